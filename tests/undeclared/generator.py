"""Measurement sets with effects that the model does not declare: random mirrors, places and suns, one world for all."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, effects_from_json
from model.forecast import Setup
from model.plant import Heliostat, TargetPlane
from model.prior import default_prior
from model.surface import control_points
from tests.undeclared.camera import photograph
from tests.undeclared.rays import Exposure, Sun, throw
from tests.undeclared.world import World, disturb
from training.surfaces import Augmentation, load_surfaces

Array = NDArray[np.float64]

LATITUDE = np.radians(50.913)

TARGETS = (
    TargetPlane("lower", np.array([0.0, -3.23, 35.88]), np.array([0.005, 1, 0.001]), np.array([0.0, 0, 1]), 8.63, 7.22),
    TargetPlane("upper", np.array([0.0, -3.24, 43.10]), np.array([0.003, 1, 0.0]), np.array([0.0, 0, 1]), 8.63, 7.21),
)
"""The two calibration targets of the Solar Tower Juelich."""

RANGES = (40.0, 250.0)
"""Slant ranges [m]; a set spreads its heliostats evenly, in the logarithm, between them."""

MIN_ELEVATION = np.radians(12.0)


@dataclass(frozen=True, eq=False)
class Plan:
    """What is planned for one photograph; angles [rad], ``goal`` (3,) [m], ``warmth`` in standard deviations."""

    index: int
    heliostat: Heliostat
    heights: Array
    declination: float
    hour_angle: float
    plane: TargetPlane
    goal: Array
    warmth: float

    def sun(self, late_minutes: float = 0.0) -> Array:
        """Direction (3,) of the sun, ``late_minutes`` after the planned time."""
        hour = self.hour_angle + np.radians(late_minutes / 4)
        # East, and in the plane of the meridian towards the equator and towards the pole.
        east, equator = -np.cos(self.declination) * np.sin(hour), np.cos(self.declination) * np.cos(hour)
        pole = np.sin(self.declination)
        north = pole * np.cos(LATITUDE) - equator * np.sin(LATITUDE)
        return np.array([east, north, pole * np.sin(LATITUDE) + equator * np.cos(LATITUDE)])

    def exposure(self, world: World) -> Exposure:
        """What really happens."""
        sun = self.sun(world.clock_minutes)
        return Exposure(world, self.index, self.heliostat, self.heights, sun, self.plane, self.goal, self.warmth)

    def setup(self, identifier: str) -> Setup:
        """What is recorded."""
        points = control_points(self.heliostat, self.heights)
        return Setup(self.heliostat, points, self.sun(), self.plane, self.goal, identifier=identifier)


@dataclass(frozen=True, eq=False)
class MeasurementSet:
    """Photographs (256, 256) of setups in a world, whose effects of the catalogue are ``truth``, as JSON."""

    world: World
    truth: list[dict[str, Any]]
    setups: list[Setup]
    images: list[Array]

    @property
    def effects(self) -> list[Effect]:
        """The truth as the model states it."""
        return effects_from_json(self.truth)


def generate(
    case: str,
    level: int,
    seed: int,
    surfaces: Array,
    *,
    heliostats: int = 4,
    setups: int = 6,
    side: int = 192,
    fan: int = 24,
) -> MeasurementSet:
    """A set of one case at strength ``level`` (0 to 2); a seed has the same plant, suns and aims in every case.

    ``surfaces`` (N, 4, 8, 8) [m] are mirrors to draw from; an image has 4 * side**2 * fan rays.
    """
    plans = _plans(heliostats, setups, surfaces, np.random.default_rng(seed))
    rng = np.random.default_rng((seed, crc32(case.encode())))
    world, truth = disturb(case, level, list(dict.fromkeys(plan.heliostat.name for plan in plans)), rng)
    sun = Sun.of(world, rng)
    images = [photograph(throw(plan.exposure(world), sun, side, fan, rng), plan.plane, world, rng) for plan in plans]
    recorded = [plan.setup(f"{plan.heliostat.name}/{number}") for number, plan in enumerate(plans, start=100)]
    return MeasurementSet(world, truth, recorded, images)


def mirrors(data: Path | None = None, count: int = 200, seed: int = 1) -> Array:
    """Surfaces (count, 4, 8, 8) [m]: mixtures of the measured ones, samples of the shipped prior without such data."""
    rng = np.random.default_rng(seed)
    if data is not None and (data / "surfaces.npz").is_file():
        return Augmentation().sample(load_surfaces(data)[0], count, rng)
    prior = default_prior()
    return np.array([prior.surface(rng.normal(size=len(prior.basis))) for _ in range(count)])


def _plans(heliostats: int, setups: int, surfaces: Array, rng: np.random.Generator) -> list[Plan]:
    """Heliostats spread over the slant ranges, evenly in their logarithm, each with a random mirror."""
    plans = []
    for index, heights in enumerate(surfaces[rng.choice(len(surfaces), heliostats, replace=False)]):
        share = (index + rng.random()) / heliostats
        distance = RANGES[0] * (RANGES[1] / RANGES[0]) ** share
        heliostat = _heliostat(f"A{chr(65 + index)}{rng.integers(10, 60)}", distance, rng)
        plans += [_plan(index, heliostat, heights, rng) for _ in range(setups)]
    return plans


def _heliostat(name: str, distance: float, rng: np.random.Generator) -> Heliostat:
    """A heliostat in the northern field, canted for the targets."""
    aim, height, bearing = np.array([0.0, -3.2, 39.5]), 1.75, rng.uniform(-0.75, 0.75)
    level = np.sqrt(distance**2 - (aim[2] - height) ** 2) if distance > aim[2] else 10.0
    position = np.array([level * np.sin(bearing), aim[1] + level * np.cos(bearing), height])
    return Heliostat.juelich(name, position, float(np.linalg.norm(aim - position)))


def _plan(index: int, heliostat: Heliostat, heights: Array, rng: np.random.Generator) -> Plan:
    """A photograph on a random day at a random hour with the sun well up."""
    plane = TARGETS[rng.integers(len(TARGETS))]
    right, up = rng.normal(0, 0.25, 2)
    goal = plane.center + right * np.cross(plane.up, plane.normal) + up * plane.up
    while True:
        declination, hour = np.radians(23.45) * np.sin(rng.uniform(0, 2 * np.pi)), rng.uniform(-1.8, 1.8)
        plan = Plan(index, heliostat, heights, declination, hour, plane, goal, rng.standard_normal())
        if np.arcsin(min(plan.sun(late)[2] for late in (-60.0, 0.0, 60.0))) > MIN_ELEVATION:
            return plan
