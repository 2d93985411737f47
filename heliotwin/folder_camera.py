"""``heliotwin camera``: measure a camera response curve and compare it with sRGB."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from heliotwin.folder import check_surfaces, finish, surfaces_of
from heliotwin.folder_forecast import agreement
from model.errors import InvalidInputError, ModelError
from model.imaging import Camera, MeasuredFlux
from model.imaging.light import Measured, Srgb, Transfer
from model.imaging.measured_law import LitSheet, fit_law, lit_sheet
from model.plant import Heliostat, TargetPlane
from model.setup import Setup
from service.base.choices import Selection
from service.base.errors import list_reasons
from service.base.progress import Progress, no_progress
from service.sources.decode import Pixels, decode_image
from service.sources.documents import Measurement
from service.sources.files import read_file
from service.sources.folder import MeasuredSurface, MeasurementFolder, points_of
from service.twin import operations

Array = NDArray[np.float64]

FEWEST_DAYS = 4
"""Least number of days with photographs: half of them test the curve of the other half."""

MIN_GAIN = 0.001
"""Accuracy that a curve must gain, by its confidence interval, before it is declared."""

# Effects that model a camera response curve. With one of them in the forecast, nothing is left to
# measure.
_LAWS = {"camera_response", "camera_shoulder"}


@dataclass(frozen=True, eq=False)
class _Photograph:
    """A photograph with its flux, measured by the sRGB curve, and its forecast."""

    measurement: Measurement
    plane: TargetPlane
    measured: MeasuredFlux
    forecast: operations.Forecast

    @property
    def day(self) -> str:
        """The photograph's date; a photograph without a time counts as a separate day."""
        taken_at = self.measurement.taken_at
        return self.measurement.key if taken_at is None else taken_at.date().isoformat()

    @property
    def lit_sheet(self) -> LitSheet:
        assert self.measured.crop is not None
        return lit_sheet(
            self.measured.crop, self.measured.clipped, self.forecast.camera_view.astype(np.float64)
        )

    def accuracy(self, law: Transfer, window: float) -> float:
        """Accuracy of the forecast with this curve; NaN if the photograph is rejected."""
        assert self.measured.crop is not None
        measured = operations.measure(self.measured.crop, "cropped", self.plane, camera=Camera(law))
        if measured.flux is None:
            return float("nan")
        return agreement(measured, self.forecast, self.plane, window).accuracy


