"""Aims that put the most power on a receiver under the flux that it can take.

The light of all mirrors is a differentiable function of their aims (`model.aiming.kernels`). Power
is maximised under the limit with an augmented Lagrangian and Adam::

    minimise  -sum A F + sum A L (max(0, l + r v)^2 - l^2) / 2 r,   v = (F + z S) / L - 1

with the map F, the limit L and the areas A of the pixels, and multipliers l. S is the standard
deviation of the flux that pointing errors leave, and z is set so that in 95 % of draws of these
errors the whole map is within the limit. Mirrors are defocused only if no aims are.

Source: Nocedal and Wright, *Numerical Optimization*, section 17.4, for inequalities.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.aiming.kernels import Kernels
from model.errors import InvalidInputError
from model.progress import nothing_between

Array = NDArray[np.float64]

DRAWS = 200
"""Draws of the pointing errors by which a plan is judged."""

WITHIN = 0.95
"""Share of draws that must be within the limit."""

_N_ANEW, _N_AGAIN = 100, 20
"""Steps of a plan from the beginning, and from aims that were good."""

_RHO = 10.0
_MAX_PRESSURE = 3.0
_UPDATE = 10
"""Steps between updates of multipliers and margins."""

_STEP, _STEP_AGAIN, _LAST_STEP = 0.35, 0.08, 0.05
"""First step of the aims, relative to the images' spread, and the last relative to the first."""

_TOLERANCE = 0.002
"""Share of the limit by which steps aim below it."""

_DEFOCUS_ABOVE = 0.01
"""Excess above which mirrors are defocused; less is left to their aims."""

_CORRECTIONS = 12


class Draws(NamedTuple):
    """Peaks [W/m2] of the map, and largest ratios of flux and limit, by draw (D,)."""

    peaks: Array
    ratios: Array

    @property
    def peak(self) -> float:
        """Quantile `WITHIN` of the peak [W/m2]."""
        return float(np.quantile(self.peaks, WITHIN))

    @property
    def ratio(self) -> float:
        """Quantile `WITHIN` of the largest ratio of flux and limit; 1 is just within it."""
        return float(np.quantile(self.ratios, WITHIN))


@dataclass(frozen=True, eq=False)
class AimPlan:
    """Aims of N mirrors on a map of P pixels.

    Attributes
    ----------
    kernels : Kernels
    limit : Tensor (P,) [W/m2]
    moved : Tensor (N, 2) [m]
        Aims, right and up on the touching planes.
    is_active : Tensor (N,)
        False for mirrors that are defocused.
    multipliers : Tensor (P,)
        What a limit higher by a W/m2 would gain in power, relative to the pixel's area.
    """

    kernels: Kernels
    limit: Tensor
    moved: Tensor
    is_active: Tensor
    multipliers: Tensor

    @property
    def flux(self) -> Tensor:
        """Expected map (P,) [W/m2]."""
        with torch.no_grad():
            return self.kernels.flux(self.moved, self.is_active.to(self.moved))

    @property
    def power(self) -> float:
        """Expected power on the receiver [W]."""
        return float((self.flux.double() * self.kernels.areas).sum())

    @property
    def points(self) -> Array:
        """Aim points (N, 3) [m] in ENU."""
        return self.kernels.points(self.moved)

    def draws(self, count: int = DRAWS, seed: int = 0) -> Draws:
        """Trace draws of the pointing errors: each moves the image without errors."""
        active = self.is_active.to(self.moved)
        peaks, ratios = [], []
        with torch.no_grad():
            for errors in _errors(self.kernels, count, seed):
                moved = self.moved + torch.einsum("nij,nj->ni", self.kernels.spread, errors)
                flux = self.kernels.flux(moved, active, is_sharp=True)
                peaks.append(float(flux.max()))
                ratios.append(float((flux / self.limit).max()))
        return Draws(np.array(peaks), np.array(ratios))


def single_aim(kernels: Kernels, limit: Tensor) -> AimPlan:
    """All mirrors aim where their images were traced, whatever the limit is."""
    count = len(kernels)
    active = torch.ones(count, dtype=torch.bool)
    return AimPlan(kernels, limit, torch.zeros(count, 2), active, torch.zeros_like(kernels.areas))


