"""Surfaces of mirrors of any facets, refined: ``python -m benchmarks.facets``.

Mirrors of 1, 6, 25 and 35 facets, focused by their canting, at 100 to 300 m. Their errors are drawn
from rougher and less similar facets than the generic prior's, with ripples that heights do not
resolve. Monte Carlo images, one per cent of noise, 8 bits. Flux accuracy is on suns that were not
shown, in the same window. Intervals are those of control heights, of 90 %.
"""

import argparse
import resource
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import sem, t

from benchmarks.record import Estimate, log_row, recording
from model.frames import sun_direction
from model.heliostat_type import FacetDesign, HeliostatType, MountDesign, facet_grid
from model.images import FLUX_SHAPE, normalized
from model.metrics import WINDOWS, flux_accuracies, spot_window, surface_error
from model.observation import Observation, observed_scene, render_observations
from model.plant import Heliostat, TargetPlane
from model.plant_model import JUELICH_MODEL
from model.prediction_warnings import has_excess_spillage
from model.prior import FacetKind, generic_covariance, ripples, tilt_modes, without
from model.refinement import refine
from model.surface import COLUMNS, ROWS, halved
from model.tracing import Window
from model.tracing.montecarlo import trace_montecarlo

Array = NDArray[np.float64]

N_IMAGES, N_OTHERS = 8, 8
NOISE = 0.01
WITHIN_90 = 1.645
DISTANCES = (100.0, 200.0, 300.0)
TOWER_HEIGHT = 40.0

ROUGH = replace(FacetKind.of_slopes(1.0, 1.0), reach=0.45, alike=0.4)
"""Facets canted wrong by 1 mrad for each axis, with waves of 1.3 mrad."""

FACETS: dict[int, Sequence[FacetDesign]] = {
    1: facet_grid(1, 1, 3.0, 3.0, 0.0),
    6: facet_grid(2, 3, 2.0, 2.0, 0.02),
    25: facet_grid(5, 5, 1.22, 1.22, 0.02),
    35: facet_grid(7, 5, 1.8, 1.35, 0.02),
}
"""Facets by their number; 25 are those of the National Solar Thermal Test Facility."""

GOALS = {
    "flux accuracy, refined": ">= 0.95",
    "within 90 % intervals [%]": ">= 85",
    "processor time [s]": "<= 60",
}

HEAD = (
    "| facets | distance [m] | window [m] | ideal | refined | truth | error [mm] | ideal's |"
    " mean sigma | within 90 % | processor [s] | wall [s] |\n" + "| --- " * 12 + "|"
)


def mirror(count: int, distance: float) -> Heliostat:
    """A heliostat of so many facets, canted to a distance [m] north of the tower."""
    kind = HeliostatType(f"{count} facets", FACETS[count], MountDesign(pivot_height=4.0))
    foot = (0.0, float(np.sqrt(distance**2 - (TOWER_HEIGHT - 4.0) ** 2)), 0.0)
    return kind.heliostat(str(count), foot, (0.0, 0.0, TOWER_HEIGHT))


def rough_heights(heliostat: Heliostat, rng: np.random.Generator) -> Array:
    """Heights (F, 8, 8) [m] of a rough mirror, whose tilt is the mount's."""
    half_sizes = heliostat.facet_frames.half_sizes
    count = len(half_sizes)
    covariance = generic_covariance(half_sizes, ROUGH)
    z = rng.multivariate_normal(np.zeros(len(covariance)), covariance, method="eigh")
    z = z.reshape(count, ROWS, COLUMNS)
    z -= z.mean(axis=(1, 2), keepdims=True)
    tilts = np.repeat(tilt_modes(half_sizes.mean(axis=0))[:, None], count, axis=1)
    return without(z, tilts)


class Suns(NamedTuple):
    """Unit vectors (N, 3) towards suns that are shown, and towards others."""

    shown: Array
    others: Array


def suns(rng: np.random.Generator) -> Suns:
    """Suns of a year between 15 and 65 degrees of elevation."""
    count = N_IMAGES + N_OTHERS
    azimuth, elevation = rng.uniform(100, 260, count), rng.uniform(15, 65, count)
    every = np.array([sun_direction(*place) for place in zip(azimuth, elevation, strict=True)])
    return Suns(every[:N_IMAGES], every[N_IMAGES:])


