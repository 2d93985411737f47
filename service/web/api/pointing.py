"""Pointing errors of heliostats: current value, trend, and detected moves."""

from datetime import datetime
from operator import attrgetter
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service import store
from service.base.errors import NotFoundError
from service.base.fields import From, HeliostatOf, Name, UpTo
from service.twin.alarms.field_overview import (
    PATIENCE_S,
    HeliostatOverview,
    read_summaries,
    with_pointing,
)
from service.twin.pointing.calibration import best_slot
from service.web.api.mounts import PlannedOut, planned_out
from service.web.auth.dependencies import READ, FieldCacheDep, Limit, NamePath, RuntimeDep
from service.web.responses.openapi import problems
from service.web.responses.paging import Page, page

router = APIRouter(tags=["mounts"])


class MovedOut(BaseModel):
    """A move of a heliostat between two photographs."""

    since: From
    until: UpTo
    when: str = Field(
        description=(
            "The same in words. If the photographs have no times, it names them, and `since` and"
            " `until` are when they arrived."
        ),
        examples=["between 2024-08-12 09:10 UTC and 2024-08-14 10:05 UTC"],
    )
    size_mrad: float = Field(
        description=("Step of its drives; if not calibrated, the pointing error [mrad].")
    )
    is_calibrated: bool = Field(
        description="Whether its mount was calibrated since, and knows the step."
    )


class DriftedOut(BaseModel):
    """Slow drift of the drives."""

    since: From
    until: UpTo
    size_mrad: float = Field(description="How far the zeros of its drives went together [mrad].")


class PointingOut(BaseModel):
    """What the newest photographs say about a calibrated mount."""

    heliostat: HeliostatOf
    mount_version: int = Field(description="Version of the mount.")
    calibrated_at: datetime = Field(description="When the mount was calibrated.")
    error_mrad: float | None = Field(
        description=(
            "Median angle at the mirror between forecast and measured spots, of the newest"
            " photographs since the heliostat last moved [mrad]. Photographs of the calibration are"
            " forecast by those of other days. null for fewer than 3."
        )
    )
    interval_mrad: tuple[float, float] | None = Field(
        description="Interval of 90 % of such angles [mrad]; null if unknown."
    )
    error_m: float | None = Field(
        description="The same at the nearest receiver's centre [m]; null without a receiver."
    )
    photographs: int = Field(description="How many that is the median of.")
    since_calibration: int = Field(
        description="How many photographs were taken since the newest calibrated one."
    )
    trend_mrad: float | None = Field(
        description=(
            "Of those, the median of the newest third over that of the third before; null below 9"
            " [mrad]."
        )
    )
    moved: MovedOut | None = Field(description="The last time that it moved.")
    drifted: DriftedOut | None = Field(description="Slow drift of its drives, where it is sure.")


class HeliostatPointingOut(PointingOut):
    """The pointing of one heliostat, with the most informative next photograph."""

    most_informative: PlannedOut | None = Field(
        description=(
            "The photograph that is expected to be most informative about its mount, of one each"
            " quarter of an hour of the coming day with a sun of at least 10 degrees. null if it"
            " reaches no target."
        )
    )


def _about(line: HeliostatOverview) -> dict[str, object]:
    own = {} if line.pointing is None else vars(line.pointing)
    return own | {"heliostat": line.name, "error_m": line.pointing_m}


def _out(line: HeliostatOverview) -> PointingOut:
    return PointingOut.model_validate(_about(line), from_attributes=True)


class PointingPage(Page[PointingOut]):
    """A part of the list of pointing errors."""

    pending: int = Field(
        description="Heliostats whose pointing error is still being computed; request them again."
    )


@router.get("/pointing", responses=problems(), dependencies=[READ])
def list_pointing(
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    limit: Limit = 100,
    after: Annotated[
        Name | None, Query(description="The last heliostat of the page before.")
    ] = None,
) -> PointingPage:
    """List the pointing errors of calibrated heliostats, by name."""
    with runtime.database.reading() as session:
        field = cache.read(session, PATIENCE_S)
    known = [
        line
        for line in field.lines
        if line.pointing is not None and (after is None or line.name > after)
    ]
    known.sort(
        key=attrgetter("name")
    )  # as `after` is compared, whatever the collation of the database
    part = page([_out(line) for line in known[: limit + 1]], limit, "heliostat")
    return PointingPage(items=part.items, next=part.next, pending=field.pending)


@router.get("/heliostats/{name}/pointing", responses=problems(404), dependencies=[READ])
def get_pointing(name: NamePath, runtime: RuntimeDep) -> HeliostatPointingOut:
    """Get the pointing error of a heliostat, from its newest photographs.

    The response includes the trend, the last move, and the most informative next photograph.
    """
    with runtime.database.reading() as session:
        (line,) = read_summaries(session, store.get_heliostat(session, name).id)
    line = with_pointing(runtime, line)
    if line.pointing is None:
        raise NotFoundError(
            f"heliostat {name} has no mount that fits it; POST to /v1/jobs/calibrations first"
        )
    slot = best_slot(runtime, name)
    about = _about(line) | {"most_informative": None if slot is None else planned_out(slot)}
    return HeliostatPointingOut.model_validate(about, from_attributes=True)
