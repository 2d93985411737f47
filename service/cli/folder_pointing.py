"""The mounts of a measurement folder: ``heliotwin calibrate``, ``heliotwin spot``, and ``--mounts`` of other verbs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError, ModelError
from model.plant import Heliostat
from model.pointing import CalibratedMount, Reading, calibrate_field
from model.pointing.report import day_of, field_to_json, mount_from_json, sun_to_json
from model.study import FluxImage
from service.base.progress import Progress, quiet
from service.cli.folder import clock_fault_of, write_json
from service.sources.documents import Measurement, get, read_json
from service.sources.folder import MeasurementFolder
from service.twin.mounted import true_sun
from service.twin.pointing import days_of

Array = NDArray[np.float64]


def calibrate_folder(
    folder: MeasurementFolder, out: Path, progress: Progress = quiet, until: datetime | None = None
) -> dict[str, Any]:
    """Mounts of a folder's heliostats from their motors, suns and spots; MOUNTS.json.

    With ``until`` only from measurements before: a study can then say what has changed since (`Mounts.photograph`).

    Raises
    ------
    ModelError
        Where no heliostat has a measurement with motors and a spot.
    """
    readings, clocks = read_readings(folder, progress)
    if until is not None:
        earlier = {name: [one for one in own if one.day < day_of(until)] for name, own in readings.items()}
        readings = {name: own for name, own in earlier.items() if own}
    skipped = folder.skipped
    if not readings:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        raise ModelError(f"no heliostat can be calibrated ({reasons})")
    done = calibrate_field(
        folder.plant.heliostats, readings, folder.plant.targets, latitude_deg=float(folder.plant.origin[0])
    )
    report = field_to_json(done, skipped, folder.effects) | ({"clocks": clocks} if clocks else {})
    write_json(out, report)
    return report


def read_readings(
    folder: MeasurementFolder, progress: Progress = quiet
) -> tuple[dict[str, list[Reading]], dict[str, str]]:
    """A folder's readings by heliostat, and faults of clocks by measurement; ``folder.skipped`` notes what is none."""
    skipped, clocks = folder.skipped, dict[str, str]()
    readings: dict[str, list[Reading]] = {}
    measured = _measurements(folder)
    days = _days(folder, measured, clocks)
    for name, own in measured.items():
        progress(name)
        usable = []
        for place, measurement in enumerate(own):
            # What nothing dates keeps its place in the folder's order.
            day = float(np.nan_to_num(days[measurement.key], nan=place))
            try:
                usable.append(_reading(folder, measurement, day))
            except ModelError as error:
                skipped[measurement.key] = str(error)
        if usable:
            readings[name] = usable
        else:
            skipped[name] = "no measurement with motors, sun and spot"
    return readings, clocks


def spot_folder(folder: MeasurementFolder, mounts: Path, out: Path, progress: Progress = quiet) -> dict[str, Any]:
    """Where the light of each measurement's motors lands by calibrated mounts; SPOTS.json.

    Raises
    ------
    InvalidInputError
        Where the file of mounts is none.
    ModelError
        Where there is a spot of no measurement.
    """
    known = read_mounts(mounts, folder.effects)
    skipped, spots = folder.skipped, {}
    measured = _measurements(folder)
    days = _days(folder, measured, {})
    for name, own in measured.items():
        progress(name)
        if name not in known:
            skipped[name] = f"{mounts} has no mount of it; calibrate it first"
            continue
        for measurement in own:
            try:
                spots[measurement.key] = _spot(folder, measurement, known[name], days[measurement.key])
            except ModelError as error:
                skipped[measurement.key] = str(error)
    report = {"spots": spots, "skipped": skipped}
    write_json(out, report)
    if not spots:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        raise ModelError(f"no spot can be told ({reasons}); see {out}")
    return report


def read_mounts(path: Path, effects: Sequence[Effect]) -> dict[str, CalibratedMount]:
    """The mounts of a file that `calibrate_folder` wrote, by heliostat, to be used under a model's effects.

    Raises
    ------
    InvalidInputError
        Where it is no such file, or its mounts were calibrated under another sun than the model's.
    """
    documents = get(read_json(path), str(path), "heliostats")
    if not isinstance(documents, dict):
        raise InvalidInputError(f"{path}: 'heliostats' must be a JSON object")
    mounts = {name: mount_from_json(document, f"{path}, {name}") for name, document in documents.items()}
    if any(document.get("sun", []) != sun_to_json(effects) for document in documents.values()):
        raise InvalidInputError(
            f"{path}: its mounts were calibrated under another sun than this model has; declare what moves the sun in "
            "twin.json, and calibrate again"
        )
    return mounts


