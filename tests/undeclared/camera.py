"""A camera before the target: what the rays' hits become on an 8-bit photograph."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from model.plant import TargetPlane
from tests.undeclared.world import World

Array = NDArray[np.float64]
Rays = NDArray[np.float32]

PIXELS = 256

READ_NOISE = 0.3
"""Standard deviation [counts]."""


def photograph(rays: Iterable[tuple[Rays, Rays]], plane: TargetPlane, world: World, rng: np.random.Generator) -> Array:
    """Counts (256, 256) over a whole target, row 0 at the top, of hits (2, n) [m] and their light (n,)."""
    image = np.zeros((PIXELS, PIXELS))
    total = photons = 0.0
    for hits, light in rays:
        for seen, share in _seen(hits, light, plane, world, rng):
            image += _histogram(seen, share, plane)
        total, photons = total + float(light.sum()), photons + light.size
    return _developed(image * photons / total, plane, world, rng)


def _seen(
    hits: Rays, light: Rays, plane: TargetPlane, world: World, rng: np.random.Generator
) -> Iterable[tuple[Rays, Rays]]:
    """Where light that hits the target appears on the photograph, still in metres, and how bright."""
    half = np.array([[plane.width], [plane.height]], dtype=np.float32) / 2
    light = light * (np.abs(hits) < half).all(axis=0)
    if world.blur_m:
        hits = hits + np.float32(world.blur_m) * rng.standard_normal(hits.shape, dtype=np.float32)
    scale_x, scale_y, shear, turn = world.registration
    if world.registration != (1.0, 1.0, 0.0, 0.0):
        cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        leaning = np.array([[scale_x, scale_x * shear], [0.0, scale_y]])
        hits = (np.array([[cosine, -sine], [sine, cosine]]) @ leaning).astype(np.float32) @ hits
    if world.barrel:
        # Radiance stays; so what is shrunk holds less light.
        bend = np.float32(world.barrel) * (hits**2).sum(axis=0) / half.max() ** 2
        hits, light = hits * (1 - bend), light * (1 - bend) * (1 - 3 * bend)
    share, *offset = world.ghost
    yield hits, light * np.float32(1 - share)
    if share:
        yield hits + np.array(offset, dtype=np.float32)[:, None], light * np.float32(share)


def _histogram(hits: Rays, light: Rays, plane: TargetPlane) -> Array:
    column = np.floor((hits[0] / np.float32(plane.width) + np.float32(0.5)) * PIXELS)
    row = np.floor((np.float32(0.5) - hits[1] / np.float32(plane.height)) * PIXELS)
    inside = (column >= 0) & (column < PIXELS) & (row >= 0) & (row < PIXELS)
    cell = (row * PIXELS + column)[inside].astype(np.int32)
    return np.bincount(cell, light[inside], PIXELS**2).reshape(PIXELS, PIXELS)


def _developed(photons: Array, plane: TargetPlane, world: World, rng: np.random.Generator) -> Array:
    """Counts of an image in photons, whose noise is the rays' own: stray light, the sensor's response, its noise."""
    level, gradient_x, gradient_y = world.stray
    x, y = (size * ((np.arange(PIXELS) + 0.5) / PIXELS - 0.5) for size in (plane.width, plane.height))
    stray = _peak(photons) * (level + gradient_x * x - gradient_y * y[:, None])
    photons = photons + rng.poisson(stray.clip(min=0))
    share = (photons / _peak(photons)).clip(max=world.saturation) ** world.gamma
    if world.compression:
        share = 1 - np.exp(-world.compression * share)
    counts = 255 * share / share.max() + READ_NOISE * rng.standard_normal(share.shape)
    return np.round(counts).clip(0, 255)


def _peak(photons: Array) -> float:
    """The brightest place, whatever its noise."""
    return float(gaussian_filter(photons, 2.0).max())
