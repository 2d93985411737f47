"""Photographs and what was measured in them."""

from datetime import datetime
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, File, Form, Header, Query, Response, UploadFile, status
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Json, JsonValue
from starlette.datastructures import UploadFile as StarletteUploadFile

from model.pointing import Weather
from service import store
from service.base.arrays import pair, unpack
from service.base.faults import GoneError, NotFoundError, StoreDamagedError, TooLargeError
from service.base.fields import (
    Azimuth,
    Elevation,
    Identifier,
    Kind,
    MeasurementName,
    Model,
    Moment,
    Name,
    Number,
    Rows,
)
from service.drawing.pictures import flux_picture
from service.sources.photograph import Photograph
from service.sources.schema import FocalSpot, FocalSpots, paint_motors
from service.store.tables import MeasurementRow
from service.twin.ingest import ingest
from service.twin.runtime import Runtime
from service.web.answers import formats
from service.web.answers.files import WholeFile, is_held
from service.web.answers.formats import MediaType, json_answer, maps_answer
from service.web.answers.openapi import BINARY, arrays, problems
from service.web.answers.paging import Page, page
from service.web.answers.representation import Maps
from service.web.door.dependencies import (
    COMPUTES,
    INGEST,
    READ,
    Limit,
    MeasurementPath,
    NamePath,
    RuntimeDep,
    require_multipart,
)

Motors = Annotated[
    tuple[Annotated[Number, Field(ge=-1e9, le=1e9)], Annotated[Number, Field(ge=-1e9, le=1e9)]],
    BeforeValidator(paint_motors),
]

Pixel = tuple[Annotated[Number, Field(ge=-1e5, le=1e5)], Annotated[Number, Field(ge=-1e5, le=1e5)]]


WindSpeed = Annotated[Number, Field(ge=0, le=100)]
WindFrom = Annotated[Number, Field(ge=0, le=360)]
Temperature = Annotated[Number, Field(ge=-90, le=60)]

# What the documentation's form begins with.
_EXAMPLE: dict[str, JsonValue] = {
    "id": "205363",
    "kind": "flux",
    "target_name": "multi_focus_tower",
    "sun_azimuth": -41.2,
    "sun_elevation": 33.5,
}


