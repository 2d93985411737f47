"""Setups and suns that several tests of the model share."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from model.effects import Effect
from model.forecast import View, align
from model.frames import sun_direction, sun_direction_at
from model.plant import Heliostat
from model.plant_model import JUELICH_MODEL
from model.setup import Setup
from model.study import FluxImage
from model.surface import control_points
from tests.conftest import flat_heliostat, target


def setups(count: int = 3) -> list[Setup]:
    """Setups of several heliostats and suns at spots off the target's centre."""
    rng = np.random.default_rng(5)
    made = []
    for index in range(count):
        heliostat = flat_heliostat((-30.0 + 25 * index, 70.0 + 10 * index, 1.8), 85.0)
        points = control_points(heliostat, rng.normal(0, 2e-4, (4, 8, 8)))
        sun, plane = sun_direction(180 - rng.uniform(-60, 60), rng.uniform(20, 60)), target()
        spot = plane.to_enu(rng.uniform(-0.5, 0.5, 2))
        made.append(Setup(heliostat, points, sun, plane, spot=spot, identifier=str(index)))
    return made


SUNS = sun_direction_at(
    np.array([-20.0, -5, 5, 20, 15, 0]), np.array([-40.0, 30, -15, 50, 0, 10]), 50.9
)


FIRST = datetime(2024, 6, 1, 12, tzinfo=UTC)


PLACES = {"near": (-8.0, 45.0, 1.8), "far": (35.0, 110.0, 1.8), "middle": (-40.0, 75.0, 1.8)}


def photographs(effects: Sequence[Effect] = (), days: int = 8) -> list[FluxImage]:
    """What the forecaster expects of three mirrors, once every third day each, with some noise."""
    rng, plane, made = np.random.default_rng(3), target(), []
    for name, place in PLACES.items():
        mirror = Heliostat.juelich(
            name, place, float(np.linalg.norm(np.array(place) - plane.center)), facet_depth=0.0
        )
        points = control_points(mirror, rng.normal(0, 2e-4, (4, 8, 8)))
        for day in range(days):
            azimuth, spot = rng.uniform(-60, 60), plane.to_enu(rng.uniform(-0.3, 0.3, 2))
            sun, moment = (
                sun_direction(180 - azimuth, 50 - abs(azimuth) / 2),
                FIRST + timedelta(days=3 * day),
            )
            made.append(
                Setup(mirror, points, sun, plane, spot, identifier=f"{name}/{day}", taken_at=moment)
            )
    images = (
        align(made, JUELICH_MODEL.with_effects(effects)).images(View(256, 256, samples=12)).numpy()
    )
    images = images + 0.003 * images.max(axis=(1, 2), keepdims=True) * rng.standard_normal(
        images.shape
    )
    return [FluxImage(setup, image) for setup, image in zip(made, images, strict=True)]
