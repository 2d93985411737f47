"""Real mirrors together: ``python -m benchmarks.mirrors``.

AA31, AA39, AA23 and AC43 from photographs as PAINT published them, with PAINT's camera declared.
Surfaces from all photographs are compared with deflectometry. Each photograph is left out in turn,
and forecast by the surface from the others, by deflectometry and by the ideal mirror. Errors are
of the control heights, as in sim-to-real iDLR, with each facet's tilt and without.

The shipped network and prior have learnt AA23. So it is judged by the prior of the other training
mirrors, and has no network. Its motors are off, so all mirrors are aligned by their spots. AC43 is
STJ-012 of the measured surfaces, from which neither network nor prior has learnt.

`heliotwin forecast` without options shows what the chosen camera is worth beside images as light.

Mirrors may be named: ``python -m benchmarks.mirrors AA31``. Then nothing is recorded of the others.
"""

import json
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.folders import read_observations
from benchmarks.record import Estimate, log_row, recording
from heliotwin.folder_forecast import forecast_folder
from model.metrics import surface_error
from model.network.architecture import MAX_IMAGES
from model.network.predictor import default_predictor
from model.observation import Observation, SurfacePrediction, misfits, spread_suns
from model.plant import Heliostat
from model.plant_model import JUELICH_MODEL
from model.prior import SurfacePrior, default_prior
from model.refinement import RefinementOptions, refine
from model.surface import split_canting
from service.sources.folder import measured_heights, read_folder
from training.prior import estimate
from training.surfaces import load_part

Array = NDArray[np.float64]

MIRRORS = ("AA31", "AA39", "AA23", "AC43")
LEARNT = "AA23"
FEW = (2, 4)
WITHIN_90 = 1.645
NEAR = (0, 10, 20, 40, 90)
"""Angles [deg] between the sun of a photograph and the nearest one that its surface knows."""

OF_PAINT = ("AA31", "AA39", "AC43")
CAMERAS = "Forecasts by deflectometry with default settings, mean accuracy"
ALL = "Surfaces from all photographs"
COUNTS = "Surfaces from few photographs, suns far apart"
LEFT_OUT = "Each photograph left out in turn: flux accuracy, mean"
DISTANCES = "Flux accuracy by the angle to the nearest sun that the surface knows, mean"
REFERENCE = "deflectometry"
GOAL = ">= 0.92"


class Mirror(NamedTuple):
    """A real mirror with its deflectometry (4, 8, 8) [m], its photographs and its prior."""

    heliostat: Heliostat
    truth: Array
    taken: list[Observation]
    prior: SurfacePrior
    has_network: bool


def read_mirrors(root: Path, names: Sequence[str]) -> dict[str, Mirror]:
    """Mirrors of a folder whose images are PAINT's differences of counts."""
    training, known = load_part(root, "training")
    with TemporaryDirectory() as directory:
        linked = _linked(root, Path(directory) / "stj", {"cameras": [{}]})
        folder, found = read_folder(linked, list(names)), dict[str, Mirror]()
        for name in names:
            heliostat, own = folder.plant.heliostats[name], folder.measured_surface(name)
            learnt = name == LEARNT
            others = training[[one != name for one in known]]
            found[name] = Mirror(
                heliostat,
                training[known.index(name)] if own is None else measured_heights(heliostat, own),
                read_observations(folder, name),
                estimate(others) if learnt else default_prior(),
                not learnt,
            )
    return found


def _linked(root: Path, to: Path, declared: dict[str, object] | None) -> Path:
    """A folder of links to a folder's files, with what it declares."""
    to.mkdir()
    for path in root.iterdir():
        (to / path.name).symlink_to(path.resolve())
    if declared is not None:
        (to / "twin.json").write_text(json.dumps({"declared": declared}))
    return to


def surfaces(
    mirror: Mirror, used: list[Observation], *, intervals: bool = True
) -> dict[str, SurfacePrediction]:
    """Surfaces from some photographs: of the network, if it has not learnt it, and refined."""
    heliostat, prior = mirror.heliostat, mirror.prior
    found, options = {}, RefinementOptions(with_half_samples=intervals)
    if mirror.has_network:
        few = spread(used, MAX_IMAGES)
        found["network"] = default_predictor().predict(heliostat, few, JUELICH_MODEL)
    start = found["network"].z if found else None
    refined = refine(heliostat, used, JUELICH_MODEL, start, prior=prior, options=options)
    return found | {"refined": refined}


def spread(taken: list[Observation], count: int) -> list[Observation]:
    """So many photographs whose suns stand far apart."""
    return [taken[i] for i in spread_suns(np.array([o.sun for o in taken]), count)]


def accuracies(mirror: Mirror, seen: list[Observation], z: Array) -> Array:
    """Flux accuracies (M,) of heights (4, 8, 8) [m] on photographs."""
    return 1 - np.array(misfits(mirror.heliostat, seen, z, JUELICH_MODEL))


