"""Trace a scenario with ARTIST itself; runs in an environment that has it.

    python artist_tracer.py SCENARIO.h5 TARGET SUN_EAST SUN_NORTH SUN_UP OUT.npz

OUT has, for each heliostat whose motors reach the aim, the irradiance (256, 256) on the target per
share of the rays sent out,
times the cosine on the target, as ARTIST has it.
"""

import sys
import types
from pathlib import Path

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
from artist.raytracing import HeliostatRayTracer
from artist.scenario import Scenario

POINTS, RAYS = 50, 40


def within_limits(group) -> dict[str, bool]:
    """Whether heliostats reach the aim; ARTIST turns others, with the same normal, on their heads.

    Ideal motors have angles; those that begin at zero, as steps do, reach no usual angle.
    """
    motors = group.kinematics.active_motor_positions
    low, high = (group.kinematics.actuators.active_non_optimizable_parameters[:, i] for i in (2, 3))
    inside = ((motors >= low) & (motors <= high)).all(dim=1)
    if "ideal" in type(group.kinematics.actuators).__name__.lower():
        inside &= (low < -3).all(dim=1)
    return dict(zip(group.names, inside.tolist(), strict=True))


def main(path: Path, target: str, sun: list[float], out: Path) -> None:
    """Trace all heliostats, each aimed at the target's middle."""
    torch.manual_seed(7)
    device = torch.device("cpu")
    with h5py.File(path) as file:
        scenario = Scenario.load_scenario_from_hdf5(
            file, number_of_surface_points_per_facet=torch.tensor([POINTS, POINTS]), device=device
        )
    scenario.set_number_of_rays(RAYS)
    index = scenario.solar_tower.target_name_to_index[target]
    found = {}
    for group in scenario.heliostat_field.heliostat_groups:
        count = group.number_of_heliostats
        mask = torch.ones(count, dtype=torch.int32)
        indices = torch.full((count,), index, dtype=torch.int32)
        rays = torch.tensor([[-x for x in sun] + [0.0]] * count, dtype=torch.float32)
        group.activate_heliostats(active_heliostats_mask=mask, device=device)
        aims = scenario.solar_tower.get_centers_of_target_areas(
            target_area_indices=indices, device=device
        )
        group.align_surfaces_with_incident_ray_directions(
            aim_points=aims,
            incident_ray_directions=rays,
            active_heliostats_mask=mask,
            device=device,
        )
        tracer = HeliostatRayTracer(scenario, group, blocking_active=False)
        bitmaps = tracer.trace_rays(
            incident_ray_directions=rays,
            active_heliostats_mask=mask,
            target_area_indices=indices,
            mirror_reflectivity=1.0,
            device=device,
        )[0]
        reached = within_limits(group)
        sent = group.surface_points.shape[1] * RAYS
        images = dict(zip(group.names, (bitmaps / sent).numpy(), strict=True))
        found.update({name: images[name] for name, is_there in reached.items() if is_there})
    np.savez_compressed(out, **found)


_, scenario_file, target_name, *direction, output = sys.argv
main(Path(scenario_file), target_name, [float(x) for x in direction], Path(output))
