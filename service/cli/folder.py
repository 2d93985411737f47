"""The command line's verbs on a measurement folder: flux, predict; and what all of them share.

Each walks the heliostats, skips what lacks something and says why, writes its files under one folder and returns the
report that it also writes there. A verb fails only if nothing is left.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from model.ephemeris import clock_fault
from model.errors import InvalidInputError, ModelError
from model.imaging import Camera, ImageKind, MeasuredFlux
from model.imaging.light import camera_at
from model.metrics import surface_error
from model.network.architecture import MAX_IMAGES
from model.observation import Observation, SurfacePrediction
from model.plant import Heliostat, TargetPlane
from model.surface import split_canting
from service.base.choices import Method, require_images
from service.base.progress import Progress, quiet
from service.sources.decode import Pixels, decode_image
from service.sources.documents import IMAGE_KINDS, Measurement
from service.sources.files import require_regular
from service.sources.folder import MeasurementFolder, measured_heights, read_surface
from service.twin import compute
from service.twin.consensus import agreeing
from service.twin.evidence import Evidence, as_observations, choose

Array = NDArray[np.float64]

ROUGHEST_FIRST: tuple[ImageKind, ...] = ("raw", "cropped", "flux", "flux-centered")
"""Kinds of image by how much is left to do to them."""


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON, making the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_image(path: Path) -> Pixels:
    """Decode an image file; a file that is no image is named."""
    try:
        return decode_image(require_regular(path).read_bytes())
    except InvalidInputError as error:
        raise InvalidInputError(f"{path}: {error}") from None


@lru_cache(maxsize=512)
def _measure(path: Path, kind: ImageKind, plane: TargetPlane, camera: Camera | None) -> MeasuredFlux:
    return compute.measure(read_image(path), kind, plane, camera=camera)


def measure(folder: MeasurementFolder, measurement: Measurement, kind: ImageKind | None = None) -> MeasuredFlux:
    """Flux of a measurement's most worked-out image, or of its image of one kind."""
    chosen = next(k for k in IMAGE_KINDS if k in measurement.images) if kind is None else kind
    plane = folder.plant.targets[measurement.target]
    camera = camera_at(folder.cameras, measurement.target, measurement.taken_at)
    return _measure(measurement.images[chosen], chosen, plane, camera)


def clock_fault_of(folder: MeasurementFolder, measurement: Measurement) -> str | None:
    """Where a measurement's time and sun disagree, and the likely reason; None where they agree, or it has no time."""
    if measurement.taken_at is None:
        return None
    latitude_deg, longitude_deg, _ = folder.plant.origin
    return clock_fault(measurement.sun, measurement.taken_at, latitude_deg, longitude_deg)


def _write_report(folder: MeasurementFolder, report: dict[str, Any], path: Path) -> None:
    report["skipped"] = {**folder.skipped, **report["skipped"]}
    write_json(path, report)


def finish(folder: MeasurementFolder, report: dict[str, Any], path: Path, done: str) -> dict[str, Any]:
    """Write the report with all that was skipped; refuse to call nothing a success."""
    _write_report(folder, report, path)
    if not report[done]:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(report["skipped"].items())[:3])
        raise ModelError(f"nothing was left to do, everything was skipped ({reasons}); see {path}")
    return report


# --- flux -------------------------------------------------------------------------------------------------------------


