"""``heliotwin camera``: a camera's transfer function from a folder's photographs, and whether it is any better."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from model.errors import InvalidInputError, ModelError
from model.imaging import Camera, MeasuredFlux
from model.imaging.light import Measured, Srgb, Transfer
from model.imaging.measured_law import LitSheet, fit_law, lit_sheet
from model.plant import TargetPlane
from service.base.progress import Progress, quiet
from service.cli.folder import check_surfaces, finish, read_image, with_surfaces
from service.cli.folder_forecast import agreement, forecast_measurement
from service.sources.documents import Measurement
from service.sources.folder import MeasurementFolder
from service.twin import compute

Array = NDArray[np.float64]

FEWEST_DAYS = 4
"""Days with photographs from which on half of them can judge what the others have told."""

LEAST_GAIN = 0.001
"""Accuracy that a curve must gain for sure to be declared: less would not matter."""

# Effects that stand for a camera's law; with one of them in the forecast nothing would be left to measure.
_LAWS = {"camera_response", "camera_shoulder"}


@dataclass(frozen=True, eq=False)
class _Shot:
    """A photograph with its forecast, as sRGB measures it."""

    measurement: Measurement
    plane: TargetPlane
    measured: MeasuredFlux
    forecast: compute.Forecast

    @property
    def day(self) -> str:
        """That of unknown time stands for a day of its own."""
        taken_at = self.measurement.taken_at
        return self.measurement.key if taken_at is None else taken_at.date().isoformat()

    @property
    def told(self) -> LitSheet:
        assert self.measured.crop is not None
        return lit_sheet(self.measured.crop, self.measured.clipped, self.forecast.camera_view.astype(np.float64))

    def accuracy(self, law: Transfer, window: float) -> float:
        """NaN where the photograph is refused by this law."""
        assert self.measured.crop is not None
        measured = compute.measure(self.measured.crop, "cropped", self.plane, camera=Camera(law))
        if measured.flux is None:
            return float("nan")
        return agreement(measured, self.forecast, self.plane, window).accuracy


def measure_camera(
    folder: MeasurementFolder,
    out: Path,
    surfaces: str = "measured",
    targets: Collection[str] = (),
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Measure the law of the camera that took a folder's photographs of ``targets``, all if none; write it to ``out``.

    Each half of the days judges the curve that the other half gives; the one that is written is of all.

    Raises
    ------
    InvalidInputError
        Where a target is unknown, a law is already part of the model, or photographs of too few days are left.
    """
    check_surfaces(surfaces)
    if unknown := set(targets) - set(folder.plant.targets):
        raise InvalidInputError(f"--target must be one of {', '.join(folder.plant.targets)}, got {min(unknown)!r}")
    if laws := _LAWS & {effect.name for effect in folder.effects}:
        raise InvalidInputError(f"twin.json declares {min(laws)}, which stands for the camera's law; take it out first")
    shots, skipped = _shots(folder, surfaces, targets, progress)
    days = sorted({shot.day for shot in shots})
    if len(days) < FEWEST_DAYS:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list((folder.skipped | skipped).items())[:3])
        raise InvalidInputError(
            f"a camera's law takes photographs of {FEWEST_DAYS} days, half of which judge; {len(days)} are left"
            + (f" ({reasons})" if reasons else "")
        )
    half = {day: place % 2 for place, day in enumerate(days)}
    told = [shot.told for shot in shots]
    curve, *halves = (
        fit_law([one for shot, one in zip(shots, told, strict=True) if half[shot.day] != judging])
        for judging in (None, 0, 1)
    )
    report = {
        **_judged(shots, [halves[half[shot.day]] for shot in shots]),
        "curve": _table(curve),
        "from_srgb": _distance(curve, told),
        "skipped": skipped,
    }
    is_better = report["gain"]["ci95"][0] > LEAST_GAIN
    entry = {"transfer": report["curve"] if is_better else "srgb", **({"targets": list(targets)} if targets else {})}
    said = {"verdict": "measured" if is_better else "srgb", "conclusion": _conclusion(report, is_better)}
    return finish(folder, {**said, "declared": {"cameras": [entry]}, **report}, out, "per_image")


