"""Changes of beams by angles: moments of the light's directions about sun and mount.

Notes
-----
Light that turns by small angles with the moments c_k multiplies the spectrum of an image on a plane
by ``exp(sum c_k h_k(a, b))``. The phases a, b are the frequency times the movement of light with
the angle. Second moments may be negative: the light is then sharper than it was traced. A sun of
another size stretches the frequencies at which its own transfer function is taken.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

TAILS_MRAD = (6.0, 15.0)
"""Widths of scattered light about the sun."""

MAX_SHARPENING = 1.0
"""Largest exponent of a transfer: detail that a forecast lacks is raised by e at most."""

N_TURNS = 4
"""Number of turns of a beam: by the sun, sidewards and upwards, and by the mount's axes."""


def sun_moments(a: Any, b: Any) -> list[Any]:
    """Exponents by second and third moments and scattered light, at phases [1/mrad] of the sun."""
    second = [-a * a / 2, -a * b, -b * b / 2]
    third = [1j * part for part in (a**3 / 6, a * a * b / 2, a * b * b / 2, b**3 / 6)]
    # Light that is scattered once and several times, as a share of all.
    tails = [math.e ** (-(width**2) * (a * a + b * b) / 2) - 1 for width in TAILS_MRAD]
    return [*second, *third, *tails]


def axis_moments(first: Any, second: Any) -> list[Any]:
    """Exponents by the variances of the angles about both axes, at their phases [1/mrad]."""
    return [-first * first / 2, -second * second / 2]


@dataclass(frozen=True, eq=False)
class BeamChange:
    """Changed beams on a plane.

    Attributes
    ----------
    moves : Tensor (B, N_TURNS, 2) [m/mrad]
        Movement of light on the plane, right and up, with each turn.
    moments : Tensor (B, 13)
        Factors of `sun_moments` and `axis_moments`, and relative changes of the sun's size,
        sidewards and upwards.
    """

    moves: Tensor
    moments: Tensor

    def transfer(self, right: Tensor, up: Tensor) -> Tensor:
        """Transfer function (B, R, C) at frequencies right (1, C) and up (R, 1) [cycles/m]."""
        phases = [_phase(move, right, up) for move in self.moves.unbind(1)]
        terms = [*sun_moments(*phases[:2]), *axis_moments(*phases[2:])]
        factors = self.moments[:, : len(terms)].unbind(1)
        total = sum(c[:, None, None] * term for c, term in zip(factors, terms, strict=True))
        exponent = torch.as_tensor(total)
        return torch.exp(torch.complex(exponent.real.clamp(max=MAX_SHARPENING), exponent.imag))

    def sun_stretch(self, right: Tensor, up: Tensor) -> Tensor:
        """What the sun's new size adds to the square (B, R, C) [cycles2/rad2] of frequencies that
        are seen from the mirror, at frequencies right (1, C) and up (R, 1) [cycles/m].
        """
        sizes = (1 + self.moments[:, -2:]).clamp(min=0)
        moves = self.moves.unbind(1)[:2]
        a, b = (1e3 / (2 * math.pi) * _phase(move, right, up) for move in moves)
        sidewards, upwards = (sizes**2 - 1)[:, :, None, None].unbind(1)
        return sidewards * a**2 + upwards * b**2


def _phase(move: Tensor, right: Tensor, up: Tensor) -> Tensor:
    """Phases (B, R, C) [1/mrad] by a turn that moves light by (B, 2) [m/mrad]."""
    return 2 * math.pi * (move[:, 0, None, None] * right + move[:, 1, None, None] * up)
