"""The prior of mirror surfaces, estimated from measured mirrors.

Notes
-----
Heights are ``z = mean + sum c_k basis_k`` with coefficients c of unit variance times a scale.
Coefficients form groups: canting, focus, waviness from large to fine. Mirrors differ in the size of
each group, some many times, so each mirror has a scale for each group. A Gaussian whose variance
has an inverse gamma distribution is Student's t. It predicts mirrors that were left out far better
than one Gaussian for all (``python -m training.prior --compare``).

Mirrors of other types have a generic prior: canting errors, and waves of all lengths, as smooth as
bent glass and similar in all facets of a mirror. Facets have equal priors, so that its covariance
is one block for what facets share and another for what each has alone::

    cov(z_f, z_g) = alike B + delta_fg ((1 - alike) B + C)

with the bending B and the canting C of a facet, each (64, 64). Its directions are products of a
pattern over facets (all alike, or a contrast between them) and a shape of a facet. Images of many
facets determine few shapes of each: `MAX_DIRECTIONS` limits their number. Finer shapes are part of
the uncertainty, and of what refinement treats to first order (`SurfacePrior.fine`).

Refinement uses the prior. The network starts from its mean. A predicted surface far from it is not
of a known type.
"""

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checksums import read_verified
from model.plant import Heliostat
from model.surface import COLUMNS, FACETS, ROWS, greville, halving

Array = NDArray[np.float64]

LEADING = 8
"""Number of coefficients of Mahalanobis distances: those of the largest variances."""

GROUPS = (0, 4, 8, 24, 64, 128)
"""First coefficients of the groups with a scale each, of four facets; others have in proportion."""

FREEDOM = 3.0
"""Degrees of freedom of the scales: their prior has the weight of this number of coefficients."""

MAX_SCALE = 4.0
"""Largest scale of a group of drawn surfaces."""

MAX_DIRECTIONS = 480
"""Largest number of directions of a generic prior, which many facets share out among them."""

MIN_LENGTH = 1e-9
"""Standard deviation [m] below which a direction is none."""

