"""The plant and its target planes."""

from typing import Any

from fastapi import APIRouter, Body, Depends, Response, status
from sqlalchemy.orm import Session

from model.frames import wgs84_to_enu
from model.plant import TargetPlane
from service import audit, representations, store
from service.dependencies import OPERATE, READ, IdentityDep, NamePath, RuntimeDep, require_json
from service.openapi import problems
from service.schemas import Corners, Page, PlantOut, ReceiverIn, ReceiverOut, TargetIn, TargetOut, TowerMeasurements

router = APIRouter(tags=["plant"])

_CORNERS = ("upper_left", "upper_right", "lower_left", "lower_right")
_RECEIVER_EXAMPLE = {"center": [0, 0, 55.2], "normal": [0, 1, 0], "radius": 4.1, "height": 5.2, "opening_deg": 60}
_PLANE_EXAMPLE = {"plane": {"center": [0, -3.2, 35.9], "normal": [0, 1, 0], "width": 8.6, "height": 7.2}}


def _from_corners(session: Session, name: str, corners: Corners) -> TargetPlane:
    origin = store.get_plant(session).origin
    return TargetPlane.from_corners(name, *(wgs84_to_enu(getattr(corners, corner), origin) for corner in _CORNERS))


def _paint_corners(document: dict[str, Any], name: str) -> dict[str, list[float]]:
    coordinates = document[name]["coordinates"]
    return {corner: [float(value) for value in coordinates[corner]] for corner in _CORNERS}


@router.get("/plant", responses=problems(409), dependencies=[READ])
def get_plant(runtime: RuntimeDep) -> PlantOut:
    """The plant's name and the tower base."""
    with runtime.database.reading() as session:
        return representations.plant(store.get_plant(session))


@router.put("/plant", responses=problems(409, 413, 415), dependencies=[OPERATE, Depends(require_json)])
def put_plant(document: TowerMeasurements, runtime: RuntimeDep, identity: IdentityDep) -> PlantOut:
    """Set the tower base, all planar targets and receivers from PAINT's tower measurements; again changes nothing."""
    from service.paint import read_receivers, read_targets

    origin, targets = read_targets(document.raw)
    receivers = read_receivers(document.raw)
    with runtime.database.writing() as session:
        change = store.put_plant(session, document.power_plant_properties.ID, origin)
        audit.record(session, identity.name, "plant.set", f"plant {document.power_plant_properties.ID}", change=change)
        for name, plane in targets.items():
            store.put_target(session, plane, _paint_corners(document.raw, name))
        for cylinder in receivers.values():
            store.put_receiver(session, cylinder)
        return representations.plant(store.get_plant(session))


@router.get("/targets", responses=problems(), dependencies=[READ])
def list_targets(runtime: RuntimeDep) -> Page[TargetOut]:
    """All target planes."""
    with runtime.database.reading() as session:
        return Page(items=[representations.target(row) for row in store.list_targets(session)], next=None)


@router.get("/targets/{name}", responses=problems(404), dependencies=[READ])
def get_target(name: NamePath, runtime: RuntimeDep) -> TargetOut:
    """A target plane."""
    with runtime.database.reading() as session:
        return representations.target(store.get_target(session, name))


@router.put(
    "/targets/{name}",
    responses={**problems(409, 413, 415), 201: {"model": TargetOut, "description": "It is new."}},
    dependencies=[OPERATE, Depends(require_json)],
)
def put_target(
    name: NamePath,
    request: TargetIn = Body(examples=[_PLANE_EXAMPLE]),
    *,
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
) -> TargetOut:
    """Set a target plane, by its rectangle [m] or by its four corners in WGS84."""
    with runtime.database.writing() as session:
        if request.corners is not None:
            plane = _from_corners(session, name, request.corners)
            corners = {corner: list(getattr(request.corners, corner)) for corner in _CORNERS}
        else:
            assert request.plane is not None  # the schema wants one of both
            plane, corners = request.plane.named(name), None
        row, change = store.put_target(session, plane, corners)
        audit.record(session, identity.name, "target.set", f"target {name}", change=change)
        if change is store.Change.NEW:
            response.status_code = status.HTTP_201_CREATED
        return representations.target(row)


@router.get("/receivers", responses=problems(), dependencies=[READ])
def list_receivers(runtime: RuntimeDep) -> Page[ReceiverOut]:
    """All cylindrical receivers."""
    with runtime.database.reading() as session:
        return Page(items=[representations.receiver(row) for row in store.list_receivers(session)], next=None)


@router.get("/receivers/{name}", responses=problems(404), dependencies=[READ])
def get_receiver(name: NamePath, runtime: RuntimeDep) -> ReceiverOut:
    """A cylindrical receiver."""
    with runtime.database.reading() as session:
        return representations.receiver(store.get_receiver(session, name))


@router.put(
    "/receivers/{name}",
    responses={**problems(409, 413, 415), 201: {"model": ReceiverOut, "description": "It is new."}},
    dependencies=[OPERATE, Depends(require_json)],
)
def put_receiver(
    name: NamePath,
    request: ReceiverIn = Body(examples=[_RECEIVER_EXAMPLE]),
    *,
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
) -> ReceiverOut:
    """Set a cylindrical receiver."""
    with runtime.database.writing() as session:
        row, change = store.put_receiver(session, request.named(name))
        audit.record(session, identity.name, "receiver.set", f"receiver {name}", change=change)
        if change is store.Change.NEW:
            response.status_code = status.HTTP_201_CREATED
        return representations.receiver(row)
