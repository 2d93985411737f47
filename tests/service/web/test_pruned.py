"""What is kept of photographs, as clients and operators see it: sizes, 410 for what is gone, 507 at
the end.
"""

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import update

from service.base.settings import Settings
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.store.columns import now
from service.store.tables import ImageRow
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.metrics import samples, value

BASE = "/v1/heliostats/AA39/measurements"


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", image_quota_gb=1e-5, **QUIET)


@pytest.fixture
def pruned(settings: Settings, operations: FakeOperations) -> Iterator[TestClient]:
    """A store with an accepted photograph, 1, and a refused one, 2, whose images were deleted."""
    app = create_app(settings, operations)
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        poster(client)(png(1), id="1")
        poster(client)(png(2, refused=True), id="2")
        for number in (1, 2):
            assert (
                client.get(f"/heliostats/AA39/photographs/{number}/thumbnail.jpg").status_code
                == 200
            )
        prune_images(app)
        yield client


def prune_images(app: FastAPI) -> None:
    """Let a hundred days pass, and a worker work."""
    runtime: Runtime = app.state.runtime
    with runtime.database.writing() as session:
        session.execute(update(ImageRow).values(created_at=now() - timedelta(days=100)))
    worker = Worker(runtime, KINDS, "tester", app.state.stopping)
    worker._purge()
    while worker.work():  # a camera may be chosen, too
        pass


def test_deleted_image_is_gone_and_its_measurement_is_not(pruned: TestClient):
    answer = pruned.get(f"{BASE}/2/image")
    assert answer.status_code == 410
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert "as old as the store's settings allow; its figures are kept" in answer.json()["detail"]
    body = pruned.get(f"{BASE}/2").json()
    assert body["image_pruned_at"] is not None
    assert body["reason"] == "no_spot"
    assert pruned.get(f"{BASE}/1").json()["image_pruned_at"] is None
    assert pruned.get(f"{BASE}/1/image").status_code == 200
    page = pruned.get("/heliostats/AA39", headers={"Accept": "text/html"}).text
    assert "photographs/1/thumbnail.jpg" in page
    assert "photographs/2/thumbnail.jpg" not in page
    assert "image kept until" in page


def test_thumbnail_goes_with_its_image(pruned: TestClient, settings: Settings):
    assert (
        len([path for path in (settings.data_dir / "thumbnails").rglob("*") if path.is_file()]) == 1
    )


def test_job_and_audit_trail_say_what_went(pruned: TestClient):
    (listed,) = pruned.get("/v1/jobs").json()["items"]
    job = pruned.get(listed["href"]).json()
    assert (job["kind"], job["state"], job["result"]["images"]) == ("prunings", "done", 1)
    assert job["result"]["counts"] == {"refused, age": 1}
    (entry,) = [
        e for e in pruned.get("/v1/audit").json()["items"] if e["action"] == "images.pruned"
    ]
    assert entry["subject"] == "1 images"
    assert entry["detail"]["size_bytes"] == len(png(2, refused=True))
    assert pruned.get("/jobs/1", headers={"Accept": "text/html"}).status_code == 200


def test_sizes_are_on_the_page_and_in_the_metrics(pruned: TestClient):
    poster(pruned)(png(3, refused=True), id="3")
    page = Page(pruned.get("/jobs", headers={"Accept": "text/html"}).text)
    rows = {verdict: page.cells(verdict) for verdict in ("accepted", "refused")}
    space = "\N{NO-BREAK SPACE}"
    assert rows["accepted"][:2] == ["1", f"{len(png(1)) / 1e3:.2f}{space}kB"]
    assert rows["refused"][0] == "1"
    assert (rows["accepted"][3], rows["refused"][3]) == (f"730{space}days", f"90{space}days")
    assert f"of 10.0{space}kB, the quota" in page
    found = samples(pruned)
    assert value(found, "heliotwin_image_bytes", verdict="accepted") == len(png(1))
    assert value(found, "heliotwin_image_bytes", verdict="refused") == len(png(3, refused=True))
    assert value(found, "heliotwin_images", verdict="accepted") == 1
    assert value(found, "heliotwin_image_oldest_seconds", verdict="accepted") == pytest.approx(
        8.64e6, rel=0.01
    )
    assert value(found, "heliotwin_image_quota_bytes") == 10_000
    assert value(found, "heliotwin_database_bytes") > 10_000


def test_post_to_a_full_store_is_refused(pruned: TestClient):
    """Nine images are a little more than the quota, and the surface was made from eight of them."""
    post = poster(pruned)
    for seed in range(10, 18):
        assert post(png(seed)).status_code == 201
    assert pruned.post("/v1/heliostats/AA39/surfaces", json={"images": 8}).status_code == 201
    assert post(png(99, size=(90, 90))).status_code == 201  # an image can still be deleted
    prune_images(pruned.app)  # type: ignore[arg-type]
    refused = post(png(98, size=(90, 90)))
    assert refused.status_code == 507
    assert refused.headers["Retry-After"] == "3600"
    assert "HELIOTWIN_IMAGE_QUOTA_GB" in refused.json()["detail"]
    assert len(pruned.get(BASE).json()["items"]) == 11  # nothing of it was kept
