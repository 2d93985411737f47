"""Page that gives times and motor positions to many photographs, with a preview and undo."""

import csv
import io
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, File, Form, Path, Query, Request, Response, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from model.times import format_time
from service.base.fields import Lines, Model, ReadVersion, Reason, Version
from service.store.photographs.correction_log import newest_correction
from service.store.tables import HeliostatRow, MeasurementRow
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.photographs.batches import (
    MOST_ENTRIES,
    MOTORS,
    TIMES,
    correct_many,
    list_batches,
    preview_many,
    undo_batch,
)
from service.twin.photographs.corrections import GivenCorrection
from service.twin.photographs.times import read_motors, read_times, shifted_times
from service.twin.runtime.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    RuntimeDep,
    require_multipart,
)
from service.web.resources.photographs import PhotographsQuery, target_names
from service.web.responses.pages import go_to, render

router = APIRouter(include_in_schema=False, prefix="/photographs/times")

_MAX_CSV = 2**20  # [bytes]
_LISTED = 5


What = Literal["times", "motors"]


class ShiftForm(PhotographsQuery):
    """The form that shifts the known times of a selection by ``minutes``."""

    minutes: Annotated[float, Field(ge=-6e5, le=6e5)]
    reason: Reason


class TimesForm(Model):
    """The form that stores what the preview of a ``version`` showed, as CSV lines."""

    lines: Lines
    reason: Reason
    what: What = "times"
    version: ReadVersion = None


def _counts(session: Session) -> list[tuple[str, int]]:
    """Heliostats with photographs of unknown time, the most first."""
    row = MeasurementRow
    n = func.count(func.distinct(func.coalesce(row.external_id, row.identifier)))
    query = select(HeliostatRow.name, n).join(HeliostatRow, HeliostatRow.id == row.heliostat_id)
    query = query.where(row.taken_at.is_(None)).group_by(HeliostatRow.name)
    found = session.execute(query.order_by(n.desc(), HeliostatRow.name)).all()
    return [(name, count) for name, count in found]


@router.get("", dependencies=[READ])
def get_times_page(
    request: Request, query: Annotated[PhotographsQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """Photographs of unknown time by heliostat, the forms, and recent changes with undo."""
    with runtime.database.reading() as session:
        return render(
            request,
            "photograph_times.html",
            query=query,
            counts=_counts(session),
            targets=target_names(session),
            zone=plant_time_zone(session, runtime.settings.time_zone),
            most=MOST_ENTRIES,
            recent=list_batches(session, _LISTED),
        )


def _preview(
    request: Request, runtime: Runtime, given: list[GivenCorrection], what: What, reason: str
) -> HTMLResponse:
    if len(given) > MOST_ENTRIES:
        raise InvalidInputError(f"lines: {len(given)} entries; give at most {MOST_ENTRIES} at once")
    with runtime.database.reading() as session:
        version = newest_correction(session)
        changes = preview_many(session, what, given)
    lines = io.StringIO()
    csv.writer(lines).writerows(
        (one.given.heliostat, one.given.identifier, *_values(one.given)) for one in changes
    )
    return render(
        request,
        "photograph_times_preview.html",
        changes=changes,
        unchanged=len(given) - len(changes),
        lines=lines.getvalue(),
        version=version,
        what=what,
        reason=reason,
    )


def _values(given: GivenCorrection) -> tuple[object, ...]:
    at, motors = given.taken_at, given.motor_position
    return (() if at is None else (format_time(at),)) + (motors or ())


def _read(
    lines: str, where: str, what: What, reason: str, zone: str | None
) -> list[GivenCorrection]:
    text = lines.splitlines()
    if what == "motors":
        return read_motors(text, where, reason)
    return read_times(text, where, reason, zone)


@router.post("/preview", dependencies=[OPERATE, Depends(require_multipart), COMPUTE_SLOT])
def post_lines_form(
    request: Request,
    runtime: RuntimeDep,
    reason: Annotated[Reason, Form()],
    what: Annotated[What, Form()] = "times",
    lines: Annotated[Lines, Form()] = "",
    file: Annotated[UploadFile | None, File()] = None,
) -> HTMLResponse:
    """What the lines or the file would change; nothing is stored."""
    data = b"" if file is None else file.file.read(_MAX_CSV + 1)
    if len(data) > _MAX_CSV:
        raise InvalidInputError(f"file: larger than {_MAX_CSV} bytes; send fewer lines")
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
    text = data.decode("utf-8-sig", "replace") if data else lines
    given = _read(text, "file" if data else "lines", what, reason, zone)
    return _preview(request, runtime, given, what, reason)


@router.post("/shift", dependencies=[OPERATE, COMPUTE_SLOT])
def post_shift_form(
    request: Request, form: Annotated[ShiftForm, Form()], runtime: RuntimeDep
) -> HTMLResponse:
    """What an offset would change; nothing is stored."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        given = shifted_times(session, form.filter(session, zone), form.minutes, form.reason)
    return _preview(request, runtime, given, "times", form.reason)


@router.post("", dependencies=[OPERATE, COMPUTE_SLOT])
def post_times_form(
    form: Annotated[TimesForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Store what the preview showed, and return to the page, which can undo them."""
    given = _read(form.lines, "lines", form.what, form.reason, None)
    action = MOTORS if form.what == "motors" else TIMES
    correct_many(runtime, given, form.reason, identity.name, action, form.version)
    return go_to("/photographs/times#recent-title")


@router.post("/{number}/undo", dependencies=[OPERATE, COMPUTE_SLOT])
def post_undo_form(
    number: Annotated[Version, Path(description="Number of the audit trail's entry.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Restore the values before a change, and return to the page."""
    undo_batch(runtime, number, identity.name)
    return go_to("/photographs/times#recent-title")
