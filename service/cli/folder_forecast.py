"""``heliotwin forecast`` on a measurement folder: light over whole targets, and how well it agrees with photographs."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, effect_to_json, model_version
from model.errors import InvalidInputError, ModelError
from model.images import clipped_alike
from model.imaging import MeasuredFlux
from model.metrics import FluxComparison, accuracy_window, compare_on_target
from model.plant import TargetPlane
from service.base.progress import Progress, quiet
from service.cli.folder import ROUGHEST_FIRST, check_surfaces, finish, measure, with_surfaces
from service.cli.folder_pointing import Mounts, motors_of
from service.sources.documents import Measurement, optics_to_json
from service.sources.folder import MeasurementFolder
from service.twin import compute

Array = NDArray[np.float64]

SPILL = 0.01
"""Share of the measured energy that may lie outside the accuracy's window, up to one of `WIDEST` [m]."""

WIDEST = 8.0

# Side [m] of a window that no target reaches.
_WIDEST_WINDOW = 1000.0


def forecast_measurement(
    folder: MeasurementFolder,
    measurement: Measurement,
    surface: tuple[Array, int] | None,
    effects: Sequence[Effect] = (),
    mounts: Mounts | None = None,
) -> compute.Forecast:
    """Light over a measurement's whole target, and what the camera shows of it; ``effects`` add to the declared ones.

    The heliostat is aligned by its measured spot; without one by its motors, on its mount of that time; without those
    at the target's centre.
    """
    heliostat, plane = folder.plant.heliostats[measurement.heliostat], folder.plant.targets[measurement.target]
    if mounts is not None:
        heliostat = mounts.stand(heliostat, measurement)
    motors = None
    if measurement.spot is None and measurement.motor_position is not None and heliostat.mount.actuators:
        motors = motors_of(heliostat, measurement)
    return compute.forecast(
        heliostat,
        None,
        measurement.sun,
        plane,
        spot=measurement.spot,
        angles=None if motors is None else heliostat.mount.angles_from_motors(motors),
        optics=folder.optics,
        surface=surface,
        effects=[*folder.effects, *effects],
        latitude_deg=float(folder.plant.origin[0]),
        taken_at=measurement.taken_at,
    )


def compare(
    folder: MeasurementFolder, measurement: Measurement, traced: compute.Forecast, window: float | None
) -> dict[str, Any] | None:
    """Accuracy of a forecast against the measurement's flux; None without an image of its target, or a refused one."""
    if not any(kind in measurement.images for kind in ROUGHEST_FIRST[:-1]):
        return None
    measured = measure(folder, measurement)
    if measured.flux is None:
        return None
    return asdict(agreement(measured, traced, folder.plant.targets[measurement.target], window))


def agreement(
    measured: MeasuredFlux, traced: compute.Forecast, plane: TargetPlane, window: float | None = None
) -> FluxComparison:
    """A forecast against the flux that was measured on a target; in a window [m] by the spot if none is given.

    Raises
    ------
    InvalidInputError
        Where the photograph was refused.
    """
    if measured.flux is None:
        raise InvalidInputError(f"{measured.quality.reason}: {measured.quality.detail}")
    flux, forecast = measured.flux.astype(np.float64), traced.camera_view.astype(np.float64)
    if measured.clipped is not None:
        forecast = clipped_alike(forecast, flux, measured.clipped.astype(np.float64))
    size = (plane.width, plane.height)
    window = window or accuracy_window([flux], [size], spill=SPILL, widest=WIDEST)
    return compare_on_target(flux, forecast, size, window)


def forecast_folder(
    folder: MeasurementFolder,
    out: Path,
    surfaces: str = "measured",
    window: float | None = None,
    progress: Progress = quiet,
    effects: Sequence[Effect] = (),
    mounts: Mounts | None = None,
) -> dict[str, Any]:
    """Forecast every measurement of a folder; ``OUT/H/ID-forecast.npz`` and ``OUT/forecast.json``.

    ``effects`` come in addition to those that the folder declares; without ``mounts`` heliostats stand as their
    properties say.
    """
    check_surfaces(surfaces)
    if window is not None and not 0 < window <= _WIDEST_WINDOW:
        raise InvalidInputError(f"--window must lie in 0 to {_WIDEST_WINDOW:g} m, got {window:g}")
    report: dict[str, Any] = {
        "surfaces": surfaces,
        "model_version": model_version([*folder.effects, *effects]),
        "effects": [effect_to_json(effect) for effect in (*folder.effects, *effects)],
        "optics": {"dni_w_m2": folder.optics.dni, **optics_to_json(folder.optics)},
        "measurements": {},
        "skipped": {},
    }
    for heliostat, surface in with_surfaces(folder, surfaces, report["skipped"]):
        measurements = folder.measurements(heliostat.name, with_images=False)
        if not measurements:
            report["skipped"][heliostat.name] = "no measurement"
        for measurement in measurements:
            progress(measurement.key)
            try:
                entry = _forecast_entry(folder, measurement, surface, effects, mounts, out, window)
            except ModelError as error:
                report["skipped"][measurement.key] = str(error)
                continue
            report["measurements"][measurement.key] = entry
    accuracies = [e["accuracy"] for e in report["measurements"].values() if "accuracy" in e]
    report["accuracy_mean"] = float(np.mean(accuracies)) if accuracies else None
    report["accuracy_median"] = float(np.median(accuracies)) if accuracies else None
    return finish(folder, report, out / "forecast.json", "measurements")


def _forecast_entry(
    folder: MeasurementFolder,
    measurement: Measurement,
    surface: tuple[Array, int] | None,
    effects: Sequence[Effect],
    mounts: Mounts | None,
    out: Path,
    window: float | None,
) -> dict[str, Any]:
    """Write the forecast of one measurement and give back its entry in ``forecast.json``."""
    traced = forecast_measurement(folder, measurement, surface, effects, mounts)
    path = out / measurement.heliostat / f"{measurement.identifier}-forecast.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, flux=traced.flux, camera_view=traced.camera_view)
    entry: dict[str, Any] = {"target": measurement.target, "peak_w_m2": traced.peak, "power_w": traced.power}
    comparison = compare(folder, measurement, traced, window)
    return entry if comparison is None else {**entry, **comparison}
