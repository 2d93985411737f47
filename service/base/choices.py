"""Choices that requests, the command line and the tables share; light, for every start of the command reads them."""

from typing import Literal

from model.errors import InvalidInputError

Method = Literal["network", "refined"]
"""How a surface is predicted."""

MOST_IMAGES = {"network": 8, "refined": 64}
"""How many images each method takes."""

RoleName = Literal["read", "ingest", "operate", "admin"]
"""What a key may do; each may also do what those before it may."""


def require_images(method: str, count: int) -> None:
    """Refuse a method that there is not, or more images than it takes.

    Raises
    ------
    InvalidInputError
    """
    if method not in MOST_IMAGES:
        raise InvalidInputError(f"method must be 'network' or 'refined', got {method!r}")
    if not 1 <= count <= MOST_IMAGES[method]:
        raise InvalidInputError(
            f"images must lie in 1 to {MOST_IMAGES[method]} for the method {method}, got {count}; "
            f"refined takes up to {MOST_IMAGES['refined']}"
        )
