"""Effects on sun, mount, mirror and optics, against geometry and the Monte Carlo tracer; and
effects as data.
"""

import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import torch

from model.effects import (
    CATALOGUE,
    Since,
    apply_mount_effects,
    effect_from_json,
    effect_to_json,
    effects_from_json,
    in_light_order,
    model_version,
)
from model.effects.axis_tilt import AxisTilt
from model.effects.blocking import Blocking
from model.effects.encoder_offset import EncoderOffset
from model.effects.facet_canting import FacetCanting
from model.effects.gravity_bending import ALONG, REFERENCE, GravityBending
from model.effects.pylon_bending import PylonBending
from model.effects.slope_error import SlopeError
from model.effects.soiling import Soiling
from model.effects.sun_position import SunPosition
from model.effects.sun_shape import SunShapeEffect
from model.effects.tracking_jitter import TrackingJitter
from model.errors import InvalidInputError
from model.forecast import View, align
from model.frames import sun_direction, sun_direction_at
from model.mount import Mount
from model.plant_model import JUELICH_MODEL, PlantModel
from model.setup import Setup
from model.site import JUELICH, Site
from model.sunshape import Gaussian
from model.surface import control_points, evaluate
from model.tracing import Optics, Scene, Window, trace
from model.tracing.convolution import central_rays
from model.tracing.montecarlo import trace_montecarlo
from tests.conftest import flat_heliostat, target

SUN = sun_direction(155.0, 40.0)

ROOT = Path(__file__).parents[2]


def setup(
    sun=SUN, position=(20.0, 70.0, 1.8), focal_length=75.0, mount=None, z=None, **given
) -> Setup:
    heliostat, plane = flat_heliostat(position, focal_length, mount), target()
    given.setdefault("spot", plane.center)
    return Setup(heliostat, control_points(heliostat, z), np.asarray(sun), plane, **given)


def waves(seed=0, scale=2e-4) -> np.ndarray:
    z = np.random.default_rng(seed).normal(0, scale, (4, 8, 8))
    return z - z.mean(axis=(1, 2), keepdims=True)


def scene_of(one: Setup, *effects) -> Scene:
    return align([one], JUELICH_MODEL.with_effects(effects), dtype=torch.float64).groups[0].scene


# --- effects as data
# --------------------------------------------------------------------------------------------------


def test_the_catalogue_is_the_contract():
    """DESIGN.md, section 5; the closed loop added `camera_ghost` and `camera_shoulder`."""
    bounds = {
        name: {p.name: (p.low, p.high, p.unit, p.owner) for p in effect.parameters()}
        for name, effect in CATALOGUE.items()
    }
    assert len(bounds) == 18
    assert bounds["sun_shape"] == {"circumsolar_ratio": (0, 0.5, "1", "set")}
    assert (
        bounds["slope_error"] == bounds["tracking_jitter"] == {"sigma_mrad": (0, 4, "mrad", "set")}
    )
    assert bounds["facet_canting"] == dict.fromkeys(("x_mrad", "y_mrad"), (-5, 5, "mrad", "facet"))
    assert bounds["gravity_bending"] == {"amplitude_mm": (-8, 8, "mm", "set")}
    assert bounds["axis_tilt"] == dict.fromkeys(
        ("north_deg", "up_deg", "east_deg"), (-3, 3, "deg", "set")
    )
    assert bounds["known_neighbours"] == {"share": (0, 1, "1", "set")}
    assert bounds["pylon_bending"] == {"amplitude_mrad": (-20, 20, "mrad", "set")}
    assert bounds["encoder_offset"] == dict.fromkeys(
        ("first_deg", "second_deg"), (-6, 6, "deg", "heliostat")
    )
    assert bounds["sun_position"] == {"minutes": (-90, 90, "min", "set")}
    assert bounds["soiling"] == {"reflectivity_ratio": (0, 1, "1", "facet")}
    assert bounds["blocking"] == {"lower_fraction": (0, 0.6, "1", "heliostat")}
    assert bounds["camera_response"] == {
        "gamma": (0.3, 3, "1", "camera"),
        "saturation": (0.3, 1, "1", "camera"),
    }
    assert bounds["camera_shoulder"] == {"compression": (0, 5, "1", "camera")}
    assert bounds["camera_blur"] == {"sigma_m": (0, 0.5, "m", "camera")}
    assert list(bounds["background"]) == ["level", "gradient_x", "gradient_y"]
    assert list(bounds["target_registration"]) == ["scale_x", "scale_y", "shear", "rotation_deg"]


