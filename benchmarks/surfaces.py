"""Surfaces against deflectometry: ``python -m benchmarks.surfaces``.

Rendered: AA28, AA39 and AC43 as deflectometry has them, 20 x 20 heights a facet, at their own
places, under suns and on targets of real photographs, traced by Monte Carlo with one per cent of
noise; by the network and refined, from the prior's mean and from the truth, without ripples, and by
the generic prior; then the same mirrors, larger by half, of whose facets there is no other prior;
then smoothed to the 8 x 8 heights that errors are of.

Real: AA39 of two years, from sets of its photographs, some of which contradict the others; flux
accuracy on photographs that no set holds. Errors are those of the control heights, the mirror's
tilt and canting counted. AC43 is STJ-012 of the measured surfaces, from which neither network nor
prior has learnt.

``--only scaling``: the time that AA39 takes from 8 to 64 images.

``--only far``: the same surfaces on heliostats 300 to 600 m away, whose spots spill out of the
smallest window, by images of that and of the one that is chosen, on a target that holds all.

``--only photographs``: what AA39's surfaces gain by photographs that the camera's range clipped or
the target cut, and by leaving out those that contradict the others, as the service does; and
whether photographs of other days take its deflectometry nearer to those of a day. Days are dealt
out to two halves; surfaces from photographs of either are judged by all photographs of the other.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.folders import read_observations
from benchmarks.record import Estimate, log_row, recording
from benchmarks.years import interval
from heliotwin.folder import surface_errors
from model.images import FLUX_SHAPE, FLUX_WINDOW, normalized
from model.metrics import WINDOWS, surface_error
from model.network.predictor import default_predictor
from model.observation import (
    Observation,
    SurfacePrediction,
    align_observations,
    misfits,
    observed_scene,
    spread_suns,
)
from model.plant import Facet, Heliostat
from model.plant_model import JUELICH_MODEL
from model.prediction_warnings import has_excess_spillage
from model.prior import default_prior, generic_prior
from model.refinement import RefinementOptions, refine
from model.surface import heights
from model.tracing import Window
from model.tracing.montecarlo import trace_montecarlo
from service.sources.folder import MeasurementFolder, measured_heights, read_folder
from service.twin import operations
from service.twin.surfaces.present_shape import reject_outliers

Array = NDArray[np.float64]

MIRRORS = ("AA28", "AA39", "AC43")
IMAGES = 8
NOISE = 0.01
FAR = (300.0, 400.0, 600.0)
WITHIN_90 = 1.645
BRIGHT = 0.3
"""Share of a spot's brighter half that may be cut off for a photograph to be taken here."""

RENDERED = "Mirrors as deflectometry has them, rendered by Monte Carlo"
FAR_AWAY = "The same mirrors farther away, by distance and window"
REAL = "AA39 from real photographs"

HEAD = (
    "| | error [mm] | canting | waviness | mean sigma | within 90 % | processor [s] | wall [s] |"
    " left out |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def row(
    table: str,
    name: str,
    predict: Callable[[], SurfacePrediction],
    truth: Array,
    goal: str | None = None,
) -> SurfacePrediction:
    """Print what a prediction is worth; ``goal`` is that of its error."""
    start, begun = time.process_time(), time.perf_counter()
    found = predict()
    seconds, wall = time.process_time() - start, time.perf_counter() - begun
    errors = surface_errors(found.z, truth)
    covered = np.mean(np.abs(found.z - truth) < WITHIN_90 * found.z_std)
    print(
        f"| {name} | {errors['mae_mm']:.3f} | {errors['mae_canting_mm']:.3f} |"
        f" {errors['mae_waviness_mm']:.3f} | {1e3 * found.z_std.mean():.3f} | {covered:.0%} |"
        f" {seconds:.1f} | {wall:.1f} | {', '.join(found.contradicting)} |",
        flush=True,
    )
    log_row(
        table,
        name,
        {
            "error [mm]": Estimate(errors["mae_mm"], goal=goal),
            "canting [mm]": errors["mae_canting_mm"],
            "waviness [mm]": errors["mae_waviness_mm"],
            "standard deviation, mean [mm]": 1e3 * found.z_std.mean(),
            "heights within 90 % intervals [%]": 100 * covered,
            "processor [s]": seconds,
        },
        n=len(found.misfits),
        of="photographs",
        compared_with="deflectometry",
    )
    return found


def truth_of(folder: MeasurementFolder, name: str) -> tuple[Heliostat, Array, Array]:
    """A heliostat, its measured heights (4, 8, 8) [m], and all that deflectometry has of them (4,
    I, J) [m].
    """
    heliostat, measured = folder.plant.heliostats[name], folder.measured_surface(name)
    assert measured is not None
    _, rows, columns, _ = measured[0].shape
    return (
        heliostat,
        measured_heights(heliostat, measured),
        heights(heliostat, *measured, shape=(rows, columns)),
    )


