"""Photographs sent for the wrong heliostat: ``python -m benchmarks.swaps [--margin 0.1]
[--time]``.

Real photographs of AA39, AC43, AD37 and AA23 (``../shared/stj-years``, ``../shared/stj``) are
compared with surfaces that the network predicts from the other half of each heliostat's
photographs, and with the measured surfaces of 47 more mirrors (``surfaces.npz``) and of AA28.
Mirrors without a known place are put at places near AA39.

Each photograph is judged as one of the true heliostat (a warning is a false alarm) and as one of
every other mirror (a warning is a hit). Each time it is compared with `CANDIDATES` others drawn at
random, with the true heliostat among them or without. The usual accuracy of a heliostat is the
median of its photographs. It is unknown for mirrors without photographs.

``--time`` prints what the comparison adds to the time of a post.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.folders import read_accepted
from benchmarks.record import Estimate, log_row, recording
from model.metrics import flux_accuracies
from model.plant import Heliostat
from service.sources.decode import decode_image
from service.sources.folder import measured_heights, read_folder
from service.twin import operations
from service.twin.measurements import AcceptedMeasurement, choose_diverse
from service.twin.photographs import likeness
from training.render import TOWER_TOP
from training.surfaces import load_surfaces

Array = NDArray[np.float64]

PHOTOGRAPHED = ("AA39", "AC43", "AD37", "AA23")
DRAWS = 20
LABELS = {
    "measure": "measure",
    "forecast": "forecast as its heliostat's",
    "others": f"forecast as each of {likeness.CANDIDATES} others'",
}
NEAR = 200
"""Anonymous mirrors stand at places drawn among so many that are nearest to AA39's."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs of the heliostats, and the accuracy [1] of each by the surfaces of M mirrors.

    Attributes
    ----------
    owners : list of str (N,)
    accuracies : dict of (N,) arrays
        By the mirror's name; a heliostat's own photographs by a surface that was not made from
        them.
    """

    owners: list[str]
    accuracies: dict[str, Array]

    def usual(self, mirror: str) -> float | None:
        """Median accuracy of a mirror's photographs; None if they are fewer than five."""
        own = self.accuracies[mirror][np.array(self.owners) == mirror]
        return float(np.median(own)) if len(own) >= 5 else None


def read_photographs() -> dict[str, list[AcceptedMeasurement]]:
    """Accepted photographs by heliostat, each once."""
    root, found = data_folder(), dict[str, dict[str, AcceptedMeasurement]]()
    for folder in (read_folder(root.parent / "stj-years"), read_folder(root)):
        for name in set(PHOTOGRAPHED) & set(folder.plant.heliostats):
            for one in read_accepted(folder, name):
                found.setdefault(name, {}).setdefault(one.identifier, one)
    return {name: list(found[name].values()) for name in PHOTOGRAPHED}


def measured_mirrors(heliostats: dict[str, Heliostat]) -> dict[str, tuple[Heliostat, Array]]:
    """Mirrors that deflectometry measured, but for those of `PHOTOGRAPHED`, with their heights."""
    root, rng = data_folder(), np.random.default_rng(0)
    folder, (surfaces, names) = read_folder(root), load_surfaces(root)
    measured = folder.measured_surface("AA28")
    assert measured is not None
    mirrors = {"AA28": (heliostats["AA28"], measured_heights(heliostats["AA28"], measured))}
    field = json.loads((root / "field-positions.json").read_text(encoding="utf-8"))
    places = {name: np.array(entry["position_enu"]) for name, entry in field.items()}
    home = heliostats["AA39"].position
    near = sorted(places.values(), key=lambda place: float(np.linalg.norm(place - home)))[
        1 : NEAR + 1
    ]
    for name, z, drawn in zip(names, surfaces, rng.permutation(NEAR), strict=False):
        if name not in mirrors and name not in PHOTOGRAPHED:
            place = places.get(name, near[drawn])
            focus = float(np.linalg.norm(place - TOWER_TOP))
            mirrors[name] = (Heliostat.juelich(name, place, focus), z)
    return mirrors


def compare() -> Photographs:
    """Forecast every photograph by every mirror."""
    photographs, folder = read_photographs(), read_folder(data_folder())
    plant = folder.plant
    every = [one.observation() for own in photographs.values() for one in own]
    measured = np.array([one.flux for one in every])

    def accuracies(heliostat: Heliostat, z: Array) -> Array:
        return flux_accuracies(measured, operations.render(heliostat, every, z, folder.model))

    found = {
        name: accuracies(*mirror) for name, mirror in measured_mirrors(plant.heliostats).items()
    }
    owners = [name for name, own in photographs.items() for _ in own]
    for name, own in photographs.items():
        halves = []
        for half in (0, 1):
            made_from = choose_diverse([one.observation() for one in own[half::2]], 8)
            heliostat = plant.heliostats[name]
            surface = operations.predict(heliostat, made_from, folder.model)
            halves.append(accuracies(heliostat, surface.z))
        found[name] = halves[1]
        places = np.flatnonzero(np.array(owners) == name)
        found[name][places[1::2]] = halves[0][places[1::2]]
    return Photographs(owners, found)