def test_effects_survive_json_and_a_report_can_be_read():
    effects = [
        SunShapeEffect(torch.tensor(0.2)),
        FacetCanting(x_mrad={"AA39": torch.tensor([0.5, 0.0, 0.0, -1.0])}),
        Blocking({"AA39": 0.25}),
    ]
    text = json.dumps([effect_to_json(effect) for effect in effects])
    again = effects_from_json(json.loads(text))
    assert json.dumps([effect_to_json(effect) for effect in again]) == text
    reported = {"value": {"AA39": 0.25}, "ci95": {"AA39": [0.2, 0.3]}, "unit": "1"}
    report = {
        "verdict": "effect",
        "effects": [{"name": "blocking", "parameters": {"lower_fraction": reported}}],
    }
    assert effect_to_json(effects_from_json(report)[0]) == effect_to_json(effects[2])
    one_by_one = {"AA39": {"value": 0.25, "ci95": [0.2, 0.3], "unit": "1"}}
    assert effect_from_json(
        {"name": "blocking", "parameters": {"lower_fraction": one_by_one}}
    ).lower_fraction == {"AA39": 0.25}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"name": "dust"}, "'dust' is unknown; the catalogue has"),
        (
            {"name": "slope_error", "parameters": {"sigma": 1}},
            "no parameter 'sigma'; it has sigma_mrad",
        ),
        (
            {"name": "slope_error", "parameters": {"sigma_mrad": 4.1}},
            r"'sigma_mrad' must be a number in \[0, 4\] mrad",
        ),
        (
            {"name": "slope_error", "parameters": {"sigma_mrad": float("nan")}},
            r"\[0, 4\] mrad, got nan",
        ),
        ({"name": "slope_error", "parameters": {"sigma_mrad": "1"}}, "must be a number"),
        ({"name": "slope_error", "parameters": {"sigma_mrad": True}}, "must be a number"),
        (
            {"name": "facet_canting", "parameters": {"x_mrad": [1, 2, 3, 4]}},
            "must map heliostat names",
        ),
        (
            {"name": "facet_canting", "parameters": {"x_mrad": {"A": 1.0}}},
            r"numbers, one a facet, in \[-5, 5\] mrad",
        ),
        ({"name": "facet_canting", "parameters": {"x_mrad": {"A": [1, [2]]}}}, "one a facet"),
        (
            {"name": "blocking", "parameters": {"lower_fraction": {"A": 0.7}}},
            r"in \[0, 0.6\], got 0.7",
        ),
        ({"name": "blocking", "parameters": 1}, "'parameters' must be an object"),
        ("blocking", "must be an object with a 'name'"),
    ],
)
def test_malformed_effects_are_refused_by_name(data, says):
    with pytest.raises(InvalidInputError, match=says):
        effect_from_json(data)


def test_a_list_is_needed():
    with pytest.raises(InvalidInputError, match="'effects' must be a list"):
        effects_from_json({"verdict": "none"})


def test_values_must_match_the_facets():
    with pytest.raises(InvalidInputError, match="flat has 4 facets, got 3 values"):
        align([setup()], JUELICH_MODEL.with_effects([Soiling({"flat": np.ones(3)})]))


def test_version_names_the_effects_in_the_order_of_light():
    effects = [Soiling(), SlopeError(), SunPosition()]
    assert [effect.name for effect in in_light_order(effects)] == [
        "sun_position",
        "soiling",
        "slope_error",
    ]
    assert model_version(effects) == "2:sun_position+soiling+slope_error"
    assert model_version([]) == "1:none"


@pytest.mark.parametrize("name", CATALOGUE)
def test_without_parameters_nothing_changes(name):
    setups, view = [setup(), setup(sun_direction(230.0, 25.0), z=waves())], View(64, 64, samples=8)
    plain, neutral = (
        align(setups, JUELICH_MODEL.with_effects(e), dtype=torch.float64).images(view)
        for e in ((), [CATALOGUE[name]()])
    )
    np.testing.assert_allclose(neutral, plain, atol=1e-3 * float(plain.max()))


