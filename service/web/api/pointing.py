"""How far off heliostats' light lands: today, its trend, and when they moved."""

from datetime import datetime
from operator import attrgetter
from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service import store
from service.base.faults import NotFoundError
from service.base.fields import Name
from service.twin.field import PATIENCE_S, Line, read_lines
from service.twin.pointing import best_slot
from service.web.answers.openapi import problems
from service.web.answers.paging import Page, page
from service.web.api.mounts import PlannedOut, planned_out
from service.web.door.dependencies import READ, FieldBookDep, Limit, NamePath, RuntimeDep

router = APIRouter(tags=["mounts"])


class MovedOut(BaseModel):
    """That a heliostat moved between two photographs."""

    after: datetime
    before: datetime
    when: str = Field(
        description="The same in words; between which photographs, where those do not tell when they were taken, and "
        "`after` and `before` are when they came.",
        examples=["between 12 and 14 August 2024"],
    )
    mrad: float = Field(
        description="What its drives stepped by, or how far its light lies off where not calibrated [mrad]."
    )
    is_calibrated: bool = Field(description="Whether its mount was calibrated since, and knows the step.")


class DriftedOut(BaseModel):
    """How far its drives went slowly."""

    since: datetime
    until: datetime
    mrad: float = Field(description="How far the zeros of its drives went together [mrad].")


class PointingOut(BaseModel):
    """What the newest photographs say of a calibrated mount."""

    heliostat: str
    mount: int = Field(description="Version of the mount.")
    calibrated_at: datetime
    error_mrad: float | None = Field(
        description="Median angle at the mirror between forecast and measured spots, of the newest photographs since "
        "the heliostat last moved [mrad]."
    )
    error_m: float | None = Field(description="The same at the nearest receiver's centre [m]; null without a receiver.")
    photographs: int = Field(description="How many that is the median of.")
    since_calibration: int = Field(description="How many photographs were taken since the newest calibrated one.")
    trend_mrad: float | None = Field(
        description="Of those, the median of the newest third over that of the third before; null below 9 [mrad]."
    )
    moved: MovedOut | None = Field(description="The last time that it moved.")
    drifted: DriftedOut | None = Field(description="Slow drift of its drives, where it is sure.")


class HeliostatPointingOut(PointingOut):
    """The same of one heliostat, with what to do about it."""

    tells_most: PlannedOut | None = Field(
        description="Of a photograph each quarter of an hour of the coming day, under a sun of 10 degrees at least, "
        "the one that is expected to tell most of its mount; null where it reaches no target."
    )


def _about(line: Line) -> dict[str, Any]:
    own = {} if line.pointing is None else vars(line.pointing)
    return own | {"heliostat": line.name, "error_m": line.pointing_m}


def _out(line: Line) -> PointingOut:
    return PointingOut.model_validate(_about(line), from_attributes=True)


class PointingPage(Page[PointingOut]):
    """A part of the field."""

    pending: int = Field(description="Heliostats whose pointing error is still being worked out; ask again for them.")


@router.get("/pointing", responses=problems(), dependencies=[READ])
def list_pointing(
    runtime: RuntimeDep,
    book: FieldBookDep,
    limit: Limit = 100,
    after: Annotated[Name | None, Query(description="The last heliostat of the page before.")] = None,
) -> PointingPage:
    """The pointing errors of all calibrated heliostats, in the order of their names."""
    with runtime.database.reading() as session:
        field = book.read(session, PATIENCE_S)
    known = [line for line in field.lines if line.pointing is not None and (after is None or line.name > after)]
    known.sort(key=attrgetter("name"))  # as `after` is compared, whatever the database's order of letters
    part = page([_out(line) for line in known[: limit + 1]], limit, "heliostat")
    return PointingPage(items=part.items, next=part.next, pending=field.pending)


@router.get("/heliostats/{name}/pointing", responses=problems(404), dependencies=[READ])
def get_pointing(name: NamePath, runtime: RuntimeDep, book: FieldBookDep) -> HeliostatPointingOut:
    """The pointing error of a heliostat's newest photographs, its trend, when it moved, and when to look next."""
    with runtime.database.reading() as session:
        (line,) = read_lines(session, store.get_heliostat(session, name).id)
    line = book.with_pointing(line)
    if line.pointing is None:
        raise NotFoundError(f"heliostat {name} has no mount that fits it; POST to /v1/jobs/calibrations first")
    slot = best_slot(runtime, name)
    about = _about(line) | {"tells_most": None if slot is None else planned_out(slot)}
    return HeliostatPointingOut.model_validate(about, from_attributes=True)
