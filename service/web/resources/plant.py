"""The plant: REST of its tower, target planes and receivers, and its page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Annotated, Literal, Self

import numpy as np
from fastapi import APIRouter, Depends, Form, Request, Response, status
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from model.frames import wgs84_to_enu
from model.locating import BracketMarks, CameraCorners, CameraHomography, CameraPose, SheetEdges
from model.plant import Plant, TargetPlane
from model.receivers import Cavity
from service import store
from service.base.fields import JsonObject, Model, Plane, TargetOf, Wgs84, from_row
from service.base.plant import KIND, CavityIn, PanelsIn, PlaneReceiverIn, ReceiverIn, TowerSize
from service.drawing.templates import figure
from service.jobs.kinds import measurements
from service.jobs.kinds.measurements import MeasurementsIn
from service.sources.documents import (
    describe_sun,
    parse_declared,
    read_facts,
    read_receivers,
    read_targets,
    read_tower_base,
    unknown_parts,
)
from service.sources.plant_schema import CameraEntry, FacetGridEntry, HeliostatTypeEntry, Marks
from service.sources.schema import TowerMeasurements
from service.store import audit
from service.store.model_versions import declared_of, find_current
from service.store.rows import Put
from service.store.tables import PlantRow, ReceiverRow, TargetRow
from service.twin import plant_setup
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.model_versions import CameraAnswer, get_model
from service.twin.runtime import Runtime
from service.twin.studies.cameras import find_camera_choice
from service.web.auth.dependencies import (
    OPERATE,
    READ,
    AuthorshipDep,
    IdentityDep,
    NamePath,
    RuntimeDep,
    require_json,
    set_tag,
)
from service.web.responses.lists import Page
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to_job, render

Place = tuple[float, float, float]
"""East, north and up."""


class PlantOut(BaseModel):
    """The plant."""

    name: str = Field(description="Name of the plant.")
    origin_wgs84: tuple[float, float, float] = Field(
        description="Tower base: latitude [deg], longitude [deg], altitude [m]."
    )
    declared: dict[str, object] | None = Field(
        description=(
            "What is declared of its model, as in twin.json; null: Buie's sun with a ratio of 0.02,"
            " no effects, and optics of reflectivity 1 without attenuation."
        )
    )
    sun_shape: dict[str, object] = Field(
        description=(
            "The sun shape of the current model, and its numbers. Buie's has `chi` of the formula,"
            " and `csr`, the true circumsolar share."
        )
    )
    tower_size: TowerSize | None = Field(
        description="The tower, which casts a shadow; null: no shadow is known."
    )
    camera_choice: dict[str, object] | None = Field(
        description=(
            "What images without background are, as job `camera-choices` found, with its evidence."
            " Job `measurements` with a `camera` declares it. null: it is declared, or not known."
        )
    )


class PlaneOut(BaseModel):
    """A rectangle that light falls on. Imports may exceed the bounds of `Plane`."""

    center: Place = Field(description="Its middle: east, north, up of the tower base [m].")
    normal: Place = Field(description="Unit normal of the lit side.")
    up: Place = Field(description="Unit vector up its map.")
    width: float = Field(description="[m]")
    height: float = Field(description="[m]")


class _Stored(BaseModel):
    """What answers add to a target or receiver: its name, and defaults are never left out."""

    model_config = ConfigDict(extra="ignore", json_schema_serialization_defaults_required=True)

    name: TargetOf


class PlaneReceiverOut(PlaneReceiverIn, _Stored):
    """A flat receiver."""


class CylinderOut(_Stored):
    """A cylindrical receiver. PAINT's may exceed the bounds of `CylinderIn`."""

    kind: Literal["cylinder"] = KIND
    center: Place = Field(description="The middle of the lit surface [m].")
    normal: Place = Field(description="Unit normal there, away from the axis.")
    up: Place = Field(description="Unit vector along the axis.")
    radius: float = Field(description="[m]")
    height: float = Field(description="[m]")
    opening_deg: float = Field(description="Angle of the lit surface [deg].")
    absorptance: float = Field(description="Share of the light that it absorbs [1].")


