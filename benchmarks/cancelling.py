"""How jobs report progress, and how soon they end: ``python -m benchmarks.cancelling``.

A service with the real model and one worker knows two mirrors of the Solar Tower Juelich with their
photographs, and a field of ideal mirrors. Each kind of job is followed once: the table has what its
page shows, by the second. Then each is begun again and cancelled after several times; printed is
the time from the request until the job is cancelled. The goal is 2 s.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks import data_folder
from benchmarks.fleet import Field
from benchmarks.load import HELIOSTATS, SUN, import_two
from benchmarks.record import Estimate, log_row, recording
from heliotwin.demo.plant import ORIGIN, properties
from model.plant import Plant
from service import store as stored
from service.store.database import Database
from tests.faults.harness import Process, Store, new_store

ENDED = ("done", "failed", "cancelled")
JOBS: dict[str, dict[str, Any]] = {
    "predictions": {"heliostats": [HELIOSTATS[0]], "method": "refined", "images": 8},
    "studies": {"heliostats": list(HELIOSTATS)},
    "forecasts": {"target": "multi_focus_tower", "sun": SUN, "surface": "current"},
}
_LOOK_EVERY_S = 0.1


def add_field(store: Store, count: int) -> None:
    """Add so many heliostats without surfaces to the store."""
    database, place = Database(store.settings.database), Plant("bench", np.array(ORIGIN))
    with database.writing() as session:
        for one in Field(count, 60.0).every():
            stored.put_heliostat(session, one.name, properties(one, place), one.position)
    database.close()


def begin(http: httpx.Client, kind: str) -> str:
    """Queue a job and wait until it runs; its path."""
    answer = http.post(f"/v1/jobs/{kind}", json=JOBS[kind]).raise_for_status()
    path = str(answer.headers["Location"])
    while http.get(path).json()["state"] == "queued":
        time.sleep(_LOOK_EVERY_S)
    return path


def changes(
    http: httpx.Client, path: str, limit_s: float
) -> Iterator[tuple[float, dict[str, Any]]]:
    """A job each time that it has changed, with the time since the first look [s], to its end."""
    began, last = time.monotonic(), None
    while (at := time.monotonic() - began) < limit_s:
        job = http.get(path).json()
        shown = job["state"], job["phase"], job["n_done"], job["n_total"], job["progress"]
        if shown != last:
            last = shown
            yield at, job
        if job["state"] in ENDED:
            return
        time.sleep(_LOOK_EVERY_S)


def follow(http: httpx.Client, kind: str, limit_s: float) -> None:
    """Print what the page of a job shows until its end, or for ``limit_s``."""
    path, seen = begin(http, kind), list[tuple[float, dict[str, Any]]]()
    for at, job in changes(http, path, limit_s):
        if not seen or (job["phase"], job["n_done"]) != (
            seen[-1][1]["phase"],
            seen[-1][1]["n_done"],
        ):
            left = "-" if job["remaining_s"] is None else f"{job['remaining_s']:.0f}"
            counts = f"{job['n_done']} of {job['n_total']}"
            print(
                f"| {kind} | {at:.1f} | {job['state']} | {job['phase']} | {counts} |"
                f" {job['progress']:.0%} | {left} |",
                flush=True,
            )
        seen.append((at, job))
    last_s, last = seen[-1]
    if last["state"] not in ENDED:
        cancel(http, path)
        return
    pauses = np.diff([at for at, _ in seen])
    found = [
        (at + job["remaining_s"]) / last_s for at, job in seen if job["remaining_s"] is not None
    ]
    ratios = f"{min(found):.2f} to {max(found):.2f}" if found else "never"
    print(
        f"{kind}: {last['state']} after {last_s:.1f} s; longest time without a change"
        f" {pauses.max():.1f} s; expected duration over the real one {ratios}\n"
    )


def cancel(http: httpx.Client, path: str) -> float:
    """Cancel a job; the time until it has ended [s]."""
    began = time.monotonic()
    http.post(f"{path}/cancel").raise_for_status()
    while (state := http.get(path).json()["state"]) not in ENDED:
        time.sleep(0.02)
    assert state == "cancelled", state
    return time.monotonic() - began


def cancelled(http: httpx.Client, kind: str, after: list[float]) -> str:
    """A row: how soon a job ended that was cancelled so long after its begin [s].

    Times after the end of the job are left out.
    """
    times, phases = [], []
    for wait_s in after:
        path = begin(http, kind)
        time.sleep(wait_s)
        job = http.get(path).json()
        if job["state"] in ENDED:
            break
        phases.append(job["phase"])
        times.append(cancel(http, path))
    each = ", ".join(f"{took:.2f}" for took in times)
    log_row(
        "Jobs that are cancelled",
        kind,
        {
            "ended after, at most [s]": Estimate(max(times), goal="<= 2"),
            "cancelled after [s]": ", ".join(f"{a:g}" for a in after[: len(times)]),
        },
        n=len(times),
        of="jobs",
    )
    return f"| {kind} | {each} | {max(times):.2f} | {'; '.join(dict.fromkeys(phases))} |"


def main(arguments: list[str]) -> None:
    """Follow each kind of job, then cancel it."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.cancelling",
        description="How jobs report progress, and how soon they end.",
    )
    parser.add_argument("--database", choices=("sqlite", "postgres"), default="sqlite")
    parser.add_argument("--heliostats", type=int, default=2000, help="of the field")
    parser.add_argument("--jobs", nargs="+", choices=tuple(JOBS), default=list(JOBS))
    parser.add_argument("--follow", type=float, default=120.0, help="each at most so long [s]")
    parser.add_argument(
        "--after", type=float, nargs="+", default=[0.5, 2, 5, 10, 15], help="cancel then [s]"
    )
    options = parser.parse_args(arguments)
    if not data_folder().is_dir():
        parser.error(f"no real measurements at {data_folder()}; set HELIOTWIN_STJ")
    load = Path("/proc/loadavg").read_text().split()[0]
    print(f"{options.database}, a field of {options.heliostats} heliostats, load {load}")
    with (
        tempfile.TemporaryDirectory() as folder,
        new_store(options.database, Path(folder)) as store,
    ):
        import_two(store)
        add_field(store, options.heliostats)
        environment: dict[str, Any] = {"HELIOTWIN_JOB_WORKERS": "1"}
        environment |= {"HELIOTWIN_JOB_LEASE_S": "60"}
        with (
            Process(store, "serve", module="service", **environment) as service,
            httpx.Client(base_url=service.base, timeout=60) as http,
        ):
            print("| job | after [s] | state | phase | done | share | expected to remain [s] |")
            print("| --- | --- | --- | --- | --- | --- | --- |")
            for kind in options.jobs:
                follow(http, kind, options.follow)
            print("| job | cancelled after [s] | longest [s] | phases |")
            print("| --- | --- | --- | --- |")
            for kind in options.jobs:
                print(cancelled(http, kind, options.after), flush=True)


if __name__ == "__main__":
    with recording("cancelling"):
        main(sys.argv[1:])
