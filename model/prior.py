"""What mirrors are like before any image is seen: a distribution over surfaces, estimated from measured ones.

Its directions come in groups: canting, focus, waviness from large to fine. Mirrors differ in how much they have of
each, some many times the others: each group has a scale of its own, which each mirror tells. A Gaussian whose variance
has an inverse gamma distribution is Student's t; that predicts mirrors left out far better than one Gaussian for all
(``python -m training.prior --compare``).

Refinement starts from it and is held to it, the network's first guess is its mean, and a predicted surface that lies
far from it is no mirror of the kind that is known.
"""

import hashlib
import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.plant import Heliostat
from model.surface import COLUMNS, ROWS, greville

Array = NDArray[np.float64]

LEADING = 8
"""Directions of the prior in which Mahalanobis distances are taken: the longest, which every image shows."""

GROUPS = (0, 4, 8, 24, 64, 128)
"""First directions of the groups that have a scale each."""

FREEDOM = 3.0
"""Degrees of freedom of the scales: as much is known of them before a mirror is seen as so many coefficients tell."""

CANTING = 0.8e-3
"""Slope [rad] along each axis by which facets are canted wrong, where no mirror of the kind was measured."""

WAVINESS = 7e-5
"""Height per side of a facet of its largest waves, where no mirror of the kind was measured."""

FALL = 1.25
"""Power of the spatial frequency with which waves become lower."""

KNOWN_SIZE = (0.8025, 0.6375)
"""Half sides [m] of the facets whose surfaces were measured: Juelich's."""

PRIOR = Path(__file__).parent / "weights" / "surface-prior.npz"


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """A distribution over surfaces, Gaussian but for the scales of its `GROUPS`.

    Attributes
    ----------
    mean : (4, 8, 8) [m]
    basis : (K, 4, 8, 8) [m]
        Orthogonal directions, each as long as its standard deviation; the longest first.
    hidden : (H, 4, 8, 8) [m]
        Directions that no image shows, as long as their standard deviations: the tilts of the whole mirror.
    name : str
        Which file, with its content hash.
    """

    mean: Array
    basis: Array
    hidden: Array
    name: str = "unnamed"

    @classmethod
    def load(cls, path: Path = PRIOR) -> "SurfacePrior":
        """Read a prior that `training.prior` wrote."""
        content = path.read_bytes()
        with np.load(io.BytesIO(content)) as data:
            name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
            mean, basis, hidden = (data[key].astype(np.float64) for key in ("mean", "basis", "hidden"))
            return cls(mean, basis, hidden, name)

    def coefficients(self, z: Array) -> Array:
        """Coefficients (K,) of the surface of the prior's span nearest to ``z`` (4, 8, 8) [m]."""
        flat = self.basis.reshape(len(self.basis), -1)
        return np.asarray(flat @ (z - self.mean).ravel() / (flat**2).sum(axis=1))

    def surface(self, coefficients: Array) -> Array:
        """Heights (4, 8, 8) [m] of coefficients (K,)."""
        return np.asarray(self.mean + np.tensordot(coefficients, self.basis, axes=1))

    def precision(self, coefficients: Array, variance: Array) -> Array:
        """Precision (K,) of each coefficient, its group's, where coefficients (K,) are known up to a variance (K,).

        The mean of the scale's posterior, as expectation-maximisation has it for Student's t (Lange, Little and Taylor
        1989, doi:10.1080/01621459.1989.10478852).
        """
        starts = [start for start in GROUPS if start < len(coefficients)]
        counts = np.diff([*starts, len(coefficients)])
        found = np.add.reduceat(coefficients**2 + variance, starts)
        return np.repeat((FREEDOM + counts) / (FREEDOM + found), counts)

    def mahalanobis(self, z: Array) -> float:
        """Mahalanobis distance of ``z`` (4, 8, 8) [m] from the mean, over the root of its `LEADING` degrees of freedom.

        The root mean square of its leading coefficients; about one for a mirror of the kind that the prior was
        estimated from.
        """
        return float(np.sqrt((self.coefficients(z)[:LEADING] ** 2).mean()))

    def deviation(self, covariance: Array) -> Array:
        """Standard deviation (4, 8, 8) [m] of heights whose coefficients have a covariance (K, K)."""
        shown = np.einsum("kfij,kl,lfij->fij", self.basis, covariance, self.basis, optimize=True)
        return np.asarray(np.sqrt(shown + (self.hidden**2).sum(axis=0)))


@lru_cache(maxsize=1)
def default_prior() -> SurfacePrior:
    """The shipped prior, loaded once."""
    return SurfacePrior.load()


def prior_of(heliostat: Heliostat) -> SurfacePrior:
    """The shipped prior for facets of the measured kind, the generic one for all others."""
    _, _, half_sizes = heliostat.facet_frames
    return default_prior() if np.allclose(half_sizes, KNOWN_SIZE, rtol=0.1) else generic_prior(half_sizes)


def generic_prior(half_sizes: Array) -> SurfacePrior:
    """What is known of facets of half sides (F, 2) [m] of which none was measured.

    They are canted wrong by `CANTING`, and their waves, cosines along x and y, fall with their frequency as polished
    and bent glass has it: a power law (Church 1988, doi:10.1364/AO.27.001518). The tilt of the whole mirror is left to
    the mount.
    """
    u, v = (greville(count) for count in (ROWS, COLUMNS))
    waves = np.einsum(
        "ai,bj->abij", np.cos(np.pi * np.arange(ROWS)[:, None] * u), np.cos(np.pi * np.arange(COLUMNS)[:, None] * v)
    ).reshape(-1, ROWS, COLUMNS)
    frequency = np.hypot(*np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))).ravel()
    x, y = np.meshgrid(2 * u - 1, 2 * v - 1, indexing="ij")
    facets = len(half_sizes)
    basis = np.zeros((facets, len(waves) + 1, facets, ROWS, COLUMNS))
    for facet, (half_x, half_y) in enumerate(half_sizes):
        side = 2 * np.sqrt(half_x * half_y)
        wavy = WAVINESS * side * frequency[1:, None, None] ** -FALL * waves[1:]
        basis[facet, :, facet] = np.concatenate([CANTING * np.stack([half_x * x, half_y * y]), wavy])
    flat = basis.reshape(-1, facets, ROWS, COLUMNS)
    flat = flat - flat.mean(axis=(2, 3), keepdims=True)
    tilts = np.stack([np.stack([half[0] * x, half[1] * y]) for half in half_sizes], axis=1)
    return SurfacePrior(np.zeros(flat.shape[1:]), orthogonal(without(flat, tilts)), CANTING * tilts, "generic")


def without(directions: Array, modes: Array) -> Array:
    """Directions (K, F, I, J) [m] without what modes (N, F, I, J) explain of them."""
    flat, explained = directions.reshape(len(directions), -1), modes.reshape(len(modes), -1)
    return np.asarray((flat - flat @ np.linalg.pinv(explained) @ explained).reshape(directions.shape))


def orthogonal(directions: Array) -> Array:
    """Orthogonal directions (K, F, I, J) [m] of the same covariance, the longest first, their largest height up."""
    flat = directions.reshape(len(directions), -1)
    _, singular, axes = np.linalg.svd(flat, full_matrices=False)
    signs = np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])
    return np.asarray(((signs * singular)[:, None] * axes)[singular > 1e-9].reshape(-1, *directions.shape[1:]))
