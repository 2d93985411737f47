"""The noise of flux images, and whitening: changes of images in units of their noise.

Notes
-----
A measured image differs from the traced one by ``N n + e``:

    n ~ N(0, I)    nuisance parameters of the camera, with directions N (`model.nuisances`)
    e ~ N(0, S)    all other errors, of the camera and of the model

S is diagonal in the cosine transform of the image divided by ``scale``, which grows with the root
of the flux: errors grow with the flux and come in patches. Each of `BANDS` of spatial frequency has
one standard deviation ``sigma``. The whitener W has ``W' W = (S + N N')^-1``. With the singular
value decomposition ``N' S^-1/2 = U D V``::

    W = (I - V' (I - (I + D^2)^-1/2) V) S^-1/2
"""

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import dct

from model.nuisances import nuisances, size_nuisance

Array = NDArray[np.float64]

BANDS = (3.0, 6.0, 10.0, 16.0, 24.0)
"""Upper ends of the bands of spatial frequency [half cycles per window]."""

# Derivatives that are whitened at once: their cosine transforms are several times as large.
_AT_ONCE = 16


class Whitener:
    """Whitens changes of M images whose noise has a standard deviation ``sigma`` in each band.

    Parameters
    ----------
    images : (M, R, R)
        Traced images, for S and N. They are not the measured ones, whose noise would be weighted by
        itself. They stay the same while a cost is minimized, or the cost would not be the one that
        was differentiated.
    sigma : (M, 5), or (1, 5) for equal images [of the peak]
    dark_share : float [of the peak]
        Flux above which the noise grows with the root of the flux.
    side : float [m]
        Width of the images.
    size_errors : (M,) [1]
        Relative standard deviations of that width.

    Attributes
    ----------
    bands : (n,)
        Index of the band of each mode of the cosine transform.
    """

    def __init__(
        self, images: Array, sigma: Array, dark_share: float, side: float, size_errors: Array
    ) -> None:
        peak, frequencies = images.max(axis=(1, 2), keepdims=True), np.arange(images.shape[-1])
        frequencies = frequencies[frequencies < BANDS[-1]]
        frequency = np.hypot(*np.meshgrid(frequencies, frequencies))
        self._is_used = frequency < BANDS[-1]
        self._cosines = dct(np.eye(images.shape[-1]), axis=0, norm="ortho")[frequencies]
        self.bands = np.digitize(frequency[self._is_used], BANDS)
        self._scale = peak * np.sqrt(np.clip(images / peak, 0, None) + dark_share)
        self._sigma = sigma[:, self.bands]
        seen = torch.as_tensor(images)
        free = nuisances(seen, side)
        if size_errors.any():
            sized = size_nuisance(seen) * torch.as_tensor(size_errors)[:, None, None]
            free = torch.cat([free, sized[:, None]], dim=1)
        scaled = self._divide_by_noise(free.numpy().swapaxes(0, 1))
        _, singular, self._directions = np.linalg.svd(scaled.swapaxes(0, 1), full_matrices=False)
        self._shrinkage = 1 - 1 / np.sqrt(1 + singular**2)

    def subset(self, places: Sequence[int]) -> "Whitener":
        """The whitener of some of the images."""
        some, rows = copy(self), list(places)
        some._scale, some._directions = self._scale[rows], self._directions[rows]
        some._shrinkage = self._shrinkage[rows]
        some._sigma = self._sigma[rows] if len(self._sigma) > 1 else self._sigma
        return some

    def __call__(self, changes: NDArray[Any]) -> NDArray[Any]:
        """Whiten changes (..., M, R, R) to independent ones (..., M, n) of unit variance."""
        if changes.ndim > 3 and len(changes) > _AT_ONCE:
            parts = (changes[i : i + _AT_ONCE] for i in range(0, len(changes), _AT_ONCE))
            return np.concatenate([self(part) for part in parts])
        white = self._divide_by_noise(changes)
        directions, shrinkage = (
            values.astype(changes.dtype) for values in (self._directions, self._shrinkage)
        )
        along = np.einsum("...mn,mdn->...md", white, directions, optimize=True) * shrinkage
        white -= np.einsum("...md,mdn->...mn", along, directions, optimize=True)
        return white

    def _divide_by_noise(self, changes: NDArray[Any]) -> NDArray[Any]:
        """S^-1/2 times changes: modes (..., M, n) of the cosine transform over their noise."""
        cosines, scale, sigma = (
            values.astype(changes.dtype) for values in (self._cosines, self._scale, self._sigma)
        )
        modes = cosines @ (changes / scale) @ cosines.T
        return np.asarray(modes[..., self._is_used] / sigma)
