"""Pages of the plant: targets, receivers and model, and settings, keys and audit trail."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import HTMLResponse
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.locating import BracketMarks, CameraCorners, CameraHomography, CameraPose, SheetEdges
from model.receivers import Cavity
from service import store
from service.base.fields import JsonObject, Version
from service.drawing.templates import figure
from service.jobs.kinds import measurements
from service.jobs.kinds.measurements import MeasurementsIn
from service.sources.documents import describe_sun
from service.sources.plant_schema import FacetGridEntry, HeliostatTypeEntry
from service.store import audit, keys
from service.store.tables import MeasurementRow, PlantRow, ReceiverRow, TargetRow
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.photographs.camera_choice import read_camera_choice
from service.twin.plant import model_versions
from service.twin.plant.model_versions import CameraAnswer
from service.web.auth.dependencies import ADMIN, OPERATE, READ, IdentityDep, RuntimeDep
from service.web.responses.pages import go_to_job, render

router = APIRouter(include_in_schema=False, prefix="/plant")

_PAGE = 100


_LOCATED_BY: Mapping[type, str] = {
    NoneType: "L and T marks",
    BracketMarks: "L brackets",
    SheetEdges: "edges",
    CameraCorners: "camera, by corners",
    CameraHomography: "camera, by homography",
    CameraPose: "camera, by pose",
}
"""What shows in photographs where a target is, by its locator; without one as at Juelich."""


def _located_by(row: TargetRow) -> str:
    return _LOCATED_BY[type(store.target_plane(row).locator)]


def _targets(session: Session) -> Sequence[tuple[TargetRow, int]]:
    """Target planes with the number of their photographs."""
    counted = (
        select(TargetRow, func.count(MeasurementRow.id))
        .outerjoin(MeasurementRow)
        .group_by(TargetRow.id)
    )
    return [(row, count) for row, count in session.execute(counted.order_by(TargetRow.name))]


_NO_SIZES: JsonObject = dict.fromkeys(("radius", "opening_deg", "panels", "aperture_m2"))


def _surface(row: ReceiverRow) -> JsonObject:
    """Sizes [m, m2] of a receiver and of a cavity's opening; those that it lacks are None."""
    receiver = store.stored_receiver(row)
    sizes = _NO_SIZES | receiver_as_json(receiver)
    if isinstance(receiver, Cavity):
        corners = receiver.aperture
        parts = np.cross(corners, np.roll(corners, -1, axis=0))
        sizes["aperture_m2"] = float(np.linalg.norm(parts.sum(axis=0)) / 2)
    return sizes


@dataclass(frozen=True)
class TypeLine:
    """A heliostat type of ``plant.yaml`` in the table, with its facets in words."""

    name: str
    entry: HeliostatTypeEntry
    facets: str


def _type_lines(plant: PlantRow | None) -> list[TypeLine]:
    """Heliostat types that the plant's file declares."""
    if plant is None or plant.heliostat_types is None:
        return []
    lines = []
    for name, declared in plant.heliostat_types["types"].items():
        entry = HeliostatTypeEntry.model_validate(declared)
        facets = entry.facets
        if isinstance(facets, FacetGridEntry):
            size = f"{facets.width_m:g} × {facets.height_m:g} m"
            text = f"{facets.rows * facets.columns} of {size}"
        else:
            text = f"as in {facets.file}"
        lines.append(TypeLine(name, entry, text))
    return lines


def _place(metres: Sequence[float]) -> list[str]:
    """East, north and up as parts of a table's cell."""
    east, north, up = (figure(value, 2) for value in metres)
    return [east, ", ", north, ", ", up]


@router.get("", dependencies=[READ])
def get_plant_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """Targets and receivers on the tower, and the optical model."""
    with runtime.database.reading() as session:
        plant = session.get(PlantRow, 1)
        targets = _targets(session)
        receivers = [(row, _surface(row)) for row in store.list_receivers(session)]
        model = None if plant is None else model_versions.get_model(session)
        camera = None if plant is None else read_camera_choice(session)
    sun = None if model is None else describe_sun(model.optics.sun_shape)
    return render(
        request,
        "plant.html",
        plant=plant,
        targets=targets,
        receivers=receivers,
        types=_type_lines(plant),
        model=model,
        place=_place,
        located_by=_located_by,
        sun=sun,
        camera=camera,
    )


@router.post("/camera", dependencies=[OPERATE])
def post_camera_form(
    camera: Annotated[CameraAnswer, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Begin the job that declares what images without background are, and measures them again."""
    payload = MeasurementsIn(camera=camera, reason="their camera was declared")
    return go_to_job(runtime, measurements.KIND, payload, identity)


@router.get("/settings", dependencies=[ADMIN])
def get_settings_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """The settings in force, without secrets."""
    return render(request, "settings.html", settings=runtime.settings.in_force)


@router.get("/keys", dependencies=[ADMIN])
def get_keys_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """Who has a key. The keys themselves are not stored."""
    with runtime.database.reading() as session:
        rows = keys.list_keys(session)
    return render(request, "keys.html", keys=rows)


@router.get("/audit", dependencies=[ADMIN])
def get_audit_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Who did what, newest first."""
    with runtime.database.reading() as session:
        rows = audit.entries(session, _PAGE + 1, after)
    more = rows[_PAGE - 1].id if len(rows) > _PAGE else None
    return render(request, "audit.html", entries=rows[:_PAGE], more=more, after=after)
