"""Aims of ARTIST and ours: ``python -m benchmarks.aims_artist PYTHON``.

``PYTHON`` is that of an environment with ``artist-csp``, as of `benchmarks.artist`. Its
optimizer brings the flux near a plateau, and has the limit as a soft constraint. So each of its
plans is compared with ours under the peak that it reaches.

Both are judged by the exact trace of the field, in the same draws of the pointing errors.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.record import log_row, recording
from heliotwin.aim import trace_kernels
from heliotwin.field import FieldRequest, trace_field
from model.aiming.kernels import Kernels
from model.aiming.plan import DRAWS, AimPlan, plan_aims
from model.frames import sun_direction
from service.base.progress import no_progress
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.artist_export import write_artist
from service.sources.plant_template import staggered_layout
from tests.service.sources.plant_files import write_plant

Array = np.ndarray

SUN, DNI = (180.0, 45.0), 900.0
LIMIT = 2.0
"""Of the mean flux of single aim."""
POINTING = "    pointing_error_mrad: 0.6\n"
PLANT = f"""\
plant: {{name: small, latitude_deg: 50.9, longitude_deg: 6.4, altitude_m: 90}}
heliostat_types:
  small:
    mount: {{kind: pitch_roll, pivot_height_m: 2.0, mirror_offset_m: 0.1}}
    facets: {{rows: 2, columns: 2, width_m: 1.6, height_m: 1.25, gap_m: 0.02}}
    canting: on_axis
    facet_shape: slant_range
    reflectance: 0.935
{POINTING}layout: {{file: layout.csv}}
receivers:
  main: {{kind: plane, center_m: [0, 0, 40], normal: [0, 1, 0], width_m: 3, height_m: 3}}
sun: {{shape: gaussian, sigma_mrad: 2.35}}
"""
PLATEAUS, WEIGHT = (0.6, 0.7, 0.8), 1e-4
"""Shares of the receiver's sides, and the limit's weight; larger ones throw most light away."""


@dataclass(frozen=True, eq=False)
class Judge:
    """Traces aims of a plant without pointing errors; ``kernels`` say how far draws move them."""

    plant: PlantDescription
    kernels: Kernels

    def __call__(self, points: Array, active: Array) -> tuple[float, float]:
        """Mean power [W], and the 95 % quantile of the peak [W/m2]."""
        rng, moved = np.random.default_rng(3), self.kernels.moved(points)
        powers, peaks = [], []
        for _ in range(DRAWS // 2):
            errors = torch.tensor(rng.normal(size=moved.shape)).to(moved)
            drawn = self.kernels.points(
                moved + torch.einsum("nij,nj->ni", self.kernels.spread, errors)
            )
            aims = {
                name: point if is_on else None
                for name, point, is_on in zip(self.kernels.names, drawn, active, strict=True)
            }
            request = replace(asked(self.kernels.resolution), aims=aims)
            found = trace_field(self.plant, request, no_progress)
            powers.append(found.report["field"]["intercepted_w"])
            peaks.append(found.flux.max())
        return float(np.mean(powers)), float(np.quantile(peaks, 0.95))

    def of_plan(self, plan: AimPlan) -> tuple[float, float]:
        return self(plan.points, plan.is_active.numpy())


def asked(resolution: tuple[int, int] | None = None) -> FieldRequest:
    return FieldRequest("main", *SUN, DNI, resolution=resolution)


class Found(NamedTuple):
    """Aims (P, N, 3) [m] of P plateaus, in the order of the kernels, and seconds (P,)."""

    aims: Array
    seconds: Array


def by_artist(scenario: Path, kernels: Kernels, power: float, limit: float) -> Found:
    """ARTIST's aims."""
    entries = [
        {"power": power, "limit": limit, "plateau": plateau, "weight": WEIGHT}
        for plateau in PLATEAUS
    ]
    out, listed = scenario.with_suffix(".npz"), scenario.with_suffix(".json")
    listed.write_text(json.dumps(entries))
    script, sun = Path(__file__).with_name("artist_tracer.py"), map(str, sun_direction(*SUN))
    command: list[str | Path] = [Path(sys.argv[1]).absolute(), "-P", script, scenario, "main"]
    command += [*sun, out, listed]
    subprocess.run(command, check=True, cwd=scenario.parent)  # where ARTIST writes its log
    with np.load(out) as found:
        names = found["names"].tolist()
        rows = [names.index(name) for name in kernels.names]
        return Found(found["aims"][:, rows], found["seconds"])


def ours(kernels: Kernels, limit: float) -> tuple[AimPlan, float]:
    """Our plan and its seconds."""
    begun = time.perf_counter()
    plan = plan_aims(kernels, torch.full_like(kernels.areas, limit))
    return plan, time.perf_counter() - begun


def main() -> None:
    """Print and record plans of both."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        layout = staggered_layout("small", [60.0 + 12 * row for row in range(6)], 11.0, 0.0, 40.0)
        plant = read_plant(write_plant(folder, PLANT, layout))
        still = read_plant(write_plant(folder / "still", PLANT.replace(POINTING, ""), layout))
        begun = time.perf_counter()
        kernels = trace_kernels(plant, asked(), no_progress).kernels
        kernels_s = time.perf_counter() - begun
        judge = Judge(still, kernels)
        single = trace_field(plant, asked(kernels.resolution), no_progress).report["field"]
        power = float(single["intercepted_w"])
        limit = LIMIT * power / float(kernels.areas.sum())
        scenario = folder / "scenario.h5"
        write_artist(plant, scenario, None)
        plan, seconds = ours(kernels, limit)
        row(kernels, "ours", judge.of_plan(plan), power, limit, kernels_s + seconds)
        found = by_artist(scenario, kernels, power, limit)
        for plateau, aims, its in zip(PLATEAUS, *found, strict=True):
            reached = judge(aims, np.ones(len(kernels), dtype=bool))
            name = f"ARTIST, plateau of {plateau:g} of the sides"
            row(kernels, name, reached, power, limit, float(its))
            same, seconds = ours(kernels, reached[1])
            name = f"ours, limited to the peak of plateau {plateau:g}"
            row(kernels, name, judge.of_plan(same), power, limit, kernels_s + seconds)


def row(
    kernels: Kernels,
    name: str,
    reached: tuple[float, float],
    power: float,
    limit: float,
    seconds: float,
) -> None:
    cells = {
        "power of single aim's [%]": 100 * reached[0] / power,
        "peak in 95 % of draws, of the limit [%]": 100 * reached[1] / limit,
        "seconds [s]": seconds,
    }
    print(name, cells, flush=True)
    log_row(
        f"Aims of ARTIST and ours, {len(kernels)} heliostats",
        name,
        cells,
        n=DRAWS // 2,
        of="draws",
        compared_with="the exact trace of the field",
    )


if __name__ == "__main__":
    with recording("aims_artist"):
        main()