class Mounts:
    """What a folder's heliostats stand on: calibrated mounts where a file has them, else what their properties say."""

    def __init__(self, folder: MeasurementFolder, path: Path | None, effects: Sequence[Effect] = ()) -> None:
        """Those in a file, if one is named, under the folder's effects and others; raises what `read_mounts` raises."""
        self._known = {} if path is None else read_mounts(path, [*folder.effects, *effects])
        names = folder.plant.heliostats if self._known else ()
        self._days = _days_of([one for name in names for one in folder.measurements(name, with_images=False)])

    def stand(self, heliostat: Heliostat, measurement: Measurement | None = None) -> Heliostat:
        """A heliostat as it stood at a measurement, by default as newly measured."""
        mount = self._known.get(heliostat.name)
        if mount is None:
            return heliostat
        day = np.nan if measurement is None else self._days[measurement.key]
        return replace(heliostat, mount=mount.mount(heliostat.mount, day))

    def photograph(self, nominal: Heliostat, measurement: Measurement, taken: FluxImage) -> FluxImage:
        """A photograph of a measurement with what its motors say, where it is newer than all its mount has seen.

        ``nominal`` is the heliostat as its properties have it. What a mount was calibrated by speaks for it anyway.
        """
        mount, motors = self._known.get(nominal.name), measurement.motor_position
        return taken if mount is None else taken.sent(nominal, mount, motors, self._days[measurement.key])

    def under(self, folder: MeasurementFolder) -> MeasurementFolder:
        """The folder, its heliostats as newly measured: zeros of drives matter only to who turns them by motors."""
        heliostats = {name: self.stand(one) for name, one in folder.plant.heliostats.items()}
        return replace(folder, plant=replace(folder.plant, heliostats=heliostats))


def _measurements(folder: MeasurementFolder) -> dict[str, list[Measurement]]:
    """Measurements by heliostat, of those that have drives; ``folder.skipped`` notes the others."""
    found, skipped = {}, folder.skipped
    for name, heliostat in folder.plant.heliostats.items():
        if heliostat.mount.actuators is None:
            skipped[name] = "its kinematics have no linear actuators, so motor positions say nothing of its angles"
            continue
        found[name] = folder.measurements(name, with_images=False)
    return found


def _days(
    folder: MeasurementFolder, measured: Mapping[str, Sequence[Measurement]], clocks: dict[str, str]
) -> dict[str, float]:
    """Days since 1970 by measurement; those without a time by their numbers, which PAINT's plant counts on.

    Faults of clocks are noted in ``clocks``: hours matter little where mounts change by days.
    """
    measurements = [one for own in measured.values() for one in own]
    faults = {one.key: clock_fault_of(folder, one) for one in measurements}
    clocks.update({key: fault for key, fault in faults.items() if fault is not None})
    return _days_of(measurements)


def _days_of(measurements: Sequence[Measurement]) -> dict[str, float]:
    days = days_of([one.taken_at for one in measurements], [one.identifier for one in measurements])
    return {one.key: float(day) for one, day in zip(measurements, days, strict=True)}


def motors_of(heliostat: Heliostat, measurement: Measurement) -> Array:
    """Motor positions (2,) [steps] within the drives' travel."""
    if measurement.motor_position is None:
        raise InvalidInputError("no 'motor_position'")
    heliostat.mount.require_within(measurement.motor_position)
    return measurement.motor_position


def _reading(folder: MeasurementFolder, measurement: Measurement, day: float) -> Reading:
    heliostat = folder.plant.heliostats[measurement.heliostat]
    motors = motors_of(heliostat, measurement)
    if measurement.spot is None:
        raise InvalidInputError("no 'focal_spot'")
    if not any(_on(plane, measurement.spot) for plane in folder.plant.targets.values()):
        raise InvalidInputError("'focal_spot' lies off every target")
    told = (measurement.identifier, measurement.target, motors, _sun(folder, measurement), measurement.spot, day)
    return Reading(*told, measurement.weather)


def _sun(folder: MeasurementFolder, measurement: Measurement) -> Array:
    """Where the sun (3,) stood by the declared model."""
    return true_sun(folder.effects, measurement.sun, measurement.taken_at, float(folder.plant.origin[0]))


# How far [m] a spot may lie off a target's plane, and off its edge: rounding and surveys, not another place.
_OFF_M = 0.5


def _on(plane: Any, spot: Array) -> bool:
    aside = np.abs(plane.to_plane(spot)) - np.array([plane.width, plane.height]) / 2
    return bool((aside < _OFF_M).all() and abs((spot - plane.center) @ plane.normal) < _OFF_M)


def _spot(folder: MeasurementFolder, measurement: Measurement, mount: CalibratedMount, day: float) -> dict[str, Any]:
    heliostat, plane = folder.plant.heliostats[measurement.heliostat], folder.plant.targets[measurement.target]
    motors, sun = motors_of(heliostat, measurement), _sun(folder, measurement)
    point, std = mount.spot(heliostat, plane, motors, sun, day)
    return {
        "spot": np.round(point, 5).tolist(),
        "std_m": round(std, 5),
        "target": measurement.target,
        "on_target": plane.holds(point),
    }
