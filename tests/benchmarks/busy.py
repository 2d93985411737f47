"""What a busy machine costs: ``python -m tests.benchmarks.busy``. Run it without OMP_NUM_THREADS in the environment.

Every work runs in a process of its own, as the command would start it, alone and beside a process that computes on all
cores. Whatever else the machine does weighs on both; its load is told.
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

from tests.benchmarks import data_folder

HELIOSTAT = "AA39"

FLUXES, REPEATS = 200, 20
"""Convolution fluxes, and predictions by the network, whose median is told."""


def prediction(out: Path) -> float:
    """Wall time [s] of the command that refines the surface of `HELIOSTAT`, its start included."""
    plant = out / "plant"
    if not plant.is_dir():
        plant.mkdir()
        root = data_folder().resolve()
        for name in (HELIOSTAT, *(path.name for path in root.glob("*tower-measurements.json"))):
            (plant / name).symlink_to(root / name)
    command = ("predict", str(plant), "--out", str(out / "predicted"), "--method", "refined")
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "service", *command], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def in_process(work: str) -> Callable[[Path], float]:
    """Median time [s] of one ``flux`` or one ``network`` prediction in a fresh process."""

    def run(out: Path) -> float:
        command = [sys.executable, "-m", "tests.benchmarks.busy", work]
        return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)

    return run


def measure(work: str) -> float:
    """What `in_process` runs: median time [s]."""
    import service  # first, as the command does: how many threads libraries take is settled before they are loaded

    assert service
    import torch

    from model.network.architecture import MAX_IMAGES
    from model.network.predictor import SurfacePredictor
    from model.plant import Heliostat
    from model.prior import default_prior
    from model.tracing import Window, trace
    from tests.benchmarks.speed import TARGET, np, scene, seconds
    from training.render import CleanCamera, Situations, observe, places

    if work == "flux":
        with torch.no_grad():
            one = scene(1, "cpu")
            return seconds(lambda: trace(one, Window(on_spot=True), samples=24, padding=0.25), FLUXES)
    mirror, rng = Heliostat.juelich("synthetic", np.array([20.0, 95.0, 1.8]), 100.0), np.random.default_rng(0)
    setups = places(Situations().suns(MAX_IMAGES, rng), [TARGET] * MAX_IMAGES)
    images = observe(mirror, default_prior().mean, setups, CleanCamera(), rng)
    predictor = SurfacePredictor()
    return seconds(lambda: predictor.heights(mirror, images), REPEATS)


def burn() -> None:
    """Compute without end."""
    while True:
        sum(range(10**6))


@contextmanager
def burning() -> Iterator[None]:
    """As many processes that compute without end as there are cores."""
    processes = [multiprocessing.Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


WORKS: dict[str, Callable[[Path], float]] = {
    f"predict --method refined, {HELIOSTAT}": prediction,
    "convolution flux": in_process("flux"),
    "network prediction, 8 images": in_process("network"),
}


def main() -> None:
    """Print every work's times and their ratio."""
    print(f"Beside a process on all {os.cpu_count()} cores (load of the machine before: {os.getloadavg()[0]:.1f})")
    with tempfile.TemporaryDirectory() as folder:
        for name, work in WORKS.items():
            load = os.getloadavg()[0]
            alone = work(Path(folder))
            with burning():
                beside = work(Path(folder))
            times = f"{alone:.4g} s alone (load {load:.1f}), {beside:.4g} s beside it: {beside / alone:.1f} times"
            print(f"  {name}: {times}", flush=True)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(measure(sys.argv[1]))
    else:
        main()
