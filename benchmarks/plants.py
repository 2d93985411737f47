"""Other plants against other tools: ``python -m benchmarks.plants``.

- Rounds A and B of Wang et al. (Solar Energy 195, 2020): intercept against the median of six ray
  tracers. Their circumsolar ratio is the true share of the aureole.
- Round C: the whole field of 522 heliostats, and the same field turned by 180 degrees.
- SolarPILOT: each of 904 heliostats of a 50 MW field at Daggett around a cylinder.
- Published layouts: from the plant's file to the first map, and whether energy closes.

Reads the plants from ``HELIOTWIN_PLANTS``, by default ``../shared/plants``.
"""

import csv
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np
import torch

from benchmarks.record import Estimate, log_row, recording
from heliotwin.field import FieldRequest, trace_field
from model.fleet import Losses, Superposition, aligned_field, field_losses, superpose, tiles
from model.frames import sun_direction
from model.heliostat_type import Canting, HeliostatType, MountDesign, facet_grid
from model.plant import Cylinder, Heliostat, MirrorOptics, Receiver, TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.site import JUELICH
from model.sunshape import Buie, Gaussian, Pillbox, SunShape
from model.sunshape.buie import chi_of_csr
from model.surface import control_points
from model.tracing import Optics
from service.base.progress import no_progress
from service.sources.plant_file import read_plant
from tests.service.sources import plant_files

Array = np.ndarray
UP = np.array([0.0, 0.0, 1.0])
TOOLS = ("heliosim", "solarpilot", "solstice", "soltrace", "tonatiuh", "tracer")


def traced(
    heliostats: dict[str, Heliostat],
    receiver: Receiver,
    sun: Array,
    optics: Optics,
    aims: dict[str, Array] | None = None,
) -> dict[str, Losses]:
    """Losses of heliostats that shade and block each other."""
    model = PlantModel(JUELICH, optics)
    goals = aims or {name: receiver.aim_of(one.position) for name, one in heliostats.items()}
    around = aligned_field([(one, goals[name]) for name, one in heliostats.items()], sun, model)
    setups = [
        Setup(one, control_points(one), sun, receiver.middle, aim=goals[name])
        for name, one in heliostats.items()
    ]
    task = Superposition(receiver, model, (96, 128), samples=24)
    return superpose(task, tiles(setups, around)).losses


def mirror(slope_error_mrad: float, side: float = 10.0, **optics: float) -> HeliostatType:
    """A square mirror that is focused as a whole, on an azimuth-elevation mount."""
    facets = facet_grid(1, 1, side, side, 0.0)
    errors = MirrorOptics(slope_error=slope_error_mrad * 1e-3, **optics)
    return HeliostatType("one", facets, MountDesign(), "slant_range", Canting("flat"), errors)


# --- six tools
# --------------------------------------------------------------------------------------------------


def tool_medians(letter: str) -> dict[str, float]:
    """Median over the tools of the intercept [%] by case; tools without a case say zero."""
    found: dict[str, list[float]] = {}
    for tool in TOOLS:
        path = plant_files.published() / "six-tools" / f"{letter}_{tool}_summary.csv"
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                incoming, absorbed = float(row["Qin (kW)"]), float(row["Qabs (kW)"])
                if incoming:
                    found.setdefault(row["Case name"], []).append(100 * absorbed / incoming)
    return {case: median(values) for case, values in found.items()}


def round_a() -> Iterator[tuple[str, float]]:
    """Cases of round A with our intercept [%]."""
    board = TargetPlane("board", np.array([0, 0, 500.0]), -UP, np.array([0, 1.0, 0]), 8.0, 8.0)
    point = Pillbox(1e-6)
    aureoles = {f"{n}": Buie(chi_of_csr(csr)) for n, csr in enumerate((0.01, 0.02, 0.03), start=1)}
    cases: dict[str, tuple[float, SunShape]] = {
        **{f"A_1.2.{n}": (float(n), point) for n in (1, 2, 3)},
        "A_2.1": (0.0, Pillbox(4e-3)),
        "A_2.2": (0.0, Gaussian(4e-3)),
        **{f"A_2.3.{n}": (0.0, sun) for n, sun in aureoles.items()},
    }
    for case, (slope_error, sun) in cases.items():
        heliostat = mirror(slope_error).heliostat("H", (0, 0, 0), board.center)
        yield case, 100 * traced({"H": heliostat}, board, UP, Optics(sun))["H"].intercept


