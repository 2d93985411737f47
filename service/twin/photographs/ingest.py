"""Ingest of a photograph: decode, measure, compare with the twin, and store.

One session reads all inputs. The computation runs outside any session. One transaction writes the
rows of image and measurement, and the heliostat's drift.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.ephemeris import SunContradiction
from model.errors import ImageRefusedError, InvalidInputError
from model.imaging import MeasuredFlux
from model.imaging.light import Camera, camera_at
from model.imaging.quality import Quality, refused
from model.plant import TargetPlane
from model.times import format_time
from service import store
from service.base.arrays import pack, to_json_value
from service.base.errors import NotFoundError, StoreFullError, TooLargeError
from service.base.monitoring import ACCURACY, PHOTOGRAPHS, REFUSALS
from service.base.settings import Settings
from service.sources.decode import Pixels
from service.sources.photograph import IncomingPhotograph
from service.store import image_files
from service.store.columns import now
from service.store.image_files import digest, media_type
from service.store.rows import Added
from service.store.tables import NO_IMAGE, ImageRow, MeasurementRow, SurfaceRow
from service.twin.measurements import HeliostatContext, accepted_measurement, load_heliostat_context
from service.twin.photographs.likeness import unlike_warnings
from service.twin.photographs.metadata import (
    find_sun_contradictions,
    metadata_columns,
    submitted_metadata,
    sun_warnings,
)
from service.twin.runtime import Runtime
from service.twin.surfaces import accuracy

# Tolerance for a camera's clock that is ahead of the server's clock.
_AHEAD = timedelta(days=1)


@dataclass(frozen=True, eq=False)
class _Known:
    """What the store knows before a photograph is measured.

    ``measurement`` is the photograph's row if it is stored already.
    """

    twin: HeliostatContext
    target_id: int
    plane: TargetPlane
    surface: SurfaceRow | None
    measurement: MeasurementRow | None


def ingest(
    runtime: Runtime,
    heliostat: str,
    photograph: IncomingPhotograph,
    data: bytes,
    is_live: bool = True,
    sent_by: str | None = None,
) -> Added[MeasurementRow]:
    """Measure and store a photograph.

    ``sent_by`` is who sent it. An image that cannot be measured is stored as refused, with its
    reason. A photograph from an archive is not ``is_live``, and is not compared with the current
    twin.

    Raises
    ------
    NotFoundError
        If the heliostat or the target is not stored.
    InvalidInputError, UnsupportedImageError, TooLargeError
        If the file cannot be decoded safely, or was taken in the future. It is not stored.
    ConflictError
        If the external id belongs to another image of the same kind, or the image is known as
        another kind, or at another heliostat.
    StoreFullError
        If the image quota is reached and no image may be deleted.
    """
    kind_of_file = media_type(data)
    require_past(photograph.taken_at)
    known = _read(runtime, heliostat, photograph, data)
    if known.measurement is not None:
        _restore_lost_file(runtime, data)
        PHOTOGRAPHS.labels("known").inc()
        return Added(known.measurement, False)
    pixels, measured = measure_photograph(
        runtime, photograph, data, known.plane, known.twin.model.cameras
    )
    height, width = pixels.shape[:2]
    del pixels  # up to 300 MB, and the next steps may wait for the model
    (contradiction,) = find_sun_contradictions([photograph], known.twin.origin)
    row = measurement_row(photograph, measured, known.target_id, contradiction)
    row.sent_by = sent_by
    judged = _forecast_accuracy(runtime, known, row) if is_live else None
    image = ImageRow(sha256=runtime.images.put(data), media_type=kind_of_file, size_bytes=len(data))
    image.width_px, image.height_px = width, height
    with runtime.database.writing() as session:
        row, is_new = store.add_measurement(session, known.twin.row, image, row)
        if is_new and not runtime.images.path(image.sha256).is_file():
            runtime.images.put(
                data
            )  # it was pruned, and its file removed before its row was locked
        if is_new and row.accepted and judged is not None and known.surface is not None:
            accuracy.record_drift(session, row, known.surface, judged, runtime.settings)
    _count(row, is_new, judged)
    return Added(row, is_new)


def store_position(
    runtime: Runtime, heliostat: str, photograph: IncomingPhotograph, sent_by: str | None = None
) -> Added[MeasurementRow]:
    """Store motor positions and a spot without an image.

    A stored photograph with the same external id has them already.

    Raises
    ------
    NotFoundError
        If the heliostat or the target is not stored.
    InvalidInputError
        If motors or spot are missing, or the time is in the future.
    """
    require_position(photograph)
    require_past(photograph.taken_at)
    with runtime.database.reading() as session:
        twin, target = (
            load_heliostat_context(session, heliostat),
            store.get_target(session, photograph.target),
        )
    (contradiction,) = find_sun_contradictions([photograph], twin.origin)
    row = position_row(photograph, target.id, contradiction)
    row.identifier = (
        photograph.external_id or digest(repr(submitted_metadata(photograph)).encode())[:16]
    )
    row.sent_by = sent_by
    with runtime.database.writing() as session:
        added = store.add_position(session, twin.row, row)
    PHOTOGRAPHS.labels("accepted" if added.is_new else "known").inc()
    return added


def require_position(photograph: IncomingPhotograph) -> None:
    """Raise InvalidInputError if a measurement without an image lacks motors or spot."""
    if photograph.motor_position is None:
        raise InvalidInputError(
            "motor_position: is missing; without an image motor_position and focal_spot_m are"
            " needed"
        )
    if photograph.focal_spot_wgs84 is None:
        raise InvalidInputError(
            "focal_spot_m: is missing; without an image motor_position and focal_spot_m are needed"
        )


def require_past(taken_at: datetime | None) -> None:
    """Raise InvalidInputError if a photograph was taken in the future.

    A surface that was computed from it would stay active until then.
    """
    if taken_at is not None and taken_at > now() + _AHEAD:
        raise InvalidInputError(
            f"taken_at: {format_time(taken_at)} lies ahead of this machine's"
            f" {format_time(now().replace(microsecond=0))}; set the clock that is wrong and post it"
            " again"
        )


def _restore_lost_file(runtime: Runtime, data: bytes) -> None:
    """Write a file that the store has lost.

    A pruned file is not written again, or repeated sends would fill the store.
    """
    with runtime.database.writing() as session:
        if session.get_one(ImageRow, digest(data), with_for_update=True).pruned_at is None:
            runtime.images.put(data)


def _require_quota(session: Session, settings: Settings, sha256: str, size: int) -> None:
    """Raise StoreFullError if the quota is reached and no image may be deleted.

    Otherwise the job `prunings` soon deletes images.
    """
    if image_files.excess_bytes(session, settings, size) and session.get(ImageRow, sha256) is None:
        quota = [
            rule
            for rule in image_files.retention_rules(session, settings)
            if rule.reason == "quota"
        ]
        if not image_files.has_candidates(session, quota):
            raise StoreFullError(
                f"the store's images have reached their quota of {settings.image_quota_gb:g} GB,"
                " and the active surfaces were made from all of them; nothing was stored: its"
                " operator must raise HELIOTWIN_IMAGE_QUOTA_GB"
            )


def _read(runtime: Runtime, heliostat: str, photograph: IncomingPhotograph, data: bytes) -> _Known:
    sha256 = digest(data)
    with runtime.database.reading() as session:
        _require_quota(session, runtime.settings, sha256, len(data))
        twin = load_heliostat_context(session, heliostat)
        target = store.get_target(session, photograph.target)
        return _Known(
            twin,
            target.id,
            store.target_plane(target),
            store.find_surface_at(session, twin.row),
            store.find_known_image(
                session,
                twin.row,
                sha256,
                photograph.kind or NO_IMAGE,
                photograph.forced is not None,
            ),
        )


class MeasuredImage(NamedTuple):
    """Pixels of an image, and its flux."""

    pixels: Pixels
    flux: MeasuredFlux


def measure_photograph(
    runtime: Runtime,
    photograph: IncomingPhotograph,
    data: bytes,
    plane: TargetPlane,
    cameras: Sequence[Camera],
) -> MeasuredImage:
    """Decode an image file and measure its flux on ``plane``, as seen by the plant's ``cameras``.

    Errors of the file are as in `ingest`.
    """
    if photograph.kind is None:
        raise InvalidInputError(
            "kind: is that of a measurement without an image, and an image came; name its kind"
        )
    limit = runtime.settings.max_image_bytes
    if len(data) > limit:
        raise TooLargeError(
            f"image: {len(data)} bytes is more than the {limit} allowed; crop or compress it"
        )
    corners = None if photograph.corners is None else np.array(photograph.corners)
    camera = camera_at(cameras, plane.name, photograph.taken_at)
    with runtime.decoded(data) as pixels, runtime.computing("measure") as operations:
        try:
            flux = operations.measure(
                pixels, photograph.kind, plane, corners=corners, camera=camera
            )
        except ImageRefusedError as refusal:
            flux = MeasuredFlux(refused(refusal.reason, refusal.detail))
        return MeasuredImage(pixels, flux)


def measure_stored(
    runtime: Runtime,
    row: MeasurementRow,
    photograph: IncomingPhotograph,
    twin: HeliostatContext,
    plane: TargetPlane,
) -> MeasuredImage:
    """Measure a stored image, with the metadata of ``photograph``."""
    if row.image_sha256 is None:
        raise NotFoundError(f"measurement {row.identifier} came without an image")
    data = runtime.images.read(row.image_sha256)
    return measure_photograph(runtime, photograph, data, plane, twin.model.cameras)


def measurement_row(
    photograph: IncomingPhotograph,
    measured: MeasuredFlux,
    target_id: int,
    contradiction: SunContradiction | None,
) -> MeasurementRow:
    """Create the row of a measurement, without heliostat, image and identifier."""
    arrays = {"flux": measured.flux, "centered": measured.centered, "square": measured.square}
    images: dict[str, NDArray[Any]] = {
        n: np.asarray(array, np.float32) for n, array in arrays.items() if array is not None
    }
    if measured.clipped is not None:
        images["clipped"] = measured.clipped
    spot, helios = photograph.focal_spot_wgs84, photograph.helios_spot_wgs84
    right, up = (
        (None, None) if measured.center_of_mass is None else measured.center_of_mass.tolist()
    )
    return MeasurementRow(
        external_id=photograph.external_id,
        kind=photograph.kind or NO_IMAGE,
        target_id=target_id,
        **metadata_columns(photograph),
        focal_spot_wgs84=None if spot is None else list(spot),
        helios_spot_wgs84=None if helios is None else list(helios),
        corners_px=(
            None if photograph.corners is None else {"corners": to_json_value(photograph.corners)}
        ),
        forced=photograph.forced,
        accepted=bool(measured.quality.accepted),
        reason=measured.quality.reason or None,
        quality=to_json_value(asdict(measured.quality))
        | {"clock": contradiction and contradiction.detail},
        warnings=sun_warnings(contradiction) or None,
        center_right_m=right,
        center_up_m=up,
        arrays=pack(images) if images else None,
    )


def position_row(
    photograph: IncomingPhotograph, target_id: int, contradiction: SunContradiction | None
) -> MeasurementRow:
    """Create the row of a measurement without an image, without heliostat and identifier."""
    row = measurement_row(
        photograph, MeasuredFlux(Quality(accepted=True)), target_id, contradiction
    )
    # Other quality figures need an image.
    row.quality = {"accepted": True, "clock": contradiction and contradiction.detail}
    return row


def _forecast_accuracy(runtime: Runtime, known: _Known, row: MeasurementRow) -> float | None:
    """Accuracy of the active surface's forecast; None if refused or unknown.

    The accuracy is added to ``row``, with a warning if another heliostat fits much better.
    """
    if not row.accepted:
        return None
    accepted = accepted_measurement(row, known.twin.origin, known.plane)
    judged = row.forecast_accuracy = accuracy.accuracy_on_arrival(
        runtime, known.twin, known.surface, accepted
    )
    if judged is not None:
        row.forecast_key = accuracy.forecast_key(known.twin, known.surface)
        unlike = unlike_warnings(runtime, known.twin, row, accepted, judged)
        row.warnings = [*(row.warnings or ()), *unlike] or None
    return judged


def _count(row: MeasurementRow, is_new: bool, judged: float | None) -> None:
    """Count a stored photograph in the metrics."""
    if is_new and judged is not None:
        ACCURACY.observe(judged)
    if is_new and not row.accepted:
        REFUSALS.labels(row.reason or "unknown").inc()
    PHOTOGRAPHS.labels(("accepted" if row.accepted else "refused") if is_new else "known").inc()
