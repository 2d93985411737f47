"""What surfaces are worth to aims: ``python -m benchmarks.aim_surfaces``.

A field of mirrors with known true surfaces. Aims are planned by ideal mirrors with the slope error
of the true ones, by twins whose slopes are wrong by a fifth of that, and by the true surfaces. The
true surfaces judge each plan under the same limit. Where draws exceed it, the plan is made again
for a lower limit until they do not, which shows the power that is lost.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from benchmarks.record import Estimate, log_row, recording
from heliotwin.aim import trace_kernels
from heliotwin.field import FieldRequest
from model.aiming.kernels import Kernels
from model.aiming.plan import AimPlan, plan_aims, single_aim
from model.aiming.uncertainty import judged_on, plan_uncertainty
from model.plant import Heliostat
from model.surface import control_points
from service.base.progress import no_progress
from service.sources.plant_file import read_plant
from tests.service.sources.aim_plant import write_aim_plant

Array = np.ndarray
SLOPE, TWIN, ROUGHNESS = 1.3e-3, 0.2, 0.3e-3
"""Slopes of the true figures [rad], the share of them that twins have wrong, and what is finer."""
DRAWN = 8
"""Draws of the twins' surfaces."""
FACTOR = 1.8
"""Limit, relative to the mean flux of single aim."""


def figure(heliostat: Heliostat, rng: np.random.Generator, slope: float) -> Array:
    """Random smooth heights (F, 8, 8) [m] with slopes of an rms per axis [rad]."""
    noise = rng.normal(size=(len(heliostat.facets), 8, 8))
    z = gaussian_filter(noise, (0, 2.0, 2.0), mode="nearest")
    half = heliostat.facet_frames[2][0]
    slopes = np.gradient(z, *(2 * half / 7), axis=(1, 2))
    rms = np.sqrt(np.mean(np.square(slopes)))
    return z * slope / rms


def write(folder: Path, heliostat: Heliostat, z: Array, std: float = 0.0) -> None:
    path = folder / heliostat.name / "Deflectometry" / f"{heliostat.name}-nurbs-surface.npz"
    path.parent.mkdir(parents=True)
    points = control_points(heliostat, z)
    z_std = np.full(z.shape, std)
    np.savez(path, control_points=points, degrees=np.array([3, 3]), z_std=z_std)


@dataclass(frozen=True, eq=False)
class Worlds:
    """Kernels by what the surfaces are taken to be, and those of draws of the twins' errors."""

    ideal: Kernels
    twin: Kernels
    true: Kernels
    drawn: list[Kernels]


def worlds(folder: Path) -> Worlds:
    """Trace the field with ideal, nearly known and true surfaces."""
    file = write_aim_plant(folder)
    text, rng = file.read_text(), np.random.default_rng(0)

    def traced(slope: float, surfaces: Path | None, seed: int | None = None) -> Kernels:
        changed = text.replace("slope_error_mrad: 1.3", f"slope_error_mrad: {1e3 * slope:.4f}")
        file.write_text(changed)
        request = FieldRequest("board", 180.0, 55.0, 900.0, surfaces=surfaces)
        rng = None if seed is None else np.random.default_rng(seed)
        return trace_kernels(read_plant(file), request, no_progress, rng).kernels

    for heliostat in read_plant(file).plant.heliostats.values():
        z = figure(heliostat, rng, SLOPE)
        write(folder / "true", heliostat, z)
        error = figure(heliostat, rng, TWIN * SLOPE)
        write(folder / "twin", heliostat, z + error, float(error.std()))
    return Worlds(
        traced(float(np.hypot(SLOPE, ROUGHNESS)), None),
        traced(float(np.hypot(TWIN * SLOPE, ROUGHNESS)), folder / "twin"),
        traced(ROUGHNESS, folder / "true"),
        [traced(ROUGHNESS, folder / "twin", seed) for seed in range(DRAWN)],
    )


def kept(kernels: Kernels, true: Kernels, limit: torch.Tensor) -> AimPlan:
    """The plan by some kernels, on the true ones, for a limit low enough to keep the real one."""
    share = 1.0
    while True:
        plan = plan_aims(kernels, limit * share)
        judged = replace(judged_on(plan, true), limit=limit)
        ratio = judged.draws().ratio
        if ratio <= 1.0:
            return judged
        share *= min(0.995, 1 / ratio)


def main() -> None:
    """Print and record what each knowledge of the surfaces is worth."""
    with tempfile.TemporaryDirectory() as name:
        found = worlds(Path(name))
    true = found.true
    single = single_aim(true, torch.ones_like(true.areas))
    limit = torch.full_like(true.areas, FACTOR * single.power / float(true.areas.sum()))
    for row in ("ideal", "twin", "true"):
        kernels: Kernels = getattr(found, row)
        plan = plan_aims(kernels, limit)
        judged = replace(judged_on(plan, true), limit=limit)
        drawn = [lambda one=one: one for one in found.drawn] if row == "twin" else []
        said = plan_uncertainty(plan, drawn)
        moment = plan_uncertainty(judged)
        cells: dict[str, Any] = {
            "power, less than said [%]": 100 * (1 - judged.power / plan.power),
            "limit reached in 95 % of draws [%]": 100 * judged.draws().ratio,
            "draws within the limit [%]": 100 * moment.within,
            "power that keeps the limit, of single aim's [%]": Estimate(
                100 * kept(kernels, true, limit).power / single.power
            ),
            "peak, interval said, low [kW/m2]": said.peak.low / 1e3,
            "peak, interval said, high [kW/m2]": said.peak.high / 1e3,
            "peak, interval true, low [kW/m2]": moment.peak.low / 1e3,
            "peak, interval true, high [kW/m2]": moment.peak.high / 1e3,
        }
        print(f"{row}:", {k: round(getattr(v, "value", v), 3) for k, v in cells.items()})
        log_row(
            "What surfaces are worth to aims",
            f"planned by {row} surfaces",
            cells,
            n=len(true),
            of="heliostats",
            compared_with="the true surfaces under the same limit",
        )


if __name__ == "__main__":
    with recording("aim_surfaces"):
        main()
