"""Correct the metadata of a photograph, or exclude it, with reason and history.

A change applies to all images of the photograph.
"""

from dataclasses import dataclass, field, fields, replace
from datetime import datetime

from sqlalchemy.orm import Session

from model.imaging.light import camera_at
from model.pointing import Weather
from service import store
from service.base.errors import ConflictError, GoneError
from service.base.fields import Sun
from service.sources.photograph import Photograph
from service.store import audit
from service.store.columns import now
from service.store.photographs.correction_log import delete_drift
from service.store.photographs.image_files import digest
from service.store.photographs.measurements import EXCLUDED, images_of_photograph
from service.store.rows import Change, Put, lock_row
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow, TargetRow
from service.twin.heliostats.measurements import HeliostatContext, load_heliostat_context
from service.twin.heliostats.metadata import photograph_from_row, stored_metadata
from service.twin.photographs.ingest import measure_stored, measurement_row
from service.twin.runtime.runtime import Runtime
from service.twin.warnings import find_sun_contradictions, other_warnings, sun_columns

# Columns that a new measurement of the image changes: metadata, weather and measured values.
_METADATA = (
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "taken_at",
    "motor_axis_1",
    "motor_axis_2",
    "quality",
    "warnings",
)
_WEATHER = tuple(weather.name for weather in fields(Weather))
_MEASURED = ("target_id", "accepted", "reason", "center_right_m", "center_up_m", "arrays")


class NothingToChangeError(ConflictError):
    """A photograph has the values of its correction already."""


@dataclass(frozen=True)
class PhotographChanges:
    """Corrected metadata of a photograph; None leaves a value unchanged.

    ``excluded`` is whether the photograph is excluded from all computations. ``without``
    names metadata to remove: ``taken_at``, ``motor_position``.
    """

    reason: str
    target_name: str | None = None
    sun: Sun | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    weather: Weather = field(default_factory=Weather)
    excluded: bool | None = None
    without: tuple[str, ...] = ()

    def of(self, row: MeasurementRow) -> Photograph:
        """The stored photograph with the changes applied."""
        names = ("target_name", "sun", "taken_at", "motor_position")
        stored = photograph_from_row(row)
        weather = {name: value for name, value in vars(self.weather).items() if value is not None}
        changes = {name: value for name in names if (value := getattr(self, name)) is not None}
        changes |= dict.fromkeys(self.without)
        return replace(stored, weather=replace(stored.weather, **weather), **changes)


def correct_photograph(
    runtime: Runtime, heliostat: str, identifier: str, changes: PhotographChanges, actor: str
) -> MeasurementRow:
    """Correct or exclude the photograph of an image, and return the image's row.

    All images of the photograph are changed. They are re-measured if their target or camera
    changes.

    Raises
    ------
    NotFoundError
        If heliostat, measurement or target are not stored.
    NothingToChangeError
        If nothing would change.
    ConflictError
        If another image of the photograph came meanwhile.
    GoneError
        If an image must be re-measured, but is deleted.
    """
    prepared = prepare_correction(runtime, heliostat, identifier, changes)
    with runtime.database.writing() as session:
        row, change = apply_correction(session, prepared, actor)
        if change is Change.UNCHANGED:
            raise NothingToChangeError(
                f"measurement {identifier} has these values already; nothing changed"
            )
    return row


@dataclass(frozen=True, eq=False)
class PreparedCorrection:
    """A correction before it is written.

    ``fresh`` are the columns to write, by identifier of the photograph's images. ``row`` is the
    stored image that was named.
    """

    heliostat: str
    identifier: str
    changes: PhotographChanges
    fresh: dict[str, dict[str, object]]
    row: MeasurementRow


def prepare_correction(
    runtime: Runtime, heliostat: str, identifier: str, changes: PhotographChanges
) -> PreparedCorrection:
    """The new columns of a photograph; raises the errors of `correct_photograph`."""
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat)
        row = store.get_measurement(session, twin.row, identifier)
        images = images_of_photograph(session, row)
        named = (
            None if changes.target_name is None else store.get_target(session, changes.target_name)
        )
    fresh = {
        row.identifier: _new_values(runtime, twin, row, changes.of(row), named or row.target)
        for row in images.values()
    }
    return PreparedCorrection(heliostat, identifier, changes, fresh, row)


def apply_correction(
    session: Session, prepared: PreparedCorrection, actor: str
) -> Put[MeasurementRow]:
    """Write a correction to all images of a photograph, and return that of the prepared one."""
    heliostat, identifier, changes = prepared.heliostat, prepared.identifier, prepared.changes
    row_of_heliostat = store.get_heliostat(session, heliostat)
    lock_row(session, HeliostatRow, row_of_heliostat.id, f"heliostat {heliostat}")
    row = store.get_measurement(session, row_of_heliostat, identifier, arrays=True)
    images = {
        one.identifier: one for one in images_of_photograph(session, row, arrays=True).values()
    }
    if images.keys() != prepared.fresh.keys():
        raise ConflictError(
            f"measurement {identifier}: another image of it came meanwhile; correct it again"
        )
    has_changed = [
        _log_correction(session, heliostat, one, prepared.fresh[name], changes, actor)
        for name, one in images.items()
    ]
    return Put(row, Change.CHANGED if any(has_changed) else Change.UNCHANGED)


