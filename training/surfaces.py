"""Training surfaces: the measured ones, split by heliostat, and their augmentation."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.prior import FREEDOM, tilt_modes, without
from model.surface import mirrored, split_canting

Array = NDArray[np.float64]

SPLIT = Path(__file__).parent / "split.json"
"""Names of the measured heliostats for training, for validation and for the final test.

Heliostats of ``surfaces-apart.json`` are excluded: their photographs are for tests, or show a
mirror of these tests.
"""


class MeasuredSurfaces(NamedTuple):
    """Control heights (N, 4, 8, 8) [m] and names of measured heliostats."""

    z: Array
    names: list[str]


class Partition(NamedTuple):
    """Indices of the heliostats for training, and of held-out ones."""

    training: list[int]
    held_out: list[int]


def load_surfaces(root: Path) -> MeasuredSurfaces:
    """Load the measured surfaces of ``root/surfaces.npz``."""
    with np.load(root / "surfaces.npz") as data:
        return MeasuredSurfaces(data["z"].astype(np.float64), [str(n) for n in data["names"]])


def split(names: Sequence[str]) -> dict[str, list[int]]:
    """Indices of heliostats in ``names`` by their part.

    The parts of `SPLIT` are "training", "validation" (to choose a network), "test" (to test it
    once) and "apart" (photographs for other tests).

    Raises
    ------
    InvalidInputError
        If a heliostat is not in exactly one part.
    """
    parts: dict[str, list[str]] = json.loads(SPLIT.read_text(encoding="utf-8"))
    listed = [name for part in parts.values() for name in part]
    wrong = {name for name in names if listed.count(name) != 1}
    if wrong:
        raise InvalidInputError(f"{SPLIT.name} must name {', '.join(sorted(wrong))} once")
    return {part: [i for i, name in enumerate(names) if name in own] for part, own in parts.items()}


def load_part(root: Path, part: str) -> MeasuredSurfaces:
    """Load the measured surfaces of one `split` part."""
    surfaces, names = load_surfaces(root)
    chosen = split(names)[part]
    return MeasuredSurfaces(surfaces[chosen], [names[i] for i in chosen])


def fold_of(names: Sequence[str], fold: int, folds: int) -> Partition:
    """Divide heliostats for one of ``folds`` folds.

    Heliostats of the part "apart" are in neither.

    Raises
    ------
    ValueError
        If there is no such fold.
    """
    if not 0 <= fold < folds:
        raise ValueError(f"fold must lie in [0, {folds}), got {fold}")
    apart = split(names)["apart"]
    used = [i for i in np.random.default_rng(7).permutation(len(names)).tolist() if i not in apart]
    held_out = used[fold::folds]
    return Partition(sorted(set(used) - set(held_out)), sorted(held_out))


def rotated(z: Array) -> Array:
    """Mirrors (..., 4, 8, 8), turned by 180 degrees about their normals.

    Source: Lewen et al. 2024.
    """
    return np.asarray(z[..., ::-1, ::-1, ::-1])


def with_symmetries(z: Array) -> Array:
    """Mirrors (N, 4, 8, 8), then mirrored, turned, and both: (4 N, 4, 8, 8)."""
    half_turned, across = rotated(z), mirrored(z)
    return np.concatenate([z, across, half_turned, rotated(across)])


@dataclass(frozen=True)
class Augmentation:
    """Limits of the differences between samples and measured surfaces.

    ``average`` is the share of samples that mix two or three heliostats. ``exchange`` is the share
    with facets from different heliostats. ``fresh`` is the share that is partly or wholly drawn
    from a Gaussian of the measured covariance, half of it facet by facet. Without it, the network
    could memorize some forty mirrors and their mixtures.

    Canting and waviness are scaled about the mean surface, each by a separate factor of at most
    ``roughest``. The factor's inverse square has a chi-squared distribution of ``freedom`` degrees,
    like the prior's scales (`model.prior`). ``tilt_mrad`` adds random canting. ``focus_mrad`` adds
    canting towards another focus: the measured heliostats AA28 and AA39 differ from the others in
    this way.
    """

    average: float = 0.6
    exchange: float = 0.3
    fresh: float = 0.6
    freedom: float = FREEDOM
    roughest: float = 4.0
    tilt_mrad: float = 0.15
    focus_mrad: float = 0.4

    def sample(self, surfaces: Array, count: int, rng: np.random.Generator) -> Array:
        """Draw random surfaces (count, 4, 8, 8) [m] from measured ones (N, 4, 8, 8)."""
        z = self._averaged(surfaces, count, rng)
        other = self._averaged(surfaces, count, rng)
        exchanged = (rng.random((count, 1, 1, 1)) < self.exchange) & (
            rng.random((count, 4, 1, 1)) < 0.5
        )
        z = self._freshened(np.where(exchanged, other, z), surfaces, rng)
        mean = surfaces.mean(axis=0)
        rough = sum(part * self._scales(count, rng) for part in split_canting(z - mean))
        return untilted(mean + rough + self._tilts(count, rng))

    def _scales(self, count: int, rng: np.random.Generator) -> Array:
        scales = np.sqrt(self.freedom / rng.chisquare(self.freedom, (count, 1, 1, 1)))
        return np.asarray(scales.clip(max=self.roughest))

    def _averaged(self, surfaces: Array, count: int, rng: np.random.Generator) -> Array:
        """Weighted averages of up to three surfaces, with their spread about the mean restored."""
        mean = surfaces.mean(axis=0)
        weights = rng.dirichlet(np.ones(3), count)
        single = rng.random(count) >= self.average
        weights[single] = [1.0, 0.0, 0.0]
        chosen = surfaces[rng.integers(len(surfaces), size=(count, 3))] - mean
        mixed = (
            np.einsum(
                "nk,nkfij->nfij", weights / np.linalg.norm(weights, axis=1, keepdims=True), chosen
            )
            + mean
        )
        mixed = np.where(rng.random((count, 1, 1, 1)) < 0.5, rotated(mixed), mixed)
        return np.where(rng.random((count, 1, 1, 1)) < 0.5, mirrored(mixed), mixed)

    def _freshened(self, z: Array, surfaces: Array, rng: np.random.Generator) -> Array:
        """Samples (count, 4, 8, 8) [m], some blended with Gaussian ones in random proportions."""
        mean = surfaces.mean(axis=0)
        seen = with_symmetries(surfaces - mean)
        whole, apart = (rng.standard_normal((len(z), facets, len(seen))) for facets in (1, 4))
        drawn = np.einsum("cfn,nfij->cfij", (whole + apart) / np.sqrt(2 * len(seen)), seen)
        share = rng.random((len(z), 1, 1, 1)) * (rng.random((len(z), 1, 1, 1)) < self.fresh)
        return np.asarray(mean + np.sqrt(1 - share**2) * (z - mean) + share * drawn)

    def _tilts(self, count: int, rng: np.random.Generator) -> Array:
        inward = np.array([[1, -1], [-1, -1], [1, 1], [-1, 1]])
        tilt = (
            rng.normal(0, self.tilt_mrad, (count, 4, 2))
            + rng.normal(0, self.focus_mrad, (count, 1, 2)) * inward
        )
        return np.asarray(np.einsum("nfk,kij->nfij", tilt * 1e-3, tilt_modes()))


def untilted(z: Array) -> Array:
    """Surfaces (..., 4, 8, 8) [m] without the tilt of the whole mirror.

    This tilt belongs to the mount.
    """
    return without(z, np.repeat(tilt_modes()[:, None], 4, axis=1))
