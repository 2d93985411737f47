"""Aim points under a limit: ``python -m benchmarks.aims``.

- Gemasolar's layout, 2,650 heliostats around a cylinder, with limits of 1.8 and 1.5 times the mean
  flux of single aim: power, draws of the pointing errors, the bound on any plan, k-factors,
  seconds, and a plan that begins with the aims of two minutes before.
- Another field of 10,000 heliostats: seconds and memory.
- A Monte Carlo simulation of a plan, which shares no code with the tracer: rays from uniform points
  of paraboloids, with own slope and pointing errors, shaded and blocked by the nearest
  heliostats.

Reads Gemasolar's layout from ``HELIOTWIN_PLANTS``, by default ``../shared/plants``.
"""

import argparse
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.record import Estimate, log_row, recording
from heliotwin.aim import trace_kernels
from heliotwin.field import FieldRequest, trace_field
from model.aiming.bound import bound_power
from model.aiming.k_factor import k_factor_aims
from model.aiming.kernels import Kernels
from model.aiming.plan import AimPlan, plan_aims, single_aim
from model.frames import sun_direction
from service.base.progress import no_progress
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_template import staggered_layout
from tests.service.sources.plant_files import gemasolar

Array = np.ndarray
SUN = (180.0, 60.0)
LATER = (180.9, 60.0)
"""The sun two minutes later."""
DNI = 900.0
POINTING = "slope_error_mrad: 1.45\n    pointing_error_mrad: 0.6"


@dataclass(frozen=True, eq=False)
class Traced:
    """Kernels of a field, and the seconds that they took."""

    kernels: Kernels
    seconds: float


def trace(plant: PlantDescription, sun: tuple[float, float]) -> Traced:
    """Trace the images of a plant's mirrors."""
    begun = time.perf_counter()
    kernels = trace_kernels(plant, FieldRequest("main", *sun, DNI), no_progress).kernels
    return Traced(kernels, time.perf_counter() - begun)


def plans(plant: PlantDescription) -> AimPlan:
    """Plans of a field under two limits; the last one is returned."""
    traced, later = trace(plant, SUN), trace(plant, LATER)
    kernels, receiver = traced.kernels, plant.receivers["main"]
    single = trace_field(
        plant, FieldRequest("main", *SUN, DNI, resolution=kernels.resolution), no_progress
    ).report["field"]
    mean = single["intercepted_w"] / float(kernels.areas.sum())
    plan = single_aim(kernels, torch.full_like(kernels.areas, mean))
    for factor, goal in ((1.8, 0.99), (1.5, 0.96)):
        limit = torch.full_like(kernels.areas, factor * mean)
        begun = time.perf_counter()
        plan = plan_aims(kernels, limit)
        aims_s = time.perf_counter() - begun
        begun = time.perf_counter()
        again = plan_aims(later.kernels, limit, plan)
        again_s = time.perf_counter() - begun
        bound, other, drawn = (
            bound_power(plan),
            k_factor_aims(kernels, limit, receiver),
            plan.draws(),
        )
        cells = {
            "power of single aim's [%]": Estimate(
                100 * plan.power / single["intercepted_w"], goal=f">= {100 * goal:g}"
            ),
            "below the bound [%]": Estimate(100 * (1 - plan.power / bound), goal="<= 1.5"),
            "limit reached in 95 % of draws [%]": Estimate(100 * drawn.ratio, goal="<= 100"),
            "defocused": int((~plan.is_active).sum()),
            "k-factors, power of single aim's [%]": 100 * other.power / single["intercepted_w"],
            "k-factors, limit reached [%]": 100 * other.draws().ratio,
            "kernels [s]": Estimate(traced.seconds, goal="<= 10"),
            "aims [s]": Estimate(aims_s, goal="<= 10"),
            "two minutes later, aims [s]": Estimate(again_s, goal="<= 2"),
            "two minutes later, power [%]": 100 * again.power / single["intercepted_w"],
            "two minutes later, limit reached [%]": 100 * again.draws().ratio,
        }
        print(f"{factor} times the mean:", {k: getattr(v, "value", v) for k, v in cells.items()})
        log_row(
            "Aims of 2,650 heliostats",
            f"limit of {factor} times the mean of single aim",
            cells,
            n=len(kernels),
            of="heliostats",
            compared_with="single aim, k-factors and the dual bound",
        )
    return plan