def _conclusion(report: dict[str, Any], is_better: bool) -> str:
    gain, (low, high) = report["gain"], report["gain"]["ci95"]
    judged = (
        f"on {report['photographs']} photographs of {report['days']} days that it was not measured from it changes the "
        f"accuracy of forecasts by {gain['mean']:+.4f} (95 % by days: {low:+.4f} to {high:+.4f}); it differs from sRGB "
        f"by up to {report['from_srgb']['light']:.3f} of the light"
    )
    if is_better:
        return f"The measured curve is better than sRGB: {judged}. Declare it."
    return f"sRGB is no worse than the measured curve, or not by as much as matters: {judged}. Keep sRGB."


def _shots(
    folder: MeasurementFolder, surfaces: str, targets: Collection[str], progress: Progress
) -> tuple[list[_Shot], dict[str, str]]:
    """Photographs with their forecasts, and what was left out."""
    shots, skipped = [], dict[str, str]()
    for heliostat, surface in with_surfaces(folder, surfaces, skipped):
        for measurement in folder.measurements(heliostat.name):
            if targets and measurement.target not in targets:
                continue
            progress(measurement.key)
            try:
                shots.append(_shot(folder, measurement, surface))
            except ModelError as error:
                skipped[measurement.key] = str(error)
    return shots, skipped


def _shot(folder: MeasurementFolder, measurement: Measurement, surface: tuple[Array, int] | None) -> _Shot:
    kind = next((kind for kind in ("cropped", "raw") if kind in measurement.images), None)
    if kind is None:
        raise InvalidInputError("no photograph: a background that was taken off in counts hides the camera's law")
    image, plane = read_image(measurement.images[kind]), folder.plant.targets[measurement.target]
    if image.dtype != np.uint8:
        raise InvalidInputError("16 bits, which are linear; a law is measured from photographs of 8 bits")
    measured = compute.measure(image, kind, plane)
    if measured.center_of_mass is None:
        raise InvalidInputError(f"{measured.quality.reason}: {measured.quality.detail}")
    placed = replace(measurement, spot=plane.to_enu(measured.center_of_mass))
    return _Shot(measurement, plane, measured, forecast_measurement(folder, placed, surface))


def _judged(shots: Sequence[_Shot], curves: Sequence[Measured]) -> dict[str, Any]:
    """Accuracies by sRGB and by curves that each photograph has told nothing of; the gain's interval is by days."""
    per_image, by_day = {}, dict[str, list[float]]()
    for shot, curve in zip(shots, curves, strict=True):
        window = agreement(shot.measured, shot.forecast, shot.plane).window
        plain, found = (shot.accuracy(law, window) for law in (Srgb(), curve))
        if np.isfinite([plain, found]).all():
            per_image[shot.measurement.key] = {"srgb": plain, "measured": found}
            by_day.setdefault(shot.day, []).append(found - plain)
    if len(by_day) < FEWEST_DAYS:
        raise ModelError(f"the curve refuses all photographs but those of {len(by_day)} days, which cannot judge it")
    sums, counts = np.array([[sum(gains), len(gains)] for gains in by_day.values()]).T
    drawn = bootstrap((sums, counts), _mean, paired=True, method="percentile", rng=0).confidence_interval
    return {
        "photographs": len(per_image),
        "days": len(by_day),
        "accuracy": {law: float(np.mean([one[law] for one in per_image.values()])) for law in ("srgb", "measured")},
        "gain": {"mean": float(sums.sum() / counts.sum()), "ci95": [float(drawn.low), float(drawn.high)]},
        "per_image": per_image,
    }


def _mean(sums: Array, counts: Array, axis: int = -1) -> Array:
    return np.asarray(sums.sum(axis=axis) / counts.sum(axis=axis))


def _table(curve: Measured) -> dict[str, list[float]]:
    """As `declared.cameras` takes it."""
    return {"counts": list(curve.shares), "light": [round(light, 6) for light in curve.lights]}


def _distance(curve: Measured, told: Sequence[LitSheet]) -> dict[str, Any]:
    """The largest difference of light from sRGB within the counts that the photographs show."""
    low, high = min(float(one.sheet.min()) for one in told), max(float(one.counts.max()) for one in told)
    counts = np.linspace(low, high, 100)
    return {"light": float(np.abs(curve.light(counts) - Srgb().light(counts)).max()), "counts": [low, high]}
