"""Pages of a large field: ``python -m benchmarks.field [--database postgres] [--heliostats
N]``.

Fills a store with heliostats, each with photographs of several kinds and two surfaces. Prints the
server's time for the field's page, its filters and its listing: for the first request after a
start, and for later ones. Accuracies are random numbers, not traced: the service computes each only
once, in the background.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any
from unittest import mock
from zlib import crc32

import numpy as np
from fastapi.testclient import TestClient
from sqlalchemy import insert

from benchmarks.record import Estimate, log_row, recording
from service import store
from service.base.arrays import pack
from service.base.settings import Settings
from service.sources.documents import read_targets
from service.store.columns import now
from service.store.database import Database
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow, SurfaceRow
from service.twin.alarms import field_overview
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import AccuracySeries, Rank
from service.web.app import create_app
from tests.faults.harness import new_store
from tests.service.conftest import (
    ORIGIN,
    QUIET,
    FakeOperations,
    client_of,
    properties_document,
    tower_document,
)

PHOTOGRAPHS = 8
"""Of each heliostat, images of the same measurement in two kinds; every tenth is refused."""

PATHS = {
    "the page": "/",
    "a search": "/?search=H012",
    "a filter": "/?show=flagged&sort=photographs",
    "sorted, page 50": "/?sort=uncertainty_mm&page=50",
    "another colour": "/?metric=deviation_mm",
    "photographs": "/photographs",
    "photographs that are refused": "/photographs?verdict=refused",
    "photographs that are excluded, of which there are none": "/photographs?verdict=excluded",
    "photographs on a target without any": "/photographs?target=upper",
    "photographs of a heliostat": "/photographs?heliostat=H00012",
    "photographs of a year ago": "/photographs?since=2025-01-01&until=2025-12-31",
    "photographs, far back": "/photographs?after=2000",
    "names": "/v1/heliostats?limit=100",
    "names, by a part": "/v1/heliostats?limit=100&search=99",
    "the field over REST": "/v1/field?limit=100&show=flagged",
}


def _chunks(count: int, size: int = 2000) -> Iterator[range]:
    return (range(first, min(first + size, count)) for first in range(0, count, size))


def fill(database: Database, count: int) -> None:
    """A store with so many heliostats, by statements of many rows."""
    rng, at = np.random.default_rng(5), now() - timedelta(days=30)
    properties = properties_document()
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        targets = [
            store.put_target(session, plane)[0].id
            for plane in read_targets(tower_document()).values()
        ]
    side = round(count**0.5)
    for numbers in _chunks(count):
        with database.writing() as session:
            session.execute(
                insert(HeliostatRow),
                [
                    {
                        "id": number + 1,
                        "name": f"H{number:05d}",
                        "properties": properties,
                        "east_m": 6.0 * (number % side - side / 2),
                        "north_m": 6.0 * (number // side) + 40.0,
                        "up_m": 1.8,
                    }
                    for number in numbers
                ],
            )
            session.execute(
                insert(ImageRow),
                [_image(number, shot) for number in numbers for shot in range(PHOTOGRAPHS)],
            )
            session.execute(
                insert(MeasurementRow),
                [
                    _measurement(number, shot, targets[0])
                    for number in numbers
                    for shot in range(PHOTOGRAPHS)
                ],
            )
            session.execute(
                insert(SurfaceRow),
                [
                    _surface(rng, number, version, at + timedelta(days=version))
                    for number in numbers
                    if number % 20
                    for version in (1, 2)
                ],
            )


def _image(number: int, shot: int) -> dict[str, Any]:
    size = {"size_bytes": 1000, "width_px": 100, "height_px": 80}
    return {
        "sha256": f"{number:032x}{shot:032x}",
        "media_type": "image/png",
        "accepted": bool(shot),
        **size,
    }


def _measurement(number: int, shot: int, target: int) -> dict[str, Any]:
    return {
        "heliostat_id": number + 1,
        "identifier": f"{shot}",
        "external_id": f"{shot // 2}",
        "image_sha256": f"{number:032x}{shot:032x}",
        "kind": ("flux", "cropped")[shot % 2],
        "target_id": target,
        "sun_azimuth_deg": 180 - 10.0 * shot,
        "sun_elevation_deg": 40.0,
        "accepted": shot % 10 != 0,
        "quality": {"signal_to_noise": 30.0},
    }


def _surface(rng: np.random.Generator, number: int, version: int, at: Any) -> dict[str, Any]:
    z = rng.normal(0, 2e-4, (4, 8, 8))
    is_trusted = number % 17 != 0
    return {
        "heliostat_id": number + 1,
        "version": version,
        "valid_from": at,
        "source": "refined",
        "misfit": 0.05,
        "trusted": is_trusted,
        "warnings": []
        if is_trusted
        else ["its photographs show the mirror under suns that are too much alike"],
        "warned_since": None if is_trusted else at,
        "arrays": pack({"z": z, "z_std": abs(z), "control_points": np.stack([z, z, z], axis=-1)}),
    }


def _drawn_series(_: Runtime, heliostat: str, known: Mapping[str, float]) -> AccuracySeries:
    accuracy = 0.8 + 0.2 * (crc32(heliostat.encode()) % 1000) / 1000
    return AccuracySeries(Rank(accuracy, 3), None, dict(known))


def _timed(client: TestClient, path: str) -> tuple[float, Any]:
    began = time.perf_counter()
    answer = client.get(path)
    took = time.perf_counter() - began
    assert answer.status_code == 200, answer.text
    return took, answer


def _settle(client: TestClient) -> None:
    while "being computed" in client.get("/").text:
        time.sleep(1)


def log_page(name: str, first: float, then: float | None, size: int) -> None:
    """Record the server's time for a page [s] and its size [bytes]."""
    cells = {"first [s]": first, "then [s]": Estimate(then, goal="<= 0.3"), "size [kB]": size / 1e3}
    log_row("Server time of pages and routes", name, cells)


