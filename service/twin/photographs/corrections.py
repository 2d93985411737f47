"""Correct the metadata of a photograph, or exclude it, with reason and history.

A change applies to all images of the photograph.
"""

from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from typing import NamedTuple, TypeVar

from sqlalchemy.orm import Session

from model.ephemeris import SunContradiction
from model.errors import InvalidInputError
from model.imaging.light import Camera, camera_at
from model.pointing import Weather
from service import store
from service.base.errors import ConflictError, GoneError, NotFoundError
from service.base.fields import JsonObject
from service.sources.photograph import IncomingPhotograph
from service.store import audit
from service.store.columns import now
from service.store.image_files import digest
from service.store.measurements import EXCLUDED, images_of_photograph
from service.store.photographs import delete_drift, list_corrections, newest_correction
from service.store.rows import ROUNDS, lock_heliostat
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow, TargetRow
from service.twin.model_versions import get_model
from service.twin.photographs.ingest import measure_photograph, measurement_row
from service.twin.photographs.metadata import (
    find_sun_contradictions,
    metadata_columns,
    other_warnings,
    photograph_from_row,
    stored_metadata,
    sun_columns,
)
from service.twin.runtime import Runtime

Done = TypeVar("Done")

_WEATHER = tuple(weather.name for weather in fields(Weather))

# Columns that a new measurement of the image changes, in addition to the metadata.
_MEASURED = ("accepted", "reason", "quality", "warnings", "center_right_m", "center_up_m", "arrays")
_PLANE = ("name", "geometry", "locator")


class NothingToChangeError(ConflictError):
    """A photograph has the values of its correction already."""


@dataclass(frozen=True)
class GivenCorrection:
    """Corrected metadata of a heliostat's measurement; None leaves a value unchanged.

    ``excluded`` is whether the photograph is excluded from all computations. ``without``
    names metadata to remove: ``taken_at``, ``motor_position``.
    """

    heliostat: str
    identifier: str
    reason: str
    target: str | None = None
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    weather: Weather = field(default_factory=Weather)
    excluded: bool | None = None
    without: tuple[str, ...] = ()

    def of(self, row: MeasurementRow) -> IncomingPhotograph:
        """The stored photograph with the changes applied."""
        names = ("target", "taken_at", "motor_position")
        stored = photograph_from_row(row)
        angles = {"azimuth_deg": self.azimuth_deg, "elevation_deg": self.elevation_deg}
        sun = {name: value for name, value in angles.items() if value is not None}
        weather = {name: value for name, value in vars(self.weather).items() if value is not None}
        changes = {name: value for name in names if (value := getattr(self, name)) is not None}
        changes |= dict.fromkeys(self.without)
        changes["sun"] = stored.sun.model_copy(update=sun)
        return replace(stored, weather=replace(stored.weather, **weather), **changes)


class Corrected(NamedTuple):
    """The named image of a corrected photograph, and the new entries of its images' histories."""

    row: MeasurementRow
    history: list[CorrectionRow]


def correct_photograph(
    runtime: Runtime, given: GivenCorrection, actor: str, version: int | None = None
) -> Corrected:
    """Correct or exclude the photograph of an image.

    All images of the photograph are changed. They are re-measured if their target or camera
    changes. Only the named fields are written.

    Raises
    ------
    NotFoundError
        If heliostat, measurement or target are not stored.
    NothingToChangeError
        If nothing would change.
    ConflictError
        If one of the fields changed since ``version`` of the history (`newest_correction`).
    GoneError
        If an image must be re-measured, but is deleted.
    """
    return correct_photographs(runtime, [given], actor, version)[0]


def correct_photographs(
    runtime: Runtime, given: Sequence[GivenCorrection], actor: str, version: int | None = None
) -> list[Corrected]:
    """Correct or exclude photographs, all or none; raises what `correct_photograph` raises."""

    def write(corrections: Corrections) -> list[Corrected]:
        corrections.lock(entry.heliostat for entry in given)
        done = [corrections.apply(entry) for entry in given]
        if corrections.is_complete and not any(corrected.history for corrected in done):
            names = ", ".join(entry.identifier for entry in given)
            raise NothingToChangeError(
                f"measurement {names} has these values already; nothing changed"
            )
        return done

    return run_corrections(runtime, actor, write, version)


