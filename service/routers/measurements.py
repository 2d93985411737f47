"""Photographs and what was measured in them."""

from typing import Annotated

from fastapi import APIRouter, Depends, File, Form, Query, Response, UploadFile, status
from pydantic import Json

from service import representations, store
from service.dependencies import (
    INGEST,
    READ,
    Limit,
    MeasurementPath,
    MediaType,
    NamePath,
    RuntimeDep,
    require_multipart,
)
from service.faults import TooLargeError
from service.openapi import arrays, problems
from service.schemas import MeasurementIn, MeasurementName, MeasurementOut, Page
from service.workflows import Photograph, ingest

router = APIRouter(prefix="/heliostats/{name}/measurements", tags=["measurements"])

_METADATA_EXAMPLE = (
    '{"id": "205363", "kind": "flux", "target_name": "multi_focus_tower", "sun_azimuth": -41.2, "sun_elevation": 33.5}'
)


def _photograph(metadata: MeasurementIn) -> Photograph:
    return Photograph(
        target_name=metadata.target_name,
        kind=metadata.kind,
        sun_azimuth_deg=metadata.sun_azimuth,
        sun_elevation_deg=metadata.sun_elevation,
        external_id=metadata.id,
        taken_at=metadata.taken_at,
        motor_position=metadata.motor_position,
        focal_spot_wgs84=metadata.focal_spot,
        corners=metadata.corners,
    )


def _bytes(upload: UploadFile, limit: int) -> bytes:
    data = upload.file.read(limit + 1)
    if len(data) > limit:
        raise TooLargeError(f"image: larger than the {limit} bytes allowed; crop or compress it")
    return data


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses={
        **problems(400, 404, 409, 413, 415),
        200: {"model": MeasurementOut, "description": "This image was there already; nothing changed."},
    },
    dependencies=[INGEST, Depends(require_multipart)],
)
def post_measurement(
    name: NamePath,
    image: Annotated[UploadFile, File(description="A PNG, JPEG, TIFF or BMP file.")],
    metadata: Annotated[Json[MeasurementIn], Form(description="JSON", examples=[_METADATA_EXAMPLE])],
    runtime: RuntimeDep,
    response: Response,
) -> MeasurementOut:
    """Measure and keep a photograph of a heliostat's spot.

    The same image posted again is the same measurement (200 instead of 201). An image that cannot be used is kept
    with `accepted: false` and its `reason`.
    """
    data = _bytes(image, runtime.settings.max_image_bytes)
    row, is_new = ingest(runtime, name, _photograph(metadata), data)
    response.headers["Location"] = f"/v1/heliostats/{name}/measurements/{row.identifier}"
    if not is_new:
        response.status_code = status.HTTP_200_OK
    return representations.measurement(name, row)


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
    items = [representations.measurement(name, row) for row in rows]
    return representations.page(items, limit)


@router.get("/{measurement}", responses=problems(404), dependencies=[READ])
def get_measurement(name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep) -> MeasurementOut:
    """A measurement with its quality record."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
    return representations.measurement(name, row)


@router.get(
    "/{measurement}/image",
    response_class=Response,
    responses={**problems(404), 200: {"description": "The file as it was sent.", "content": {"image/*": {}}}},
    dependencies=[READ],
)
def get_image(name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep) -> Response:
    """The image as it was sent."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
    headers = {"ETag": f'"{row.image_sha256}"', "X-Content-Type-Options": "nosniff"}
    return Response(runtime.images.read(row.image_sha256), media_type=row.image.media_type, headers=headers)


@router.get(
    "/{measurement}/flux", responses={**problems(404, 406), **arrays("`flux` and `centered`.")}, dependencies=[READ]
)
def get_flux(name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep, media_type: MediaType) -> Response:
    """The measured flux: over the whole target (256 x 256), and 64 x 64 about the centre of mass with sum 100."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement, arrays=True)
    return representations.measured_flux(name, row, media_type)
