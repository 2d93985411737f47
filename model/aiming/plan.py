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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.aiming.kernels import Kernels, Thinned
from model.errors import InvalidInputError
from model.progress import nothing_between

Array = NDArray[np.float64]

DRAWS = 200
"""Draws of the pointing errors by which a plan is judged."""

WITHIN = 0.95
"""Share of draws that must be within the limit."""

_N_ANEW, _N_SMALL, _N_AGAIN, _N_FINE = 60, 100, 20, 6
"""Steps on a quarter of the pixels, from the beginning (of a small field times `_ease`) or from
aims that were good, and on all.
"""

_STEPS_FIT = 2000
"""Heliostats for which these steps suffice; fewer ones each matter more, and cost less a step."""

_MOST_EASE, _MOST_FINE = 10, 4
"""Most times that a small field takes the steps on a quarter of the pixels, and those on all."""

_RHO = 10.0
_MAX_PRESSURE = 3.0
_UPDATE, _UPDATE_FINE = 10, 6
"""Steps between updates of multipliers and margins."""

_STEP, _STEP_AGAIN, _STEP_FINE, _LAST_STEP = 0.35, 0.06, 0.03, 0.05
"""First step of the aims, relative to the images' spread, and the last relative to the first."""

_TOLERANCE = 0.005
"""Share of the limit by which steps aim below it."""

_DEFOCUS_ABOVE = 0.01
"""Excess above which mirrors are defocused if aims do not halve it; less is left to their aims."""

_CORRECTIONS = 12


