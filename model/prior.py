"""The prior of mirror surfaces, estimated from measured mirrors.

Notes
-----
Heights are ``z = mean + sum c_k basis_k`` with coefficients c of unit variance times a scale.
Coefficients form groups: canting, focus, waviness from large to fine. Mirrors differ in the size of
each group, some many times, so each mirror has a scale for each group. A Gaussian whose variance
has an inverse gamma distribution is Student's t. It predicts mirrors that were left out far better
than one Gaussian for all (``python -m training.prior --compare``).

Facets of other types have a generic prior: canting errors, and waves of all lengths, as smooth as
bent glass and similar in all facets of a mirror.

Refinement uses the prior. The network starts from its mean. A predicted surface far from it is not
of a known type.
"""

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checksums import read_verified
from model.plant import Heliostat
from model.surface import COLUMNS, ROWS, greville, halving

Array = NDArray[np.float64]

LEADING = 8
"""Number of coefficients of Mahalanobis distances: those of the largest variances."""

GROUPS = (0, 4, 8, 24, 64, 128)
"""First coefficients of the groups with a scale each."""

FREEDOM = 3.0
"""Degrees of freedom of the scales: their prior has the weight of this number of coefficients."""

MEASURED_FACET = (0.8025, 0.6375)
"""Half sides [m] of the facets whose surfaces were measured: those of Juelich."""

SIZE_TOLERANCE = 0.2
"""Relative difference of size up to which a facet is of the measured type."""

PRIOR = Path(__file__).parent / "weights" / "surface-prior.npz"


@dataclass(frozen=True)
class FacetKind:
    """Errors of facets that were never measured; most probable for Juelich's (``python -m
    training.prior --generic``).

    Lengths are relative to the side of the facet.

    Attributes
    ----------
    canting : float [rad]
        Slope along each side by which facets are canted wrong.
    bending, reach : float
        Standard deviation of a height, and correlation length.
    grain : float
        Independent standard deviation of each control point.
    alike : float
        Share of the bending that all facets of a mirror have in common, from production and
        mounting.
    ripple : float
        Standard deviation of each control point of a grid with halved spans, as in the
        deflectometry of AA28 and AC43 (``python -m training.fit``).
    """

    canting: float = 0.73e-3
    bending: float = 0.61e-3
    reach: float = 0.57
    grain: float = 3.2e-5
    alike: float = 0.7
    ripple: float = 5.6e-5


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """A distribution of surfaces, Gaussian except for the scales of its `GROUPS`.

    Attributes
    ----------
    mean : (4, 8, 8) [m]
    basis : (K, 4, 8, 8) [m]
        Orthogonal directions, each as long as its standard deviation; the longest first.
    hidden : (H, 4, 8, 8) [m]
        Directions that no image shows, as long as their standard deviations: the tilts of the whole
        mirror.
    name : str
        Name of the file, with its content hash.
    """

    mean: Array
    basis: Array
    hidden: Array
    name: str = "unnamed"

    @classmethod
    def load(
        cls, path: Path = PRIOR, read: Callable[[Path], bytes] = Path.read_bytes
    ) -> "SurfacePrior":
        """Read a prior of `training.prior`."""
        content = read(path)
        with np.load(io.BytesIO(content)) as data:
            name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
            mean, basis, hidden = (
                data[key].astype(np.float64) for key in ("mean", "basis", "hidden")
            )
            return cls(mean, basis, hidden, name)

    def coefficients(self, z: Array) -> Array:
        """Coefficients (K,) of the surface of the prior's span nearest to ``z`` (4, 8, 8) [m]."""
        flat = self.basis.reshape(len(self.basis), -1)
        return np.asarray(flat @ (z - self.mean).ravel() / (flat**2).sum(axis=1))

    def surface(self, coefficients: Array) -> Array:
        """Heights (4, 8, 8) [m] of coefficients (K,)."""
        return np.asarray(self.mean + np.tensordot(coefficients, self.basis, axes=1))

    def precision(self, coefficients: Array, variance: Array) -> Array:
        """Precision (K,) of each coefficient, that of its group, for coefficients (K,) with a
        ``variance`` (K,).

        The mean of the scale's posterior, as in expectation-maximisation for Student's t (Lange,
        Little and Taylor 1989, doi:10.1080/01621459.1989.10478852).
        """
        starts = [start for start in GROUPS if start < len(coefficients)]
        counts = np.diff([*starts, len(coefficients)])
        found = np.add.reduceat(coefficients**2 + variance, starts)
        return np.repeat((FREEDOM + counts) / (FREEDOM + found), counts)

    def mahalanobis(self, z: Array) -> float:
        """Mahalanobis distance of ``z`` (4, 8, 8) [m] from the mean, over the root of its `LEADING`
        degrees of freedom.

        The root mean square of the leading coefficients; about one for a mirror of the measured
        type.
        """
        return float(np.sqrt((self.coefficients(z)[:LEADING] ** 2).mean()))

    def deviation(self, covariance: Array) -> Array:
        """Standard deviation (4, 8, 8) [m] of heights by their coefficients' covariance (K, K)."""
        visible = np.einsum("kfij,kl,lfij->fij", self.basis, covariance, self.basis, optimize=True)
        return np.asarray(np.sqrt(visible + (self.hidden**2).sum(axis=0)))


@lru_cache(maxsize=1)
def default_prior() -> SurfacePrior:
    """The shipped prior, loaded once; `WeightsError` if it is not that of its model card."""
    return SurfacePrior.load(read=read_verified)


