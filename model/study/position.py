"""Offsets of spots from where their motors sent them, as evidence for or against a model.

A photograph with known mount angles (`Setup.angles`) has two kinds of information: the shape of its
spot and the position. An encoder offset, a clock error, a tilted foundation and a leaning pylon
hardly change the shape, but each moves spots in a different way. The positions are compared with
the declared mount: as surveyed, or as calibrated by photographs *of another time*. A calibration
fits axes, zeros and drives, so it absorbs whatever moved the spots that it used. Those photographs
must not have angles, or they would count twice. On calibrated mounts, effects are therefore
searched only from the first later photograph on (`model.forecast.apply_mount_effects`).

The remaining uncertainty of a calibration moves the spots of all photographs of its mount together.
It could be mistaken for an effect that begins with the first of them. So the residuals are whitened
by the covariance that results from the mount's parameters (`whiten`): shifts that these parameters
can explain are no evidence for an effect.

Fits add the residual, in standard deviations, to the residuals of the pixels. Held-out images are
judged by the likelihood of Student's t, because some real spots belong to another heliostat. `NAT`
weighs this likelihood against accuracy.

Notes
-----
::

    off ~ N(0, 1 + S S')              residuals in USUAL_RAD; S shifts by the mount's parameters
    whitened = (1 + S S')**(-1/2) off                                           (`whiten`)
    loss = (TAILS / 2 + 1) ln(1 + |off|**2 / TAILS)   [nat], Student's t in 2D  (`loss`)
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

USUAL_RAD = 1e-3
"""Standard deviation [rad] per direction of real spots about forecasts by calibrated mounts."""

TAILS = 4.0
"""Degrees of freedom of Student's t."""

NAT = 0.01
"""Accuracy [1] that a photograph's gain of one nat by position is worth.

With it the least gain that studies ask for is a displacement of about one standard deviation.
"""

EXPECTED = 1.084
"""Loss [nat] of residuals that are normal: (TAILS / 2 + 1) E ln(1 + x / TAILS), with x chi-squared
of two degrees.
"""


def whiten(off: Array, shifts: Array) -> Array:
    """Whiten the residuals (n, 2) of one mount, which have unit variance and shared deviations.

    ``shifts`` (n, 2, K) are their shifts by K independent deviations of the mount's parameters, in
    the same units. The symmetric root of the precision changes each residual as little as possible.
    """
    shared = shifts.reshape(off.size, -1)
    vectors, sizes, _ = np.linalg.svd(shared, full_matrices=False)
    flat = off.ravel()
    return np.asarray(
        (flat + vectors @ ((1 / np.hypot(1, sizes) - 1) * (vectors.T @ flat))).reshape(off.shape)
    )


def loss(off: Array) -> Array:
    """Loss [nat] (N,) by residuals (N, 2) in standard deviations; zero if they are unknown."""
    square = np.nan_to_num((off**2).sum(axis=-1))
    return np.asarray((TAILS / 2 + 1) * np.log1p(square / TAILS))


def is_known(off: Array) -> NDArray[np.bool_]:
    """Where (N,) residuals (N, 2) are known."""
    return np.asarray(np.isfinite(off).all(axis=-1))
