"""The closed loop on photographs that the same forecaster made: what it finds is known."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import combinations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import rankdata

from model.covariates import RECORDED_TIME, covariates_of
from model.effects import CATALOGUE, Effect
from model.effects.blocking import Blocking
from model.effects.camera_blur import CameraBlur
from model.effects.encoder_offset import EncoderOffset
from model.effects.facet_canting import FacetCanting
from model.effects.scope import Since
from model.effects.slope_error import SlopeError
from model.effects.sun_shape import SunShapeEffect
from model.errors import InvalidInputError
from model.forecast import View, align
from model.frames import sun_direction
from model.images import binned
from model.metrics import flux_accuracies
from model.plant import Heliostat
from model.plant_model import JUELICH_MODEL
from model.setup import Setup
from model.study import FluxImage, StudyOptions, conclude, study, study_to_json
from model.study.advice import PHOTOGRAPHS, SAME_SCALING, photographs_to_distinguish
from model.study.fitting import Fitter
from model.study.flux_images import Forecaster, cut, in_pixels, spot_window, without_hot_pixels
from model.study.judging import few_gain, paired_gain, rank_correlation, split
from model.study.noise import grain_variance
from model.study.outcome import Reference
from model.study.parameters import ParameterVector, Term
from model.study.position import whiten
from model.study.report import error_covariates
from model.study.trials import TrialFitter
from model.surface import control_points
from tests.conftest import target
from tests.model.scenes import PLACES

SMALL = View(40, 40, samples=8, padding=0.125)
FINE = View(96, 96, samples=12)
CAMERA = View(256, 256, samples=12)
QUICK = StudyOptions(candidates=("sun_shape", "gravity_bending"), fit_view=FINE)
NOISE = 0.003


def setups(heliostats: int = 2, count: int = 4) -> list[Setup]:
    """Wavy mirrors under suns around the day."""
    rng, plane, made = np.random.default_rng(7), target(), []
    for name, place in list(PLACES.items())[:heliostats]:
        distance = float(np.linalg.norm(np.array(place) - plane.center))
        mirror = Heliostat.juelich(name, place, distance, facet_depth=0.0)
        points = control_points(mirror, rng.normal(0, 2e-4, (4, 8, 8)))
        for number, azimuth in enumerate(np.linspace(-60, 60, count)):
            sun, spot = (
                sun_direction(180 - azimuth, 50 - abs(azimuth) / 2),
                plane.to_enu(rng.uniform(-0.3, 0.3, 2)),
            )
            made.append(Setup(mirror, points, sun, plane, spot=spot, identifier=f"{name}/{number}"))
    return made


def flux_images(
    effects: Sequence[Effect] = (),
    noise: float = 0.0,
    view: View = CAMERA,
    heliostats: int = 2,
    count: int = 4,
) -> list[FluxImage]:
    """What the forecaster expects under ``effects``, with noise in shares of the peak."""
    rng, taken = np.random.default_rng(3), setups(heliostats, count)
    images = align(taken, JUELICH_MODEL.with_effects(effects)).images(view).double().numpy()
    images = images + noise * images.max(axis=(1, 2), keepdims=True) * rng.standard_normal(
        images.shape
    )
    return [FluxImage(setup, image) for setup, image in zip(taken, images, strict=True)]


@pytest.fixture(scope="module")
def clean() -> list[FluxImage]:
    return flux_images(noise=NOISE)


@pytest.fixture(scope="module")
def hazy() -> list[FluxImage]:
    return flux_images([SunShapeEffect(0.15)], noise=NOISE)


# --- unknowns
# --------------------------------------------------------------------------------------------------


def unknowns_of(
    kinds: Sequence[type[Effect]], facets: tuple[tuple[str, int], ...]
) -> ParameterVector:
    """Of effects that are always there."""
    return ParameterVector(tuple(Term(kind) for kind in kinds), facets)


def test_unknowns_become_effects_and_nested_parameters():
    unknowns = unknowns_of((FacetCanting, Blocking, SlopeError), (("A", 4), ("B", 2)))
    assert len(unknowns.all) == 2 * (4 + 2) + 2 + 1
    low, high = unknowns.bounds
    values = low + (high - low) * np.linspace(0.1, 0.9, len(low))
    canting, blocking, slope = unknowns.effects(values)
    np.testing.assert_array_equal(canting.x_mrad["A"], values[:4])
    np.testing.assert_array_equal(canting.y_mrad["B"], values[10:12])
    assert blocking.lower_fraction == {"A": values[12], "B": values[13]}
    assert slope.sigma_mrad == values[14]
    assert unknowns.nested(Term(FacetCanting), range(15))["x_mrad"] == {
        "A": [0, 1, 2, 3],
        "B": [4, 5],
    }


def test_unknowns_go_into_others_by_what_they_are():
    both = unknowns_of((SlopeError, Blocking), (("A", 4), ("B", 4)))
    one = unknowns_of((Blocking, CameraBlur), (("B", 4),))
    values = both.transfer(np.array([1.5, 0.2, 0.3]), one)
    np.testing.assert_array_equal(values, [0.3, 0.0])
    np.testing.assert_array_equal(one.transfer(values, both), [0.0, 0.0, 0.3])
    assert both.per_heliostat.terms == (Term(Blocking),)
    assert [u.heliostat for u in both.for_heliostats(["A"]).all] == [None, "A"]


def test_unknowns_of_one_colour_belong_to_different_heliostats():
    unknowns = unknowns_of((FacetCanting, SlopeError), (("A", 4), ("B", 4)))
    groups = list(unknowns.groups.values())
    assert sorted(place for group in groups for place in group) == list(range(len(unknowns.all)))
    for group in groups:
        owners = [unknowns.all[place].heliostat for place in group]
        assert len(set(owners)) == len(owners)


# --- judging
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("heliostats", [1, 2, 3])
def test_a_split_parts_images_and_keeps_one_heliostat_of_several(heliostats):
    taken = flux_images(view=SMALL, heliostats=heliostats, count=5)
    parts = split(taken)
    rows = np.concatenate([parts.fit, parts.own, parts.held_out])
    assert sorted(rows) == list(range(len(taken)))
    assert {taken[row].heliostat for row in parts.held_out} == set(list(PLACES)[:heliostats])
    assert {taken[row].heliostat for row in parts.own} == ({"middle"} if heliostats == 3 else set())
    assert not {taken[row].heliostat for row in parts.fit} & {
        taken[row].heliostat for row in parts.own
    }


def test_images_that_surfaces_were_predicted_from_judge_only_for_want_of_others():
    taken = flux_images(view=SMALL, heliostats=2, count=5)
    unseen = {2, 3, 7}
    parts = split([replace(p, seen=row not in unseen) for row, p in enumerate(taken)])
    assert set(parts.held_out) == unseen
    assert len(parts.fit) == len(taken) - len(unseen)
    of_all = split([replace(p, seen=row != 2) for row, p in enumerate(taken)])
    np.testing.assert_array_equal(of_all.held_out, split(taken).held_out)


def test_a_report_says_where_the_judging_images_are_not_independent_of_the_surfaces(clean):
    found = study([replace(p, seen=True) for p in clean], JUELICH_MODEL, options=QUICK)
    report = study_to_json(found)
    assert report["images"]["held_out_but_predicted_from"] == report["images"]["held_out"] == 4
    assert "flatters both accuracies" in report["conclusion"]


def test_accuracy_is_one_less_the_summed_difference():
    a = np.zeros((2, 4, 4))
    b = a.copy()
    a[:, 0, 0] = b[0, 0, 0] = b[1, 3, 3] = 1.0
    np.testing.assert_allclose(flux_accuracies(a, b), [1.0, -1.0])


def test_the_interval_of_a_gain_covers_the_truth_about_as_often_as_it_says():
    """In 19 of 20 draws; percentiles of small samples promise a little too much."""
    rng, heliostats = np.random.default_rng(0), np.repeat(["a", "b", "c"], 10)
    covers = 0
    for _ in range(200):
        gain = paired_gain(rng.normal(0.02, 0.01, 30), heliostats, rounds=300)
        covers += gain.low <= 0.02 <= gain.high
    assert 170 <= covers <= 198


def test_a_gain_has_its_sign_and_differences_between_heliostats_are_no_noise():
    heliostats = np.repeat(["a", "b"], 8)
    differences = np.where(heliostats == "a", 0.01, 0.05) + np.tile([-1e-4, 1e-4], 8)
    better, worse = paired_gain(differences, heliostats), paired_gain(-differences, heliostats)
    assert better.mean == pytest.approx(0.03)
    assert 0.0299 < better.low < better.high < 0.0301
    assert worse.high < 0
    assert worse.score == pytest.approx(-better.score)


def test_rank_correlation_knows_order_only():
    values = np.array([0.1, 0.4, 0.2, 3.0])
    assert rank_correlation(values, np.exp(values)) == pytest.approx(1.0)
    assert rank_correlation(values, -values) == pytest.approx(-1.0)
    assert rank_correlation(values, np.ones(4)) == 0.0


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [2, 1, 0, 5, 4, 3], [2, 5, 0, 4, 1, 3]])
def test_ties_are_the_same_in_any_order(order: list[int]):
    """Two heliostats with three images each: all images of one have its slant range."""
    ranges, errors = (
        np.array([100.0, 100, 100, 200, 200, 200]),
        np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
    )
    assert rank_correlation(errors[order], ranges[order]) == pytest.approx(0.8783, abs=1e-4)


def test_one_difference_gains_nothing():
    assert paired_gain(np.array([0.1]), np.array(["a"])) == few_gain(np.array([0.1]))


# --- photographs
# --------------------------------------------------------------------------------------------------


def test_the_noise_of_an_image_is_read_from_its_grain():
    """Read noise and counting noise that grows with the light, on a spot as smooth as the sun makes
    it.
    """
    rng, x = np.random.default_rng(1), np.linspace(-1, 1, 128)
    light = np.exp(-(x[:, None] ** 2 + x**2) / 0.15)
    truth = 1e-4 + 4e-4 * light
    found = grain_variance(light + np.sqrt(truth) * rng.standard_normal(light.shape), spacing=1)
    np.testing.assert_allclose(found.mean(), truth.mean(), rtol=0.05)
    bright = light > 0.5
    np.testing.assert_allclose(found[bright].mean(), truth[bright].mean(), rtol=0.1)
    assert grain_variance(light, spacing=1).mean() < 0.01 * truth.mean()


def test_hot_and_dead_pixels_are_taken_from_their_neighbours(hazy):
    rng = np.random.default_rng(1)
    (rows, columns), changes = rng.integers(2, 250, (2, 100)), rng.choice([0.3, -0.2], 100)
    broken = []
    for one in hazy:
        image = one.image / one.image.max()
        for row, column, change in zip(rows, columns, changes, strict=True):
            image[row : row + 2, column : column + 2] += change
        broken.append(replace(one, image=image))
    for whole, spoiled, repaired in zip(hazy, broken, without_hot_pixels(broken), strict=True):
        light = whole.image / whole.image.max()
        assert repaired.hot_share > 0.01
        assert np.abs(repaired.image - light).sum() < 0.2 * np.abs(spoiled.image - light).sum()
    found = study(broken, JUELICH_MODEL, options=QUICK)
    assert [one.name for one in found.found] == ["sun_shape"]
    assert "Hot or dead pixels have" in conclude(found)
    few, coarse = broken[:3], [replace(one, image=binned(one.image, 16)) for one in broken]
    for untouched in (hazy, few, coarse):
        assert without_hot_pixels(untouched) == untouched


CAMERAS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "grainy": lambda light, rng: light + 0.01 * rng.standard_normal(light.shape),
    "cut at black and white": (
        lambda light, rng: (light + 0.01 * rng.standard_normal(light.shape)).clip(0, 1)
    ),
    "of 6 bits": (
        lambda light, rng: np.round(63 * light + 0.3 * rng.standard_normal(light.shape)).clip(0, 63)
    ),
    "coarse": lambda light, rng: (
        (c := in_pixels(light[None], 64, 64)[0] / 16) + 0.01 * rng.standard_normal(c.shape)
    ),
    "resampled": lambda light, rng: (
        light + gaussian_filter(0.02 * rng.standard_normal(light.shape), 1.0)
    ),
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_share_of_noise_is_the_error_it_makes(camera):
    """Roughly, whatever the camera does to the noise: where it is far too low, a study calls noise
    unexplained.
    """
    rng, errors, shares = np.random.default_rng(5), [], []
    for exact in flux_images():
        light = exact.image / exact.image.max()
        taken = FluxImage(exact.setup, CAMERAS[camera](light, rng))
        true = cut(in_pixels(light[None], *taken.image.shape), [exact.setup.plane], 4.0, 64)
        errors.append(
            1 - flux_accuracies(cut(taken.image[None], [exact.setup.plane], 4.0, 64), true)[0]
        )
        shares.append(taken.noise_share(4.0))
    assert 0.5 < np.mean(shares) / np.mean(errors) < 1.35


@pytest.mark.parametrize(
    "image", [np.ones((64, 64)), np.ones((4, 4)), np.eye(16)], ids=["even", "tiny", "lines"]
)
def test_noise_is_finite_whatever_the_image(image):
    assert np.isfinite(FluxImage(setups()[0], image).noise_share(4.0))


def test_a_coarse_camera_is_forecast_in_its_own_pixels():
    taken = flux_images()
    coarse = [FluxImage(p.setup, in_pixels(p.image[None], 32, 32)[0]) for p in taken]
    forecaster = Forecaster(coarse, JUELICH_MODEL, 4.0, View(128, 128, samples=12))
    assert flux_accuracies(forecaster.measured(), forecaster.cuts([])).min() > 0.99


def test_the_window_holds_the_spots(clean, hazy):
    assert spot_window(clean) in (4.0, 6.0)
    assert spot_window(hazy) >= spot_window(clean)


def test_a_forecaster_repeats_itself_whatever_it_has_kept(clean):
    forecaster = Forecaster(clean, JUELICH_MODEL, 4.0, SMALL)
    plain = forecaster.cuts([])
    for effects in (
        [SlopeError(1.0)],
        [CameraBlur(0.2)],
        [FacetCanting(x_mrad={"near": np.array([2.0, 0, 0, -2])})],
    ):
        changed = forecaster.cuts(effects)
        assert np.abs(changed - plain).sum(axis=(1, 2)).max() > 0.01
        np.testing.assert_allclose(
            changed, Forecaster(clean, JUELICH_MODEL, 4.0, SMALL).cuts(effects), atol=1e-6
        )
    forecaster.forget()
    np.testing.assert_allclose(forecaster.cuts([]), plain, atol=1e-6)


def test_parts_of_the_photographs_that_were_used_long_ago_free_their_memory(clean):
    fitter = TrialFitter(clean, JUELICH_MODEL, StudyOptions(fit_view=SMALL, view=SMALL))
    made = [fitter.forecasters(np.arange(count)) for count in (1, 2, 3, 4)]
    for forecasters in made:
        forecasters.coarse.cuts([])
    fitter.forecasters(np.arange(4))
    assert [bool(one.coarse._flux) for one in made] == [False, True, True, True]
    assert fitter.forecasters(np.arange(1)) is made[0]


# --- fitting
# --------------------------------------------------------------------------------------------------


def fitted(truth: Effect) -> tuple[ParameterVector, np.ndarray, np.ndarray]:
    """ParameterVector of a kind, their fit to forecasts that hold ``truth``, and the
    spread of it.
    """
    forecaster = Forecaster(flux_images([truth], view=SMALL), JUELICH_MODEL, 6.0, SMALL)
    unknowns = unknowns_of((type(truth),), (("far", 4), ("near", 4)))
    fit = Fitter(forecaster).fit(unknowns, unknowns.neutral)
    return unknowns, fit.values, fit.spread


def test_a_fit_recovers_the_suns_shape():
    _, values, spread = fitted(SunShapeEffect(0.12))
    assert values[0] == pytest.approx(0.12, abs=0.004)
    assert 0 <= spread[0] < 0.01


def test_a_fit_recovers_the_canting_of_every_facet():
    """But for the tilt that all facets of a mirror share, which the alignment takes back."""
    rng = np.random.default_rng(4)
    x, y = ({name: rng.uniform(-1, 1, 4) for name in ("far", "near")} for _ in range(2))
    unknowns, values, _ = fitted(FacetCanting(x_mrad=x, y_mrad=y))
    (found,) = unknowns.effects(values)
    for truth, seen in ((x, found.x_mrad), (y, found.y_mrad)):
        for name in truth:
            np.testing.assert_allclose(
                seen[name] - seen[name].mean(), truth[name] - truth[name].mean(), atol=0.12
            )


def test_where_the_model_fails_the_residual_is_infinite(clean):
    """All light blocked, or the sun below the horizon: as wrong as can be, and no
    reason to stop.
    """
    fitter = Fitter(Forecaster(clean, JUELICH_MODEL, 4.0, SMALL))
    unknowns = unknowns_of((CATALOGUE["soiling"],), (("far", 4), ("near", 4)))
    dark = np.zeros(len(unknowns.all))
    assert np.isinf(fitter.residuals(unknowns, dark)).all()
    trials = np.array([dark, unknowns.neutral])
    energies = (fitter.residuals_of(unknowns, trials) ** 2).sum(axis=-1)
    np.testing.assert_array_equal(fitter.energies_of(unknowns, trials), energies)
    assert np.isnan(fitter.descend(unknowns, dark).spread).all()


# --- study
# --------------------------------------------------------------------------------------------------


def test_no_effect_is_found_in_clean_photographs(clean):
    found = study(clean, JUELICH_MODEL, options=QUICK)
    assert found.verdict == "none"
    assert found.effects == found.found == []
    np.testing.assert_array_equal(found.after, found.before)
    assert "explains the images" in conclude(found)


def test_an_effect_is_found_with_its_parameter_and_what_it_buys(hazy):
    reports: list[str] = []
    found = study(hazy, JUELICH_MODEL, options=QUICK, progress=reports.append)
    report = study_to_json(found)
    assert found.verdict == "effect"
    (effect,) = found.effects
    assert isinstance(effect, SunShapeEffect)
    ratio = report["effects"][0]["parameters"]["circumsolar_ratio"]
    assert ratio["value"] == pytest.approx(0.15, abs=0.01)
    assert ratio["ci95"][0] < ratio["value"] < ratio["ci95"][1]
    gain = report["effects"][0]["accuracy_gain"]
    assert 0 < gain["ci95"][0] <= gain["mean"] <= gain["ci95"][1]
    rise = report["after"]["accuracy_mean"] - report["before"]["accuracy_mean"]
    assert rise == pytest.approx(gain["mean"], abs=2e-5)
    assert report["images"] == {"fit": 4, "held_out": 4}
    assert [c["name"] for c in report["candidates"]] == ["sun_shape", "gravity_bending"]
    assert report["candidates"][0]["accuracy_gain"] == gain
    stages = {"changes, days and single heliostats", "halves of the photographs"}
    assert set(reports) == {"sun_shape", "gravity_bending"} | stages
    assert (report["partly"], report["discrepancy"]) == ([], None)
    (alone,) = found.found
    for lookalikes, words in (
        ([], ""),
        (["slope_error"], "; these images cannot distinguish sun shape from slope error"),
    ):
        alike = replace(found, found=[replace(alone, lookalikes=lookalikes)])
        assert f"{found.accuracy_after.mean():.1%}{words}." in conclude(alike)


def test_several_effects_must_leave_less_of_pure_light_than_one(hazy):
    found = study(hazy, JUELICH_MODEL, options=QUICK)
    one = replace(found, after=(found.after + found.before) / 2)
    assert 0.2 < one.unexplained_share < 2 / 3
    several = replace(one, found=2 * one.found)
    on_sheet = replace(several, images=[replace(p, sheet_share=1e-3) for p in several.images])
    assert (one.verdict, several.verdict, on_sheet.verdict) == ("effect", "unexplained", "effect")


@pytest.mark.parametrize("is_estimated", [True, False])
def test_what_estimated_surfaces_leave_is_no_effects(hazy, is_estimated: bool):
    """Twelve images without the effect are as wrong as those with it are then."""
    begin = datetime(2026, 5, 13, tzinfo=UTC)
    times = [begin + timedelta(days=day) for day in range(-12, 8)]
    images = [
        replace(hazy[0], is_estimated=is_estimated, setup=replace(hazy[0].setup, taken_at=at))
        for at in times
    ]
    effect = SunShapeEffect(0.2, scope=Since(begin.date()))
    error = np.array([0.03 + 0.05 * (at >= begin) for at in times])
    reference = Reference.of(images, [effect])
    left = reference.beyond(error)
    assert (len(left), round(float(left.mean()), 6)) == ((8, 0.05) if is_estimated else (20, 0.05))
    assert reference.gain(np.full(20, 0.02)).mean == pytest.approx(0.0 if is_estimated else 0.02)
    everywhere = Reference.of(images, [SunShapeEffect(0.2)])  # nothing shows what surfaces leave
    assert len(everywhere.beyond(error)) == 20


def test_spots_that_are_off_do_not_speak_against_what_changed_shapes(hazy):
    found = study(hazy, JUELICH_MODEL, options=QUICK)
    off = np.full_like(found.position_residuals_before, 99.0)
    moved = replace(found, position_residuals_before=off, position_residuals_after=off)
    of_position = replace(moved, effects=[EncoderOffset(first_deg={"AA23": 0.1})])
    blurred = replace(moved, after=(moved.after + 3 * moved.before) / 4)
    assert moved.unexplained_share > 2 / 3
    assert moved.verdict == "effect"
    assert (of_position.verdict, blurred.verdict) == ("unexplained", "unexplained")


@pytest.mark.full
def test_what_no_candidate_explains_is_said(hazy):
    found = study(hazy, JUELICH_MODEL, options=replace(QUICK, candidates=("axis_tilt",)))
    assert found.verdict == "unexplained"
    assert found.unexplained_share == 1.0
    assert found.partly == []
    assert study_to_json(found)["discrepancy"]["lives_in"] in (None, "angle", "mirror")
    assert [c.name for c in found.candidates] == ["axis_tilt"]
    assert set(error_covariates(found)) == {
        "sun elevation",
        "slant range",
        "solar time",
        "sun azimuth",
        "height of the target",
    }


@pytest.mark.full
def test_what_remains_is_reported_alike_in_any_order_of_the_images(hazy):
    """Several images have one slant range and one height of the target: they are ties."""
    found = study(hazy, JUELICH_MODEL, options=replace(QUICK, candidates=("axis_tilt",)))
    (known,) = (
        values
        for one, values in covariates_of([p.setup for p in found.images], found.site).items()
        if one.name == "slant range"
    )
    assert len(np.unique(known)) < len(known)
    reported = []
    for order in (
        np.arange(len(known)),
        np.arange(len(known))[::-1],
        np.argsort(found.accuracy_after),
    ):
        arrays = {name: getattr(found, name)[order] for name in ("measured", "before", "after")}
        permuted = replace(found, images=[found.images[place] for place in order], **arrays)
        reported.append(error_covariates(permuted))
    assert reported[0] == reported[1] == reported[2]
    expected = np.corrcoef(rankdata(1 - found.accuracy_after), rankdata(known))[0, 1]
    assert reported[0]["slant range"] == pytest.approx(expected, abs=5e-4)


@pytest.mark.full
def test_calibrated_mounts_are_not_tilted(hazy):
    def stand(photograph):
        heliostat = photograph.setup.heliostat
        mount = replace(heliostat.mount, is_calibrated=True)
        return replace(
            photograph, setup=replace(photograph.setup, heliostat=replace(heliostat, mount=mount))
        )

    options = replace(QUICK, candidates=("axis_tilt",))
    found = study([stand(p) for p in hazy], JUELICH_MODEL, options=options)
    assert found.verdict == "unexplained"
    (candidate,) = found.candidates
    assert candidate.gain.low == candidate.gain.high == 0


@pytest.mark.full
def test_an_error_that_grows_with_time_is_seen_where_times_were_recorded(hazy):
    first = datetime(2026, 6, 1, 12, tzinfo=UTC)
    dated = [
        replace(p, setup=replace(p.setup, taken_at=first + timedelta(days=day)))
        for day, p in enumerate(hazy)
    ]
    found = study(dated, JUELICH_MODEL, options=replace(QUICK, candidates=("axis_tilt",)))
    days = covariates_of([p.setup for p in found.images], found.site)[RECORDED_TIME]
    days -= days.min()
    np.testing.assert_allclose(days, np.round(days))
    assert error_covariates(found)["recorded time"] == pytest.approx(
        rank_correlation(1 - found.accuracy_after, days), abs=5e-4
    )
    assert RECORDED_TIME not in covariates_of(
        [p.setup for p in (*found.images, hazy[0])], found.site
    )


def test_what_is_declared_is_no_candidate(hazy):
    found = study(hazy, JUELICH_MODEL.with_effects([SunShapeEffect(0.15)]), QUICK)
    assert found.verdict == "none"
    assert [c.name for c in found.candidates] == ["gravity_bending"]


def test_too_few_photographs_or_two_of_one_name_are_refused(clean):
    with pytest.raises(InvalidInputError, match="at least 4 photographs, got 3"):
        study(clean[:3], JUELICH_MODEL)
    with pytest.raises(InvalidInputError, match="different identifiers"):
        study([*clean[:4], clean[0]], JUELICH_MODEL)


@pytest.mark.parametrize(
    "image", [np.zeros((8, 8)), np.full((8, 8), np.nan), np.ones(8)], ids=["dark", "nan", "line"]
)
def test_a_photograph_that_holds_no_image_is_named(clean, image):
    with pytest.raises(InvalidInputError, match="photograph near/0"):
        FluxImage(clean[0].setup, image)


def test_spot_shifts_within_the_mounts_uncertainty_have_little_weight():
    """Squares of whitened residuals with shared deviations are the exact quadratic form."""
    rng = np.random.default_rng(0)
    off, shifts = rng.normal(size=(6, 2)), 5 * rng.normal(size=(6, 2, 3))
    shared = shifts.reshape(12, 3)
    precision = np.linalg.inv(np.eye(12) + shared @ shared.T)
    assert (whiten(off, shifts) ** 2).sum() == pytest.approx(off.ravel() @ precision @ off.ravel())
    common = shifts[..., 0]
    assert (whiten(common, shifts) ** 2).sum() < 0.02 * (common**2).sum()
    np.testing.assert_allclose(whiten(off, 0 * shifts), off)


# --- advice
# --------------------------------------------------------------------------------------------------


def test_all_look_alikes_have_photographs_that_distinguish_them():
    scalings = (kind.scales_with for kind in CATALOGUE.values())
    assert set().union(*scalings) == set(PHOTOGRAPHS)
    for first, second in combinations(CATALOGUE, 2):
        same = all(
            name.startswith("camera") or name == "target_registration" for name in (first, second)
        )
        assert (photographs_to_distinguish(first, second) == SAME_SCALING) == same
        assert photographs_to_distinguish(first, second) == photographs_to_distinguish(
            second, first
        )


@pytest.mark.parametrize(
    ("first", "second", "says"),
    [
        ("sun_shape", "camera_blur", "a near and a far heliostat"),
        ("sun_shape", "slope_error", "several heliostats within the same hour"),
        ("gravity_bending", "facet_canting", "a high and a low sun"),
        ("soiling", "blocking", "a high and a low sun"),
        ("slope_error", "tracking_jitter", "in the early morning"),
    ],
)
def test_photographs_vary_what_look_alikes_scale_with(first, second, says):
    assert says in photographs_to_distinguish(first, second)