class Draws(NamedTuple):
    """Peaks [W/m2] of the map, largest ratios of flux and limit, and powers [W], by draw (D,)."""

    peaks: Array
    ratios: Array
    powers: Array

    @property
    def peak(self) -> float:
        """Quantile `WITHIN` of the peak [W/m2]."""
        return float(np.quantile(self.peaks, WITHIN))

    @property
    def ratio(self) -> float:
        """Quantile `WITHIN` of the largest ratio of flux and limit; 1 is just within it."""
        return _quantile(self.ratios)


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

    def draws(self, count: int = DRAWS, seed: int = 0, rows: Sequence[int] | None = None) -> Draws:
        """Trace draws of the pointing errors: each moves the image without errors.

        ``rows`` are those of the ``count`` draws that are traced, if not all.
        """
        active = self.is_active.to(self.moved)
        peaks, ratios, powers = [], [], []
        with torch.no_grad():
            every = _errors(self.kernels, count, seed)
            for errors in every if rows is None else every[list(rows)]:
                moved = self.moved + torch.einsum("nij,nj->ni", self.kernels.spread, errors)
                flux = self.kernels.flux(moved, active, is_sharp=True)
                peaks.append(float(flux.max()))
                ratios.append(float((flux / self.limit).max()))
                powers.append(float(flux @ self.kernels.areas))
        return Draws(np.array(peaks), np.array(ratios), np.array(powers))


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
        ``multipliers``; its kernels and limit do not matter. If they are too far from aims within
        the limit, the plan begins without them.
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
        plan = _within_budget(replace(single_aim(kernels, limit), moved=_spread_out(kernels)))
        ease = _ease(kernels)
        step, count = _STEP, _N_ANEW if ease == 1 else _N_SMALL * ease
    else:
        plan, step, count = replace(start, kernels=kernels, limit=limit), _STEP_AGAIN, _N_AGAIN
    thin = kernels.thinned()
    rough = _Ascent(_on_blocks(plan, thin), step, between)
    rough.run(count, _UPDATE, count // 4 if start is None else 0)
    plan = replace(plan, moved=rough.moved, multipliers=rough.multipliers[thin.block])
    deviations, before = rough.deviations, math.inf
    blocks = _on_blocks(plan, thin)
    linear = linear_draws(blocks)
    second_order = _quantile(_traced(blocks, linear, linear.ratios, _FULL_DRAWS)) - linear.ratio
    del blocks, rough, thin  # the memory of a quarter of the pixels
    for _ in range(_CORRECTIONS):
        ascent = _Ascent(plan, _STEP_FINE, between, deviations, second_order)
        ascent.run(_N_FINE * min(_ease(kernels), _MOST_FINE), _UPDATE_FINE)
        plan, deviations = ascent.plan, ascent.deviations
        linear = linear_draws(plan)
        traced = _traced(plan, linear, linear.ratios, _FULL_DRAWS)
        if _quantile(traced) <= 1:
            traced = _traced(plan, linear, traced, _CONFIRMING_DRAWS, _FULL_DRAWS)
        second_order = _quantile(traced) - linear.ratio
        excess = _quantile(traced) - 1
        if excess <= 0:
            break
        if excess > max(_DEFOCUS_ABOVE, before / 2):
            if start is not None:  # too far from these aims: others may need no defocusing
                return plan_aims(kernels, limit, between=between)
            plan = _defocused(plan, excess)
        before = excess
    return ascent.plan


def _on_blocks(plan: AimPlan, thin: Thinned) -> AimPlan:
    """A plan on a quarter of the pixels, each with the least limit of its block."""
    count = len(thin.kernels.areas)
    limit = torch.full((count,), math.inf).scatter_reduce(0, thin.block, plan.limit, "amin")
    multipliers = torch.zeros(count).scatter_reduce(
        0, thin.block, plan.multipliers, "mean", include_self=False
    )
    return replace(plan, kernels=thin.kernels, limit=limit, multipliers=multipliers)


def _quantile(ratios: Array) -> float:
    return float(np.quantile(ratios, WITHIN))


def _traced(
    plan: AimPlan, linear: "LinearDraws", ratios: Array, count: int, done: int = 0
) -> Array:
    """Ratios of `linear_draws` with the ``count`` largest traced, of which ``done`` are already."""
    ease, traced = _ease(plan.kernels), ratios.copy()
    rows = np.argsort(-linear.ratios)[done * ease : count * ease].tolist()
    traced[rows] = plan.draws(rows=rows).ratios
    return traced


_FULL_DRAWS, _CONFIRMING_DRAWS = 12, 48
"""Draws that are traced for a step, and before a plan counts as within its limit. Draws that are
not among the first to first order may be among them in truth.
"""


def _ease(kernels: Kernels) -> int:
    """How many times more steps a field takes than one of thousands."""
    return min(max(_STEPS_FIT // len(kernels), 1), _MOST_EASE)


def _within_budget(plan: AimPlan) -> AimPlan:
    """A plan without the mirrors of the least power, if the limit allows less than all have."""
    order = torch.argsort(plan.kernels.power, descending=True)
    allowed = float((plan.limit * plan.kernels.areas).sum())
    is_active = torch.zeros_like(plan.is_active)
    is_active[order] = plan.kernels.power[order].cumsum(0) <= max(
        allowed, float(plan.kernels.power.max())
    )
    return replace(plan, is_active=is_active)


def _spread_out(kernels: Kernels) -> Tensor:
    """Aims (N, 2) [m] up and down in turn, as far as the images' spread, to begin with."""
    count = len(kernels)
    turn = torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0)
    share = torch.rand(count, generator=torch.Generator().manual_seed(0))
    return torch.stack([torch.zeros(count), turn * share * 2 * image_spread(kernels)[:, 1]], dim=-1)


def image_spread(kernels: Kernels) -> Tensor:
    """Standard deviations (N, 2) [m] of the images, right and up."""
    images, size = kernels.expected, kernels.size
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
        self,
        plan: AimPlan,
        step: float,
        between: Callable[[], None],
        deviations: float = 3.5,
        second_order: float = 0.0,
    ) -> None:
        self.begun, self.between, self.deviations = plan, between, deviations
        self.kernels, self.limit = plan.kernels, plan.limit
        self.active = plan.is_active.to(plan.moved)
        spread = image_spread(self.kernels)
        # Steps in units of the images' spread: far and near mirrors move alike. The image of a
        # mirror in full shadow has none.
        self.unit = torch.maximum(spread.mean(dim=1), self.kernels.sides / self.kernels.size)[
            :, None
        ]
        self.places = (plan.moved / self.unit).requires_grad_()
        self.multipliers = plan.multipliers.clone()
        self.step = step
        self.drawn = linear_draws(plan)
        self.margin = deviations * self.drawn.sigma
        self.second_order = second_order

    @property
    def moved(self) -> Tensor:
        return self.places.detach() * self.unit

    @property
    def plan(self) -> AimPlan:
        return replace(self.begun, moved=self.moved, multipliers=self.multipliers)

    def run(self, count: int, update: int, settled: int = 0) -> None:
        """Take ``count`` steps, which shrink as a cosine.

        Margins are updated after each ``update`` of them, multipliers once ``settled`` are taken.
        """
        areas = self.kernels.areas
        total = float(self.kernels.power.sum())
        adam = torch.optim.Adam([self.places], lr=self.step, betas=(0.8, 0.98))
        for number in range(count):
            self.between()
            if number % update == 0:
                self.drawn = linear_draws(self.plan) if number else self.drawn
                self._update(number >= settled)
            fall = (1 + math.cos(math.pi * number / count)) / 2
            for group in adam.param_groups:
                group["lr"] = self.step * (_LAST_STEP + (1 - _LAST_STEP) * fall)
            adam.zero_grad()
            flux = self.kernels.flux(self.places * self.unit, self.active)
            pressure = (self.multipliers + _RHO * self._excess(flux)).clamp(min=0)
            penalty = (areas * self.limit * penalty_of(pressure)).sum()
            ((penalty - (areas * flux).sum()) / total).backward()  # type: ignore[no-untyped-call]
            adam.step()

    def _excess(self, flux: Tensor) -> Tensor:
        return (flux + self.margin) / self.limit - 1

    def _update(self, has_settled: bool) -> None:
        """Set margin and multipliers by the present aims."""
        with torch.no_grad():
            flux = self.kernels.flux(self.moved, self.active)
            drawn, ratio = self.drawn, self.drawn.ratio + self.second_order
            if has_settled:
                # By the margin for which the aims were found.
                self.multipliers = (self.multipliers + _RHO * self._excess(flux)).clamp(min=0)
                full = (drawn.sigma / self.limit)[(flux + self.margin) > 0.98 * self.limit]
                if len(full):
                    wanted = (ratio - 1 + _TOLERANCE) / max(float(full.mean()), 1e-4)
                    self.deviations = min(max(self.deviations + _SHARE * wanted, 0.5), 6.0)
            self.margin = self.deviations * drawn.sigma


_SHARE = 0.5
"""Share of a wanted change of the margin that is made at once."""


def penalty_of(pressure: Tensor) -> Tensor:
    """The penalty [of the limit] whose slope by the excess is the ``pressure``.

    It is quadratic up to `_MAX_PRESSURE` and linear above: far too much light must not be thrown
    off the receiver.
    """
    soft = pressure.clamp(max=_MAX_PRESSURE)
    return soft * (2 * pressure - soft) / (2 * _RHO)


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
        return _quantile(self.ratios)


def linear_draws(plan: AimPlan, count: int = DRAWS) -> LinearDraws:
    """Draw the errors of `AimPlan.draws`, with flux that changes in proportion to them."""
    errors, pixels = _errors(plan.kernels, count, 0), torch.arange(len(plan.limit))
    size = max(len(plan.kernels), count // 2) * len(pixels)
    bands = pixels.chunk(1 if size <= 2 * _DENSE else math.ceil(size / _DENSE))
    found = [_draws_on(plan, band, errors) for band in bands]
    sigma = torch.cat([one.sigma for one in found])
    return LinearDraws(sigma, np.max([one.ratios for one in found], axis=0))


def _draws_on(plan: AimPlan, band: Tensor, errors: Tensor) -> LinearDraws:
    """Draws of errors (D, N, 2) on some pixels of the map."""
    limit = plan.limit[band]
    if len(band) < len(plan.limit):
        plan = replace(plan, kernels=plan.kernels.on_pixels(band))
    drawn, sigma = torch.zeros(len(errors), len(band)), torch.zeros(len(band))
    for axis in range(2):
        changes = _changes(plan, axis)
        drawn.addmm_(errors[:, :, axis], changes)
        sigma = torch.hypot(sigma, changes.norm(dim=0))
    ratios = drawn.add_(plan.flux).div_(limit).max(dim=1).values
    return LinearDraws(sigma, ratios.double().numpy())


_DENSE = 2**23
"""Mirrors, or twice as many draws, times pixels of a map whose changes are in memory at once."""


def _changes(plan: AimPlan, axis: int) -> Tensor:
    """What a standard deviation of the errors changes (N, P) [W/m2]."""
    changes = torch.zeros(len(plan.kernels), len(plan.kernels.areas))
    with torch.no_grad():
        for part, rows in plan.kernels.parts():
            moved, shift = plan.moved[rows], part.spread[:, :, axis] / 2
            change = part.light(moved + shift) - part.light(moved - shift)
            change *= plan.is_active[rows, None]
            changes[rows].scatter_add_(1, part.pixels.long(), change)
    return changes


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
    worth = (1 - plan.multipliers) * plan.kernels.areas
    with torch.no_grad():
        values = [
            (part.light(plan.moved[rows]) * worth[part.pixels]).sum(dim=1)
            for part, rows in plan.kernels.parts()
        ]
    return torch.cat(values)
