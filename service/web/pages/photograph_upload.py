"""Page that uploads photographs: several files of a heliostat, each with its sun by its time."""

import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import PurePath
from typing import Annotated
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Depends, Form, Request, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import Field, model_validator

from model.errors import InvalidInputError, ModelError
from model.imaging import ImageKind
from service import store
from service.base.errors import ServiceError
from service.base.fields import (
    AZIMUTH,
    ELEVATION,
    FormMoment,
    Model,
    Name,
    Sun,
    SunAt,
    drop_empty_fields,
    parse_moment,
)
from service.base.names import IDENTIFIER
from service.sources.photograph import IncomingPhotograph
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.forecasts.requests import position_of
from service.twin.photographs.repeats import ReceivedPhotograph, receive
from service.twin.runtime.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    RuntimeDep,
    require_multipart,
)
from service.web.resources.photographs import target_names
from service.web.responses.pages import render

router = APIRouter(include_in_schema=False, prefix="/photographs/upload")

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


def _page(
    request: Request, runtime: Runtime, form: UploadForm | None, uploaded: list[UploadedFile]
) -> HTMLResponse:
    with runtime.database.reading() as session:
        return render(
            request,
            "photograph_upload.html",
            form=form,
            uploaded=uploaded,
            targets=target_names(session),
            zone=plant_time_zone(session, runtime.settings.time_zone),
            limit=runtime.settings.max_image_bytes,
            most=_MOST,
        )


@router.get("", dependencies=[READ])
def get_upload_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """The form, and what it costs."""
    return _page(request, runtime, None, [])


@router.post("", dependencies=[OPERATE, Depends(require_multipart), COMPUTE_SLOT])
def post_upload_form(
    request: Request,
    form: Annotated[UploadForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> HTMLResponse:
    """Measure and store the files one by one, and show the verdict or the error of each."""
    with runtime.database.reading() as session:
        store.get_heliostat(session, form.heliostat)
        store.get_target(session, form.target)
    uploaded = [_store(runtime, form, file, identity.name) for file in form.files]
    return _page(request, runtime, form, uploaded)
