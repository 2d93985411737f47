"""A victim beside a greedy key: ``python -m benchmarks.greedy [--database postgres]``.

On the service with the real model, which knows two mirrors of the Solar Tower Juelich, sixteen
connections ask with one key, each as soon as it has its answer: for a forecast of 1024 x 1024 as
JSON, for pages with it, for predictions, or with photographs, frames of 5 and of 48 megapixels
among them. Meanwhile another key reads plain routes and /readyz, or asks for forecasts
(``--victim model``), or sends photographs (``--victim photographs``). Prints its times, alone and
beside each, and what the greedy one was answered. ``--heliostats N`` adds so many with photographs
and surfaces. All clients run on the same machine as the service.
"""

import argparse
import asyncio
import itertools
import json
import struct
import sys
import tempfile
import time
import uuid
import zlib
from collections import Counter
from collections.abc import Awaitable, Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

from benchmarks import data_folder, field
from benchmarks.load import HELIOSTATS, SUN, Tally, Visitor, import_two
from benchmarks.record import log_row, recording
from service.store import keys
from service.store.database import Database, migrate
from tests.faults.harness import Process, Store, new_store

CONNECTIONS = 16
PLAIN = (
    "/v1/heliostats",
    "/v1/heliostats/AA39",
    "/v1/forecasts?limit=20",
    "/v1/jobs",
    "/v1/targets",
    "/readyz",
)
FORECAST = {
    "heliostat": "AA39",
    "target": "multi_focus_tower",
    "sun": SUN,
    "surface": "ideal",
    "resolution": 1024,
}

Ask = Callable[[Visitor], Awaitable[httpx.Response]]


async def _map(visitor: Visitor) -> httpx.Response:
    return await visitor.http.get("/v1/forecasts/1")


async def _page(visitor: Visitor) -> httpx.Response:
    path = visitor.random.choice(["/forecasts/1", "/heliostats/AA39", "/"])
    return await visitor.http.get(path, headers={"Accept": "text/html"})


@cache
def _frame_file(rows: int, columns: int, levels: int) -> bytes:
    """A noisy camera frame."""
    pixels = np.random.default_rng(0).integers(0, levels, (rows, columns), dtype=np.uint8)
    return cv2.imencode(".png", pixels)[1].tobytes()


def _labelled(png: bytes, label: str) -> bytes:
    """The same picture in a file that differs, by a chunk of text before its last chunk."""
    chunk = b"tEXtid\0" + label.encode()
    length, checksum = struct.pack(">I", len(chunk) - 4), struct.pack(">I", zlib.crc32(chunk))
    return png[:-12] + length + chunk + checksum + png[-12:]


async def _post_frame(visitor: Visitor, rows: int, columns: int, levels: int) -> httpx.Response:
    identifier = uuid.uuid4().hex
    sent = {"kind": "raw", "id": identifier, "target": "multi_focus_tower"}
    image = _labelled(_frame_file(rows, columns, levels), identifier)
    return await visitor.http.post(
        "/v1/heliostats/AA39/measurements",
        files={"image": ("frame.png", image, "image/png")},
        data={
            "metadata": json.dumps({**sent, "sun": {"azimuth_deg": 180.0, "elevation_deg": 45.0}})
        },
    )


async def _frame(visitor: Visitor) -> httpx.Response:
    """A frame of 5 megapixels and some 5 MB."""
    return await _post_frame(visitor, 2048, 2448, 255)


async def _largest_frame(visitor: Visitor) -> httpx.Response:
    """A frame of 48 megapixels, which is nearly the largest accepted, and some 13 MB."""
    return await _post_frame(visitor, 6000, 8000, 4)


async def _field(visitor: Visitor) -> httpx.Response:
    return await visitor.http.get(visitor.random.choice(["/v1/field", "/v1/alarms", "/metrics"]))


GREEDY: dict[str, tuple[str, Ask]] = {
    "maps": ("read", _map),
    "pages": ("read", _page),
    "predictions": ("operate", Visitor.surface),
    "photographs": ("ingest", Visitor.photograph),
    "frames": ("ingest", _frame),
    "frames48": ("ingest", _largest_frame),
    "field": ("read", _field),
}
"""What a greedy key asks for, and its role."""


def _client(base: str, key: str) -> httpx.AsyncClient:
    return httpx.AsyncClient(base_url=base, headers={"Authorization": f"Bearer {key}"}, timeout=60)


async def _greedy(base: str, key: str, ask: Ask, seed: int, answers: Counter[str]) -> None:
    async with _client(base, key) as http:
        visitor = Visitor(http, Tally(), seed)
        while True:
            try:
                answers[str((await ask(visitor)).status_code)] += 1
            except httpx.TransportError as error:
                answers[type(error).__name__] += 1


async def _photograph(http: httpx.AsyncClient, turn: int) -> httpx.Response:
    return await Visitor(http, Tally(), 10**7 + turn).photograph()


async def _plain(http: httpx.AsyncClient, turn: int) -> httpx.Response:
    return await http.get(PLAIN[turn % len(PLAIN)])


async def _model(http: httpx.AsyncClient, turn: int) -> httpx.Response:
    return await http.post(
        "/v1/forecasts", json={**FORECAST, "resolution": 64, "dni_w_m2": 500 + turn % 1000}
    )


VICTIMS = {"plain": _plain, "model": _model, "photographs": _photograph}
"""What the victim asks for: plain routes, a forecast, which needs the model, or photographs."""