N_TILTS = 2
"""Tilts of a plane."""

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

    @classmethod
    def of_slopes(cls, canting_mrad: float, slope_mrad: float) -> "FacetKind":
        """The usual kind with other spreads of canting and of the slopes of a facet [mrad].

        Both are standard deviations for each axis.
        """
        usual = cls()
        return replace(
            usual,
            canting=1e-3 * canting_mrad,
            # The slopes of Matern's process of smoothness 5/2 (`generic_covariance`).
            bending=1e-3 * slope_mrad * usual.reach / np.sqrt(5 / 3),
        )

    @classmethod
    def of_declared(cls, slope_error: float) -> "FacetKind":
        """The usual kind with all slopes in proportion to a declared slope error [rad].

        Zero is no declaration: the kind is the usual one.
        """
        usual = cls()
        if not slope_error:
            return usual
        factor = slope_error / usual.slope
        return replace(
            usual,
            canting=factor * usual.canting,
            bending=factor * usual.bending,
            grain=factor * usual.grain,
        )

    @property
    def slope(self) -> float:
        """Standard deviation of a facet's slopes along each side [rad]: canting and bending."""
        return float(np.hypot(self.canting, self.bending * np.sqrt(5 / 3) / self.reach))


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """A distribution of surfaces, Gaussian except for the scales of its `GROUPS`.

    Attributes
    ----------
    mean : (F, 8, 8) [m]
    basis : (K, F, 8, 8) [m]
        Orthogonal directions, each as long as its standard deviation; the longest first.
    hidden : (H, F, 8, 8) [m]
        Directions that no image shows, as long as their standard deviations: the tilts of the whole
        mirror.
    name : str
        Name of the file, with its content hash.
    shapes : (L, 8, 8) [m] or None
        Shapes of a facet that span the directions; None if those of each facet differ.
    fine : (N, 8, 8) [m]
        Shapes of a facet that are finer than the directions, as long as their standard deviations.
    """

    mean: Array
    basis: Array
    hidden: Array
    name: str = "unnamed"
    shapes: Array | None = None
    fine: Array = field(default_factory=lambda: np.zeros((0, ROWS, COLUMNS)))

    @property
    def groups(self) -> list[int]:
        """First coefficients of the groups with a scale each."""
        starts = sorted({start * len(self.mean) // FACETS for start in GROUPS})
        return [start for start in starts if start < len(self.basis)]

    @property
    def weights(self) -> Array | None:
        """Weights (K, F, L) of the `shapes` in the directions."""
        if self.shapes is None:
            return None
        flat = self.shapes.reshape(len(self.shapes), -1)
        return np.asarray(self.basis.reshape(*self.basis.shape[:2], -1) @ np.linalg.pinv(flat))

    @classmethod
    def load(
        cls, path: Path = PRIOR, read: Callable[[Path], bytes] = Path.read_bytes
    ) -> "SurfacePrior":
        """Read a prior of `training.prior` or `training.type_network`."""
        content = read(path)
        with np.load(io.BytesIO(content)) as data:
            name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
            known = {key: values.astype(np.float64) for key, values in data.items()}
            return cls(name=name, **known)

    def coefficients(self, z: Array) -> Array:
        """Coefficients (K,) of the surface of the prior's span nearest to ``z`` (F, 8, 8) [m]."""
        flat = self.basis.reshape(len(self.basis), -1)
        return np.asarray(flat @ (z - self.mean).ravel() / (flat**2).sum(axis=1))

    def surface(self, coefficients: Array) -> Array:
        """Heights (F, 8, 8) [m] of coefficients (K,)."""
        return np.asarray(self.mean + np.tensordot(coefficients, self.basis, axes=1))

    def precision(self, coefficients: Array, variance: Array) -> Array:
        """Precision (K,) of each coefficient, that of its group, for coefficients (K,) with a
        ``variance`` (K,).

        The mean of the scale's posterior, as in expectation-maximisation for Student's t (Lange,
        Little and Taylor 1989, doi:10.1080/01621459.1989.10478852).
        """
        starts = self.groups
        counts = np.diff([*starts, len(coefficients)])
        found = np.add.reduceat(coefficients**2 + variance, starts)
        return np.repeat((FREEDOM + counts) / (FREEDOM + found), counts)

    def mahalanobis(self, z: Array) -> float:
        """Mahalanobis distance of ``z`` (F, 8, 8) [m] from the mean, over the root of its `LEADING`
        degrees of freedom.

        The root mean square of the leading coefficients; about one for a mirror of the measured
        type.
        """
        return float(np.sqrt((self.coefficients(z)[:LEADING] ** 2).mean()))

    def deviation(self, covariance: Array) -> Array:
        """Standard deviation (F, 8, 8) [m] of heights by their coefficients' covariance (K, K)."""
        visible = np.einsum("kfij,kl,lfij->fij", self.basis, covariance, self.basis, optimize=True)
        unseen = (self.hidden**2).sum(axis=0) + (self.fine**2).sum(axis=0)
        return np.asarray(np.sqrt(visible + unseen))


def draw_surfaces(prior: SurfacePrior, count: int, rng: np.random.Generator) -> Array:
    """Draw surfaces (count, F, 8, 8) [m] of a prior, each group with a scale of Student's t."""
    sizes = np.diff([*prior.groups, len(prior.basis)])
    scales = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (count, len(sizes)))).clip(max=MAX_SCALE)
    coarse = scales.repeat(sizes, axis=1) * rng.standard_normal((count, len(prior.basis)))
    fine = rng.standard_normal((count, len(prior.mean), len(prior.fine)))
    return np.asarray(
        prior.mean
        + np.tensordot(coarse, prior.basis, axes=1)
        + np.tensordot(fine, prior.fine, axes=1)
    )