# --- sun and mount
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("minutes", [-40.0, 25.0])
@pytest.mark.parametrize("latitude", [50.913, -23.0])
def test_a_clock_error_moves_the_sun_along_its_daily_path(minutes, latitude):
    recorded = sun_direction_at([-20.0, 10.0, 23.0], [-30.0, 5.0, 40.0], latitude)
    true = sun_direction_at(
        [-20.0, 10.0, 23.0], np.array([-30.0, 5.0, 40.0]) + minutes / 4, latitude
    )
    np.testing.assert_allclose(
        SunPosition(minutes).on_sun(recorded, Site(latitude, 0.0, 0.0)), true, atol=1e-12
    )


def test_later_sun_is_further_west():
    noon = sun_direction(180.0, 40.0)
    assert SunPosition(30.0).on_sun(noon[None], JUELICH)[0, 0] < -0.1


@pytest.mark.parametrize("tilt", [AxisTilt(north_deg=2.0), AxisTilt(up_deg=-3.0)])
def test_what_is_left_of_a_tilt_is_a_roll_of_the_mirror(tilt):
    """The normal stays where sun and spot demand it; its y stays perpendicular to the first axis,
    which moved.
    """
    upright, tilted = (
        scene_of(setup(sun_direction(130.0, 25.0)), *effects) for effects in ([], [tilt])
    )
    normals = upright.attitude[0, :, 2], tilted.attitude[0, :, 2]
    np.testing.assert_allclose(*normals, atol=1e-4)
    axis = tilt.on_mount(Mount.juelich(), "flat").first_axis
    assert float(tilted.attitude[0, :, 1] @ torch.as_tensor(axis)) == pytest.approx(0, abs=1e-12)
    roll = np.degrees(np.arccos(float(upright.attitude[0, :, 1] @ tilted.attitude[0, :, 1])))
    assert 0.5 < roll < 4


def test_axis_tilt_turns_both_axes_right_handed():
    mount = AxisTilt(up_deg=2.0).on_mount(Mount.juelich(), "flat")
    np.testing.assert_allclose(
        mount.first_axis, [np.cos(np.radians(2)), np.sin(np.radians(2)), 0], atol=1e-12
    )
    mount = AxisTilt(north_deg=2.0).on_mount(Mount.juelich(), "flat")
    np.testing.assert_allclose(
        mount.first_axis, [np.cos(np.radians(2)), 0, -np.sin(np.radians(2))], atol=1e-12
    )


# --- mirror
# --------------------------------------------------------------------------------------------------


def test_gravity_bends_the_mirror_to_a_paraboloid_from_where_it_was_measured():
    one = setup(z=waves())
    bent, straight = (scene_of(one, *effects) for effects in ([GravityBending(6.0)], []))
    sine = float(bent.attitude[0, 2, 2])
    grid = np.linspace(0, 1, 21)

    def surface(scene: Scene) -> np.ndarray:
        return evaluate(scene.control_points[0].movedim(1, -1).numpy(), grid, grid)[0]

    before, after = surface(straight), surface(bent)
    shape = (before[..., 1] / 1.28) ** 2 + ALONG * (before[..., 0] / 1.61) ** 2
    np.testing.assert_allclose(
        before[..., 2] - after[..., 2], 6e-3 * (sine - REFERENCE) * shape, atol=2e-8
    )
    np.testing.assert_allclose(after[..., :2], before[..., :2], atol=1e-12)


def test_gravity_follows_the_mirrors_attitude():
    """A low sun behind the target needs an upright mirror, a sun overhead a flat one.

    The amplitude is the same, the sag differs.
    """
    amplitude, sag = GravityBending(5.0), []
    for elevation in (15.0, 60.0):
        scenes = [scene_of(setup(sun_direction(170.0, elevation)), *e) for e in ([amplitude], [])]
        sunk = (scenes[1].control_points - scenes[0].control_points)[0, :, 2]
        edge = sunk.flatten()[sunk.abs().argmax()]
        sag.append(float(edge) / (float(scenes[0].attitude[0, 2, 2]) - REFERENCE))
    assert sag[0] == pytest.approx(sag[1], rel=1e-6)
    assert sag[0] == pytest.approx(5e-3 * (1 + ALONG), rel=1e-3)


# --- where light goes by the motors
# -----------------------------------------------------------------------------------