def log_errors(
    table: str, row: str, mirror: Mirror, found: SurfacePrediction, goal: str | None = None
) -> None:
    """Print and record how far a surface is from deflectometry."""
    error = 1e3 * surface_error(found.z, mirror.truth)
    waviness = 1e3 * surface_error(split_canting(found.z)[1], split_canting(mirror.truth)[1])
    inside = np.abs(found.z - mirror.truth) < WITHIN_90 * found.z_std
    cells = {
        "error, with each facet's tilt [mm]": Estimate(error, goal=goal),
        "error, without [mm]": waviness,
        "standard deviation, mean [mm]": 1e3 * found.z_std.mean(),
        "heights within 90 % intervals [%]": 100 * inside.mean(),
        "accuracy on others": 1 - _mean_misfit(mirror, found),
    }
    print(
        row, {name: f"{getattr(one, 'value', one):.3f}" for name, one in cells.items()}, flush=True
    )
    log_row(table, row, cells, n=len(found.used), of="photographs", compared_with=REFERENCE)


def _mean_misfit(mirror: Mirror, found: SurfacePrediction) -> float:
    others = [o for o in mirror.taken if o.identifier not in found.used]
    return 1 - float(accuracies(mirror, others, found.z).mean()) if others else np.nan


def leave_out(mirror: Mirror) -> tuple[dict[str, Array], Array]:
    """Accuracies (M,) by each surface on each photograph that it does not know, and the angles
    (M,) [deg] to the nearest sun that it knows.
    """
    suns = np.array([o.sun for o in mirror.taken])
    cosines = suns @ suns.T
    np.fill_diagonal(cosines, -1)
    fixed = {"ideal": np.zeros_like(mirror.truth), REFERENCE: mirror.truth}
    found = {name: accuracies(mirror, mirror.taken, z) for name, z in fixed.items()}
    for place, one in enumerate(mirror.taken):
        others = [o for o in mirror.taken if o is not one]
        for name, surface in surfaces(mirror, others, intervals=False).items():
            known = found.setdefault(name, np.full(len(suns), np.nan))
            known[place] = accuracies(mirror, [one], surface.z)[0]
    return found, np.degrees(np.arccos(cosines.max(axis=1).clip(-1, 1)))


def log_accuracies(table: str, row: str, found: dict[str, Array], goal: str | None = None) -> None:
    """Print and record mean accuracies by each surface, of values (M,)."""
    cells = {
        name: Estimate(
            float(values.mean()), goal=goal if name == "refined" else None, n=len(values)
        )
        for name, values in found.items()
        if len(values) and np.isfinite(values).all()
    }
    print(row, {name: f"{one.value:.3f}" for name, one in cells.items()}, flush=True)
    log_row(table, row, cells, of="photographs")


def log_cameras(root: Path) -> None:
    """Print and record accuracies by the command line's own forecasts, as light and as chosen."""
    found: dict[str, dict[str, list[float]]] = {name: {} for name in OF_PAINT}
    as_light: dict[str, object] = {"cameras": []}
    for camera, declared in (("as light", as_light), ("camera chosen", None)):
        with TemporaryDirectory() as directory:
            folder = read_folder(_linked(root, Path(directory) / "stj", declared), list(OF_PAINT))
            report = forecast_folder(folder, Path(directory) / "out")["measurements"]
            for name in OF_PAINT:
                for one in folder.measurements(name, with_images=False):
                    if "accuracy" in report[one.key]:
                        shown = "whole images" if "flux" in one.images else "centred images"
                        judged = found[name].setdefault(f"{shown}, {camera}", [])
                        judged.append(report[one.key]["accuracy"])
    for name, by_camera in found.items():
        log_accuracies(CAMERAS, name, {case: np.array(one) for case, one in by_camera.items()})
    means = {
        case: Estimate(
            fmean(fmean(one[case]) for one in found.values()),
            goal=">= 0.89" if case.endswith("chosen") else None,
        )
        for case in found[OF_PAINT[0]]
        if all(case in one for one in found.values())
    }
    print("mean of mirrors", {case: f"{one.value:.3f}" for case, one in means.items()})
    log_row(CAMERAS, "mean of mirrors", means, n=len(found), of="mirrors")


def main(names: list[str]) -> None:
    """Print and record the tables."""
    root = data_folder()
    if not (root / "AA31").is_dir():
        print(f"mirrors: no real measurements at {root}; set HELIOTWIN_STJ")
        return
    with recording("mirrors"):
        if not names:
            log_cameras(root)
        judged: dict[str, list[Array]] = {}
        angles: list[Array] = []
        for name, mirror in read_mirrors(root, names or MIRRORS).items():
            for method, found in surfaces(mirror, mirror.taken).items():
                log_errors(ALL, f"{name}, {method}", mirror, found)
            for count in (few for few in FEW if few < len(mirror.taken)):
                for method, found in surfaces(mirror, spread(mirror.taken, count)).items():
                    log_errors(COUNTS, f"{name}, {count} photographs, {method}", mirror, found)
            by_surface, nearest = leave_out(mirror)
            log_accuracies(LEFT_OUT, name, by_surface, GOAL)
            angles.append(nearest)
            for method, values in by_surface.items():
                judged.setdefault(method, []).append(values)
        together = {method: np.concatenate(parts) for method, parts in judged.items()}
        log_accuracies(LEFT_OUT, "all", together, GOAL)
        nearest = np.concatenate(angles)
        for low, high in pairwise(NEAR):
            some = (nearest >= low) & (nearest < high)
            rows = {m: v[some] for m, v in together.items() if len(v) == len(some)}
            if some.any():
                log_accuracies(DISTANCES, f"{low} to {high} deg", rows)


if __name__ == "__main__":
    main(sys.argv[1:])