@lru_cache(maxsize=1)
def default_prior() -> SurfacePrior:
    """The shipped prior, loaded once; `WeightsError` if it is not that of its model card."""
    return SurfacePrior.load(read=read_verified)


def prior_of(heliostat: Heliostat) -> SurfacePrior:
    """The shipped prior for mirrors of the measured type, the generic one for all others.

    The latter has the slopes that the heliostat's type declares.
    """
    half_sizes = heliostat.facet_frames.half_sizes
    if of_measured_kind(half_sizes):
        return default_prior()
    return generic_prior(half_sizes, FacetKind.of_declared(heliostat.optics.slope_error))


def of_measured_kind(half_sizes: Array) -> bool:
    """Whether facets of half sides (F, 2) [m] are as many as the measured ones, of about their
    size.
    """
    near = np.abs(half_sizes / MEASURED_FACET - 1) <= SIZE_TOLERANCE
    return len(half_sizes) == FACETS and bool(near.all())


def generic_prior(half_sizes: Array, kind: FacetKind | None = None) -> SurfacePrior:
    """The prior of a mirror with facets, of half sides (F, 2) [m], of a type that was never
    measured.

    The tilt of the whole mirror is a parameter of the mount. The work is linear in the number of
    facets: principal directions are those of two blocks, each of one facet's heights.
    """
    count, kind, half = len(half_sizes), kind or FacetKind(), half_sizes.mean(axis=0)
    bending, alone = _facet_blocks(half, kind)
    shapes, fine = _facet_shapes(kind.alike * bending + alone, half, MAX_DIRECTIONS // count)
    shared, apart = (
        shapes @ block @ shapes.T for block in (count * kind.alike * bending + alone, alone)
    )
    shared[:N_TILTS], shared[:, :N_TILTS] = 0, 0
    patterns = ((np.full((1, count), count**-0.5), shared), (_contrasts(count), apart))
    mean = np.zeros((count, ROWS, COLUMNS))
    directions = np.concatenate(
        [
            np.einsum("pf,ks->kpfs", pattern, _deviations(block) @ shapes).reshape(-1, *mean.shape)
            for pattern, block in patterns
        ]
    )
    lengths = np.sqrt((directions**2).sum(axis=(1, 2, 3)))
    order = np.argsort(-lengths, kind="stable")
    return SurfacePrior(
        mean,
        directions[order][lengths[order] > MIN_LENGTH],
        np.zeros((0, *mean.shape)),
        "generic",
        shapes.reshape(-1, ROWS, COLUMNS),
        fine.reshape(-1, ROWS, COLUMNS),
    )


class _FacetShapes(NamedTuple):
    """Shapes (L, 64) of a facet, and finer ones (N, 64) [m]."""

    shapes: Array
    fine: Array


def _facet_shapes(covariance: Array, half: Array, count: int) -> _FacetShapes:
    """Shapes (L, 64) of a facet by the covariance (64, 64) of its heights, and finer ones (N, 64).

    The first are orthonormal: the `tilt_modes`, then principal directions, together up to
    ``count``. The finer ones are as long as their standard deviations.
    """
    tilts = tilt_modes(half).reshape(N_TILTS, -1)
    tilts /= np.linalg.norm(tilts, axis=1, keepdims=True)
    constant = np.full((1, tilts.shape[1]), tilts.shape[1] ** -0.5)
    rest = np.eye(tilts.shape[1]) - tilts.T @ tilts - constant.T @ constant
    values, axes = np.linalg.eigh(rest @ covariance @ rest)
    values, axes = (part[:N_TILTS:-1] for part in (values, axes.T))
    n_kept = max(count - N_TILTS, 1)
    fine = axes[n_kept:] * np.sqrt(values[n_kept:, None].clip(min=0))
    return _FacetShapes(np.concatenate([tilts, axes[:n_kept]]), fine)


def _deviations(covariance: Array) -> Array:
    """Principal directions (L, L), as rows one deviation long, of a covariance (L, L) [m2]."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.sqrt(values.clip(min=0))).T)


def _contrasts(count: int) -> Array:
    """Orthonormal contrasts (count - 1, count): each facet against the mean of those before it."""
    helmert = np.tril(np.ones((count, count)), -1)[1:] - np.diag(np.arange(count))[1:]
    return np.asarray(helmert / np.linalg.norm(helmert, axis=1, keepdims=True))


class _FacetBlocks(NamedTuple):
    """Covariances (64, 64) [m2] of a facet's bending, and of what it shares with no other."""

    bending: Array
    alone: Array


def _facet_blocks(half: Array, kind: FacetKind) -> _FacetBlocks:
    """Covariances (64, 64) [m2] of a facet's bending, and of what it has in common with no other.

    ``half`` (2,) [m] are its half sides.
    """
    side, (x, y) = 2 * np.sqrt(half.prod()), tilt_modes(half).reshape(2, -1)
    apart = np.sqrt(5) * np.hypot(x[:, None] - x, y[:, None] - y) / (kind.reach * side)
    bending = (kind.bending * side) ** 2 * (1 + apart + apart**2 / 3) * np.exp(-apart)
    canting = kind.canting**2 * (np.outer(x, x) + np.outer(y, y)) + (
        kind.grain * side
    ) ** 2 * np.eye(len(x))
    return _FacetBlocks(bending, (1 - kind.alike) * bending + canting)


def generic_covariance(half_sizes: Array, kind: FacetKind) -> Array:
    """Covariance (F 64, F 64) [m2] of the heights of facets of half sides (F, 2) [m].

    Heights are a Gaussian process with Matern's covariance of smoothness 5/2. Its spectrum falls as
    a power of the frequency, as that of polished and bent glass does (Church 1988,
    doi:10.1364/AO.27.001518; Rasmussen and Williams 2006, *Gaussian Processes for Machine
    Learning*, eq. 4.17). Lengths scale with the facets' side, slopes do not.
    """
    count = len(half_sizes)
    bending, alone = _facet_blocks(half_sizes.mean(axis=0), kind)
    shared = np.kron(np.full((count, count), kind.alike), bending)
    return np.asarray(shared + np.kron(np.eye(count), alone))


def ripple_shapes(half_sizes: Array) -> Array:
    """Shapes (N, 13, 13) [m] of a facet, of half sides (F, 2) [m], finer than 8 x 8 heights.

    Each control point of a grid with halved spans has a standard deviation `FacetKind.ripple`,
    without the part that the coarser grid explains.
    """
    side, kind = 2 * np.sqrt(half_sizes.mean(axis=0).prod()), FacetKind()
    return np.asarray(kind.ripple * side * _finer_modes())


def ripples(half_sizes: Array) -> Array:
    """Directions (F N, F, 13, 13) [m] of facets of half sides (F, 2) [m]: `ripple_shapes` of each
    facet.
    """
    shapes = ripple_shapes(half_sizes)
    each = np.einsum("fg,nij->fngij", np.eye(len(half_sizes)), shapes)
    return np.asarray(each.reshape(-1, len(half_sizes), *shapes.shape[1:]))


@lru_cache(maxsize=1)
def _finer_modes() -> Array:
    """Orthonormal heights (N, 13, 13) that no 8 x 8 heights can represent."""
    along = halving(ROWS), halving(COLUMNS)
    coarse = np.kron(*along)
    beyond = np.linalg.svd(coarse)[0][:, coarse.shape[1] :].T
    return np.asarray(beyond.reshape(-1, *map(len, along)))


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
        ((signs * singular)[:, None] * axes)[singular > MIN_LENGTH].reshape(
            -1, *directions.shape[1:]
        )
    )