class MeasurementIn(Model):
    """What is known of a photograph; PAINT's ``calibration-properties.json`` with ``kind`` (and ``id``) added fits."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})

    target_name: Name = Field(description="The target that the heliostat was aimed at.")
    sun_azimuth: Azimuth
    sun_elevation: Elevation
    kind: Kind = Field(
        description="raw: a camera frame; cropped: the rectified target; flux: the separated spot on the whole "
        "target; flux-centered: the spot about its centre of mass, already separated."
    )
    id: Identifier | None = Field(default=None, description="The caller's own number of the measurement.")
    taken_at: Moment | None = Field(default=None, description="When it was taken, with time zone.")
    motor_position: Motors | None = Field(
        default=None, description="Motor positions of both axes [steps], as a pair or as PAINT's object."
    )
    focal_spot: FocalSpot | None = Field(
        default=None,
        description="Known centre of mass: latitude [deg], longitude [deg], altitude [m], or PAINT's object (UTIS is "
        "preferred).",
    )
    corners: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        default=None,
        description="Positions (x, y) [px] of the target's upper left, upper right, lower left and lower right "
        "corners in a raw frame; without them they are searched.",
    )
    wind_speed_m_s: WindSpeed | None = Field(default=None, description="Of the wind then [m/s].")
    wind_from_deg: WindFrom | None = Field(default=None, description="Where it came from, from north, over east [deg].")
    temperature_c: Temperature | None = Field(default=None, description="Of the air then [°C].")


class MeasurementOut(BaseModel):
    """A stored measurement."""

    id: str = Field(description="Names it in this service's paths.")
    heliostat: str
    external_id: str | None = Field(description="The caller's own number.")
    kind: Kind
    target_name: str
    sun_azimuth: float = Field(description="From south, positive to the east [deg].")
    sun_elevation: float = Field(description="[deg]")
    motor_position: tuple[float, float] | None = Field(description="[steps]")
    taken_at: datetime | None
    focal_spot: tuple[float, float, float] | None = Field(
        description="As given, UTIS's, else HeliOS's: latitude [deg], longitude [deg], altitude [m]."
    )
    helios_spot: tuple[float, float, float] | None = Field(
        description="HeliOS's, where it was given: likewise [deg, deg, m]."
    )
    wind_speed_m_s: float | None = Field(description="[m/s]")
    wind_from_deg: float | None = Field(description="From north, over east [deg].")
    temperature_c: float | None = Field(description="[°C]")
    accepted: bool = Field(description="Whether the image can be used; a refused one is kept with its reason.")
    reason: str | None = Field(description="Why it was refused; `excluded`: somebody did.")
    quality: dict[str, Any] = Field(
        description="The quality record of the image; `clock` says where time and sun disagree by more than a degree."
    )
    center_of_mass: tuple[float, float] | None = Field(description="Right and up of the target's centre [m].")
    image_sha256: str
    image_media_type: str
    image_pruned_at: datetime | None = Field(
        description="Since when the image is kept no longer; everything else of the measurement is."
    )
    corrected_at: datetime | None = Field(description="Since when it stands so, where it was corrected or excluded.")
    created_at: datetime


class MeasurementFluxOut(MeasurementOut):
    """A measurement with its flux."""

    flux: Rows | None = Field(
        description="On the whole target, sum 100 [%]; null: only what is about the spot is known."
    )
    centered: Rows = Field(description="(64, 64) in 4 m about the centre of mass, sum 100 [%].")


def measurement_out(heliostat_name: str, row: MeasurementRow) -> MeasurementOut:
    """A measurement as JSON."""
    return MeasurementOut.model_validate(
        {
            "id": row.identifier,
            "heliostat": heliostat_name,
            "external_id": row.external_id,
            "kind": row.kind,
            "target_name": row.target.name,
            "sun_azimuth": row.sun_azimuth_deg,
            "sun_elevation": row.sun_elevation_deg,
            "motor_position": pair(row.motor_axis_1, row.motor_axis_2),
            "taken_at": row.taken_at,
            "focal_spot": row.focal_spot_wgs84,
            "helios_spot": row.helios_spot_wgs84,
            "wind_speed_m_s": row.wind_speed_m_s,
            "wind_from_deg": row.wind_from_deg,
            "temperature_c": row.temperature_c,
            "accepted": row.accepted,
            "reason": row.reason,
            "quality": row.quality,
            "center_of_mass": pair(row.center_right_m, row.center_up_m),
            "image_sha256": row.image_sha256,
            "image_media_type": row.image.media_type,
            "image_pruned_at": row.image.pruned_at,
            "corrected_at": row.corrected_at,
            "created_at": row.created_at,
        }
    )


_PRUNED = {"age": "it was as old as the store's settings allow", "quota": "the store's images had reached their quota"}


def require_image(row: MeasurementRow) -> None:
    """GoneError, which says why, where the image of a measurement is kept no longer."""
    if row.image.pruned_at is not None:
        raise GoneError(
            f"the image of measurement {row.identifier} was given up on {row.image.pruned_at:%Y-%m-%d}: "
            f"{_PRUNED[row.image.pruned_for or 'age']}; its figures are kept"
        )


def flux_answer(heliostat_name: str, row: MeasurementRow, media_type: str) -> Response:
    """The flux of a measurement; NotFoundError for a refused image, which has none."""
    if row.arrays is None:
        raise NotFoundError(f"measurement {row.identifier} was refused ({row.reason}), so it has no flux")
    arrays = unpack(row.arrays)
    if media_type == formats.JSON:
        document = measurement_out(heliostat_name, row)
        return json_answer(document, flux=arrays.get("flux"), centered=arrays.get("centered"))
    whole = "flux" in arrays
    size = (row.target.width_m, row.target.height_m) if whole else None
    picture = partial(flux_picture, arrays["flux" if whole else "centered"], size, "flux [% per pixel]")
    name, title = f"{heliostat_name}-{row.identifier}-flux", f"{heliostat_name} {row.identifier}, measured"
    return maps_answer(Maps(name, title, arrays, picture, row.arrays), media_type)


router = APIRouter(prefix="/heliostats/{name}/measurements", tags=["measurements"])

# Bytes of metadata that are read of a part that came as a file.
_MOST_METADATA = 2**16


def _photograph(metadata: MeasurementIn) -> Photograph:
    spot = metadata.focal_spot
    utis, helios = (spot.UTIS, spot.HeliOS) if isinstance(spot, FocalSpots) else (spot, None)
    return Photograph(
        target_name=metadata.target_name,
        kind=metadata.kind,
        sun_azimuth_deg=metadata.sun_azimuth,
        sun_elevation_deg=metadata.sun_elevation,
        external_id=metadata.id,
        taken_at=metadata.taken_at,
        motor_position=metadata.motor_position,
        focal_spot_wgs84=helios if utis is None else utis,
        helios_spot_wgs84=helios,
        corners=metadata.corners,
        weather=Weather(metadata.wind_speed_m_s, metadata.wind_from_deg, metadata.temperature_c),
    )


def get_row(name: str, measurement: str, runtime: Runtime) -> MeasurementRow:
    """A heliostat's measurement; NotFoundError where there is none."""
    with runtime.database.reading() as session:
        return store.get_measurement(session, store.get_heliostat(session, name), measurement)


