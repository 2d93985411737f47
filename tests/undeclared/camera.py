"""Cameras before the target: what the rays' hits become as light, as counts of light alone, and as
a photograph.

A photograph shows a white sheet by daylight, with its seams, marks and stains, and the mirror's
light upon it; the camera is exposed as cameras are, encodes light for human eyes, clips what is too
bright and keeps 8 bits.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from benchmarks import data_folder
from tests.undeclared.plant import Target
from tests.undeclared.world import World

Array = NDArray[np.float64]
Rays = NDArray[np.float32]
Photograph = NDArray[np.uint8]

PIXELS = 256

READ_NOISE = 0.3
"""Standard deviation [counts]."""

WELL = 2e4
"""Electrons that make the largest count."""

AVERAGED = 30
"""Number of photographs that are averaged for a real sheet: the remaining noise is 0.4 %."""

DAYLIGHT, EXPOSURE = (0.2, 0.34), (0.5, 0.95)
"""Intensity of the sheet by day, and of the spot's peak over it: shares of the camera's range."""


def light(
    rays: Iterable[tuple[Rays, Rays]], target: Target, world: World, rng: np.random.Generator
) -> Array:
    """What a sensor says (256, 256) of hits (2, n) [m] and their light (n,) alone, of the brightest
    place.

    Over a whole target, row 0 at the top.
    """
    image = np.zeros((PIXELS, PIXELS))
    total = photons = 0.0
    for hits, power in rays:
        for seen, share in _seen(hits, power, target, world, rng):
            image += _histogram(seen, share, target)
        total, photons = total + float(power.sum()), photons + power.size
    return _sensed(image * photons / total, target, world, rng)


def counts(light: Array, rng: np.random.Generator) -> Array:
    """An 8-bit image of light alone: no daylight, no curve."""
    return np.round(255 * light / light.max() + READ_NOISE * rng.standard_normal(light.shape)).clip(
        0, 255
    )


def photograph(light: Array, target: Target, world: World, rng: np.random.Generator) -> Photograph:
    """An 8-bit photograph (256, 256) of light on the sheet by day."""
    across, down = rng.uniform(-0.2, 0.2, 2)
    x = np.linspace(-1, 1, PIXELS)
    day = rng.uniform(*DAYLIGHT) * (
        1 + across * x + down * x[:, None] - 0.05 * (x**2 + x[:, None] ** 2)
    )
    sensed = sheet(target.name) * (day + rng.uniform(*EXPOSURE) * light)
    sensed = rng.poisson(WELL * sensed.clip(min=0)) / WELL
    encoded = _encoded(sensed.clip(max=1) ** world.law)
    return (
        np.round(255 * encoded + READ_NOISE * rng.standard_normal(encoded.shape))
        .clip(0, 255)
        .astype(np.uint8)
    )


def _seen(
    hits: Rays, power: Rays, target: Target, world: World, rng: np.random.Generator
) -> Iterable[tuple[Rays, Rays]]:
    """Where light that hits the target appears on the photograph, still in metres, and
    how bright.
    """
    half = np.array([[target.width], [target.height]], dtype=np.float32) / 2
    power = power * (np.abs(hits) < half).all(axis=0)
    place, shaded = world.mast
    power = power * (1 - np.float32(shaded) * (np.abs(hits[0] - np.float32(place)) < 0.2))
    if world.blur_m:
        hits = hits + np.float32(world.blur_m) * rng.standard_normal(hits.shape, dtype=np.float32)
    if world.side_blur_m:
        sigma = np.float32(world.side_blur_m) * (hits[0] / half[0] + 0.5).clip(0, 1)
        hits = hits + sigma * rng.standard_normal(hits.shape, dtype=np.float32)
    if world.rolling_m:
        sway = np.float32(world.rolling_m) * np.sin(2 * np.pi * hits[1] / np.float32(1.5))
        hits = np.stack([hits[0] + sway, hits[1]]).astype(np.float32)
    scale_x, scale_y, shear, turn = world.registration
    if world.registration != (1.0, 1.0, 0.0, 0.0):
        cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        leaning = np.array([[scale_x, scale_x * shear], [0.0, scale_y]])
        hits = (np.array([[cosine, -sine], [sine, cosine]]) @ leaning).astype(np.float32) @ hits
    if world.barrel:
        # Radiance stays; so what is shrunk holds less light.
        bend = np.float32(world.barrel) * (hits**2).sum(axis=0) / half.max() ** 2
        hits, power = hits * (1 - bend), power * (1 - bend) * (1 - 3 * bend)
    share, *offset = world.ghost
    yield hits, power * np.float32(1 - share)
    if share:
        yield hits + np.array(offset, dtype=np.float32)[:, None], power * np.float32(share)


def _histogram(hits: Rays, power: Rays, target: Target) -> Array:
    column = np.floor((hits[0] / np.float32(target.width) + np.float32(0.5)) * PIXELS)
    row = np.floor((np.float32(0.5) - hits[1] / np.float32(target.height)) * PIXELS)
    inside = (column >= 0) & (column < PIXELS) & (row >= 0) & (row < PIXELS)
    cell = (row * PIXELS + column)[inside].astype(np.int32)
    return np.bincount(cell, power[inside], PIXELS**2).reshape(PIXELS, PIXELS)


def _sensed(photons: Array, target: Target, world: World, rng: np.random.Generator) -> Array:
    """Of an image in photons, whose noise is the rays' own: with stray light, and the sensor's
    response.
    """
    level, gradient_x, gradient_y = world.stray
    x, y = (
        size * ((np.arange(PIXELS) + 0.5) / PIXELS - 0.5) for size in (target.width, target.height)
    )
    stray = _peak(photons) * (level + gradient_x * x - gradient_y * y[:, None])
    photons = photons + rng.poisson(stray.clip(min=0))
    for right, up in world.hot:
        row, column = int((0.5 - up / 2) * PIXELS), int((0.5 + right / 2) * PIXELS)
        photons[row : row + 2, column : column + 2] += 0.3 * _peak(photons)
    share = (photons / _peak(photons)).clip(max=world.saturation) ** world.gamma
    return 1 - np.exp(-world.compression * share) if world.compression else share


def _peak(photons: Array) -> float:
    """The brightest place, whatever its noise."""
    return float(gaussian_filter(photons, 2.0).max())


def _encoded(light: Array) -> Array:
    """IEC 61966-2-1 (sRGB): what cameras make of light."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _decoded(counts: Array) -> Array:
    """Light of 8-bit counts, the inverse of `_encoded`."""
    encoded = counts / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