def large(folder: Path) -> None:
    """A field of 10,000 heliostats."""
    text = (folder / "plant.yaml").read_text()
    big = folder / "large"
    big.mkdir()
    (big / "plant.yaml").write_text(
        text.replace("radius_m: 4, height_m: 16", "radius_m: 8, height_m: 24").replace(
            "116]", "220]"
        )
    )
    layout = staggered_layout("large", [120 + 16.5 * row for row in range(77)], 29.0, 0.0, 180.0)
    lines = layout.splitlines()[:10_001]
    (big / "layout.csv").write_text("\n".join(lines) + "\n")
    traced = trace(read_plant(big / "plant.yaml"), SUN)
    kernels = traced.kernels
    power = single_aim(kernels, kernels.areas).power
    limit = torch.full_like(kernels.areas, 1.8 * power / float(kernels.areas.sum()))
    begun = time.perf_counter()
    plan = plan_aims(kernels, limit)
    aims_s = time.perf_counter() - begun
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    cells = {
        "kernels and aims [s]": Estimate(traced.seconds + aims_s, goal="<= 90"),
        "memory [GB]": Estimate(memory, goal="<= 4"),
        "power of single aim's [%]": 100 * plan.power / power,
        "limit reached in 95 % of draws [%]": 100 * plan.draws(100).ratio,
    }
    print(f"{len(kernels)} heliostats:", {k: getattr(v, "value", v) for k, v in cells.items()})
    log_row("Aims of a large field", f"{len(kernels):,} heliostats", cells, n=1, of="plan")


# --- Monte Carlo


def unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Mirror:
    """A paraboloid on an azimuth-elevation mount: centre, axes right, up, normal (3, 3), focus."""

    center: Array
    axes: Array
    focus: float


WIDTH, HEIGHT, NEAREST = 9.752, 12.305, 12
SLOPE, POINTING_ERROR, HALF_ANGLE, REFLECTANCE = 1.45e-3, 0.6e-3, 4.65e-3, 0.93


def simulate(plan: AimPlan, rays: int, seed: int) -> Array:
    """Irradiance (rows, columns) [W/m2] of a plan on Gemasolar's cylinder by random rays."""
    rng = np.random.default_rng(seed)
    sun, axis, radius, height = sun_direction(*SUN), np.array([0.0, 0.0, 116.0]), 4.0, 16.0
    rows, columns = plan.kernels.resolution
    mirrors = []
    for middle, aim in zip(plan.kernels.mirrors.double().numpy(), plan.points, strict=True):
        normal = unit(sun + unit(aim - middle))
        right = unit(np.cross([0.0, 0.0, 1.0], normal))
        focus = float(np.linalg.norm(axis - middle))
        mirrors.append(Mirror(middle, np.array([right, np.cross(normal, right), normal]), focus))
    near = cKDTree([m.center[:2] for m in mirrors]).query([m.center[:2] for m in mirrors], NEAREST)[
        1
    ]
    total = np.zeros((rows, columns))
    for index, mirror in enumerate(mirrors):
        x, y = rng.uniform(-0.5, 0.5, (2, rays)) * [[WIDTH], [HEIGHT]]
        local = np.stack([x, y, (x**2 + y**2) / (4 * mirror.focus)], axis=-1)
        start = mirror.center + local @ mirror.axes
        bent = np.stack([-x / (2 * mirror.focus), -y / (2 * mirror.focus), np.ones(rays)], axis=-1)
        normal = unit(unit(bent) @ mirror.axes + _errors(rng, mirror.axes, SLOPE, rays))
        toward = unit(sun + _disc(rng, sun, rays))
        light = (normal * toward).sum(1).clip(0) * WIDTH * HEIGHT / rays * DNI * REFLECTANCE
        out = 2 * (normal * toward).sum(1, keepdims=True) * normal - toward
        out = unit(out + _errors(rng, _frame(out.mean(axis=0)), POINTING_ERROR, 1))
        for other in near[index, 1:]:
            light = light * ~(
                _meets(start, toward, mirrors[other]) | _meets(start, out, mirrors[other])
            )
        p, d = (start - axis)[:, :2], out[:, :2]
        a, b, c = (d**2).sum(1), (p * d).sum(1), (p**2).sum(1) - radius**2
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        place = start - axis + ((-b - root) / a)[:, None] * out
        # The map's middle faces north, and its columns go west, as seen from outside.
        column = (np.arctan2(-place[:, 0], place[:, 1]) / (2 * np.pi) + 0.5) * columns
        row = (0.5 - place[:, 2] / height) * rows
        lands = (b**2 > a * c) & (row >= 0) & (row < rows)
        np.add.at(
            total, (row[lands].astype(int), column[lands].astype(int) % columns), light[lands]
        )
    return total * rows * columns / (2 * np.pi * radius * height)


