"""Changes of a series: their dates, and how seldom one is found where there is none."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from model.changes import find_changes

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def days(count: int, each: int = 1) -> list[datetime]:
    """Times of photographs, so many ``each`` day."""
    return [NOON + timedelta(days=n // each, minutes=20 * (n % each)) for n in range(count)]


def noise(rng: np.random.Generator, count: int, freedom: float) -> np.ndarray:
    return rng.normal(size=count) if freedom == np.inf else rng.standard_t(freedom, size=count)


def test_a_step_is_dated_by_the_photographs_beside_it():
    values = [0.95, 0.94, 0.96, 0.95, 0.93, 0.95, 0.96, 0.94, 0.80, 0.81, 0.79]
    times = days(len(values))
    (change,) = find_changes(times, values)
    assert (change.since, change.until, change.first) == (times[7], times[8], 8)
    assert change.probability > 0.9
    assert change.before == pytest.approx(0.948, abs=0.01)
    assert change.after == pytest.approx(0.80, abs=0.01)
    assert 0.10 < change.min_drop < 0.148


def test_each_of_several_changes_is_dated():
    rng = np.random.default_rng(2)
    values = np.repeat([0.95, 0.86, 0.95, 0.80], 8) + rng.normal(0, 0.01, 32)
    assert [one.first for one in find_changes(days(32), values)] == [8, 16, 24]


def test_photographs_of_a_single_hazy_day_are_no_change():
    rng = np.random.default_rng(3)
    values = rng.normal(0.95, 0.01, 20)
    values[-4:] -= 0.1  # the newest day
    assert find_changes(days(20, 4), values) == []
    values = rng.normal(0.95, 0.01, 20)
    values[8:12] -= 0.1
    assert find_changes(days(20, 4), values) == []


@pytest.mark.parametrize("values", [[], [1.0], [0.95, 0.94, 0.8, 0.81], [0.9] * 12])
def test_too_few_or_equal_values_have_no_change(values: list[float]):
    assert find_changes(days(len(values)), values) == []


@pytest.mark.full
@pytest.mark.parametrize("freedom", [np.inf, 3.0], ids=["normal", "t3"])
@pytest.mark.parametrize("count", [12, 24, 48])
def test_series_without_a_change_seldom_have_one(freedom: float, count: int):
    rng = np.random.default_rng(4)
    found = [find_changes(days(count), noise(rng, count, freedom)) for _ in range(200)]
    assert np.mean([bool(one) for one in found]) <= 0.03


@pytest.mark.full
@pytest.mark.parametrize(("after", "share"), [(2, 0.3), (3, 0.7), (5, 0.9)])
def test_a_step_of_three_sigma_is_found_and_lies_in_its_interval(after: int, share: float):
    rng, times = np.random.default_rng(5), days(30 + after)
    found, inside = 0, 0
    for _ in range(150):
        values = rng.normal(size=30 + after)
        values[30:] -= 3.0
        falls = [one for one in find_changes(times, values) if one.after < one.before]
        found += bool(falls)
        inside += any(one.since <= times[29] and times[30] <= one.until for one in falls)
    assert found >= share * 150
    assert inside >= 0.95 * found