def photographed(
    heliostat: Heliostat,
    z: Array,
    setups: list[Observation],
    rays: int,
    rng: np.random.Generator,
    side: float = FLUX_WINDOW,
) -> list[Observation]:
    """What an 8-bit camera with noise sees of Monte Carlo light in squares of ``side`` [m]."""
    images, _ = trace_montecarlo(
        observed_scene(heliostat, setups, z), Window(side, side, on_spot=True), rays=rays
    )
    seen = images / images.max(axis=(1, 2), keepdims=True) + rng.normal(0, NOISE, images.shape)
    flux = normalized(np.round(seen.clip(0, 1) * 255)).astype(np.float32)
    return [
        replace(setup, flux=image, side=side) for setup, image in zip(setups, flux, strict=True)
    ]


def by_network(heliostat: Heliostat, seen: list[Observation]) -> SurfacePrediction:
    """What the shipped network predicts."""
    return default_predictor().predict(heliostat, seen, JUELICH_MODEL)


def held(heliostat: Heliostat, z: Array, setups: list[Observation], rays: int) -> list[Observation]:
    """`photographed` in the smallest window that holds the spots, or the largest there is."""
    for side in WINDOWS:
        seen = photographed(heliostat, z, setups, rays, np.random.default_rng(1), side)
        if not has_excess_spillage(seen):
            break
    return seen


def spread(observations: list[Observation], count: int) -> list[Observation]:
    """So many whose suns stand far apart."""
    return [observations[i] for i in spread_suns(np.array([o.sun for o in observations]), count)]


def places_of(years: MeasurementFolder, count: int) -> list[Observation]:
    """Suns and targets of AA39's photographs; nothing is seen yet."""
    blank, targets = np.ones(FLUX_SHAPE, np.float32), years.plant.targets
    setups = [
        Observation(blank, m.to_sun, targets[m.target], targets[m.target].center, m.external_id)
        for m in years.measurements("AA39")
    ]
    return spread(setups, count)


def rendered(folder: MeasurementFolder, years: MeasurementFolder, rays: int) -> None:
    """Print errors of mirrors whose photographs were rendered."""
    print(f"Rendered by Monte Carlo, {rays:.0e} rays, {NOISE:.0%} noise, {IMAGES} images\n{HEAD}")
    for name in MIRRORS:
        heliostat, truth, fine = truth_of(folder, name)
        seen = photographed(
            heliostat, fine, places_of(years, IMAGES), rays, np.random.default_rng(1)
        )
        row(RENDERED, f"{name} network", partial(by_network, heliostat, seen), truth)
        ends = {
            "refined from the mean": row(
                RENDERED,
                f"{name} refined",
                partial(refine, heliostat, seen, JUELICH_MODEL),
                truth,
                "<= 0.07",
            ),
            "from the truth": row(
                RENDERED,
                f"{name} refined from the truth",
                partial(refine, heliostat, seen, JUELICH_MODEL, truth),
                truth,
            ),
        }
        apart = surface_error(*(end.z for end in ends.values())) * 1e3
        left = ", ".join(f"{label} {end.misfit:.4f}" for label, end in ends.items())
        row(
            RENDERED,
            f"{name} refined without ripples",
            partial(
                refine,
                heliostat,
                seen,
                JUELICH_MODEL,
                options=RefinementOptions(with_ripples=False),
            ),
            truth,
        )
        generic = generic_prior(heliostat.facet_frames[2])
        row(
            RENDERED,
            f"{name} refined, generic prior",
            partial(refine, heliostat, seen, JUELICH_MODEL, prior=generic),
            truth,
            "<= 0.12",
        )
        larger, shape = enlarged(heliostat, 1.5), 1.5 * truth
        images = held(larger, 1.5 * fine, places_of(years, IMAGES), rays)
        row(
            RENDERED,
            f"{name} with facets half as large again, refined",
            partial(refine, larger, images, JUELICH_MODEL),
            shape,
        )
        smooth = photographed(
            heliostat, truth, places_of(years, IMAGES), rays, np.random.default_rng(1)
        )
        row(
            RENDERED,
            f"{name} of 8 x 8 heights, network",
            partial(by_network, heliostat, smooth),
            truth,
        )
        row(
            RENDERED,
            f"{name} of 8 x 8 heights, refined",
            partial(refine, heliostat, smooth, JUELICH_MODEL),
            truth,
            "<= 0.07",
        )
        print(f"| | both ends {apart:.3f} mm apart, misfit {left} | | | | | | | |")


