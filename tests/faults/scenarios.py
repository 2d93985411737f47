"""The faults. Each function causes one and returns what happened.

It raises AssertionError if something acknowledged is lost.
"""

import random
import shutil
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import httpx
from sqlalchemy import make_url

from tests.service.conftest import png
from tests.waiting import until

from .harness import Client, Process, Proxy, Store

Scenario = Callable[[Store], str]


class NotTriedError(Exception):
    """The fault cannot be made here; the message says why."""


@contextmanager
def _posting(client: Client, seeds: Iterator[int], threads: int = 4) -> Iterator[Counter[int]]:
    """Post photographs from some threads until the block ends; counts answers by status, 0 for
    none.
    """
    stop, statuses = threading.Event(), Counter[int]()

    def send() -> None:
        while not stop.is_set():
            try:
                statuses[client.post(png(next(seeds))).status_code] += 1
            except httpx.TransportError:
                statuses[0] += 1
                stop.wait(0.05)

    running = [threading.Thread(target=send) for _ in range(threads)]
    for thread in running:
        thread.start()
    try:
        yield statuses
    finally:
        stop.set()
        for thread in running:
            thread.join()


class _Counter:
    """Numbers for several threads."""

    def __init__(self) -> None:
        self._lock, self._number = threading.Lock(), 0

    def __iter__(self) -> "_Counter":
        return self

    def __next__(self) -> int:
        with self._lock:
            self._number += 1
            return self._number


# --- killed
# --------------------------------------------------------------------------------------------------


def kill_during_ingest(store: Store, rounds: int = 3) -> str:
    """kill -9 of the service while four clients post; what it acknowledged is there when it is
    back.
    """
    seeds, kept, unanswered = _Counter(), {}, 0
    for number in range(rounds):
        with Process(store) as service:
            client = service.client()
            client.kept = kept
            if not number:
                client.set_up()
            known = len(kept)
            with _posting(client, seeds) as statuses:
                until(lambda known=known: len(kept) > known + 10, "photographs come")
                service.kill()
                time.sleep(0.2)
            unanswered += statuses[0]
    with Process(store) as service:
        client = service.client()
        client.kept = kept
        count = client.require_kept()
        stored = len(client.measurements())
        assert client.post(png(next(seeds))).status_code == 201
    report = store.check()
    assert not report.bad
    assert not report.database
    return (
        f"killed {rounds} times: {count} acknowledged, {count} there, 0 lost; {stored - count} more"
        f" were stored, unanswered; {report.unused + report.leftovers} files without a row"
    )


def kill_during_job(store: Store, heliostats: int = 8) -> str:
    """kill -9 of a worker in the midst of a job; another takes it up, and each surface is there
    once.
    """
    with Process(store) as service:
        client = service.client()
        names = client.set_up(heliostats)
        for seed, name in enumerate(names):
            assert client.post(png(seed), name).status_code == 201
        job = client.http.post("/v1/jobs/predictions", json={}).headers["Location"]

        def versions() -> list[int]:
            pages = [
                client.http.get(f"/v1/heliostats/{name}/surfaces").json()["items"] for name in names
            ]
            return [len(page) for page in pages]

        with Process(store, "worker", HELIOTWIN_FAULTS_MOST_PREDICTIONS="2") as worker:
            until(lambda: sum(versions()) >= 2, "the job is under way")
            worker.kill()
        before = sum(versions())
        assert before == 2, "the job went on after its worker was killed"
        with Process(store, "worker"):
            until(
                lambda: client.http.get(job).json()["state"] in ("done", "failed"), "the job ends"
            )
        done = client.http.get(job).json()
        assert done["state"] == "done", done
        assert versions() == [1] * heliostats
    attempt = done["attempts"]
    return (
        f"killed after {before} of {heliostats} surfaces: taken up again (attempt {attempt}), each"
        " is there once"
    )


# --- disks and networks
# -----------------------------------------------------------------------------------------------


