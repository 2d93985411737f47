"""Lists in parts."""

from collections.abc import Sequence
from typing import Generic, TypeVar

from pydantic import BaseModel, Field

Item = TypeVar("Item")


class Page(BaseModel, Generic[Item]):
    """A part of a list."""

    items: list[Item]
    next: str | None = Field(description="Pass as `after` for the next page; null on the last.")


def page(items: Sequence[Item], limit: int, mark: str = "id") -> Page[Item]:
    """The first ``limit`` of items that are up to one more; after the last one's ``mark`` begins the next page."""
    shown = list(items[:limit])
    return Page(items=shown, next=str(getattr(shown[-1], mark)) if len(items) > limit else None)
