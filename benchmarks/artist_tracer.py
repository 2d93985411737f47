"""Trace a scenario with ARTIST itself, or let it find aims; runs in an environment that has it.

    python artist_tracer.py SCENARIO.h5 TARGET SUN_EAST SUN_NORTH SUN_UP OUT.npz [ASKED.json]

OUT has, for each heliostat whose motors reach the aim, the irradiance (256, 256) on the target per
share of the rays sent out,
times the cosine on the target, as ARTIST has it.

With ASKED, a list of ``power`` [W] of single aim, ``limit`` [W/m2], its ``weight`` and ``plateau``
(share of the target's sides), OUT has ``names`` (N,), and for each entry ``aims`` (N, 3) [m] and
``seconds``.
"""

import json
import sys
import time
import types
from pathlib import Path
from typing import Any

try:
    import torchvision
except ImportError:  # ARTIST needs it for photographs only
    torchvision = types.ModuleType("torchvision")
    for part in ("io", "transforms"):
        child = types.ModuleType(f"torchvision.{part}")
        setattr(torchvision, part, child)
        sys.modules[child.__name__] = child
    sys.modules["torchvision"] = torchvision

import h5py
import numpy as np
import torch
from artist.flux import trapezoid_distribution
from artist.optim import AimPointOptimizer
from artist.optim.loss import KLDivergenceLoss
from artist.raytracing import HeliostatRayTracer
from artist.scenario import Scenario
from artist.util.env import setup_distributed_environment

DEVICE = torch.device("cpu")
POINTS, RAYS = 50, 40
AIM_POINTS, AIM_RAYS, AIM_SIZE = 16, 4, 32
"""Points along a facet's sides, rays of each and pixels while ARTIST finds aims.

The noise of few rays in a small pixel would be taken for a hot spot.
"""


def load(path: Path, points: int, rays: int) -> Scenario:
    """A scenario with so many points along a facet's sides, and rays of each."""
    torch.manual_seed(7)
    with h5py.File(path) as file:
        scenario = Scenario.load_scenario_from_hdf5(
            file, number_of_surface_points_per_facet=torch.tensor([points] * 2), device=DEVICE
        )
    scenario.set_number_of_rays(rays)
    return scenario


def within_limits(group: Any) -> dict[str, bool]:
    """Whether heliostats reach the aim; ARTIST turns others, with the same normal, on their heads.

    Ideal motors have angles; those that begin at zero, as steps do, reach no usual angle.
    """
    motors = group.kinematics.active_motor_positions
    low, high = (group.kinematics.actuators.active_non_optimizable_parameters[:, i] for i in (2, 3))
    inside = ((motors >= low) & (motors <= high)).all(dim=1)
    if "ideal" in type(group.kinematics.actuators).__name__.lower():
        inside &= (low < -3).all(dim=1)
    return dict(zip(group.names, inside.tolist(), strict=True))


def traced(
    scenario: Scenario, group: Any, index: int, sun: list[float], blocked: bool
) -> torch.Tensor:
    """Images (N, 256, 256) of all heliostats of a group, each aimed at the target's middle."""
    count = group.number_of_heliostats
    mask = torch.ones(count, dtype=torch.int32)
    indices = torch.full((count,), index, dtype=torch.int32)
    rays = torch.tensor([[-x for x in sun] + [0.0]] * count, dtype=torch.float32)
    group.activate_heliostats(active_heliostats_mask=mask, device=DEVICE)
    aims = scenario.solar_tower.get_centers_of_target_areas(
        target_area_indices=indices, device=DEVICE
    )
    group.align_surfaces_with_incident_ray_directions(
        aim_points=aims, incident_ray_directions=rays, active_heliostats_mask=mask, device=DEVICE
    )
    tracer = HeliostatRayTracer(scenario, group, blocking_active=blocked)
    return tracer.trace_rays(
        incident_ray_directions=rays,
        active_heliostats_mask=mask,
        target_area_indices=indices,
        mirror_reflectivity=1.0,
        device=DEVICE,
    )[0]


def images(path: Path, target: str, sun: list[float]) -> dict[str, np.ndarray]:
    """The image of each heliostat."""
    scenario = load(path, POINTS, RAYS)
    index = scenario.solar_tower.target_name_to_index[target]
    found = {}
    for group in scenario.heliostat_field.heliostat_groups:
        bitmaps = traced(scenario, group, index, sun, blocked=False)
        reached = within_limits(group)
        sent = group.surface_points.shape[1] * RAYS
        by_name = dict(zip(group.names, (bitmaps / sent).numpy(), strict=True))
        found.update({name: by_name[name] for name, is_there in reached.items() if is_there})
    return found


