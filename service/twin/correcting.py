"""Correcting what is known of a photograph, or excluding it, in all its images: with a reason, its history kept."""

from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from typing import Any

from sqlalchemy.orm import Session

from model.imaging.light import camera_at
from model.pointing import Weather
from service import store
from service.base.faults import ConflictError, GoneError
from service.sources.photograph import Photograph
from service.store import audit
from service.store.columns import now
from service.store.corrections import forget_drift
from service.store.images import digest
from service.store.measurements import EXCLUDED, images_of_shot
from service.store.tables import CorrectionRow, MeasurementRow, TargetRow
from service.twin.evidence import Twin, load_twin
from service.twin.ingest import clock_of, measure_stored, row_of
from service.twin.photographs import photograph_of, values_of
from service.twin.runtime import Runtime

# What another sun, time or pair of motor positions changes, and what is measured anew with another target or camera.
_TOLD = ("sun_azimuth_deg", "sun_elevation_deg", "taken_at", "motor_axis_1", "motor_axis_2", "quality")
_WEATHER = tuple(weather.name for weather in fields(Weather))
_MEASURED = ("target_id", "accepted", "reason", "center_right_m", "center_up_m", "arrays")


@dataclass(frozen=True)
class Changes:
    """What shall be known of a photograph instead; None leaves it. ``excluded``: whether nothing is made from it."""

    reason: str
    target_name: str | None = None
    sun_azimuth_deg: float | None = None
    sun_elevation_deg: float | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    weather: Weather = field(default_factory=Weather)
    excluded: bool | None = None

    def of(self, row: MeasurementRow) -> Photograph:
        """The photograph as it shall be known."""
        names = ("target_name", "sun_azimuth_deg", "sun_elevation_deg", "taken_at", "motor_position")
        known = photograph_of(row)
        weather = {name: value for name, value in vars(self.weather).items() if value is not None}
        told = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(known, weather=replace(known.weather, **weather), **told)


def correct(runtime: Runtime, heliostat: str, identifier: str, changes: Changes, actor: str) -> MeasurementRow:
    """Correct or exclude the photograph that an image shows; the image is returned, all kinds of it are changed.

    Where it is another target, or another camera's, it is measured anew.

    Raises
    ------
    NotFoundError
        Where heliostat, measurement or target are not stored.
    ConflictError
        Where nothing would change, or another image of the photograph came meanwhile.
    GoneError
        Where it must be measured anew, and its image is kept no longer.
    """
    with runtime.database.reading() as session:
        twin = load_twin(session, heliostat)
        images = images_of_shot(session, store.get_measurement(session, twin.row, identifier))
        named = None if changes.target_name is None else store.get_target(session, changes.target_name)
    fresh = {
        row.identifier: _fresh(runtime, twin, row, changes.of(row), named or row.target) for row in images.values()
    }
    with runtime.database.writing() as session:
        row = store.get_measurement(session, store.get_heliostat(session, heliostat), identifier, arrays=True)
        of_shot = {one.identifier: one for one in images_of_shot(session, row, arrays=True).values()}
        if of_shot.keys() != fresh.keys():
            raise ConflictError(f"measurement {identifier}: another image of it came meanwhile; correct it again")
        kept = [_keep(session, heliostat, one, fresh[name], changes, actor) for name, one in of_shot.items()]
        if not any(kept):
            raise ConflictError(f"measurement {identifier} stands so already; nothing was changed")
    return row


def measure_anew(runtime: Runtime, heliostat: str, identifier: str, reason: str, actor: str) -> bool:
    """Measure a stored photograph by today's camera, as this version measures; whether anything changed.

    Raises
    ------
    NotFoundError
        Where heliostat or measurement are not stored.
    GoneError
        Where its image is kept no longer.
    """
    with runtime.database.reading() as session:
        twin = load_twin(session, heliostat)
        row = store.get_measurement(session, twin.row, identifier)
        target, changes = row.target, Changes(reason)
    fresh = _measured(runtime, twin, row, changes.of(row), target)
    with runtime.database.writing() as session:
        row = store.get_measurement(session, store.get_heliostat(session, heliostat), identifier, arrays=True)
        return _keep(session, heliostat, row, fresh, changes, actor)


def _keep(
    session: Session, heliostat: str, row: MeasurementRow, fresh: dict[str, Any], changes: Changes, actor: str
) -> bool:
    """Write the columns that change with their history; False where none does."""
    before = _state(row)
    _write(row, fresh, changes.excluded)
    session.flush()
    session.refresh(row, ["target"])
    after = _state(row)
    apart = [name for name, value in after.items() if value != before[name]]
    if not apart:
        return False
    if not set(apart) <= set(_WEATHER):  # which nothing is made from but the next calibration
        row.corrected_at = now()
        forget_drift(session, row)
    old, new = ({name: state[name] for name in apart} for state in (before, after))
    session.add(CorrectionRow(measurement_id=row.id, made_by=actor, reason=changes.reason, before=old, after=new))
    store.use_image(session, row.image, row.accepted, False)
    about = {"reason": changes.reason, "before": old, "after": new}
    audit.record(session, actor, "measurement.corrected", f"heliostat {heliostat} {row.identifier}", **about)
    return True


def _state(row: MeasurementRow) -> dict[str, Any]:
    """What is known of a photograph, and by their hash its flux images."""
    flux = None if row.arrays is None else digest(row.arrays)[:12]
    weather = {name: getattr(row, name) for name in _WEATHER}
    return values_of(row) | weather | {"excluded": row.reason == EXCLUDED, "flux": flux}


def _fresh(
    runtime: Runtime, twin: Twin, row: MeasurementRow, photograph: Photograph, target: TargetRow
) -> dict[str, Any]:
    """The columns that change."""
    cameras = twin.model.cameras
    before = camera_at(cameras, row.target.name, row.taken_at)
    if target.id == row.target_id and camera_at(cameras, target.name, photograph.taken_at) == before:
        motors = photograph.motor_position or (None, None)
        return {
            "sun_azimuth_deg": photograph.sun_azimuth_deg,
            "sun_elevation_deg": photograph.sun_elevation_deg,
            "taken_at": photograph.taken_at,
            "motor_axis_1": motors[0],
            "motor_axis_2": motors[1],
            "quality": {**row.quality, "clock": clock_of(photograph, twin)},
            **vars(photograph.weather),
        }
    return _measured(runtime, twin, row, photograph, target)


def _measured(
    runtime: Runtime, twin: Twin, row: MeasurementRow, photograph: Photograph, target: TargetRow
) -> dict[str, Any]:
    """The columns of a photograph that is measured anew."""
    if row.image.pruned_at is not None:
        raise GoneError(
            f"measurement {row.identifier} must be measured anew, and its image was given up on "
            f"{row.image.pruned_at:%Y-%m-%d}; exclude it instead"
        )
    _, measured = measure_stored(runtime, row, photograph, twin, store.target_plane(target))
    made = row_of(photograph, measured, target.id, clock_of(photograph, twin))
    return {name: getattr(made, name) for name in (*_TOLD, *_WEATHER, *_MEASURED)}


def _write(row: MeasurementRow, fresh: dict[str, Any], excluded: bool | None) -> None:
    was_excluded = row.reason == EXCLUDED
    for name, value in fresh.items():
        setattr(row, name, value)
    if excluded if excluded is not None else was_excluded:
        row.accepted, row.reason = False, EXCLUDED
    else:
        row.accepted, row.reason = bool(row.quality["accepted"]), row.quality.get("reason") or None
