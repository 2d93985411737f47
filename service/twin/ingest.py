"""A photograph on its way in: decoded, measured, held against today's twin, and kept.

What is read is read in one session, what is computed is computed outside of any, and what is kept is kept in one
transaction: the image's row, the measurement and what it says of the heliostat's drift.
"""

from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.ephemeris import clock_fault
from model.errors import ImageRefusedError, InvalidInputError
from model.frames import sun_direction
from model.imaging import MeasuredFlux
from model.imaging.light import camera_at
from model.imaging.quality import refused
from model.plant import TargetPlane
from service import store
from service.base.arrays import pack, plain
from service.base.faults import ConflictError, StoreFullError, TooLargeError
from service.base.meters import ACCURACY, PHOTOGRAPHS, REFUSALS
from service.base.settings import Settings
from service.sources.decode import Pixels, decode_image
from service.sources.photograph import Photograph
from service.store import photographs
from service.store.columns import now
from service.store.corrections import list_corrections
from service.store.images import digest, media_type
from service.store.tables import ImageRow, MeasurementRow, SurfaceRow
from service.twin import accuracy
from service.twin.evidence import Twin, evidence_of, load_twin
from service.twin.photographs import told_of, values_of
from service.twin.runtime import Runtime

# How far a camera's clock may be ahead of ours.
_AHEAD = timedelta(days=1)


@dataclass(frozen=True, eq=False)
class _Known:
    """What the store knows before a photograph is measured; ``measurement`` where it is this very photograph."""

    twin: Twin
    target_id: int
    plane: TargetPlane
    surface: SurfaceRow | None
    measurement: MeasurementRow | None


def ingest(
    runtime: Runtime, heliostat: str, photograph: Photograph, data: bytes, is_live: bool = True
) -> tuple[MeasurementRow, bool]:
    """Measure and keep a photograph; the second value is False where it was there already.

    An image that cannot be measured is kept too, not accepted, with its reason. One that is not ``is_live``, out of an
    archive, says nothing of today's twin, and is not held against it.

    Raises
    ------
    NotFoundError
        Where the heliostat or the target is not stored.
    InvalidInputError, UnsupportedImageError, TooLargeError
        Where the file is no image that can be decoded safely, or was taken in the future; it is not kept.
    ConflictError
        Where the external id belongs to another image of the same kind, or the image is known with another sun, target
        or time.
    StoreFullError
        Where the images' quota is reached and nothing may be given up.
    """
    kind_of_file = media_type(data)
    _require_past(photograph.taken_at)
    known = _read(runtime, heliostat, photograph, data)
    if known.measurement is not None:
        _require_same(runtime, heliostat, known.measurement, photograph)
        _mend(runtime, data)
        PHOTOGRAPHS.labels("known").inc()
        return known.measurement, False
    pixels, measured = measure_photograph(runtime, photograph, data, known.twin, known.plane)
    row = row_of(photograph, measured, known.target_id, clock_of(photograph, known.twin))
    judged = row.forecast_accuracy = _judge(runtime, known, row) if is_live else None
    height, width = pixels.shape[:2]
    image = ImageRow(sha256=runtime.images.put(data), media_type=kind_of_file, size_bytes=len(data))
    image.width_px, image.height_px = width, height
    with runtime.database.writing() as session:
        row, is_new = store.add_measurement(session, known.twin.row, image, row)
        if is_new and not runtime.images.path(image.sha256).is_file():
            runtime.images.put(data)  # it was given up before, and removed before its row was locked
        if is_new and row.accepted and judged is not None and known.surface is not None:
            accuracy.note(session, row, known.surface, judged, runtime.settings)
    _count(row, is_new, judged)
    return row, is_new


def _require_same(runtime: Runtime, heliostat: str, row: MeasurementRow, photograph: Photograph) -> None:
    """ConflictError where an image that is known came with other values; those that were corrected may come again."""
    with runtime.database.reading() as session:
        corrections = list_corrections(session, row)
    sent, stored = told_of(photograph), values_of(row)
    first = {name: value for correction in reversed(corrections) for name, value in correction.before.items()}
    apart = [
        f"{name}: {stored[name]} is stored, {value} was sent"
        for name, value in sent.items()
        if None not in (value, stored[name]) and value != stored[name] and value != first.get(name)
    ]
    if apart:
        raise ConflictError(
            f"{'; '.join(apart)}. The image is known already; to correct what is known of it, "
            f"PATCH /v1/heliostats/{heliostat}/measurements/{row.identifier}"
        )


def _require_past(taken_at: datetime | None) -> None:
    """A surface from a photograph of next year would stay the current one until then."""
    if taken_at is not None and taken_at > now() + _AHEAD:
        raise InvalidInputError(
            f"taken_at: {taken_at.isoformat()} lies ahead of this machine's {now().isoformat(timespec='seconds')}; "
            "set the clock that is wrong and post it again"
        )


def _mend(runtime: Runtime, data: bytes) -> None:
    """Write a file that the store has lost; one that it gave up stays away, or senders who repeat would fill it."""
    with runtime.database.writing() as session:
        if session.get_one(ImageRow, digest(data), with_for_update=True).pruned_at is None:
            runtime.images.put(data)


