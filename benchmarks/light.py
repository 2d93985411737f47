"""Photographs of two years as counts and as linear intensity.

Run ``python -m benchmarks.light [--out DIR]``.

Every crop of AA39 in ``../shared/stj-years`` is measured twice: its counts are used as they are and
converted to linear intensity (sRGB). Both are compared with the forecast by the measured surface,
without a fitted number: Buie's sun with 0.02, a window of 4 m. For each photograph it also reports
the best circumsolar ratio, which is fitted to that photograph. Prints means and medians. Plots the
accuracy by date, the brightness against the forecast, and the photographs themselves. A further
plot shows the compression of each photograph's counts against the spot's brightness over daylight.

Lens and sky are estimated from some photographs and judged on others: the blur of each target's
camera by the other half of the days, the circumsolar ratio by the others of the same day.

For photographs under low suns it tests whether neighbours shaded the mirror. All heliostats within
40 m (``field-positions.json``) are assumed to be like this one and to aim at the receiver. Their
true aim points were not recorded.

``--consensus`` instead reports which photographs contradict the others, without a measured surface,
and what surfaces gain without them. ``--differences`` compares the differences of counts that PAINT
publishes (``../shared/stj``) through the camera response curve. Ambient light and exposure of each
come from all others, and from itself. ``--ceiling`` fits sky, lens, response curve, ambient light
and position to each photograph itself: the upper bound of the accuracy with this surface.
"""

import argparse
import json
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

from benchmarks import data_folder
from benchmarks.folders import read_observations
from benchmarks.record import Estimate, log_row, recording
from benchmarks.years import interval
from heliotwin.folder import surface_errors
from model.forecast import View, align
from model.images import FLUX_SIZE, FLUX_WINDOW, clipped_alike, normalized
from model.imaging import Camera, MeasuredFlux, center_of_mass, flux_window, measure
from model.imaging.light import LINEAR
from model.imaging.window import share_window
from model.metrics import compare_on_target, flux_accuracy
from model.neighbours import Neighbours, Outlines, outlines
from model.network.architecture import MAX_IMAGES
from model.observation import misfits
from model.plant import TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.sunshape import Buie
from model.tracing import Optics, Scene, Window, trace
from model.tracing.alignment import align_to_spots
from model.tracing.convolution import central_rays
from service.base.choices import Method
from service.sources.decode import decode_image
from service.sources.documents import Measurement
from service.sources.folder import MeasurementFolder, measured_heights, read_folder
from service.twin import operations
from service.twin.measurements import choose_diverse
from service.twin.surfaces.present_shape import reject_outliers

Array = NDArray[np.float64]

RATIOS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4)
BLURS = (0.0, 0.03, 0.06, 0.09, 0.12)
AMBIENTS = (0.40, 0.44, 0.48, 0.53, 0.58, 0.62, 0.66)
PEAKS = (0.7, 0.8, 0.9, 1.0)
CAMERAS = {"counts": Camera(LINEAR), "light": Camera()}
LEFT_BY_SRGB = {0.55: "-", 0.70: "--"}
"""Compression by sRGB over ln(total / ambient light): by its slopes at both, and as it fits a
Gaussian spot best.
"""
VIEW = View(256, 256, samples=24, padding=0.5, cones="facet")