def judge(
    photographs: Photographs, place: int, claimed: str, candidates: Sequence[str]
) -> str | None:
    """The heliostat that a photograph is like instead of the ``claimed`` one, or None."""
    own = float(photographs.accuracies[claimed][place])
    if not likeness.is_suspicious(own, photographs.usual(claimed)):
        return None
    return likeness.find_like(
        own, {name: float(photographs.accuracies[name][place]) for name in candidates}
    )


def report(photographs: Photographs, used: float) -> None:
    """Print false alarms and hits; ``used`` is the margin of the service."""
    rng, mirrors = np.random.default_rng(1), list(photographs.accuracies)
    alarms: dict[str, list[bool]] = {name: [] for name in PHOTOGRAPHED}
    named: list[tuple[bool, bool]] = []
    absent: list[bool] = []
    for place, owner in enumerate(photographs.owners):
        for claimed in mirrors:
            others = [name for name in mirrors if name not in (claimed, owner)]
            for _ in range(DRAWS if claimed == owner else 1):
                drawn = [
                    str(name) for name in rng.choice(others, likeness.CANDIDATES, replace=False)
                ]
                like = judge(photographs, place, claimed, drawn)
                if claimed == owner:
                    alarms[owner].append(like is not None)
                    continue
                absent.append(like is not None)
                like = judge(photographs, place, claimed, [owner, *drawn[1:]])
                named.append((like is not None, like == owner))
    every = [alarm for own in alarms.values() for alarm in own]
    print(
        f"{len(photographs.owners)} photographs, {len(mirrors)} mirrors, {likeness.CANDIDATES}"
        " others compared"
    )
    for name in PHOTOGRAPHED:
        own = photographs.accuracies[name][np.array(photographs.owners) == name]
        print(
            f"  {name}: {len(own)} photographs, median accuracy {np.median(own):.3f}, least"
            f" {own.min():.3f}"
        )
    print(
        "false alarms: " + ", ".join(f"{name} {np.mean(own):.2%}" for name, own in alarms.items()),
        end="",
    )
    print(f", all {np.mean(every):.2%}")
    warned, right = np.mean(named, axis=0)
    print(
        f"swapped, true heliostat among the others: {warned:.1%} warned of, {right:.1%} with the"
        " right name"
    )
    print(f"swapped, true heliostat not among them: {np.mean(absent):.1%} warned of")
    log_row(
        "Photographs sent for the wrong heliostat, by the margin",
        f"margin {likeness.MARGIN:g}" + " (used)" * (used == likeness.MARGIN),
        {
            "false alarms [%]": Estimate(100 * np.mean(every), goal="<= 2"),
            "warned, true heliostat compared [%]": 100 * warned,
            "warned with the right name [%]": 100 * right,
            "warned, true heliostat not compared [%]": 100 * np.mean(absent),
        },
        n=len(photographs.owners),
        of="photographs",
        compared_with="the true heliostat",
    )


def timing() -> None:
    """Print the time to measure a photograph, to forecast it, and to compare it with others."""
    folder = read_folder(data_folder().parent / "stj-years")
    heliostat = folder.plant.heliostats["AA39"]
    one = next(one for one in folder.measurements("AA39") if "cropped" in one.images)
    data, z = one.images["cropped"].read_bytes(), np.zeros((4, 8, 8))
    accepted = {one.identifier: one for one in read_accepted(folder, "AA39")}
    observation = accepted[one.external_id].observation()

    def measure() -> object:
        pixels = decode_image(data, max_pixels=10**8)
        return operations.measure(pixels, "cropped", folder.plant.targets[one.target])

    def forecast() -> object:
        return operations.render(heliostat, [observation], z, folder.model)

    def others() -> object:
        return [forecast() for _ in range(likeness.CANDIDATES)]

    for work in (measure, forecast, others):
        work()
        taken = []
        for _ in range(21):
            began = time.process_time()
            work()
            taken.append(time.process_time() - began)
        print(f"{work.__name__}: {1e3 * np.median(taken):.1f} ms of processor time")
        cells = {"processor [ms]": 1e3 * np.median(taken)}
        log_row("Time of a photograph", LABELS[work.__name__], cells, n=len(taken), of="repeats")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--margin", type=float, nargs="+", default=[likeness.MARGIN], help="margins to try [1]"
    )
    parser.add_argument("--time", action="store_true")
    options = parser.parse_args()
    if options.time:
        with recording("swaps-time"):
            timing()
        return
    with recording("swaps"):
        report_margins(options.margin)


def report_margins(margins: Sequence[float]) -> None:
    """Print the figures of each margin."""
    photographs, used = compare(), likeness.MARGIN
    for margin in margins:
        likeness.MARGIN = margin
        print(
            f"\nmargin {margin:g}, least accuracy {likeness.MIN_ACCURACY:g}, drop {likeness.DROP:g}"
        )
        report(photographs, used)


if __name__ == "__main__":
    main()