def _require_room(session: Session, settings: Settings, sha256: str, size: int) -> None:
    """StoreFullError where the quota is reached for good; else the job `prunings` makes room soon."""
    if photographs.excess_bytes(session, settings, size) and session.get(ImageRow, sha256) is None:
        quota = [rule for rule in photographs.rules(session, settings) if rule.reason == "quota"]
        if not photographs.has_some(session, quota):
            raise StoreFullError(
                f"the store's images have reached their quota of {settings.image_quota_gb:g} GB, and today's surfaces "
                "were made from all of them; nothing was kept: its operator must raise HELIOTWIN_IMAGE_QUOTA_GB"
            )


def _read(runtime: Runtime, heliostat: str, photograph: Photograph, data: bytes) -> _Known:
    sha256 = digest(data)
    with runtime.database.reading() as session:
        _require_room(session, runtime.settings, sha256, len(data))
        twin = load_twin(session, heliostat)
        target = store.get_target(session, photograph.target_name)
        return _Known(
            twin,
            target.id,
            store.target_plane(target),
            store.find_surface_at(session, twin.row),
            store.find_measurement_of_image(session, twin.row, sha256, photograph.kind),
        )


def measure_photograph(
    runtime: Runtime, photograph: Photograph, data: bytes, twin: Twin, plane: TargetPlane
) -> tuple[Pixels, MeasuredFlux]:
    """The pixels of an image file, and the flux on ``plane`` in them; raises what `ingest` raises of the file."""
    limit = runtime.settings.max_image_bytes
    if len(data) > limit:
        raise TooLargeError(f"image: {len(data)} bytes is more than the {limit} allowed; crop or compress it")
    corners = None if photograph.corners is None else np.array(photograph.corners)
    camera = camera_at(twin.model.cameras, plane.name, photograph.taken_at)
    with runtime.computing("measure") as operations:
        pixels = decode_image(data, max_pixels=runtime.settings.max_image_pixels)
        try:
            return pixels, operations.measure(pixels, photograph.kind, plane, corners=corners, camera=camera)
        except ImageRefusedError as refusal:
            return pixels, MeasuredFlux(refused(refusal.reason, refusal.detail))


def measure_stored(
    runtime: Runtime, row: MeasurementRow, photograph: Photograph, twin: Twin, plane: TargetPlane
) -> tuple[Pixels, MeasuredFlux]:
    """The same of an image that is kept, as ``photograph`` tells of it."""
    return measure_photograph(runtime, photograph, runtime.images.read(row.image_sha256), twin, plane)


def clock_of(photograph: Photograph, twin: Twin) -> str | None:
    """What is wrong with the time that the sender gave, by the sun; it is told, and refuses nothing."""
    if photograph.taken_at is None:
        return None
    sun = sun_direction(photograph.sun_azimuth_deg, photograph.sun_elevation_deg)
    return clock_fault(sun, photograph.taken_at, *twin.origin[:2])


def row_of(photograph: Photograph, measured: MeasuredFlux, target_id: int, clock: str | None) -> MeasurementRow:
    """The measurement as it is kept, but for its heliostat, image and identifier."""
    arrays = {"flux": measured.flux, "centered": measured.centered}
    kept: dict[str, NDArray[Any]] = {
        n: np.asarray(array, np.float32) for n, array in arrays.items() if array is not None
    }
    if measured.clipped is not None:
        kept["clipped"] = measured.clipped
    motors = photograph.motor_position or (None, None)
    spot, helios = photograph.focal_spot_wgs84, photograph.helios_spot_wgs84
    right, up = (None, None) if measured.center_of_mass is None else measured.center_of_mass.tolist()
    return MeasurementRow(
        external_id=photograph.external_id,
        kind=photograph.kind,
        target_id=target_id,
        sun_azimuth_deg=photograph.sun_azimuth_deg,
        sun_elevation_deg=photograph.sun_elevation_deg,
        motor_axis_1=motors[0],
        motor_axis_2=motors[1],
        taken_at=photograph.taken_at,
        focal_spot_wgs84=None if spot is None else list(spot),
        helios_spot_wgs84=None if helios is None else list(helios),
        corners_px=None if photograph.corners is None else {"corners": plain(photograph.corners)},
        **asdict(photograph.weather),
        accepted=bool(measured.quality.accepted),
        reason=measured.quality.reason or None,
        quality=plain(asdict(measured.quality)) | {"clock": clock},
        center_right_m=right,
        center_up_m=up,
        arrays=pack(kept) if kept else None,
    )


def _judge(runtime: Runtime, known: _Known, row: MeasurementRow) -> float | None:
    """How well today's twin forecasts an accepted photograph; None where that cannot be told."""
    if not row.accepted:
        return None
    return accuracy.judge(runtime, known.twin, known.surface, evidence_of(row, known.twin.origin, known.plane))


def _count(row: MeasurementRow, is_new: bool, judged: float | None) -> None:
    """Count a photograph that is stored."""
    if is_new and judged is not None:
        ACCURACY.observe(judged)
    if is_new and not row.accepted:
        REFUSALS.labels(row.reason or "unknown").inc()
    PHOTOGRAPHS.labels(("accepted" if row.accepted else "refused") if is_new else "known").inc()