def prior_of(heliostat: Heliostat) -> SurfacePrior:
    """The shipped prior for facets of the measured type, the generic one for all others."""
    half_sizes = heliostat.facet_frames.half_sizes
    return default_prior() if of_measured_kind(half_sizes) else generic_prior(half_sizes)


def of_measured_kind(half_sizes: Array) -> bool:
    """Whether facets of half sides (F, 2) [m] have about the size of the measured ones."""
    return bool((np.abs(half_sizes / MEASURED_FACET - 1) <= SIZE_TOLERANCE).all())


def generic_prior(half_sizes: Array) -> SurfacePrior:
    """The prior of a mirror with facets, of half sides (F, 2) [m], of a type that was never
    measured.

    The tilt of the whole mirror is a parameter of the mount.
    """
    count, half = len(half_sizes), half_sizes.mean(axis=0)
    directions = principal(generic_covariance(half_sizes, FacetKind()), count)
    directions -= directions.mean(axis=(2, 3), keepdims=True)
    tilts = np.repeat(tilt_modes(half)[:, None], count, axis=1)
    mean, nothing = np.zeros_like(tilts[0]), np.zeros_like(tilts[:0])
    return SurfacePrior(mean, orthogonal(without(directions, tilts)), nothing, "generic")


def generic_covariance(half_sizes: Array, kind: FacetKind) -> Array:
    """Covariance (F 64, F 64) [m2] of the heights of facets of half sides (F, 2) [m].

    Heights are a Gaussian process with Matern's covariance of smoothness 5/2. Its spectrum falls as
    a power of the frequency, as that of polished and bent glass does (Church 1988,
    doi:10.1364/AO.27.001518; Rasmussen and Williams 2006, *Gaussian Processes for Machine
    Learning*, eq. 4.17). Lengths scale with the facets' side, slopes do not.
    """
    count, half = len(half_sizes), half_sizes.mean(axis=0)
    side, (x, y) = 2 * np.sqrt(half.prod()), tilt_modes(half).reshape(2, -1)
    apart = np.sqrt(5) * np.hypot(x[:, None] - x, y[:, None] - y) / (kind.reach * side)
    bending = (kind.bending * side) ** 2 * (1 + apart + apart**2 / 3) * np.exp(-apart)
    canting = kind.canting**2 * (np.outer(x, x) + np.outer(y, y)) + (
        kind.grain * side
    ) ** 2 * np.eye(len(x))
    shared = np.kron(np.full((count, count), kind.alike), bending)
    return np.asarray(shared + np.kron(np.eye(count), (1 - kind.alike) * bending + canting))


def ripples(half_sizes: Array) -> Array:
    """Directions (N, F, 13, 13) [m] of facets of half sides (F, 2) [m] that are finer than 8 x 8
    heights.

    Each control point of a grid with halved spans has a standard deviation `FacetKind.ripple`,
    without the part that the coarser grid explains.
    """
    side, kind = 2 * np.sqrt(half_sizes.mean(axis=0).prod()), FacetKind()
    return np.asarray(kind.ripple * side * _finer_modes(len(half_sizes)))


@lru_cache(maxsize=4)
def _finer_modes(facets: int) -> Array:
    """Orthonormal heights (N, F, 13, 13) that no 8 x 8 heights of the facets can represent."""
    along = halving(ROWS), halving(COLUMNS)
    coarse = np.kron(*along)
    beyond = np.linalg.svd(coarse)[0][:, coarse.shape[1] :].T
    return np.asarray(np.kron(np.eye(facets), beyond).reshape(-1, facets, *map(len, along)))


def tilt_modes(half_size: ArrayLike = MEASURED_FACET) -> Array:
    """Heights (2, 8, 8) [m] of one radian of slope along x and y of a facet of half sides (2,) [m].

    They are those of its control points.
    """
    sides = np.asarray(half_size, dtype=np.float64)
    along = (
        half * (2 * greville(count) - 1) for half, count in zip(sides, (ROWS, COLUMNS), strict=True)
    )
    return np.stack(np.meshgrid(*along, indexing="ij"))


def principal(covariance: Array, facets: int) -> Array:
    """Principal directions (K, F, 8, 8) [m] of a covariance (K, K) [m2], one deviation long."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.sqrt(values.clip(min=0))).T.reshape(-1, facets, ROWS, COLUMNS))


def without(directions: Array, modes: Array) -> Array:
    """Directions (..., F, I, J) [m] without the part that modes (N, F, I, J) explain."""
    flat, explained = directions.reshape(*directions.shape[:-3], -1), modes.reshape(len(modes), -1)
    return np.asarray(
        (flat - flat @ np.linalg.pinv(explained) @ explained).reshape(directions.shape)
    )


def orthogonal(directions: Array) -> Array:
    """Orthogonal directions (K, F, I, J) [m] of equal covariance, longest first."""
    flat = directions.reshape(len(directions), -1)
    _, singular, axes = np.linalg.svd(flat, full_matrices=False)
    # Symmetric directions have two or four largest heights, equal except for rounding: the first
    # one counts.
    largest = np.abs(axes) > (1 - 1e-6) * np.abs(axes).max(axis=1, keepdims=True)
    signs = np.sign(axes[np.arange(len(axes)), largest.argmax(axis=1)])
    return np.asarray(
        ((signs * singular)[:, None] * axes)[singular > 1e-9].reshape(-1, *directions.shape[1:])
    )