def remeasure(runtime: Runtime, heliostat: str, identifier: str, reason: str, actor: str) -> bool:
    """Re-measure a stored photograph with the current camera; return whether anything changed.

    Raises
    ------
    NotFoundError
        If heliostat or measurement are not stored.
    GoneError
        If the image is deleted.
    """

    def write(corrections: Corrections) -> bool:
        corrections.lock([heliostat])
        given = GivenCorrection(heliostat, identifier, reason)
        return bool(corrections.remeasure(given).history)

    return run_corrections(runtime, actor, write)


def run_corrections(
    runtime: Runtime, actor: str, write: Callable[["Corrections"], Done], version: int | None = None
) -> Done:
    """Run ``write`` in one transaction, in which it corrects photographs.

    It runs once before to find what takes long: suns to compare with times, and images to measure.
    The transaction uses that where the photographs are still the same. If another image must be
    measured by then, it begins again.

    Raises
    ------
    ConflictError
        If a field that it changes was changed since ``version``. The message names who changed
        what.
    """
    prepared = Prepared()
    with runtime.database.reading() as session:
        trial = Corrections(session, actor, prepared, is_trial=True)
        write(trial)
    prepared.add(runtime, trial.columns)

    def attempt(session: Session) -> Done:
        corrections = Corrections(session, actor, prepared, version)
        # Nothing that is read depends on what is written. So all rows are written together.
        with session.no_autoflush:
            done = write(corrections)
        corrections.finish()
        return done

    for _ in range(ROUNDS):
        try:
            return runtime.database.run_in_transaction(attempt)
        except _UnmeasuredError as error:
            prepared.add(runtime, error.lacking)
    raise ConflictError("the photographs change again and again; try again later")


@dataclass(frozen=True)
class _Task:
    """A stored image to measure, with all that its flux depends on."""

    sha256: str
    photograph: IncomingPhotograph
    plane: JsonObject
    cameras: tuple[Camera, ...]
    origin: tuple[float, float, float]

    def measure(self, runtime: Runtime) -> JsonObject:
        """The columns that depend on the image."""
        data, plane = runtime.images.read(self.sha256), store.target_plane(TargetRow(**self.plane))
        _, flux = measure_photograph(runtime, self.photograph, data, plane, self.cameras)
        (contradiction,) = find_sun_contradictions([self.photograph], self.origin)
        row = measurement_row(self.photograph, flux, 0, contradiction)
        measured = {name: getattr(row, name) for name in _MEASURED}
        return metadata_columns(self.photograph) | measured


class _Remeasured(NamedTuple):
    """What an image was measured for, and the columns."""

    task: _Task
    columns: JsonObject


class Prepared:
    """What corrections need that takes long.

    ``suns`` are contradictions of suns and times, ``measured`` re-measured images by row id.
    """

    def __init__(self) -> None:
        self.suns: dict[Hashable, SunContradiction | None] = {}
        self.measured: dict[int, _Remeasured] = {}

    def add(self, runtime: Runtime, lacking: "CorrectedColumns") -> None:
        """Compute what was lacking."""
        for number, task in lacking.tasks.items():
            self.measured[number] = _Remeasured(task, task.measure(runtime))
        found = find_sun_contradictions(lacking.compared, lacking.model.site.origin)
        self.suns |= dict(zip(map(_sun_key, lacking.compared), found, strict=True))


def _sun_key(photograph: IncomingPhotograph) -> Hashable:
    """What the contradiction of a photograph's sun and time depends on."""
    sun, weather = photograph.sun, photograph.weather
    return sun.azimuth_deg, sun.elevation_deg, photograph.taken_at, weather.temperature_c


class _UnmeasuredError(Exception):
    """Images must be measured before corrections can be written."""

    def __init__(self, lacking: "CorrectedColumns") -> None:
        self.lacking = lacking