# --- aims

CONFIGURATION = {
    "optimization": {
        "initial_learning_rate": 3e-4,
        "tolerance": 0.0005,
        "max_epoch": 150,
        "batch_size": 50,
        "log_step": 0,
        "early_stopping_delta": 1e-4,
        "early_stopping_patience": 100,
        "early_stopping_window": 100,
    },
    "scheduler": {
        "scheduler_type": "reduce_on_plateau",
        "lr_min": 1e-6,
        "reduce_factor": 0.3,
        "patience": 100,
        "threshold": 1e-3,
        "cooldown": 10,
    },
}
"""Settings of ARTIST's tutorial, with more epochs."""


def flat(plateau: float) -> torch.Tensor:
    """A distribution with a plateau on a share of the sides, and the tutorial's slopes."""
    side = trapezoid_distribution(AIM_SIZE, AIM_SIZE * 30 // 256, int(AIM_SIZE * plateau), DEVICE)
    return side[:, None] * side[None, :]


def aims_of(group: Any, sun: list[float], plane: torch.Tensor, normal: torch.Tensor) -> np.ndarray:
    """Where rays of the sun from the mirrors' middles (N, 3) meet a target."""
    middles = group.active_surface_points.detach()[..., :3].mean(dim=1)
    normals = group.active_surface_normals.detach()[..., :3].mean(dim=1)
    normals = normals / normals.norm(dim=1, keepdim=True)
    toward = torch.tensor(sun, dtype=torch.float32)
    out = 2 * (normals @ toward)[:, None] * normals - toward
    return (middles + (((plane - middles) @ normal) / (out @ normal))[:, None] * out).numpy()


def plans(
    path: Path, target: str, sun: list[float], asked: list[dict[str, Any]]
) -> dict[str, np.ndarray]:
    """Aims of each entry that is asked for."""
    scenario = load(path, AIM_POINTS, AIM_RAYS)
    index = scenario.solar_tower.target_name_to_index[target]
    (group,) = scenario.heliostat_field.heliostat_groups
    area = scenario.solar_tower.target_areas[0]
    plane, normal = area.centers[index, :3], area.normals[index, :3]
    aims, seconds = [], []
    rays = torch.tensor([-x for x in sun] + [0.0], dtype=torch.float32)
    sent = group.surface_points.shape[1] * AIM_RAYS
    share = float(traced(scenario, group, index, sun, blocked=True).sum()) / sent
    with setup_distributed_environment(number_of_heliostat_groups=1, device=DEVICE) as setup:
        for one in asked:
            # ARTIST leaves out the cosine of incidence: its light is scaled to the true power.
            scale = one["power"] / (share * 0.935 * area_of(group))
            begun = time.perf_counter()
            constraints = {
                "rho_flux_integral": 1.0,
                "rho_local_flux": one["weight"],
                "rho_intercept": 1.0,
                "max_flux_density": one["limit"],
            }
            optimizer = AimPointOptimizer(
                setup,
                scenario,
                {**CONFIGURATION, "constraints": constraints},
                incident_ray_direction=rays,
                target_area_index=index,
                ground_truth=flat(one["plateau"]),
                dni=scale,
                bitmap_resolution=torch.tensor([AIM_SIZE, AIM_SIZE]),
                device=DEVICE,
            )
            loss, history = optimizer.optimize(KLDivergenceLoss(), device=DEVICE)[:2]
            seconds.append(time.perf_counter() - begun)
            aims.append(aims_of(group, sun, plane, normal))
            change = history["flux_integral"][-1]
            print(f"ARTIST: {one}, loss {float(loss):.4f}, power {change:+.2f} %", flush=True)
    return {"names": np.array(group.names), "aims": np.array(aims), "seconds": np.array(seconds)}


def area_of(group: Any) -> float:
    """The area [m2] that ARTIST gives to a mirror."""
    width, height = (4 * group.canting[0].norm(dim=1)[0][:2] + 0.02).tolist()
    return width * height


_, scenario_file, target_name, *direction, output = sys.argv[:7]
SUN = [float(x) for x in direction]
if len(sys.argv) > 7:
    entries = json.loads(Path(sys.argv[7]).read_text())
    arrays: dict[str, Any] = plans(Path(scenario_file), target_name, SUN, entries)
else:
    arrays = images(Path(scenario_file), target_name, SUN)
np.savez_compressed(output, **arrays)
