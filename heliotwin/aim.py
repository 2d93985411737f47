"""``heliotwin aim``: aim points of the most power under what a receiver can take."""

import csv
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from heliotwin.field import FieldRequest, light_field, no_light, trace_field
from model.aiming.kernels import ImageTracer, Kernels, require_few_pairs
from model.aiming.plan import AimPlan, plan_aims
from model.aiming.uncertainty import plan_uncertainty
from model.fleet import Superposition, tiles
from model.setup import Setup
from service.base.progress import Progress
from service.sources.folder import read_height_std
from service.sources.limits import Limit
from service.sources.plant_file import PlantDescription
from service.twin.forecasts.aims import ROWS, AimFigures, aim_figures, begin_at
from service.twin.forecasts.field_forecast import join_images

Array = NDArray[np.float64]


class AimReport(AimFigures):
    """``REPORT.json`` of `aim`; DESIGN.md, section 8."""

    receiver: str
    sun: dict[str, float]
    dni_w_m2: float
    seconds: dict[str, float]
    power_interval_w: list[float]
    peak_interval_w_m2: list[float]
    surface_draws: int
    sources: dict[str, dict[str, int]]
    skipped: dict[str, str]


@dataclass(frozen=True, eq=False)
class Aims:
    """A plan of aims and its report.

    Attributes
    ----------
    plan : AimPlan
    report : AimReport
    """

    plan: AimPlan
    report: AimReport


def find_aims(
    plant: PlantDescription,
    request: FieldRequest,
    limit: Limit,
    start: dict[str, Array | None] | None,
    step: Progress,
) -> Aims:
    """Find the aims of a plant's heliostats on one receiver.

    ``start`` are good aims of a moment before (3,) [m] by heliostat, None for one that was not
    active.

    Raises
    ------
    InvalidInputError
        If the plant has no such receiver, no heliostat reaches it, or the limit is invalid.
    """
    begun = time.perf_counter()
    found = trace_kernels(plant, request, step)
    kernels = found.kernels
    traced = time.perf_counter()
    on_map = torch.tensor(limit.on_map(*kernels.resolution), dtype=torch.float32).flatten()
    begin = None if start is None else begin_at(kernels, on_map, start)
    plan = plan_aims(kernels, on_map, begin, lambda: step("aims"))
    aimed = time.perf_counter()
    single = trace_field(plant, replace(request, resolution=kernels.resolution), step)
    power = single.report["field"]["intercepted_w"]
    worlds = _drawn_worlds(plant, request, step)
    drawn = plan.draws()
    moment = plan_uncertainty(plan, worlds, drawn)
    report = AimReport(
        **aim_figures(plan, drawn, found.task.receiver, power),
        receiver=request.receiver,
        sun={"azimuth_deg": request.azimuth_deg, "elevation_deg": request.elevation_deg},
        dni_w_m2=found.task.model.optics.dni,
        seconds={"kernels": traced - begun, "aims": aimed - traced},
        power_interval_w=[moment.power.low, moment.power.high],
        peak_interval_w_m2=[moment.peak.low, moment.peak.high],
        surface_draws=len(worlds),
        sources=single.report["sources"],
        skipped=found.skipped,
    )
    return Aims(plan, report)


@dataclass(frozen=True, eq=False)
class TracedKernels:
    """Images of a field's mirrors, how they were traced, and why some mirrors have none."""

    kernels: Kernels
    task: Superposition
    skipped: dict[str, str]


_WORLDS = 4
"""Draws of the surfaces: each traces the whole field again."""

_ALIKE = 1.5
"""Distance, in control points, over which errors of a surface are alike."""


def _drawn_worlds(
    plant: PlantDescription, request: FieldRequest, step: Progress
) -> list[Callable[[], Kernels]]:
    """Makers of kernels with drawn surfaces.

    There are none if no surface of the request has standard deviations.
    """
    if request.surfaces is None or not any(
        read_height_std(request.surfaces, one) is not None
        for one in plant.plant.heliostats.values()
    ):
        return []
    return [partial(_drawn_world, plant, request, step, seed) for seed in range(_WORLDS)]


def _drawn_world(
    plant: PlantDescription, request: FieldRequest, step: Progress, seed: int
) -> Kernels:
    return trace_kernels(plant, request, step, np.random.default_rng(seed)).kernels


def _drawn(setup: Setup, surfaces: Path, rng: np.random.Generator) -> Setup:
    """A setup whose surface has errors of its standard deviations."""
    std = read_height_std(surfaces, setup.heliostat)
    if std is None:
        return setup
    noise = gaussian_filter(rng.normal(size=std.shape), (0, _ALIKE, _ALIKE), mode="reflect")
    heights = std * noise / np.sqrt(np.mean(noise**2))
    normals = setup.heliostat.facet_frames[1][:, 2]
    return replace(
        setup, control_points=setup.control_points + heights[..., None] * normals[:, None, None]
    )


def trace_kernels(
    plant: PlantDescription,
    request: FieldRequest,
    step: Progress,
    rng: np.random.Generator | None = None,
) -> TracedKernels:
    """Trace the images of a plant's mirrors; errors as of `find_aims`.

    They are traced from near to far, since images of one tile have one size. ``rng`` draws errors
    of the surfaces that have standard deviations.
    """
    lit = light_field(plant, request, ROWS)
    group, goal = lit.group, lit.task.receiver.center
    require_few_pairs(len(lit.setups), lit.task.resolution)
    setups = sorted(lit.setups, key=lambda one: math.dist(one.heliostat.position, goal))
    if rng is not None and request.surfaces is not None:
        setups = [_drawn(setup, request.surfaces, rng) for setup in setups]
    images = map(ImageTracer(lit.task, len(setups)), tiles(setups, lit.neighbours))
    kernels = join_images(
        lit.task, images, group, lambda count: step(f"images of {count} heliostats")
    )
    if kernels is None:
        raise no_light(group, group.skipped, "the layout gives it none")
    return TracedKernels(kernels, lit.task, group.skipped)


def write_aims(path: Path, plan: AimPlan) -> None:
    """Write ``name,east_m,north_m,up_m,active``, in the order of names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = sorted(
        zip(plan.kernels.names, plan.points.tolist(), plan.is_active.tolist(), strict=True)
    )
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "east_m", "north_m", "up_m", "active"])
        for name, point, is_on in rows:
            writer.writerow([name, *(f"{value:.4f}" for value in point), int(is_on)])
