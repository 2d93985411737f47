"""``heliotwin forecast`` on a measurement folder: flux on targets, compared with photographs."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from heliotwin.folder import (
    add_camera,
    add_ideal_surfaces,
    finish,
    forecast_report,
    predicted_from,
    surfaces_of,
)
from heliotwin.folder_store import FolderStore, open_folder
from model.effects import Effect
from model.errors import InvalidInputError, ModelError
from model.frames import sun_direction
from model.images import clipped_alike
from model.imaging import MeasuredFlux
from model.metrics import FluxComparison, accuracy_window, compare_on_target
from model.plant import TargetPlane
from model.setup import Setup
from service import store
from service.base.progress import Progress, no_progress
from service.sources.folder import MeasuredSurface, MeasurementFolder, points_of
from service.sources.photograph import CENTERED_WINDOW
from service.store.tables import NO_IMAGE, MeasurementRow
from service.twin import operations
from service.twin.measurements import (
    AcceptedMeasurement,
    HeliostatContext,
    accepted_measurement,
    spot_position,
)
from service.twin.photographs.readings import motors_of
from service.twin.stored_mount import load_mount

Array = NDArray[np.float64]

SPILL = 0.01
"""Share of the measured energy that may lie outside the accuracy window, up to `WIDEST` [m]."""

WIDEST = 8.0

# Side [m] of a window that is larger than any target.
_WIDEST_WINDOW = 1000.0


def forecast_measurement(
    opened: FolderStore,
    twin: HeliostatContext,
    row: MeasurementRow,
    surface: MeasuredSurface | None,
) -> operations.Forecast:
    """Forecast the flux on a measurement's whole target, and its camera view.

    The heliostat is aligned to its spot. Without a spot it is aligned by its motor positions, with
    its mount of that time. Without motor positions it aims at the target's centre.
    """
    heliostat, plane, angles = twin.heliostat, store.target_plane(row.target), None
    spot = spot_position(row, plane, twin.origin)
    if spot is None and row.motor_axis_1 is not None and heliostat.mount.actuators is not None:
        heliostat = load_mount(opened.session, heliostat.name).turned(row.taken_at)
        angles = heliostat.mount.angles_from_motors(motors_of(heliostat, row))
    points, degree = points_of(heliostat, surface)
    setup = Setup(
        heliostat,
        points,
        sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        plane,
        spot=spot,
        angles=angles,
        degree=degree,
        taken_at=row.taken_at,
        temperature_c=row.temperature_c,
    )
    with opened.runtime.computing("forecast") as operations:
        return operations.forecast(setup, twin.model)


def _compare(
    twin: HeliostatContext, row: MeasurementRow, traced: operations.Forecast, window: float | None
) -> dict[str, Any]:
    """Accuracy of a forecast compared with the measurement's flux, or why there is none."""
    if row.kind == NO_IMAGE:
        return {"not_compared": "no image"}
    if not row.accepted or row.arrays is None:
        return {"not_compared": f"{row.reason}: {row.quality['detail']}"}
    if row.kind == "flux-centered" and (window or 0) > CENTERED_WINDOW:
        return {"not_compared": f"a centred image shows only {CENTERED_WINDOW:g} m"}
    taken = accepted_measurement(row, twin.origin)
    return asdict(agreement(taken, traced, taken.target, window))


def agreement(
    measured: MeasuredFlux | AcceptedMeasurement,
    traced: operations.Forecast,
    plane: TargetPlane,
    window: float | None = None,
) -> FluxComparison:
    """Compare a forecast with the flux that was measured on a target.

    Without ``window`` [m], its side is chosen from the size of the spot. A centred image is
    compared within its own square.
    """
    forecast, size = traced.camera_view.astype(np.float64), (plane.width, plane.height)
    if measured.flux is None:
        assert measured.square is not None
        flux, square = measured.square.astype(np.float64), (CENTERED_WINDOW, CENTERED_WINDOW)
        window = window or accuracy_window([flux], [square], spill=SPILL, widest=CENTERED_WINDOW)
        return compare_on_target(flux, forecast, size, window, measured_size=square)
    flux = measured.flux.astype(np.float64)
    if measured.clipped is not None:
        forecast = clipped_alike(forecast, flux, measured.clipped.astype(np.float64))
    window = window or accuracy_window([flux], [size], spill=SPILL, widest=WIDEST)
    return compare_on_target(flux, forecast, size, window)


