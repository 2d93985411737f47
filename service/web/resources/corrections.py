"""Corrections of photographs, one or many at once, and the forms for it."""

import csv
import io
from typing import Annotated, Literal, Self

from fastapi import APIRouter, Depends, File, Form, Path, Query, Request, Response, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field, model_validator

from model.errors import InvalidInputError
from model.times import format_time
from service import store
from service.base.fields import (
    Author,
    CreatedAt,
    Flag,
    Lines,
    MeasurementName,
    Model,
    Moment,
    Name,
    ReadVersion,
    Reason,
    Sun,
    Version,
    Why,
    from_row,
)
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import predictions
from service.jobs.kinds.predictions import PredictionsIn
from service.sources.schema import WeatherFields
from service.store.deletion import Deleted
from service.store.measurements import count_undated
from service.store.photographs import MadeFrom, list_corrections, made_from, newest_correction
from service.store.tables import MeasurementRow
from service.twin.forecasts.aims import plant_time_zone
from service.twin.photographs.batches import (
    MOST_ENTRIES,
    MOTORS,
    TIMES,
    correct_many,
    given_time,
    list_batches,
    preview_many,
    read_motors,
    read_times,
    shifted_times,
    undo_batch,
)
from service.twin.photographs.corrections import (
    GivenCorrection,
    correct_photograph,
    correct_photographs,
)
from service.twin.photographs.stored_photograph import delete_photograph
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    IfMatch,
    MeasurementPath,
    NamePath,
    RuntimeDep,
    ZoneDep,
    require_json,
    require_multipart,
    set_tag,
)
from service.web.resources.measurements import MeasurementOut, Motors, measurement_out
from service.web.resources.photographs import PhotographsQuery
from service.web.responses.lists import Page
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to, render


class CorrectionIn(WeatherFields, Model):
    """New values of a photograph. Fields that are not named stay as they are."""

    reason: Reason = Field(description="Why; kept with the correction.")
    target: Name | None = Field(default=None, description="The target it shows.")
    sun: Sun | None = Field(default=None, description="Where the sun was [deg].")
    taken_at: Moment | None = Field(default=None, description="When it was taken, with zone.")
    motor_position: Motors | None = Field(default=None, description="Of both axes [steps].")
    excluded: Flag | None = Field(
        default=None, description="Whether nothing shall be made from it any more."
    )
    predict_again: Flag = Field(
        default=False, description="Begin a job that predicts the heliostat's surface again."
    )

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.model_fields_set - {"reason", "predict_again"}:
            raise ValueError("name what shall be changed: a field of the photograph, or excluded")
        return self


class CorrectionOut(BaseModel):
    """A correction of a photograph."""

    created_at: CreatedAt
    created_by: Author
    reason: Why
    before: dict[str, object] = Field(description="Previous values, by the fields that changed.")
    after: dict[str, object] = Field(description="New values.")


class CorrectedOut(MadeFrom):
    """A corrected photograph, and what was made from it before the correction."""

    measurement: MeasurementOut = Field(description="The photograph as it is now.")
    job: int | None = Field(
        description="The job that predicts the surface again, if one was requested."
    )


def predict_again(runtime: Runtime, heliostat: str, actor: str) -> int:
    """Enqueue a prediction of a heliostat's surface, and return the id of the job.

    The method is that of the active surface.
    """
    with runtime.database.reading() as session:
        today = store.find_surface_at(session, store.get_heliostat(session, heliostat))
    method = "network" if today is not None and today.source == "network" else "refined"
    payload = PredictionsIn(heliostats=[heliostat], method=method)
    return enqueue(runtime, predictions.KIND, payload, actor).row.id


router = APIRouter(tags=["measurements"])
pages = APIRouter(include_in_schema=False)

_PATH = "/heliostats/{name}/measurements/{measurement}"


