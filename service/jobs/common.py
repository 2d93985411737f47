"""Common functions of jobs on many heliostats."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service import store
from service.base.errors import ConflictError, NotFoundError
from service.base.fields import Name
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow
from service.twin.runtime import Runtime

Heliostats = Annotated[
    list[Name] | None,
    Field(min_length=1, max_length=20_000, description="Names of heliostats; all without it."),
]

MAX_PIXELS = 10_000_000
"""Maximum number of pixels of a plan's maps over all times: 40 MB for each kind of map."""


def chosen_names(runtime: Runtime, names: Sequence[str] | None) -> list[str]:
    """The requested heliostats without duplicates; all stored ones if ``names`` is None."""
    if names is not None:
        return list(dict.fromkeys(names))
    with runtime.database.reading() as session:
        return list(session.scalars(select(HeliostatRow.name).order_by(HeliostatRow.name)))


def count_chosen(runtime: Runtime, names: Sequence[str] | None) -> int:
    """The number of requested heliostats; that of all stored ones if ``names`` is None."""
    if names is not None:
        return len(names)
    with runtime.database.reading() as session:
        return session.scalars(select(func.count()).select_from(HeliostatRow)).one()


def require_some(n_successful: int, skipped: dict[str, str]) -> None:
    """Raise ConflictError with the first reason if ``n_successful`` is 0."""
    if not n_successful:
        name, reason = next(iter(skipped.items()), ("the store", "it holds no heliostat"))
        raise ConflictError(
            f"nothing could be done for any of {len(skipped)} heliostats; {name}: {reason}"
        )


_HELIOSTATS = ("heliostats", "aim_points_m", "aim_offsets_m")
"""Payload fields that name heliostats, in a list or as keys."""
_LISTED = 5
"""Maximum number of unknown names that an error lists."""


def require_stored(session: Session, payload: Mapping[str, Any]) -> None:
    """Check that the heliostats and the target that a job's payload names are stored.

    Raises
    ------
    NotFoundError
        With the field and the first unknown names, or the job that is no plan of aims.
    ConflictError
        If the plan of aims is not done, or aims at another target.
    """
    for field in _HELIOSTATS:
        names = dict.fromkeys(payload.get(field) or ())
        known = set(session.scalars(select(HeliostatRow.name).where(HeliostatRow.name.in_(names))))
        if unknown := [name for name in names if name not in known]:
            more = f" and {len(unknown) - _LISTED} more" if len(unknown) > _LISTED else ""
            listed = f"{', '.join(unknown[:_LISTED])}{more}"
            raise NotFoundError(f"{field}: {listed} not found; GET /v1/heliostats lists the names")
    if (target := payload.get("target")) is not None:
        store.get_target_or_receiver(session, target)
    if (number := payload.get("aim_plan")) is not None:
        _require_aim_plan(session, number, target)


def _require_aim_plan(session: Session, number: int, target: object) -> None:
    """Check that a job is a finished plan of aims on the same target."""
    row = session.get(JobRow, number)
    if row is None or row.kind != "aim-plans":
        raise NotFoundError(f"aim_plan: job {number} is no plan of aims; GET /v1/jobs lists them")
    if row.state != "done":
        raise ConflictError(f"aim_plan: job {number} is {row.state}; wait until it is done")
    if row.payload.get("target") != target:
        raise ConflictError(
            f"aim_plan: job {number} aims at {row.payload.get('target') or 'a separate receiver'}"
            f", not at {target}; give a plan of the same target"
        )
