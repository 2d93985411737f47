"""Verbs on a measurement folder: flux and predict, and functions that all folder verbs share.

Each verb visits all heliostats and skips those with missing data, with a reason. It writes its
files to one folder, with a report that it also returns. A verb fails only if every heliostat is
skipped.
"""

import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from heliotwin.folder_store import FolderStore, open_folder
from model.effects import Effect, effect_to_json
from model.errors import InvalidInputError, ModelError
from model.images import FLUX_WINDOW
from model.imaging import ImageKind
from model.metrics import surface_error
from model.network.architecture import MAX_IMAGES
from model.observation import Observation, SurfacePrediction
from model.plant import Heliostat
from model.surface import split_canting
from service import store
from service.base.arrays import pair_or_none, unpack
from service.base.choices import Method, Selection, require_images
from service.base.errors import list_reasons
from service.base.progress import Progress, no_progress
from service.sources.documents import optics_to_json, read_json
from service.sources.folder import (
    MeasuredSurface,
    MeasurementFolder,
    measured_heights,
    read_surface,
)
from service.store.tables import NO_IMAGE, MeasurementRow
from service.twin.measurements import accepted_measurement, to_observations
from service.twin.surfaces.prediction import choose_observations

Array = NDArray[np.float64]

ROUGHEST_FIRST: tuple[ImageKind, ...] = ("raw", "cropped", "flux", "flux-centered")
"""Kinds of image, from the least to the most processed."""


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON; create the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_report(folder: MeasurementFolder, report: dict[str, Any], path: Path) -> None:
    report["skipped"] = {**folder.skipped, **report["skipped"]}
    write_json(path, report)


def add_camera(report: dict[str, Any], opened: FolderStore) -> None:
    """Add the camera that the images chose to a report, and to its warnings unless it is usual."""
    choice = opened.camera
    report["camera"] = None if choice is None else choice.to_json()
    report["warnings"] = list(report.get("warnings", ()))
    if choice is not None and choice.answer != "linear":
        report["warnings"].append(choice.in_words)


def forecast_report(
    folder: MeasurementFolder, surfaces: str, effects: Sequence[Effect], **more: Any
) -> dict[str, Any]:
    """An empty report of forecasts with these ``surfaces``, by the model with added effects."""
    check_surfaces(surfaces)
    model = folder.model.with_effects(effects)
    return {
        "warnings": [],
        "surfaces": surfaces,
        **more,
        "effects": [effect_to_json(effect) for effect in model.effects],
        "optics": {"dni_w_m2": model.optics.dni, **optics_to_json(model.optics)},
        "ideal_surfaces": [],
        "skipped": {},
    }


def finish(
    folder: MeasurementFolder, report: dict[str, Any], path: Path, done: str
) -> dict[str, Any]:
    """Write the report with all skipped items; raise ModelError if ``report[done]`` is empty."""
    _write_report(folder, report, path)
    if not report[done]:
        reasons = list_reasons(report["skipped"])
        raise ModelError(f"nothing was left to do, everything was skipped ({reasons}); see {path}")
    return report


# --- flux
# --------------------------------------------------------------------------------------------------


def flux_folder(
    folder: MeasurementFolder, out: Path, progress: Progress = no_progress
) -> dict[str, Any]:
    """Measure the flux of every camera frame or crop.

    The files are ``OUT/H/ID-flux.png``, ``OUT/H/ID-flux-centered.npz`` and ``OUT/quality.json``.
    """
    report: dict[str, Any] = {"images": {}, "skipped": {}}
    with open_folder(folder, ROUGHEST_FIRST, progress=progress) as opened:
        report["skipped"] |= opened.refused
        add_camera(report, opened)
        for name in opened.names:
            rows = opened.measurements(name)
            rows = [row for row in rows if row.kind != NO_IMAGE]
            if not rows and not any(key.startswith(f"{name}/") for key in opened.refused):
                report["skipped"][name] = "no image"
            for row in rows:
                entry = {"kind": row.kind, **row.quality}
                center = pair_or_none(row.center_right_m, row.center_up_m)
                if center is not None:
                    spot = store.target_plane(row.target).to_enu(center)
                    entry["center_of_mass_m"] = list(center)
                    entry["center_of_mass_wgs84"] = folder.plant.to_wgs84(spot).tolist()
                _write_flux(out / name, row, center)
                report["images"][f"{name}/{row.identifier}"] = entry
    return finish(folder, report, out / "quality.json", "images")


