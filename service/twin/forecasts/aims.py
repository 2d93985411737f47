"""What a plan of aim points is worth, by the names of ``REPORT.json`` of ``heliotwin aim``."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypedDict

from numpy.typing import ArrayLike
from torch import Tensor

from model.aiming.bound import bound_power
from model.aiming.k_factor import k_factor_aims
from model.aiming.kernels import Kernels
from model.aiming.plan import AimPlan, single_aim
from model.plant import Receiver

ROWS = 32
"""Rows of a map if none are asked for: its pixels are smaller than any image of a mirror."""


def begin_at(kernels: Kernels, limit: Tensor, aims: Mapping[str, ArrayLike | None]) -> AimPlan:
    """A plan that begins with aims (3,) [m] by heliostat, None for one that is not active.

    Heliostats without an aim begin where their images were traced.
    """
    plan = single_aim(kernels, limit)
    points, active = plan.points, plan.is_active
    for row, name in enumerate(kernels.names):
        if name in aims:
            aim = aims[name]
            active[row] = aim is not None
            points[row] = points[row] if aim is None else aim
    return replace(plan, moved=kernels.moved(points), is_active=active)


class Baseline(TypedDict):
    """What another way of aiming reaches under the same limit and draws."""

    name: str
    power_w: float
    peak_p95_w_m2: float


class AimFigures(TypedDict):
    """Power [W] and flux [W/m2] of a plan; DESIGN.md, section 8."""

    power_w: float
    single_aim_power_w: float
    peak_w_m2: float
    peak_p95_w_m2: float
    limit_w_m2: float
    largest_share_of_limit: float
    bound_w: float
    baseline: Baseline
    inactive: list[str]


def aim_figures(plan: AimPlan, receiver: Receiver, single_aim_power_w: float) -> AimFigures:
    """Judge a plan by draws of the pointing errors, by its bound and by k-factors."""
    other = k_factor_aims(plan.kernels, plan.limit, receiver)
    drawn, names = plan.draws(), plan.kernels.names
    return AimFigures(
        power_w=plan.power,
        single_aim_power_w=single_aim_power_w,
        peak_w_m2=float(plan.flux.max()),
        peak_p95_w_m2=drawn.peak,
        limit_w_m2=float(plan.limit.max()),
        largest_share_of_limit=drawn.ratio,
        bound_w=bound_power(plan),
        baseline=Baseline(name="k-factor", power_w=other.power, peak_p95_w_m2=other.draws().peak),
        inactive=sorted(
            name for name, is_on in zip(names, plan.is_active.tolist(), strict=True) if not is_on
        ),
    )
