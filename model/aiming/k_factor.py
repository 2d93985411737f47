"""Aims by the aiming factor k, to compare with.

Each mirror aims above or below the receiver's middle, neighbours in turn, as far as k times its
beam's spread leaves space to the edge. All k begin at 3, where every beam is within the receiver.
In sectors that see pixels above the limit, k falls until none is, or the aims are at the edge.

Source: Sanchez-Gonzalez, Rodriguez-Sanchez and Santana 2017, *Aiming strategy model based on
allowable flux densities for molten salt central receivers*, Solar Energy 157.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.aiming.kernels import Kernels
from model.aiming.plan import AimPlan, image_spread, linear_draws, single_aim
from model.plant import Receiver

SECTORS = 12
_FIRST_K, _STEP = 3.0, 0.1


def k_factor_aims(kernels: Kernels, limit: Tensor, receiver: Receiver) -> AimPlan:
    """Aims by k on a receiver under a limit (P,) [W/m2].

    If no k keeps the limit, those that come nearest to it do after mirrors on the hottest pixel are
    defocused.
    """
    spread = image_spread(kernels)[:, 1]
    middle = torch.tensor(receiver.aim_of(kernels.mirrors.double().numpy())).to(kernels.aims)
    middle_up = ((middle - kernels.aims) * kernels.axes[:, 1]).sum(dim=1)
    sector, turn = _sectors(kernels)
    k = torch.full((SECTORS,), _FIRST_K)
    plan, least = single_aim(kernels, limit), float("inf")
    nearest = plan
    while least > 1 and bool((k > 0).any()):
        space = (receiver.height / 2 - k[sector] * spread).clamp(min=0)
        up = middle_up + space * turn
        plan = replace(plan, moved=torch.stack([torch.zeros_like(up), up], dim=-1))
        ratio = linear_draws(plan).ratio
        if ratio < least:
            nearest, least = plan, ratio
        hot = _sectors_that_light(kernels, sector, plan.flux * ratio > limit)
        hot = hot if bool((k[hot] > 0).any()) else torch.ones_like(hot)
        k = torch.where(hot, (k - _STEP).clamp(min=0), k)
    while least > 1:
        nearest = _without_hottest(nearest)
        least = linear_draws(nearest).ratio
    return nearest


_DEFOCUSED = 0.01
"""Share of the mirrors that are defocused at once."""


def _without_hottest(plan: AimPlan) -> AimPlan:
    """A plan without those mirrors that put the most light on the hottest pixel."""
    kernels = plan.kernels
    hottest = int((plan.flux / plan.limit).argmax())
    at = kernels.on_pixels(torch.tensor([hottest]))
    light = at.light(plan.moved).sum(dim=1)
    light[~plan.is_active] = -1.0
    active = plan.is_active.clone()
    active[torch.argsort(light, descending=True)[: max(1, round(_DEFOCUSED * len(light)))]] = False
    return replace(plan, is_active=active)


class _Sectors(NamedTuple):
    """Sector (N,) of each mirror by its azimuth, and 1 or -1 (N,) in turn with the distance."""

    sector: Tensor
    turn: Tensor


def _sectors(kernels: Kernels) -> _Sectors:
    east, north, _ = kernels.mirrors.double().numpy().T
    sector = (np.arctan2(east, north) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    order = np.lexsort((np.hypot(east, north), sector))
    turn = np.empty(len(order))
    turn[order] = np.where(np.arange(len(order)) % 2 == 0, 1.0, -1.0)
    return _Sectors(torch.tensor(sector), torch.tensor(turn, dtype=torch.float32))


def _sectors_that_light(kernels: Kernels, sector: Tensor, pixels: Tensor) -> Tensor:
    """Sectors whose mirrors light pixels (P,) most steeply: (SECTORS,) bool."""
    hot = torch.zeros(SECTORS, dtype=torch.bool)
    for part, rows in kernels.parts():
        facing = part.factors * pixels[part.pixels]
        best = facing.max(dim=1).values > _STEEP * part.factors.max(dim=1).values
        hot[sector[rows][best]] = True
    return hot


_STEEP = 0.9
"""A pixel is a sector's own if its light is as steep as this share of the steepest."""
