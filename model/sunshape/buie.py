"""Buie's sun shape, the default: a disc with an aureole."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.errors import InvalidInputError
from model.sunshape.base import SOLAR_DISC, SunShape, check, integral

AUREOLE_EDGE = 43.6e-3
"""Where the circumsolar aureole ends in Buie's sun shape [rad]."""


@dataclass(frozen=True)
class Buie(SunShape):
    """Buie's sun shape: a limb-darkened disc and an aureole that falls as a power of the angle.

    ``circumsolar_ratio`` is the chi of the formula, 0 (no aureole) to 0.5; it may be a tensor, for
    gradients.

    Source: Buie, Monger, Dey, *Sunshape distributions for terrestrial solar simulations*, Solar
    Energy 74 (2003), doi:10.1016/S0038-092X(03)00125-7, eqs. 6 to 9.
    """

    units: ClassVar[Mapping[str, float]] = {"circumsolar_ratio": 1.0}

    circumsolar_ratio: float | Tensor = 0.02

    def __post_init__(self) -> None:
        check("circumsolar_ratio", self.circumsolar_ratio, 0.0, 0.5)

    @property
    def edges(self) -> Sequence[float]:
        """Centre, rim of the disc and end of the aureole [rad]."""
        return (0.0, SOLAR_DISC, AUREOLE_EDGE)

    def profile(self, angle: Tensor) -> Tensor:
        """Radiance relative to the centre's; the formula counts angles in milliradians."""
        theta = (angle * 1e3).clamp(min=1e-9)
        disc = torch.cos(0.326 * theta) / torch.cos(0.308 * theta)
        chi = torch.as_tensor(self.circumsolar_ratio, dtype=angle.dtype, device=angle.device).clamp(
            min=1e-9
        )
        kappa = 0.9 * torch.log(13.5 * chi) * chi**-0.3
        gamma = 2.2 * torch.log(0.52 * chi) * chi**0.43 - 0.1
        aureole = torch.exp(kappa + gamma * torch.log(theta))
        inside = angle <= SOLAR_DISC
        return torch.where(
            inside, disc, torch.where(angle <= AUREOLE_EDGE, aureole, torch.zeros_like(aureole))
        )


MAX_CHI = 0.5
"""Largest chi of `Buie`."""


def csr_of_chi(chi: float) -> float:
    """True circumsolar ratio, the share of the light that comes from the aureole.

    By integration of the profile; the formula's ``chi`` (0 to 0.5) differs from it, by a factor of
    20 at 0.01. Source: Wang, Asselineau, Fontanges, Logie, Pye and Coventry, *Verification of
    optical modelling of sunshape and surface slope error*, Solar Energy 195 (2020).
    """
    whole = Buie(chi)
    disc = integral(_Disc(chi))
    return float(1 - disc / integral(whole))


def chi_of_csr(csr: float) -> float:
    """The ``chi`` of `Buie` whose true circumsolar ratio is ``csr``: the inverse of `csr_of_chi`.

    Raises
    ------
    InvalidInputError
        If no chi has it.
    """
    most = csr_of_chi(MAX_CHI)
    if not 0 <= csr <= most:
        raise InvalidInputError(f"csr must lie in [0, {most:.3f}], got {csr:g}")
    low, high = 0.0, MAX_CHI
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if csr_of_chi(middle) < csr else (low, middle)
    return 0.0 if csr == 0 else (low + high) / 2


# Of the interval of chi, until it is smaller than a double resolves.
_HALVINGS = 52


class _Disc(Buie):
    """The solar disc of Buie's sun shape without its aureole."""

    @property
    def edges(self) -> Sequence[float]:
        """Centre and rim of the disc [rad]."""
        return (0.0, SOLAR_DISC)
