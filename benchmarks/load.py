"""Fifty clients on the service with the real model: ``python -m benchmarks.load [--database
postgres]``.

Each client does what clients of a plant do, one thing after the other with a pause between: posts
photographs (real ones of the Solar Tower Juelich, each made another by a little noise), reads,
predicts, forecasts, looks at pages. Prints answers, errors and times by what was asked, and the
memory of the service. The clients run on the same machine.

``--in-turn N`` sends N requests of each kind instead, one after the other, and prints what each
takes of the processor, with what the service does in the background because of it. To compare two
commits, run both in turns on an idle machine (``load-in-turn``).
"""

import argparse
import asyncio
import json
import random
import resource
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

from benchmarks import data_folder
from benchmarks.record import log_row, recording
from tests.faults.harness import ROOT, Process, Store, new_store
from tests.service.conftest import metadata_of

HELIOSTATS = ("AA39", "AC43")
_SETTLE_S = 3.0
"""Time after requests in which the background work that they cause is done."""
SUN = {"azimuth_deg": 200.0, "elevation_deg": 45.0}


@dataclass
class Tally:
    """Times [s] and failures by what was asked."""

    times: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    failures: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    acknowledged: set[str] = field(default_factory=set)


class Visitor:
    """What a client may ask; each method is one request."""

    def __init__(self, http: httpx.AsyncClient, tally: Tally, seed: int) -> None:
        self.http, self.tally = http, tally
        self.random = random.Random(seed)
        self.noise = np.random.default_rng(seed)

    async def photograph(self) -> httpx.Response:
        name = self.random.choice(HELIOSTATS)
        file = self.random.choice(sorted((data_folder() / name / "Calibration").glob("*-flux.png")))
        paint = file.with_name(f"{file.name.split('-')[0]}-calibration-properties.json")
        document = metadata_of(json.loads(paint.read_bytes()))
        pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert pixels is not None
        noisy = np.clip(pixels + self.noise.normal(0, 1, pixels.shape), 0, 255).astype(np.uint8)
        identifier = uuid.uuid4().hex
        answer = await self.http.post(
            f"/v1/heliostats/{name}/measurements",
            files={"image": ("spot.png", cv2.imencode(".png", noisy)[1].tobytes(), "image/png")},
            data={"metadata": json.dumps(document | {"kind": "flux", "id": identifier})},
        )
        if answer.status_code == 201:
            self.tally.acknowledged.add(identifier)
        return answer

    async def read(self) -> httpx.Response:
        name = self.random.choice(HELIOSTATS)
        path = self.random.choice(
            [
                "heliostats",
                f"heliostats/{name}",
                f"heliostats/{name}/measurements?limit=20",
                f"heliostats/{name}/surfaces/current",
                f"heliostats/{name}/surfaces?limit=20",
                "jobs?limit=20",
            ]
        )
        return await self.http.get(f"/v1/{path}")

    async def surface(self) -> httpx.Response:
        return await self.http.post(
            f"/v1/heliostats/{self.random.choice(HELIOSTATS)}/surfaces", json={"images": 8}
        )

    async def forecast(self) -> httpx.Response:
        asked = {
            "heliostat": self.random.choice(HELIOSTATS),
            "target": "multi_focus_tower",
            "sun": SUN,
        }
        return await self.http.post("/v1/forecasts", json=asked)

    async def page(self) -> httpx.Response:
        path = self.random.choice(
            ["/", f"/heliostats/{self.random.choice(HELIOSTATS)}", "/forecast", "/jobs"]
        )
        return await self.http.get(path, headers={"Accept": "text/html"})

    async def metrics(self) -> httpx.Response:
        return await self.http.get("/metrics")

    def choose(self) -> Callable[[], Awaitable[httpx.Response]]:
        weighted = {
            self.photograph: 30,
            self.read: 45,
            self.forecast: 12,
            self.page: 10,
            self.surface: 2,
            self.metrics: 1,
        }
        return self.random.choices(list(weighted), list(weighted.values()))[0]

    async def ask(self, action: Callable[[], Awaitable[httpx.Response]]) -> None:
        name = action.__name__
        started = time.perf_counter()
        try:
            status = (await action()).status_code
            if status >= 400:
                self.tally.failures[name][str(status)] += 1
        except httpx.TransportError as error:
            self.tally.failures[name][type(error).__name__] += 1
        self.tally.times[name].append(time.perf_counter() - started)


