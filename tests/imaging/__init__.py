"""What the imaging tests share."""

import numpy as np

from benchmarks.imaging import accuracy

__all__ = ["accuracy", "gaussian"]


def gaussian(plane, right, up, sigma_a, sigma_b, angle=0.0, size=256):
    """A Gaussian spot (size, size) on a plane, peak 1; lengths in metres."""
    x = ((np.arange(size) + 0.5) / size - 0.5) * plane.width - right
    y = (0.5 - (np.arange(size) + 0.5) / size) * plane.height - up
    x, y = np.meshgrid(x, y)
    a, b = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    return np.exp(-0.5 * ((a / sigma_a) ** 2 + (b / sigma_b) ** 2))
