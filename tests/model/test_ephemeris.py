"""The sun's position against published, recorded and analytic values."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from benchmarks.sun import apart_mrad, dated
from model.effects.sun_position import SunPosition
from model.ephemeris import clock_faults, sun_angles_at, sun_positions
from model.errors import InvalidInputError
from model.frames import sun_direction
from model.site import Site
from service.sources.folder import read_folder

PLACE = (50.913, 6.388, 87.0)


def test_position_of_the_published_example():
    """NREL/TP-560-34302 (Reda and Andreas 2008), table A5.1, at 11 degrees Celsius.

    The example's pressure is 820 hPa, the standard atmosphere's at its altitude 812: 0.0001 degrees
    of refraction.
    """
    moment = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    azimuth, elevation = sun_positions([moment], (39.742476, -105.1786, 1830.14), 11.0)[0]
    assert azimuth == pytest.approx(194.34024, abs=1e-4)
    assert elevation == pytest.approx(90 - 50.11162, abs=3e-4)


def test_recorded_suns_are_where_the_sun_was_seen(stj_pointing: Path):
    folder = read_folder(stj_pointing)
    measurements = dated(folder)
    apart, low = (
        apart_mrad(folder, measurements),
        np.array([one.sun.elevation_deg < 10 for one, _ in measurements]),
    )
    assert len(apart) > 1000
    assert np.median(apart) < 0.05
    assert apart.max() < 0.2
    assert low.sum() > 10
    assert apart[low].max() < 0.1


@pytest.mark.parametrize(("month", "declination"), [(6, 23.436), (12, -23.436)])
def test_highest_elevation_at_the_solstices(month: int, declination: float):
    """By about 0.01 degrees higher than without refraction in summer, 0.05 in winter."""
    start = datetime(2026, month, 21, 11, tzinfo=UTC)
    highest = sun_positions([start + timedelta(minutes=m) for m in range(90)], PLACE)[:, 1].max()
    geometric = 90 - 50.913 + declination
    refraction = 0.0167 / np.tan(np.radians(geometric))
    assert highest == pytest.approx(geometric + refraction, abs=0.01)


def test_a_low_sun_is_lifted_by_the_air_of_the_place():
    moment = datetime(2026, 3, 20, 6, 10, tzinfo=UTC)
    (sea, mountain, space), cold = (
        (sun_positions([moment], (*PLACE[:2], up))[0, 1] for up in (0.0, 5e3, 1e5)),
        -20.0,
    )
    assert 0 < space < mountain < sea < sun_positions([moment], PLACE, cold)[0, 1]


def test_morning_sun_is_in_the_east():
    azimuth, elevation = sun_angles_at(datetime(2026, 3, 20, 7, tzinfo=UTC), PLACE)
    assert azimuth < 120
    assert 0 < elevation < 20


def test_moment_needs_a_zone():
    with pytest.raises(InvalidInputError, match="time zone"):
        sun_angles_at(datetime(2026, 3, 20), PLACE)


def test_a_clock_error_moves_the_sun_as_time_does():
    """`SunPosition` turns the sun about the pole; by ten minutes it errs by a fiftieth of what that
    moves it.
    """
    moments = [
        datetime(2026, month, 21, hour, tzinfo=UTC) for month in (3, 6, 9) for hour in (8, 11, 15)
    ]
    suns, later = (
        sun_direction(
            *sun_positions([one + timedelta(minutes=minutes) for one in moments], PLACE).T
        )
        for minutes in (0, 10)
    )
    turned = SunPosition(10.0).on_sun(suns, Site.from_origin(PLACE))
    assert (
        np.linalg.norm(turned - later, axis=1).max()
        < 0.02 * np.linalg.norm(later - suns, axis=1).min()
    )


@pytest.mark.parametrize(
    ("hours", "says"),
    [
        (0.0, None),
        (0.025, None),
        (2.0, "2 h ahead"),
        (-5.5, "5.5 h behind"),
        (0.05, "check time, sun and place"),
    ],
)
def test_a_clock_is_held_against_the_sun(hours, says):
    moment = datetime(2024, 6, 21, 10, 30, tzinfo=UTC)
    sun = sun_direction(*sun_angles_at(moment, PLACE))
    (fault,) = clock_faults(sun[None], [moment + timedelta(hours=hours)], PLACE)
    if says is None:
        assert fault is None
    else:
        assert fault is not None
        assert says in fault.detail
        assert f"{fault.angle_deg:.1f} degrees" in fault.detail


def test_clocks_of_many_are_those_of_each():
    moments = [datetime(2024, 6, 21, hour, 30, tzinfo=UTC) for hour in (8, 10, 12)]
    suns = sun_direction(*sun_positions(moments, PLACE).T)
    clock_times = [moments[0], moments[1] + timedelta(hours=1), moments[2]]
    faults = clock_faults(suns, clock_times, PLACE, [30.0, None, 5.0])
    assert faults == [
        clock_faults(sun[None], [one], PLACE)[0] for sun, one in zip(suns, clock_times, strict=True)
    ]
    assert [fault is None for fault in faults] == [True, False, True]
    assert clock_faults(np.empty((0, 3)), [], PLACE) == []
