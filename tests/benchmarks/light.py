"""Photographs of two years as counts and as light: ``python -m tests.benchmarks.light [--out DIR]``.

Every crop of AA39 in ``../shared/stj-years`` is measured twice, its values taken for light (linear) and turned into
light (sRGB), and held against the forecast by the measured surface, without any fitted number: Buie's sun with 0.02, a
window of 4 m. Of each photograph it also tells which circumsolar ratio suits it best, which the photograph itself has
chosen. Prints means and medians, and draws accuracy by date and brightness against forecast.

Of the photographs under low suns it asks whether neighbours shaded the mirror: all within 40 m
(``field-positions.json``) are taken for mirrors like this one that send the sun to the receiver, which nobody recorded.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray

from model.forecast import Setup, View, align
from model.images import clipped_alike
from model.imaging import Camera, MeasuredFlux, measure
from model.imaging.light import LINEAR
from model.metrics import compare_on_target
from model.neighbours import Neighbours, outlines
from model.sunshape import Buie
from model.tracing import Optics, Scene, Window, trace
from model.tracing.alignment import align_scene
from model.tracing.convolution import central_rays
from service.sources.decode import decode_image
from service.sources.documents import Measurement
from service.sources.folder import MeasurementFolder, read_folder
from tests.benchmarks import data_folder

Array = NDArray[np.float64]

RATIOS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4)
CAMERAS = {"counts": Camera(LINEAR), "light": Camera()}
VIEW = View(256, 256, samples=24, padding=0.5, cones="facet")


@dataclass(frozen=True, eq=False)
class Case:
    """A photograph: what was measured by each camera's law, and forecasts (256, 256) by circumsolar ratio."""

    name: str
    target: tuple[float, float]
    taken_at: datetime | None
    measured: dict[str, MeasuredFlux]
    forecasts: dict[float, Array]

    def accuracy(self, law: str, ratio: float) -> float:
        """NaN where the photograph is refused."""
        taken = self.measured[law]
        if taken.flux is None:
            return float("nan")
        flux, forecast = taken.flux.astype(float), self.forecasts[ratio]
        if taken.clipped is not None:
            forecast = clipped_alike(forecast, flux, taken.clipped.astype(float))
        return compare_on_target(flux, forecast, self.target).accuracy

    def best(self, law: str) -> float:
        """Circumsolar ratio that suits it best."""
        return max(RATIOS, key=lambda ratio: self.accuracy(law, ratio))


def read_cases(folder: MeasurementFolder, heliostat: str) -> list[Case]:
    """Every crop of a heliostat, measured and forecast."""
    surface = folder.measured_surface(heliostat)
    assert surface is not None
    return [_case(folder, one, *surface) for one in folder.measurements(heliostat) if "cropped" in one.images]


def _case(folder: MeasurementFolder, one: Measurement, points: Array, degree: int) -> Case:
    plane = folder.plant.targets[one.target]
    setup = Setup(folder.plant.heliostats[one.heliostat], points, one.sun, plane, spot=one.spot, degree=degree)
    image = decode_image(one.images["cropped"].read_bytes())
    measured = {law: measure(image, "cropped", plane, camera=camera) for law, camera in CAMERAS.items()}
    with torch.no_grad():
        aligned = align([setup], latitude_deg=float(folder.plant.origin[0]), dtype=torch.float64)
        forecasts = {ratio: aligned.flux(Optics(Buie(ratio)), (), VIEW)[0].clamp(min=0).numpy() for ratio in RATIOS}
    return Case(one.identifier, (plane.width, plane.height), one.taken_at, measured, forecasts)


