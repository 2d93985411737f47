"""Effects that come and go: they act when they should, and studies find when."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, date, datetime

import numpy as np
import pytest

from model.effects import Always, ByDay, Effect, Since, acting, effect_from_json, effect_to_json
from model.effects.axis_tilt import AxisTilt
from model.effects.blocking import Blocking
from model.effects.camera_response import CameraResponse
from model.effects.camera_shoulder import CameraShoulder
from model.effects.encoder_offset import EncoderOffset
from model.effects.facet_canting import FacetCanting
from model.effects.slope_error import SlopeError
from model.effects.sun_shape import SunShapeEffect
from model.errors import InvalidInputError
from model.forecast import View, align
from model.plant_model import JUELICH_MODEL
from model.study import Study, StudyOptions, conclude, study, study_to_json
from model.study.judging import Gain, few_gain, find_end, split
from model.study.parameters import ParameterVector, Term, copied
from model.study.scope_search import ScopeSearch, most_promising
from model.study.scopes import ScopeCandidate, Span, best_span, single_heliostat_scopes, time_scopes
from model.study.selection import ForwardSelection, improve_begins
from model.study.trials import TrialFitter
from service.base.settings import FIGURE_SCALES
from service.drawing.study_report import study_page
from tests.model.scenes import FIRST, photographs

CHANGE = date(2024, 6, 16)
HAZY = {
    date(2024, 6, 7): {"circumsolar_ratio": 0.15},
    date(2024, 6, 16): {"circumsolar_ratio": 0.2},
}
TILTS = {"far": np.array([0.5, -0.3, 0.0, -0.2])}, {"far": np.array([-0.4, 0.4, 0.2, -0.2])}
CANTED = FacetCanting(*TILTS, scope=Since(CHANGE, ("far",)))
ROUGH = SlopeError(1.0, scope=Always(("far",)))
LEANING = AxisTilt(2.0, scope=Always(("near",)))


def found_in(effects: Sequence[Effect], *candidates: str) -> Study:
    return study(photographs(effects), JUELICH_MODEL, options=StudyOptions(candidates))


# --- when effects act
# -------------------------------------------------------------------------------------------------


def test_an_effect_acts_since_its_day_and_in_the_plant_of_today():
    since = SunShapeEffect(0.1, scope=Since(date(2024, 6, 2)))
    assert acting([since], datetime(2024, 6, 1, 23, tzinfo=UTC), "far") == ()
    assert acting([since], datetime(2024, 6, 2, 0, tzinfo=UTC), "far") == (since,)
    assert acting([since], None, "far") == acting([since], None, None) == (since,)


def test_an_effect_that_ended_acts_in_its_days_only():
    hazy = SunShapeEffect(0.1, scope=Since(date(2024, 6, 2), until=date(2024, 6, 9)))
    for day, acts in ((1, False), (2, True), (8, True), (9, False)):
        assert acting([hazy], datetime(2024, 6, day, 12, tzinfo=UTC), "far") == (hazy,) * acts
    assert acting([hazy], None, "far") == ()
    with pytest.raises(InvalidInputError, match="must end after that day, got 2024-06-02"):
        Since(date(2024, 6, 2), until=date(2024, 6, 2))


def test_an_effect_of_one_heliostat_acts_at_no_other():
    assert acting([ROUGH], FIRST, "far") == acting([ROUGH], None, "far") == (ROUGH,)
    assert acting([ROUGH], FIRST, "near") == acting([ROUGH], None, None) == ()
    worn = SlopeError(1.0, scope=Since(CHANGE, ("far",)))
    assert acting([worn], FIRST, "far") == acting([worn], None, "near") == ()
    assert acting([worn], None, "far") == (worn,)


def test_an_effect_by_day_has_values_of_its_own_on_some_days():
    hazy = SunShapeEffect(0.03, scope=ByDay(HAZY))
    (there,) = acting([hazy], datetime(2024, 6, 7, 9, tzinfo=UTC), "far")
    assert isinstance(there, SunShapeEffect)
    assert there.circumsolar_ratio == 0.15
    assert acting([hazy], datetime(2024, 6, 7, 15, tzinfo=UTC), "near") == (there,)
    assert (
        acting([hazy], datetime(2024, 6, 8, 9, tzinfo=UTC), "far")
        == acting([hazy], None, None)
        == (hazy,)
    )


@pytest.mark.parametrize(
    "effect",
    [CANTED, SunShapeEffect(0.03, scope=ByDay(HAZY)), CameraResponse(1.1), ROUGH, LEANING],
    ids=lambda e: e.name,
)
def test_forecasts_hold_each_effect_when_and_where_it_acts(effect: Effect):
    """All photographs at once are what each is with the effects of its time."""
    setups = [p.setup for p in photographs(days=6)]
    view = View(24, 24, samples=8)
    together = align(setups, JUELICH_MODEL.with_effects([effect])).images(view)
    for setup, image in zip(setups, together, strict=True):
        there = acting([effect], setup.taken_at, setup.heliostat.name)
        there = tuple(replace(one, scope=Always()) for one in there)
        (alone,) = align([setup], JUELICH_MODEL.with_effects(there)).images(view)
        np.testing.assert_allclose(image, alone, rtol=1e-3, atol=1e-3 * float(alone.max()))


def test_scopes_survive_json():
    for effect in (CANTED, ROUGH, SlopeError(1.0, scope=Since(CHANGE, ("far",), date(2024, 7, 1)))):
        assert effect_from_json(effect_to_json(effect)).scope == effect.scope
    assert effect_to_json(ROUGH)["scope"] == {"kind": "set", "heliostats": ["far"]}
    hazy = effect_from_json(effect_to_json(SunShapeEffect(0.03, scope=ByDay(HAZY))))
    assert hazy.scope == ByDay(HAZY)
    assert isinstance(effect_from_json(effect_to_json(CameraResponse(1.1))).scope, Always)


@pytest.mark.parametrize(
    ("scope", "says"),
    [
        ("set", "'scope' must be"),
        ({"kind": "sometimes"}, "'scope' must be"),
        ({"kind": "since", "since": "June"}, "a day must be a date such as 2024-06-02, got June"),
        ({"kind": "since"}, "a day must be a date"),
        ({"kind": "since", "since": "2024-06-02", "until": 3}, "a day must be a date"),
        (
            {"kind": "since", "since": "2024-06-02", "until": "2024-06-01"},
            "must end after that day",
        ),
        ({"kind": "set", "heliostats": "far"}, "must be a list of names, or null for all, got far"),
        ({"kind": "set", "heliostats": []}, "must be a list of names"),
        ({"kind": "day", "heliostats": ["far"]}, "a scope by day is of all heliostats"),
        (
            {"kind": "set", "heliostats": ["far"]},
            "sun_shape: the sun and the camera are the same for all heliostats",
        ),
    ],
)
def test_a_malformed_scope_is_refused(scope: object, says: str):
    with pytest.raises(InvalidInputError, match=says):
        effect_from_json({"name": "sun_shape", "parameters": {}, "scope": scope})


def test_a_scope_names_no_other_heliostats_than_the_parameters():
    canted = effect_to_json(CANTED)
    assert canted["scope"] == {
        "kind": "since",
        "since": "2024-06-16",
        "until": None,
        "heliostats": ["far"],
    }
    assert effect_from_json({**canted, "scope": {"kind": "set"}}).heliostats == ["far"]
    with pytest.raises(
        InvalidInputError, match="must be those that its parameters name, or null, got near"
    ):
        effect_from_json({**canted, "scope": {**canted["scope"], "heliostats": ["near"]}})


@pytest.mark.parametrize("by_day", [{"June": 0.1}, {"2024-06-02": 7}, 3, {"2024-06-02": "x"}])
def test_malformed_values_by_day_are_refused(by_day: object):
    parameters = {"circumsolar_ratio": {"value": 0.1, "by_day": by_day}}
    with pytest.raises(InvalidInputError, match="sun_shape"):
        effect_from_json({"name": "sun_shape", "parameters": parameters, "scope": {"kind": "day"}})


def test_what_belongs_to_heliostats_has_no_values_by_day():
    with pytest.raises(InvalidInputError, match="no values by day"):
        Blocking(scope=ByDay({}))


def test_copies_keep_the_scope():
    both = copied(CANTED, 2)
    assert both.heliostats == ["far#0", "far#1"]
    assert both.scope == Since(CHANGE, ("far#0", "far#1"))
    assert copied(ROUGH, 2).scope == Always(("far#0", "far#1"))


# --- unknowns with a scope
# --------------------------------------------------------------------------------------------


def test_unknowns_of_days_are_moved_at_once_and_become_one_effect():
    days = tuple(sorted(HAZY))
    unknowns = ParameterVector((Term(SunShapeEffect, days=days),), (("near", 4), ("far", 4)))
    assert list(unknowns.groups.values()) == [[0, 1]]
    (effect,) = unknowns.effects(np.array([0.1, 0.2]))
    assert effect_to_json(effect)["parameters"]["circumsolar_ratio"]["value"] == pytest.approx(0.15)
    (there,) = acting([effect], datetime(2024, 6, 16, 9, tzinfo=UTC), None)
    assert isinstance(there, SunShapeEffect)
    assert there.circumsolar_ratio == 0.2


def test_unknowns_of_one_heliostat_touch_its_later_photographs():
    term = Term(FacetCanting, since=CHANGE, heliostats=("far",))
    unknowns = ParameterVector((term,), (("near", 4), ("far", 4)))
    assert len(unknowns.all) == 8
    (effect,) = unknowns.effects(np.zeros(8))
    assert effect.heliostats == ["far"]
    touched = {p.key for p in photographs() if term.touches(p.heliostat, p.taken_at)}
    assert touched == {"far/5", "far/6", "far/7"}


def test_the_day_of_a_change_is_the_one_after_which_most_is_saved():
    days = [date(2024, 6, 1 + n) for n in range(8)]
    saved = np.array([[-1.0, 0.5, -1, -1, 3, 2, -0.5, 3], [-4.0, 0, -4, -4, 2, 1, -2, 2]])
    assert best_span(saved, days) == Span(date(2024, 6, 5), None, 7.5)
    assert best_span(saved[:, :1], days[:1]) is None
    failed = np.full((1, 8), -np.inf)  # strengths at which no attitude reflects the sun there
    assert best_span(np.vstack([failed, saved]), days) == best_span(saved, days)
    assert best_span(failed, days) is None
    since, by_day = time_scopes(
        CameraResponse, saved, [days[0]] * 4 + [days[1]] * 4, np.array(["a"] * 8)
    )
    assert since.term == Term(CameraResponse, since=days[1])
    assert by_day.term == Term(CameraResponse, days=tuple(days[:2]))


def test_an_effect_ends_where_later_photographs_lose_by_it():
    days = [date(2024, 6, 1 + n) for n in range(8)]
    saved = np.array([[-1.0, -2, 3, 2, 3, -2, -1, -2]])
    assert best_span(saved, days) == Span(days[2], days[5], 8.0)
    (since, _) = time_scopes(CameraResponse, saved, days, np.array(["a"] * 8))
    assert since.term == Term(CameraResponse, since=days[2], until=days[5])
    # From the first photograph on. One last day that is not clearly worse is no end, nor is one day
    # a span.
    early = np.array([[3.0, 2, 3, -2, -1, -2, -1, -2]])
    assert best_span(early, days) == Span(days[0], days[3], 8.0)
    late = np.array([[-1.0, -2, 3, 2, 3, 3, 3, -0.5]])
    assert best_span(late, days) == Span(days[2], None, 13.5)
    once = np.array([[-1.0, -2, 9, -2, -1, -1, -1, 1]])
    assert best_span(once, days) == Span(days[1], days[3], 7.0)


def test_an_effect_ends_if_all_later_photographs_are_worse_for_several_days():
    days = [date(2024, 6, 1 + n // 3) for n in range(24)]
    gains = np.where(np.arange(24) < 12, 0.03, -0.03) + np.tile([-0.01, 0, 0.01], 8)
    end = find_end(gains, days)
    assert end is not None
    assert (end.day, round(end.gain.mean, 6)) == (date(2024, 6, 5), -0.03)
    assert find_end(-gains, days) is None  # the last photographs need it
    assert find_end(gains[:15], days[:15]) is None  # a single day
    assert find_end(0.01 * gains, days) is None  # less than counts
    assert find_end(gains * np.tile([5, -3, -1], 8), days) is None  # by chance
    assert find_end(gains[:1], days[:1]) is None


def test_one_heliostat_is_promising_where_the_others_lose_or_save_nothing():
    """What all share must save clearly more at one; what is each one's own, hardly less there than
    everywhere.
    """
    names = np.array(["far", "far", "near", "near"])
    (found,) = single_heliostat_scopes(
        SlopeError, np.array([[1.0, 1.0, -0.5, 0.0], [2.0, 3.0, -2.0, -3.0]]), names
    )
    assert (found.term, found.saved) == (Term(SlopeError, heliostats=("far",)), 5.0)
    assert not list(single_heliostat_scopes(SlopeError, np.array([[1.0, 1.0, 0.1, 0.0]]), names))
    assert not list(
        single_heliostat_scopes(SunShapeEffect, np.array([[1.0, 1.0, -0.5, 0.0]]), names)
    )
    (found,) = single_heliostat_scopes(FacetCanting, np.array([[1.0, 1.0, 0.1, 0.0]]), names)
    assert found.term == Term(FacetCanting, heliostats=("far",))
    assert not list(single_heliostat_scopes(FacetCanting, np.array([[1.0, 1.0, 0.5, 0.0]]), names))
    assert not list(single_heliostat_scopes(SlopeError, np.array([[1.0, 1.0]]), names[:2]))


def test_what_one_heliostat_has_is_fitted_to_its_photographs():
    term = Term(SlopeError, heliostats=("far",))
    unknowns = ParameterVector((Term(SunShapeEffect), term), (("near", 4), ("far", 4)))
    assert [u.term for u in unknowns.per_heliostat.all] == [term]
    assert [u.term.kind for u in unknowns.for_heliostats(["near"]).all] == [SunShapeEffect]
    _, rough = unknowns.effects(np.array([0.02, 1.0]))
    assert effect_to_json(rough) == effect_to_json(ROUGH)
    assert {p.heliostat for p in photographs(days=1) if term.touches(p.heliostat, p.taken_at)} == {
        "far"
    }
    assert term.is_disjoint_from(Term(FacetCanting, since=CHANGE, heliostats=("near",)))
    assert not term.is_disjoint_from(Term(FacetCanting))
    assert not term.is_disjoint_from(term)


def test_a_moved_target_does_not_hide_a_changed_camera():
    camera, turned = Term(CameraShoulder, since=CHANGE), Term(EncoderOffset, since=CHANGE)
    always = Term(CameraShoulder)
    found = [
        ScopeCandidate(turned, 1000.0),
        ScopeCandidate(always, 20.0),
        ScopeCandidate(camera, 10.0),
        ScopeCandidate(Term(SunShapeEffect, since=CHANGE), 1.0),
    ]
    assert most_promising(found, [always]) == [camera, turned]


def test_few_gains_are_worth_less():
    assert few_gain(np.array([0.05])).low <= 0
    assert few_gain(np.array([0.05, 0.01])).low < 0
    assert few_gain(np.array([0.05, 0.04])).low > 0
    assert (
        few_gain(np.array([0.05, 0.01, 0.03])).low
        > 0
        > few_gain(np.array([0.05, 0.01, 0.03]), among=5).low
    )


def test_of_every_day_some_photographs_are_fitted_and_some_judge():
    taken = photographs(days=4)
    parts = split(taken)
    fitted, judging = (
        {taken[row].taken_at for row in rows} for rows in (parts.fit, parts.held_out)
    )
    assert fitted == judging == {p.taken_at for p in taken}


def test_fits_see_days_after_those_that_surfaces_were_predicted_from():
    taken = photographs(days=8)
    last = sorted({p.taken_at for p in taken})[3]
    seen = [replace(p, seen=p.taken_at <= last) for p in taken]
    parts = split(seen)
    assert not any(seen[row].seen for row in parts.held_out)
    fitted, judging = (
        {seen[row].taken_at for row in rows} for rows in (parts.fitted, parts.held_out)
    )
    assert fitted == {p.taken_at for p in taken}
    assert judging == {p.taken_at for p in taken if p.taken_at > last}


# --- what studies find
# ------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_nothing_comes_or_goes_in_calm_photographs():
    calm = study_to_json(found_in([], "sun_shape", "camera_response", "facet_canting"))
    assert calm["verdict"] == "none"
    assert calm["effects"] == []


@pytest.mark.full
def test_recanted_mirror_is_found_with_its_date():
    report = study_to_json(found_in([CANTED], "facet_canting", "slope_error"))
    (found,) = report["effects"]
    assert found["scope"] == {
        "kind": "since",
        "since": "2024-06-16",
        "until": None,
        "heliostats": ["far"],
    }
    assert "facet canting of far since 2024-06-16" in report["conclusion"]
    assert report["verdict"] == "effect"
    tilts = np.array(found["parameters"]["y_mrad"]["value"]["far"])
    np.testing.assert_allclose(tilts, CANTED.y_mrad["far"], atol=0.15)
    assert effect_from_json(found).scope == Since(CHANGE, ("far",))


@pytest.mark.full
def test_changed_camera_is_found_with_its_date():
    report = study_to_json(
        found_in([CameraResponse(1.1, scope=Since(CHANGE))], "camera_response", "camera_blur")
    )
    (found,) = report["effects"]
    assert found["scope"] == {
        "kind": "since",
        "since": "2024-06-16",
        "until": None,
        "heliostats": None,
    }
    assert found["parameters"]["gamma"]["value"] == pytest.approx(1.1, abs=0.02)


@pytest.mark.full
def test_a_changed_camera_beside_haze_is_found_since_its_day():
    """A camera of each day would absorb the haze, too."""
    haze = SunShapeEffect(0.15, scope=Since(date(2024, 6, 18), until=date(2024, 6, 21)))
    changed = [CameraResponse(1.2, scope=Since(CHANGE)), haze]
    found = study_to_json(found_in(changed, "camera_response", "sun_shape"))["effects"]
    scopes = {effect["name"]: effect["scope"] for effect in found}
    assert scopes["camera_response"]["since"] == "2024-06-16"


@pytest.mark.parametrize("is_estimated", [True, False])
def test_a_dated_effect_may_gain_less_where_surfaces_are_estimates(is_estimated: bool):
    """What they leave is there before and after its day."""
    taken = [replace(p, is_estimated=is_estimated) for p in photographs(days=2)]
    fitter = TrialFitter(taken, JUELICH_MODEL, StudyOptions())
    selection, small = ForwardSelection(fitter, ScopeSearch(fitter)), Gain(0.003, 0.001, 0.005, 3.0)
    dated = Term(CameraShoulder, since=CHANGE)
    assert selection.is_worthwhile(dated, small) == is_estimated
    assert not selection.is_worthwhile(Term(CameraShoulder), small)
    assert not selection.is_worthwhile(replace(dated, heliostats=("far",)), small)


@pytest.mark.full
@pytest.mark.parametrize("changed", [date(2024, 6, 13), date(2024, 6, 19)], ids=["within", "after"])
def test_a_camera_that_was_changed_within_or_after_haze_has_its_own_day(changed: date):
    """What is found first may begin with the haze, and the haze with the camera or at once."""
    week = Since(date(2024, 6, 7), until=date(2024, 6, 19))
    effects = [CameraShoulder(0.8, scope=Since(changed)), SunShapeEffect(0.15, scope=week)]
    fitter = TrialFitter(photographs(effects), JUELICH_MODEL, StudyOptions())
    selection = ForwardSelection(fitter, ScopeSearch(fitter))
    camera = Term(CameraShoulder, since=changed)
    haze = Term(SunShapeEffect, since=week.since, until=week.until)
    is_within = week.until is not None and changed < week.until
    begun = changed if is_within else week.since
    wrong = [replace(camera, since=week.since), replace(haze, since=begun)]
    improved = improve_begins(selection, fitter.fit(wrong))
    assert improved.parameters.terms == (camera, haze)
    assert improve_begins(selection, improved) is improved


@pytest.mark.full
def test_what_is_found_beside_a_wrong_begin_is_chosen_again():
    """The camera is first thought to have changed with the haze before it."""
    week, since = Since(date(2024, 6, 7), until=date(2024, 6, 16)), Since(date(2024, 6, 16))
    effects = [CameraShoulder(0.8, scope=since), SunShapeEffect(0.3, scope=week)]
    found = found_in(effects, "camera_shoulder", "camera_blur", "sun_shape")
    begins = {one.name: one.scope.since for one in found.effects if isinstance(one.scope, Since)}
    assert begins == {"camera_shoulder": since.since, "sun_shape": week.since}


@pytest.mark.full
def test_haze_of_a_week_is_found_with_begin_and_end():
    """Photographs of each third day; the haze acts on three of their days."""
    week = Since(date(2024, 6, 8), until=date(2024, 6, 15))
    report = study_to_json(found_in([SunShapeEffect(0.2, scope=week)], "sun_shape", "slope_error"))
    (found,) = report["effects"]
    assert found["scope"] == {
        "kind": "since",
        "since": "2024-06-10",
        "until": "2024-06-16",
        "heliostats": None,
    }
    assert "sun shape since 2024-06-10, ended by 2024-06-16" in report["conclusion"]
    assert found["parameters"]["circumsolar_ratio"]["value"] == pytest.approx(0.2, abs=0.02)
    assert report["verdict"] == "effect"


@pytest.mark.full
def test_hazy_days_are_found_and_named():
    report = study_to_json(
        found_in([SunShapeEffect(0.02, scope=ByDay(HAZY))], "sun_shape", "slope_error")
    )
    (found,) = report["effects"]
    assert found["scope"] == {"kind": "day"}
    assert "sun shape by day (most on 2024-06-07, 2024-06-16)" in report["conclusion"]
    for day, truth in HAZY.items():
        by_day = found["parameters"]["circumsolar_ratio"]["by_day"]
        assert by_day[day.isoformat()] == pytest.approx(truth["circumsolar_ratio"], abs=0.03)


@pytest.mark.full
@pytest.mark.parametrize("is_dated", [True, False])
def test_a_rough_mirror_is_found_by_name(is_dated: bool):
    taken = photographs([ROUGH])
    taken = (
        taken if is_dated else [replace(p, setup=replace(p.setup, taken_at=None)) for p in taken]
    )
    options = StudyOptions(("slope_error", "camera_blur"))
    found = study(taken, JUELICH_MODEL, options=options)
    (effect,) = study_to_json(found)["effects"]
    assert effect["scope"] == {"kind": "set", "heliostats": ["far"]}
    assert effect["parameters"]["sigma_mrad"]["value"] == pytest.approx(1.0, abs=0.05)
    assert "demand slope error of far: accuracy" in conclude(found)
    assert effect_from_json(effect).scope == found.effects[0].scope == Always(("far",))
    assert "<td>far</td>" in study_page(found, "a plant", FIGURE_SCALES)


@pytest.mark.full
def test_what_one_heliostat_is_known_to_have_another_may_have():
    """The declared one is not sought again, and the other one's is found beside it."""
    both = [ROUGH, SlopeError(1.5, scope=Always(("near",)))]
    options = StudyOptions(("slope_error", "camera_blur"))
    found = study(photographs(both), JUELICH_MODEL.with_effects([ROUGH]), options)
    (effect,) = study_to_json(found)["effects"]
    assert effect["scope"] == {"kind": "set", "heliostats": ["near"]}
    assert effect["parameters"]["sigma_mrad"]["value"] == pytest.approx(1.5, abs=0.1)