def displaced(one: Setup, *effects) -> np.ndarray:
    return align([one], JUELICH_MODEL.with_effects(effects)).displacements[0]


def on_its_motors(one: Setup, *effects) -> Setup:
    """The setup with what its motors say when its spot lies where it does."""
    return replace(one, angles=align([one], JUELICH_MODEL.with_effects(effects)).angles[0])


def test_where_motors_send_the_light_nothing_is_displaced():
    for effects in (
        [],
        [AxisTilt(1.0, -2.0), SunPosition(12.0), GravityBending(5.0)],
        [PylonBending(9.0)],
    ):
        one = on_its_motors(setup(z=waves()), *effects)
        np.testing.assert_allclose(displaced(one, *effects), 0.0, atol=1e-6)
    assert np.isnan(displaced(setup())).all()


def test_an_encoder_moves_the_spot_by_twice_its_offset():
    """Of a mirror that faces south: the first axis turns it up or down, the second sidewards."""
    one = on_its_motors(setup(sun_direction(180.0, 20.0), (0.0, 70.0, 1.8)))
    up = displaced(one, EncoderOffset(first_deg={"flat": 0.1}))
    np.testing.assert_allclose(np.degrees(up), [0.0, 0.2], atol=5e-4)
    aside = displaced(one, EncoderOffset(second_deg={"flat": 0.1}))
    assert abs(np.degrees(aside[0])) == pytest.approx(0.2, rel=0.1)
    np.testing.assert_array_equal(
        displaced(one, EncoderOffset(first_deg={"other": 0.1})), displaced(one)
    )


def test_a_forecast_by_motors_has_the_offsets_of_encoders():
    one, offset = on_its_motors(setup()), EncoderOffset(first_deg={"flat": 0.1})
    by_motors = align([replace(one, spot=None)], JUELICH_MODEL.with_effects([offset]))
    np.testing.assert_allclose(by_motors.angles[0], one.angles + np.radians([0.1, 0.0]))


@pytest.mark.parametrize(
    ("until", "acts"),
    [(None, False), (date(2026, 5, 30), True), (date(2026, 6, 1), False)],
    ids=str,
)
def test_on_a_calibrated_mount_acts_what_came_after_its_photographs(until, acts):
    mount = replace(Mount.juelich(), is_calibrated=True, calibrated_until=until)
    (standing,) = apply_mount_effects(
        [flat_heliostat(mount=mount)], [AxisTilt(up_deg=2.0, scope=Since(date(2026, 6, 1)))]
    )
    assert (standing.mount.first_axis[1] != 0) == acts
    (standing,) = apply_mount_effects([flat_heliostat(mount=mount)], [AxisTilt(up_deg=2.0)])
    assert standing.mount.first_axis[1] == 0


# --- mirror
# --------------------------------------------------------------------------------------------------


def test_canting_of_one_heliostat_leaves_the_others_alone():
    tilt = FacetCanting(x_mrad={"flat": [2.0, 0, 0, 0]}, y_mrad={"other": [1.0, 1.0, 1.0, 1.0]})
    one = setup(focal_length=None)
    before, after = (central_rays(scene_of(one, *e), 8) for e in ([], [tilt]))
    spots = (after.hits - before.hits)[0].view(2, 4, -1).mean(-1).numpy()
    # Alignment holds the common centre, so that the facet goes three quarters of the way and the
    # others one back.
    shift = np.linalg.norm(spots[:, 0] - spots[:, 1])
    assert 0.9 < shift / (2 * 2e-3 * float(before.slant_range)) < 1.15
    np.testing.assert_allclose(spots[:, 1], spots[:, 2], atol=2e-3)
    np.testing.assert_allclose(after.spot, before.spot, atol=1e-4)


def test_soiling_dims_facets():
    base, soiled = scene_of(setup()), scene_of(setup(), Soiling({"flat": [1, 0.5, 1, 0.25]}))
    ratio = central_rays(soiled, 8).power.view(4, -1).sum(1) / central_rays(base, 8).power.view(
        4, -1
    ).sum(1)
    np.testing.assert_allclose(ratio, [1, 0.5, 1, 0.25], rtol=0.01)


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.37, 0.55])
@pytest.mark.parametrize("samples", [3, 16])
def test_blocking_takes_its_share_of_the_mirror_at_any_sampling(fraction, samples):
    """Between the rows of facets lies a gap of 10 mm, so that the share of the height is not quite
    that of the area.
    """
    free, cut = scene_of(setup()), scene_of(setup(), Blocking({"flat": fraction}))
    lost = 1 - float(
        central_rays(cut, samples).power.sum() / central_rays(free, samples).power.sum()
    )
    height = max(0.0, min(fraction * 2.56, 1.275)) + max(0.0, fraction * 2.56 - 1.285)
    assert lost == pytest.approx(height / 2.55, abs=2e-3)


