"""A measured profile. It is not declared in ``twin.json``: its parameters are two tables."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from model.errors import InvalidInputError
from model.sunshape.base import SunShape


@dataclass(frozen=True)
class Tabulated(SunShape):
    """A measured profile: radiances at increasing angles [rad] from 0, linear between."""

    angles: tuple[float, ...]
    radiances: tuple[float, ...]

    def __post_init__(self) -> None:
        a, r = np.asarray(self.angles), np.asarray(self.radiances)
        if (
            a.shape != r.shape
            or a.ndim != 1
            or len(a) < 2
            or not (np.isfinite(a).all() and np.isfinite(r).all())
        ):
            raise InvalidInputError(
                "a tabulated sun shape needs as many finite radiances as angles, at least two"
            )
        if a[0] != 0 or (np.diff(a) <= 0).any() or (r < 0).any() or not r.any():
            raise InvalidInputError(
                "a tabulated sun shape needs angles rising from 0 and radiances that are not"
                " negative"
            )

    @property
    def edges(self) -> Sequence[float]:
        """The table's angles [rad]."""
        return self.angles

    def profile(self, angle: Tensor) -> Tensor:
        """Linear interpolation."""
        table = np.interp(angle.detach().cpu().numpy(), self.angles, self.radiances, right=0.0)
        return torch.as_tensor(table, dtype=angle.dtype, device=angle.device)
