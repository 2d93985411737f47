"""Photographs and their measured flux."""

import json
from codecs import BOM_UTF8
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Depends, File, Form, Header, Query, Response, UploadFile, status
from pydantic import BaseModel, BeforeValidator, Field, Json, WrapValidator, model_validator
from pydantic.json_schema import SkipJsonSchema
from sqlalchemy.orm import Session
from starlette.datastructures import UploadFile as StarletteUploadFile
from starlette.requests import Request

from model.errors import InvalidInputError
from model.frames import enu_to_wgs84
from service import store
from service.base.arrays import pair_or_none, unpack
from service.base.errors import GoneError, NotFoundError, StoreDamagedError, TooLargeError
from service.base.fields import (
    CreatedAt,
    Flag,
    HeliostatOf,
    Identifier,
    Kind,
    MeasurementName,
    Model,
    Moment,
    Name,
    Number,
    Position,
    Reason,
    Rows,
    SunPosition,
    TargetOf,
    from_row,
    unique_keys,
)
from service.drawing.pictures import flux_picture
from service.sources.photograph import IncomingPhotograph
from service.sources.schema import WeatherFields, paint_motors
from service.store.listing import Order, Period
from service.store.measurements import MeasurementFilter
from service.store.photographs import newest_correction
from service.store.tables import ImageRow, MeasurementRow
from service.twin.photographs.metadata import spot_m
from service.twin.photographs.repeats import receive
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import photograph_name
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    INGEST,
    READ,
    RENDER_SLOT,
    IdentityDep,
    Limit,
    MeasurementPath,
    NamePath,
    RuntimeDep,
    require_multipart,
    set_tag,
)
from service.web.responses import formats
from service.web.responses.files import WholeFile, etag_matches
from service.web.responses.formats import MediaType, json_answer, maps_answer
from service.web.responses.lists import OrderQuery, Page, page, sheet_answer
from service.web.responses.openapi import BINARY, arrays, problems
from service.web.responses.representations import Maps

Motors = Annotated[
    tuple[Annotated[Number, Field(ge=-1e9, le=1e9)], Annotated[Number, Field(ge=-1e9, le=1e9)]],
    BeforeValidator(paint_motors),
]

Pixel = tuple[Annotated[Number, Field(ge=-1e5, le=1e5)], Annotated[Number, Field(ge=-1e5, le=1e5)]]


class MeasurementIn(WeatherFields, Model):
    """Metadata of a photograph."""

    target: Name = Field(description="The target that the heliostat was aimed at.")
    sun: SunPosition
    kind: Kind = Field(
        description=(
            "raw: a camera frame; cropped: the rectified target; flux: the separated spot on the"
            " whole target; flux-centered: the spot about its centre of mass, already separated;"
            " none: no image, but motor_position and focal_spot_m."
        )
    )
    id: Identifier | None = Field(
        default=None, description="The caller's own number of the measurement."
    )
    taken_at: Moment | None = Field(default=None, description="When it was taken, with time zone.")
    motor_position: Motors | None = Field(
        default=None,
        description="Motor positions of both axes [steps], as a pair or as PAINT's object.",
    )
    focal_spot_m: Position | None = Field(
        default=None,
        description="Known centre of mass: east, north, up of the tower base [m]; PAINT's UTIS.",
    )
    helios_spot_m: Position | None = Field(
        default=None, description="The same by HeliOS, used if there is no other; likewise [m]."
    )
    corners: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        default=None,
        description=(
            "Positions (x, y) [px] of the target's upper left, upper right, lower left and lower"
            " right corners in a raw frame; without them they are searched."
        ),
    )
    force: Flag = Field(
        default=False,
        description=(
            "Store the image although another heliostat has the same one; needs a `reason`."
        ),
    )
    reason: Reason | None = Field(
        default=None, description="Why it is forced; kept with the measurement."
    )

    @model_validator(mode="after")
    def _forced_with_reason(self) -> Self:
        if self.force != (self.reason is not None):
            raise ValueError("force and reason: send both, or neither")
        return self