class PanelsOut(PanelsIn, _Stored):
    """A receiver of panels side by side."""


class CavityOut(CavityIn, _Stored):
    """Panels behind an opening."""


ReceiverOut = Annotated[
    PlaneReceiverOut | CylinderOut | PanelsOut | CavityOut, Field(discriminator="kind")
]


class Corners(Model):
    """The corners of a target as seen from the field.

    In WGS84: latitude [deg], longitude [deg], altitude [m].
    """

    upper_left: Wgs84 = Field(description="[deg, deg, m]")
    upper_right: Wgs84 = Field(description="[deg, deg, m]")
    lower_left: Wgs84 = Field(description="[deg, deg, m]")
    lower_right: Wgs84 = Field(description="[deg, deg, m]")


class TargetIn(Model):
    """A target plane: a rectangle in east-north-up metres, or four corners in WGS84."""

    plane: Plane | None = Field(default=None, description="A rectangle [m]; or `corners`.")
    corners: Corners | None = Field(default=None, description="Four corners in WGS84.")
    marks: Marks | None = Field(
        default=None,
        description=(
            "What locates it in raw photographs: `l_brackets` at its corners; or `none`, and then"
            " its `camera`, or without a camera its edges. If both are left out, what is stored"
            " remains. A target that declares nothing is located by L and T marks as at the Solar"
            " Tower Juelich."
        ),
    )
    camera: CameraEntry | None = Field(
        default=None, description="The camera that looks at it, as in plant.yaml; without marks."
    )

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.plane is None) == (self.corners is None):
            raise ValueError("give either plane or corners")
        return self

    def located(self, plane: TargetPlane) -> TargetPlane:
        """The target with what locates it, if that is given.

        Raises
        ------
        InvalidInputError
            If its camera cannot see it.
        """
        if self.marks is None and self.camera is None:
            return plane
        given = self.model_dump(include={"marks", "camera"}, exclude_none=True)
        return plane.located_by({"marks": "none"} | given)


class TargetOut(PlaneOut, _Stored):
    """A target plane."""

    corners: dict[str, object] | None = Field(
        description="The WGS84 corners that it was made from, if it was."
    )
    marks: str | None = Field(
        description="The marks that locate it in raw photographs; null: not declared."
    )
    camera: dict[str, object] | None = Field(
        description="The camera that looks at it, if that is declared."
    )


def plant_out(session: Session) -> PlantOut:
    """The plant as JSON."""
    row, declared = store.get_plant(session), declared_of(session, find_current(session))
    camera = find_camera_choice(session)
    return PlantOut(
        name=row.name,
        origin_wgs84=row.origin,
        declared=declared,
        sun_shape=describe_sun(get_model(session).optics.sun_shape),
        tower_size=None if row.tower is None else TowerSize(**row.tower),
        camera_choice=camera and camera.result,
    )


def target_out(row: TargetRow) -> TargetOut:
    """A target plane as JSON."""
    located = row.locator or {}
    return from_row(
        TargetOut, row, **row.geometry, marks=located.get("marks"), camera=located.get("camera")
    )


class ReceiverPage(Page[ReceiverOut]):
    """All receivers, under a name that generated clients accept."""


def receiver_out(row: ReceiverRow) -> ReceiverOut:
    """A receiver as JSON."""
    return _RECEIVER.validate_python({"name": row.name, **store.receiver_document(row)})


_RECEIVER: TypeAdapter[ReceiverOut] = TypeAdapter(ReceiverOut)

router = APIRouter(tags=["plant"])
pages = APIRouter(include_in_schema=False)
_CORNERS = ("upper_left", "upper_right", "lower_left", "lower_right")


