"""Photographs of the whole plant: the list, the queue of their review, and uploads."""

import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import PurePath
from typing import Annotated, Literal, NamedTuple, get_args
from urllib.parse import urlencode
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Depends, Form, Query, Request, Response, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import Field, model_validator
from sqlalchemy.orm import Session

from model.errors import InvalidInputError, ModelError
from model.imaging import ImageKind
from service import store
from service.base.errors import NotFoundError, ServiceError
from service.base.fields import (
    AZIMUTH,
    ELEVATION,
    FormDay,
    FormMoment,
    Model,
    Name,
    ReadVersion,
    Reason,
    Sun,
    SunAt,
    Version,
    drop_empty_fields,
    parse_moment,
    start_of_day,
)
from service.base.validation import IDENTIFIER
from service.sources.photograph import IncomingPhotograph
from service.store import audit
from service.store.listing import Period
from service.store.photographs import (
    PhotographFilter,
    PhotographGroup,
    PhotographVerdict,
    count_groups,
    get_group,
    list_groups,
    newest_correction,
)
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow
from service.twin.forecasts.aims import plant_time_zone
from service.twin.forecasts.requests import position_of
from service.twin.photographs.corrections import (
    GivenCorrection,
    NothingToChangeError,
    correct_photograph,
)
from service.twin.photographs.repeats import ReceivedPhotograph, receive
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    RuntimeDep,
    require_multipart,
)
from service.web.resources.heliostat_figures import forecast_figures
from service.web.resources.measurements import (
    MeasurementFilterQuery,
    MeasurementOut,
    TakenQuery,
    measurement_out,
)
from service.web.responses.lists import Page, page
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to, render

router = APIRouter(prefix="/measurements", tags=["measurements"])
pages = APIRouter(include_in_schema=False)

LISTED = 50
"""Photographs on a page."""

VERDICTS: tuple[PhotographVerdict, ...] = get_args(PhotographVerdict)


class PhotographOut(MeasurementOut):
    """A photograph: the image that decides its verdict, and the ids of all its images."""

    verdict: PhotographVerdict = Field(
        description="used: an image is accepted; else excluded by a person, or refused."
    )
    images: dict[str, str] = Field(description="The `id` of each image by its kind, this one too.")
    mark: int = Field(exclude=True)


class PhotographFilterQuery(MeasurementFilterQuery):
    """Filters of photographs, but for their period."""

    heliostat: Name | None = Field(None, description="Only this heliostat.")
    verdict: PhotographVerdict | None = Field(None, description="Only of this verdict.")
    after: Version | None = Field(None, description="`next` of the page before.")

    def taken_in(self, session: Session, period: Period) -> PhotographFilter:
        """The same as a filter; NotFoundError if heliostat or target are not stored."""
        return PhotographFilter(
            None if self.heliostat is None else store.get_heliostat(session, self.heliostat),
            None if self.target is None else store.get_target(session, self.target),
            self.verdict,
            period,
            self.dated,
            self.warned,
        )


class PhotographListQuery(TakenQuery, PhotographFilterQuery):
    """Which photographs REST lists."""


class PhotographsQuery(PhotographFilterQuery):
    """Filters of the page: ``since`` and ``until`` are days in the plant's zone, both inclusive."""

    since: FormDay | None = None
    until: FormDay | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def link(self, path: str = "/photographs", **more: int | None) -> str:
        """The URL of another page with the same filters."""
        asked = self.filters | {name: str(one) for name, one in more.items() if one is not None}
        return f"{path}?{urlencode(asked)}" if asked else path

    @property
    def filters(self) -> dict[str, str]:
        """The fields of the filters that are set, for hidden fields of forms."""
        asked = self.model_dump(mode="json", exclude_none=True, exclude={"after"})
        return {
            name: str(value).lower() if isinstance(value, bool) else str(value)
            for name, value in asked.items()
        }

    def filter(self, session: Session, zone: str) -> PhotographFilter:
        """The same as a filter; NotFoundError if heliostat or target are not stored."""
        days = Period(start_of_day(self.since, zone), start_of_day(self.until, zone, 1))
        return self.taken_in(session, days)


@router.get("", responses=problems(404), dependencies=[READ])
def list_plant_measurements(
    query: Annotated[PhotographListQuery, Query()], runtime: RuntimeDep
) -> Page[PhotographOut]:
    """List the photographs of the whole plant, newest first. Those of an unknown time come last.

    An item is a photograph. Its kinds of images are separate items of a heliostat's list.
    """
    with runtime.database.reading() as session:
        chosen = query.taken_in(session, query.taken)
        groups = list_groups(session, chosen, query.limit + 1, query.after)
        items = [
            PhotographOut(
                **dict(measurement_out(session, group.heliostat, group.best)),
                verdict=group.verdict,
                images={row.kind: row.identifier for row in group.images},
                mark=group.mark,
            )
            for group in groups
        ]
    return page(items, query.limit, "mark")


