"""A photograph on its way in: decoded, measured, kept, and held against today's twin."""

from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.errors import ImageRefusedError, InvalidInputError
from model.imaging import ImageKind, decode_image
from model.plant import TargetPlane
from service import store
from service.base.arrays import plain
from service.base.faults import TooLargeError
from service.base.meters import PHOTOGRAPHS, REFUSALS
from service.store.images import digest, media_type
from service.store.measurements import NewImage, NewMeasurement
from service.store.tables import MeasurementRow, now
from service.twin.accuracy import judge
from service.twin.runtime import Operations, Runtime

# How far a camera's clock may be ahead of ours.
_AHEAD = timedelta(days=1)


@dataclass(frozen=True)
class Photograph:
    """What is known of an image that comes in; units as in `service.store.tables.MeasurementRow`.

    ``corners``: pixels (x, y) of the target's upper left, upper right, lower left, lower right corner.
    """

    target_name: str
    kind: "ImageKind"
    sun_azimuth_deg: float
    sun_elevation_deg: float
    external_id: str | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    focal_spot_wgs84: tuple[float, float, float] | None = None
    corners: tuple[tuple[float, float], ...] | None = None


@dataclass(frozen=True, eq=False)
class _Reading:
    """A `MeasuredFlux` with its quality as JSON; everything but the quality is None where it was refused."""

    accepted: bool
    reason: str | None
    quality: dict[str, Any]
    flux: NDArray[Any] | None = None
    centered: NDArray[Any] | None = None
    center_of_mass: NDArray[Any] | None = None


def _read(operations: Operations, pixels: NDArray[Any], photograph: Photograph, plane: TargetPlane) -> _Reading:
    corners = None if photograph.corners is None else np.array(photograph.corners)
    try:
        measured = operations.measure(pixels, photograph.kind, plane, corners=corners)
    except ImageRefusedError as refusal:
        quality = {"accepted": False, "reason": refusal.reason, "detail": refusal.detail}
        return _Reading(accepted=False, reason=refusal.reason, quality=quality)
    quality = plain(asdict(measured.quality))
    return _Reading(
        accepted=bool(measured.quality.accepted),
        reason=measured.quality.reason or None,
        quality=quality,
        flux=measured.flux,
        centered=measured.centered,
        center_of_mass=measured.center_of_mass,
    )


def _decode(runtime: Runtime, data: bytes) -> NDArray[np.uint8]:

    limit = runtime.settings.max_image_bytes
    if len(data) > limit:
        raise TooLargeError(f"image: {len(data)} bytes is more than the {limit} allowed; crop or compress it")
    return decode_image(data, max_pixels=runtime.settings.max_image_pixels)


def _new_measurement(photograph: Photograph, image: NewImage, reading: _Reading, session: Session) -> NewMeasurement:
    return NewMeasurement(
        image=image,
        kind=photograph.kind,
        target=store.get_target(session, photograph.target_name),
        sun_azimuth_deg=photograph.sun_azimuth_deg,
        sun_elevation_deg=photograph.sun_elevation_deg,
        accepted=reading.accepted,
        quality=reading.quality,
        reason=reading.reason,
        external_id=photograph.external_id,
        motor_position=photograph.motor_position,
        taken_at=photograph.taken_at,
        focal_spot_wgs84=photograph.focal_spot_wgs84,
        corners_px=None if photograph.corners is None else {"corners": plain(photograph.corners)},
        center_of_mass=reading.center_of_mass,
        flux=reading.flux,
        centered=reading.centered,
    )


def _require_past(taken_at: datetime | None) -> None:
    """A surface from a photograph of next year would stay the current one until then."""
    if taken_at is not None and taken_at > now() + _AHEAD:
        raise InvalidInputError(
            f"taken_at: {taken_at.isoformat()} lies ahead of this machine's {now().isoformat(timespec='seconds')}; "
            "set the clock that is wrong and post it again"
        )


def ingest(runtime: Runtime, heliostat_name: str, photograph: Photograph, data: bytes) -> tuple[MeasurementRow, bool]:
    """Measure and keep a photograph; the second value is False where it was there already.

    An image that cannot be measured is kept too, not accepted, with its reason.

    Raises
    ------
    NotFoundError
        Where the heliostat or the target is not stored.
    InvalidInputError, UnsupportedImageError, TooLargeError
        Where the file is no image that can be decoded safely, or was taken in the future; it is not kept.
    ConflictError
        Where the external id belongs to another image of the same kind.
    """
    kind_of_file = media_type(data)
    _require_past(photograph.taken_at)
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, heliostat_name)
        plane = store.target_plane(store.get_target(session, photograph.target_name))
        known = store.find_measurement_of_image(session, heliostat, digest(data), photograph.kind)
        if known is not None:
            runtime.images.put(data)  # mends a file that the store has lost
            PHOTOGRAPHS.labels("known").inc()
            return known, False
    with runtime.computing("measure") as operations:
        pixels = _decode(runtime, data)
        reading = _read(operations, pixels, photograph, plane)
    height, width = pixels.shape[:2]
    image = NewImage(runtime.images.put(data), kind_of_file, len(data), width, height)
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, heliostat_name)
        new = _new_measurement(photograph, image, reading, session)
        row, is_new = store.add_measurement(session, heliostat, new)
    _watch(runtime, heliostat_name, row, is_new)
    return row, is_new


def _watch(runtime: Runtime, heliostat_name: str, row: MeasurementRow, is_new: bool) -> None:
    """Count a photograph that is stored, and hold it against the current twin."""
    pass  # late: it stands on this module

    if is_new and row.accepted:
        judge(runtime, heliostat_name, row)
    elif is_new:
        REFUSALS.labels(row.reason or "unknown").inc()
    PHOTOGRAPHS.labels(("accepted" if row.accepted else "refused") if is_new else "known").inc()