def _from_corners(session: Session, name: str, corners: Corners) -> TargetPlane:
    origin = store.get_plant(session).origin
    return TargetPlane.from_corners(
        name, *(wgs84_to_enu(getattr(corners, corner), origin) for corner in _CORNERS)
    )


@router.get("/plant", responses=problems(409), dependencies=[READ])
def get_plant(runtime: RuntimeDep, response: Response) -> PlantOut:
    """Get the plant: its name, tower base and declared model."""
    with runtime.database.reading() as session:
        plant = plant_out(session)
        set_tag(response, audit.version(session, f"plant {plant.name}", "plant.set"))
        return plant


@router.put(
    "/plant", responses=problems(409, 413, 415), dependencies=[OPERATE, Depends(require_json)]
)
def put_plant(document: TowerMeasurements, runtime: RuntimeDep, by: AuthorshipDep) -> PlantOut:
    """Set the plant: tower base, targets and receivers.

    The body is PAINT's tower measurements. Repeating the request changes nothing. `receivers` are
    of any kind, and `tower_size` casts a shadow. A part of a type that is not understood is
    refused. `declared` sets what is declared of the plant model, if it is given. An effect's
    `scope` says when it acts and at which `heliostats`. Without a scope, it acts at all of them.

    A scope of one mirror: `{"kind": "set", "heliostats": ["AB12"]}`.
    """
    for name, reason in unknown_parts(document.raw).items():
        raise InvalidInputError(f"{name}.{reason}")
    origin, targets = read_tower_base(document.raw), read_targets(document.raw)
    receivers, facts = read_receivers(document.raw), read_facts(document.raw)
    parse_declared(document.declared or {}, "declared")  # refuse models that cannot be computed
    places = {name: document.raw[name]["coordinates"] for name in targets}
    corners = {
        name: {corner: list(map(float, place[corner])) for corner in _CORNERS}
        for name, place in places.items()
    }

    def write(session: Session) -> PlantOut:
        plant = Plant(document.power_plant_properties.ID, origin, targets, receivers=receivers)
        plant_setup.set_plant(session, by, plant, document.declared, corners, facts)
        return plant_out(session)

    return runtime.database.run_in_transaction(write)


@router.get("/targets", responses=problems(), dependencies=[READ])
def list_targets(runtime: RuntimeDep) -> Page[TargetOut]:
    """List target planes."""
    with runtime.database.reading() as session:
        return Page(items=[target_out(row) for row in store.list_targets(session)], next=None)


@router.get("/targets/{name}", responses=problems(404), dependencies=[READ])
def get_target(name: NamePath, runtime: RuntimeDep, response: Response) -> TargetOut:
    """Get a target plane."""
    with runtime.database.reading() as session:
        set_tag(response, audit.version(session, f"target {name}", "target.set"))
        return target_out(store.get_target(session, name))


@router.put(
    "/targets/{name}",
    responses={**problems(409, 413, 415), 201: {"model": TargetOut, "description": "It is new."}},
    dependencies=[OPERATE, Depends(require_json)],
)
def put_target(
    name: NamePath, request: TargetIn, runtime: RuntimeDep, by: AuthorshipDep, response: Response
) -> TargetOut:
    """Set a target plane, by its rectangle [m] or its corners in WGS84.

    `marks` or `camera` say how raw photographs show where it is. They act on photographs that come
    later, and on those that are measured again.
    """

    def write(session: Session) -> Put[TargetRow]:
        if request.corners is not None:
            plane = _from_corners(session, name, request.corners)
            corners = {corner: list(getattr(request.corners, corner)) for corner in _CORNERS}
            return plant_setup.set_target(session, by, request.located(plane), corners)
        assert request.plane is not None  # the schema requires one of the two
        plane = request.plane.named(name)
        return plant_setup.set_target(session, by, request.located(plane))

    row, change = runtime.database.run_in_transaction(write)
    if change is store.Change.NEW:
        response.status_code = status.HTTP_201_CREATED
    return target_out(row)


