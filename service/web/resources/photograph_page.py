"""Page of a photograph: comparison with the forecast, correction form, and derived results."""

from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Form, Header, Query, Request, Response
from fastapi.responses import HTMLResponse

from service import store
from service.base.errors import NotFoundError
from service.base.fields import (
    AZIMUTH,
    ELEVATION,
    FormMoment,
    JsonObject,
    Model,
    Name,
    ReadVersion,
    Reason,
)
from service.drawing.pictures import photograph_picture
from service.drawing.templates import in_words
from service.store.measurements import EXCLUDED, images_of_photograph
from service.store.photographs import list_corrections, made_from, newest_correction
from service.store.tables import CorrectionRow, MeasurementRow
from service.twin.photographs.corrections import (
    GivenCorrection,
    NothingToChangeError,
    correct_photograph,
)
from service.twin.photographs.metadata import stored_metadata
from service.twin.photographs.stored_photograph import (
    delete_photograph,
    load_for_display,
    pixels_of,
)
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    MeasurementPath,
    NamePath,
    RuntimeDep,
    ZoneDep,
)
from service.web.resources.corrections import predict_again
from service.web.resources.heliostat_figures import forecast_figures
from service.web.resources.measurements import get_row, require_image
from service.web.responses.files import etag_matches
from service.web.responses.pages import go_to, render

pages = APIRouter(include_in_schema=False)

PATH = "/heliostats/{name}/photographs/{measurement}"


DIGITS = 4
"""Decimals of the sun's angles in the form [deg]."""


class CorrectionForm(Model):
    """The correction form, which is filled with the stored values of ``version``."""

    reason: Reason
    target: Name | None = None
    azimuth_deg: Annotated[float, AZIMUTH] | None = None
    elevation_deg: Annotated[float, ELEVATION] | None = None
    taken_at: FormMoment | None = None
    excluded: bool = False
    predict_again: bool = False
    version: ReadVersion = None

    def correction(
        self, heliostat: str, row: MeasurementRow, since: Sequence[CorrectionRow]
    ) -> GivenCorrection:
        """What its user changed of a stored photograph, which was corrected ``since`` it was shown.

        The page rounds angles and times.
        """
        shown: JsonObject = stored_metadata(row) | {"excluded": row.reason == EXCLUDED}
        for correction in reversed(since):
            shown |= correction.before
        before = shown["taken_at"] and datetime.fromisoformat(shown["taken_at"])
        rounded = {
            "target": shown["target"],
            "azimuth_deg": round(shown["sun.azimuth_deg"], DIGITS),
            "elevation_deg": round(shown["sun.elevation_deg"], DIGITS),
            "taken_at": before and before.replace(microsecond=0),
            "excluded": shown["excluded"],
        }
        given = {
            name: value
            for name, was in rounded.items()
            if (value := getattr(self, name)) not in (None, was)
        }
        return GivenCorrection(heliostat, row.identifier, self.reason, **given)


def change_texts(correction: CorrectionRow) -> list[str]:
    """Changes of a correction in words."""
    said = []
    for field, value in correction.after.items():
        if field == "excluded":
            said.append("excluded" if value else "no longer excluded")
        elif field == "flux":
            said.append("its flux was measured again")
        else:
            before, after = (
                "not known" if known is None else in_words(known)
                for known in (correction.before[field], value)
            )
            name = field.removesuffix("_deg").replace(".", " ").replace("_", " ")
            said.append(f"{name}: {before} → {after}")
    return said


class DeletionForm(Model):
    """The form that deletes a photograph."""

    reason: Reason
    confirmed: Literal["true"]


# Longest sides of a thumbnail and of a larger view [px]. The file has the full size.
_THUMBNAIL = 192
_SHOWN = 1000
_LARGE = 6000  # side for close inspection [px]: larger than the frame of any camera


def _thumbnail(runtime: Runtime, _: str, row: MeasurementRow) -> bytes:
    image = require_image(row)

    def draw() -> bytes:
        with pixels_of(runtime, row) as pixels:
            return photograph_picture(pixels, _THUMBNAIL)

    return runtime.images.thumbnail(image.sha256, draw)


def _outlined(runtime: Runtime, heliostat: str, row: MeasurementRow, most: int = _SHOWN) -> bytes:
    pixels, measured = load_for_display(runtime, heliostat, row)
    return photograph_picture(pixels, most, measured.corners)