def pages(settings: Settings) -> None:
    """A row for each path: the first answer after the start, then the median of five, and how large
    it is.
    """
    print("| asked | first [s] | then [s] | size [kB] |\n| --- | --- | --- | --- |")
    operations: Any = FakeOperations()  # without studies, which no page here asks for
    with client_of(create_app(settings, operations)) as client:
        client.headers["Accept"] = "text/html"
        took, answer = _timed(client, "/")
        print(
            f"| the page after a start | {took:.2f} | | {len(answer.content) / 1e3:.0f} |",
            flush=True,
        )
        log_page("the page after a start", took, None, len(answer.content))
        _settle(client)
        for name, path in PATHS.items():
            first, answer = _timed(client, path)
            then = statistics.median(_timed(client, path)[0] for _ in range(5))
            print(
                f"| {name} | {first:.2f} | {then:.2f} | {len(answer.content) / 1e3:.0f} |",
                flush=True,
            )
            log_page(name, first, then, len(answer.content))


def main() -> None:
    """Fill a store and print what its pages take."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--database", choices=("sqlite", "postgres"), default="sqlite")
    parser.add_argument("--heliostats", type=int, default=20_000)
    options = parser.parse_args()
    drawn = mock.patch.object(field_overview, "accuracy_series", _drawn_series)
    with (
        drawn,
        tempfile.TemporaryDirectory() as folder,
        new_store(options.database, Path(folder)) as made,
    ):
        settings = made.settings.model_copy(update=QUIET | {"job_workers": 1})
        database = Database(settings.database)
        database.upgrade()
        fill(database, options.heliostats)
        database.close()
        print(f"{options.database}, {options.heliostats} heliostats of {PHOTOGRAPHS} images each")
        with recording(f"field-{options.database}"):
            pages(settings)


if __name__ == "__main__":
    main()