def _write_flux(folder: Path, row: MeasurementRow, center: tuple[float, float] | None) -> None:
    """Write the flux over the whole target (8-bit picture) and the centered window (arrays).

    Nothing is written for a rejected image.
    """
    folder.mkdir(parents=True, exist_ok=True)
    known = {} if row.arrays is None else unpack(row.arrays)
    if "flux" in known:
        write_gray(folder / f"{row.identifier}-flux.png", known["flux"])
    if "centered" in known:
        arrays = {"flux": known["centered"], "window_m": np.array(FLUX_WINDOW)}
        if center is not None:
            arrays["center_of_mass_m"] = np.array(center)
        np.savez_compressed(folder / f"{row.identifier}-flux-centered.npz", **arrays)  # type: ignore[arg-type]


def write_gray(path: Path, image: NDArray[Any]) -> None:
    """Write an 8-bit gray picture with the peak at 255."""
    scaled = np.round(
        np.asarray(image, dtype=np.float64) / max(float(image.max()), 1e-30) * 255
    ).astype(np.uint8)
    if not cv2.imwrite(str(path), scaled):
        raise OSError(f"{path} could not be written")


# --- predict
# --------------------------------------------------------------------------------------------------


def observations_of(opened: FolderStore, heliostat: str) -> Selection[Observation]:
    """Observations of a heliostat, and the reasons of rejected images by identifier."""
    twin, (rows, refused) = opened.context(heliostat), opened.photographs(heliostat)
    evidence = [accepted_measurement(row, twin.origin) for row in rows]
    return Selection(to_observations(evidence, twin.heliostat), refused)


def predict_heliostat(
    opened: FolderStore, name: str, method: Method, images: int
) -> tuple[SurfacePrediction, dict[str, object]]:
    """Predict one heliostat's surface; also return its entry in ``predictions.json``."""
    twin, (rows, refused) = opened.context(name), opened.photographs(name)
    if not rows:
        reason = (
            f"every image was refused: {next(iter(refused.values()))}" if refused else "no image"
        )
        raise InvalidInputError(reason)
    with opened.runtime.computing(f"predict_{method}") as operations:
        chosen, apart = choose_observations(operations, twin, rows, images)
        predicted = operations.predict(twin.heliostat, chosen, twin.model, method)
    entry: dict[str, object] = {
        "method": predicted.method,
        "weights": predicted.weights,
        "images": list(predicted.used),
        "information_share": {
            name: round(share, 3)
            for name, share in zip(predicted.used, predicted.information_shares, strict=False)
        },
        "refused": refused | apart,
        "misfit": round(predicted.misfit, 4),
        "trusted": predicted.trusted,
        "mahalanobis_distance": round(predicted.mahalanobis_distance, 3),
        "suspicious": list(predicted.suspicious),
        "contradicting": list(predicted.contradicting),
        "warnings": list(predicted.warnings),
        "z_rms_mm": round(float(np.sqrt((predicted.z**2).mean()) * 1e3), 4),
        "z_std_mean_mm": round(float(predicted.z_std.mean() * 1e3), 4),
    }
    if predicted.method != method:
        few = "few photographs agree better with the network's surface than with a refined one"
        entry["note"] = few if method == "refined" else _refined_note(twin.heliostat)
    measured = opened.folder.measured_surface(name)
    if measured is not None:
        truth = measured_heights(twin.heliostat, measured)
        entry["against_measured"] = surface_errors(predicted.z, truth)
        entry["measured_spline"] = (
            "fit of deflectometry: a parameter is a position"
            if measured.parameters_are_positions
            else "its geometry"
        )
    return predicted, entry


def _refined_note(heliostat: Heliostat) -> str:
    width, height = 2 * heliostat.facet_frames.half_sizes.mean(axis=0)
    return (
        f"no network was trained for mirrors of {len(heliostat.facets)} facets of {width:.2f} m x"
        f" {height:.2f} m on this mount: the surface was refined"
    )


def surface_errors(z: Array, truth: Array) -> dict[str, float]:
    """Mean absolute errors [mm] of control heights: total, canting, waviness, and the ideal
    surface's.
    """
    (canting, waviness), (true_canting, true_waviness) = split_canting(z), split_canting(truth)
    errors = {
        "mae_mm": surface_error(z, truth),
        "mae_canting_mm": surface_error(canting, true_canting),
        "mae_waviness_mm": surface_error(waviness, true_waviness),
        "mae_ideal_mm": surface_error(np.zeros_like(truth), truth),
    }
    return {name: round(value * 1e3, 4) for name, value in errors.items()}


