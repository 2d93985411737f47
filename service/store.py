"""What is kept and how it is found again: functions on a SQLAlchemy session, each doing one thing.

Writers are idempotent: what is there already is left as it is and reported as such, also when two writers race.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import Select, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, defer, undefer

from model.plant import Cylinder, Receiver, TargetPlane
from service import names
from service.arrays import pack
from service.faults import ConflictError, NotFoundError
from service.tables import (
    Base,
    ForecastRow,
    HeliostatRow,
    ImageRow,
    MeasurementRow,
    PlantRow,
    ReceiverRow,
    StudyRow,
    SurfaceRow,
    TargetRow,
    now,
)

# Which image of a measurement to use where there are several: separated ones first, for they need no guess.
PREFERENCE = ("flux", "cropped", "raw", "flux-centered")

# Rounds that a writer takes against others who write the same thing before it gives up.
_ROUNDS = 8

Named = TypeVar("Named", HeliostatRow, TargetRow, ReceiverRow)


class Change(StrEnum):
    """What a write did."""

    NEW = "new"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


def insert(session: Session, row: Base) -> bool:
    """Insert ``row`` unless a unique constraint forbids it; False where another writer was first."""
    try:
        with session.begin_nested():
            session.add(row)
            session.flush()
    except IntegrityError:
        return False
    return True


def _insert_or_find(session: Session, row: Named) -> tuple[Named, bool]:
    """``row``, inserted, or the one that has its name already; the second value is True where it is new."""
    table = type(row)
    query = select(table).where(table.name == row.name)
    held = session.scalar(query)
    if held is None and insert(session, row):
        return row, True
    return held or session.scalars(query).one(), False


def _assign(row: Base, values: dict[str, Any]) -> Change:
    changed = {name: value for name, value in values.items() if getattr(row, name) != value}
    for name, value in changed.items():
        setattr(row, name, value)
    return Change.CHANGED if changed else Change.UNCHANGED


def _floats(values: ArrayLike) -> list[float]:
    return [float(value) for value in np.asarray(values)]


# --- plant ------------------------------------------------------------------------------------------------------------


def get_plant(session: Session) -> PlantRow:
    """The plant; ConflictError where none was set."""
    plant = session.get(PlantRow, 1)
    if plant is None:
        raise ConflictError(
            "the plant is not set yet: PUT its PAINT tower measurements to /v1/plant, or import a folder"
        )
    return plant


def put_plant(session: Session, name: str, origin: ArrayLike) -> Change:
    """Set the plant's name and origin (latitude [deg], longitude [deg], altitude [m]).

    Raises
    ------
    ConflictError
        Where heliostats or targets are already stored relative to another origin.
    """
    latitude, longitude, altitude = _floats(origin)
    values = {"name": name, "latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": altitude}
    plant = session.get(PlantRow, 1)
    if plant is None:
        if insert(session, PlantRow(id=1, **values)):
            return Change.NEW
        plant = get_plant(session)
    if plant.origin != (latitude, longitude, altitude) and _has_positions(session):
        raise ConflictError("the plant's origin is fixed: heliostats or targets are stored relative to it")
    return _assign(plant, values)


def put_declared(session: Session, declared: dict[str, Any]) -> Change:
    """Set what is declared of the plant's model, in the form of ``twin.json``.

    Raises
    ------
    ConflictError
        Where studies were made with another: what they found adds to that.
    """
    plant = get_plant(session)
    studied = session.scalar(select(StudyRow.id).limit(1)) is not None
    if studied and (plant.declared or {}) != declared:
        raise ConflictError("the declared model is fixed: studies were made with it; adopt what they find instead")
    return _assign(plant, {"declared": declared})


def _has_positions(session: Session) -> bool:
    return any(session.scalar(select(table.id).limit(1)) is not None for table in (HeliostatRow, TargetRow))


# --- heliostats -------------------------------------------------------------------------------------------------------


def find_heliostat(session: Session, name: str) -> HeliostatRow | None:
    """The heliostat of this name, or None."""
    return session.scalar(select(HeliostatRow).where(HeliostatRow.name == name))


def get_heliostat(session: Session, name: str) -> HeliostatRow:
    """The heliostat of this name; NotFoundError where there is none."""
    row = find_heliostat(session, name)
    if row is None:
        raise NotFoundError(f"there is no heliostat {name}; POST it to /v1/heliostats first")
    return row


def get_heliostats(session: Session, wanted: Sequence[str]) -> dict[str, HeliostatRow]:
    """Those of some heliostats that are stored, by name."""
    rows = session.scalars(select(HeliostatRow).where(HeliostatRow.name.in_(wanted)))
    return {row.name: row for row in rows}


def list_heliostats(session: Session, limit: int, after: str | None = None) -> Sequence[HeliostatRow]:
    """Up to ``limit`` heliostats in the order of their names, those after the name ``after``."""
    query = select(HeliostatRow).options(defer(HeliostatRow.properties)).order_by(HeliostatRow.name).limit(limit)
    return session.scalars(query.where(HeliostatRow.name > after) if after else query).all()


def require_same_properties(row: HeliostatRow, properties: dict[str, Any]) -> None:
    """ConflictError where ``properties`` are not those of the stored heliostat."""
    if row.properties != properties:
        raise ConflictError(f"name: heliostat {row.name} exists with other properties; PUT them to change it")


def put_heliostat(
    session: Session, name: str, properties: dict[str, Any], position: ArrayLike
) -> tuple[HeliostatRow, Change]:
    """Keep a heliostat's PAINT ``properties`` and its ENU ``position`` (3,) [m]; InvalidInputError for a bad name."""
    names.require(names.NAME, name, "heliostat")
    east, north, up = _floats(position)
    values = {"properties": properties, "east_m": east, "north_m": north, "up_m": up}
    row, is_new = _insert_or_find(session, HeliostatRow(name=name, **values))
    return row, Change.NEW if is_new else _assign(row, values)