@pytest.mark.full
def test_a_mirror_that_is_canted_otherwise_is_found_by_name():
    report = study_to_json(
        found_in([replace(CANTED, scope=Always())], "facet_canting", "slope_error")
    )
    (found,) = report["effects"]
    assert found["scope"] == {"kind": "set", "heliostats": ["far"]}
    assert list(found["parameters"]["x_mrad"]["value"]) == ["far"]


@pytest.mark.full
def test_what_is_always_there_is_not_dated():
    (found,) = study_to_json(found_in([SunShapeEffect(0.12)], "sun_shape", "camera_response"))[
        "effects"
    ]
    assert found["scope"] == {"kind": "set"}


@pytest.mark.full
def test_two_mirrors_recanted_on_different_days_are_both_found():
    other = FacetCanting(
        {"near": np.array([-1.0, 0.8, 0.6, -0.4])},
        {"near": np.array([0.8, -1.0, -0.6, 0.8])},
        scope=Since(date(2024, 6, 10)),
    )
    found = study_to_json(found_in([CANTED, other], "facet_canting"))["effects"]
    scopes = {tuple(effect["scope"]["heliostats"]): effect["scope"]["since"] for effect in found}
    assert scopes == {("far",): "2024-06-16", ("near",): "2024-06-10"}


def test_an_effect_by_day_ends_on_other_days():
    hazy = SunShapeEffect(0.03, scope=ByDay(HAZY, date(2024, 6, 9)))
    assert effect_from_json(effect_to_json(hazy)).scope == hazy.scope
    at = [datetime(2024, 6, day, 9, tzinfo=UTC) for day in (7, 8, 9)]
    assert [bool(acting([hazy], one, "far")) for one in (*at, None)] == [True, True, False, False]