# --- the sheet
# --------------------------------------------------------------------------------------------------


def empty_targets() -> list[Path]:
    """Real photographs of the empty lower target of Juelich, where the data are there."""
    return sorted((data_folder() / "empty-targets").glob("*.png"))


@lru_cache(maxsize=8)
def sheet(target: str) -> Array:
    """Reflectance (256, 256) of a target's sheet: that of Juelich, or a drawn one where the data
    are not there.
    """
    crops = empty_targets()
    return real_sheet(target, crops) if crops else drawn_sheet(target)


def real_sheet(target: str, crops: Sequence[Path]) -> Array:
    """Reflectance (256, 256) of the sheet on photographs: the mean of their light, each without its
    daylight.

    There are such of one target only: the other has its pattern too, the other way round.
    """
    chosen = crops[:: -(-len(crops) // AVERAGED)]
    lights = _decoded(
        np.stack([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in chosen]).astype(
            np.float64
        )
    )
    paint = np.mean([light / _daylight(light) for light in lights], axis=0)
    paint /= np.median(paint)
    return paint[:, ::-1] if target == "upper" else paint


def _daylight(light: Array) -> Array:
    """The smooth light on a photograph (256, 256) of an empty target: a square's best fit to what
    is no mark.
    """
    y, x = np.mgrid[-1 : 1 : 1j * PIXELS, -1 : 1 : 1j * PIXELS]
    terms = np.stack([x**0, x, y, x * x, x * y, y * y])
    sheet = light > 0.8 * np.median(light)
    weights, *_ = np.linalg.lstsq(terms[:, sheet].T, light[sheet], rcond=None)
    return np.tensordot(weights, terms, 1)


def drawn_sheet(target: str) -> Array:
    """Reflectance (256, 256) of panels, seams with rivets, stains, grain, marks at the corners.

    As strong as on 300 photographs of the empty targets of Juelich: grain and stains 1 to 2 %,
    seams 5 to 30 %.
    """
    rng = np.random.default_rng(crc32(target.encode()))
    paint = 1 + 0.015 * rng.standard_normal((PIXELS, PIXELS))
    for size, strength in ((2.5, 0.006), (14.0, 0.007)):
        stains = gaussian_filter(rng.standard_normal((PIXELS, PIXELS)), size)
        paint *= 1 + strength * stains / stains.std()
    rows, columns = (
        np.round(np.linspace(0, PIXELS, n) + rng.uniform(-4, 4, n)).astype(int)[1:-1]
        for n in (5, 9)
    )
    paint[rows[-1] :] *= 0.94
    paint[rows[-1] :, :14] *= 0.9
    paint[rows] *= 1 - rng.uniform(0.15, 0.35, (len(rows), 1))
    paint[:, columns] *= 1 - rng.uniform(0.05, 0.12, len(columns))
    paint[np.ix_(np.arange(5, PIXELS, 11), columns)] *= 0.8
    ends = [slice(0, 4), slice(0, 22)], [slice(PIXELS - 4, PIXELS), slice(PIXELS - 22, PIXELS)]
    for down, along_down in ends:
        for across, along_across in ends:
            paint[down, along_across] = paint[along_down, across] = 0.12
    paint[-26:, 127:130] = paint[-4:, 117:139] = 0.12
    return gaussian_filter(paint, 0.6)
