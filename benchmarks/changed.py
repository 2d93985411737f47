"""Whether a real mirror changed: ``python -m benchmarks.changed``.

AA39's photographs of two years are split at a date. A surface is refined from photographs of each
side, and both surfaces forecast the other photographs. If the mirror changed, the surface of the
same side forecasts better. The advantage is printed with its interval over days. As a control, the
days are assigned to the sides alternately, so that there is no advantage.
"""

import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.folders import read_observations
from benchmarks.record import Estimate, log_row, recording
from benchmarks.surfaces import BRIGHT, spread
from benchmarks.years import interval
from model.metrics import surface_error
from model.network.predictor import default_predictor
from model.observation import Observation, misfits
from model.plant import Heliostat
from model.plant_model import JUELICH_MODEL
from model.refinement import refine
from service.sources.folder import read_folder

Array = NDArray[np.float64]

IMAGES = 8
PARTS = 3


def day_of(observation: Observation) -> str:
    """The day of a photograph."""
    assert observation.taken_at is not None
    return observation.taken_at.date().isoformat()


def surface_from(heliostat: Heliostat, fitted: Sequence[Observation]) -> Array:
    """The refined surface (4, 8, 8) [m] of some photographs."""
    start = default_predictor().predict(heliostat, spread(list(fitted), 8), JUELICH_MODEL)
    return refine(heliostat, fitted, JUELICH_MODEL, start.z).z


def row(name: str, heliostat: Heliostat, sides: Sequence[list[Observation]]) -> None:
    """Print what either side's surface is worth to both."""
    fitted = [spread(side, IMAGES) for side in sides]
    used = {o.identifier for side in fitted for o in side}
    judges = [[o for o in side if o.identifier not in used] for side in sides]
    surfaces = [surface_from(heliostat, side) for side in fitted]
    missed = [[np.array(misfits(heliostat, j, z, JUELICH_MODEL)) for j in judges] for z in surfaces]
    advantage = np.concatenate([missed[1][0] - missed[0][0], missed[0][1] - missed[1][1]])
    worth = [[1 - each.mean() for each in of_surface] for of_surface in missed]
    low, high = interval(advantage, [day_of(o) for side in judges for o in side])
    print(
        f"| {name} | {len(judges[0])}, {len(judges[1])} | {worth[0][0]:.3f} / {worth[1][0]:.3f} |"
        f" {worth[1][1]:.3f} / {worth[0][1]:.3f} | {advantage.mean():+.4f} [{low:+.4f},"
        f" {high:+.4f}] | {1e3 * surface_error(*surfaces):.3f} |",
        flush=True,
    )
    log_row(
        "Surfaces from either side of a date",
        name,
        {
            "advantage in accuracy of the own side's": Estimate(advantage.mean(), (low, high)),
            "surfaces differ by [mm]": 1e3 * surface_error(*surfaces),
        },
        n=len(advantage),
        of="photographs",
        compared_with="the other photographs of both sides, intervals over days",
    )


def main() -> int:
    """Print the table."""
    root = data_folder().parent / "stj-years"
    if not root.is_dir():
        print(f"changed: no real measurements at {root}; set HELIOTWIN_STJ")
        return 0
    years = read_folder(root)
    heliostat = years.plant.heliostats["AA39"]
    dated = [
        o
        for o in read_observations(years, "AA39")
        if o.clipped_share < BRIGHT and o.taken_at is not None
    ]
    taken = sorted(dated, key=day_of)
    days = sorted({day_of(o) for o in taken})
    print(
        "| parted | judges | before: by their own side's surface / by the other's | after: likewise"
        " | advantage of the own side's, 95 % over days | surfaces differ by [mm] |\n| --- | --- |"
        " --- | --- | --- | --- |"
    )
    for part in range(1, PARTS):
        date = day_of(taken[len(taken) * part // PARTS])
        row(
            f"at {date}",
            heliostat,
            [[o for o in taken if (day_of(o) >= date) == later] for later in (False, True)],
        )
    in_turn = [[o for o in taken if days.index(day_of(o)) % 2 == odd] for odd in (0, 1)]
    row("day by day, in turn", heliostat, in_turn)
    return 0


if __name__ == "__main__":
    with recording("changed"):
        status = main()
    sys.exit(status)
