"""The prior of a heliostat type: from measured mirrors of the type, or from its declared errors."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.plant import Heliostat
from model.prior import FacetKind, SurfacePrior, generic_prior, prior_of, tilt_modes, without
from model.surface import COLUMNS, ROWS, split_canting

Array = NDArray[np.float64]


def type_prior(heliostat: Heliostat, measured: Array) -> SurfacePrior:
    """Estimate the prior of mirrors like a heliostat's.

    Parameters
    ----------
    heliostat : Heliostat
        Any of the type.
    measured : (N, F, 8, 8) [m]
        Measured mirrors of the type. With none it is the prior that `prior_of` has for the type.
        A few mirrors determine a mean and the sizes of canting and waves. Their shapes are those of
        the generic prior.
    """
    if not len(measured):
        return prior_of(heliostat)
    half_sizes = heliostat.facet_frames.half_sizes
    flat = untilted(measured, half_sizes)
    # The prior mean of the ideal mirror counts as one more mirror.
    mean = flat.sum(axis=0) / (len(flat) + 1)
    kind = measured_kind(flat - mean, half_sizes)
    return replace(generic_prior(half_sizes, kind), mean=mean, name="measured")


def measured_kind(deviations: Array, half_sizes: Array) -> FacetKind:
    """The kind of facets with the slopes of deviations (N, F, 8, 8) [m] from a mean mirror.

    ``half_sizes`` (F, 2) [m] are those of the facets.
    """
    canting, waviness = split_canting(deviations)
    return FacetKind.of_slopes(
        1e3 * _slope(canting, half_sizes), max(1e3 * _slope(waviness, half_sizes), 1e-3)
    )


def _slope(heights: Array, half_sizes: Array) -> float:
    """Root mean square slope along one side [rad] of heights (N, F, 8, 8) [m]."""
    steps = 2 * half_sizes / (np.array([ROWS, COLUMNS]) - 3)
    # The inner control heights are evenly spaced; the outer ones are nearer to each other.
    inner = heights[..., 2:-2, 2:-2]
    squares = [
        (
            (
                inner.take(range(1, inner.shape[axis]), axis)
                - inner.take(range(inner.shape[axis] - 1), axis)
            )
            / steps[:, i, None, None]
        )
        ** 2
        for i, axis in enumerate((-2, -1))
    ]
    return float(np.sqrt(np.mean([part.mean() for part in squares])))


def untilted(z: Array, half_sizes: Array) -> Array:
    """Mirrors (N, F, 8, 8) [m] without the tilt of the whole mirror, which is the mount's."""
    z = z - z.mean(axis=(-2, -1), keepdims=True)
    tilts = np.repeat(tilt_modes(half_sizes.mean(axis=0))[:, None], z.shape[1], axis=1)
    return without(z, tilts)