@dataclass(frozen=True, eq=False)
class Case:
    """A photograph: what was measured by each camera's law, and forecasts (256, 256) by circumsolar
    ratio.
    """

    name: str
    plane: TargetPlane
    taken_at: datetime | None
    measured: dict[str, MeasuredFlux]
    forecasts: dict[float, Array]

    @property
    def target(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.plane.width, self.plane.height

    @property
    def day(self) -> str:
        """Of unknown times: the name, for nothing is known of the same day."""
        return self.name if self.taken_at is None else self.taken_at.date().isoformat()

    def shown(self, law: str, ratio: float, blur_m: float = 0.0) -> Array:
        """The forecast, blurred by a lens, as far as the camera's range shows it."""
        forecast, taken = self.forecasts[ratio], self.measured[law]
        if blur_m > 0:
            sigmas = (
                blur_m * pixels / side
                for pixels, side in zip(forecast.shape[::-1], self.target, strict=True)
            )
            forecast = np.asarray(cv2.GaussianBlur(forecast, (0, 0), *sigmas), dtype=np.float64)
        if taken.clipped is None or taken.flux is None:
            return forecast
        return clipped_alike(forecast, taken.flux.astype(float), taken.clipped.astype(float))

    def accuracy(self, law: str, ratio: float, blur_m: float = 0.0) -> float:
        """NaN where the photograph is refused."""
        flux = self.measured[law].flux
        if flux is None:
            return float("nan")
        return compare_on_target(flux, self.shown(law, ratio, blur_m), self.target).accuracy

    def best(self, law: str) -> float:
        """Circumsolar ratio that suits it best."""
        return max(RATIOS, key=lambda ratio: self.accuracy(law, ratio))


def read_cases(folder: MeasurementFolder, heliostat: str) -> list[Case]:
    """Every crop of a heliostat, measured and forecast."""
    surface = folder.measured_surface(heliostat)
    assert surface is not None
    return [
        _case(folder, one, surface.points, surface.degree)
        for one in folder.measurements(heliostat)
        if "cropped" in one.images
    ]


def _case(folder: MeasurementFolder, one: Measurement, points: Array, degree: int) -> Case:
    plane = folder.plant.targets[one.target]
    forecasts = _forecasts(folder, one, points, degree)
    image = decode_image(one.images["cropped"].read_bytes())
    measured = {
        law: measure(image, "cropped", plane, camera=camera) for law, camera in CAMERAS.items()
    }
    return Case(one.external_id, plane, one.taken_at, measured, forecasts)


def _forecasts(
    folder: MeasurementFolder,
    one: Measurement,
    points: Array,
    degree: int,
    ratios: tuple[float, ...] = RATIOS,
) -> dict[float, Array]:
    """Light (256, 256) over the whole target by circumsolar ratio."""
    mirror, plane = folder.plant.heliostats[one.heliostat], folder.plant.targets[one.target]
    setup = Setup(mirror, points, one.to_sun, plane, spot=one.spot, degree=degree)
    with torch.no_grad():
        aligned = align([setup], PlantModel(folder.model.site), dtype=torch.float64)
        traced = {
            ratio: replace(aligned, model=PlantModel(folder.model.site, Optics(Buie(ratio))))
            for ratio in ratios
        }
        return {ratio: one.flux(VIEW)[0].clamp(min=0).numpy() for ratio, one in traced.items()}


def table(cases: list[Case]) -> None:
    """Accuracies of all photographs by law; a refused one counts in the share that is used."""
    print(
        "| taken as | used | mean | median | below 0.85 | by the best ratio of each: mean |"
        " median |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for law in CAMERAS:
        plain = np.array([case.accuracy(law, 0.02) for case in cases])
        best = np.array([case.accuracy(law, case.best(law)) for case in cases])
        used = np.isfinite(plain)
        figures = [f"{value:.3f}" for value in (plain[used].mean(), np.median(plain[used]))]
        figures += [
            str(int((plain < 0.85).sum())),
            f"{best[used].mean():.3f}",
            f"{np.median(best[used]):.3f}",
        ]
        print(f"| {law} | {used.sum()} of {len(cases)} | {' | '.join(figures)} |")
        is_light = law == "light"
        days = [case.day for case, is_used in zip(cases, used, strict=True) if is_used]
        log_row(
            "All photographs, nothing fitted",
            f"taken as {law}",
            {
                "used [%]": Estimate(100 * used.mean(), goal=">= 80" if is_light else None),
                "accuracy, mean": Estimate(
                    plain[used].mean(),
                    interval(plain[used], days, rounds=1000),
                    goal=">= 0.92" if is_light else None,
                ),
                "median": Estimate(np.median(plain[used]), goal=">= 0.935" if is_light else None),
                "below 0.85": int((plain < 0.85).sum()),
                "mean by the best circumsolar ratio of each": best[used].mean(),
                "median by the best ratio": np.median(best[used]),
            },
            n=int(used.sum()),
            of="photographs",
            compared_with="forecasts by the measured surface, intervals over days",
        )
    reasons = {case.name: case.measured["light"].quality.reason for case in cases}
    print(f"refused: { {name: reason for name, reason in reasons.items() if reason} }")
    low = {
        case.name: round(case.accuracy("light", 0.02), 3)
        for case in cases
        if case.accuracy("light", 0.02) < 0.85
    }
    print(f"below 0.85 in light: {low}")


def left_out(cases: list[Case], apart: Collection[str]) -> None:
    """Print accuracies in linear intensity, with lens and sky from other photographs.

    Intervals are by days. Then print the same without the photographs ``apart``, which contradict
    the others. They were found without a measured surface.
    """
    used = [case for case in cases if case.measured["light"].flux is not None]
    known = {
        (case.name, ratio, blur): case.accuracy("light", ratio, blur)
        for case in used
        for ratio in RATIOS
        for blur in BLURS
    }
    days = sorted({case.day for case in used})
    half = {day: index % 2 for index, day in enumerate(days)}

    def lens(case: Case) -> float:
        others = [
            o for o in used if o.plane.name == case.plane.name and half[o.day] != half[case.day]
        ]
        return max(BLURS, key=lambda blur: np.median([known[o.name, 0.02, blur] for o in others]))

    def sky(case: Case, blur: float) -> float:
        others = [o for o in used if o.day == case.day and o is not case]
        return (
            max(RATIOS, key=lambda ratio: np.mean([known[o.name, ratio, blur] for o in others]))
            if others
            else 0.02
        )

    lenses = {case.name: lens(case) for case in used}
    rows = {
        "nothing": {case.name: known[case.name, 0.02, 0.0] for case in used},
        "the camera's blur, by the other half of the days": {
            case.name: known[case.name, 0.02, lenses[case.name]] for case in used
        },
        "and the sky, by the day's other photographs": {
            case.name: known[case.name, sky(case, lenses[case.name]), lenses[case.name]]
            for case in used
        },
    }
    print(
        "| known from photographs that are not judged | mean (95 % by days) | median | by target |"
    )
    print("| --- | --- | --- | --- |")
    for label, found in rows.items():
        _print_row(f"{label}; all", used, found)
    agreed = [case for case in used if case.name not in apart]
    for label, found in rows.items():
        _print_row(f"{label}; the {len(agreed)} that agree", agreed, found)
    print(f"blur by target [m]: { {case.plane.name: lenses[case.name] for case in used} }")


def _print_row(label: str, cases: list[Case], found: dict[str, float]) -> None:
    """Mean and median of photographs, and of those on each target."""
    low, high = interval(
        np.array([found[case.name] for case in cases]), [case.day for case in cases], rounds=1000
    )
    by_target: dict[str, list[float]] = {}
    for case in sorted(cases, key=lambda case: case.plane.name):
        by_target.setdefault(case.plane.name, []).append(found[case.name])
    values = [found[case.name] for case in cases]
    targets = ", ".join(
        f"{name} {np.mean(some):.3f}/{np.median(some):.3f}" for name, some in by_target.items()
    )
    print(
        f"| {label} | {np.mean(values):.3f} ({low:.3f} to {high:.3f}) | {np.median(values):.3f} |"
        f" {targets} |"
    )
    log_row(
        "Accuracy in linear intensity, by what is known or fitted",
        label,
        {"mean": Estimate(np.mean(values), (low, high)), "median": np.median(values)},
        n=len(values),
        of="photographs",
        compared_with="forecasts by the measured surface, intervals over days",
    )


def consensus(folder: MeasurementFolder, heliostat: str) -> None:
    """Which photographs contradict the others, and the surfaces from all and from the others."""
    surface = folder.measured_surface(heliostat)
    assert surface is not None
    mirror, truth = (
        folder.plant.heliostats[heliostat],
        measured_heights(folder.plant.heliostats[heliostat], surface),
    )
    usable = read_observations(folder, heliostat)
    kept, apart = reject_outliers(operations, mirror, usable, folder.model)
    against = dict(
        zip(
            (o.identifier for o in usable),
            misfits(mirror, usable, truth, folder.model),
            strict=True,
        )
    )
    print(
        "| contradicts the others | accuracy of the forecast by the measured surface's 8 x 8"
        " heights |"
    )
    print("| --- | --- |")
    for name in apart:
        print(f"| {name} | {1 - against[name]:.3f} |")
        accuracy = {"accuracy by the measured surface": 1 - against[name]}
        log_row("Photographs that contradict the others", name, accuracy)
    worst = sorted(against, key=lambda name: -against[name])[: len(apart)]
    print(
        f"of the {len(apart)} that the measured surface forecasts worst,"
        f" {len(set(worst) & set(apart))} are among them"
    )
    shared = {"also found without a surface": len(set(worst) & set(apart))}
    log_row("Worst by the measured surface", "photographs", shared, n=len(apart), of="photographs")
    print("| surface | from all [mm] | from those that agree [mm] |")
    print("| --- | --- | --- |")
    methods: tuple[Method, ...] = ("network", "refined")
    for method in methods:
        errors: list[float] = []
        for pool in (usable, kept):
            found = operations.predict(
                mirror, choose_diverse(pool, MAX_IMAGES), folder.model, method
            )
            errors.append(surface_errors(found.z, truth)["mae_mm"])
        print(f"| {method} | {' | '.join(f'{error:.3f}' for error in errors)} |")
        log_row(
            f"Surfaces of {heliostat} from {MAX_IMAGES} photographs, chosen by their suns",
            method,
            {"from all [mm]": errors[0], "from consistent ones [mm]": errors[1]},
            compared_with="deflectometry",
        )


def differences() -> None:
    """PAINT's differences of counts, through the law: as light, by a usual ambient, by all others',
    by their own.
    """
    rows: dict[str, dict[tuple[float, float], float]] = {}
    plain: dict[str, float] = {}
    folder = read_folder(data_folder(), ["AA39", "AC43"])
    exposures = [(ambient, peak) for ambient in AMBIENTS for peak in PEAKS if peak > ambient]
    for heliostat in folder.plant.heliostats:
        surface = folder.measured_surface(heliostat)
        assert surface is not None
        for one in (m for m in folder.measurements(heliostat) if "flux" in m.images):
            plane, image = (
                folder.plant.targets[one.target],
                decode_image(one.images["flux"].read_bytes()),
            )
            cameras = {
                exposure: Camera(ambient=exposure[0], peak_counts=exposure[1])
                for exposure in exposures
            }
            taken = {
                str(e): measure(image, "flux", plane, camera=camera)
                for e, camera in cameras.items()
            }
            taken["counts"] = measure(image, "flux", plane)
            forecast = {
                0.02: _forecasts(folder, one, surface.points, surface.degree, ratios=(0.02,))[0.02]
            }
            case = Case(one.external_id, plane, one.taken_at, taken, forecast)
            rows[one.key] = {exposure: case.accuracy(str(exposure), 0.02) for exposure in exposures}
            plain[one.key] = case.accuracy("counts", 0.02)
    stretched = [exposure for exposure in exposures if exposure[1] == 1]

    def by_others(name: str, among: list[tuple[float, float]]) -> tuple[float, float]:
        return max(
            among, key=lambda e: np.mean([row[e] for key, row in rows.items() if key != name])
        )

    print(
        "| photograph | counts | ambient 0.53 | ambient by the others | and peak by the others |"
        " its own ambient | its own ambient and peak |\n| --- | --- | --- | --- | --- | --- | --- |"
    )
    table = []
    for name, row in rows.items():
        own, both = (max(among, key=lambda e: row[e]) for among in (stretched, exposures))
        others = [row[by_others(name, among)] for among in (stretched, exposures)]
        table.append((plain[name], row[0.53, 1.0], *others, row[own], row[both]))
        figures = " | ".join(f"{value:.3f}" for value in table[-1][:-1])
        print(
            f"| {name} | {figures} ({own[0]:.2f}) | {row[both]:.3f} ({both[0]:.2f},"
            f" {both[1]:.2f}) |"
        )
    means = np.mean(table, axis=0)
    print(f"| mean | {' | '.join(f'{value:.3f}' for value in means)} |")
    for label, value in zip(WAYS, means, strict=True):
        log_row(
            "PAINT's differences of counts through the camera response curve",
            label,
            {"accuracy, mean": Estimate(value, goal=">= 0.92")},
            n=len(table),
            of="photographs",
            compared_with="forecasts by the measured surface",
        )


WAYS = (
    "as counts",
    "ambient light 0.53",
    "ambient light by the other photographs",
    "ambient light and exposure by the other photographs",
    "ambient light of each (fitted)",
    "ambient light and exposure of each (fitted)",
)
"""How `differences` converts counts."""

FITTED = {
    "blur [m]": (0.0, 0.2),
    "exponent of the law, less one": (-0.3, 0.4),
    "ambient light [of the peak]": (-0.05, 0.05),
    "shift to the right [m]": (-0.1, 0.1),
    "shift down [m]": (-0.1, 0.1),
    "turn [rad]": (-0.05, 0.05),
    "scale, less one": (-0.05, 0.05),
}
"""What `ceiling` fits to each photograph beside the circumsolar ratio, and within which bounds."""


def ceiling(cases: list[Case], apart: Collection[str]) -> None:
    """Accuracies in light after all that is a photograph's own was fitted to it, a part after the
    other.
    """
    used = [case for case in cases if case.measured["light"].flux is not None]
    stages = {
        "the ratio and blur": 1,
        "and the law's exponent and ambient light": 3,
        "and shift, turn and scale": 7,
    }
    found = {case.name: _best_of_all(case, list(stages.values())) for case in used}
    agreed = [case for case in used if case.name not in apart]
    print("| fitted to each photograph itself | mean (95 % by days) | median | by target |")
    print("| --- | --- | --- | --- |")
    for index, label in enumerate(stages):
        row = {name: values[index] for name, values in found.items()}
        _print_row(f"{label}; all", used, row)
        _print_row(f"{label}; the {len(agreed)} that agree", agreed, row)


def _best_of_all(case: Case, counts: list[int]) -> list[float]:
    """Accuracy with the first so many of `FITTED`, those fitted before being a start, at the ratio
    that suits best.
    """
    taken = case.measured["light"]
    assert taken.flux is not None
    center = center_of_mass(taken.flux, case.target)
    seen = flux_window(taken.flux, case.target, center).astype(np.float64)
    clipped = (
        np.zeros(seen.shape)
        if taken.clipped is None
        else share_window(taken.clipped, case.target, center).astype(float)
    )
    forecast = case.forecasts[case.best("light")]
    cut = flux_window(forecast, case.target, center_of_mass(forecast, case.target)).astype(
        np.float64
    )
    cut = cut / cut.max()

    def accuracy(values: Array) -> float:
        blur, exponent, ambient, right, down, turn, scale = np.pad(
            values, (0, len(FITTED) - len(values))
        )
        image = (
            cv2.GaussianBlur(cut, (0, 0), blur * FLUX_SIZE / FLUX_WINDOW) if blur > 1e-3 else cut
        )
        middle = (FLUX_SIZE - 1) / 2
        moved = np.asarray(
            cv2.getRotationMatrix2D((middle, middle), float(np.degrees(turn)), 1 + scale), float
        )
        moved[:, 2] += np.array([right, down]) * FLUX_SIZE / FLUX_WINDOW
        image = cv2.warpAffine(image, moved, cut.shape, borderMode=cv2.BORDER_REPLICATE)
        image = (image.clip(0) ** (1 + exponent) + ambient).clip(0)
        return flux_accuracy(seen, clipped_alike(image, seen, clipped))

    best, values = [], np.zeros(0)
    for count in counts:
        start = np.concatenate([values, np.zeros(count - len(values))])
        fit = minimize(
            lambda v: -accuracy(v),
            start,
            method="Powell",
            bounds=list(FITTED.values())[:count],
            options={"maxfev": 60 * count, "xtol": 1e-2, "ftol": 1e-4},
        )
        values = fit.x if -fit.fun > accuracy(start) else start
        best.append(accuracy(values))
    return best


def shadows(folder: MeasurementFolder, heliostat: str, cases: list[Case]) -> None:
    """Accuracies of the photographs whose mirror neighbours would shade or block, without them and
    with them.
    """
    surface = folder.measured_surface(heliostat)
    assert surface is not None
    points, degree, mirror = surface.points, surface.degree, folder.plant.heliostats[heliostat]
    positions = json.loads((data_folder() / "field-positions.json").read_text())
    places = {name: np.array(entry["position_enu"]) for name, entry in positions.items()}
    near = [
        replace(mirror, name=n, position=p)
        for n, p in places.items()
        if _is_near(p - mirror.position)
    ]
    aims = np.tile(next(iter(folder.plant.receivers.values())).center, (len(near) + 1, 1))
    gained: dict[str, float] = {}
    print(
        "| photograph | sun's elevation [deg] | light that neighbours leave | accuracy without them"
        " | with them |"
    )
    print("| --- | --- | --- | --- | --- |")
    for case, one in zip(
        cases, (m for m in folder.measurements(heliostat) if "cropped" in m.images), strict=True
    ):
        standing = outlines([mirror, *near], one.to_sun, aims)
        field = Neighbours.from_outlines(
            [Outlines([m.name for m in (mirror, *near)], standing, aims)], one.to_sun
        )
        obstacles = torch.as_tensor(field.obstacles([heliostat]))
        plane = folder.plant.targets[one.target]
        setup = Setup(mirror, points, one.to_sun, plane, one.spot, degree=degree)
        free, shaded = (
            align_to_spots([setup], alter=alter).scene for alter in (None, _before(obstacles))
        )
        shaded = _before(obstacles)(shaded)
        left = float(
            central_rays(_before(obstacles)(free), 24).power.sum()
            / central_rays(free, 24).power.sum()
        )
        if left > 0.99 or case.measured["light"].flux is None:
            continue
        image = (
            trace(shaded, Window.of(plane), Optics(), samples=48).irradiance[0].clamp(min=0).numpy()
        )
        with_them = replace(case, forecasts={0.02: image}).accuracy("light", 0.02)
        figures = (
            f"{one.sun.elevation_deg:.0f} | {left:.2f} | {case.accuracy('light', 0.02):.3f} |"
            f" {with_them:.3f}"
        )
        print(f"| {one.external_id} | {figures} |")
        log_row(
            "Photographs that neighbours may shade",
            one.external_id,
            {
                "sun's elevation [degrees]": one.sun.elevation_deg,
                "light left [%]": 100 * left,
                "accuracy without neighbours": case.accuracy("light", 0.02),
                "accuracy with them": with_them,
            },
        )
        gained[case.name] = max(0.0, with_them - case.accuracy("light", 0.02))
    plain = np.array(
        [case.accuracy("light", 0.02) for case in cases if case.measured["light"].flux is not None]
    )
    mean = plain.mean() + sum(gained.values()) / len(plain)
    print(
        f"mean of all {plain.mean():.3f}; {mean:.3f} if each states whether its neighbours"
        " had this pose"
    )


def _is_near(apart: Array) -> bool:
    return 0.5 < float(np.linalg.norm(apart)) < 40


def _before(obstacles: torch.Tensor) -> Callable[[Scene], Scene]:
    """Puts rectangles before a scene's mirrors."""
    return lambda scene: scene.with_(obstacles=obstacles.to(scene.sun))


def compressions(cases: list[Case]) -> Array:
    """Of each photograph (N, 2) with hardly a place cut off: ln(total / ambient light), and its
    counts' compression.

    The shoulder of `model.effects.camera_shoulder` that suits the counts best, were they
    differences of light.
    """

    def shouldered(image: Array, compression: float) -> Array:
        return -np.expm1(-compression * image / image.max())

    def best(case: Case, flux: Array) -> float:
        def missed(compression: float) -> float:
            return -compare_on_target(
                flux, shouldered(case.forecasts[0.02], compression), case.target
            ).accuracy

        return float(
            minimize_scalar(missed, bounds=(1e-3, 5), method="bounded", options={"xatol": 0.01}).x
        )

    taken = [(case, case.measured["counts"].flux, case.measured["light"].quality) for case in cases]
    return np.array(
        [
            (np.log1p(quality.signal_to_background), best(case, flux.astype(float)))
            for case, flux, quality in taken
            if flux is not None and quality.accepted and quality.saturated_share < 0.02
        ]
    )


def draw(cases: list[Case], path: Path) -> None:
    """Accuracy by date under both laws, one photograph against its forecast pixel by pixel,
    compression by ambient.
    """
    figure, (left, right, last) = plt.subplots(1, 3, figsize=(18, 5), layout="constrained")
    dated = [case for case in cases if case.taken_at is not None]
    shown = max(dated, key=lambda case: case.accuracy("light", 0.02))
    forecast = shown.forecasts[0.02] / shown.forecasts[0.02].sum()
    for law, colour in (("counts", "tab:red"), ("light", "tab:blue")):
        left.plot(
            [c.taken_at for c in dated],
            [c.accuracy(law, 0.02) for c in dated],
            ".",
            color=colour,
            label=law,
        )
        flux = shown.measured[law].flux
        assert flux is not None
        x, y = (image[::3, ::3].ravel() / forecast.max() for image in (forecast, flux / flux.sum()))
        right.plot(x, y, ".", markersize=1.5, color=colour, label=law)
    left.set(
        ylabel="accuracy of the forecast",
        ylim=(0.5, 1),
        title="AA39, measured surface, nothing fitted",
    )
    left.tick_params(axis="x", rotation=30)
    left.legend(loc="lower left")
    right.plot([0, 1], [0, 1], color="gray", linewidth=0.8)
    right.set(
        xlabel="forecast, of its peak",
        ylabel="photograph, the same",
        title=f"{shown.name}, pixel by pixel",
    )
    contrast, found = compressions(cases).T
    reach = np.array([0, contrast.max()])
    last.plot(contrast, found, ".", label=f"{len(found)} photographs")
    for slope, style in LEFT_BY_SRGB.items():
        last.plot(
            reach,
            slope * reach,
            style,
            color="gray",
            linewidth=0.8,
            label=f"{slope:.2f} ln(total / ambient)",
        )
    last.set(
        xlabel="ln(total / ambient light)",
        ylabel="compression of the counts",
        title="a lit sheet's shoulder",
    )
    last.legend(loc="upper left")
    by_srgb = ", ".join(
        f"{slope * contrast.mean():.2f} by {slope:.2f} ln" for slope in LEFT_BY_SRGB
    )
    print(
        f"compression of {len(found)} photographs: {found.mean():.2f} (expected of sRGB:"
        f" {by_srgb}); correlation with ln(total / ambient)"
        f" {np.corrcoef(contrast, found)[0, 1]:.2f}"
    )
    cells = {"mean": found.mean()}
    cells |= {"correlation with ln(total / ambient)": np.corrcoef(contrast, found)[0, 1]}
    log_row("Compression of the counts", "AA39", cells, n=len(found), of="photographs")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(f"drawn: {path}")


def draw_pictures(cases: list[Case], path: Path) -> None:
    """Light, forecast and difference of the worst photographs and of a usual one of each target."""
    used = sorted(
        (c for c in cases if c.measured["light"].flux is not None),
        key=lambda c: c.accuracy("light", 0.02),
    )
    names = sorted({case.plane.name for case in used})
    of_target = [[case for case in used if case.plane.name == name] for name in names]
    shown = used[:10] + [some[len(some) // 2] for some in of_target]
    figure, axes = plt.subplots(
        3, len(shown), figsize=(1.6 * len(shown), 5.4), layout="constrained"
    )
    for column, case in zip(axes.T, shown, strict=True):
        flux = case.measured["light"].flux
        assert flux is not None
        images = (flux.astype(float), case.shown("light", 0.02))
        seen, forecast = (
            normalized(flux_window(i, case.target, center_of_mass(i, case.target))) for i in images
        )
        peak = seen.max()
        for axis, image in zip(column, (seen, forecast), strict=False):
            axis.imshow(image, vmin=0, vmax=peak)
        column[2].imshow(forecast - seen, vmin=-0.3 * peak, vmax=0.3 * peak, cmap="RdBu_r")
        column[0].set_title(f"{case.name}\n{case.accuracy('light', 0.02):.3f}", fontsize=9)
    for axis in axes.flat:
        axis.axis("off")
    figure.savefig(path, dpi=90)
    print(f"drawn: {path}")


def main(arguments: list[str]) -> None:
    """Print the table and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/light"))
    parser.add_argument(
        "--consensus", action="store_true", help="photographs that contradict the others"
    )
    parser.add_argument(
        "--ceiling", action="store_true", help="all that is a photograph's own fitted to it"
    )
    parser.add_argument(
        "--differences", action="store_true", help="PAINT's differences of counts, through the law"
    )
    options = parser.parse_args(arguments)
    root = data_folder().parent / "stj-years"
    if not root.is_dir():
        parser.error(f"no photographs at {root}; set HELIOTWIN_STJ to its neighbour stj")
    folder = read_folder(root)
    if options.differences:
        with recording("light-differences"):
            differences()
    if options.consensus:
        with recording("light-consensus"):
            consensus(folder, "AA39")
    if options.differences or options.consensus:
        return
    cases = read_cases(folder, "AA39")
    mirror, usable = folder.plant.heliostats["AA39"], read_observations(folder, "AA39")
    _, apart = reject_outliers(operations, mirror, usable, folder.model)
    if options.ceiling:
        with recording("light-ceiling"):
            ceiling(cases, apart)
        return
    with recording("light"):
        table(cases)
        left_out(cases, apart)
        shadows(folder, "AA39", cases)
        draw(cases, options.out / "light.png")
    draw_pictures(cases, options.out / "light-pictures.png")


if __name__ == "__main__":
    main(sys.argv[1:])