def photographs_figures(runtime: Runtime, query: PhotographsQuery) -> dict[str, object]:
    """The photographs on a page of the list, and what its filters offer."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        groups = list_groups(session, query.filter(session, zone), LISTED + 1, query.after)
        targets = [row.name for row in store.list_targets(session)]
    older = query.link(after=groups[LISTED - 1].mark) if len(groups) > LISTED else None
    return {"groups": groups[:LISTED], "targets": targets, "older": older, "verdicts": VERDICTS}


@pages.get("/photographs", dependencies=[READ, RENDER_SLOT])
def get_photographs_page(
    request: Request, query: Annotated[PhotographsQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """One page of photographs, with the filter form."""
    shown = photographs_figures(runtime, query)
    return render(request, "photographs.html", query=query, **shown)


# --- review
# --------------------------------------------------------------------------------------------------

_REVIEW = "/photographs/review"

REASONS = (
    "clouds",
    "another heliostat's light on it",
    "not on the target",
    "overexposed",
    "another heliostat",
    "wrong time or sun",
    "other",
)
"""Reasons to exclude that the page offers."""


class ReviewQuery(PhotographsQuery):
    """Filters as of the list, the shown photograph ``at``, and the correction to undo."""

    at: Version | None = None
    undo: Version | None = None

    @property
    def filters(self) -> dict[str, str]:
        """The filters without what the page shows."""
        shown = PhotographsQuery.model_fields
        return {name: one for name, one in super().filters.items() if name in shown}


class ReviewForm(ReviewQuery):
    """The buttons: ``next`` is the photograph after this one."""

    at: Version
    next: Version | None = None
    action: Literal["accept", "exclude"]
    reason: Reason = "reviewed"
    version: ReadVersion = None


class UndoForm(ReviewQuery):
    """The button that undoes the last exclusion."""

    undo: Version


def review_figures(runtime: Runtime, query: ReviewQuery) -> dict[str, object]:
    """A photograph to review, with its forecast and its place in the queue."""
    with runtime.database.reading() as session:
        version = newest_correction(session)
        chosen = query.filter(session, plant_time_zone(session, runtime.settings.time_zone))
        listed = list_groups(session, chosen, 1, query.after) if query.at is None else []
        group = get_group(session, query.at) if query.at else next(iter(listed), None)
        total, place, following = count_groups(session, chosen), 0, None
        if group is not None:
            row = next(image for image in group.images if image.id == group.mark)
            place = min(count_groups(session, chosen, row) + 1, max(total, 1))
            following = next(iter(list_groups(session, chosen, 1, group.mark)), None)
    name = "" if group is None else group.heliostat
    is_measured = group is not None and group.best.image_sha256 and group.verdict != "refused"
    return {
        "version": version,
        "group": group,
        "images": {image.kind: image for image in group.images if image.has_file} if group else {},
        "following": following,
        "place": place,
        "total": total,
        "reasons": REASONS,
        **forecast_figures(runtime, name, group.best if group and is_measured else None),
    }


@pages.get("/photographs/review", dependencies=[READ, COMPUTE_SLOT])
def get_review_page(
    request: Request, query: Annotated[ReviewQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """A photograph with its verdict and forecast, its place in the queue, and the buttons."""
    return render(request, "photograph_review.html", query=query, **review_figures(runtime, query))


def reviewed_group(runtime: Runtime, mark: int) -> PhotographGroup:
    """A photograph of the queue; NotFoundError if there is none."""
    with runtime.database.reading() as session:
        return get_group(session, mark)


def record_review(runtime: Runtime, group: PhotographGroup, actor: str) -> None:
    """Record in the audit trail that a photograph was looked at, and stays as it is."""
    subject = f"heliostat {group.heliostat} {group.best.identifier}"
    runtime.database.run_in_transaction(
        lambda session: audit.record(session, actor, "measurement.reviewed", subject)
    )


@pages.post("/photographs/review", dependencies=[OPERATE, COMPUTE_SLOT])
def post_review_form(
    form: Annotated[ReviewForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Accept or exclude a photograph, and go to the next one."""
    group, undo = reviewed_group(runtime, form.at), None
    if form.action == "accept" and group.verdict == "refused":
        raise InvalidInputError(
            f"action: {group.name} was refused by its measurement; correct it on its page instead"
        )
    given = GivenCorrection(
        group.heliostat, group.best.identifier, form.reason, excluded=form.action == "exclude"
    )
    try:
        corrected = correct_photograph(runtime, given, identity.name, form.version)
        undo = max(entry.id for entry in corrected.history)
    except NothingToChangeError:
        record_review(runtime, group, identity.name)
    if form.next is None:
        return go_to(form.link(_REVIEW, after=form.at, undo=undo))
    return go_to(form.link(_REVIEW, at=form.next, undo=undo))


class UndoneExclusion(NamedTuple):
    """What a correction excluded or accepted: the photograph, and the state before."""

    heliostat: str
    measurement: MeasurementRow
    excluded: bool