def _text(part: Any) -> Any:
    """A part of the form; browsers send JSON as if it were a file."""
    return part.file.read(_MOST_METADATA + 1) if isinstance(part, UploadFile | StarletteUploadFile) else part


def _file(part: Any) -> Any:
    """A part of the form that is a file; the framework's own words for another name its classes."""
    if not isinstance(part, StarletteUploadFile):
        raise ValueError("must be a file; send it as a part with a filename")
    return part


def _bytes(upload: UploadFile, limit: int) -> bytes:
    data = upload.file.read(limit + 1)
    if len(data) > limit:
        raise TooLargeError(f"image: larger than the {limit} bytes allowed; crop or compress it")
    return data


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses={
        **problems(400, 404, 409, 413, 415, 507),
        200: {"model": MeasurementOut, "description": "This image was there already; nothing changed."},
    },
    dependencies=[INGEST, Depends(require_multipart), COMPUTES],
)
def post_measurement(
    name: NamePath,
    image: Annotated[UploadFile, BeforeValidator(_file), File(description="A PNG, JPEG, TIFF or BMP file.")],
    metadata: Annotated[Json[MeasurementIn], BeforeValidator(_text), Form(description="JSON")],
    runtime: RuntimeDep,
    response: Response,
) -> MeasurementOut:
    """Measure and keep a photograph of a heliostat's spot.

    The same image posted again is the same measurement (200 instead of 201); with another sun, target or time it is
    refused (409), and `PATCH` corrects what is known of it. An image that cannot be used is kept
    with `accepted: false` and its `reason`.
    """
    data = _bytes(image, runtime.settings.max_image_bytes)
    row, is_new = ingest(runtime, name, _photograph(metadata), data)
    response.headers["Location"] = f"/v1/heliostats/{name}/measurements/{row.identifier}"
    if not is_new:
        response.status_code = status.HTTP_200_OK
    return measurement_out(name, row)


@router.get("", responses=problems(404), dependencies=[READ])
def list_measurements(
    name: NamePath,
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[MeasurementName | None, Query(description="The last id of the page before.")] = None,
    accepted: Annotated[bool | None, Query(description="Only accepted, or only refused ones.")] = None,
) -> Page[MeasurementOut]:
    """A heliostat's measurements in the order they came."""
    with runtime.database.reading() as session:
        rows = store.list_measurements(session, store.get_heliostat(session, name), limit + 1, after, accepted)
    items = [measurement_out(name, row) for row in rows]
    return page(items, limit)


@router.get("/{measurement}", responses=problems(404), dependencies=[READ])
def get_measurement(name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep) -> MeasurementOut:
    """A measurement with its quality record."""
    return measurement_out(name, get_row(name, measurement, runtime))


@router.get(
    "/{measurement}/image",
    response_class=Response,
    responses={
        **problems(404, 410),
        200: {"description": "The file as it was sent.", "content": {"image/*": {"schema": BINARY}}},
        304: {"description": "If-None-Match names the file, which the client holds already."},
    },
    dependencies=[READ],
)
def get_image(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    if_none_match: Annotated[str | None, Header(description="The ETag of a file that is held already.")] = None,
) -> Response:
    """The image as it was sent; every byte of it is checked before the first one leaves."""
    row = get_row(name, measurement, runtime)
    require_image(row)
    # It may be kept, but every use asks again, and shows its key again.
    headers = {"ETag": f'"{row.image_sha256}"', "Cache-Control": "private, no-cache"}
    if is_held(headers["ETag"], if_none_match):
        return Response(status_code=status.HTTP_304_NOT_MODIFIED, headers=headers)
    headers["X-Content-Type-Options"] = "nosniff"
    try:
        path = runtime.images.checked(row.image_sha256)
    except StoreDamagedError:
        require_image(get_row(name, measurement, runtime))  # it may have been given up since its row was read
        raise
    return WholeFile(path, media_type=row.image.media_type, headers=headers)


@router.get(
    "/{measurement}/flux",
    responses={**problems(404, 406), **arrays(MeasurementFluxOut, "`flux` and `centered`.")},
    dependencies=[READ],
)
def get_flux(name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep, media_type: MediaType) -> Response:
    """The measured flux: over the whole target (256 x 256), and 64 x 64 about the centre of mass with sum 100."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement, arrays=True)
    return flux_answer(name, row, media_type)
