"""The sun's position against published and analytic values."""

from datetime import UTC, datetime, timedelta, timezone

import pytest

from model.ephemeris import clock_fault, sun_angles_at
from model.errors import InvalidInputError
from model.frames import sun_direction


def test_position_of_the_published_example():
    """NREL/TP-560-34302 (Reda and Andreas 2008), table A5.1: azimuth 194.34 degrees from north, zenith 50.11.

    The example's zenith holds 0.02 degrees of refraction, and the formulae here err by 0.01.
    """
    moment = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    azimuth, elevation = sun_angles_at(moment, 39.742476, -105.1786)
    assert (180 - azimuth) % 360 == pytest.approx(194.34024, abs=0.02)
    assert elevation == pytest.approx(90 - 50.11162, abs=0.03)


@pytest.mark.parametrize(("month", "declination"), [(6, 23.436), (12, -23.436)])
def test_highest_elevation_at_the_solstices(month: int, declination: float):
    start = datetime(2026, month, 21, 11, tzinfo=UTC)
    elevations = [sun_angles_at(start + timedelta(minutes=m), 50.913, 6.388)[1] for m in range(90)]
    assert max(elevations) == pytest.approx(90 - 50.913 + declination, abs=0.02)


def test_morning_sun_stands_in_the_east():
    azimuth, elevation = sun_angles_at(datetime(2026, 3, 20, 7, tzinfo=UTC), 50.913, 6.388)
    assert azimuth > 60
    assert 0 < elevation < 20


def test_moment_needs_a_zone():
    with pytest.raises(InvalidInputError, match="time zone"):
        sun_angles_at(datetime(2026, 3, 20), 50.9, 6.4)


@pytest.mark.parametrize(
    ("hours", "says"),
    [(0.0, None), (0.05, None), (2.0, "2 h ahead"), (-5.5, "5.5 h behind"), (0.2, "check time, sun and place")],
)
def test_a_clock_is_held_against_the_sun(hours, says):
    moment = datetime(2024, 6, 21, 10, 30, tzinfo=UTC)
    sun = sun_direction(*sun_angles_at(moment, 50.91, 6.39))
    fault = clock_fault(sun, moment + timedelta(hours=hours), 50.91, 6.39)
    assert fault is None if says is None else says in (fault or "")
