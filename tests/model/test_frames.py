import numpy as np
import pytest

from model.errors import InvalidInputError
from model.frames import (
    enu_to_wgs84,
    solar_time,
    sun_angles,
    sun_direction,
    sun_direction_at,
    wgs84_to_enu,
)

ORIGIN = (50.913421122592574, 6.387824755874856, 87.0)


def test_origin_is_zero_and_up_is_altitude():
    np.testing.assert_allclose(wgs84_to_enu(ORIGIN, ORIGIN), 0, atol=1e-9)
    np.testing.assert_allclose(wgs84_to_enu((*ORIGIN[:2], 97.0), ORIGIN), [0, 0, 10], atol=1e-8)


def test_known_lengths_of_a_degree():
    # At 50.9 N a degree of latitude is 111.249 km, a degree of longitude 70.30 km (NIMA TR8350.2
    # radii of curvature).
    a, e2, latitude = 6378137.0, 0.00669437999014, np.radians(ORIGIN[0])
    w = np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    north = wgs84_to_enu((ORIGIN[0] + 1e-4, ORIGIN[1], 87.0), ORIGIN)[1]
    east = wgs84_to_enu((ORIGIN[0], ORIGIN[1] + 1e-4, 87.0), ORIGIN)[0]
    assert north == pytest.approx(np.radians(1e-4) * (a * (1 - e2) / w**3 + 87), rel=1e-5)
    assert east == pytest.approx(np.radians(1e-4) * (a / w + 87) * np.cos(latitude), rel=1e-5)


def test_round_trip():
    enu = np.random.default_rng(0).uniform(-400, 400, (100, 3))
    np.testing.assert_allclose(wgs84_to_enu(enu_to_wgs84(enu, ORIGIN), ORIGIN), enu, atol=1e-6)


def test_sun_azimuth_counts_from_north_over_east():
    np.testing.assert_allclose(sun_direction(180, 0), [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(sun_direction(90, 0), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(sun_direction(12, 90), [0, 0, 1], atol=1e-12)
    azimuth, elevation = sun_angles(sun_direction([220, 110], [20, 55]))
    np.testing.assert_allclose(azimuth, [220, 110])
    np.testing.assert_allclose(elevation, [20, 55])


def test_elevation_at_noon_of_the_equinox_is_the_complement_of_the_latitude():
    azimuth, elevation = sun_angles(sun_direction_at(0.0, 0.0, 50.9))
    assert elevation == pytest.approx(39.1)
    assert azimuth == pytest.approx(180, abs=1e-9)
    morning, _ = sun_angles(sun_direction_at(0.0, -45.0, 50.9))
    assert morning > 0  # the east


@pytest.mark.parametrize("bad", [(91, 0, 0), (0, 181, 0), (np.nan, 0, 0), (0, 0)])
def test_bad_coordinates_are_refused(bad):
    with pytest.raises(InvalidInputError, match="position"):
        wgs84_to_enu(bad, ORIGIN)


@pytest.mark.parametrize("latitude_deg", [-33.0, 0.0, 50.9])
def test_solar_time_is_noon_plus_an_hour_for_every_fifteen_degrees_at_any_season(latitude_deg):
    suns = sun_direction_at([-23.4, 0.0, 23.4], [-60.0, 0.0, 37.5], latitude_deg)
    np.testing.assert_allclose(solar_time(suns, latitude_deg), [8.0, 12.0, 14.5], atol=1e-12)