def table(cases: list[Case]) -> None:
    """Accuracies of all photographs by law; a refused one counts in the share that is used."""
    print("| taken as | used | mean | median | below 0.85 | by the best ratio of each: mean | median |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for law in CAMERAS:
        plain = np.array([case.accuracy(law, 0.02) for case in cases])
        best = np.array([case.accuracy(law, case.best(law)) for case in cases])
        used = np.isfinite(plain)
        figures = [f"{value:.3f}" for value in (plain[used].mean(), np.median(plain[used]))]
        figures += [str(int((plain < 0.85).sum())), f"{best[used].mean():.3f}", f"{np.median(best[used]):.3f}"]
        print(f"| {law} | {used.sum()} of {len(cases)} | {' | '.join(figures)} |")
    reasons = {case.name: case.measured["light"].quality.reason for case in cases}
    print(f"refused: { {name: reason for name, reason in reasons.items() if reason} }")
    low = {case.name: round(case.accuracy("light", 0.02), 3) for case in cases if case.accuracy("light", 0.02) < 0.85}
    print(f"below 0.85 in light: {low}")


def shadows(folder: MeasurementFolder, heliostat: str, cases: list[Case]) -> None:
    """Accuracies of the photographs whose mirror neighbours would shade or block, without them and with them."""
    surface = folder.measured_surface(heliostat)
    assert surface is not None
    (points, degree), mirror = surface, folder.plant.heliostats[heliostat]
    positions = json.loads((data_folder() / "field-positions.json").read_text())
    places = {name: np.array(entry["position_enu"]) for name, entry in positions.items()}
    near = [replace(mirror, name=n, position=p) for n, p in places.items() if _is_near(p - mirror.position)]
    aims = np.tile(next(iter(folder.plant.receivers.values())).center, (len(near) + 1, 1))
    print("| photograph | sun's elevation [deg] | light that neighbours leave | accuracy without them | with them |")
    print("| --- | --- | --- | --- | --- |")
    for case, one in zip(cases, (m for m in folder.measurements(heliostat) if "cropped" in m.images), strict=True):
        standing = outlines([mirror, *near], one.sun, aims)
        field = Neighbours.from_outlines([([m.name for m in (mirror, *near)], standing, aims)], one.sun)
        obstacles = torch.as_tensor(field.obstacles([heliostat]))
        plane = folder.plant.targets[one.target]
        goals: tuple[Any, ...] = ([mirror], [points], one.sun[None], [plane], [one.spot])
        free, shaded = (align_scene(*goals, degree=degree, alter=alter).scene for alter in (None, _before(obstacles)))
        shaded = _before(obstacles)(shaded)
        left = float(central_rays(_before(obstacles)(free), 24).power.sum() / central_rays(free, 24).power.sum())
        if left > 0.99 or case.measured["light"].flux is None:
            continue
        image = trace(shaded, Window.of(plane), Optics(), samples=48).irradiance[0].clamp(min=0).numpy()
        with_them = replace(case, forecasts={0.02: image}).accuracy("light", 0.02)
        figures = f"{one.elevation_deg:.0f} | {left:.2f} | {case.accuracy('light', 0.02):.3f} | {with_them:.3f}"
        print(f"| {one.identifier} | {figures} |")


def _is_near(apart: Array) -> bool:
    return 0.5 < float(np.linalg.norm(apart)) < 40


def _before(obstacles: torch.Tensor) -> Callable[[Scene], Scene]:
    """Puts rectangles before a scene's mirrors."""
    return lambda scene: scene.with_(obstacles=obstacles.to(scene.sun))


def draw(cases: list[Case], path: Path) -> None:
    """Accuracy by date under both laws, and of one bright photograph brightness against forecast, pixel by pixel."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 5), layout="constrained")
    dated = [case for case in cases if case.taken_at is not None]
    shown = max(dated, key=lambda case: case.accuracy("light", 0.02))
    forecast = shown.forecasts[0.02] / shown.forecasts[0.02].sum()
    for law, colour in (("counts", "tab:red"), ("light", "tab:blue")):
        left.plot([c.taken_at for c in dated], [c.accuracy(law, 0.02) for c in dated], ".", color=colour, label=law)
        flux = shown.measured[law].flux
        assert flux is not None
        x, y = (image[::3, ::3].ravel() / forecast.max() for image in (forecast, flux / flux.sum()))
        right.plot(x, y, ".", markersize=1.5, color=colour, label=law)
    left.set(ylabel="accuracy of the forecast", ylim=(0.5, 1), title="AA39, measured surface, nothing fitted")
    left.legend(loc="lower left")
    right.plot([0, 1], [0, 1], color="gray", linewidth=0.8)
    right.set(xlabel="forecast, of its peak", ylabel="photograph, the same", title=f"{shown.name}, pixel by pixel")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(f"drawn: {path}")


def main(arguments: list[str]) -> None:
    """Print the table and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/light"))
    options = parser.parse_args(arguments)
    root = data_folder().parent / "stj-years"
    if not root.is_dir():
        parser.error(f"no photographs at {root}; set HELIOTWIN_STJ to its neighbour stj")
    folder = read_folder(root)
    cases = read_cases(folder, "AA39")
    table(cases)
    shadows(folder, "AA39", cases)
    draw(cases, options.out / "light.png")


if __name__ == "__main__":
    main(sys.argv[1:])