@router.patch(
    _PATH,
    responses=problems(404, 409, 410, 413, 415, 429),
    dependencies=[OPERATE, Depends(require_json), COMPUTE_SLOT],
)
def patch_measurement(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    correction: CorrectionIn,
    version: IfMatch,
    response: Response,
) -> CorrectedOut:
    """Correct a photograph, or exclude it. This holds for all its images; its history is kept.

    Only the named fields are written, so that corrections of other fields at the same time stay.
    With another target, the photograph is measured again. Surfaces and forecasts that were made
    from it stay, and the response names them. With `predict_again`, a job predicts the
    heliostat's surface again. Another weather outdates no surface, because only calibrations use
    it.
    """
    given = GivenCorrection(
        name,
        measurement,
        reason=correction.reason,
        target=correction.target,
        **({} if correction.sun is None else correction.sun.model_dump()),
        taken_at=correction.taken_at,
        motor_position=correction.motor_position,
        weather=correction.weather,
        excluded=correction.excluded,
    )
    row, _ = correct_photograph(runtime, given, identity.name, version)
    with runtime.database.reading() as session:
        set_tag(response, newest_correction(session, row))
        made, measured = made_from(session, row), measurement_out(session, name, row)
    job = predict_again(runtime, name, identity.name) if correction.predict_again else None
    return CorrectedOut(**dict(made), measurement=measured, job=job)


@router.delete(_PATH, responses=problems(404), dependencies=[OPERATE])
def delete_measurement(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    reason: Annotated[Reason, Query(description="Why; kept in the audit trail.")],
    only_this: Annotated[
        bool, Query(description="Delete only this image, not the photograph in all kinds.")
    ] = False,
) -> Deleted:
    """Delete a photograph that was sent by mistake.

    All its images are deleted. Its files are deleted when nothing else refers to them. Surfaces
    that were made from it stay, and name it in `deleted`; predict them again. An import of a folder
    that holds the photograph brings it back.
    """
    return delete_photograph(runtime, name, measurement, reason, identity.name, only_this)


@router.get(f"{_PATH}/corrections", responses=problems(404), dependencies=[READ])
def get_corrections(
    name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep
) -> Page[CorrectionOut]:
    """List the corrections of a photograph, oldest first."""
    with runtime.database.reading() as session:
        row: MeasurementRow = store.get_measurement(
            session, store.get_heliostat(session, name), measurement
        )
        items = [from_row(CorrectionOut, one) for one in list_corrections(session, row)]
    return Page(items=items, next=None)


class TimeIn(Model):
    """The time of a measurement."""

    heliostat: Name
    id: MeasurementName
    taken_at: Moment = Field(description="With time zone.")


class TimesIn(Model):
    """Times of measurements whose time was unknown or wrong."""

    reason: Reason = Field(description="Where they come from; kept with each correction.")
    times: list[TimeIn] = Field(
        min_length=1,
        max_length=MOST_ENTRIES,
        description="The times, by heliostat and measurement.",
    )


class TimesOut(BaseModel):
    """Number of given times, and number of those that changed anything."""

    given: int = Field(description="How many times were given.")
    changed: int = Field(description="How many of them changed a measurement.")


@router.patch(
    "/measurements/times",
    responses=problems(404, 409, 410, 413, 415, 429),
    dependencies=[OPERATE, Depends(require_json), COMPUTE_SLOT],
)
def patch_times(runtime: RuntimeDep, identity: IdentityDep, body: TimesIn) -> TimesOut:
    """Set the times of many photographs.

    Either all are set, or none. Each is a correction with its history. `errors` names every wrong
    entry by its index, such as `times.3`. Entries that match the stored time are skipped.
    """
    given = [
        given_time(entry.heliostat, entry.id, entry.taken_at, body.reason) for entry in body.times
    ]
    changed = correct_many(runtime, given, body.reason, identity.name, TIMES)
    return TimesOut(given=len(given), changed=changed)


# --- forms
# --------------------------------------------------------------------------------------------------


class ExclusionForm(Model):
    """Photographs to exclude, or to use again, with the reason."""

    photographs: Annotated[list[MeasurementName], Field(min_length=1, max_length=100)]
    reason: Reason
    excluded: bool = True
    predict_again: bool = False
    version: ReadVersion = None


