"""Conversions of large images in strips of rows, to save memory."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Pixels of a strip; a conversion needs some 50 bytes for each.
_STRIP_PIXELS = 2**21


def row_strips(shape: tuple[int, ...]) -> Iterator[slice]:
    """Slices of rows that cover an image of ``shape`` (rows, columns, ...), each of few pixels."""
    rows = max(1, _STRIP_PIXELS // max(1, shape[1]))
    return (slice(first, first + rows) for first in range(0, shape[0], rows))


def convert_by_strips(
    image: NDArray[Any], convert: Callable[[NDArray[Any]], NDArray[Any]]
) -> NDArray[Any]:
    """Apply a pixelwise conversion to an image (rows, columns, ...), strip by strip.

    Parameters
    ----------
    convert : callable
        Takes some rows of ``image`` and returns as many rows.
    """
    first, *others = row_strips(image.shape)
    head = convert(image[first])
    if not others:
        return head
    converted = np.empty((image.shape[0], *head.shape[1:]), head.dtype)
    converted[first] = head
    for strip in others:
        converted[strip] = convert(image[strip])
    return converted
