"""Measured dimming and pointing errors of mirrors, by which the field is forecast."""

import csv
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from model.errors import InvalidInputError
from model.plant import Heliostat, MirrorOptics
from service.twin.alarms.measured_states import predicted_pointing_error
from service.twin.forecasts.aims import has_other_state
from service.twin.forecasts.mirror_states import (
    AS_DECLARED,
    STATE_COLUMNS,
    Estimate,
    MirrorStates,
    count_sources,
    in_state,
    read_states,
    state_rows,
    with_measured,
)
from service.twin.pointing_errors import PointingState

MEASURED = MirrorStates(
    {"A1": Estimate(0.56, (0.5, 0.61))}, {"A2": Estimate(7.5, (5.0, 12.0))}, default_mrad=0.5
)


def mirrors() -> dict[str, Heliostat]:
    plain = {name: Heliostat.juelich(name, (0.0, 50.0, 0.0)) for name in ("A1", "A2", "A3")}
    declared = MirrorOptics(0.9, 1e-3, 2e-3, 0.8)
    return plain | {"A4": Heliostat("A4", np.zeros(3), plain["A1"].mount, plain["A1"].facets,
                                    optics=declared)}  # fmt: skip


def test_what_is_not_measured_is_as_declared_or_the_default():
    states = {name: MEASURED.of(one) for name, one in mirrors().items()}
    pointing = {name: one["pointing_error_mrad"] for name, one in states.items()}
    assert pointing["A2"] == {"value": 7.5, "source": "measured", "ci95": (5.0, 12.0)}
    assert pointing["A3"] == {"value": 0.5, "source": "default"}
    assert pointing["A4"] == {"value": 2.0, "source": "declared"}
    assert count_sources(states.values()) == {
        "cleanliness": {"measured": 1, "declared": 3},
        "pointing_error_mrad": {"default": 2, "measured": 1, "declared": 1},
    }
    assert set(with_measured(states)) == {"A1", "A2"}
    acting = {name: in_state(one, states[name]).optics for name, one in mirrors().items()}
    assert [one.cleanliness for one in acting.values()] == [0.56, 1.0, 1.0, 0.8]
    assert [one.pointing_error for one in acting.values()] == [5e-4, 7.5e-3, 5e-4, 2e-3]
    assert acting["A4"] == mirrors()["A4"].optics
    declared = AS_DECLARED.of(mirrors()["A3"])["pointing_error_mrad"]
    assert declared == {"value": 0.0, "source": "declared"}


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join((",".join(STATE_COLUMNS), *lines)) + "\n")
    return path


def test_states_return_from_their_file(tmp_path: Path):
    states = {name: MEASURED.of(one) for name, one in mirrors().items()}
    path = tmp_path / "states.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([STATE_COLUMNS, *state_rows(with_measured(states))])
    found = read_states(path, mirrors())
    assert (found.cleanliness, found.pointing_mrad) == (
        MEASURED.cleanliness,
        MEASURED.pointing_mrad,
    )
    only = read_states(write(path, "A1,0.5,,,,,"), mirrors())
    assert only == MirrorStates({"A1": Estimate(0.5, None)}, {})


@pytest.mark.parametrize(
    ("line", "says"),
    [("B9,0.5,,,,,", "no heliostat"), ("A1,0,,,,,", "cleanliness"), ("A1,,,,-1,,", "pointing")],
)
def test_files_of_states_are_refused_with_their_line(tmp_path: Path, line: str, says: str):
    with pytest.raises(InvalidInputError, match=f"line 2.*{says}"):
        read_states(write(tmp_path / "states.csv", line), mirrors())


def pointing(error_mrad: float | None, photographs: int, newer: int) -> PointingState:
    return PointingState(1, datetime.now(UTC), error_mrad, photographs, newer)


def test_a_predicted_error_is_the_spread_per_axis_and_its_interval_holds_it():
    rng = np.random.default_rng(0)
    estimates = []
    for _ in range(400):
        angles = np.hypot(*rng.normal(0, 2.0, (2, 8)))
        found = predicted_pointing_error(pointing(float(np.median(angles)), 8, 8))
        assert found is not None
        estimates.append(found)
    assert np.median([one.value for one in estimates]) == pytest.approx(2.0, rel=0.06)
    held = [one.ci95[0] < 2.0 < one.ci95[1] for one in estimates if one.ci95]
    assert 0.85 < np.mean(held) <= 1.0


def test_too_few_photographs_predict_nothing():
    assert predicted_pointing_error(None) is None
    assert predicted_pointing_error(pointing(None, 0, 5)) is None
    huge = predicted_pointing_error(pointing(500.0, 2, 2))
    assert huge is not None
    assert huge.value < 100


@pytest.mark.parametrize(
    ("name", "cleanliness", "pointing_mrad", "is_other"),
    [
        ("A1", None, None, True),  # dimmed since
        ("A1", 0.55, None, False),
        ("A1", 0.9, None, True),
        ("A3", 0.5, None, True),  # cleaned since: its flux may exceed the limit
        ("A2", None, 6.0, False),
        ("A2", None, 2.0, True),
        ("A2", None, 20.0, False),  # it points better than was assumed
        ("A3", None, None, False),
    ],
)
def test_plans_are_outdated_by_other_states(
    name: str, cleanliness: float | None, pointing_mrad: float | None, is_other: bool
):
    assert has_other_state(MEASURED, name, cleanliness, pointing_mrad) is is_other


def test_measured_values_of_a_heliostat_in_words():
    assert MEASURED.in_words("A1") == ["as photographs measured, its cleanliness 0.56 counts"]
    (said,) = MEASURED.in_words("A2")
    assert said == "as photographs measured, its pointing error 7.50 mrad counts"
    assert MEASURED.in_words("A3") == []