def forecast_folder(
    folder: MeasurementFolder,
    out: Path,
    surfaces: str = "measured",
    window: float | None = None,
    progress: Progress = no_progress,
    effects: Sequence[Effect] = (),
    mounts: Path | None = None,
) -> dict[str, Any]:
    """Forecast every measurement of a folder; ``OUT/H/ID-forecast.npz`` and ``OUT/forecast.json``.

    Heliostats without a surface are forecast as ideal mirrors; the report's ``warnings`` say so.
    ``effects`` are added to those that the folder declares. ``mounts`` is a file of `heliotwin
    calibrate`; without it the heliostats have the mounts of their properties.
    """
    report = forecast_report(folder, surfaces, effects, measurements={})
    used = predicted_from(surfaces)
    if window is not None and not 0 < window <= _WIDEST_WINDOW:
        raise InvalidInputError(f"--window must lie in 0 to {_WIDEST_WINDOW:g} m, got {window:g}")
    source = surfaces if surfaces in ("measured", "ideal") else "predicted"
    without_surface: set[str] = set()
    with open_folder(folder, effects=effects, mounts_file=mounts, progress=progress) as opened:
        report["skipped"] |= opened.refused
        add_camera(report, opened)
        for heliostat, surface in surfaces_of(folder, surfaces, report["skipped"], without_surface):
            name = heliostat.name
            twin, rows = opened.context(name), opened.measurements(name)
            if not rows:
                report["skipped"][name] = "no measurement"
            for row in rows:
                key = f"{name}/{row.identifier}"
                try:
                    traced = forecast_measurement(opened, twin, row, surface)
                except ModelError as error:
                    report["skipped"][key] = str(error)
                    continue
                entry = _entry(out / name, row, traced) | _compare(twin, row, traced, window)
                if key in opened.refused:
                    entry["not_compared"] = opened.refused[key]
                entry["surface"] = "ideal" if surface is None else source
                if name in used and surface is not None:
                    entry["used_for_surface"] = row.identifier in used[name]
                report["measurements"][key] = entry
    forecast = {key.partition("/")[0] for key in report["measurements"]}
    add_ideal_surfaces(report, without_surface, forecast)
    compared = [entry for entry in report["measurements"].values() if "accuracy" in entry]
    report |= _accuracy_by_surface(compared)
    if used:
        report["accuracy_by_use"] = {
            name: _accuracy_of(
                [entry for entry in compared if entry.get("used_for_surface") is was_used]
            )
            for name, was_used in (("used_for_surface", True), ("not_used", False))
        }
    return finish(folder, report, out / "forecast.json", "measurements")


def _accuracy_of(compared: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Mean and median accuracy of some measurements; None if there are none."""
    accuracies = [entry["accuracy"] for entry in compared]
    return {
        "accuracy_mean": float(np.mean(accuracies)) if accuracies else None,
        "accuracy_median": float(np.median(accuracies)) if accuracies else None,
    }


def _accuracy_by_surface(compared: Sequence[dict[str, Any]]) -> dict[str, object]:
    """Accuracy of all measurements.

    If ideal mirrors replace only some of the surfaces, they are counted separately.
    """
    by_surface = {
        surface: _accuracy_of([entry for entry in compared if entry["surface"] == surface])
        for surface in sorted({entry["surface"] for entry in compared})
    }
    found = next(
        (accuracy for surface, accuracy in by_surface.items() if surface != "ideal"),
        by_surface.get("ideal", _accuracy_of([])),
    )
    return {**found, **({"accuracy_by_surface": by_surface} if len(by_surface) > 1 else {})}


def circularity(report: dict[str, Any]) -> str | None:
    """Warning if surfaces are tested on images that they were predicted from, or None."""
    compared = [entry for entry in report["measurements"].values() if "accuracy" in entry]
    n_used = sum(entry.get("used_for_surface", False) for entry in compared)
    if not n_used:
        return None
    used, others = (
        report["accuracy_by_use"][name]["accuracy_mean"]
        for name in ("used_for_surface", "not_used")
    )
    said = (
        f"{n_used} of {len(compared)} images were used for the surfaces that they judge: accuracy"
        f" {used:.3f}"
    )
    if others is None:
        return f"{said}; no image is left that was not used, so that the accuracy is too favourable"
    return f"{said} by them, {others:.3f} by those not used"


def _entry(out: Path, row: MeasurementRow, traced: operations.Forecast) -> dict[str, object]:
    """Write the forecast of one measurement and return its entry in ``forecast.json``."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{row.identifier}-forecast.npz"
    np.savez_compressed(path, flux=traced.flux, camera_view=traced.camera_view)
    return {"target": row.target.name, "peak_w_m2": traced.peak, "power_w": traced.power}
