"""What a representation beside JSON is: media types, a suffix, and how maps become bytes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Maps:
    """Named arrays that a client asks for, and what it takes to show them.

    Attributes
    ----------
    name : str
        Of a file with them, without its suffix.
    title : str
        For people.
    arrays : mapping of names to arrays
    picture : callable
        Draws them under a title, as PNG.
    packed : bytes or None
        The arrays as npz, where they are stored so.
    """

    name: str
    title: str
    arrays: Mapping[str, NDArray[np.generic]]
    picture: Callable[[str], bytes]
    packed: bytes | None = None


@dataclass(frozen=True)
class Representation:
    """One way to write maps; a client asks for it by any of its ``media_types``."""

    media_types: tuple[str, ...]
    suffix: str
    write: Callable[[Maps], bytes]