def plan_aims(
    kernels: Kernels,
    limit: Tensor,
    start: AimPlan | None = None,
    between: Callable[[], None] = nothing_between,
) -> AimPlan:
    """Find aims of the most power under a limit.

    Parameters
    ----------
    kernels : Kernels
    limit : Tensor (P,) [W/m2]
        Positive.
    start : AimPlan, optional
        Aims that were good for these mirrors a little before, by its ``moved`` and
        ``multipliers``; its kernels and limit do not matter.
    between : callable
        Called repeatedly; an exception ends the work.

    Raises
    ------
    InvalidInputError
        If the limit is not positive.
    """
    if not (torch.isfinite(limit).all() and float(limit.min()) > 0):
        raise InvalidInputError("limit: must be positive everywhere; give the pixels a small one")
    if start is None:
        found = _within_budget(replace(single_aim(kernels, limit), moved=_spread_out(kernels)))
        ascent = _Ascent(found, _STEP, between)
        ascent.run(_N_ANEW)
    else:
        found = replace(start, kernels=kernels, limit=limit)
        ascent = _Ascent(found, _STEP_AGAIN, between)
        ascent.run(_N_AGAIN)
    for _ in range(_CORRECTIONS):
        plan = ascent.plan
        excess = _judged_ratio(plan) - 1
        if excess <= 0:
            break
        if excess > _DEFOCUS_ABOVE:
            plan = _defocused(plan, excess)
        ascent = _Ascent(plan, _STEP_AGAIN, between, ascent.deviations + _DEEPER)
        ascent.run(_N_AGAIN)
    return ascent.plan


def _judged_ratio(plan: AimPlan) -> float:
    """The quantile of `Draws.ratio`: by draws to first order, with what some full ones differ."""
    linear, full = linear_draws(plan), plan.draws(_FULL_DRAWS)
    return linear.ratio + float((full.ratios - linear.ratios[:_FULL_DRAWS]).mean())


_FULL_DRAWS = 40


def _within_budget(plan: AimPlan) -> AimPlan:
    """A plan without the mirrors of the least power, if the limit allows less than all have."""
    order = torch.argsort(plan.kernels.power, descending=True)
    allowed = float((plan.limit * plan.kernels.areas).sum())
    is_active = torch.zeros_like(plan.is_active)
    is_active[order] = plan.kernels.power[order].cumsum(0) <= max(
        allowed, float(plan.kernels.power.max())
    )
    return replace(plan, is_active=is_active)


_DEEPER = 0.3
"""Standard deviations that are added to the margin if draws exceed the limit."""


def _spread_out(kernels: Kernels) -> Tensor:
    """Aims (N, 2) [m] up and down in turn, as far as the images' spread, to begin with."""
    count = len(kernels)
    turn = torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0)
    share = torch.rand(count, generator=torch.Generator().manual_seed(0))
    return torch.stack([torch.zeros(count), turn * share * 2 * image_spread(kernels)[:, 1]], dim=-1)


def image_spread(kernels: Kernels) -> Tensor:
    """Standard deviations (N, 2) [m] of the images, right and up."""
    images = kernels.expected
    size = images.shape[-1]
    place = (torch.arange(size) + 0.5) / size - 0.5
    total = images.sum(dim=(1, 2)).clamp(min=1e-30)
    spreads = []
    for profile in (images.sum(1), images.sum(2)):
        mean = profile @ place / total
        spreads.append((profile @ place**2 / total - mean**2).clamp(min=0).sqrt())
    return torch.stack(spreads, dim=-1) * kernels.sides[:, None]