async def _visit(base: str, tally: Tally, seed: int, until_s: float, pause_s: float) -> None:
    async with httpx.AsyncClient(base_url=base, timeout=60) as http:
        visitor = Visitor(http, tally, seed)
        await asyncio.sleep(visitor.random.uniform(0, pause_s))
        while time.monotonic() < until_s:
            await visitor.ask(visitor.choose())
            await asyncio.sleep(visitor.random.expovariate(1 / pause_s))


async def _warm_up(base: str) -> None:
    async with httpx.AsyncClient(base_url=base, timeout=120) as http:
        visitor = Visitor(http, Tally(), 10**6)
        for action in (
            visitor.photograph,
            visitor.surface,
            visitor.forecast,
            visitor.page,
            visitor.read,
        ):
            for _ in range(5):
                await visitor.ask(action)
        assert not visitor.tally.failures, visitor.tally.failures


async def _visits(service: Process, tally: Tally, options: argparse.Namespace) -> list[float]:
    """The visits of all clients; the service's memory [MB] after each fifth of the time."""
    until_s, memory = time.monotonic() + options.seconds, []

    async def watch() -> None:
        for _ in range(5):
            await asyncio.sleep(options.seconds / 5)
            memory.append(_status(service.number, "VmRSS"))

    visits = (
        _visit(service.base, tally, seed, until_s, options.pause) for seed in range(options.clients)
    )
    await asyncio.gather(watch(), *visits)
    return memory


async def _in_turn(service: Process, count: int) -> None:
    """Send ``count`` requests of each kind, one after the other, and print what they take."""
    async with httpx.AsyncClient(base_url=service.base, timeout=120) as http:
        visitor = Visitor(http, Tally(), 7)
        for action in (visitor.photograph, visitor.read, visitor.page, visitor.forecast):
            begun = _cpu_s(service.number)
            for _ in range(count):
                await visitor.ask(action)
            await asyncio.sleep(_SETTLE_S)
            name = action.__name__
            row = {
                "median answer [ms]": 1e3 * float(np.median(visitor.tally.times[name])),
                "processor time [ms]": 1e3 * (_cpu_s(service.number) - begun) / count,
            }
            print(f"{name:12}" + ", ".join(f"{what} {value:.1f}" for what, value in row.items()))
            log_row("Requests in turn", name, row, n=count, of="requests")
        assert not visitor.tally.failures, visitor.tally.failures


def _status(number: int, name: str) -> float:
    """A figure of the process's memory [MB]."""
    text = Path(f"/proc/{number}/status").read_text()
    return int(next(line for line in text.splitlines() if line.startswith(name)).split()[1]) / 1024


def _cpu_s(number: int) -> float:
    fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def import_two(store: Store) -> None:
    """The plant and two of its mirrors."""
    with tempfile.TemporaryDirectory() as folder:
        for name in (*HELIOSTATS, "WRI1030197-tower-measurements.json"):
            (Path(folder) / name).symlink_to((data_folder() / name).resolve())
        environment = {
            "HELIOTWIN_DATA_DIR": str(store.folder),
            "HELIOTWIN_DATABASE_URL": store.url or "",
        }
        environment |= {
            "HELIOTWIN_MIGRATE_ON_START": "true",
            "PATH": "/usr/bin:/bin",
            "OMP_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "service", "import", folder, "--json"]
        subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.DEVNULL)


def _row(name: str, times: list[float], failures: Counter[str]) -> str:
    p50, p99 = np.percentile(times, [50, 99]) * 1e3
    counts = ", ".join(f"{count} x {kind}" for kind, count in failures.items()) or "0"
    log_row(
        "Answers of the service",
        name,
        {"errors": counts, "median [ms]": p50, "99 % [ms]": p99, "longest [ms]": max(times) * 1e3},
        n=len(times),
        of="requests",
    )
    return f"| {name} | {len(times)} | {counts} | {p50:.0f} | {p99:.0f} | {max(times) * 1e3:.0f} |"