class WarningOut(BaseModel):
    """A warning about a measurement, which its sender should check."""

    type: Literal["sun_contradicts_time", "unlike_heliostat"] = Field(
        description=(
            "sun_contradicts_time: the sun did not stand where it was recorded at the time that was"
            " sent. unlike_heliostat: when the photograph came, the surface of another heliostat"
            " forecast it much better than its own heliostat's."
        )
    )
    detail: str = Field(description="What contradicts what, in words.")
    angle_deg: float | None = Field(
        default=None,
        description=(
            "Between the recorded sun and where it was at the recorded time [deg]; null: of another"
            " type."
        ),
    )
    clock_ahead_h: float | None = Field(
        default=None,
        description="How far a clock that explains the recorded sun is ahead [h]; null: none does.",
    )
    like: str | None = Field(
        default=None,
        description="The heliostat that explains the photograph much better, of that type.",
    )


class MeasurementOut(BaseModel):
    """A stored measurement."""

    id: str = Field(description="Names it in this service's paths.")
    heliostat: HeliostatOf
    external_id: str | None = Field(description="The caller's own number.")
    kind: Kind = Field(description="What the image shows, as it was sent.")
    target: TargetOf
    sun: SunPosition
    motor_position: tuple[float, float] | None = Field(description="[steps]")
    taken_at: datetime | None = Field(description="null: the time is not known.")
    focal_spot_m: tuple[float, float, float] | None = Field(
        description="As given, else HeliOS's: east, north, up of the tower base [m]."
    )
    helios_spot_m: tuple[float, float, float] | None = Field(
        description="HeliOS's, if it was given: likewise [m]."
    )
    wind_speed_m_s: float | None = Field(description="[m/s]")
    wind_from_deg: float | None = Field(description="From north, over east [deg].")
    temperature_c: float | None = Field(description="[°C]")
    accepted: bool = Field(
        description="Whether the image can be used; a refused one is kept with its reason."
    )
    reason: str | None = Field(description="Why it was refused; `excluded`: a person excluded it.")
    warnings: list[WarningOut] = Field(
        description="What contradicts itself in what was sent; none where nothing does."
    )
    quality: dict[str, Any] = Field(
        description=(
            "The quality record of the image; `clock` says where time and sun disagree by over half"
            " a degree."
        )
    )
    center_of_mass_m: tuple[float, float] | None = Field(
        description="Right and up of the target's centre [m]."
    )
    image_sha256: str | None = Field(description="null: it came without an image.")
    image_media_type: str | None = Field(description="Media type of the file; null: no image.")
    image_pruned_at: datetime | None = Field(
        description="Since when the image is kept no longer; everything else of the measurement is."
    )
    corrected_at: datetime | None = Field(description="When it was last corrected or excluded.")
    forced: str | None = Field(
        description="Why it is stored although another heliostat has the same image."
    )
    created_at: CreatedAt
    sent_by: str | None = Field(
        description=(
            "Name of the key that sent it, `local` without one, or who imported it; null: not"
            " known."
        )
    )


class TakenQuery(Model):
    """A period, and the length of a page."""

    since: Moment | None = Field(None, description="Only those taken from then on, with zone.")
    until: Moment | None = Field(None, description="Only those taken before then, with zone.")
    limit: Limit = 100

    @property
    def taken(self) -> Period:
        """The period; without it all are listed, also those of an unknown time."""
        return Period(self.since, self.until)


class MeasurementFilterQuery(Model):
    """Filters of photographs and of their images."""

    target: Name | None = Field(None, description="Only photographs of this target.")
    dated: bool | None = Field(None, description="Only those of a known, or of an unknown time.")
    warned: bool | None = Field(None, description="Only those with warnings, or without any.")


class MeasurementListQuery(TakenQuery, MeasurementFilterQuery):
    """Which images of a heliostat are listed."""

    after: MeasurementName | None = Field(None, description="The last id of the page before.")
    accepted: bool | None = Field(None, description="Only accepted, or only refused ones.")
    kind: Kind | None = Field(None, description="Only images of this kind.")
    sort: Literal["created_at", "taken_at"] = Field(
        "created_at",
        description="By when they came, or were taken: then those of unknown time come last.",
    )
    order: OrderQuery = "up"


