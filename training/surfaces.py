"""Surfaces to learn from: the measured ones, split by heliostat, and what augmentation makes of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.surface import greville, mirrored, split_canting

Array = NDArray[np.float64]


def load_surfaces(root: Path) -> tuple[Array, list[str]]:
    """Control heights (N, 4, 8, 8) [m] of measured heliostats and their names, from ``root/surfaces.npz``."""
    with np.load(root / "surfaces.npz") as data:
        return data["z"].astype(np.float64), [str(name) for name in data["names"]]


def split_by_heliostat(
    count: int, held_out: int, seed: int, fold: int = 0
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the training and the held-out heliostats; every heliostat is held out in one fold.

    Raises
    ------
    ValueError
        Where the fold leaves no heliostat to hold out.
    """
    order = np.random.default_rng(seed).permutation(count)
    apart = order[fold * held_out : (fold + 1) * held_out]
    if fold < 0 or not len(apart):
        raise ValueError(f"fold must lie in [0, {-(-count // held_out)}), got {fold}")
    return np.setdiff1d(order, apart), np.sort(apart)


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
    of it facet by facet: some forty mirrors and their mixtures could be learnt by heart. ``canting`` and ``waviness``
    scale the two parts of the surface apart by up to that factor either way, ``tilt_mrad`` adds canting at random,
    ``focus_mrad`` canting towards another focus: the measured heliostats AA28 and AA39 lie off the others there, by
    what their properties call ideal.
    """

    average: float = 0.6
    exchange: float = 0.3
    fresh: float = 0.6
    canting: float = 1.4
    waviness: float = 1.3
    tilt_mrad: float = 0.15
    focus_mrad: float = 0.4

    def sample(self, surfaces: Array, count: int, rng: np.random.Generator) -> Array:
        """Random surfaces (count, 4, 8, 8) [m] from measured ones (N, 4, 8, 8)."""
        z = self._averaged(surfaces, count, rng)
        other = self._averaged(surfaces, count, rng)
        exchanged = (rng.random((count, 1, 1, 1)) < self.exchange) & (rng.random((count, 4, 1, 1)) < 0.5)
        z = self._freshened(np.where(exchanged, other, z), surfaces, rng)
        canting, waviness = split_canting(z)
        scale_canting, scale_waviness = (
            np.exp(rng.uniform(-1, 1, (count, 1, 1, 1)) * np.log(limit)) for limit in (self.canting, self.waviness)
        )
        return untilted(canting * scale_canting + waviness * scale_waviness + self._tilts(count, rng))

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


def tilt_modes() -> Array:
    """Heights (2, 8, 8) [m] of one radian of slope along a facet's x and y (Juelich's facets)."""
    x, y = np.meshgrid(0.8025 * (2 * greville(8) - 1), 0.6375 * (2 * greville(8) - 1), indexing="ij")
    return np.stack([x, y])


def untilted(z: Array) -> Array:
    """Surfaces (..., 4, 8, 8) [m] without the tilt of the whole mirror, which is the mount's and not the surface's."""
    modes = np.repeat(tilt_modes()[:, None], 4, axis=1).reshape(2, -1)
    flat = z.reshape(*z.shape[:-3], -1)
    return np.asarray((flat - flat @ np.linalg.pinv(modes) @ modes).reshape(z.shape))
