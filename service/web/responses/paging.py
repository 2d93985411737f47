"""Pages of lists, and their filter and sort parameters."""

from collections.abc import Sequence
from typing import Annotated, Generic, Literal, TypeVar

from fastapi import Query
from pydantic import BaseModel, Field

from service.base.fields import Model, Moment, Version
from service.store.listing import Order, Period
from service.web.auth.dependencies import Limit

Item = TypeVar("Item")

Since = Annotated[
    Moment | None, Query(description="Only those from this time on (time with zone).")
]
Until = Annotated[Moment | None, Query(description="Only those before this time (time with zone).")]
AfterId = Annotated[Version | None, Query(description="The last id of the page before.")]
Direction = Literal["up", "down"]
"""Sort direction: "up" begins with the smallest or oldest item, "down" with the largest."""
OrderQuery = Annotated[
    Direction, Query(description="up: the oldest, or smallest, first; down: the other way round.")
]


class ListQuery(Model, extra="ignore"):
    """Which items of a list are shown, by when they were created, and in which order.

    Unknown parameters are those of pages; `require_known_query` refuses them in REST.
    """

    limit: Limit = 100
    after: AfterId = None
    since: Since = None
    until: Until = None
    order: OrderQuery = "up"

    @property
    def created(self) -> Period:
        """When the items were created."""
        return Period(self.since, self.until)

    @property
    def by_id(self) -> Order:
        """The order for the store."""
        return Order(descending=self.order == "down")


class Page(BaseModel, Generic[Item]):
    """A part of a list."""

    items: list[Item] = Field(description="The entries of this page, in the list's order.")
    next: str | None = Field(description="Pass as `after` for the next page; null on the last.")


def page(items: Sequence[Item], limit: int, mark: str = "id") -> Page[Item]:
    """Build a page of ``limit`` items from up to ``limit`` + 1.

    The next page begins after the ``mark`` of the last item.
    """
    shown = list(items[:limit])
    return Page(items=shown, next=str(getattr(shown[-1], mark)) if len(items) > limit else None)