def remeasure(runtime: Runtime, heliostat: str, identifier: str, reason: str, actor: str) -> bool:
    """Re-measure a stored photograph with the current camera; return whether anything changed.

    Raises
    ------
    NotFoundError
        If heliostat or measurement are not stored.
    GoneError
        If the image is deleted.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat)
        row = store.get_measurement(session, twin.row, identifier)
        target, changes = row.target, PhotographChanges(reason)
    fresh = _measured(runtime, twin, row, changes.of(row), target)
    with runtime.database.writing() as session:
        lock_row(session, HeliostatRow, twin.row.id, f"heliostat {heliostat}")
        row = store.get_measurement(session, twin.row, identifier, arrays=True)
        return _log_correction(session, heliostat, row, fresh, changes, actor)


def _log_correction(
    session: Session,
    heliostat: str,
    row: MeasurementRow,
    fresh: dict[str, object],
    changes: PhotographChanges,
    actor: str,
) -> bool:
    """Write changed columns with their history; return False if none changed."""
    before = _state(row)
    _write(row, fresh, changes.excluded)
    session.flush()
    session.refresh(row, ["target"])
    after = _state(row)
    apart = [name for name, value in after.items() if value != before[name]]
    if not apart:
        return False
    if not set(apart) <= set(_WEATHER):  # only the next calibration uses the weather
        row.corrected_at = now()
        delete_drift(session, row)
    old, new = ({name: state[name] for name in apart} for state in (before, after))
    session.add(
        CorrectionRow(
            measurement_id=row.id, created_by=actor, reason=changes.reason, before=old, after=new
        )
    )
    if row.image is not None:
        store.use_image(session, row.image, row.accepted, False)
    about = {"reason": changes.reason, "before": old, "after": new}
    audit.record(
        session, actor, "measurement.corrected", f"heliostat {heliostat} {row.identifier}", **about
    )
    return True


def _state(row: MeasurementRow) -> dict[str, object]:
    """Metadata of a photograph, and the hash of its flux images."""
    flux = None if row.arrays is None else digest(row.arrays)[:12]
    excluded = {"excluded": row.reason == EXCLUDED, "flux": flux}
    return stored_metadata(row) | vars(Weather.of(row)) | excluded


def _new_values(
    runtime: Runtime,
    twin: HeliostatContext,
    row: MeasurementRow,
    photograph: Photograph,
    target: TargetRow,
) -> dict[str, object]:
    """The columns of a corrected photograph."""
    cameras = twin.model.cameras
    before = camera_at(cameras, row.target.name, row.taken_at)
    is_alike = (
        target.id == row.target_id
        and camera_at(cameras, target.name, photograph.taken_at) == before
    )
    if is_alike or row.image is None:
        motors = photograph.motor_position or (None, None)
        return {
            "target_id": target.id,
            "sun_azimuth_deg": photograph.sun.azimuth_deg,
            "sun_elevation_deg": photograph.sun.elevation_deg,
            "taken_at": photograph.taken_at,
            "motor_axis_1": motors[0],
            "motor_axis_2": motors[1],
            **sun_columns(row, photograph, twin),
            **vars(photograph.weather),
        }
    return _measured(runtime, twin, row, photograph, target)


def _measured(
    runtime: Runtime,
    twin: HeliostatContext,
    row: MeasurementRow,
    photograph: Photograph,
    target: TargetRow,
) -> dict[str, object]:
    """The columns of a photograph that is re-measured."""
    if row.image is not None and row.image.pruned_at is not None:
        raise GoneError(
            f"measurement {row.identifier} must be measured again, and its image was deleted on "
            f"{row.image.pruned_at:%Y-%m-%d}; exclude it instead"
        )
    _, measured = measure_stored(runtime, row, photograph, twin, store.target_plane(target))
    (contradiction,) = find_sun_contradictions([photograph], twin.origin)
    new_row = measurement_row(photograph, measured, target.id, contradiction)
    new_row.warnings = [*(new_row.warnings or ()), *other_warnings(row, photograph)] or None
    return {name: getattr(new_row, name) for name in (*_METADATA, *_WEATHER, *_MEASURED)}


def _write(row: MeasurementRow, fresh: dict[str, object], excluded: bool | None) -> None:
    was_excluded = row.reason == EXCLUDED
    for name, value in fresh.items():
        setattr(row, name, value)
    if excluded if excluded is not None else was_excluded:
        row.accepted, row.reason = False, EXCLUDED
    else:
        row.accepted, row.reason = bool(row.quality["accepted"]), row.quality.get("reason") or None