class PostedOut(MeasurementOut):
    """A posted photograph. If it was stored already, this includes what the post changed."""

    filled: list[str] = Field(
        description="Fields that were missing, and that this post filled; empty if it is new."
    )
    ignored: list[str] = Field(
        description="Fields that this post has otherwise than they are stored; PATCH corrects them."
    )


class MeasurementFluxOut(MeasurementOut):
    """A measurement with its flux."""

    flux: Rows | None = Field(
        description="On the whole target, sum 100 [%]; null: only what is about the spot is known."
    )
    centered: Rows = Field(description="(64, 64) in 4 m about the centre of mass, sum 100 [%].")


def measurement_out(session: Session, heliostat_name: str, row: MeasurementRow) -> MeasurementOut:
    """A measurement as JSON."""
    origin = store.get_plant(session).origin
    return from_row(
        MeasurementOut,
        row,
        id=row.identifier,
        heliostat=heliostat_name,
        target=row.target.name,
        motor_position=pair_or_none(row.motor_axis_1, row.motor_axis_2),
        focal_spot_m=spot_m(row.focal_spot_wgs84, origin),
        helios_spot_m=spot_m(row.helios_spot_wgs84, origin),
        warnings=row.warnings or [],
        center_of_mass_m=pair_or_none(row.center_right_m, row.center_up_m),
        image_media_type=row.image and row.image.media_type,
        image_pruned_at=row.image and row.image.pruned_at,
    )


_PRUNED = {
    "age": "it was as old as the store's settings allow",
    "quota": "the store's images had reached their quota",
    "deleted": "the photograph was deleted",
}


def require_image(row: MeasurementRow) -> ImageRow:
    """The image of a measurement.

    Raises
    ------
    NotFoundError
        If the measurement came without an image.
    GoneError
        If the image is no longer stored.
    """
    if row.image is None:
        raise NotFoundError(f"measurement {row.identifier} came without an image")
    if row.image.pruned_at is not None:
        raise GoneError(
            f"the image of measurement {row.identifier} was deleted on"
            f" {row.image.pruned_at:%Y-%m-%d}: {_PRUNED[row.image.pruned_for or 'age']}; its"
            " figures are kept"
        )
    return row.image


def flux_answer(
    session: Session, heliostat_name: str, row: MeasurementRow, media_type: str
) -> Response:
    """The flux of a measurement in the requested media type.

    Raises
    ------
    NotFoundError
        If the measurement has no image, or if its image was refused.
    """
    if row.image_sha256 is None:
        raise NotFoundError(
            f"measurement {row.identifier} came without an image, so it has no flux"
        )
    if row.arrays is None:
        raise NotFoundError(
            f"measurement {row.identifier} was refused ({row.reason}), so it has no flux"
        )
    arrays = unpack(row.arrays)
    if media_type == formats.JSON:
        document = measurement_out(session, heliostat_name, row)
        return json_answer(document, flux=arrays.get("flux"), centered=arrays.get("centered"))
    whole = "flux" in arrays
    size = (row.target.geometry["width"], row.target.geometry["height"]) if whole else None
    picture = partial(
        flux_picture, arrays["flux" if whole else "centered"], size, "flux [% per pixel]"
    )
    name, title = (
        f"{heliostat_name}-{row.identifier}-flux",
        f"{heliostat_name} {row.identifier}, measured",
    )
    return maps_answer(Maps(name, title, arrays, picture, row.arrays), media_type)


router = APIRouter(prefix="/heliostats/{name}/measurements", tags=["measurements"])
pages = APIRouter(include_in_schema=False)

# Generated clients know this media type of files, and no range such as ``image/*``.
OCTETS = "application/octet-stream"

# Largest metadata that are read from a form part with a file [bytes].
_MAX_METADATA = 2**16


def _wgs84(runtime: Runtime, place: Position | None) -> tuple[float, float, float] | None:
    if place is None:
        return None
    with runtime.database.reading() as session:
        origin = store.get_plant(session).origin
    latitude, longitude, altitude = enu_to_wgs84(place, origin).tolist()
    return latitude, longitude, altitude


