"""Measurements as inputs of the model."""

from dataclasses import replace

import numpy as np
import pytest

from model import prediction_warnings
from model.errors import InvalidInputError
from model.forecast import View, align
from model.frames import sun_direction
from model.images import normalized
from model.imaging.window import center_of_mass, flux_window
from model.plant_model import JUELICH_MODEL
from model.setup import Setup
from model.surface import control_points
from service.twin.measurements import AcceptedMeasurement, to_observations
from tests.conftest import flat_heliostat, target


def photographed(distance: float, side: float = 12.0) -> list[AcceptedMeasurement]:
    """Two photographs of an ideal mirror so far [m] north of a target of ``side`` [m]."""
    heliostat, plane = flat_heliostat((0.0, distance, 1.8), distance), target(side)
    suns = [sun_direction(180 - azimuth, 40.0) for azimuth in (-20.0, 20.0)]
    setups = [Setup(heliostat, control_points(heliostat), sun, plane, plane.center) for sun in suns]
    images = align(setups, JUELICH_MODEL).flux(View(96, 96)).clamp(min=0).numpy()
    shown = []
    for sun, image in zip(suns, images, strict=True):
        spot = center_of_mass(image, (side, side))
        about_spot = normalized(flux_window(image, (side, side), spot)).astype(np.float32)
        shown.append(AcceptedMeasurement("1", sun, plane, image, about_spot, plane.to_enu(spot)))
    return shown


def test_the_window_grows_with_the_spot():
    assert [o.side for o in to_observations(photographed(150.0))] == [4.0, 4.0]
    seen = photographed(500.0)
    grown = to_observations(seen)
    assert [o.side for o in grown] == [6.0, 6.0]
    assert prediction_warnings.has_excess_spillage([one.observation() for one in seen])
    assert not prediction_warnings.has_excess_spillage(grown)
    assert grown[0].flux.sum() == pytest.approx(100, rel=1e-5)


def test_a_window_is_no_larger_than_the_target_and_than_what_is_known():
    assert [o.side for o in to_observations(photographed(500.0, side=5.0))] == [4.0, 4.0]
    centered = [replace(one, flux=None) for one in photographed(500.0)]
    assert [o.side for o in to_observations(centered)] == [4.0, 4.0]
    with pytest.raises(InvalidInputError, match="cannot be cut to 6 m"):
        centered[0].observation(6.0)
    assert to_observations([]) == []


def test_what_the_range_cut_off_grows_along():
    (seen, _) = photographed(500.0)
    bright = seen.flux > 0.8 * seen.flux.max()
    small, large = (replace(seen, clipped=bright).observation(side) for side in (4.0, 6.0))
    assert large.clipped.sum() * 36 == pytest.approx(small.clipped.sum() * 16, rel=0.05)
    assert large.clipped_share == pytest.approx(small.clipped_share, abs=0.05)