@pages.post("/heliostats/{name}/exclusions", dependencies=[OPERATE, COMPUTE_SLOT])
def post_exclusion_form(
    name: NamePath,
    form: Annotated[ExclusionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Exclude photographs or use them again, and go to the job that predicts the surface again."""
    given = [
        GivenCorrection(name, photograph, form.reason, excluded=form.excluded)
        for photograph in form.photographs
    ]
    correct_photographs(runtime, given, identity.name, form.version)
    if form.predict_again:
        return go_to(f"/jobs/{predict_again(runtime, name, identity.name)}")
    return go_to(f"/heliostats/{name}#excluded-title")


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


def times_figures(runtime: Runtime) -> dict[str, object]:
    """What the page of times lists, and what its forms offer."""
    with runtime.database.reading() as session:
        return {
            "counts": count_undated(session),
            "targets": [row.name for row in store.list_targets(session)],
            "zone": plant_time_zone(session, runtime.settings.time_zone),
            "most": MOST_ENTRIES,
            "recent": list_batches(session, _LISTED),
        }


@pages.get("/photographs/times", dependencies=[READ])
def get_times_page(
    request: Request, query: Annotated[PhotographsQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """Photographs of unknown time by heliostat, the forms, and recent changes with undo."""
    return render(request, "photograph_times.html", query=query, **times_figures(runtime))


def preview_figures(
    runtime: Runtime, given: list[GivenCorrection], what: What, reason: str
) -> dict[str, object]:
    """What corrections would change, and the lines that store it.

    Raises
    ------
    InvalidInputError
        If there are more than `MOST_ENTRIES`.
    """
    if len(given) > MOST_ENTRIES:
        raise InvalidInputError(f"lines: {len(given)} entries; give at most {MOST_ENTRIES} at once")
    with runtime.database.reading() as session:
        version = newest_correction(session)
        changes = preview_many(session, what, given)
    lines = io.StringIO()
    csv.writer(lines).writerows(
        (one.given.heliostat, one.given.identifier, *_values(one.given)) for one in changes
    )
    return {
        "changes": changes,
        "unchanged": len(given) - len(changes),
        "lines": lines.getvalue(),
        "version": version,
        "what": what,
        "reason": reason,
    }


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


@pages.post(
    "/photographs/times/preview", dependencies=[OPERATE, Depends(require_multipart), COMPUTE_SLOT]
)
def post_lines_form(
    request: Request,
    runtime: RuntimeDep,
    zone: ZoneDep,
    reason: Annotated[Reason, Form()],
    what: Annotated[What, Form()] = "times",
    lines: Annotated[Lines, Form()] = "",
    file: Annotated[UploadFile | None, File()] = None,
) -> HTMLResponse:
    """What the lines or the file would change; nothing is stored."""
    data = b"" if file is None else file.file.read(_MAX_CSV + 1)
    if len(data) > _MAX_CSV:
        raise InvalidInputError(f"file: larger than {_MAX_CSV} bytes; send fewer lines")
    text = data.decode("utf-8-sig", "replace") if data else lines
    given = _read(text, "file" if data else "lines", what, reason, zone)
    figures = preview_figures(runtime, given, what, reason)
    return render(request, "photograph_times_preview.html", **figures)


def shift_corrections(runtime: Runtime, form: ShiftForm, zone: str) -> list[GivenCorrection]:
    """The known times of the chosen photographs, shifted as corrections."""
    with runtime.database.reading() as session:
        return shifted_times(session, form.filter(session, zone), form.minutes, form.reason)


@pages.post("/photographs/times/shift", dependencies=[OPERATE, COMPUTE_SLOT])
def post_shift_form(
    request: Request, form: Annotated[ShiftForm, Form()], runtime: RuntimeDep, zone: ZoneDep
) -> HTMLResponse:
    """What an offset would change; nothing is stored."""
    given = shift_corrections(runtime, form, zone)
    figures = preview_figures(runtime, given, "times", form.reason)
    return render(request, "photograph_times_preview.html", **figures)


@pages.post("/photographs/times", dependencies=[OPERATE, COMPUTE_SLOT])
def post_times_form(
    form: Annotated[TimesForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Store what the preview showed, and return to the page, which can undo them."""
    given = _read(form.lines, "lines", form.what, form.reason, None)
    action = MOTORS if form.what == "motors" else TIMES
    correct_many(runtime, given, form.reason, identity.name, action, form.version)
    return go_to("/photographs/times#recent-title")


@pages.post("/photographs/times/{number}/undo", dependencies=[OPERATE, COMPUTE_SLOT])
def post_undo_form(
    number: Annotated[Version, Path(description="Number of the audit trail's entry.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Restore the values before a change, and return to the page."""
    undo_batch(runtime, number, identity.name)
    return go_to("/photographs/times#recent-title")
