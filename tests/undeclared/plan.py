"""What is planned for a measurement set: which heliostat is photographed when, on which target, and
where on it.
"""

from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from tests.undeclared import sky
from tests.undeclared.plant import TARGETS, Heliostat, Target, field
from tests.undeclared.rays import Exposure
from tests.undeclared.world import World

Array = NDArray[np.float64]

RANGES = (40.0, 400.0)
"""Slant ranges [m]; a set spreads its heliostats between them."""

MIN_ELEVATION = np.radians(12.0)

HOURS = (7.0, 17.0)
"""Of a day, in which photographs are taken [UTC]."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What is planned for one photograph of the heliostat ``index``.

    ``moment`` has its time zone; ``goal`` (3,) [m] is where the light's centre of mass goes;
    ``warmth`` is in standard deviations.
    """

    index: int
    heliostat: Heliostat
    moment: datetime
    target: Target
    goal: Array
    warmth: float

    @property
    def day(self) -> date:
        """The day, in UTC."""
        return self.moment.date()

    def sun(self, late_minutes: float = 0.0) -> Array:
        """Direction (3,) of the sun, ``late_minutes`` after the planned time."""
        return sky.sun(self.moment + timedelta(minutes=late_minutes))

    def exposure(self, world: World) -> Exposure:
        """What really happens."""
        sun = self.sun(world.clock_minutes)
        return Exposure(world, self.index, self.heliostat, sun, self.target, self.goal, self.warmth)


def scattered(heliostats: int, each: int, rng: np.random.Generator) -> list[Plan]:
    """So many photographs of each heliostat, on random days of a year."""
    plans = []
    for index, heliostat in enumerate(field(heliostats, RANGES, rng)):
        for _ in range(each):
            plans.append(
                _plan(
                    index, heliostat, date(2023, 1, 1) + timedelta(days=int(rng.integers(365))), rng
                )
            )
    return plans


def season(days: tuple[int, int], rng: np.random.Generator) -> list[Plan]:
    """Photographs of 3 to 5 heliostats in the order of time, about one a day each, on so many days
    over weeks.
    """
    heliostats = field(int(rng.integers(3, 6)), RANGES, rng)
    day, pace = date(2023, 3, 15) + timedelta(days=int(rng.integers(500))), rng.uniform(1, 6)
    plans: list[Plan] = []
    turns: list[int] = []
    for _ in range(rng.integers(*days, endpoint=True)):
        day += timedelta(days=1 + int(rng.exponential(pace)))
        for _ in range(len(heliostats) + rng.integers(3)):
            turns = turns or rng.permutation(len(heliostats)).tolist()
            index = turns.pop()
            plans.append(_plan(index, heliostats[index], day, rng))
    return sorted(plans, key=lambda plan: plan.moment)


def _plan(index: int, heliostat: Heliostat, day: date, rng: np.random.Generator) -> Plan:
    """A photograph at a random hour of a day with the sun well up."""
    target = TARGETS[rng.integers(len(TARGETS))]
    goal = target.center + rng.normal(0, 0.25, 2) @ target.axes[:2]
    midnight = datetime.combine(day, datetime.min.time(), UTC)
    while True:
        moment = midnight + timedelta(hours=rng.uniform(*HOURS))
        plan = Plan(index, heliostat, moment, target, goal, rng.standard_normal())
        if np.arcsin(min(plan.sun(late)[2] for late in (-60.0, 0.0, 60.0))) > MIN_ELEVATION:
            return plan