def test_blocking_hides_the_lower_facets():
    cut = scene_of(setup(), Blocking({"flat": 0.5}))
    power = central_rays(cut, 8).power.view(4, -1).sum(1)
    assert float(power[2:].sum()) == pytest.approx(0, abs=1e-12)
    assert (power[:2] > 1).all()


# --- optics
# --------------------------------------------------------------------------------------------------


def test_errors_add_in_quadrature():
    optics = SlopeError(1.2).on_optics(Optics(slope_error=5e-4))
    assert optics.slope_error == pytest.approx(1.3e-3)
    assert TrackingJitter(0.3).on_optics(
        TrackingJitter(0.4).on_optics(Optics())
    ).tracking_jitter == pytest.approx(5e-4)


@pytest.mark.parametrize(
    "mount", [Mount.juelich(), Mount.azimuth_elevation()], ids=["juelich", "azimuth_elevation"]
)
def test_jitter_smears_along_the_way_that_the_spot_goes_as_the_mount_turns(mount):
    heliostat, plane, step = flat_heliostat((40.0, 60.0, 1.8), 75.0, mount), target(), 1e-5
    angles = heliostat.mount.align(heliostat.position, SUN, plane.center)
    one = Setup(heliostat, control_points(heliostat), SUN, plane)
    spots = [
        central_rays(Scene.from_setups([one], [angles + [s, 0]], torch.float64), 8).spot
        for s in (-step, step)
    ]
    moved = ((spots[1] - spots[0]) / (2 * step))[0].numpy()
    still = Scene.from_setups([one], [angles], torch.float64)
    np.testing.assert_allclose(
        central_rays(still, 8).spot_per_angle[0], moved, atol=0.01 * np.linalg.norm(moved)
    )
    window, soft = Window(12.0, 12.0, 96, 96, on_spot=True), Gaussian(1e-3)
    spread = [
        _covariance(
            trace(still, window, Optics(sun_shape=soft, tracking_jitter=sigma), samples=12), window
        )
        for sigma in (0.0, 3e-3)
    ]
    np.testing.assert_allclose(
        spread[1] - spread[0],
        9e-6 * np.outer(moved, moved),
        atol=9e-6 * 0.02 * float(moved @ moved),
    )


def _covariance(flux, window: Window) -> np.ndarray:
    """Second central moments (2, 2) [m2], right and up, of one image."""
    image = flux.irradiance[0].numpy()
    x = (np.arange(window.columns) + 0.5) * window.pixel[0] - window.width / 2
    y = window.height / 2 - (np.arange(window.rows) + 0.5) * window.pixel[1]
    places = np.stack([a.ravel() for a in np.meshgrid(x, y)])
    return np.cov(places, aweights=image.ravel().clip(min=0), ddof=0)


def test_jitter_needs_to_know_the_axis():
    scene = scene_of(setup()).with_(jitter_axis=None)
    for tracer in (trace, trace_montecarlo):
        with pytest.raises(InvalidInputError, match="jitter_axis"):
            tracer(scene, Window(), Optics(tracking_jitter=1e-3))


# --- both tracers
# --------------------------------------------------------------------------------------------------

STRONG = [
    SunPosition(45.0),
    AxisTilt(north_deg=2.0, up_deg=-2.0),
    FacetCanting(x_mrad={"flat": [2.0, -1.0, 0.0, 1.0]}, y_mrad={"flat": [0.0, 1.0, -2.0, 1.0]}),
    GravityBending(4.0),
    Soiling({"flat": [1.0, 0.3, 0.6, 0.0]}),
    Blocking({"flat": 0.33}),
    SunShapeEffect(0.3),
    SlopeError(2.0),
    TrackingJitter(3.0),
]