# --- targets ----------------------------------------------------------------------------------------------------------


def find_target(session: Session, name: str) -> TargetRow | None:
    """The target of this name, or None."""
    return session.scalar(select(TargetRow).where(TargetRow.name == name))


def get_target(session: Session, name: str) -> TargetRow:
    """The target of this name; NotFoundError where there is none, naming those that exist."""
    row = find_target(session, name)
    if row is None:
        known = ", ".join(target.name for target in list_targets(session)) or "none yet"
        raise NotFoundError(f"there is no target {name}; known targets: {known}")
    return row


def list_targets(session: Session) -> Sequence[TargetRow]:
    """All targets in the order of their names."""
    return session.scalars(select(TargetRow).order_by(TargetRow.name)).all()


def put_target(
    session: Session, plane: TargetPlane, corners: dict[str, list[float]] | None = None
) -> tuple[TargetRow, Change]:
    """Keep a target plane under its name; ``corners`` are the WGS84 corners that it was made from, where known.

    Raises `InvalidInputError` for a bad name, ConflictError where a receiver has it.
    """
    names.require(names.NAME, plane.name, "target")
    if find_receiver(session, plane.name) is not None:
        raise ConflictError(f"name: {plane.name} is a receiver; choose another name for the target plane")
    values: dict[str, Any] = {
        "center_m": _floats(plane.center),
        "normal": _floats(plane.normal),
        "up": _floats(plane.up),
        "width_m": float(plane.width),
        "height_m": float(plane.height),
    }
    row, is_new = _insert_or_find(session, TargetRow(name=plane.name, corners=corners, **values))
    if is_new:
        return row, Change.NEW
    moved = any(getattr(row, name) != value for name, value in values.items())
    # Corners that are known stay known while the plane is the same.
    values["corners"] = corners if moved or corners is not None else row.corners
    return row, _assign(row, values)


def target_plane(row: TargetRow) -> TargetPlane:
    """The model's target plane of a stored one."""
    return TargetPlane(
        name=row.name,
        center=np.array(row.center_m),
        normal=np.array(row.normal),
        up=np.array(row.up),
        width=row.width_m,
        height=row.height_m,
    )


# --- receivers --------------------------------------------------------------------------------------------------------


def list_receivers(session: Session) -> Sequence[ReceiverRow]:
    """All receivers in the order of their names."""
    return session.scalars(select(ReceiverRow).order_by(ReceiverRow.name)).all()


def find_receiver(session: Session, name: str) -> ReceiverRow | None:
    """The receiver of this name, or None."""
    return session.scalar(select(ReceiverRow).where(ReceiverRow.name == name))


def get_receiver(session: Session, name: str) -> ReceiverRow:
    """The receiver of this name; NotFoundError where there is none."""
    row = find_receiver(session, name)
    if row is None:
        raise NotFoundError(f"there is no receiver {name}; PUT it to /v1/receivers/{name} first")
    return row


def put_receiver(session: Session, cylinder: Cylinder) -> tuple[ReceiverRow, Change]:
    """Keep a receiver under its name.

    Raises
    ------
    InvalidInputError
        For a bad name.
    ConflictError
        Where a target has that name.
    """
    names.require(names.NAME, cylinder.name, "receiver")
    if find_target(session, cylinder.name) is not None:
        raise ConflictError(f"name: {cylinder.name} is a target plane; choose another name for the receiver")
    values: dict[str, Any] = {
        "center_m": _floats(cylinder.center),
        "normal": _floats(cylinder.normal),
        "up": _floats(cylinder.up),
        "radius_m": float(cylinder.radius),
        "height_m": float(cylinder.height),
        "opening_deg": float(cylinder.opening_deg),
    }
    row, is_new = _insert_or_find(session, ReceiverRow(name=cylinder.name, **values))
    return row, Change.NEW if is_new else _assign(row, values)