def places(directions: Array, side: float) -> list[Observation]:
    """Observations of which nothing is seen yet, on a target that holds the spot."""
    plane = TargetPlane(
        "target",
        np.array([0.0, 0.0, TOWER_HEIGHT]),
        np.array([0.0, 1.0, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        2 * side,
        2 * side,
    )
    blank = np.ones(FLUX_SHAPE, np.float32)
    return [
        Observation(blank, sun, plane, plane.center, str(i), side=side)
        for i, sun in enumerate(directions)
    ]


def traced(
    heliostat: Heliostat, fine: Array, setups: list[Observation], rays: int, seed: int
) -> Array:
    """Monte Carlo images (M, 64, 64) [W/m2] of heights (F, 13, 13) [m]."""
    side = setups[0].side
    window = Window(side, side, *FLUX_SHAPE, on_spot=True)
    return trace_montecarlo(
        observed_scene(heliostat, setups, fine), window, rays=rays, seed=seed
    ).irradiance


def seen(images: Array, setups: list[Observation], rng: np.random.Generator) -> list[Observation]:
    """What an 8-bit camera with noise sees of images (M, 64, 64)."""
    bright = images / images.max(axis=(1, 2), keepdims=True) + rng.normal(0, NOISE, images.shape)
    flux = normalized(np.round(bright.clip(0, 1) * 255)).astype(np.float32)
    return [replace(setup, flux=image) for setup, image in zip(setups, flux, strict=True)]


def case(count: int, distance: float, rays: int, seed: int) -> dict[str, float]:
    """Refine one mirror, print a row, and return its figures."""
    rng, model = np.random.default_rng((seed, count, int(distance))), JUELICH_MODEL
    heliostat = mirror(count, distance)
    truth = rough_heights(heliostat, rng)
    fine = ripples(heliostat.facet_frames.half_sizes)
    rippled = halved(truth) + np.tensordot(rng.normal(size=len(fine)), fine, axes=1)
    del fine
    directions = suns(rng)
    for side in WINDOWS[WINDOWS.index(spot_window(heliostat, distance)) :]:
        shown, others = (places(some, side) for some in directions)
        observations = seen(traced(heliostat, rippled, shown, rays, seed), shown, rng)
        if not has_excess_spillage(observations):
            break
    judges = traced(heliostat, rippled, others, rays, seed + 1)

    def accuracy(z: Array) -> float:
        images = render_observations(heliostat, others, z, model).clip(min=0)
        return float(flux_accuracies(judges, images).mean())

    start, begun = _processor_seconds(), time.perf_counter()
    found = refine(heliostat, observations, model)
    seconds, wall = _processor_seconds() - start, time.perf_counter() - begun
    covered = np.mean(np.abs(found.z - truth) < WITHIN_90 * found.z_std)
    errors = (surface_error(found.z, truth), surface_error(0 * truth, truth), found.z_std.mean())
    print(
        f"| {count} | {distance:.0f} | {side:g} | {accuracy(0 * truth):.3f} |"
        f" {accuracy(found.z):.3f} | {accuracy(rippled):.3f} |"
        f" {' | '.join(f'{1e3 * error:.3f}' for error in errors)} | {covered:.0%} |"
        f" {seconds:.1f} | {wall:.1f} |",
        flush=True,
    )
    return {
        "flux accuracy, ideal": accuracy(0 * truth),
        "flux accuracy, refined": accuracy(found.z),
        "flux accuracy, true heights": accuracy(rippled),
        "within 90 % intervals [%]": 100 * float(covered),
        "processor time [s]": seconds,
    }


def log_mirrors(count: int, distance: float, cases: list[dict[str, float]]) -> None:
    """Record the means over mirrors of one kind, with 95 % intervals over mirrors."""
    log_row(
        "Mirrors of any facets, refined from simulated images",
        f"{count} facets at {distance:.0f} m",
        {name: mean_of([case[name] for case in cases], GOALS.get(name)) for name in cases[0]},
        n=len(cases),
        of="mirrors",
        compared_with="the true surface, suns not shown",
    )


def mean_of(values: list[float], goal: str | None) -> Estimate:
    """The mean with its 95 % interval by Student's t; one value has none."""
    if len(values) < 2:
        return Estimate(values[0], goal=goal)
    half = float(t.ppf(0.975, len(values) - 1) * sem(values))
    mean = float(np.mean(values))
    return Estimate(mean, (mean - half, mean + half), goal=goal, std=float(np.std(values, ddof=1)))


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--facets", type=int, nargs="+", choices=FACETS, default=list(FACETS))
    parser.add_argument("--distances", type=float, nargs="+", default=DISTANCES)
    parser.add_argument("--mirrors", type=int, default=1, help="of each kind and distance")
    parser.add_argument("--rays", type=int, default=2_000_000)
    options = parser.parse_args(arguments)
    print(f"{N_IMAGES} Monte Carlo images, {options.rays:.0e} rays, {NOISE:.0%} noise\n{HEAD}")
    for count in options.facets:
        for distance in options.distances:
            seeds = range(options.mirrors)
            log_mirrors(
                count, distance, [case(count, distance, options.rays, seed) for seed in seeds]
            )


if __name__ == "__main__":
    with recording("facets"):
        main(sys.argv[1:])