@router.delete(
    "/targets/{name}",
    status_code=status.HTTP_204_NO_CONTENT,
    response_class=Response,
    responses=problems(404, 409),
    dependencies=[OPERATE],
)
def delete_target(name: NamePath, runtime: RuntimeDep, by: AuthorshipDep) -> None:
    """Delete a target plane that was created by mistake.

    This is refused if photographs, forecasts or waiting jobs refer to it.
    """
    runtime.database.run_in_transaction(
        lambda session: plant_setup.remove(session, by, "target", name)
    )


@router.get("/receivers", responses=problems(), dependencies=[READ])
def list_receivers(runtime: RuntimeDep) -> ReceiverPage:
    """List receivers of all kinds."""
    with runtime.database.reading() as session:
        every = [receiver_out(row) for row in store.list_receivers(session)]
    return ReceiverPage(items=every, next=None)


@router.get("/receivers/{name}", responses=problems(404), dependencies=[READ])
def get_receiver(name: NamePath, runtime: RuntimeDep, response: Response) -> ReceiverOut:
    """Get a receiver."""
    with runtime.database.reading() as session:
        set_tag(response, audit.version(session, f"receiver {name}", "receiver.set"))
        return receiver_out(store.get_receiver(session, name))


@router.put(
    "/receivers/{name}",
    responses={**problems(409, 413, 415), 201: {"model": ReceiverOut, "description": "It is new."}},
    dependencies=[OPERATE, Depends(require_json)],
)
def put_receiver(
    name: NamePath, request: ReceiverIn, runtime: RuntimeDep, by: AuthorshipDep, response: Response
) -> ReceiverOut:
    """Set a receiver: a plane, a cylinder, panels side by side, or a cavity.

    `kind` says which. Without it, the receiver is a cylinder.
    """
    row, change = runtime.database.run_in_transaction(
        lambda session: plant_setup.set_receiver(session, by, request.named(name))
    )
    if change is store.Change.NEW:
        response.status_code = status.HTTP_201_CREATED
    return receiver_out(row)


@router.delete(
    "/receivers/{name}",
    status_code=status.HTTP_204_NO_CONTENT,
    response_class=Response,
    responses=problems(404, 409),
    dependencies=[OPERATE],
)
def delete_receiver(name: NamePath, runtime: RuntimeDep, by: AuthorshipDep) -> None:
    """Delete a receiver that was created by mistake.

    This is refused if waiting jobs refer to it.
    """
    runtime.database.run_in_transaction(
        lambda session: plant_setup.remove(session, by, "receiver", name)
    )


# --- the page
# --------------------------------------------------------------------------------------------------

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


def plant_figures(runtime: Runtime) -> dict[str, object]:
    """What the page of the plant shows."""
    with runtime.database.reading() as session:
        plant = store.find_plant(session)
        model = None if plant is None else get_model(session)
        return {
            "plant": plant,
            "targets": store.count_photographs(session),
            "receivers": [(row, _surface(row)) for row in store.list_receivers(session)],
            "types": _type_lines(plant),
            "model": model,
            "sun": None if model is None else describe_sun(model.optics.sun_shape),
            "camera": find_camera_choice(session),
        }


@pages.get("/plant", dependencies=[READ])
def get_plant_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """Targets and receivers on the tower, and the optical model."""
    shown = plant_figures(runtime)
    return render(request, "plant.html", **shown, place=_place, located_by=_located_by)


@pages.post("/plant/camera", dependencies=[OPERATE])
def post_camera_form(
    camera: Annotated[CameraAnswer, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Begin the job that declares what images without background are, and measures them again."""
    payload = MeasurementsIn(camera=camera, reason="their camera was declared")
    return go_to_job(runtime, measurements.KIND, payload, identity)
