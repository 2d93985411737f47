"""What a busy machine costs: ``python -m benchmarks.busy``. Run it without OMP_NUM_THREADS in
the environment.

Each task runs in a separate process, as the command would start it: once alone, and once next to a
process that computes on all cores. Other programs of the machine slow down both, so its load is
printed. Processor time is the cost of the task itself: a thread that waits uses none, a thread that
spins does.
"""

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks import data_folder
from benchmarks.record import log_row, recording
from model.plant_model import JUELICH_MODEL

HELIOSTAT = "AA39"

FLUXES, REPEATS = 200, 20
"""Numbers of convolution fluxes and of network predictions, whose median is printed."""


Times = tuple[float, float]
"""Wall time and processor time [s]."""


def now() -> Times:
    """Of the clock, and of this process and those that it waited for."""
    children = os.times()
    return (
        time.perf_counter(),
        time.process_time() + children.children_user + children.children_system,
    )


def prediction(out: Path) -> Times:
    """Times of the command that refines the surface of `HELIOSTAT`, its start included."""
    plant = out / "plant"
    if not plant.is_dir():
        plant.mkdir()
        root = data_folder().resolve()
        for name in (HELIOSTAT, *(path.name for path in root.glob("*tower-measurements.json"))):
            (plant / name).symlink_to(root / name)
    command = ("predict", str(plant), "--out", str(out / "predicted"), "--method", "refined")
    began = now()
    subprocess.run(
        [sys.executable, "-m", "service", *command], check=True, stdout=subprocess.DEVNULL
    )
    ended = now()
    return ended[0] - began[0], ended[1] - began[1]


def in_process(work: str) -> Callable[[Path], Times]:
    """Median times of one ``flux`` or one ``network`` prediction in a fresh process."""

    def run(out: Path) -> Times:
        command = [sys.executable, "-m", "benchmarks.busy", work]
        wall, cpu = subprocess.run(
            command, check=True, capture_output=True, text=True
        ).stdout.split()
        return float(wall), float(cpu)

    return run


def medians(work: Callable[[], object], repeats: int) -> Times:
    """Median times of one call, after a warm-up."""
    work()
    taken = []
    for _ in range(repeats):
        began = now()
        work()
        taken.append([after - before for before, after in zip(began, now(), strict=True)])
    wall, cpu = (sorted(column)[repeats // 2] for column in zip(*taken, strict=True))
    return wall, cpu


def measure(work: str) -> Times:
    """What `in_process` runs."""
    # First, as the command does: it limits the threads of libraries before they are loaded.
    import service

    assert service
    import numpy as np
    import torch

    from benchmarks.speed import TARGET, scene
    from model.network.architecture import MAX_IMAGES
    from model.network.predictor import SurfacePredictor
    from model.plant import Heliostat
    from model.prior import default_prior
    from model.tracing import Window, trace
    from training.render import CleanCamera, SceneSampler, observe, places

    if work == "flux":
        with torch.no_grad():
            one = scene(1, "cpu")
            return medians(
                lambda: trace(one, Window(on_spot=True), samples=24, padding=0.25), FLUXES
            )
    mirror, rng = (
        Heliostat.juelich("synthetic", np.array([20.0, 95.0, 1.8]), 100.0),
        np.random.default_rng(0),
    )
    setups = places(SceneSampler().suns(MAX_IMAGES, rng), [TARGET] * MAX_IMAGES)
    images = observe(mirror, default_prior().mean, setups, CleanCamera(), rng)
    predictor = SurfacePredictor()
    return medians(lambda: predictor.heights(mirror, images, JUELICH_MODEL), REPEATS)


def burn() -> None:
    """Compute without end."""
    while True:
        sum(range(10**6))


@contextmanager
def burning() -> Iterator[None]:
    """As many processes that compute without end as there are cores."""
    processes = [
        multiprocessing.Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)
    ]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


WORKS: dict[str, Callable[[Path], Times]] = {
    f"predict --method refined, {HELIOSTAT}": prediction,
    "convolution flux": in_process("flux"),
    "network prediction, 8 images": in_process("network"),
}


def main() -> None:
    """Print every work's times and their ratio."""
    print(
        f"Beside a process on all {os.cpu_count()} cores (load of the machine before:"
        f" {os.getloadavg()[0]:.1f})"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name, work in WORKS.items():
            load = os.getloadavg()[0]
            alone = work(Path(folder))
            with burning():
                beside = work(Path(folder))
            print(f"  {name} (load before: {load:.1f}):")
            for kind, idle, busy in zip(("wall", "processor"), alone, beside, strict=True):
                ratio = busy / idle
                print(
                    f"    {kind} time {idle:.4g} s alone, {busy:.4g} s beside it: {ratio:.1f}"
                    " times",
                    flush=True,
                )
                cells = {"alone [s]": idle, "on a busy machine [s]": busy, "ratio": ratio}
                log_row("Next to a process on all cores", f"{name}, {kind}", cells)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(*measure(sys.argv[1]))
    else:
        with recording("busy"):
            main()