def enlarged(heliostat: Heliostat, factor: float) -> Heliostat:
    """A heliostat whose facets, and the distances between them, are so many times as large."""
    facets = (
        Facet(factor * f.position, factor * f.canting_x, factor * f.canting_y)
        for f in heliostat.facets
    )
    return replace(heliostat, facets=tuple(facets))


def far(folder: MeasurementFolder, years: MeasurementFolder, rays: int) -> None:
    """Print errors of heliostats whose spots are larger than the smallest window."""
    print(
        f"North of the tower, canted to their distance; Monte Carlo, {rays:.0e} rays, {IMAGES}"
        f" images\n{HEAD}"
    )
    places = [
        replace(o, target=replace(o.target, width=16.0, height=16.0))
        for o in places_of(years, IMAGES)
    ]
    for distance in FAR:
        heliostat = Heliostat.juelich("far", (0.0, distance, 1.8), distance)
        for name in MIRRORS:
            _, truth, fine = truth_of(folder, name)
            smallest = photographed(heliostat, fine, places, rays, np.random.default_rng(1))
            for taken in (
                (smallest, held(heliostat, fine, places, rays))
                if has_excess_spillage(smallest)
                else (smallest,)
            ):
                label = f"{name} at {distance:.0f} m, {taken[0].side:g} m"
                row(FAR_AWAY, f"{label}, network", partial(by_network, heliostat, taken), truth)
                row(
                    FAR_AWAY,
                    f"{label}, refined",
                    partial(refine, heliostat, taken, JUELICH_MODEL),
                    truth,
                )


def scaling(folder: MeasurementFolder, years: MeasurementFolder, rays: int) -> None:
    """Print the time that AA39 takes from 8 to 64 images."""
    heliostat, truth, fine = truth_of(folder, "AA39")
    seen = photographed(heliostat, fine, places_of(years, 64), rays, np.random.default_rng(1))
    print(f"From 8 to 64 images\n{HEAD}")
    for count in (8, 16, 32, 64):
        row(
            "AA39 rendered, by the number of images",
            f"{count} images",
            partial(refine, heliostat, seen[:count], JUELICH_MODEL),
            truth,
        )


