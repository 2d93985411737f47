"""Faults tried for real, each with its outcome: ``python -m benchmarks.faults
[sqlite|postgres] [NAME ...]``.
"""

import sys
import tempfile
import time
from pathlib import Path

from benchmarks.record import log_row, recording
from tests.faults.harness import new_store
from tests.faults.scenarios import SCENARIOS, NotTriedError

ENGINES = ("sqlite", "postgres")


def main(arguments: list[str]) -> int:
    """Try every fault on both databases, or those that are named; 1 where something acknowledged
    was lost.
    """
    engines = [engine for engine in ENGINES if engine in arguments] or list(ENGINES)
    names = [name for name in SCENARIOS if name in arguments] or list(SCENARIOS)
    lost = 0
    for name in names:
        for engine in engines:
            started = time.monotonic()
            try:
                with (
                    tempfile.TemporaryDirectory() as folder,
                    new_store(engine, Path(folder)) as store,
                ):
                    outcome = SCENARIOS[name](store)
            except NotTriedError as reason:
                outcome = f"not tried: {reason}"
            except AssertionError as failure:
                outcome, lost = f"FAILED: {failure}", 1
            print(f"{name}, {engine} ({time.monotonic() - started:.0f} s): {outcome}", flush=True)
            log_row("Faults and their outcomes", name, {engine: outcome})
    return lost


if __name__ == "__main__":
    with recording("faults"):
        status = main(sys.argv[1:])
    sys.exit(status)
