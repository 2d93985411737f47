"""How far the power and the peak of a plan may be from what it says.

A real moment is one draw of the pointing errors, on mirrors whose surfaces are known to some
accuracy. Each of the given worlds has images of one draw of these surfaces, and shares the draws
with the others. Errors of many mirrors average out in the power, less so in the peak.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.aiming.kernels import Kernels
from model.aiming.plan import DRAWS, AimPlan, Draws
from model.errors import InvalidInputError

Array = NDArray[np.float64]

LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """Central interval of `LEVEL`."""

    low: float
    high: float


@dataclass(frozen=True)
class PlanUncertainty:
    """Intervals of a moment's power [W] and peak [W/m2], and how often the map is in the limit [1].

    Attributes
    ----------
    power, peak : Interval
    within : float
    """

    power: Interval
    peak: Interval
    within: float


def plan_uncertainty(
    plan: AimPlan, worlds: Sequence[Callable[[], Kernels]] = (), own: Draws | None = None
) -> PlanUncertainty:
    """Judge a plan by `DRAWS` draws of pointing errors and surfaces, at least one for each world.

    Parameters
    ----------
    plan : AimPlan
    worlds : sequence of callables
        Each makes kernels of the same mirrors with drawn surfaces, one at a time in memory; by
        default the plan's kernels alone.
    own : Draws, optional
        The plan's, if they were traced before; without worlds these are what it is judged by.

    Raises
    ------
    InvalidInputError
        If a world has other mirrors than the plan.
    """
    if worlds:
        each = max(1, DRAWS // len(worlds))
        # A seed for each world: the same errors in all of them would hide part of the spread.
        drawn = [judged_on(plan, make()).draws(each, seed) for seed, make in enumerate(worlds)]
    else:
        drawn = [own or plan.draws()]
    powers, peaks, ratios = (
        np.concatenate([getattr(one, name) for one in drawn])
        for name in ("powers", "peaks", "ratios")
    )
    return PlanUncertainty(_interval(powers), _interval(peaks), float((ratios <= 1).mean()))


def judged_on(plan: AimPlan, kernels: Kernels) -> AimPlan:
    """The same aims on other images of the same mirrors, such as those of the true surfaces.

    Raises
    ------
    InvalidInputError
        If these are of other mirrors.
    """
    if kernels.names != plan.kernels.names:
        raise InvalidInputError("kernels: are of other mirrors than the plan; trace the same ones")
    return replace(plan, kernels=kernels)


def _interval(values: Array) -> Interval:
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(low), float(high))