def _crop(runtime: Runtime, heliostat: str, row: MeasurementRow) -> bytes:
    measured = load_for_display(runtime, heliostat, row)[1]
    if measured.crop is None:
        raise NotFoundError(
            f"measurement {row.identifier}: the target was not found in it, so it has no crop"
        )
    return photograph_picture(measured.crop, _SHOWN)


_VIEWS: dict[str, Callable[[Runtime, str, MeasurementRow], bytes]] = {
    "thumbnail": _thumbnail,
    "outlined": _outlined,
    "large": partial(_outlined, most=_LARGE),
    "crop": _crop,
}


@pages.get(PATH + "/{view}.jpg", dependencies=[READ, RENDER_SLOT])
def get_view(
    name: NamePath,
    measurement: MeasurementPath,
    view: Literal["thumbnail", "outlined", "large", "crop"],
    runtime: RuntimeDep,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """A reduced photograph, with the outline of the detected target, or rectified.

    It is made on request.
    """
    row = get_row(name, measurement, runtime)
    image = require_image(row)
    changed_at = row.corrected_at or row.created_at
    # Browsers may store it, but must ask again and present the key each time.
    headers = {
        "ETag": f'"{image.sha256[:32]}-{changed_at.timestamp():.0f}"',
        "Cache-Control": "private, no-cache",
    }
    if etag_matches(headers["ETag"], if_none_match):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(_VIEWS[view](runtime, name, row), media_type="image/jpeg", headers=headers)


def photograph_figures(runtime: Runtime, name: str, measurement: str) -> dict[str, object]:
    """What the page of a photograph shows."""
    with runtime.database.reading() as session:
        version = newest_correction(session)
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
        images = images_of_photograph(session, row)
        corrections, made = list_corrections(session, row), made_from(session, row)
        targets = [target.name for target in store.list_targets(session)]
    is_measured = row.accepted and row.image_sha256 is not None
    return {
        "version": version,
        "row": row,
        "images": images,
        "kept": {kind: image for kind, image in images.items() if image.has_file},
        "is_excluded": row.reason == EXCLUDED,
        "corrections": [(correction, change_texts(correction)) for correction in corrections],
        "made": made,
        "targets": targets,
        **forecast_figures(runtime, name, row if is_measured else None),
    }


@pages.get(PATH, dependencies=[READ, COMPUTE_SLOT])
def get_photograph_page(
    name: NamePath,
    measurement: MeasurementPath,
    request: Request,
    runtime: RuntimeDep,
    unchanged: Annotated[bool, Query(description="Say that a correction changed nothing.")] = False,
) -> HTMLResponse:
    """A photograph with its flux, the forecast of the current twin, and its history."""
    shown = photograph_figures(runtime, name, measurement)
    return render(request, "photograph.html", name=name, unchanged=unchanged, **shown)


def correction_of_form(
    runtime: Runtime, name: str, measurement: str, form: CorrectionForm, zone: str
) -> GivenCorrection:
    """What the form changes of a photograph, compared with what its user saw."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
        since = [] if form.version is None else list_corrections(session, row, form.version)
        session.refresh(row)
        return form.in_utc(zone).correction(name, row, since)


@pages.post(PATH, dependencies=[OPERATE, COMPUTE_SLOT])
def post_correction_form(
    name: NamePath,
    measurement: MeasurementPath,
    form: Annotated[CorrectionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
    zone: ZoneDep,
) -> Response:
    """Correct or exclude a photograph. Without a change, its page says so.

    Return to its page, or to the job that predicts the surface again.
    """
    given = correction_of_form(runtime, name, measurement, form, zone)
    try:
        correct_photograph(runtime, given, identity.name, form.version)
    except NothingToChangeError:
        return go_to(f"/heliostats/{name}/photographs/{measurement}?unchanged=true")
    if form.predict_again:
        return go_to(f"/jobs/{predict_again(runtime, name, identity.name)}")
    return go_to(f"/heliostats/{name}/photographs/{measurement}")


@pages.post(PATH + "/delete", dependencies=[OPERATE])
def post_deletion_form(
    name: NamePath,
    measurement: MeasurementPath,
    form: Annotated[DeletionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Delete all images of a photograph, and return to its heliostat."""
    delete_photograph(runtime, name, measurement, form.reason, identity.name)
    return go_to(f"/heliostats/{name}")
