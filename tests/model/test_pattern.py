"""Residuals that stay at the same place on the target while spots move are the target's pattern.

Residuals that move with the spots belong to the flux.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from model.study.pattern import Pattern, pattern_of

SIZE, WINDOW = 64, 4.0
PIXEL = WINDOW / SIZE
TARGET = 128  # pixels along each side of a target of 8 m
Array = NDArray[np.float64]


def spot(center: tuple[int, int], size: int) -> Array:
    """A round spot of 0.6 m about a pixel (row, column)."""
    rows, columns = np.mgrid[:size, :size]
    squared = (rows - center[0]) ** 2 + (columns - center[1]) ** 2
    return np.asarray(np.exp(-squared * PIXEL**2 / (2 * 0.6**2)))


def found(shade: Array, own: Array, grain: float = 0.0) -> Pattern:
    """Of spots at eight places on a target that keeps ``shade`` of the light, while the light lacks
    ``own``.
    """
    generator = np.random.default_rng(1)
    plane = SimpleNamespace(name="target", width=8.0, height=8.0)
    images, measured = [], []
    for row, column in generator.integers(40, TARGET - 40, (8, 2)):
        whole = spot((row, column), TARGET)
        images.append(SimpleNamespace(image=whole, setup=SimpleNamespace(plane=plane)))
        half = SIZE // 2
        seen = whole[row - half : row + half, column - half : column + half] * (1 - own)
        seen = seen * (1 - shade[row - half : row + half, column - half : column + half])
        measured.append(seen * (1 + grain * generator.standard_normal(seen.shape)))
    forecast = np.tile(spot((SIZE // 2, SIZE // 2), SIZE), (8, 1, 1))
    cuts = [
        stack / stack.sum(axis=(1, 2), keepdims=True) for stack in (np.array(measured), forecast)
    ]
    return pattern_of(np.array(images, dtype=object).tolist(), *cuts, WINDOW)


def lines(size: int) -> Array:
    """Grid lines that take 5 % of the light, of an uneven pitch that no step of a spot repeats."""
    shade = np.zeros((size, size))
    for at in (3, 14, 22, 37, 45, 60, 71, 79, 94, 102, 117):
        shade[at % size], shade[:, at % size] = 0.05, 0.05
    return shade


NONE_ON_TARGET, NONE_ON_SPOT = np.zeros((TARGET, TARGET)), np.zeros((SIZE, SIZE))


def test_grid_lines_are_the_targets():
    pattern = found(lines(TARGET), NONE_ON_SPOT, grain=0.01)
    assert pattern.is_targets
    assert pattern.depth == pytest.approx(lines(TARGET).std(), rel=0.4)


def test_what_moves_with_the_spots_is_not():
    pattern = found(NONE_ON_TARGET, lines(SIZE), grain=0.01)
    assert pattern.on_spot > 0.9
    assert not pattern.is_targets


@pytest.mark.parametrize("grain", [0.0, 0.05])
def test_grain_is_nobodys(grain: float):
    pattern: Any = found(NONE_ON_TARGET, NONE_ON_SPOT, grain)
    assert abs(pattern.on_target) < 0.1
    assert not pattern.is_targets
