"""Measurement sets with effects that the model does not declare: random mirrors, places and suns,
known worlds.

Nothing here is the product's; `tests.undeclared.adapter` hands a set to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from tests.undeclared import camera
from tests.undeclared.changes import WITHOUT_SHEET, changing
from tests.undeclared.plan import Plan, scattered, season
from tests.undeclared.rays import Sun, throw
from tests.undeclared.world import World, disturb

PLAY = 0.4e-3
"""Standard deviation [rad] of an axis beside what its encoder says: spots of Juelich scatter by
some 0.8 mrad.
"""


@dataclass(frozen=True, eq=False)
class MeasurementSet:
    """Images (256, 256) of plans, each in its world; ``truth`` are the worlds' effects of the
    catalogue, as JSON.

    ``light`` is what the images are of, of each one's brightest place. Images are photographs where
    ``on_sheet``, and else counts of the light alone.
    """

    plans: Sequence[Plan]
    worlds: Sequence[World]
    truth: list[dict[str, Any]]
    light: list[NDArray[np.float64]]
    images: list[NDArray[Any]]
    on_sheet: bool

    def encoders(self, seed: int) -> list[NDArray[np.float64]]:
        """What the encoders (2,) [rad] of each photograph's mount said, with the play of real
        drives.
        """
        rng = np.random.default_rng((seed, crc32(b"encoders")))
        exposures = [
            plan.exposure(world) for plan, world in zip(self.plans, self.worlds, strict=True)
        ]
        return [
            exposure.encoders(exposure.stand()) + PLAY * rng.standard_normal(2)
            for exposure in exposures
        ]

    @property
    def identifiers(self) -> list[str]:
        """What names the photographs."""
        return [str(number) for number in range(100, 100 + len(self.plans))]


def generate(
    case: str,
    level: int,
    seed: int,
    *,
    heliostats: int = 4,
    setups: int = 6,
    side: int = 192,
    fan: int = 24,
) -> MeasurementSet:
    """A set of one case of `tests.undeclared.world`, one world for all its images, which are of
    light alone.

    Strengths are 0 to 2. A seed has the same plant, suns and aims in every case; an image has 4 *
    side**2 * fan rays.
    """
    plans, rng = scattered(heliostats, setups, np.random.default_rng(seed)), _chances(case, seed)
    world, truth = disturb(
        case, level, list(dict.fromkeys(plan.heliostat.name for plan in plans)), rng
    )
    return _taken(plans, [world] * len(plans), truth, False, rng, side, fan)


def generate_season(
    case: str,
    level: int,
    seed: int,
    *,
    days: tuple[int, int] = (8, 14),
    side: int = 192,
    fan: int = 24,
) -> MeasurementSet:
    """A season's photographs in one case of `tests.undeclared.changes`, on as many ``days`` as lie
    within.
    """
    plans, rng = season(days, np.random.default_rng(seed)), _chances(case, seed)
    worlds, truth = changing(case, level, plans, rng)
    return _taken(plans, worlds, truth, case not in WITHOUT_SHEET, rng, side, fan)


def _chances(case: str, seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, crc32(case.encode())))


def _taken(
    plans: Sequence[Plan],
    worlds: Sequence[World],
    truth: list[dict[str, Any]],
    on_sheet: bool,
    rng: np.random.Generator,
    side: int,
    fan: int,
) -> MeasurementSet:
    """The set of its images."""
    suns = lru_cache(lambda ratio, clouded: Sun.of(ratio, clouded, rng))
    lights, images = [], []
    for plan, world in zip(plans, worlds, strict=True):
        rays = throw(
            plan.exposure(world), suns(world.circumsolar_ratio, world.clouded), side, fan, rng
        )
        light = camera.light(rays, plan.target, world, rng)
        lights.append(light)
        images.append(
            camera.photograph(light, plan.target, world, rng)
            if on_sheet
            else camera.counts(light, rng)
        )
    return MeasurementSet(plans, worlds, truth, lights, images, on_sheet)