class _Ascent:
    """Steps of the augmented Lagrangian from a plan."""

    def __init__(
        self, plan: AimPlan, step: float, between: Callable[[], None], deviations: float = 2.5
    ) -> None:
        self.begun, self.between, self.deviations = plan, between, deviations
        self.kernels, self.limit = plan.kernels, plan.limit
        self.active = plan.is_active.to(plan.moved)
        spread = image_spread(self.kernels)
        # Steps in units of the images' spread: far and near mirrors move alike.
        self.unit = spread.mean(dim=1, keepdim=True)
        self.places = (plan.moved / self.unit).requires_grad_()
        self.multipliers = plan.multipliers.clone()
        self.step = step
        self.margin = torch.zeros_like(self.limit)

    @property
    def moved(self) -> Tensor:
        return self.places.detach() * self.unit

    @property
    def plan(self) -> AimPlan:
        return replace(self.begun, moved=self.moved, multipliers=self.multipliers)

    def run(self, count: int) -> None:
        """Take ``count`` steps; they shrink as a cosine."""
        areas = self.kernels.areas
        total = float(self.kernels.power.sum())
        adam = torch.optim.Adam([self.places], lr=self.step, betas=(0.8, 0.98))
        for number in range(count):
            self.between()
            if number % _UPDATE == 0:
                self._update(number > count // 4)
            fall = (1 + math.cos(math.pi * number / count)) / 2
            for group in adam.param_groups:
                group["lr"] = self.step * (_LAST_STEP + (1 - _LAST_STEP) * fall)
            adam.zero_grad()
            flux = self.kernels.flux(self.places * self.unit, self.active)
            pressure = (self.multipliers + _RHO * self._excess(flux)).clamp(min=0)
            # Linear above `_MAX_PRESSURE`: far too much light must not be thrown off the receiver.
            soft = pressure.clamp(max=_MAX_PRESSURE)
            penalty = (areas * self.limit * soft * (2 * pressure - soft)).sum() / (2 * _RHO)
            ((penalty - (areas * flux).sum()) / total).backward()  # type: ignore[no-untyped-call]
            adam.step()

    def _excess(self, flux: Tensor) -> Tensor:
        return (flux + self.margin) / self.limit - 1

    def _update(self, has_settled: bool) -> None:
        """Set margin and multipliers by the present aims."""
        with torch.no_grad():
            flux = self.kernels.flux(self.moved, self.active)
            drawn = linear_draws(self.plan)
            if has_settled:
                full = (drawn.sigma / self.limit)[(flux + self.margin) > 0.98 * self.limit]
                if len(full):
                    self.deviations += (drawn.ratio - 1 + _TOLERANCE) / max(
                        float(full.mean()), 1e-4
                    )
                    self.deviations = min(max(self.deviations, 0.5), 6.0)
            self.margin = self.deviations * drawn.sigma
            if has_settled:
                self.multipliers = (self.multipliers + _RHO * self._excess(flux)).clamp(min=0)


class LinearDraws(NamedTuple):
    """Draws of the pointing errors to first order.

    Attributes
    ----------
    sigma : Tensor (P,) [W/m2]
        Standard deviation of the flux.
    ratios : (D,)
        Largest ratio of flux and limit of each draw.
    """

    sigma: Tensor
    ratios: Array

    @property
    def ratio(self) -> float:
        """Quantile `WITHIN` of the ratios; 1 is just within the limit."""
        return float(np.quantile(self.ratios, WITHIN))


def linear_draws(plan: AimPlan, count: int = DRAWS) -> LinearDraws:
    """Draw the errors of `AimPlan.draws`, with flux that changes in proportion to them."""
    kernels, flux = plan.kernels, plan.flux
    errors = _errors(kernels, count, 0)
    drawn, variance = torch.zeros(count, len(flux)), torch.zeros_like(flux)
    with torch.no_grad():
        for axis in range(2):
            shift = kernels.spread[:, :, axis] / 2
            change = kernels.light(plan.moved + shift) - kernels.light(plan.moved - shift)
            change = change * plan.is_active[:, None]
            variance.index_add_(0, kernels.pixels.flatten(), (change**2).flatten())
            dense = torch.zeros(len(kernels), len(flux)).scatter_add_(1, kernels.pixels, change)
            drawn += errors[:, :, axis] @ dense
    ratios = ((flux + drawn) / plan.limit).max(dim=1).values
    return LinearDraws(variance.sqrt(), ratios.double().numpy())


def _errors(kernels: Kernels, count: int, seed: int) -> Tensor:
    """Standard normal draws (count, N, 2); the first ones are the same for any count."""
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randn(len(kernels), 2, generator=generator) for _ in range(count)])


def _defocused(plan: AimPlan, excess: float) -> AimPlan:
    """A plan without the mirrors that are worth least, as many as the limit is exceeded by."""
    value = mirror_values(plan)
    value[~plan.is_active] = math.inf
    count = max(1.0, int(plan.is_active.sum()) * min(excess, 0.5) / 4)
    active = plan.is_active.clone()
    active[torch.argsort(value)[: int(count)]] = False
    return replace(plan, is_active=active)


def mirror_values(plan: AimPlan) -> Tensor:
    """Power (N,) [W] of each mirror, less what its light costs at the multipliers."""
    kernels = plan.kernels
    weights = ((1 - plan.multipliers) * kernels.areas)[kernels.pixels]
    with torch.no_grad():
        return (kernels.light(plan.moved) * weights).sum(dim=1)