def receiver_cylinder(row: ReceiverRow) -> Cylinder:
    """The model's receiver of a stored one."""
    return Cylinder(
        name=row.name,
        center=np.array(row.center_m),
        normal=np.array(row.normal),
        up=np.array(row.up),
        radius=row.radius_m,
        height=row.height_m,
        opening_deg=row.opening_deg,
    )


def get_target_or_receiver(session: Session, name: str) -> Receiver:
    """The target plane or the cylinder of this name; NotFoundError where there is neither."""
    row = find_receiver(session, name)
    return target_plane(get_target(session, name)) if row is None else receiver_cylinder(row)


# --- images and measurements ------------------------------------------------------------------------------------------


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
    """A measured photograph to be stored; units as in `service.tables.MeasurementRow`.

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
    right, up = _floats(center)
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
    for _ in range(_ROUNDS):
        existing = find_measurement_of_image(session, heliostat, new.image.sha256, new.kind)
        if existing is not None:
            return existing, False
        row = _measurement_row(heliostat, _free_identifier(session, heliostat, new), new)
        if insert(session, row):
            session.refresh(row, ["target", "image"])
            return row, True
    raise ConflictError("too many writers on the same measurement; try again")


# --- surfaces ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class NewSurface:
    """A surface to be stored as the next version.

    Attributes
    ----------
    source : one of measured, network, refined, imported
    z, z_std : (4, 8, 8) [m]
        Control heights and their standard deviation; zero where it is not known.
    control_points : (4, 8, 8, 3) [m]
        In heliostat coordinates, canting and facet position in them.
    valid_from : datetime
        From when it describes the mirror; without it, from now.
    model : str
        Name and hash of the weights that made it.
    model_version : str
        Version of the plant's model that it was made with.
    measurements : the rows that it was made from
    misfit : float
    """

    source: str
    z: NDArray[Any]
    z_std: NDArray[Any]
    control_points: NDArray[Any]
    valid_from: datetime | None = None
    model: str | None = None
    model_version: str | None = None
    measurements: Sequence[MeasurementRow] = field(default=())
    misfit: float | None = None

    @property
    def content(self) -> str:
        """SHA-256 over its source and control points."""
        points = np.ascontiguousarray(self.control_points, dtype=np.float64)
        return hashlib.sha256(self.source.encode() + points.tobytes()).hexdigest()


def _surfaces(heliostat: HeliostatRow) -> Select[SurfaceRow]:
    return select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)


def _surface_row(heliostat: HeliostatRow, version: int, new: NewSurface, content: str | None) -> SurfaceRow:
    created = now()
    arrays = {"z": new.z, "z_std": new.z_std, "control_points": new.control_points}
    return SurfaceRow(
        heliostat_id=heliostat.id,
        version=version,
        created_at=created,
        valid_from=new.valid_from or created,
        source=new.source,
        model=new.model,
        model_version=new.model_version,
        misfit=new.misfit,
        content_sha256=content,
        arrays=pack({name: np.asarray(array, np.float64) for name, array in arrays.items()}),
        measurements=sorted(new.measurements, key=lambda measurement: measurement.id),
    )


def add_surface(
    session: Session, heliostat: HeliostatRow, new: NewSurface, once: bool = False
) -> tuple[SurfaceRow, bool]:
    """Store a surface as the heliostat's next version.

    With ``once`` (imports) the same control points from the same source are stored only the first time; the second
    value is False where they were there already.
    """
    content = new.content if once else None
    for _ in range(_ROUNDS):
        if content is not None:
            existing = session.scalar(_surfaces(heliostat).where(SurfaceRow.content_sha256 == content))
            if existing is not None:
                return existing, False
        last = session.scalar(select(func.max(SurfaceRow.version)).where(SurfaceRow.heliostat_id == heliostat.id))
        row = _surface_row(heliostat, (last or 0) + 1, new, content)
        if insert(session, row):
            return row, True
    raise ConflictError("too many writers on the same heliostat's surfaces; try again")


def list_surfaces(
    session: Session, heliostat: HeliostatRow, limit: int, after: int | None = None
) -> Sequence[SurfaceRow]:
    """Up to ``limit`` versions, oldest first, those after version ``after``."""
    query = _surfaces(heliostat).order_by(SurfaceRow.version).limit(limit)
    return session.scalars(query.where(SurfaceRow.version > after) if after else query).all()


def get_surface(session: Session, heliostat: HeliostatRow, version: int) -> SurfaceRow:
    """A version with its arrays; NotFoundError where there is none."""
    row = session.scalar(_surfaces(heliostat).where(SurfaceRow.version == version).options(undefer(SurfaceRow.arrays)))
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no surface version {version}")
    return row


def find_measured_surface(session: Session, heliostat: HeliostatRow) -> SurfaceRow | None:
    """The newest version, with its arrays, that was measured and not predicted, or None."""
    query = _surfaces(heliostat).where(SurfaceRow.source == "measured")
    return session.scalar(query.order_by(SurfaceRow.version.desc()).limit(1).options(undefer(SurfaceRow.arrays)))


def find_surface_at(session: Session, heliostat: HeliostatRow, moment: datetime | None = None) -> SurfaceRow | None:
    """The version, with its arrays, that was valid at ``moment``: the last to begin before it, or None.

    Without a moment the last of all: what begins a little ahead, because a camera's clock is ahead of ours or ours was
    set back, is current too.
    """
    query = _surfaces(heliostat)
    if moment is not None:
        query = query.where(SurfaceRow.valid_from <= moment)
    query = query.order_by(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc()).limit(1)
    return session.scalar(query.options(undefer(SurfaceRow.arrays)))


def current_surfaces(session: Session, heliostats: Sequence[int]) -> dict[int, bytes]:
    """The arrays of what `find_surface_at` has without a moment, by the heliostats' ids, of those that have one."""
    newest = func.row_number().over(
        partition_by=SurfaceRow.heliostat_id, order_by=(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc())
    )
    ranked = select(SurfaceRow.id, newest.label("place")).where(SurfaceRow.heliostat_id.in_(heliostats)).subquery()
    first = select(ranked.c.id).where(ranked.c.place == 1)
    rows = session.execute(select(SurfaceRow.heliostat_id, SurfaceRow.arrays).where(SurfaceRow.id.in_(first)))
    return {row.heliostat_id: row.arrays for row in rows}