def real(years: MeasurementFolder) -> None:
    """Print errors of AA39 from real photographs, and the flux accuracy on photographs that no set
    holds.
    """
    heliostat, truth, _ = truth_of(years, "AA39")
    taken = [o for o in read_observations(years, "AA39") if o.clipped_share < BRIGHT]
    sets = {
        "8, suns far apart": spread(taken, 8),
        "8 over the years": taken[:: len(taken) // 8][:8],
        "16, suns far apart": spread(taken, 16),
        "16 over the years": taken[2 :: len(taken) // 16][:16],
    }
    used = {o.identifier for chosen in sets.values() for o in chosen}
    others = [o for o in taken if o.identifier not in used]

    def accuracy(z: Array) -> float:
        found = misfits(heliostat, others, z, JUELICH_MODEL)
        return 1 - float(np.median(found))

    print(f"AA39, real photographs; median flux accuracy on {len(others)} others\n{HEAD}")
    for name, chosen in sets.items():
        start = default_predictor().predict(heliostat, spread(chosen, 8), JUELICH_MODEL)
        found = row(
            REAL, name, partial(refine, heliostat, chosen, JUELICH_MODEL, start.z), truth, "<= 0.25"
        )
        by_surface = {
            "accuracy on other photographs, median": Estimate(accuracy(found.z), n=len(others)),
            "of the network": Estimate(accuracy(start.z), n=len(others)),
            "of deflectometry": Estimate(accuracy(truth), n=len(others)),
            "network's error [mm]": 1e3 * surface_error(start.z, truth),
        }
        log_row(REAL, name, by_surface, of="photographs", compared_with="deflectometry")
        print(
            f"| | accuracy {accuracy(found.z):.3f}, network {accuracy(start.z):.3f}, deflectometry"
            f" {accuracy(truth):.3f}; network's error {1e3 * surface_error(start.z, truth):.3f} | |"
            " | | | | | |"
        )


def day_of(observation: Observation) -> str:
    """The day of a photograph, or its identifier if its time is not known."""
    taken_at = observation.taken_at
    return observation.identifier if taken_at is None else taken_at.date().isoformat()


def whole(heliostat: Heliostat, z: Array, taken: list[Observation]) -> list[Observation]:
    """Photographs of which neither the camera's range nor the target's edge takes anything."""
    cut = {
        row
        for group in align_observations(heliostat, taken, z, JUELICH_MODEL).groups
        for row, is_truncated in zip(group.rows, group.is_truncated, strict=True)
        if is_truncated
    }
    return [o for i, o in enumerate(taken) if i not in cut and o.clipped_share == 0]


def photographs(years: MeasurementFolder) -> None:
    """Print what surfaces from all photographs are worth beside those from whole ones, by other
    days' photographs.
    """
    heliostat, truth, _ = truth_of(years, "AA39")
    taken = read_observations(years, "AA39")
    days = sorted({day_of(o) for o in taken})
    sides = [[o for o in taken if days.index(day_of(o)) % 2 == half] for half in (0, 1)]
    agree = [
        o for side in sides for o in reject_outliers(operations, heliostat, side, JUELICH_MODEL)[0]
    ]
    faultless = whole(heliostat, truth, taken)
    corrected = replace(default_prior(), mean=truth)

    def found(chosen: list[Observation]) -> Array:
        start = default_predictor().predict(heliostat, spread(chosen, IMAGES), JUELICH_MODEL)
        return refine(heliostat, chosen, JUELICH_MODEL, start.z).z

    ways: dict[str, Callable[[list[Observation]], Array]] = {
        f"{IMAGES} whole ones": lambda side: found(
            spread([o for o in side if o in faultless], IMAGES)
        ),
        f"{IMAGES} of all": lambda side: found(spread(side, IMAGES)),
        f"{IMAGES} that agree": lambda side: found(spread([o for o in side if o in agree], IMAGES)),
        f"{2 * IMAGES} that agree": lambda side: found(
            spread([o for o in side if o in agree], 2 * IMAGES)
        ),
        "none: deflectometry": lambda side: truth,
        f"{2 * IMAGES} that agree, about deflectometry": lambda side: (
            refine(
                heliostat,
                spread([o for o in side if o in agree], 2 * IMAGES),
                JUELICH_MODEL,
                truth,
                prior=corrected,
            ).z
        ),
    }
    print(
        f"AA39: {len(faultless)} of {len(taken)} photographs are whole; {len(days)} days\n"
        "| surfaces from | error [mm] | accuracy on the other days' photographs, mean | median | "
        "gain over whole ones, 95 % over days |\n| --- | --- | --- | --- | --- |"
    )
    judges = [o for side in reversed(sides) for o in side]
    first: Array | None = None
    for name, way in ways.items():
        surfaces = [way(side) for side in sides]
        missed = [
            misfits(heliostat, judged, z, JUELICH_MODEL)
            for z, judged in zip(surfaces, reversed(sides), strict=True)
        ]
        accuracy = 1 - np.concatenate(missed)
        first = accuracy if first is None else first
        low, high = interval(accuracy - first, [day_of(o) for o in judges])
        apart = [1e3 * surface_error(z, truth) for z in surfaces]
        log_row(
            "AA39 from photographs of half of the days, judged by the others",
            name,
            {
                "error, first half [mm]": apart[0],
                "error, second half [mm]": apart[1],
                "accuracy, mean": accuracy.mean(),
                "accuracy, median": np.median(accuracy),
                "gain over the first row": Estimate((accuracy - first).mean(), (low, high)),
            },
            n=len(judges),
            of="photographs",
            compared_with="deflectometry and photographs of other days, intervals over days",
        )
        errors = ", ".join(f"{error:.3f}" for error in apart)
        print(
            f"| {name} | {errors} | {accuracy.mean():.3f} | {np.median(accuracy):.3f} | "
            f"{(accuracy - first).mean():+.4f} [{low:+.4f}, {high:+.4f}] |",
            flush=True,
        )


TABLES: dict[str, Callable[[MeasurementFolder, MeasurementFolder, int], None]] = {
    "rendered": rendered,
    "real": lambda folder, years, rays: real(years),
    "scaling": scaling,
    "far": far,
    "photographs": lambda folder, years, rays: photographs(years),
}
"""What can be printed, of the folder of many heliostats, that of one over years, and so many rays
an image.
"""


def main(arguments: list[str]) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rays", type=int, default=3_000_000)
    parser.add_argument("--only", choices=TABLES)
    options = parser.parse_args(arguments)
    root: Path = data_folder()
    if not (root.parent / "stj-years").is_dir():
        print(f"surfaces: no real measurements at {root}; set HELIOTWIN_STJ")
        return
    folder, years = read_folder(root), read_folder(root.parent / "stj-years")
    for name in (options.only,) if options.only else ("rendered", "real"):
        with recording(f"surfaces-{name}"):
            TABLES[name](folder, years, options.rays)


if __name__ == "__main__":
    main(sys.argv[1:])
