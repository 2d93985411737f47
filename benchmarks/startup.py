"""How long the command takes to start: ``python -m benchmarks.startup``. Compare the ratios;
machines are shared.

The time of the clock grows with whatever else runs; that of the processor is the start's own.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.record import log_row, recording

PROCESSES = 5
"""Number of processes per command, whose median is printed."""

COMMANDS = (("-c", "pass"), ("-m", "service", "--help"), ("-m", "service", "keys", "list"))


def start(command: tuple[str, ...], data_dir: Path) -> tuple[float, float]:
    """Wall and processor time [s] of one process of this interpreter."""
    environment = os.environ | {"HELIOTWIN_DATA_DIR": str(data_dir)}
    environment.pop("HELIOTWIN_DATABASE_URL", None)
    began, used = time.perf_counter(), os.times()
    subprocess.run(
        [sys.executable, *command], env=environment, check=True, stdout=subprocess.DEVNULL
    )
    now = os.times()
    cpu = now.children_user + now.children_system - used.children_user - used.children_system
    return time.perf_counter() - began, cpu


def main() -> None:
    """Print the medians, and how often each is that of an interpreter that does nothing."""
    print(
        f"Start-up, median of {PROCESSES} processes (load of the machine: {os.getloadavg()[0]:.1f})"
    )
    base = None
    with tempfile.TemporaryDirectory() as folder:
        for command in COMMANDS:
            start(
                command, Path(folder)
            )  # compiled files, the disk's cache, and the store are there from now on
            wall, cpu = np.median([start(command, Path(folder)) for _ in range(PROCESSES)], axis=0)
            base = base or (wall, cpu)
            print(
                f"  python {' '.join(command)}: {wall:.2f} s of wall time ({wall / base[0]:.0f}"
                f" times), {cpu:.2f} s of processor time ({cpu / base[1]:.0f} times)"
            )
            log_row(
                "Start of a command",
                f"`python {' '.join(command)}`",
                {"wall [s]": wall, "processor [s]": cpu, "processor, ratio": cpu / base[1]},
                n=PROCESSES,
                of="processes",
                compared_with="an interpreter that does nothing",
            )


if __name__ == "__main__":
    with recording("startup"):
        main()