def get_surface_at(session: Session, heliostat: HeliostatRow, moment: datetime | None = None) -> SurfaceRow:
    """The version valid at ``moment``, by default now; NotFoundError where there is none."""
    row = find_surface_at(session, heliostat, moment)
    if row is None:
        when = f"at {moment.isoformat()}" if moment else "yet"
        raise NotFoundError(f"heliostat {heliostat.name} has no surface {when}; POST to its surfaces to predict one")
    return row


# --- forecasts --------------------------------------------------------------------------------------------------------


def add_forecast(session: Session, row: ForecastRow) -> ForecastRow:
    """Store a forecast."""
    session.add(row)
    session.flush()
    session.refresh(row, ["heliostat", "surface"])
    return row


def get_forecast(session: Session, number: int) -> ForecastRow:
    """A forecast with its flux; NotFoundError where there is none."""
    row = session.scalar(select(ForecastRow).where(ForecastRow.id == number).options(undefer(ForecastRow.flux)))
    if row is None:
        raise NotFoundError(f"there is no forecast {number}")
    return row


def list_forecasts(
    session: Session, limit: int, after: int | None = None, heliostat: HeliostatRow | None = None
) -> Sequence[ForecastRow]:
    """Up to ``limit`` forecasts in the order they were made, those after number ``after``."""
    query = select(ForecastRow).order_by(ForecastRow.id).limit(limit)
    if heliostat is not None:
        query = query.where(ForecastRow.heliostat_id == heliostat.id)
    return session.scalars(query.where(ForecastRow.id > after) if after else query).all()


# --- studies ----------------------------------------------------------------------------------------------------------


def add_study(session: Session, row: StudyRow) -> StudyRow:
    """Store a study."""
    session.add(row)
    session.flush()
    return row


def get_study(session: Session, number: int, page: bool = False) -> StudyRow:
    """A study with its report, and its ``page`` where wanted; NotFoundError where there is none."""
    columns = [undefer(StudyRow.report), undefer(StudyRow.skipped), *([undefer(StudyRow.html)] if page else [])]
    row = session.scalar(select(StudyRow).where(StudyRow.id == number).options(*columns))
    if row is None:
        raise NotFoundError(f"there is no study {number}")
    return row


def list_studies(session: Session, limit: int, after: int | None = None) -> Sequence[StudyRow]:
    """Up to ``limit`` studies without their reports, newest first, those older than study ``after``."""
    query = select(StudyRow).order_by(StudyRow.id.desc()).limit(limit)
    return session.scalars(query.where(StudyRow.id < after) if after else query).all()


# --- counts -----------------------------------------------------------------------------------------------------------

_COUNTED: dict[str, type[Base]] = {
    "heliostats": HeliostatRow,
    "targets": TargetRow,
    "images": ImageRow,
    "measurements": MeasurementRow,
    "surfaces": SurfaceRow,
    "forecasts": ForecastRow,
}


def counts(session: Session) -> dict[str, int]:
    """How many of each there are."""
    return {
        name: cast(int, session.scalar(select(func.count()).select_from(table))) for name, table in _COUNTED.items()
    }
