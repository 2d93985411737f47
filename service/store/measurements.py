"""Images and measurements, as they are kept and found again."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, undefer

from service.base import names
from service.base.arrays import pack
from service.base.faults import ConflictError, NotFoundError
from service.store.rows import ROUNDS, floats, insert
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow, TargetRow

# Which image of a measurement to use where there are several: separated ones first, for they need no guess.
PREFERENCE = ("flux", "cropped", "raw", "flux-centered")


@dataclass(frozen=True)
class NewImage:
    """An image file that lies in the image store; size in bytes and pixels."""

    sha256: str
    media_type: str
    size_bytes: int
    width_px: int
    height_px: int


@dataclass(frozen=True, eq=False)
class NewMeasurement:
    """A measured photograph to be stored; units as in `service.store.tables.MeasurementRow`.

    ``flux`` (256, 256) over the whole target and ``centered`` (64, 64) are None where the image was refused.
    """

    image: NewImage
    kind: str
    target: TargetRow
    sun_azimuth_deg: float
    sun_elevation_deg: float
    accepted: bool
    quality: dict[str, Any]
    reason: str | None = None
    external_id: str | None = None
    motor_position: tuple[float, float] | None = None
    taken_at: datetime | None = None
    focal_spot_wgs84: tuple[float, float, float] | None = None
    corners_px: dict[str, Any] | None = None
    center_of_mass: ArrayLike | None = None
    flux: NDArray[Any] | None = None
    centered: NDArray[Any] | None = None


def _measurements(heliostat: HeliostatRow) -> Select[MeasurementRow]:
    return select(MeasurementRow).where(MeasurementRow.heliostat_id == heliostat.id)


def find_measurement_of_image(
    session: Session, heliostat: HeliostatRow, sha256: str, kind: str
) -> MeasurementRow | None:
    """The measurement that this image of this kind already is, or None."""
    query = _measurements(heliostat).where(MeasurementRow.image_sha256 == sha256, MeasurementRow.kind == kind)
    return session.scalar(query)


def find_measurement(session: Session, heliostat: HeliostatRow, identifier: str) -> MeasurementRow | None:
    """The measurement of this identifier, or None."""
    return session.scalar(_measurements(heliostat).where(MeasurementRow.identifier == identifier))


def get_measurement(session: Session, heliostat: HeliostatRow, identifier: str, arrays: bool = False) -> MeasurementRow:
    """The measurement of this identifier, with its ``arrays`` where wanted; NotFoundError where there is none."""
    query = _measurements(heliostat).where(MeasurementRow.identifier == identifier)
    row = session.scalar(query.options(undefer(MeasurementRow.arrays)) if arrays else query)
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no measurement {identifier}")
    return row


def list_measurements(
    session: Session, heliostat: HeliostatRow, limit: int, after: str | None = None, accepted: bool | None = None
) -> Sequence[MeasurementRow]:
    """Up to ``limit`` measurements in the order they came, those after the one called ``after``."""
    query = _measurements(heliostat).order_by(MeasurementRow.id).limit(limit)
    if accepted is not None:
        query = query.where(MeasurementRow.accepted == accepted)
    if after is not None:
        query = query.where(MeasurementRow.id > get_measurement(session, heliostat, after).id)
    return session.scalars(query).all()


def recent_measurements(
    session: Session,
    heliostat: HeliostatRow,
    limit: int,
    since: datetime | None = None,
    until: datetime | None = None,
) -> list[MeasurementRow]:
    """The newest accepted measurements, one image of each, by when they were taken or else came."""
    moment = func.coalesce(MeasurementRow.taken_at, MeasurementRow.created_at)
    query = _measurements(heliostat).where(MeasurementRow.accepted, MeasurementRow.arrays.is_not(None))
    if since is not None:
        query = query.where(moment >= since)
    if until is not None:
        query = query.where(moment < until)
    # Images of the same measurement in another kind show the same spot again, hence the longer list.
    query = query.order_by(moment.desc(), MeasurementRow.id.desc()).limit(len(PREFERENCE) * limit)
    best: dict[str, MeasurementRow] = {}
    for row in session.scalars(query):
        key = row.external_id or row.identifier
        if key not in best or PREFERENCE.index(row.kind) < PREFERENCE.index(best[key].kind):
            best[key] = row
    return list(best.values())[:limit]


def _put_image(session: Session, image: NewImage) -> None:
    if session.get(ImageRow, image.sha256) is None:
        insert(session, ImageRow(**asdict(image)))


def _free_identifier(session: Session, heliostat: HeliostatRow, new: NewMeasurement) -> str:
    """Its own identifier; with the kind appended where another kind of image of the same measurement has it."""
    wanted = new.external_id or new.image.sha256[:16]
    for identifier in (wanted, f"{wanted}-{new.kind}"):
        holder = find_measurement(session, heliostat, identifier)
        if holder is None:
            return identifier
        if holder.kind == new.kind:
            break
    raise ConflictError(f"id: measurement {wanted} of heliostat {heliostat.name} has another {new.kind} image already")


def _center_columns(center: ArrayLike | None) -> dict[str, float]:
    if center is None:
        return {}
    right, up = floats(center)
    return {"center_right_m": right, "center_up_m": up}


def _measurement_row(heliostat: HeliostatRow, identifier: str, new: NewMeasurement) -> MeasurementRow:
    arrays = {name: array for name, array in (("flux", new.flux), ("centered", new.centered)) if array is not None}
    motors = new.motor_position or (None, None)
    return MeasurementRow(
        heliostat_id=heliostat.id,
        identifier=identifier,
        external_id=new.external_id,
        image_sha256=new.image.sha256,
        kind=new.kind,
        target_id=new.target.id,
        sun_azimuth_deg=new.sun_azimuth_deg,
        sun_elevation_deg=new.sun_elevation_deg,
        motor_axis_1=motors[0],
        motor_axis_2=motors[1],
        taken_at=new.taken_at,
        focal_spot_wgs84=None if new.focal_spot_wgs84 is None else list(new.focal_spot_wgs84),
        corners_px=new.corners_px,
        accepted=new.accepted,
        reason=new.reason,
        quality=new.quality,
        arrays=pack({name: np.asarray(array, np.float32) for name, array in arrays.items()}) if arrays else None,
        **_center_columns(new.center_of_mass),
    )


def add_measurement(session: Session, heliostat: HeliostatRow, new: NewMeasurement) -> tuple[MeasurementRow, bool]:
    """Store a measurement once; the second value is False where this image of this kind was there already.

    Raises
    ------
    ConflictError
        Where the given id belongs to another image of the same kind.
    InvalidInputError
        Where the given id is no good name.
    """
    if new.external_id is not None:
        names.require(names.IDENTIFIER, new.external_id, "id")
    _put_image(session, new.image)
    for _ in range(ROUNDS):
        existing = find_measurement_of_image(session, heliostat, new.image.sha256, new.kind)
        if existing is not None:
            return existing, False
        row = _measurement_row(heliostat, _free_identifier(session, heliostat, new), new)
        if insert(session, row):
            session.refresh(row, ["target", "image"])
            return row, True
    raise ConflictError("too many writers on the same measurement; try again")