def _report(
    tally: Tally, seconds: float, memory: dict[str, float], cpu_s: tuple[float, float]
) -> None:
    everything = [taken for times in tally.times.values() for taken in times]
    failures: Counter[str] = sum(tally.failures.values(), Counter())
    print(
        "| asked | answers | errors | p50 [ms] | p99 [ms] | longest [ms] |\n| --- | --- | --- | ---"
        " | --- | --- |"
    )
    for name in sorted(tally.times):
        print(_row(name, tally.times[name], tally.failures[name]))
    print(_row("all", everything, failures))
    print(
        f"{len(everything) / seconds:.1f} answers/s; CPU: service {cpu_s[0]:.0f} s, clients"
        f" {cpu_s[1]:.0f} s"
    )
    print("memory [MB]: " + ", ".join(f"{name} {value:.0f}" for name, value in memory.items()))
    log_row("Load", "answers a second", {"value": len(everything) / seconds})
    log_row("Load", "processor time of the service [s]", {"value": cpu_s[0]})
    for name, value in memory.items():
        log_row("Memory of the service", name, {"memory [MB]": value})


def _require_all(store: Store, base: str, acknowledged: set[str]) -> None:
    stored: set[str] = set()
    for name in HELIOSTATS:
        after: dict[str, Any] = {}
        while True:
            page = httpx.get(
                f"{base}/v1/heliostats/{name}/measurements", params={"limit": 500, **after}
            ).json()
            stored |= {item["id"] for item in page["items"]}
            if page["next"] is None:
                break
            after = {"after": page["next"]}
    report = store.check()
    print(
        f"{len(acknowledged)} photographs acknowledged, {len(acknowledged - stored)} lost,"
        f" {len(report.bad)} bad"
    )
    lost = {"lost": len(acknowledged - stored), "bad": len(report.bad)}
    log_row("Photographs acknowledged", "all", lost, n=len(acknowledged), of="photographs")


def main(arguments: list[str]) -> None:
    """Run the clients and print what they met."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--database", choices=("sqlite", "postgres"), default="sqlite")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument(
        "--pause", type=float, default=2.0, help="mean pause of a client between two requests [s]"
    )
    parser.add_argument("--in-turn", type=int, metavar="N", help="send N of each kind in turn")
    options = parser.parse_args(arguments)
    if not data_folder().is_dir():
        parser.error(f"no real measurements at {data_folder()}; set HELIOTWIN_STJ")
    load = Path("/proc/loadavg").read_text().split()[0]
    print(
        f"{options.database}, {options.clients} clients, {options.seconds:.0f} s, pause"
        f" {options.pause} s, load {load}"
    )
    with (
        tempfile.TemporaryDirectory() as folder,
        new_store(options.database, Path(folder)) as store,
    ):
        import_two(store)
        extra: dict[str, Any] = {
            "HELIOTWIN_JOB_WORKERS": "1",
            "HELIOTWIN_JOB_LEASE_S": "30",
            "HELIOTWIN_JOB_POLL_S": "0.5",
        }
        what = f"{options.database}-{options.clients}-clients-{round(options.seconds / 60)}-minutes"
        with (
            Process(store, "serve", module="service", **extra) as service,
            recording(f"load-{what if options.in_turn is None else 'in-turn'}"),
        ):
            asyncio.run(_warm_up(service.base))
            if options.in_turn is not None:
                asyncio.run(_in_turn(service, options.in_turn))
                return
            tally, number = Tally(), service.number
            memory, cpu_s = {"before": _status(number, "VmRSS")}, _cpu_s(number)
            own = resource.getrusage(resource.RUSAGE_SELF).ru_utime
            grown = asyncio.run(_visits(service, tally, options))
            memory |= {f"after {part}/5": value for part, value in enumerate(grown, start=1)}
            memory["highest"] = _status(number, "VmHWM")
            spent = (
                _cpu_s(number) - cpu_s,
                resource.getrusage(resource.RUSAGE_SELF).ru_utime - own,
            )
            _report(tally, options.seconds, memory, spent)
            _require_all(store, service.base, tally.acknowledged)


if __name__ == "__main__":
    main(sys.argv[1:])