@pytest.mark.parametrize("effect", STRONG, ids=lambda effect: effect.name)
def test_both_tracers_show_the_effect_alike(effect):
    """L1 distance of the images within the Monte Carlo tracer's noise."""
    rays, view, optics = (
        400_000,
        View(32, 32, window=6.0, samples=24, cones="facet"),
        Optics(sun_shape=Gaussian(3e-3)),
    )
    declared = PlantModel(JUELICH, optics)
    aligned = align([setup(z=waves())], declared.with_effects([effect]), dtype=torch.float64)

    def montecarlo(scene: Scene, window: Window, optics: Optics) -> torch.Tensor:
        return torch.as_tensor(trace_montecarlo(scene, window, optics, rays=rays)[0])

    smooth = aligned.flux(view)[0].clamp(min=0).numpy()
    thrown = aligned.flux(view, montecarlo)[0].numpy()
    plain = align([setup(z=waves())], declared, dtype=torch.float64).flux(view)[0].numpy()
    # Half the rays or more count: the others meet dirt or a neighbour.
    noise = np.sqrt(2 / np.pi) * np.sqrt(smooth / smooth.sum() / (rays / 2)).sum()
    assert np.abs(thrown - smooth).sum() / smooth.sum() < 1.1 * noise
    assert np.abs(plain - smooth).sum() / smooth.sum() > 0.008


@pytest.mark.parametrize(
    "effect", [SunShapeEffect(0.3), SlopeError(2.0), TrackingJitter(3.0)], ids=lambda e: e.name
)
def test_optics_spread_light_and_lose_none(effect):
    window = View(96, 96, window=30.0, samples=12)
    plain, spread = (
        align([setup()], JUELICH_MODEL.with_effects(effects), dtype=torch.float64)
        .flux(window)
        .sum()
        for effects in ((), [effect])
    )
    assert float(spread / plain) == pytest.approx(1, abs=2e-3)


# --- gradients
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "value"),
    [
        (lambda v: FacetCanting(x_mrad={"flat": v}), [0.5, 0.0, -1.0, 0.2]),
        (lambda v: FacetCanting(y_mrad={"flat": v}), [0.5, 0.0, -1.0, 0.2]),
        (lambda v: GravityBending(v), 3.0),
        (lambda v: Soiling({"flat": v}), [0.9, 0.5, 0.7, 0.3]),
        (lambda v: Blocking({"flat": v}), 0.333),
        (lambda v: SunShapeEffect(v), 0.1),
        (lambda v: SlopeError(v), 1.0),
        (lambda v: TrackingJitter(v), 1.0),
    ],
    ids=[
        "canting_x",
        "canting_y",
        "gravity",
        "soiling",
        "blocking",
        "sun_shape",
        "slope",
        "jitter",
    ],
)
def test_gradients_agree_with_finite_differences(make, value):
    """With the alignment held, which is not differentiable."""
    held, view = (
        align([setup(z=waves())], JUELICH_MODEL, dtype=torch.float64).groups[0],
        View(24, 24, samples=8),
    )
    heliostats = [setup().heliostat]
    weights = torch.as_tensor(np.random.default_rng(1).normal(size=(24, 24)))

    def total(parameter: torch.Tensor) -> torch.Tensor:
        effect = make(parameter)
        scene = effect.on_scene(held.scene, heliostats)
        return (
            view.trace(scene, view.window_on(held.setups[0].plane), effect.on_optics(Optics()))
            * weights
        ).sum()

    start = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    total(start).backward()
    direction = torch.as_tensor(np.random.default_rng(2).normal(size=start.shape))
    with torch.no_grad():
        expected = float(total(start + 1e-5 * direction) - total(start - 1e-5 * direction)) / 2e-5
    assert float((start.grad * direction).sum()) == pytest.approx(expected, rel=2e-3)


def test_every_effect_says_what_it_is():
    """Each effect has a sentence in ``about``, which `python -OO` keeps."""
    for name, kind in CATALOGUE.items():
        assert "about" in vars(kind), name
        title, _, rest = kind.about.partition(": ")
        assert title, name
        assert rest.endswith("."), name


def test_nothing_shown_to_people_is_taken_from_docstrings():
    """`python -OO` drops docstrings, and a change of a docstring would change a report."""
    sources = [path for package in ("model", "service") for path in (ROOT / package).rglob("*.py")]
    assert [path for path in sources if "__doc__" in path.read_text(encoding="utf-8")] == []
