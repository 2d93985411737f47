"""What a plan of aim points is worth, by the names of ``REPORT.json`` of ``heliotwin aim``."""

from typing import TypedDict

from model.aiming.bound import bound_power
from model.aiming.k_factor import k_factor_aims
from model.aiming.plan import AimPlan
from model.plant import Receiver


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
