"""How fast: ``python -m benchmarks.speed``. Compare the ratios; the machines are shared."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from benchmarks.record import Estimate, log_row, recording
from model.frames import sun_direction
from model.network.architecture import MAX_IMAGES
from model.network.predictor import INPUTS, N_ITERATIONS, SurfacePredictor
from model.plant import Heliostat, TargetPlane
from model.plant_model import JUELICH_MODEL
from model.prior import default_prior
from model.refinement import refine
from model.setup import Setup
from model.surface import control_points
from model.tracing import Scene, Window, trace
from model.tracing.montecarlo import trace_montecarlo
from training.export import example
from training.render import CleanCamera, SceneSampler, observe, places

BATCH = 64

TARGET = TargetPlane(
    "t", np.array([0.0, 0, 40]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8, 8
)


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Median time of one call [s], after a warm-up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def scene(count: int, device: str) -> Scene:
    """Random mirrors at 100 m under one sun."""
    rng, prior = np.random.default_rng(0), default_prior()
    heliostat = Heliostat.juelich("synthetic", np.array([20.0, 95.0, 1.8]), 100.0)
    suns = np.tile(sun_direction(155.0, 40.0), (count, 1))
    angles = np.tile(heliostat.mount.align(heliostat.position, suns[0], TARGET.center), (count, 1))
    points = [
        control_points(heliostat, prior.surface(rng.normal(size=len(prior.basis))))
        for _ in range(count)
    ]
    setups = [Setup(heliostat, p, sun, TARGET) for p, sun in zip(points, suns, strict=True)]
    return Scene.from_setups(setups, angles, device=device)


def main() -> None:
    """Print times of the tracers and of the network."""
    window = Window(on_spot=True)
    print(f"Speed ({torch.get_num_threads()} torch threads)")
    with torch.no_grad():
        batch, one = scene(BATCH, "cpu"), scene(1, "cpu")
        reference = trace(batch, window, samples=96, padding=1.0).normalized()
        for samples in (16, 24, 32):
            error = (
                (trace(batch, window, samples=samples, padding=0.25).normalized() - reference)
                .abs()
                .sum((1, 2))
            )
            each = (
                seconds(partial(trace, batch, window, samples=samples, padding=0.25), 20)
                / BATCH
                * 1e3
            )
            print(
                f"  convolution, {samples}^2 points a facet, batch {BATCH}: {each:.3f} ms a 64 x 64"
                f" flux, L1 to the converged image {float(error.mean()):.2f} %"
            )
            table, row = "One flux of 64 x 64 pixels", f"convolution, {samples} x {samples} points"
            log_row(table, row, {"time [ms]": Estimate(each, goal="<= 1")}, n=BATCH, of="fluxes")
            apart, truth = {"error, L1 [%]": float(error.mean())}, "the converged image"
            log_row(table, row, apart, n=BATCH, of="fluxes", compared_with=truth)
        rays = seconds(lambda: trace_montecarlo(one, window, rays=1_000_000), 3)
        print(f"  Monte Carlo, 1e6 rays: {rays:.2f} s a flux")
        log_row("One flux of 64 x 64 pixels", "Monte Carlo, 1e6 rays", {"time [ms]": 1e3 * rays})
        if torch.cuda.is_available():
            many = scene(4096, "cuda")

            def on_gpu() -> None:
                trace(many, window, samples=24, padding=0.25)
                torch.cuda.synchronize()

            each = seconds(on_gpu, 10) / 4096 * 1e3
            device = torch.cuda.get_device_name()
            print(f"  convolution on {device}: {each:.4f} ms a flux")
            log_row("One flux of 64 x 64 pixels", f"convolution on {device}", {"time [ms]": each})
    predictor, mirror = (
        SurfacePredictor(threads=1),
        Heliostat.juelich("synthetic", np.array([20.0, 95.0, 1.8]), 100.0),
    )
    rng = np.random.default_rng(0)
    setups = places(SceneSampler().suns(MAX_IMAGES, rng), [TARGET] * MAX_IMAGES)
    images = observe(mirror, default_prior().mean, setups, CleanCamera(), rng)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    single, pair = (
        {n: v.numpy() for n, v in zip(INPUTS, example(batch, MAX_IMAGES), strict=True)}
        for batch in (1, 2)
    )
    # The iterations before the last, which is made for the mirrored world, too.
    taken = (
        seconds(
            lambda: [
                predictor.iterate(inputs) for inputs in [single] * (N_ITERATIONS - 1) + [pair]
            ],
            20,
        )
        * 1e3
    )
    print(f"  network, one heliostat, 8 images, 1 core, {N_ITERATIONS} iterations: {taken:.1f} ms")
    log_row("A surface from 8 images", "network alone", {"time [ms]": taken})
    for n_iterations in (1, N_ITERATIONS):
        taken = (
            seconds(
                partial(
                    predictor.heights, mirror, images, JUELICH_MODEL, n_iterations=n_iterations
                ),
                20,
            )
            * 1e3
        )
        print(
            f"  the same with alignment and tracing of its guesses, iterations {n_iterations}:"
            f" {taken:.1f} ms"
        )
        label = f"network with alignment and tracing, iterations: {n_iterations}"
        log_row("A surface from 8 images", label, {"time [ms]": taken})
    torch.set_num_threads(threads)
    taken = seconds(lambda: refine(mirror, images, JUELICH_MODEL), 3)
    print(f"  refinement, one heliostat, 8 images: {taken:.1f} s")
    log_row("A surface from 8 images", "refinement", {"time [ms]": 1e3 * taken})


if __name__ == "__main__":
    with recording("speed"):
        main()
