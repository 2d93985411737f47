"""Representations of maps other than JSON: media types, suffix, and conversion to bytes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.base.arrays import pack


@dataclass(frozen=True, eq=False)
class Maps:
    """Named arrays that a client requests, and what is needed to show them.

    Attributes
    ----------
    name : str
        File name without the suffix.
    title : str
        Title for people.
    arrays : mapping of names to arrays picture : callable
        Draws the arrays under a title, as PNG.
    packed : bytes or None
        The arrays as npz, if they are stored in this form.
    """

    name: str
    title: str
    arrays: Mapping[str, NDArray[np.generic]]
    picture: Callable[[str], bytes]
    packed: bytes | None = None


@dataclass(frozen=True)
class Representation:
    """One way to write maps. A client requests it by any of its ``media_types``."""

    media_types: tuple[str, ...]
    suffix: str
    write: Callable[[Maps], bytes]


NPZ = "application/x-npz"
NPZ_VENDOR = "application/vnd.numpy.npz"


def _write_arrays(maps: Maps) -> bytes:
    return pack(maps.arrays) if maps.packed is None else maps.packed


PNG = "image/png"


def _write_picture(maps: Maps) -> bytes:
    return maps.picture(maps.title)


REPRESENTATIONS = (
    Representation((NPZ, NPZ_VENDOR), "npz", _write_arrays),
    Representation((PNG,), "png", _write_picture),
)
"""The arrays as a NumPy archive, and a picture with axes, a colour bar and a title."""