def flux_folder(folder: MeasurementFolder, out: Path, progress: Progress = quiet) -> dict[str, Any]:
    """Measure every camera frame or crop: ``OUT/H/ID-flux.png``, ``ID-flux-centered.npz``, ``quality.json``."""
    report: dict[str, Any] = {"images": {}, "skipped": {}}
    for name in folder.plant.heliostats:
        measurements = folder.measurements(name)
        if not measurements:
            report["skipped"][name] = "no image"
        for measurement in measurements:
            progress(measurement.key)
            kind = next(k for k in ROUGHEST_FIRST if k in measurement.images)
            try:
                measured = measure(folder, measurement, kind)
            except ModelError as error:
                report["skipped"][measurement.key] = str(error)
                continue
            entry = {"kind": kind, **asdict(measured.quality), "clock": clock_fault_of(folder, measurement)}
            if measured.flux is not None and measured.center_of_mass is not None:
                spot = folder.plant.targets[measurement.target].to_enu(measured.center_of_mass)
                entry["center_of_mass_m"] = [float(v) for v in measured.center_of_mass]
                entry["center_of_mass_wgs84"] = [float(v) for v in folder.plant.to_wgs84(spot)]
            _write_flux(out / name, measurement.identifier, measured)
            report["images"][measurement.key] = entry
    return finish(folder, report, out / "quality.json", "images")


def _write_flux(folder: Path, identifier: str, measured: MeasuredFlux) -> None:
    """The flux over the whole target as an 8-bit picture, the centred window as numbers; nothing of a refused one."""
    folder.mkdir(parents=True, exist_ok=True)
    if measured.flux is not None:
        write_gray(folder / f"{identifier}-flux.png", measured.flux)
    if measured.centered is not None:
        arrays = {"flux": measured.centered, "window_m": np.array(measured.window)}
        if measured.center_of_mass is not None:
            arrays["center_of_mass_m"] = measured.center_of_mass
        np.savez_compressed(folder / f"{identifier}-flux-centered.npz", **arrays)  # type: ignore[arg-type]


def write_gray(path: Path, image: NDArray[Any]) -> None:
    """An 8-bit grey picture, the peak at 255."""
    scaled = np.round(np.asarray(image, dtype=np.float64) / max(float(image.max()), 1e-30) * 255).astype(np.uint8)
    if not cv2.imwrite(str(path), scaled):
        raise OSError(f"{path} could not be written")


# --- predict ----------------------------------------------------------------------------------------------------------


def evidence_of(folder: MeasurementFolder, measurement: Measurement) -> Evidence:
    """What a measurement tells the model, of its most worked-out image.

    Raises
    ------
    InvalidInputError
        Where the image cannot be read, or is refused; the message says why.
    """
    measured, target = measure(folder, measurement), folder.plant.targets[measurement.target]
    if measured.centered is None:
        raise InvalidInputError(f"{measured.quality.reason}: {measured.quality.detail}")
    center = measured.center_of_mass
    return Evidence(
        identifier=measurement.identifier,
        sun=measurement.sun,
        target=target,
        flux=measured.flux,
        centered=measured.centered,
        spot=measurement.spot if center is None else target.to_enu(center),
        motor_position=measurement.motor_position,
        taken_at=measurement.taken_at,
        clipped=measured.clipped,
        sheet_share=measured.quality.sheet_share,
    )


def observations_of(folder: MeasurementFolder, heliostat: str) -> tuple[list[Observation], dict[str, str]]:
    """What a heliostat's images show, and why others were refused, by identifier."""
    usable, refused = [], {}
    for measurement in folder.measurements(heliostat):
        try:
            usable.append(evidence_of(folder, measurement))
        except InvalidInputError as error:
            refused[measurement.identifier] = str(error)
    return as_observations(usable), refused