def undone_exclusion(runtime: Runtime, number: int) -> UndoneExclusion:
    """The exclusion or acceptance of this number; NotFoundError if there is none."""
    with runtime.database.reading() as session:
        correction = session.get(CorrectionRow, number)
        if correction is None or "excluded" not in correction.before:
            raise NotFoundError(f"undo: there is no exclusion {number}")
        row = session.get_one(MeasurementRow, correction.measurement_id)
        name = session.get_one(HeliostatRow, row.heliostat_id).name
        return UndoneExclusion(name, row, bool(correction.before["excluded"]))


@pages.post("/photographs/review/undo", dependencies=[OPERATE, COMPUTE_SLOT])
def post_undo_form(
    form: Annotated[UndoForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Undo an exclusion or acceptance, and show the photograph again."""
    name, row, was_excluded = undone_exclusion(runtime, form.undo)
    given = GivenCorrection(name, row.identifier, "review undone", excluded=was_excluded)
    with suppress(NothingToChangeError):
        correct_photograph(runtime, given, identity.name, form.undo)
    return go_to(form.link(_REVIEW, at=row.id))


# --- uploads
# --------------------------------------------------------------------------------------------------

_MOST = 200
_TIME = re.compile(
    r"(?<!\d)(\d{4})-?([01]\d)-?([0-3]\d)[T_ -]([0-2]\d)[-:.]?([0-5]\d)[-:.]?([0-5]\d)?(?!\d)"
)


class UploadForm(Model):
    """The form: the time of a file is that in its name, else ``taken_at``."""

    heliostat: Name
    target: Name
    kind: ImageKind
    files: Annotated[list[UploadFile], Field(min_length=1, max_length=_MOST)]
    taken_at: FormMoment | None = None
    azimuth_deg: Annotated[float, AZIMUTH] | None = None
    elevation_deg: Annotated[float, ELEVATION] | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)


@dataclass(frozen=True)
class UploadedFile:
    """A file with what was stored, or the reason that it was not."""

    name: str
    received: ReceivedPhotograph | None = None
    error: str = ""


def time_in_name(name: str, zone: str) -> datetime | None:
    """The time in a file's name, such as ``2026-06-21_12-03-00``, in the zone."""
    found = _TIME.search(name)
    if found is None:
        return None
    try:
        at = datetime(*(int(part or 0) for part in found.groups()))  # type: ignore[arg-type]
        return parse_moment(at.replace(tzinfo=ZoneInfo(zone)))
    except ValueError:
        return None


def _photograph(runtime: Runtime, form: UploadForm, name: str) -> IncomingPhotograph:
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        taken_at = time_in_name(name, zone) or form.in_utc(zone).taken_at
        if form.azimuth_deg is not None and form.elevation_deg is not None:
            sun = Sun(azimuth_deg=form.azimuth_deg, elevation_deg=form.elevation_deg)
        elif taken_at is not None:
            sun = position_of(session, SunAt(at=taken_at))
        else:
            raise InvalidInputError("no time in the file's name; fill in the time, or the sun")
    stem = PurePath(name).stem
    identifier = stem if re.fullmatch(IDENTIFIER, stem) else None
    return IncomingPhotograph(
        form.target, form.kind, sun, external_id=identifier, taken_at=taken_at
    )


def _store(runtime: Runtime, form: UploadForm, file: UploadFile, actor: str) -> UploadedFile:
    name = file.filename or "file"
    try:
        data = file.file.read()
        if not data:
            raise InvalidInputError("the file is empty")
        photograph = _photograph(runtime, form, name)
        return UploadedFile(name, receive(runtime, form.heliostat, photograph, data, actor=actor))
    except (ModelError, ServiceError) as error:
        return UploadedFile(name, error=str(error))


def upload_figures(runtime: Runtime) -> dict[str, object]:
    """What the form of uploads offers."""
    with runtime.database.reading() as session:
        return {
            "targets": [row.name for row in store.list_targets(session)],
            "zone": plant_time_zone(session, runtime.settings.time_zone),
            "limit": runtime.settings.max_image_bytes,
            "most": _MOST,
        }


@pages.get("/photographs/upload", dependencies=[READ])
def get_upload_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """The form, and what it costs."""
    shown = upload_figures(runtime)
    return render(request, "photograph_upload.html", form=None, uploaded=[], **shown)


def store_files(runtime: Runtime, form: UploadForm, actor: str) -> list[UploadedFile]:
    """Measure and store the files of a form one by one.

    Raises
    ------
    NotFoundError
        If the heliostat or the target is not stored.
    """
    with runtime.database.reading() as session:
        store.get_heliostat(session, form.heliostat)
        store.get_target(session, form.target)
    return [_store(runtime, form, file, actor) for file in form.files]


@pages.post("/photographs/upload", dependencies=[OPERATE, Depends(require_multipart), COMPUTE_SLOT])
def post_upload_form(
    request: Request,
    form: Annotated[UploadForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> HTMLResponse:
    """Measure and store the files one by one, and show the verdict or the error of each."""
    uploaded = store_files(runtime, form, identity.name)
    shown = upload_figures(runtime)
    return render(request, "photograph_upload.html", form=form, uploaded=uploaded, **shown)
