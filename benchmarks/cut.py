"""Spots that run over their target's edge, on real photographs: ``python -m benchmarks.cut``.

Photographs of AA39 (``../shared/stj-years``) are cropped on one side after the other. It is as if
the target ended within the spot, so that a share of its light misses the target. The rest is
measured and compared with the forecast by the measured surface. The mirror is turned until the
centre of the light on the target is where it was measured and, for comparison, until the centre of
all light is there. The photograph's quality has an estimate of the share, which is printed too.
"""

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.record import log_row, recording
from model.forecast import View, align
from model.imaging import MeasuredFlux, measure, quality
from model.metrics import compare_on_target
from model.plant import TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.site import Site
from model.sunshape import Buie
from model.tracing import Optics
from service.sources.decode import Pixels, decode_image
from service.sources.folder import read_folder

SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
SIDES = ("left", "right", "top", "bottom")
VIEW = View(256, 256, samples=24, padding=0.5, cones="facet")

Array = NDArray[np.float64]


def line_at(flux: NDArray[np.float32], side: str, share: float) -> float:
    """Where, in shares of the target from its left or top, a line cuts that share of the light off
    at a side.
    """
    line = flux.sum(axis=0 if side in ("left", "right") else 1, dtype=np.float64)
    before = np.concatenate([[0.0], np.cumsum(line)]) / line.sum()
    wanted = share if side in ("left", "top") else 1 - share
    return 0.0 if share == 0 else float(np.interp(wanted, before, np.linspace(0, 1, len(before))))


def shortened(
    plane: TargetPlane, image: Pixels, side: str, at: float
) -> tuple[TargetPlane, Pixels]:
    """The target that ends at a line, and what is left of an image of it."""
    rows, columns = image.shape[:2]
    low, high = (at, 1.0) if side in ("left", "top") else (0.0, at or 1.0)
    if side in ("left", "right"):
        edges = round(low * columns), round(high * columns)
        size, left = (edges[1] - edges[0]) / columns, image[:, slice(*edges)]
        center = plane.to_enu(
            np.array([((edges[0] + edges[1]) / 2 / columns - 0.5) * plane.width, 0.0])
        )
        return replace(plane, center=center, width=size * plane.width), left
    edges = round(low * rows), round(high * rows)
    size, left = (edges[1] - edges[0]) / rows, image[slice(*edges)]
    center = plane.to_enu(np.array([0.0, (0.5 - (edges[0] + edges[1]) / 2 / rows) * plane.height]))
    return replace(plane, center=center, height=size * plane.height), left


def accuracies(
    setup: Setup, whole: TargetPlane, taken: MeasuredFlux, site: Site
) -> tuple[float, float]:
    """Of the forecast whose light on the target, and of that whose light in all, has its centre
    where it was seen.
    """
    assert taken.flux is not None
    large = replace(whole, width=20.0, height=20.0, center=setup.plane.center)
    model = PlantModel(site, Optics(Buie(0.02)))
    size, scores = (setup.plane.width, setup.plane.height), []
    for plane in (setup.plane, large):
        aligned = align([replace(setup, plane=plane)], model)
        if plane is large:  # the mount of the large target before the one that ends early
            mount = aligned.angles[0]
            aligned = align([replace(setup, spot=None, angles=mount)], model)
        forecast = aligned.flux(VIEW)[0].clamp(min=0).numpy()
        scores.append(compare_on_target(taken.flux, forecast, size).accuracy)
    return scores[0], scores[1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--every", type=int, default=4, help="every so-manieth photograph")
    options = parser.parse_args()
    quality._LIMIT_CUT = 1.0  # the limit is what is looked for
    folder = read_folder(data_folder().parent / "stj-years")
    surface = folder.measured_surface("AA39")
    assert surface is not None
    points, degree = surface[:2]
    crops = [one for one in folder.measurements("AA39") if "cropped" in one.images][
        :: options.every
    ]
    found: dict[float, list[tuple[float, float, float]]] = {share: [] for share in SHARES}
    for number, one in enumerate(crops):
        image, plane = (
            decode_image(one.images["cropped"].read_bytes()),
            folder.plant.targets[one.target],
        )
        whole = measure(image, "cropped", plane)
        if whole.flux is None:
            continue
        side = SIDES[number % len(SIDES)]
        for share in SHARES:
            target, left = shortened(plane, image, side, line_at(whole.flux, side, share))
            taken = measure(left.copy(), "cropped", target)
            if taken.center_of_mass is None:
                continue
            spot = target.to_enu(taken.center_of_mass)
            setup = Setup(
                folder.plant.heliostats["AA39"],
                points,
                one.to_sun,
                target,
                spot=spot,
                degree=degree,
            )
            found[share].append(
                (taken.quality.cut_share, *accuracies(setup, plane, taken, folder.model.site))
            )
    print(
        "| light beside the target | photographs | taken for | accuracy, aligned by the part shown"
        " | by all light |"
    )
    print("| --- | --- | --- | --- | --- |")
    for share, rows in found.items():
        cut, shown, old = np.mean(rows, axis=0)
        print(f"| {share:.0%} | {len(rows)} | {cut:.0%} | {shown:.3f} | {old:.3f} |")
        log_row(
            "Spots that the target truncates",
            f"{share:.0%} of the light beside the target",
            {
                "estimated share [%]": 100 * cut,
                "accuracy, aligned by the part shown": shown,
                "accuracy, aligned by all light": old,
            },
            n=len(rows),
            of="photographs",
            compared_with="forecasts by the measured surface",
        )


if __name__ == "__main__":
    with recording("cut"):
        main()