@contextmanager
def _small_disk(folder: Path, megabytes: int) -> Iterator[None]:
    folder.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    if (
        shutil.which("mount") is None
        or subprocess.run(command, capture_output=True, check=False).returncode
    ):
        raise NotTriedError("a small disk (tmpfs) may not be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def full_disk(store: Store) -> str:
    """A data_dir on a disk (tmpfs) of 8 MB that fills up: the service answers 507.

    Nothing acknowledged is lost. When space is free again, it accepts photographs.
    """
    with _small_disk(store.folder, 8):
        ballast = store.folder / "ballast"
        ballast.write_bytes(bytes(2 * 2**20))
        with Process(store) as service:
            client, seeds = service.client(), _Counter()
            client.set_up()
            refused = until(lambda: _refusal(client, seeds), "the disk is full")
            _fill(store.folder / "rest")
            more = Counter(client.post(png(next(seeds), (8, 8))).status_code for _ in range(20))
            assert set(more) <= {201, 507}, more
            assert more[507]
            reads = client.http.get("/v1/heliostats").status_code
            assert reads == 200
            count = client.require_kept()
            for file in (ballast, store.folder / "rest"):
                file.unlink()
            assert client.post(png(next(seeds))).status_code == 201
            assert client.require_kept() == count + 1
        report = store.check()
        assert not report.bad
        assert not report.database
    detail = refused["detail"].partition(";")[0]
    return f"507 ({detail}); {count} acknowledged, {count} there, reads answer; with free space 201"


def _refusal(client: Client, seeds: _Counter) -> dict[str, str] | None:
    answer = client.post(png(next(seeds), (300, 300)))
    if answer.status_code == 201:
        return None
    assert answer.status_code == 507, answer.text
    document: dict[str, str] = answer.json()
    return document


def _fill(file: Path) -> None:
    """Fill the disk."""
    with suppress(OSError), file.open("wb", buffering=0) as rest:
        while True:
            rest.write(bytes(4096))


def database_gone(store: Store, away_s: float = 2.0) -> str:
    """PostgreSQL out of reach (a relay to it is cut) while clients post and a job runs; back, it
    goes on by itself.
    """
    if store.url is None:
        raise NotTriedError("SQLite is a file of the service")
    url = make_url(store.url)
    proxy = Proxy(url.host or "127.0.0.1", url.port or 5432)
    through = url.set(host="127.0.0.1", port=proxy.port).render_as_string(hide_password=False)
    behind = replace(store, url=through)
    with Process(behind, HELIOTWIN_JOB_WORKERS="1", HELIOTWIN_FAULTS_PAUSE_S="0.3") as service:
        client = service.client()
        names = client.set_up(8)
        for seed, name in enumerate(names):
            assert client.post(png(10_000 + seed), name).status_code == 201
        job = client.http.post("/v1/jobs/predictions", json={}).headers["Location"]
        with _posting(client, _Counter()) as statuses:
            until(lambda: statuses[201] > 10, "photographs come")
            proxy.cut()
            until(lambda: statuses[503] > 3, "the fault is reported")
            answer = client.http.get("/v1/heliostats")
            assert answer.status_code == 503
            assert answer.headers["Retry-After"]
            assert service.is_alive()
            time.sleep(away_s)
            proxy.mend()
            mended = time.monotonic()
            known = statuses[201]
            until(lambda: statuses[201] > known, "photographs come again")
            back_s = time.monotonic() - mended
        assert set(statuses) <= {200, 201, 503}, statuses
        done = until(
            lambda: (j := client.http.get(job).json())["state"] in ("done", "failed") and j,
            "the job ends",
        )
        assert done["state"] == "done", done
        surfaces = [
            len(client.http.get(f"/v1/heliostats/{name}/surfaces").json()["items"])
            for name in names
        ]
        assert surfaces == [1] * len(names)
        count = client.require_kept()
    proxy.cut()
    return (
        f"{statuses[503]} answers 503, no other error; back {back_s:.1f} s after the database, no"
        f" restart; {count} acknowledged, {count} there; the job under way done once (attempt"
        f" {done['attempts']})"
    )


# --- senders and clocks
# -----------------------------------------------------------------------------------------------


def duplicates_and_disorder(store: Store) -> str:
    """The same photographs from eight clients at once, in any order; then old ones
    after new ones.
    """
    with Process(store) as service:
        client = service.client()
        client.set_up()
        posts = [seed for seed in range(10) for _ in range(8)]
        random.Random(1).shuffle(posts)
        with ThreadPoolExecutor(8) as pool:
            statuses = Counter(pool.map(lambda seed: client.post(png(seed)).status_code, posts))
        assert statuses == {201: 10, 200: 70}, statuses
        assert len(client.measurements()) == 10
        surfaces = "/v1/heliostats/H0/surfaces"
        for day in (5, 1, 3):  # the newest first
            answer = client.post(
                png(100 + day), id=f"day{day}", taken_at=f"2024-06-0{day}T12:00:00Z"
            )
            assert answer.status_code == 201
            predicted = client.http.post(surfaces, json={"measurements": [f"day{day}"]})
            assert predicted.status_code == 201
        current = client.http.get(f"{surfaces}/current").json()
        assert current["version"] == 1, "an old photograph that came late made the current surface"
        then = client.http.get(surfaces, params={"at": "2024-06-04T00:00:00Z"}).json()
        assert then["version"] == 3
        count = client.require_kept()
    return (
        "80 posts of 10 photographs: 10 times 201, 70 times 200; late old ones change nothing;"
        f" {count} there"
    )


def clock_jumps(store: Store) -> str:
    """The service's clock goes back a day and ahead a day, while photographs come, a job waits and
    a job runs.
    """
    clock = store.folder.parent / f"{store.folder.name}.clock"
    clock.write_text("0")
    moved = replace(store, environment={"HELIOTWIN_FAULTS_CLOCK": str(clock)})
    with Process(moved) as service:
        client, seeds = service.client(), _Counter()
        names = client.set_up(4)
        for name in names:
            assert client.post(png(next(seeds)), name).status_code == 201
        assert client.http.post("/v1/heliostats/H0/surfaces", json={}).status_code == 201
        waiting = client.http.post("/v1/jobs/predictions", json={}).headers["Location"]
        clock.write_text("-86400")
        assert client.http.get("/v1/heliostats/H0/surfaces/current").status_code == 200
        assert client.post(png(next(seeds)), taken_at="2024-06-01T12:00:00Z").status_code == 201
        started = time.monotonic()
        with Process(moved, "worker", HELIOTWIN_FAULTS_PAUSE_S="0.5"):
            until(
                lambda: client.http.get(waiting).json()["progress"] > 0.2,
                "the job that waited is taken up",
            )
            waited_s = time.monotonic() - started
            clock.write_text("86400")
            assert client.post(png(next(seeds))).status_code == 201
            until(
                lambda: client.http.get(waiting).json()["state"] in ("done", "failed"),
                "the job ends",
            )
        clock.write_text("0")
        done = client.http.get(waiting).json()
        assert done["state"] == "done", done
        counts = [
            len(client.http.get(f"/v1/heliostats/{name}/surfaces").json()["items"])
            for name in names
        ]
        assert counts == [2, 1, 1, 1]
        future = client.post(png(next(seeds)), taken_at="2999-01-01T00:00:00Z")
        assert future.status_code == 422
        assert "taken_at" in future.json()["detail"]
        count = client.require_kept()
    return (
        f"a job that waited is taken up {waited_s:.0f} s after its worker starts, though the clock"
        " went back a day, and done once though it then went two ahead; photographs from the"
        f" future 422; {count} acknowledged, {count} there"
    )


# --- the store
# --------------------------------------------------------------------------------------------------


def corrupt_images(store: Store) -> str:
    """One file altered, one cut off, one gone: three clear errors, all else works; posted again
    they are whole.
    """
    with Process(store) as service:
        client = service.client()
        client.set_up()
        for seed in range(6):
            assert client.post(png(seed)).status_code == 201
        first, second, third, *_ = sorted(
            path for path in (store.folder / "images").rglob("*") if path.is_file()
        )
        first.write_bytes(first.read_bytes()[:-1] + b"?")
        second.write_bytes(b"")
        third.unlink()
        answers: Counter[int] = Counter()
        for key in client.kept:
            path = f"/v1/heliostats/H0/measurements/{key.partition('/')[2]}"
            answer = client.http.get(f"{path}/image")
            answers[answer.status_code] += 1
            if answer.status_code != 200:
                assert "heliotwin check" in answer.json()["detail"]
            assert client.http.get(f"{path}/flux").status_code == 200
        assert answers == {200: 3, 500: 3}, answers
        assert client.http.post("/v1/heliostats/H0/surfaces", json={}).status_code == 201
        assert len(store.check().bad) == 3
        for seed in range(6):
            assert client.post(png(seed)).status_code == 200
        assert not store.check().bad
        client.require_kept()
    return (
        "3 reads answer 500 and name the image, fluxes and predictions work, check lists 3; posted"
        " again all are whole"
    )


SCENARIOS: dict[str, Scenario] = {
    scenario.__name__: scenario
    for scenario in (
        kill_during_ingest,
        kill_during_job,
        full_disk,
        database_gone,
        duplicates_and_disorder,
        clock_jumps,
        corrupt_images,
    )
}