def round_b() -> Iterator[tuple[str, float]]:
    """Cases of round B with our intercept [%]."""
    board = TargetPlane("board", np.array([0, 0, 62.0]), np.array([0, 1.0, 0]), UP, 8.0, 6.0)
    feet = [(0, 46.5, 0), (0, 536.9, 0), (-324.3, 427.9, 0), (252.5, 118.1, 0)]
    for shape, sun in enumerate((Pillbox(4.65e-3), Buie(chi_of_csr(0.02))), start=1):
        for place, angles in enumerate(((180.0, 78.0), (76.0, 22.0)), start=1):
            for number, foot in enumerate(feet, start=1):
                heliostat = mirror(2.0).heliostat("H", foot, board.center)
                found = traced({"H": heliostat}, board, sun_direction(*angles), Optics(sun))
                yield f"B_{shape}.{place}.{number}", 100 * found["H"].intercept


def six_tools() -> None:
    """Print rounds A and B."""
    print("Intercept [%] against the median of six tools\n")
    for letter, cases in (("A", round_a()), ("B", round_b())):
        medians, worst, count = tool_medians(letter), 0.0, 0
        for case, ours in cases:
            difference = ours - medians[case]
            worst, count = max(worst, abs(difference)), count + 1
            print(f"{case:8} {ours:7.2f} {medians[case]:7.2f} {difference:+6.2f}")
        log_row(
            "Intercept against six ray tracers",
            f"round {letter}",
            {"largest difference [points]": Estimate(worst, goal="<= 0.3")},
            n=count,
            of="cases",
            compared_with="median of six tools (Wang et al. 2020)",
        )
    print()


def whole_field() -> None:
    """Print round C, and the same turned by 180 degrees."""
    print("Round C: absorbed power, and losses in percent of the light on the mirrors")
    known = {"180": 32858.6, "76": 22899.1}
    with tempfile.TemporaryDirectory() as folder:
        plant = read_plant(plant_files.round_c(Path(folder)))
    heliostats = plant.plant.heliostats
    board = plant.receivers["board"]
    turn = np.diag([-1.0, -1.0, 1.0])
    kind = plant.types["ideal"]
    turned = {
        name: kind.heliostat(
            name, turn @ one.position, turn @ board.center, one.facets[0].focal_length
        )
        for name, one in heliostats.items()
    }
    south = TargetPlane("board", turn @ board.center, -board.normal, UP, 8.0, 6.0, 0.9)
    for azimuth, elevation in ((180.0, 78.0), (76.0, 22.0)):
        sun = sun_direction(azimuth, elevation)
        pair = [
            field_losses(traced(some, onto, direction, plant.optics).values())
            for some, onto, direction in ((heliostats, board, sun), (turned, south, turn @ sun))
        ]
        absorbed = [one.area * one.efficiency for one in pair]
        lost = [np.array([one.cosine, one.shading, one.blocking, one.intercept]) for one in pair]
        apart = np.abs(lost[1] - lost[0]) / np.maximum(1 - lost[0], 1e-4)
        reference = known[f"{azimuth:.0f}"]
        print(
            f"sun {azimuth:.0f}: {absorbed[0]:.1f} kW, {100 * (absorbed[0] / reference - 1):+.3f} %"
            f" of {reference} kW; turned {100 * (absorbed[1] / absorbed[0] - 1):+.3f} %, losses"
            f" {100 * apart.max():.2f} % apart"
        )
        log_row(
            "Round C",
            f"sun {azimuth:.0f}",
            {
                "absorbed [kW]": absorbed[0],
                "turned, absorbed [%]": Estimate(
                    100 * abs(absorbed[1] / absorbed[0] - 1), goal="<= 0.3"
                ),
                "turned, largest difference of a loss [%]": Estimate(
                    100 * apart.max(), goal="<= 2"
                ),
            },
            n=len(heliostats),
            of="heliostats",
            compared_with="the same field turned by 180 degrees",
        )
    print()


# --- SolarPILOT
# --------------------------------------------------------------------------------------------------


