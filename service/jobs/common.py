"""What jobs on many heliostats share."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field
from sqlalchemy import select

from service.base.faults import ConflictError
from service.base.fields import Name
from service.store.tables import HeliostatRow
from service.twin.runtime import Runtime

Heliostats = Annotated[
    list[Name] | None, Field(min_length=1, max_length=20_000, description="Names of heliostats; all without it.")
]


def chosen_names(runtime: Runtime, wanted: Sequence[str] | None) -> list[str]:
    """The heliostats that are wanted, each once; all of the store where none is named."""
    if wanted is not None:
        return list(dict.fromkeys(wanted))
    with runtime.database.reading() as session:
        return list(session.scalars(select(HeliostatRow.name).order_by(HeliostatRow.name)))


def require_some(done: int, skipped: dict[str, str]) -> None:
    """ConflictError where nothing could be done, with the first reason."""
    if not done:
        name, reason = next(iter(skipped.items()), ("the store", "it holds no heliostat"))
        raise ConflictError(f"nothing could be done for any of {len(skipped)} heliostats; {name}: {reason}")