def predict_folder(
    folder: MeasurementFolder,
    out: Path,
    method: Method = "network",
    images: int = MAX_IMAGES,
    progress: Progress = no_progress,
    mounts: Path | None = None,
) -> dict[str, Any]:
    """Predict every heliostat's surface from up to ``images`` of its images.

    The files are those of `write_surface` and ``OUT/predictions.json``. ``mounts`` is a file of
    `heliotwin calibrate`.
    """
    require_images(method, images)
    report: dict[str, Any] = {"method": method, "heliostats": {}, "skipped": {}}
    try:
        with open_folder(folder, mounts_file=mounts, progress=progress) as opened:
            add_camera(report, opened)
            for name in opened.names:
                progress(name)
                try:
                    predicted, entry = predict_heliostat(opened, name, method, images)
                except ModelError as error:
                    report["skipped"][name] = str(error)
                    continue
                points, z, z_std = predicted.control_points, predicted.z, predicted.z_std
                write_surface(out, name, control_points=points, z=z, z_std=z_std)
                report["heliostats"][name] = entry
    except KeyboardInterrupt:  # the finished predictions may be hours of work
        left = [name for name in folder.plant.heliostats if name not in report["heliostats"]]
        report["skipped"] = dict.fromkeys(left, "interrupted") | report["skipped"]
        _write_report(folder, report, out / "predictions.json")
        raise
    return finish(folder, report, out / "predictions.json", "heliostats")


def write_surface(out: Path, name: str, **arrays: Array) -> None:
    """Write ``OUT/H/Deflectometry/H-nurbs-surface.npz``, in the format of a measured surface.

    ``arrays`` are its ``control_points`` (F, I, J, 3) [m], and more of a predicted one.
    """
    path = out / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays, degrees=np.array([3, 3]))  # type: ignore[arg-type]


# --- surfaces
# --------------------------------------------------------------------------------------------------


def check_surfaces(surfaces: str) -> None:
    """Check that ``surfaces`` is ``measured``, ``ideal`` or a folder."""
    if surfaces not in ("measured", "ideal") and not Path(surfaces).is_dir():
        raise InvalidInputError(
            f"--surfaces must be 'measured', 'ideal' or a folder of predictions, got {surfaces!r}"
        )


def surfaces_of(
    folder: MeasurementFolder,
    surfaces: str,
    skipped: dict[str, str],
    without_surface: set[str] | None = None,
) -> Iterator[tuple[Heliostat, MeasuredSurface | None]]:
    """Iterate over heliostats with control points and degree of their surface; None is the ideal.

    A heliostat whose surface is missing has the ideal one, and its name is added to
    ``without_surface``. Without that set it is skipped. Heliostats whose surface cannot be read are
    skipped, too: they are added to ``skipped``, with the reason.
    """
    for name, heliostat in folder.plant.heliostats.items():
        if name in folder.skipped:
            continue
        try:
            found = _find_surface(folder, heliostat, surfaces)
            if found is None and surfaces != "ideal":
                root = folder.root if surfaces == "measured" else Path(surfaces)
                if without_surface is None:
                    raise InvalidInputError(f"no surface in {root / name / 'Deflectometry'}")
                without_surface.add(name)
        except ModelError as error:
            skipped[name] = str(error)
        else:
            yield heliostat, found


def _find_surface(
    folder: MeasurementFolder, heliostat: Heliostat, surfaces: str
) -> MeasuredSurface | None:
    if surfaces == "ideal":
        return None
    if surfaces == "measured":
        return folder.measured_surface(heliostat.name)
    return read_surface(Path(surfaces), heliostat)


def add_ideal_surfaces(
    report: dict[str, Any], without_surface: Collection[str], forecast: Collection[str]
) -> None:
    """Add the forecast heliostats without a surface to a report, and to its warnings."""
    ideal = report["ideal_surfaces"] = sorted(set(without_surface).intersection(forecast))
    if ideal:
        report["warnings"].append(
            f"{len(ideal)} of {len(forecast)} heliostats have no surface and are forecast as ideal"
            " mirrors; heliotwin predict predicts surfaces, and --surfaces reads them"
        )


def predicted_from(surfaces: str) -> dict[str, list[str]]:
    """Photographs, by heliostat, that a folder of predictions was computed from:
    their identifiers.
    """
    path = Path(surfaces) / "predictions.json"
    if surfaces in ("measured", "ideal") or not path.is_file():
        return {}
    try:
        return {
            name: list(entry["images"]) for name, entry in read_json(path)["heliostats"].items()
        }
    except (KeyError, TypeError, AttributeError):
        raise InvalidInputError(f"{path} is not as `heliotwin predict` writes it") from None
