"""A synthetic target with a known spot."""

import numpy as np
import pytest

from benchmarks.imaging import read_plant
from model.plant import TargetPlane
from tests.imaging import gaussian


@pytest.fixture(scope="session")
def plane():
    return TargetPlane("tower", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 5.4, 6.4)


@pytest.fixture(scope="session")
def spot(plane):
    return gaussian(plane, 0.3, -0.2, 0.8, 0.5, 0.6)


@pytest.fixture(scope="session")
def plant(stj):
    return read_plant(stj)