async def _victim(
    base: str, key: str, ask: Any, seconds: float, pause_s: float
) -> tuple[list[float], Counter[str]]:
    """Its times [s] and what it was answered."""
    times, answers, until_s = list[float](), Counter[str](), time.monotonic() + seconds
    async with _client(base, key) as http:
        for turn in itertools.count():
            if time.monotonic() > until_s:
                return times, answers
            began = time.perf_counter()
            answers[str((await ask(http, turn)).status_code)] += 1
            times.append(time.perf_counter() - began)
            await asyncio.sleep(pause_s)
    raise AssertionError


async def _beside(
    base: str, made: dict[str, str], name: str | None, options: argparse.Namespace
) -> str:
    """A row: the victim alone, or beside the greedy key that asks for ``name``."""
    met: Counter[str] = Counter()
    crowd = []
    if name is not None:
        role, ask = GREEDY[name]
        crowd = [
            asyncio.create_task(_greedy(base, made[role], ask, seed, met))
            for seed in range(CONNECTIONS)
        ]
        await asyncio.sleep(2)  # its burst is over
    times, answers = await _victim(
        base, made["victim"], VICTIMS[options.victim], options.seconds, options.pause
    )
    for one in crowd:
        one.cancel()
    await asyncio.gather(*crowd, return_exceptions=True)
    invalid = {kind for kind in met if kind[0] == "4" and kind != "429"}
    assert not invalid, f"{name}: {met}"  # a request that the service does not accept costs little
    p50, p99 = np.percentile(times, [50, 99]) * 1e3
    log_row(
        f"{options.victim.capitalize()} requests of one key next to a greedy key",
        name or "alone",
        {
            "median [ms]": p50,
            "99 % [ms]": p99,
            "longest [ms]": max(times) * 1e3,
            "answers other than 2xx": sum(n for kind, n in answers.items() if kind[0] != "2"),
        },
        n=len(times),
        of="requests",
    )
    sent = [
        ", ".join(f"{count} x {kind}" for kind, count in sorted(some.items())) or "-"
        for some in (answers, met)
    ]
    return (
        f"| {name or 'alone'} | {sent[0]} | {p50:.0f} | {p99:.0f} | {max(times) * 1e3:.0f} |"
        f" {sent[1]} |"
    )


def _keys(store: Store) -> dict[str, str]:
    """A key of each role, and the victim's."""
    database = Database(store.settings.database)
    with database.writing() as session:
        made = {
            role: keys.create(session, role, role, "bench")
            for role in ("read", "ingest", "operate")
        }
        made["victim"] = keys.create(session, "victim", "operate", "bench")
    database.close()
    return made


async def _fill(base: str, made: dict[str, str]) -> None:
    """A large forecast, and photographs and a surface to predict and draw from."""
    async with _client(base, made["operate"]) as http:
        visitor = Visitor(http, Tally(), 10**6)
        (await http.post("/v1/forecasts", json=FORECAST)).raise_for_status()
        for _ in range(2 * len(HELIOSTATS)):
            (await visitor.photograph()).raise_for_status()
            (await visitor.surface()).raise_for_status()
        for page in ("/", "/forecasts/1", "/heliostats/AA39"):
            (await http.get(page, headers={"Accept": "text/html"})).raise_for_status()


async def _run(base: str, made: dict[str, str], options: argparse.Namespace) -> None:
    await _fill(base, made)
    print(
        "| beside | victim's answers | p50 [ms] | p99 [ms] | longest [ms] | greedy one's answers |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for name in (None, *options.greedy):
        print(await _beside(base, made, name, options), flush=True)


def main(arguments: list[str]) -> None:
    """Run each and print what the victim met."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.greedy", description="A victim's times beside a greedy key."
    )
    parser.add_argument("--database", choices=("sqlite", "postgres"), default="sqlite")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each")
    parser.add_argument(
        "--pause", type=float, default=0.05, help="of the victim between two requests [s]"
    )
    parser.add_argument("--greedy", nargs="+", choices=tuple(GREEDY), default=list(GREEDY))
    parser.add_argument("--heliostats", type=int, default=0, help="that the store has besides")
    parser.add_argument(
        "--victim", choices=tuple(VICTIMS), default="plain", help="what the victim asks for"
    )
    parser.add_argument(
        "--unlimited", action="store_true", help="let each key ask as often as it likes"
    )
    options = parser.parse_args(arguments)
    if not data_folder().is_dir():
        parser.error(f"no real measurements at {data_folder()}; set HELIOTWIN_STJ")
    limits: dict[str, Any] = {}
    if not options.unlimited:
        limits = {"HELIOTWIN_REQUESTS_PER_S": "200", "HELIOTWIN_REQUESTS_BURST": "400"}
    load = Path("/proc/loadavg").read_text().split()[0]
    print(
        f"{options.database}, {options.seconds:.0f} s each, load"
        f" {load}{', unlimited' * options.unlimited}"
    )
    with (
        tempfile.TemporaryDirectory() as folder,
        new_store(options.database, Path(folder)) as store,
    ):
        if options.heliostats:
            store.folder.mkdir(exist_ok=True)
            migrate(store.settings)
            database = Database(store.settings.database)
            field.fill(database, options.heliostats)
            database.close()
        import_two(store)
        size = f"-{options.heliostats}" if options.heliostats else ""
        with (
            Process(store, "serve", module="service", **limits) as service,
            recording(f"greedy-{options.database}{size}"),
        ):
            asyncio.run(_run(service.base, _keys(store), options))


if __name__ == "__main__":
    main(sys.argv[1:])
