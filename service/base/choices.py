"""Choices shared by requests, the command line and the tables.

Every start of the command imports this module, so it must stay small.
"""

from typing import Generic, Literal, NamedTuple, TypeVar

from model.errors import InvalidInputError

Method = Literal["network", "refined"]
"""Method of surface prediction."""

MAX_IMAGES = {"network": 8, "refined": 64}
"""Maximum number of images per method."""

Item = TypeVar("Item")


class Selection(NamedTuple, Generic[Item]):
    """What is used, and the reasons of what is left out, by name."""

    chosen: list[Item]
    skipped: dict[str, str]


RoleName = Literal["read", "ingest", "operate", "admin"]
"""Roles of keys. Each role includes the permissions of those before it."""


def require_images(method: str, count: int) -> None:
    """Reject an unknown method or an invalid number of images.

    Raises
    ------
    InvalidInputError
    """
    if method not in MAX_IMAGES:
        raise InvalidInputError(f"method must be 'network' or 'refined', got {method!r}")
    if not 1 <= count <= MAX_IMAGES[method]:
        raise InvalidInputError(
            f"images must lie in 1 to {MAX_IMAGES[method]} for the method {method}, got {count}; "
            f"refined takes up to {MAX_IMAGES['refined']}"
        )