def solarpilot() -> None:
    """Print the differences from SolarPILOT's factors of each heliostat."""
    path = plant_files.published() / "halos" / "radial-daggett-50.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))

    def columns(*names: str) -> Array:
        return np.array([[float(row[name]) for name in names] for row in rows])

    feet, aims = columns("Pos-x", "Pos-y", "Pos-z"), columns("Aim-x", "Aim-y", "Aim-z")
    normals, out = columns("Track-x", "Track-y", "Track-z"), aims - feet
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    sun = np.median(2 * (normals * out).sum(axis=1, keepdims=True) * normals - out, axis=0)
    sun /= np.linalg.norm(sun)
    radius = float(np.hypot(*aims[:, :2].T).mean())
    receiver = Cylinder("main", np.array([0, radius, 150.0]), np.array([0, 1.0, 0]), UP, radius, 21)
    kind = mirror(1.53, 12.2, reflectance=0.95 * 0.95, pointing_error=2e-4)
    heliostats = {
        f"H{n}": kind.heliostat(f"H{n}", foot, aim)
        for n, (foot, aim) in enumerate(zip(feet, aims, strict=True))
    }
    optics = Optics(Pillbox(), attenuation=(0.006789, 0.1046, -0.0170, 0.002845))
    given = {name: aims[n] for n, name in enumerate(heliostats)}
    losses = list(traced(heliostats, receiver, sun, optics, given).values())
    pairs = {
        "cosine": ([one.cosine for one in losses], columns("Cosine eff")[:, 0], "<= 0.0002"),
        "attenuation": (
            [one.attenuation for one in losses],
            columns("Attenuation")[:, 0],
            "<= 0.0002",
        ),
        "shading times blocking": (
            [one.shading * one.blocking for one in losses],
            columns("Shading", "Blocking").prod(axis=1),
            "<= 0.003",
        ),
        "intercept": (
            [one.intercept for one in losses],
            columns("Intercept eff.")[:, 0],
            "<= 0.01",
        ),
    }
    print(f"SolarPILOT's factors of {len(rows)} heliostats: mean and largest difference")
    for name, (ours, theirs, goal) in pairs.items():
        apart = np.abs(np.array(ours) - theirs)
        print(f"{name:24} {apart.mean():.5f} {apart.max():.5f}")
        log_row(
            "Factors of each heliostat",
            name,
            {
                "mean difference": Estimate(apart.mean(), goal=goal),
                "largest difference": apart.max(),
            },
            n=len(rows),
            of="heliostats",
            compared_with="SolarPILOT (HALOS sample field)",
        )
    print()


# --- published layouts
# --------------------------------------------------------------------------------------------------


def layouts() -> None:
    """Print the time from a plant's file to its first map, and how well energy closes."""
    print("Published layouts: seconds of processor from file to map, map against sums")
    asked = {"gemasolar": "main", "solar_two": "main", "ps10": "cavity"}
    for name, receiver in asked.items():
        with tempfile.TemporaryDirectory() as folder:
            path = getattr(plant_files, name)(Path(folder))
            began, clock = time.process_time(), time.perf_counter()
            plant = read_plant(path)
            found = trace_field(plant, FieldRequest(receiver, 180.0, 60.0, 1000.0), no_progress)
            taken, waited = time.process_time() - began, time.perf_counter() - clock
        areas = plant.receivers[receiver].grid(*found.flux.shape).areas
        total = found.report["field"]
        closes = float((found.flux * areas).sum()) / total["intercepted_w"] - 1
        print(
            f"{name:10} {total['heliostats']} heliostats: {taken:.1f} s, {waited:.1f} s of the"
            f" clock; {closes:+.1e}"
        )
        log_row(
            "Published layouts",
            name.replace("_", " "),
            {
                "processor time [s]": taken,
                "time of the clock [s]": Estimate(waited, goal="<= 30"),
                "map against sums": Estimate(abs(closes), goal="<= 0.001"),
            },
            n=int(total["heliostats"]),
            of="heliostats",
        )


def main() -> None:
    """Print the tables."""
    torch.set_num_threads(2)
    six_tools()
    whole_field()
    solarpilot()
    layouts()


if __name__ == "__main__":
    with recording("plants"):
        main()
