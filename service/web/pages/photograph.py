"""A photograph: its light against the forecast, the form that corrects or excludes it, and what was made from it."""

from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Form, Header, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy import select

from model.errors import ModelError
from service import store
from service.base.faults import NotFoundError, ServiceError
from service.base.fields import AZIMUTH, ELEVATION, FormMoment, Model, Name
from service.drawing.pictures import photograph_picture
from service.drawing.templates import in_words
from service.store.corrections import list_corrections, made_from
from service.store.measurements import EXCLUDED, images_of_shot
from service.store.tables import CorrectionRow, MeasurementRow, TargetRow
from service.twin.correcting import Changes, correct
from service.twin.runtime import Runtime
from service.twin.viewing import compare_one, look_at, pixels_of
from service.web.answers.files import is_held
from service.web.answers.pages import go_to, render
from service.web.api.corrections import remake
from service.web.api.measurements import get_row, require_image
from service.web.door.dependencies import (
    COMPUTES,
    DRAWS,
    OPERATE,
    READ,
    IdentityDep,
    MeasurementPath,
    NamePath,
    RuntimeDep,
)
from service.web.pages.heliostat import comparison_figures

router = APIRouter(include_in_schema=False)

PATH = "/heliostats/{name}/photographs/{measurement}"


class CorrectionForm(Model):
    """The form; its fields hold what is known already."""

    reason: str = Field(min_length=1, max_length=200)
    target_name: Name | None = None
    sun_azimuth: Annotated[float, AZIMUTH] | None = None
    sun_elevation: Annotated[float, ELEVATION] | None = None
    taken_at: FormMoment | None = None
    excluded: bool = False
    remake: bool = False


def told(correction: CorrectionRow) -> list[str]:
    """What a correction changed, in words."""
    said = []
    for field, value in correction.after.items():
        if field == "excluded":
            said.append("excluded" if value else "no longer excluded")
        elif field == "flux":
            said.append("its light was measured anew")
        else:
            before, after = (
                "not told" if known is None else in_words(known) for known in (correction.before[field], value)
            )
            said.append(f"{field.replace('_', ' ')}: {before} → {after}")
    return said


# Longest sides of a thumbnail and of what is shown larger [px]: the file itself has them all.
_THUMBNAIL = 192
_SHOWN = 1000
_LARGE = 6000  # side [px] of one to look at closely: no camera's frame is made smaller


def _thumbnail(runtime: Runtime, _: str, row: MeasurementRow) -> bytes:
    return photograph_picture(pixels_of(runtime, row), _THUMBNAIL)


def _outlined(runtime: Runtime, heliostat: str, row: MeasurementRow, most: int = _SHOWN) -> bytes:
    pixels, measured = look_at(runtime, heliostat, row)
    return photograph_picture(pixels, most, measured.corners)


def _crop(runtime: Runtime, heliostat: str, row: MeasurementRow) -> bytes:
    measured = look_at(runtime, heliostat, row)[1]
    if measured.crop is None:
        raise NotFoundError(f"measurement {row.identifier}: the target was not found in it, so it has no crop")
    return photograph_picture(measured.crop, _SHOWN)


_VIEWS: dict[str, Callable[[Runtime, str, MeasurementRow], bytes]] = {
    "thumbnail": _thumbnail,
    "outlined": _outlined,
    "large": partial(_outlined, most=_LARGE),
    "crop": _crop,
}


@router.get(PATH + "/{view}.jpg", dependencies=[READ, DRAWS])
def get_view(
    name: NamePath,
    measurement: MeasurementPath,
    view: Literal["thumbnail", "outlined", "large", "crop"],
    runtime: RuntimeDep,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """A photograph made small, with the target's outline as it was found, or rectified: made when it is asked for."""
    row = get_row(name, measurement, runtime)
    require_image(row)
    stands = row.corrected_at or row.created_at
    # It may be kept, but every use asks again, and shows its key again.
    headers = {"ETag": f'"{row.image_sha256[:32]}-{stands.timestamp():.0f}"', "Cache-Control": "private, no-cache"}
    if is_held(headers["ETag"], if_none_match):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(_VIEWS[view](runtime, name, row), media_type="image/jpeg", headers=headers)


@router.get(PATH, dependencies=[READ, COMPUTES])
def get_photograph_page(
    name: NamePath, measurement: MeasurementPath, request: Request, runtime: RuntimeDep
) -> HTMLResponse:
    """A photograph with its light, what today's twin forecasts of it, and its history."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
        images = images_of_shot(session, row)
        corrections, made = list_corrections(session, row), made_from(session, row)
        targets = session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all()
    compared, trouble = [], None
    if row.accepted:
        try:
            compared = [compare_one(runtime, name, measurement)]
        except (ModelError, ServiceError) as error:
            trouble = str(error)
    return render(
        request,
        "photograph.html",
        name=name,
        row=row,
        images=images,
        kept={kind: image for kind, image in images.items() if image.image.pruned_at is None},
        comparisons=comparison_figures(compared, runtime.settings.figure_scales["flux_difference"]),
        trouble=trouble,
        is_excluded=row.reason == EXCLUDED,
        corrections=[(row, told(row)) for row in corrections],
        made=made,
        targets=targets,
    )


@router.post(PATH, dependencies=[OPERATE, COMPUTES])
def post_correction_form(
    name: NamePath,
    measurement: MeasurementPath,
    form: Annotated[CorrectionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Correct or exclude a photograph, and go back to it, or to the job that makes the surface anew."""
    changes = Changes(
        reason=form.reason,
        target_name=form.target_name,
        sun_azimuth_deg=form.sun_azimuth,
        sun_elevation_deg=form.sun_elevation,
        taken_at=form.taken_at,
        excluded=form.excluded,
    )
    correct(runtime, name, measurement, changes, identity.name)
    if form.remake:
        return go_to(f"/jobs/{remake(runtime, name, identity.name)}")
    return go_to(f"/heliostats/{name}/photographs/{measurement}")
