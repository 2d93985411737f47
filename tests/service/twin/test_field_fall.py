"""Falls of the whole field's accuracy: their day, and what of one heliostat's fall they are."""

from datetime import UTC, datetime, timedelta

import numpy as np

from service.twin.alarms.field_fall import LEAST, find_field_fall, levels_of
from service.twin.studies.field_change import SampledPhotograph
from service.twin.surfaces.present_shape import AccuracyFall

FIRST = datetime(2026, 5, 1, 9, tzinfo=UTC)


def photographs(days: int, heliostats: int) -> list[SampledPhotograph]:
    """One of each heliostat a day, an hour apart."""
    return [
        SampledPhotograph(
            day * heliostats + place,
            f"{day}-{place}",
            f"H{place}",
            FIRST + timedelta(days=day, hours=place),
            1,
        )
        for day in range(days)
        for place in range(heliostats)
    ]


def test_a_small_fall_of_all_is_dated_though_one_heliostat_is_far_off():
    taken, rng = photographs(30, 8), np.random.default_rng(0)
    relative = {
        one.id: rng.normal(0, 0.01)
        - 0.015 * (one.taken_at >= FIRST + timedelta(days=18))
        - 0.3 * (one.heliostat == "H3" and one.taken_at >= FIRST + timedelta(days=4))
        for one in taken
    }
    levels = levels_of(taken, relative)
    assert len(levels) == 30
    fall = find_field_fall(levels)
    assert fall is not None
    assert fall.since < FIRST + timedelta(days=18) <= fall.until
    assert abs(fall.earlier - fall.recent - 0.015) < 0.005


def test_what_is_small_or_has_recovered_is_no_fall_of_the_field():
    taken = photographs(30, 8)
    for size, days in ((LEAST / 2, range(18, 30)), (0.03, range(10, 17))):
        rng = np.random.default_rng(1)
        relative = {
            one.id: rng.normal(0, 0.004) - size * ((one.taken_at - FIRST).days in days)
            for one in taken
        }
        assert find_field_fall(levels_of(taken, relative)) is None, size


def test_days_of_few_heliostats_have_no_level():
    taken = photographs(10, 8)
    known = {one.id: 0.0 for one in taken if one.heliostat in ("H0", "H1")}
    assert levels_of(taken, known) == {}


def test_what_all_lost_is_not_one_heliostats():
    levels = {(FIRST + timedelta(days=day)).isoformat(): -0.03 * (day >= 10) for day in range(20)}
    then = FIRST + timedelta(days=10)
    fall = AccuracyFall(then - timedelta(days=1), then, 0.96, 0.88, 0.06)
    assert round(fall.of_field(levels), 6) == 0.03
    assert fall.of_field({}) == 0.0