def predict_heliostat(
    folder: MeasurementFolder, heliostat: Heliostat, method: Method, images: int
) -> tuple[SurfacePrediction, dict[str, Any]]:
    """Predict one heliostat's surface; the second value is its entry in ``predictions.json``."""
    usable, refused = observations_of(folder, heliostat.name)
    if not usable:
        reason = f"every image was refused: {next(iter(refused.values()))}" if refused else "no image"
        raise InvalidInputError(reason)
    model, latitude_deg = (folder.optics, folder.effects), float(folder.plant.origin[0])
    kept, apart = agreeing(compute, heliostat, usable, *model, latitude_deg=latitude_deg)
    predicted = compute.predict(heliostat, choose(kept, images), method, *model, latitude_deg=latitude_deg)
    entry: dict[str, Any] = {
        "method": method,
        "weights": predicted.weights,
        "images": list(predicted.used),
        "tells": {name: round(share, 3) for name, share in zip(predicted.used, predicted.tells, strict=False)},
        "refused": refused | apart,
        "misfit": round(predicted.misfit, 4),
        "trusted": predicted.trusted,
        "strangeness": round(predicted.mahalanobis, 3),
        "suspicious": list(predicted.suspicious),
        "contradicting": list(predicted.contradicting),
        "doubts": list(predicted.doubts),
        "z_rms_mm": round(float(np.sqrt((predicted.z**2).mean()) * 1e3), 4),
        "z_std_mean_mm": round(float(predicted.z_std.mean() * 1e3), 4),
    }
    measured = folder.measured_surface(heliostat.name)
    if measured is not None:
        entry["against_measured"] = surface_errors(predicted.z, measured_heights(heliostat, measured))
    return predicted, entry


def surface_errors(z: Array, truth: Array) -> dict[str, float]:
    """Mean absolute errors [mm] of control heights: all, canting alone, waviness alone, and of the ideal surface."""
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
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Predict every heliostat's surface from up to ``images`` of its images; files as DESIGN.md, section 6."""
    require_images(method, images)
    report: dict[str, Any] = {"method": method, "heliostats": {}, "skipped": {}}
    try:
        for name, heliostat in folder.plant.heliostats.items():
            progress(name)
            try:
                predicted, entry = predict_heliostat(folder, heliostat, method, images)
            except ModelError as error:
                report["skipped"][name] = str(error)
                continue
            write_surface(out, name, predicted)
            report["heliostats"][name] = entry
    except KeyboardInterrupt:  # hours of work may lie behind it
        left = [name for name in folder.plant.heliostats if name not in report["heliostats"]]
        report["skipped"] = dict.fromkeys(left, "interrupted") | report["skipped"]
        _write_report(folder, report, out / "predictions.json")
        raise
    return finish(folder, report, out / "predictions.json", "heliostats")


def write_surface(out: Path, name: str, predicted: SurfacePrediction) -> None:
    """``OUT/H/Deflectometry/H-nurbs-surface.npz``, readable as a measured surface."""
    path = out / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        control_points=predicted.control_points,
        z=predicted.z,
        z_std=predicted.z_std,
        degrees=np.array([3, 3]),
    )


# --- surfaces ---------------------------------------------------------------------------------------------------------


def check_surfaces(surfaces: str) -> None:
    """Refuse a choice of surfaces that is none of those that verbs know."""
    if surfaces not in ("measured", "ideal") and not Path(surfaces).is_dir():
        raise InvalidInputError(f"--surfaces must be 'measured', 'ideal' or a folder of predictions, got {surfaces!r}")


def with_surfaces(
    folder: MeasurementFolder, surfaces: str, skipped: dict[str, str]
) -> Iterator[tuple[Heliostat, tuple[Array, int] | None]]:
    """Heliostats with the surfaces to trace, as `surface_of` has them; ``skipped`` tells why others are left out."""
    for name, heliostat in folder.plant.heliostats.items():
        try:
            surface = surface_of(folder, heliostat, surfaces)
        except ModelError as error:
            skipped[name] = str(error)
        else:
            yield heliostat, surface


def surface_of(folder: MeasurementFolder, heliostat: Heliostat, surfaces: str) -> tuple[Array, int] | None:
    """The surface to trace: None for the ideal one; refused where it is missing."""
    if surfaces == "ideal":
        return None
    if surfaces == "measured":
        root, found = folder.root, folder.measured_surface(heliostat.name)
    else:
        root, found = Path(surfaces), read_surface(Path(surfaces), heliostat)
    if found is None:
        raise InvalidInputError(f"no surface in {root / heliostat.name / 'Deflectometry'}")
    return found
