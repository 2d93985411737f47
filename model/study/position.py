"""Where spots lie beside where their motors sent them, as a part of what photographs say for or against a model.

A photograph whose mount's angles are known (`Setup.angles`) tells two things: the shape of its light, and where it
went. An encoder that is off, a clock, a tilted foundation and a leaning pylon hardly change shapes, and each moves
spots in another way. What they say is held against the mount that is declared: as surveyed, or as calibrated by
photographs *of another time*. A calibration has axes, zeros and drives of its own free, which take in whatever moved
the spots that it saw; so those photographs must not be given angles, or they would speak twice, and on calibrated
mounts effects are sought only since the first photograph thereafter (`model.forecast.altered`).

What a calibration leaves open moves the spots of all photographs of its mount together, and would pass for an effect
that begins with the first of them. So residuals are whitened by the covariance that the mount's own parameters give
them (`whitened`): what these could have done speaks for nothing else.

Fits count the residual [rad] in its standard deviations beside the pixels. Judges count what is left by the likelihood
of Student's t, for real spots are now and then another heliostat's, and weigh it against accuracy by `NAT`.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

USUAL_RAD = 1e-3
"""Standard deviation [rad] per direction of real spots about forecasts by calibrated mounts of other photographs."""

TAILS = 4.0
"""Degrees of freedom of Student's t."""

NAT = 0.01
"""Accuracy [1] that a photograph's gain of one nat by position is worth.

With it the least gain that studies ask for is a displacement of about one standard deviation.
"""

EXPECTED = 1.084
"""Loss [nat] of residuals that are normal: (TAILS / 2 + 1) E ln(1 + x / TAILS), with x chi-squared of two degrees."""


def whitened(off: Array, doubts: Array) -> Array:
    """Residuals (n, 2) of one mount, of unit variance beside doubts (n, 2, K) that they share, made independent.

    ``doubts`` are what each of K independent deviations of the mount's parameters moves them by, in the same units.
    The symmetric root of the precision leaves each residual as nearly as can be what it was.
    """
    shared = doubts.reshape(off.size, -1)
    vectors, sizes, _ = np.linalg.svd(shared, full_matrices=False)
    flat = off.ravel()
    return np.asarray((flat + vectors @ ((1 / np.hypot(1, sizes) - 1) * (vectors.T @ flat))).reshape(off.shape))


def loss(off: Array) -> Array:
    """Loss [nat] (N,) by residuals (N, 2) in standard deviations, less a constant; zero where they are not known."""
    square = np.nan_to_num((off**2).sum(axis=-1))
    return np.asarray((TAILS / 2 + 1) * np.log1p(square / TAILS))


def is_known(off: Array) -> NDArray[np.bool_]:
    """Where (N,) residuals (N, 2) are known."""
    return np.asarray(np.isfinite(off).all(axis=-1))