def _photograph(metadata: MeasurementIn, runtime: Runtime) -> IncomingPhotograph:
    helios = metadata.helios_spot_m
    used = helios if metadata.focal_spot_m is None else metadata.focal_spot_m
    return IncomingPhotograph(
        target=metadata.target,
        kind=None if metadata.kind == "none" else metadata.kind,
        sun=metadata.sun,
        external_id=metadata.id,
        taken_at=metadata.taken_at,
        motor_position=metadata.motor_position,
        focal_spot_wgs84=_wgs84(runtime, used),
        helios_spot_wgs84=_wgs84(runtime, helios),
        corners=metadata.corners,
        weather=metadata.weather,
        forced=metadata.reason,
    )


def get_row(name: str, measurement: str, runtime: Runtime) -> MeasurementRow:
    """A heliostat's measurement; NotFoundError if it is not stored."""
    with runtime.database.reading() as session:
        return store.get_measurement(session, store.get_heliostat(session, name), measurement)


def _read_metadata(part: Any, refuse: Callable[[Any], MeasurementIn]) -> MeasurementIn:
    """The JSON of a form part. Some clients send it as a file, and some begin it with a BOM."""
    text = (
        part.file.read(_MAX_METADATA + 1).removeprefix(BOM_UTF8)
        if isinstance(part, UploadFile | StarletteUploadFile)
        else part.removeprefix("\ufeff")
    )
    try:
        given = json.loads(text, object_pairs_hook=unique_keys)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError):
        return refuse(text)  # as no JSON
    return MeasurementIn.model_validate(given)


def _file(part: Any) -> Any:
    """Require that a form part is a file. The default message names classes of the framework."""
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
        200: {
            "model": PostedOut,
            "description": "This image was there already; what was missing is filled.",
        },
    },
    dependencies=[INGEST, Depends(require_multipart), COMPUTE_SLOT],
)
def post_measurement(
    name: NamePath,
    metadata: Annotated[
        Json[MeasurementIn], WrapValidator(_read_metadata), Form(description="JSON")
    ],
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
    image: Annotated[
        UploadFile | SkipJsonSchema[None],
        BeforeValidator(_file),
        File(description="A PNG, JPEG, TIFF or BMP file; none if kind is none."),
    ] = None,
) -> PostedOut:
    """Post a photograph to measure and store.

    Motor positions and a spot may come without an image. The same image posted again is the same
    measurement (200 instead of 201). Missing fields are `filled`. Another focal spot, weather or
    corners are `ignored`. The measurement is then also found by this `id`. The image is refused
    (409) with another kind, sun, target, time or motor position, or at another heliostat; `detail`
    says what to do. An image that cannot be used is stored with `accepted: false` and its `reason`.
    """
    photograph = _photograph(metadata, runtime)
    if image is None and photograph.kind is not None:
        raise InvalidInputError(
            f"image: is missing, and kind says {photograph.kind}; send it, or kind none"
        )
    data = None if image is None else _bytes(image, runtime.settings.max_image_bytes)
    received = receive(runtime, name, photograph, data, actor=identity.name)
    response.headers["Location"] = f"/v1/heliostats/{name}/measurements/{received.row.identifier}"
    if not received.is_new:
        response.status_code = status.HTTP_200_OK
    with runtime.database.reading() as session:
        known = measurement_out(session, name, received.row).model_dump()
    return PostedOut(**known, filled=list(received.filled), ignored=list(received.ignored))


@router.get("", responses=problems(404), dependencies=[READ])
def list_measurements(
    name: NamePath, query: Annotated[MeasurementListQuery, Query()], runtime: RuntimeDep
) -> Page[MeasurementOut]:
    """List the photographs of a heliostat. They are in the order of arrival, or by time."""
    with runtime.database.reading() as session:
        rows = store.list_measurements(
            session,
            store.get_heliostat(session, name),
            query.limit + 1,
            query.after,
            MeasurementFilter(
                query.accepted, query.kind, query.target, query.dated, query.warned, query.taken
            ),
            Order("id" if query.sort == "created_at" else query.sort, query.order == "down"),
        )
        items = [measurement_out(session, name, row) for row in rows]
    return page(items, query.limit)