def measure_camera(
    folder: MeasurementFolder,
    out: Path,
    surfaces: str = "measured",
    targets: Collection[str] = (),
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Measure the camera response curve from a folder's photographs; write it to ``out``.

    ``targets`` restricts the photographs to these targets; if it is empty, all are used. Each half
    of the days tests the curve from the other half. The written curve uses all days.

    Raises
    ------
    InvalidInputError
        If a target is unknown, the model already has a camera response, or photographs of too few
        days are left.
    """
    check_surfaces(surfaces)
    if unknown := set(targets) - set(folder.plant.targets):
        raise InvalidInputError(
            f"--target must be one of {', '.join(folder.plant.targets)}, got {min(unknown)!r}"
        )
    if laws := _LAWS & {effect.name for effect in folder.model.effects}:
        raise InvalidInputError(
            f"twin.json declares {min(laws)}, which replaces the camera response curve; remove it"
            " first"
        )
    photographs, skipped = _read_photographs(folder, surfaces, targets, progress)
    days = sorted({photo.day for photo in photographs})
    if len(days) < FEWEST_DAYS:
        reasons = list_reasons(folder.skipped | skipped)
        raise InvalidInputError(
            f"a camera response curve needs photographs of {FEWEST_DAYS} days;"
            f" {len(days)} are left" + (f" ({reasons})" if reasons else "")
        )
    half = {day: place % 2 for place, day in enumerate(days)}
    sheets = [photo.lit_sheet for photo in photographs]
    curve, *halves = (
        fit_law(
            [
                one
                for photo, one in zip(photographs, sheets, strict=True)
                if half[photo.day] != judging
            ]
        )
        for judging in (None, 0, 1)
    )
    report = {
        **_judged(photographs, [halves[half[photo.day]] for photo in photographs]),
        "curve": _table(curve),
        "from_srgb": _distance(curve, sheets),
        "skipped": skipped,
    }
    is_better = report["gain"]["ci95"][0] > MIN_GAIN
    entry = {
        "transfer": report["curve"] if is_better else "srgb",
        **({"targets": list(targets)} if targets else {}),
    }
    said = {
        "verdict": "measured" if is_better else "srgb",
        "conclusion": _conclusion(report, is_better),
    }
    return finish(folder, {**said, "declared": {"cameras": [entry]}, **report}, out, "per_image")


def _conclusion(report: dict[str, Any], is_better: bool) -> str:
    gain, (low, high) = report["gain"], report["gain"]["ci95"]
    judged = (
        f"on {report['photographs']} photographs of {report['days']} days that it was not measured"
        f" from it changes the accuracy of forecasts by {gain['mean']:+.4f} (95 % by days:"
        f" {low:+.4f} to {high:+.4f}); it differs from sRGB by up to"
        f" {report['from_srgb']['light']:.3f} of the light"
    )
    if is_better:
        return f"The measured curve is better than sRGB: {judged}. Declare it."
    return (
        f"sRGB is no worse than the measured curve, or not by as much as matters: {judged}. Keep"
        " sRGB."
    )


def _read_photographs(
    folder: MeasurementFolder, surfaces: str, targets: Collection[str], progress: Progress
) -> Selection[_Photograph]:
    """Photographs with their forecasts, and skipped items with reasons."""
    photographs, skipped = [], dict[str, str]()
    for heliostat, surface in surfaces_of(folder, surfaces, skipped):
        for measurement in folder.measurements(heliostat.name):
            if targets and measurement.target not in targets:
                continue
            progress(measurement.key)
            try:
                photographs.append(_read_photograph(folder, heliostat, measurement, surface))
            except ModelError as error:
                skipped[measurement.key] = str(error)
    return Selection(photographs, skipped)


def read_image(path: Path) -> Pixels:
    """Decode an image file; errors name the file."""
    try:
        return decode_image(read_file(path))
    except InvalidInputError as error:
        raise InvalidInputError(f"{path}: {error}") from None


def _read_photograph(
    folder: MeasurementFolder,
    heliostat: Heliostat,
    measurement: Measurement,
    surface: MeasuredSurface | None,
) -> _Photograph:
    kind = next((kind for kind in ("cropped", "raw") if kind in measurement.images), None)
    if kind is None:
        raise InvalidInputError(
            "no photograph: a background that was subtracted in counts hides the camera's curve"
        )
    image, plane = read_image(measurement.images[kind]), folder.plant.targets[measurement.target]
    if image.dtype != np.uint8:
        raise InvalidInputError(
            "16 bits, which are linear; a curve is measured from photographs of 8 bits"
        )
    measured = operations.measure(image, kind, plane)
    if measured.center_of_mass is None:
        raise InvalidInputError(f"{measured.quality.reason}: {measured.quality.detail}")
    points, degree = points_of(heliostat, surface)
    spot = plane.to_enu(measured.center_of_mass)
    taken_at = measurement.taken_at
    setup = Setup(
        heliostat, points, measurement.to_sun, plane, spot, degree=degree, taken_at=taken_at
    )
    return _Photograph(measurement, plane, measured, operations.forecast(setup, folder.model))


def _judged(photographs: Sequence[_Photograph], curves: Sequence[Measured]) -> dict[str, Any]:
    """Accuracies by sRGB and by curves that were fitted without the photograph.

    The confidence interval of the gain is a bootstrap over days.
    """
    per_image, by_day = {}, dict[str, list[float]]()
    for photo, curve in zip(photographs, curves, strict=True):
        window = agreement(photo.measured, photo.forecast, photo.plane).window
        plain, found = (photo.accuracy(law, window) for law in (Srgb(), curve))
        if np.isfinite([plain, found]).all():
            per_image[photo.measurement.key] = {"srgb": plain, "measured": found}
            by_day.setdefault(photo.day, []).append(found - plain)
    if len(by_day) < FEWEST_DAYS:
        raise ModelError(
            f"the curve refuses all photographs but those of {len(by_day)} days, which cannot"
            " judge it"
        )
    sums, counts = np.array([[sum(gains), len(gains)] for gains in by_day.values()]).T
    drawn = bootstrap(
        (sums, counts), _mean, paired=True, method="percentile", rng=0
    ).confidence_interval
    return {
        "photographs": len(per_image),
        "days": len(by_day),
        "accuracy": {
            law: float(np.mean([one[law] for one in per_image.values()]))
            for law in ("srgb", "measured")
        },
        "gain": {
            "mean": float(sums.sum() / counts.sum()),
            "ci95": [float(drawn.low), float(drawn.high)],
        },
        "per_image": per_image,
    }


def _mean(sums: Array, counts: Array, axis: int = -1) -> Array:
    return np.asarray(sums.sum(axis=axis) / counts.sum(axis=axis))


def _table(curve: Measured) -> dict[str, list[float]]:
    """The curve as a `transfer` of ``declared.cameras``."""
    return {"counts": list(curve.shares), "light": [round(light, 6) for light in curve.lights]}


def _distance(curve: Measured, sheets: Sequence[LitSheet]) -> dict[str, Any]:
    """Largest difference of linear intensity from sRGB, within the photographs' range of counts."""
    low, high = (
        min(float(one.sheet.min()) for one in sheets),
        max(float(one.counts.max()) for one in sheets),
    )
    counts = np.linspace(low, high, 100)
    return {
        "light": float(np.abs(curve.light(counts) - Srgb().light(counts)).max()),
        "counts": [low, high],
    }