class CorrectedColumns:
    """The columns of corrected photographs, from what is ``prepared``.

    It collects what is lacking: ``tasks``, images to measure by row id, and in a trial
    ``compared``, photographs whose sun is compared with their time.
    """

    def __init__(self, session: Session, prepared: Prepared, is_trial: bool) -> None:
        self.tasks, self.compared = dict[int, _Task](), list[IncomingPhotograph]()
        self.model = get_model(session)
        self._session, self._prepared, self._is_trial = session, prepared, is_trial

    def of(self, row: MeasurementRow, given: GivenCorrection) -> dict[str, object] | None:
        """The columns of a corrected image; None if it is not measured yet."""
        photograph, target, cameras = given.of(row), row.target, self.model.cameras
        if given.target is not None:
            target = store.get_target(self._session, given.target)
        before = camera_at(cameras, row.target.name, row.taken_at)
        is_alike = (
            target is row.target and camera_at(cameras, target.name, photograph.taken_at) == before
        )
        if not is_alike and row.image is not None:
            return self.remeasured(row, photograph, target)
        return {
            "target": target,
            **metadata_columns(photograph),
            **sun_columns(row, photograph, self._contradiction(photograph)),
        }

    def remeasured(
        self, row: MeasurementRow, photograph: IncomingPhotograph, target: TargetRow
    ) -> dict[str, object] | None:
        """The columns of an image that is re-measured; None if that is still to be done."""
        image = row.image
        if image is None:
            raise NotFoundError(f"measurement {row.identifier} came without an image")
        if image.pruned_at is not None:
            raise GoneError(
                f"measurement {row.identifier} must be measured again, and its image was deleted on"
                f" {image.pruned_at:%Y-%m-%d}; exclude it instead"
            )
        camera = camera_at(self.model.cameras, target.name, photograph.taken_at)
        task = _Task(
            image.sha256,
            photograph,
            {name: getattr(target, name) for name in _PLANE},
            () if camera is None else (camera,),
            self.model.site.origin,
        )
        known = self._prepared.measured.get(row.id)
        if known is None or known.task != task:
            self.tasks[row.id] = task
            return None
        warnings = [*(known.columns["warnings"] or ()), *other_warnings(row, photograph)]
        return known.columns | {"target": target, "warnings": warnings or None}

    def _contradiction(self, photograph: IncomingPhotograph) -> SunContradiction | None:
        """What contradicts a photograph's time; a trial leaves it for later."""
        key = _sun_key(photograph)
        if key in self._prepared.suns:
            return self._prepared.suns[key]
        if self._is_trial:
            self.compared.append(photograph)
            return None
        return find_sun_contradictions([photograph], self.model.site.origin)[0]


