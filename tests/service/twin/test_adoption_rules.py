"""Which results of studies can be adopted."""

import pytest

from service.store.results import StudyFindings
from service.twin.adoption_rules import is_ambiguous, names_of, open_questions, why_refused

BETTER, WORSE = {"before": 0.90, "after": 0.95}, {"before": 0.931, "after": 0.92}


def correction(**transfer: object) -> StudyFindings:
    return StudyFindings("unexplained", [{"name": "soiling"}], 1.0, transfer, 0.8)


@pytest.mark.parametrize(
    ("findings", "said"),
    [
        (StudyFindings("effect", [{"name": "soiling"}], 0.1), None),
        (StudyFindings("none", [], 0.0), "found no effect"),
        (
            StudyFindings("unexplained", [{"name": "sun_shape"}], 0.4),
            "sun_shape explains only part",
        ),
        (correction(heliostats=BETTER, days=None, targets=WORSE), None),
        (correction(heliostats=None, days=BETTER), None),
        (correction(heliostats=None, days=None, targets=BETTER), "tested neither"),
        (correction(heliostats=BETTER, days=WORSE), "days that no fit saw worse (93.1% before"),
    ],
)
def test_a_correction_is_adopted_if_what_no_fit_saw_does_not_lose(findings, said):
    refusal = why_refused(findings)
    assert (refusal is None) == (said is None)
    assert said is None or said in str(refusal)


def test_a_correction_is_no_cause_and_answers_for_what_it_leaves_itself():
    found = correction(heliostats=BETTER)
    assert names_of(found) == ["correction (no cause)"]
    assert open_questions(found) == []


@pytest.mark.parametrize(
    ("name", "other", "expected"),
    [
        ("camera_shoulder", "camera_response", False),
        ("camera_shoulder", "slope_error", True),
        ("sun_shape", "slope_error", True),
    ],
)
def test_of_two_effects_of_images_either_will_do(name: str, other: str, expected: bool):
    found = StudyFindings("effect", [{"name": name, "lookalikes": [other]}], 0.1)
    assert is_ambiguous(found) is expected
    assert len(open_questions(found)) == 1  # which a person sees in either case


def test_of_two_effects_that_ended_either_will_do():
    scope = {"kind": "since", "since": "2026-06-01", "until": "2026-06-07"}
    ended = {"name": "slope_error", "lookalikes": ["sun_shape"], "scope": scope}
    assert not is_ambiguous(StudyFindings("effect", [ended], 0.1))