def _frame(axis: Array) -> Array:
    """Two unit vectors across an axis (3,), and the axis."""
    first = unit(np.cross(axis, [0.0, 0.0, 1.0]))
    return np.array([first, np.cross(unit(axis), first), unit(axis)])


def _errors(rng: np.random.Generator, axes: Array, sigma: float, count: int) -> Array:
    return rng.normal(0, sigma, (count, 2)) @ axes[:2]


def _disc(rng: np.random.Generator, sun: Array, count: int) -> Array:
    radius, turn = HALF_ANGLE * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1) @ _frame(sun)[:2]


def _meets(start: Array, ray: Array, mirror: Mirror) -> Array:
    distance = (mirror.center - start) @ mirror.axes[2] / (ray @ mirror.axes[2])
    place = start + distance[:, None] * ray - mirror.center
    inside = (np.abs(place @ mirror.axes[0]) < WIDTH / 2) & (
        np.abs(place @ mirror.axes[1]) < HEIGHT / 2
    )
    return inside & (distance > 0)


def judge(plan: AimPlan, rays: int) -> None:
    """Compare a plan with random rays, which draw one pointing error for each mirror and run."""
    maps = np.array([simulate(plan, rays, seed) for seed in range(RUNS)])
    said = plan.flux.double().numpy().reshape(plan.kernels.resolution)
    hot = said > 0.97 * said.max()
    peaks = maps[:, hot].mean(axis=1) / said[hot].mean()
    powers = maps.sum(axis=(1, 2)) / said.sum()
    cells = {}
    for name, ratios in (("peak", peaks), ("power", powers)):
        apart, error = 100 * (ratios.mean() - 1), 100 * 1.96 * ratios.std(ddof=1) / RUNS**0.5
        cells[f"{name}, simulated less said [%]"] = Estimate(
            abs(apart), (max(0.0, abs(apart) - error), abs(apart) + error), goal="<= 1"
        )
        print(f"{name}: {apart:+.2f} % (+- {error:.2f})")
    log_row(
        "Aims of 2,650 heliostats, simulated",
        "limit of 1.5 times the mean of single aim",
        cells,
        n=RUNS,
        of="runs",
        compared_with="a Monte Carlo simulation of all rays",
    )


RUNS = 6


def main(arguments: list[str]) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rays", type=int, default=4000, help="of each mirror and run")
    parser.add_argument("--only", choices=("plans", "large", "simulated"))
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as directory:
        file = gemasolar(Path(directory))
        text = file.read_text().replace("slope_error_mrad: 1.45", POINTING)
        file.write_text(
            text.replace("shape: buie\n  csr: 0.05", "shape: pillbox\n  half_angle_mrad: 4.65")
        )
        if options.only != "large":
            plan = plans(read_plant(file))
            if options.only != "plans":
                judge(plan, options.rays)
        if options.only in (None, "large"):
            large(Path(directory))


if __name__ == "__main__":
    with recording("aims"):
        main(sys.argv[1:])