@router.get("/{measurement}", responses=problems(404), dependencies=[READ])
def get_measurement(
    name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep, response: Response
) -> MeasurementOut:
    """Get a photograph's measurement with its quality record. Its ETag is for PATCH."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
        set_tag(response, newest_correction(session, row))
        session.refresh(row)
        return measurement_out(session, name, row)


@router.get(
    "/{measurement}/image",
    response_class=Response,
    responses={
        **problems(404, 410),
        200: {
            "description": "The file as it was sent.",
            "content": {"image/*": {"schema": BINARY}, OCTETS: {"schema": BINARY}},
        },
        304: {"description": "If-None-Match names the file, which the client holds already."},
    },
    dependencies=[READ],
)
def get_image(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    request: Request,
    if_none_match: Annotated[
        str | None, Header(description="The ETag of a file that is held already.")
    ] = None,
) -> Response:
    """Get the image of a photograph as it was sent. The whole file is verified first.

    Accept: application/octet-stream gets the same bytes as that media type.
    """
    image = require_image(row := get_row(name, measurement, runtime))
    # Browsers may store it, but must ask again and present the key each time.
    headers = {"ETag": f'"{row.image_sha256}"', "Cache-Control": "private, no-cache"}
    if etag_matches(headers["ETag"], if_none_match):
        return Response(status_code=status.HTTP_304_NOT_MODIFIED, headers=headers)
    headers["X-Content-Type-Options"] = "nosniff"
    try:
        path = runtime.images.checked(image.sha256)
    except StoreDamagedError:
        require_image(
            get_row(name, measurement, runtime)
        )  # it may have been pruned after its row was read
        raise
    media_type = OCTETS if request.headers.get("accept") == OCTETS else image.media_type
    return WholeFile(path, media_type=media_type, headers=headers)


@router.get(
    "/{measurement}/flux",
    responses={**problems(404, 406), **arrays(MeasurementFluxOut, "`flux` and `centered`.")},
    dependencies=[READ],
)
def get_flux(
    name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep, media_type: MediaType
) -> Response:
    """Get the measured flux of a photograph, with a sum of 100.

    `flux` covers the whole target (256 x 256). `centered` covers 64 x 64 about the centre of mass.
    """
    with runtime.database.reading() as session:
        row = store.get_measurement(
            session, store.get_heliostat(session, name), measurement, arrays=True
        )
        return flux_answer(session, name, row, media_type)


# --- the table
# --------------------------------------------------------------------------------------------------


_QUALITY = (
    "signal_to_background",
    "signal_to_noise",
    "saturated_share",
    "cut_share",
    "second_spot_share",
    "energy_outside_window",
)
_PHOTOGRAPH = (
    "photograph",
    "id",
    "kind",
    "accepted",
    "reason",
    "detail",
    "taken_at",
    "target",
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "motor_axis_1",
    "motor_axis_2",
    "center_right_m",
    "center_up_m",
    *_QUALITY,
    "created_at",
    "sent_by",
    "corrected_at",
    "image_sha256",
)


def _cell(row: MeasurementRow, column: str) -> object:
    match column:
        case "photograph":
            return photograph_name(row)
        case "id":
            return row.identifier
        case "target":
            return row.target.name
    of_quality = column in ("detail", *_QUALITY)
    return row.quality.get(column) if of_quality else getattr(row, column)


def _images(name: NamePath, runtime: RuntimeDep) -> Sequence[MeasurementRow]:
    with runtime.database.reading() as session:
        return store.list_measurements(session, store.get_heliostat(session, name), None)


@pages.get("/heliostats/{name}/photographs.csv", dependencies=[READ, RENDER_SLOT])
def get_photographs_table(
    name: NamePath, images: Annotated[Sequence[MeasurementRow], Depends(_images)]
) -> Response:
    """All images of a heliostat's photographs, in the order of their arrival."""
    rows = ([_cell(row, column) for column in _PHOTOGRAPH] for row in images)
    return sheet_answer(f"{name}-photographs", _PHOTOGRAPH, rows)
