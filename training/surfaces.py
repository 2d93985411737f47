"""Surfaces to learn from: the measured ones, split by heliostat, and what augmentation makes of them."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.prior import FREEDOM, tilt_modes, without
from model.surface import mirrored, split_canting

Array = NDArray[np.float64]

SPLIT = Path(__file__).parent / "split.json"
"""Which measured heliostats the network learns from, which choose among networks, which judge the one that was chosen.

Those of ``surfaces-apart.json`` take no part: their photographs are kept for tests, or show a mirror of these tests.
"""


def load_surfaces(root: Path) -> tuple[Array, list[str]]:
    """Control heights (N, 4, 8, 8) [m] of measured heliostats and their names, from ``root/surfaces.npz``."""
    with np.load(root / "surfaces.npz") as data:
        return data["z"].astype(np.float64), [str(name) for name in data["names"]]


def split(names: Sequence[str]) -> dict[str, list[int]]:
    """Indices of heliostats in ``names`` by their part: "training", "validation" (chooses), "test" (judges once).

    `SPLIT` tells them by name. It also tells which are "apart": their photographs judge elsewhere.

    Raises
    ------
    InvalidInputError
        Where a heliostat has not exactly one part.
    """
    parts: dict[str, list[str]] = json.loads(SPLIT.read_text(encoding="utf-8"))
    told = [name for part in parts.values() for name in part]
    unsure = {name for name in names if told.count(name) != 1}
    if unsure:
        raise InvalidInputError(f"{SPLIT.name} must name {', '.join(sorted(unsure))} once")
    return {part: [i for i, name in enumerate(names) if name in own] for part, own in parts.items()}


def load_part(root: Path, part: str) -> tuple[Array, list[str]]:
    """Surfaces (N, 4, 8, 8) [m] and names of the heliostats of one part of the `split`."""
    surfaces, names = load_surfaces(root)
    chosen = split(names)[part]
    return surfaces[chosen], [names[i] for i in chosen]


def fold_of(names: Sequence[str], fold: int, folds: int) -> tuple[list[int], list[int]]:
    """Indices of heliostats to learn from and of those held out in one of so many folds; none that are apart.

    Raises
    ------
    ValueError
        Where there is no such fold.
    """
    if not 0 <= fold < folds:
        raise ValueError(f"fold must lie in [0, {folds}), got {fold}")
    apart = split(names)["apart"]
    used = [i for i in np.random.default_rng(7).permutation(len(names)).tolist() if i not in apart]
    held_out = used[fold::folds]
    return sorted(set(used) - set(held_out)), sorted(held_out)


def rotated(z: Array) -> Array:
    """The same mirrors (..., 4, 8, 8) turned by 180 degrees about their normals (Lewen et al. 2024)."""
    return np.asarray(z[..., ::-1, ::-1, ::-1])


def with_symmetries(z: Array) -> Array:
    """Mirrors (N, 4, 8, 8), then the same mirrored, turned, and both: (4 N, 4, 8, 8)."""
    half_turned, across = rotated(z), mirrored(z)
    return np.concatenate([z, across, half_turned, rotated(across)])


@dataclass(frozen=True)
class Augmentation:
    """How far samples may stray from the measured surfaces.

    ``average`` is the share of samples that mix two or three heliostats, ``exchange`` the share whose facets come from
    different ones, ``fresh`` the share that is partly or wholly drawn from a Gaussian of the measured covariance, half
    of it facet by facet: some forty mirrors and their mixtures could be learnt by heart. Canting and waviness are
    scaled about the mean surface, each by a factor of its own, whose inverse square has a chi-squared distribution of
    ``freedom`` degrees as the prior's scales have (`model.prior`), ``roughest`` at most. ``tilt_mrad`` adds canting at
    random, ``focus_mrad`` canting towards another focus: the measured heliostats AA28 and AA39 lie off the others
    there, by what their properties call ideal.
    """

    average: float = 0.6
    exchange: float = 0.3
    fresh: float = 0.6
    freedom: float = FREEDOM
    roughest: float = 4.0
    tilt_mrad: float = 0.15
    focus_mrad: float = 0.4

    def sample(self, surfaces: Array, count: int, rng: np.random.Generator) -> Array:
        """Random surfaces (count, 4, 8, 8) [m] from measured ones (N, 4, 8, 8)."""
        z = self._averaged(surfaces, count, rng)
        other = self._averaged(surfaces, count, rng)
        exchanged = (rng.random((count, 1, 1, 1)) < self.exchange) & (rng.random((count, 4, 1, 1)) < 0.5)
        z = self._freshened(np.where(exchanged, other, z), surfaces, rng)
        mean = surfaces.mean(axis=0)
        rough = sum(part * self._scales(count, rng) for part in split_canting(z - mean))
        return untilted(mean + rough + self._tilts(count, rng))

    def _scales(self, count: int, rng: np.random.Generator) -> Array:
        scales = np.sqrt(self.freedom / rng.chisquare(self.freedom, (count, 1, 1, 1)))
        return np.asarray(scales.clip(max=self.roughest))

    def _averaged(self, surfaces: Array, count: int, rng: np.random.Generator) -> Array:
        """Weighted averages of up to three surfaces, their spread about the mean restored."""
        mean = surfaces.mean(axis=0)
        weights = rng.dirichlet(np.ones(3), count)
        single = rng.random(count) >= self.average
        weights[single] = [1.0, 0.0, 0.0]
        chosen = surfaces[rng.integers(len(surfaces), size=(count, 3))] - mean
        mixed = np.einsum("nk,nkfij->nfij", weights / np.linalg.norm(weights, axis=1, keepdims=True), chosen) + mean
        mixed = np.where(rng.random((count, 1, 1, 1)) < 0.5, rotated(mixed), mixed)
        return np.where(rng.random((count, 1, 1, 1)) < 0.5, mirrored(mixed), mixed)

    def _freshened(self, z: Array, surfaces: Array, rng: np.random.Generator) -> Array:
        """Samples (count, 4, 8, 8) [m], some of them blended with Gaussian ones in any proportion."""
        mean = surfaces.mean(axis=0)
        seen = with_symmetries(surfaces - mean)
        whole, apart = (rng.standard_normal((len(z), facets, len(seen))) for facets in (1, 4))
        drawn = np.einsum("cfn,nfij->cfij", (whole + apart) / np.sqrt(2 * len(seen)), seen)
        share = rng.random((len(z), 1, 1, 1)) * (rng.random((len(z), 1, 1, 1)) < self.fresh)
        return np.asarray(mean + np.sqrt(1 - share**2) * (z - mean) + share * drawn)

    def _tilts(self, count: int, rng: np.random.Generator) -> Array:
        inward = np.array([[1, -1], [-1, -1], [1, 1], [-1, 1]])
        tilt = rng.normal(0, self.tilt_mrad, (count, 4, 2)) + rng.normal(0, self.focus_mrad, (count, 1, 2)) * inward
        return np.asarray(np.einsum("nfk,kij->nfij", tilt * 1e-3, tilt_modes()))


def untilted(z: Array) -> Array:
    """Surfaces (..., 4, 8, 8) [m] without the tilt of the whole mirror, which is the mount's and not the surface's."""
    return without(z, np.repeat(tilt_modes()[:, None], 4, axis=1))