class Corrections:
    """Corrections of photographs in one transaction, by ``actor``.

    If ``version`` is given, no field may have changed since then. A trial writes nothing, and finds
    what must be prepared.
    """

    def __init__(
        self,
        session: Session,
        actor: str,
        prepared: Prepared,
        version: int | None = None,
        is_trial: bool = False,
    ) -> None:
        self.session, self.actor, self._is_trial = session, actor, is_trial
        self.columns = CorrectedColumns(session, prepared, is_trial)
        self._conflicts, self._outdated = list[str](), list[MeasurementRow]()
        newest = newest_correction(session)
        self._since = None if version is None or version >= newest else version
        self._heliostats: dict[str, HeliostatRow] = {}
        self._named: set[tuple[str, str]] = set()

    @property
    def is_complete(self) -> bool:
        """Whether all can be written: images are measured, and no field changed meanwhile."""
        return not (self._is_trial or self.columns.tasks or self._conflicts)

    def lock(self, heliostats: Iterable[str]) -> None:
        """Lock heliostats in the order of their ids, before their photographs are read."""
        rows = store.get_heliostats(self.session, sorted(set(heliostats)))
        self._heliostats |= rows
        for row in [] if self._is_trial else sorted(rows.values(), key=lambda row: row.id):
            lock_heliostat(self.session, row)

    def find(self, given: GivenCorrection) -> MeasurementRow:
        """The named image; its photograph must not have been named before."""
        found = self._heliostats.get(given.heliostat)
        heliostat = found or store.get_heliostat(self.session, given.heliostat)
        row = store.get_measurement(self.session, heliostat, given.identifier)
        photograph = (given.heliostat, row.external_id or row.identifier)
        if photograph in self._named:
            raise InvalidInputError(
                f"measurement {given.identifier} of {given.heliostat} is named twice; name it once"
            )
        self._named.add(photograph)
        return row

    def apply(self, given: GivenCorrection) -> Corrected:
        """Correct all images of a photograph; raises what `correct_photograph` raises."""
        row = self.find(given)
        images = images_of_photograph(self.session, row).values()
        made = [self._write(given, one, self.columns.of(one, given)) for one in images]
        return Corrected(row, [entry for entry in made if entry is not None])

    def remeasure(self, given: GivenCorrection) -> Corrected:
        """Re-measure an image and correct it."""
        row = self.find(given)
        columns = self.columns.remeasured(row, given.of(row), row.target)
        entry = self._write(given, row, columns)
        return Corrected(row, [] if entry is None else [entry])

    def finish(self) -> None:
        """End the transaction; it fails if a field changed, or an image is not measured yet."""
        if self._conflicts:
            more = f"; and {len(self._conflicts) - 5} more" if len(self._conflicts) > 5 else ""
            raise ConflictError(f"{'; '.join(self._conflicts[:5])}{more}. {audit.READ_AGAIN}")
        if self.columns.tasks:
            raise _UnmeasuredError(self.columns)
        delete_drift(self.session, self._outdated)

    def _write(
        self, given: GivenCorrection, row: MeasurementRow, columns: dict[str, object] | None
    ) -> CorrectionRow | None:
        """Write changed columns with their history; None if none changed, or one may not."""
        if columns is None or self._is_trial:
            return None
        has_flux, reason = "arrays" in columns, given.reason
        before = _state(row, has_flux)
        _assign(row, columns, given.excluded)
        after = _state(row, has_flux)
        apart = [name for name, value in after.items() if value != before[name]]
        if not apart:
            return None
        self._require_unchanged(given, row, apart)
        if not set(apart) <= set(_WEATHER):  # only the next calibration uses the weather
            row.corrected_at = now()
            self._outdated.append(row)
        old, new = ({name: state[name] for name in apart} for state in (before, after))
        entry = CorrectionRow(
            measurement_id=row.id, created_by=self.actor, reason=reason, before=old, after=new
        )
        self.session.add(entry)
        if row.image is not None:
            store.use_image(self.session, row.image, row.accepted, False)
        subject = f"heliostat {given.heliostat} {row.identifier}"
        about = {"reason": reason, "before": old, "after": new}
        audit.record(self.session, self.actor, "measurement.corrected", subject, **about)
        return entry

    def _require_unchanged(
        self, given: GivenCorrection, row: MeasurementRow, names: Collection[str]
    ) -> None:
        """Note the fields among ``names`` that changed since the version."""
        if self._since is not None:
            subject = f"heliostat {given.heliostat} {row.identifier}"
            entries = list_corrections(self.session, row, self._since)
            self._conflicts += audit.list_changes(subject, entries, names)


def _state(row: MeasurementRow, with_flux: bool) -> dict[str, object]:
    """Metadata of a photograph, and the hash of its flux images."""
    flux = None if not with_flux or row.arrays is None else digest(row.arrays)[:12]
    excluded = {"excluded": row.reason == EXCLUDED, "flux": flux}
    return stored_metadata(row) | vars(Weather.of(row)) | excluded


def _assign(row: MeasurementRow, columns: dict[str, object], excluded: bool | None) -> None:
    was_excluded = row.reason == EXCLUDED
    for name, value in columns.items():
        setattr(row, name, value)
    if excluded if excluded is not None else was_excluded:
        row.accepted, row.reason = False, EXCLUDED
    else:
        row.accepted, row.reason = bool(row.quality["accepted"]), row.quality.get("reason") or None
