"""Jobs over HTTP: asked for, followed, cancelled; their progress as a stream that a real client
reads.
"""

import io
import json
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import delete, update

from model.errors import InvalidInputError
from service.base.settings import Settings
from service.jobs.kind import Context
from service.jobs.kinds import KINDS
from service.jobs.kinds.predictions import PredictionsIn, predict_many
from service.store import keys, queue
from service.store.columns import now
from service.store.image_files import digest
from service.store.job_tables import JobRow
from service.store.listing import Portion
from service.store.tables import ImageRow
from service.twin import importing
from service.web.app import create_app
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    Post,
    client_of,
    paint_measurement,
    png,
    serving,
)
from tests.service.job_kinds import NEXT_PART, TEST_KINDS
from tests.service.statements import statements
from tests.waiting import WAIT_LIMIT_S, until

JSON = {"Content-Type": "application/json"}


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    root = tmp_path / "imports"
    root.mkdir()
    working = QUIET | {"job_workers": 1, "job_poll_s": 0.05, "job_retry_s": 0.05}
    return Settings(data_dir=tmp_path / "data", import_root=root, max_queued_jobs=50, **working)


@pytest.fixture
def app(settings: Settings, operations: FakeOperations) -> FastAPI:
    return create_app(settings, operations, {**KINDS, **TEST_KINDS})


def finish(client: TestClient, answer: Any) -> dict[str, Any]:
    """The job that was asked for, when it has ended."""
    assert answer.status_code == 202, answer.text
    path = answer.headers["Location"]
    until(lambda: client.get(path).json()["state"] in ("done", "failed", "cancelled"))
    job: dict[str, Any] = client.get(path).json()
    return job


# --- the kinds
# --------------------------------------------------------------------------------------------------


def test_predictions_make_one_version_each_and_name_what_they_skip(
    client: TestClient, post: Post, properties: Any
):
    client.put("/v1/heliostats/AB01", json=properties)
    client.put("/v1/heliostats/AB02", json=properties)
    post(png(1))
    post(png(2), heliostat="AB01")
    job = finish(client, client.post("/v1/jobs/predictions", json={}))
    assert job["state"] == "done"
    assert job["result"]["surfaces"] == {"AA39": 1, "AB01": 1}
    assert "no accepted measurement" in job["result"]["skipped"]["AB02"]
    assert job["progress"] == 1
    assert client.get("/v1/heliostats/AA39/surfaces/1").status_code == 200
    again = finish(
        client, client.post("/v1/jobs/predictions", json={"heliostats": ["AA39", "AA39"]})
    )
    assert again["result"] == {
        "surfaces": {},
        "unchanged": {"AA39": 1},
        "judged": {},
        "skipped": {},
    }


@pytest.mark.full
def test_surfaces_of_a_job_that_is_begun_again_are_not_made_again(
    client: TestClient,
    post: Post,
    properties: Any,
    operations: FakeOperations,
    monkeypatch: pytest.MonkeyPatch,
):
    client.put("/v1/heliostats/AB01", json=properties)
    post(png(1))
    post(png(2), heliostat="AB01")
    predict, calls = operations.predict, []

    def fails_the_second_time(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise ZeroDivisionError
        return predict(*arguments, **options)

    monkeypatch.setattr(operations, "predict", fails_the_second_time)
    job = finish(client, client.post("/v1/jobs/predictions", json={}))
    assert (job["state"], job["attempts"]) == ("done", 2)
    assert job["result"]["surfaces"] == {"AA39": 1, "AB01": 1}
    assert len(calls) == 3
    for name in ("AA39", "AB01"):
        assert len(client.get(f"/v1/heliostats/{name}/surfaces").json()["items"]) == 1


def test_surface_of_a_late_worker_is_not_stored(
    app: FastAPI,
    client: TestClient,
    post: Post,
    operations: FakeOperations,
    monkeypatch: pytest.MonkeyPatch,
):
    """While it computed, its lease ran out and another took the job: its surface is undone with its
    step.
    """
    post()
    runtime = app.state.runtime
    with runtime.database.writing() as session:
        session.add(JobRow(kind="later", payload={}, created_by="a"))
    with runtime.database.writing() as session:
        row = queue.claim(session, ["later"], "late", 60, 3)
        assert row is not None
        lease = queue.lease_of(row)
        queue.release(session, lease)
    with runtime.database.writing() as session:
        queue.claim(session, ["later"], "fresh", 60, 3)

    class Silent(Context):
        """Reports nothing, so that it does not learn by reporting that its lease is lost."""

        def report(self, *_: Any, **__: Any) -> None:
            pass

    with pytest.raises(queue.LeaseLostError):
        predict_many(Silent(runtime, lease, "a", threading.Event()), PredictionsIn())
    assert len(operations.predictions) == 1
    assert client.get("/v1/heliostats/AA39/surfaces").json()["items"] == []


@pytest.mark.full
def test_predictions_without_any_image_fail_with_the_reason(client: TestClient):
    job = finish(client, client.post("/v1/jobs/predictions", json={"heliostats": ["AA39"]}))
    assert job["state"] == "failed"
    assert "AA39: heliostat AA39 has no accepted measurement" in job["reason"]


def test_photographs_are_measured_again(
    client: TestClient, post: Post, operations: FakeOperations, monkeypatch: pytest.MonkeyPatch
):
    """What changes has its history, what does not stays as it was, and what is kept no longer is
    counted.
    """
    for number in (1, 2, 3):
        post(png(number), id=str(number))
    app: Any = client.app
    with app.state.runtime.database.writing() as session:
        image = session.get_one(ImageRow, digest(png(3)))
        image.pruned_at, image.pruned_for = now(), "age"
    measure, calls = operations.measure, []

    def brighter_the_first_time(*arguments: Any, **options: Any) -> Any:
        taken = measure(*arguments, **options)
        calls.append(1)
        return (
            replace(taken, center_of_mass=np.zeros(2), flux=2 * taken.flux)
            if len(calls) == 1
            else taken
        )

    monkeypatch.setattr(operations, "measure", brighter_the_first_time)
    job = finish(
        client, client.post("/v1/jobs/measurements", json={"reason": "a camera was declared"})
    )
    assert job["result"] == {"measured": 2, "changed": 1, "gone": 1, "skipped": {}}
    path = "/v1/heliostats/AA39/measurements"
    (kept,) = client.get(f"{path}/1/corrections").json()["items"]
    assert (kept["reason"], list(kept["after"])) == ("a camera was declared", ["flux"])
    assert client.get(f"{path}/1").json()["center_of_mass_m"] == [0.0, 0.0]
    assert client.get(f"{path}/2/corrections").json()["items"] == []


def test_cancelled_measuring_says_what_it_changed(
    client: TestClient, operations: FakeOperations, post: Post, monkeypatch: pytest.MonkeyPatch
):
    """Also of the heliostat that it was at: its first photograph is changed for good."""
    monkeypatch.setattr("service.jobs.kind._REPORT_EVERY_S", 0.0)
    for number in (1, 2):
        assert post(png(number), id=str(number)).status_code == 201
    measure = operations.measure

    def cancelling(*arguments: Any, **options: Any) -> Any:
        newest = client.get("/v1/jobs").json()["items"][0]["id"]
        client.post(f"/v1/jobs/{newest}/cancel")
        taken = measure(*arguments, **options)
        return replace(taken, center_of_mass=np.zeros(2), flux=2 * taken.flux)

    monkeypatch.setattr(operations, "measure", cancelling)
    job = finish(client, client.post("/v1/jobs/measurements", json={}))
    assert (job["state"], job["result"]) == (
        "cancelled",
        {"measured": 1, "changed": 1, "gone": 0, "skipped": {}},
    )
    page = client.get(f"/jobs/{job['id']}", headers={"Accept": "text/html"}).text
    assert "Changes until it ended" in page
    assert "<dt>Changed</dt>" in page


def test_cancelled_import_says_what_it_stored(
    bare: TestClient,
    settings: Settings,
    tower: Any,
    properties: Any,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("service.jobs.kind._REPORT_EVERY_S", 0.0)
    assert settings.import_root is not None
    (settings.import_root / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower))
    for name in ("AA39", "AB01"):
        (settings.import_root / name / "Properties").mkdir(parents=True)
        document = settings.import_root / name / "Properties" / f"{name}-heliostat-properties.json"
        document.write_text(json.dumps(properties))
    put = importing._put_heliostat

    def cancelling(*arguments: Any) -> Any:
        newest = bare.get("/v1/jobs").json()["items"][0]["id"]
        bare.post(f"/v1/jobs/{newest}/cancel")
        return put(*arguments)

    monkeypatch.setattr(importing, "_put_heliostat", cancelling)
    job = finish(bare, bare.post("/v1/jobs/imports", json={"folder": "."}))
    assert (job["state"], job["result"]["counts"]["heliostats new"]) == ("cancelled", 1)
    page = bare.get(f"/jobs/{job['id']}", headers={"Accept": "text/html"}).text
    assert "<dt>heliostats new</dt><dd>1</dd>" in page


def test_fleet_forecast_is_the_sum_of_its_heliostats(client: TestClient, properties: Any):
    client.put("/v1/heliostats/AB01", json=properties)
    body = {
        "target": "lower",
        "sun": {"azimuth_deg": 180, "elevation_deg": 45},
        "surface": "ideal",
        "resolution": 16,
    }
    job = finish(client, client.post("/v1/jobs/forecasts", json=body))
    assert job["state"] == "done"
    assert job["result"]["heliostats"] == 2
    assert job["result"]["peak_w_m2"] == 4.0
    area = job["result"]["plane"]["width"] * job["result"]["plane"]["height"]
    assert job["result"]["power_w"] == pytest.approx(4.0 * area)
    assert job["result"]["reflected_w"] == 120.0
    path = f"/v1/jobs/{job['id']}/flux"
    npz = np.load(
        io.BytesIO(client.get(path, headers={"Accept": "application/x-npz"}).content),
        allow_pickle=False,
    )
    np.testing.assert_array_equal(npz["flux"], np.full((16, 16), 4.0, np.float32))
    assert np.shape(client.get(path).json()["flux"]) == (16, 16)
    assert client.get(path, headers={"Accept": "image/png"}).content.startswith(b"\x89PNG")
    ideal = finish(client, client.post("/v1/jobs/forecasts", json={**body, "surface": "current"}))
    assert ideal["result"]["ideal_surfaces"] == ["AA39", "AB01"]
    assert "2 of 2 heliostats have no surface" in ideal["result"]["warnings"][0]
    page = client.get(f"/jobs/{ideal['id']}", headers={"Accept": "text/html"}).text
    assert page.index("2 of 2 heliostats have no surface") < page.index("Power on")


def test_job_without_a_map_has_none(client: TestClient):
    job = finish(client, client.post("/v1/jobs/squares", json={}))
    assert client.get(f"/v1/jobs/{job['id']}/flux").status_code == 404


def test_import_of_an_allowed_folder(
    bare: TestClient, settings: Settings, tower: Any, properties: Any
):
    assert settings.import_root is not None
    folder = settings.import_root / "plant"
    (folder / "AA39" / "Properties").mkdir(parents=True)
    (folder / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower))
    (folder / "AA39" / "Properties" / "AA39-heliostat-properties.json").write_text(
        json.dumps(properties)
    )
    job = finish(bare, bare.post("/v1/jobs/imports", json={"folder": "plant"}))
    assert job["state"] == "done", job["reason"]
    assert job["result"]["counts"]["heliostats new"] == 1
    assert bare.get("/v1/heliostats/AA39").status_code == 200
    again = finish(bare, bare.post("/v1/jobs/imports", json={"folder": "./plant"}))
    assert "heliostats unchanged" in again["result"]["counts"]


@pytest.mark.parametrize(
    "folder", ["..", "../data", "/etc", "plant/../../data", "nothing", "link", "~", "file"]
)
def test_import_never_leaves_its_root(bare: TestClient, settings: Settings, folder: str):
    """Whether the other place exists makes no difference to the answer."""
    root = settings.import_root
    assert root is not None
    (root / "plant").mkdir()
    (root / "file").write_text("x")
    (root / "link").symlink_to(settings.data_dir)
    job = finish(bare, bare.post("/v1/jobs/imports", json={"folder": folder}))
    assert job["state"] == "failed"
    reason = f"folder: there is no folder {folder!r} under the one that may be imported"
    assert job["reason"].startswith(reason)


def test_what_is_bad_in_an_imported_folder_costs_only_itself(
    bare: TestClient, settings: Settings, tower: Any, properties: Any
):
    """A link that leads outside, a pipe, a damaged surface, a name that none may have, and numbers
    that are none.
    """
    root = settings.import_root
    assert root is not None
    (root / "plant").mkdir(parents=True)
    (root / "plant" / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower))
    for name in ("AA39", "AB12", "AC43", "a name"):
        for part in ("Properties", "Calibration", "Deflectometry"):
            (root / "plant" / name / part).mkdir(parents=True)
        file = root / "plant" / name / "Properties" / f"{name}-heliostat-properties.json"
        file.write_text(json.dumps(properties | ({"note": float("nan")} if name == "AB12" else {})))
    calibration = root / "plant" / "AA39" / "Calibration"
    for number in ("1", "2", "3"):
        (calibration / f"{number}-calibration-properties.json").write_text(
            json.dumps(paint_measurement())
        )
    (calibration / "1-flux.png").write_bytes(png())
    (root / "secret.png").symlink_to("/etc/hostname")
    (calibration / "2-flux.png").symlink_to(root / "secret.png")
    (calibration / "3-calibration-properties.json").unlink()
    os.mkfifo(calibration / "3-calibration-properties.json")
    (root / "plant" / "AC43" / "Deflectometry" / "AC43-deflectometry.h5").write_bytes(b"no HDF5")
    job = finish(bare, bare.post("/v1/jobs/imports", json={"folder": "plant"}))
    assert job["state"] == "done", job["reason"]
    counts, skipped = job["result"]["counts"], job["result"]["skipped"]
    assert (counts["heliostats new"], counts["images new"]) == (2, 1)
    for what, why in (
        ("AA39/2 flux", "leads outside of the folder; copy what it links to"),
        ("AA39/3", "no regular file"),
        ("AB12", "document.note: must be a finite number"),
        ("AC43 surface", "no readable HDF5 file"),
        ("a name", "must be 1 to 32 letters"),
    ):
        assert why in skipped[what], skipped


def test_import_of_which_nothing_is_left_fails(
    bare: TestClient, settings: Settings, tower: Any, properties: Any
):
    root = settings.import_root
    assert root is not None
    (root / "plant" / "a name" / "Properties").mkdir(parents=True)
    (root / "plant" / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower))
    file = root / "plant" / "a name" / "Properties" / "a name-heliostat-properties.json"
    file.write_text(json.dumps(properties))
    job = finish(bare, bare.post("/v1/jobs/imports", json={"folder": "plant"}))
    assert job["state"] == "failed"
    assert job["reason"].startswith(
        "no heliostat could be imported (a name: heliostat 'a name': must be"
    )


def test_import_needs_the_operators_leave(settings: Settings, operations: FakeOperations):
    shutil.rmtree(settings.data_dir, ignore_errors=True)
    closed = settings.model_copy(update={"import_root": None})
    with client_of(create_app(closed, operations)) as client:
        answer = client.post("/v1/jobs/imports", json={"folder": "."})
        assert answer.status_code == 409
        assert "HELIOTWIN_IMPORT_ROOT" in answer.json()["detail"]
        assert client.get("/v1/jobs").json()["items"] == []  # refused at once, and not queued


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("predictions", {"heliostats": []}),
        ("predictions", {"heliostats": ["../x"]}),
        ("predictions", {"images": 9}),
        ("forecasts", {"sun": {"azimuth_deg": 180, "elevation_deg": 45}}),
        ("forecasts", {"target": "lower", "sun": {"azimuth_deg": 180, "elevation_deg": -1}}),
        ("studies", {"max_heliostats": 200, "images": 9}),
        ("studies", {"heliostats": [f"AA{number}" for number in range(1, 8)], "images": 64}),
        ("imports", {"folder": ""}),
        ("imports", {"folder": "a\x00b"}),
        ("imports", {"folder": "a\nb"}),
        ("imports", {}),
    ],
)
def test_wrong_request(refusing: TestClient, kind: str, body: Any):
    assert refusing.post(f"/v1/jobs/{kind}", json=body).status_code == 422


def test_too_many_photographs_of_a_study_name_the_field(refusing: TestClient):
    """By default 12 of each heliostat."""
    (error,) = refusing.post("/v1/jobs/studies", json={"max_heliostats": 200}).json()["errors"]
    assert error["field"] == "images"
    assert "2400 in all, 400 at most; ask for 2 of each heliostat" in error["message"]


# --- asking, listing, cancelling
# --------------------------------------------------------------------------------------


def test_idempotency_key_is_kept_over_http(client: TestClient):
    headers = {"Idempotency-Key": "order-1"}
    first = client.post("/v1/jobs/squares", json={"value": 2}, headers=headers)
    again = client.post("/v1/jobs/squares", json={"value": 2}, headers=headers)
    assert first.headers["Location"] == again.headers["Location"]
    assert "Idempotency-Replayed" not in first.headers
    assert again.headers["Idempotency-Replayed"] == "true"
    other = client.post("/v1/jobs/squares", json={"value": 3}, headers=headers)
    assert other.status_code == 422
    assert other.json()["type"] == "urn:heliotwin:problem:idempotency-key-reused"
    assert other.json()["errors"][0]["field"] == "Idempotency-Key"
    assert (
        client.post("/v1/jobs/squares", json={}, headers={"Idempotency-Key": "a b"}).status_code
        == 422
    )


def test_jobs_are_listed_newest_first_in_pages(client: TestClient):
    numbers = [
        finish(client, client.post("/v1/jobs/squares", json={"value": value}))["id"]
        for value in range(3)
    ]
    failed = finish(client, client.post("/v1/jobs/squares", json={"refuses": True}))["id"]
    page = client.get("/v1/jobs", params={"limit": 2}).json()
    assert [job["id"] for job in page["items"]] == [failed, numbers[2]]
    rest = client.get("/v1/jobs", params={"limit": 2, "after": page["next"]}).json()
    assert [job["id"] for job in rest["items"]] == [numbers[1], numbers[0]]
    assert rest["next"] is None
    assert [
        job["id"] for job in client.get("/v1/jobs", params={"state": "failed"}).json()["items"]
    ] == [failed]
    assert client.get("/v1/jobs", params={"kind": "imports"}).json()["items"] == []


def test_cancel_over_http(client: TestClient):
    running = client.post("/v1/jobs/squares", json={"steps": 1000, "pause_s": 0.05})
    waiting = client.post(
        "/v1/jobs/squares", json={"steps": 1000, "pause_s": 0.05}
    )  # a short one would not wait
    path = running.headers["Location"]
    until(lambda: client.get(path).json()["state"] == "running")
    assert client.post(f"{waiting.headers['Location']}/cancel").json()["state"] == "cancelled"
    assert client.post(f"{path}/cancel").json()["cancel_requested"] is True
    assert finish(client, running)["state"] == "cancelled"
    done = client.post("/v1/jobs/squares", json={})
    assert finish(client, done)["state"] == "done"
    assert client.post(f"{done.headers['Location']}/cancel").status_code == 409
    assert client.post("/v1/jobs/99/cancel").status_code == 404
    assert client.get("/v1/jobs/99").status_code == 404


class Steps:
    """What a job showed at each step of its computation."""

    def __init__(self, app: FastAPI) -> None:
        self.shown: list[tuple[str, int | None, int | None, bool]] = []
        self._database = app.state.runtime.database

    def note(self) -> None:
        with self._database.reading() as session:
            row = queue.list_jobs(session, Portion(1))[0]
            has_estimate = row.remaining_s is not None and row.remaining_s > 0
            self.shown.append((row.phase, row.n_done, row.n_total, has_estimate))


def test_jobs_show_phase_counts_and_estimate_while_the_model_computes(
    app: FastAPI,
    client: TestClient,
    operations: FakeOperations,
    post: Post,
    monkeypatch: pytest.MonkeyPatch,
):
    """A refinement showed 0 % for its minute, and a study was as silent."""
    monkeypatch.setattr("service.jobs.kind._REPORT_EVERY_S", 0.0)
    monkeypatch.setattr("service.jobs.kind._MIN_S", 0.0)
    for number in range(4):
        post(png(number + 1), id=str(number))
    predict, steps = operations.predict, Steps(app)

    def refine(
        heliostat: Any, observations: Any, model: Any, method: str, progress: Any = None
    ) -> Any:
        if progress is None:  # from a part of the photographs, for cross-validation
            return predict(heliostat, observations, model, method)
        for done in range(3):
            progress("estimating errors", done, 3)
            steps.note()
        return predict(heliostat, observations, model, method)

    def study(photographs: Any, model: Any, options: Any, progress: Any) -> Any:
        for name in ("sun_shape", "soiling", "blocking"):
            progress(name)
            options.between()
            steps.note()
        raise InvalidInputError("enough")

    monkeypatch.setattr(operations, "predict", refine)
    monkeypatch.setattr(operations, "study", study, raising=False)
    refined = client.post("/v1/jobs/predictions", json={"method": "refined"})
    assert finish(client, refined)["state"] == "done"
    assert steps.shown == [("estimating errors", done, 3, True) for done in range(3)]
    steps.shown.clear()
    studied = client.post("/v1/jobs/studies", json={"candidates": ["sun_shape", "soiling"]})
    assert finish(client, studied)["reason"] == "enough"
    assert steps.shown == [("fits, at most", done, 14, done > 0) for done in range(3)]


@pytest.mark.parametrize("kind", ["predictions", "studies", "forecasts"])
def test_job_is_cancelled_in_the_midst_of_a_computation(
    app: FastAPI,
    client: TestClient,
    operations: FakeOperations,
    post: Post,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
):
    """A refinement ended 62 s after somebody cancelled it."""
    for number in range(4):
        post(png(number + 1), id=str(number))
    client.post("/v1/heliostats/AA39/surfaces", json={})
    begun = threading.Event()

    def compute(end_if_cancelled: Callable[[], None]) -> None:
        begun.set()
        until(end_if_cancelled)  # which returns nothing, and raises once the job is cancelled

    fakes = {
        "predict": lambda _heliostat, _images, _model, _method, progress: compute(
            lambda: progress("images", 0, 1)
        ),
        "study": lambda _photographs, _model, options, _progress: compute(options.between),
        "superpose": lambda task, *_, **__: compute(task.between),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(operations, name, fake, raising=False)
    sun = {"azimuth_deg": 180, "elevation_deg": 45}
    asked = {"target": "lower", "sun": sun} if kind == "forecasts" else {}
    job = client.post(f"/v1/jobs/{kind}", json=asked)
    until(begun.is_set)
    assert client.post(f"{job.headers['Location']}/cancel").json()["cancel_requested"] is True
    ended = finish(client, job)
    assert (ended["state"], ended["attempts"]) == ("cancelled", 1)


def test_page_of_a_job_shows_phase_counts_and_estimate(client: TestClient):
    job = client.post("/v1/jobs/squares", json={"steps": 1000, "pause_s": 0.05})
    path = job.headers["Location"]
    until(lambda: client.get(path).json()["remaining_s"] is not None)
    page = client.get(path.removeprefix("/v1"), headers={"Accept": "text/html"})
    assert re.search(r"parts: \d+ of 1000; about .{1,20} left", Page(page.text).words)
    client.post(f"{path}/cancel")
    assert finish(client, job)["remaining_s"] is None


def test_too_many_waiting_jobs_are_refused(app: FastAPI, client: TestClient):
    with app.state.runtime.database.writing() as session:
        session.add_all(JobRow(kind="unknown", payload={}, created_by="a") for _ in range(50))
    answer = client.post("/v1/jobs/squares", json={})
    assert answer.status_code == 429
    assert answer.headers["Retry-After"]


# --- the stream
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def server(app: FastAPI) -> Iterator[str]:
    """The service behind a real socket; yields its address."""
    with serving(app) as address:
        yield address


@pytest.fixture
def by_hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[dict[str, str]], None]]:
    """Jobs ``by_hand`` do their next part when this is given an event that shows the one before as
    done.

    Progress is written at once, and looked for often: nothing here depends on how fast parts and
    looks are.
    """
    monkeypatch.setattr("service.jobs.kind._REPORT_EVERY_S", 0.0)
    monkeypatch.setattr("service.web.responses.job_events._LOOK_EVERY_S", 0.05)
    seen: set[float] = set()

    def go_on(event: dict[str, str]) -> None:
        progress = json.loads(event["data"])["progress"]
        if progress not in seen:
            seen.add(progress)
            NEXT_PART.release()

    yield go_on
    while NEXT_PART.acquire(blocking=False):
        pass


def read_events(
    url: str,
    last: str | None = None,
    most: int = 10**6,
    on_event: Callable[[dict[str, str]], None] = lambda _: None,
) -> list[dict[str, str]]:
    """Events of a stream until its end, or the first ``most`` of them."""
    events: list[dict[str, str]] = [{}]
    headers = {} if last is None else {"Last-Event-ID": last}
    with httpx.stream("GET", url, headers=headers) as answer:
        assert answer.status_code == 200
        assert answer.headers["Content-Type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            name, _, value = line.partition(": ")
            if line:
                events[-1][name] = value
            elif "data" not in events[-1]:
                events[-1] = {}
            else:
                on_event(events[-1])
                if len(events) == most:
                    return events
                events.append({})
    return events[:-1]


def test_stream_follows_a_job_to_its_end(server: str, by_hand: Callable[[dict[str, str]], None]):
    job = httpx.post(
        f"{server}/v1/jobs/squares", json={"value": 3, "steps": 6, "by_hand": True}
    ).json()
    events = read_events(f"{server}/v1/jobs/{job['id']}/events", on_event=by_hand)
    assert [event["event"] for event in events[:-1]] == ["progress"] * (len(events) - 1)
    documents = [json.loads(event["data"]) for event in events]
    shares = [document["progress"] for document in documents]
    assert shares == sorted(shares)
    assert len(set(shares)) == 7
    assert events[-1]["event"] == "end"
    assert httpx.get(server + documents[-1]["href"]).json()["result"] == {"square": 9}
    numbers = [int(event["id"]) for event in events]
    assert numbers == sorted(set(numbers))


def test_stream_goes_on_where_it_was_left(server: str, by_hand: Callable[[dict[str, str]], None]):
    job = httpx.post(f"{server}/v1/jobs/squares", json={"steps": 6, "by_hand": True}).json()
    url = f"{server}/v1/jobs/{job['id']}/events"
    begun = read_events(url, most=2, on_event=by_hand)
    rest = read_events(url, last=begun[-1]["id"], on_event=by_hand)
    assert int(rest[0]["id"]) > int(begun[-1]["id"])
    assert rest[-1]["event"] == "end"
    over = httpx.get(url, headers={"Last-Event-ID": rest[-1]["id"]})
    assert over.status_code == 204
    assert httpx.get(url, headers={"Last-Event-ID": "nonsense"}).text.count("event: end") == 1
    assert httpx.get(f"{server}/v1/jobs/99/events").status_code == 404


def test_silent_stream_is_kept_open_by_comments(
    server: str, by_hand: Callable[[dict[str, str]], None], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("service.web.responses.job_events._COMMENT_EVERY_S", 0.2)
    job = httpx.post(f"{server}/v1/jobs/squares", json={"steps": 1, "by_hand": True}).json()
    text = ""
    with httpx.stream("GET", f"{server}/v1/jobs/{job['id']}/events") as answer:
        for part in answer.iter_text():
            if ": still here" in part and ": still here" not in text:
                NEXT_PART.release()  # only now the job ends, and the stream
            text += part
    assert "\n: still here\n\n" in text
    assert text.startswith("retry: 2000\n\n")
    assert text.endswith("\n\n")


def test_stream_resumed_behind_the_end_of_its_job_ends_with_it(server: str):
    """It never ended where its reader claimed to have seen more events than the job would have."""
    job = httpx.post(f"{server}/v1/jobs/squares", json={"steps": 3, "pause_s": 0.2}).json()
    url = f"{server}/v1/jobs/{job['id']}/events"
    assert [event["event"] for event in read_events(url, last="999999999")] == ["end"]
    assert httpx.get(url, headers={"Last-Event-ID": "999999999"}).status_code == 204


def test_open_stream_does_not_keep_the_service_from_stopping(app: FastAPI, server: str):
    """The fixture's end waits for the server; the stream of a job that nobody works at would not
    end by itself.
    """
    with app.state.runtime.database.writing() as session:
        row = JobRow(kind="unknown", payload={}, created_by="a")
        session.add(row)
        session.flush()
        number = row.id
    follows = threading.Event()
    arguments = (f"{server}/v1/jobs/{number}/events", None, 10**6, lambda _: follows.set())
    reader = threading.Thread(target=read_events, args=arguments)
    reader.start()
    assert follows.wait(WAIT_LIMIT_S)
    app.state.stopping.set()
    reader.join(WAIT_LIMIT_S)
    assert not reader.is_alive()


# --- large jobs, and many who follow them
# -----------------------------------------------------------------------------


LARGE = [f"H{number:05}" for number in range(20_000)]


def large(app: FastAPI, count: int = 1) -> list[int]:
    """Jobs with all that 20,000 heliostats bring, at which nobody works."""
    result = {"surfaces": dict.fromkeys(LARGE, 1), "skipped": {}}
    with app.state.runtime.database.writing() as session:
        rows = [
            JobRow(kind="k", payload={"heliostats": LARGE}, result=result, created_by="a")
            for _ in range(count)
        ]
        session.add_all(rows)
        session.flush()
        return [row.id for row in rows]


def test_lists_and_events_hold_jobs_in_short_and_read_no_more(app: FastAPI, client: TestClient):
    numbers = large(app, 3)
    with statements(app.state.runtime.database) as sent:
        page = client.get("/v1/jobs")
    assert len(page.content) < 3000
    assert [(item["id"], item["href"]) for item in page.json()["items"]] == [
        (number, f"/v1/jobs/{number}") for number in reversed(numbers)
    ]
    assert not {"payload", "result"} & page.json()["items"][0].keys()
    with app.state.runtime.database.writing() as session:
        session.execute(update(JobRow).values(state="done", revision=2))
    with statements(app.state.runtime.database) as sent_for_events:
        events = client.get(f"/v1/jobs/{numbers[0]}/events")
    assert len(events.content) < 1000
    with statements(app.state.runtime.database) as sent_for_page:
        assert "H00001" not in client.get("/jobs").text
    read = [text for text in (*sent, *sent_for_events, *sent_for_page) if "FROM jobs" in text]
    assert len(read) >= 3
    assert not [text for text in read if "jobs.payload" in text or "jobs.result" in text]
    whole = client.get(f"/v1/jobs/{numbers[0]}").json()
    assert whole["payload"] == {"heliostats": LARGE}
    assert len(whole["result"]["surfaces"]) == 20_000


def test_page_of_a_large_job_shows_its_beginning_and_is_small_while_it_is_followed(
    app: FastAPI, client: TestClient
):
    (number,) = large(app)
    with statements(app.state.runtime.database) as sent:
        part = client.get(f"/jobs/{number}", headers={"HX-Request": "true"})
    assert 'id="job"' in part.text
    assert not [text for text in sent if "jobs.payload" in text or "jobs.result" in text]
    assert "20000 entries" in client.get(f"/jobs/{number}").text
    with app.state.runtime.database.writing() as session:
        session.execute(update(JobRow).values(state="done"))
    page = client.get(f"/jobs/{number}").text
    assert len(page) < 60_000
    assert "H00099, version 1" in page
    assert "H00100" not in page


@contextmanager
def following(
    server: str, number: int, count: int, **options: Any
) -> Iterator[list[httpx.Response]]:
    """So many open streams of a job that nobody works at."""
    with httpx.Client() as client, ExitStack() as held:
        url = f"{server}/v1/jobs/{number}/events"
        yield [held.enter_context(client.stream("GET", url, **options)) for _ in range(count)]


def test_watchers_have_a_bound_together_and_for_each_key(app: FastAPI, settings: Settings):
    bounded = settings.model_copy(update={"max_watchers": 3, "max_watchers_of_key": 2})
    app = create_app(bounded, FakeOperations())
    with serving(app) as server:
        (number,) = large(app)
        with app.state.runtime.database.writing() as session:
            key, other = (
                {"Authorization": f"Bearer {keys.create(session, name, 'read', 'tester')}"}
                for name in ("one", "other")
            )
        with following(server, number, 3, headers=key) as streams:
            assert [stream.status_code for stream in streams] == [200, 200, 429]
            assert streams[2].headers["Retry-After"]
            assert "key one follows 2 jobs already" in json.loads(streams[2].read())["detail"]
            with following(server, number, 2, headers=other) as others:
                assert [stream.status_code for stream in others] == [200, 503]
                assert others[1].headers["Retry-After"]
                assert others[1].headers["Content-Type"] == "application/problem+json"
        url = f"{server}/v1/jobs/{number}/events"

        def is_free() -> bool:
            with httpx.stream("GET", url, headers=key) as stream:
                return stream.status_code == 200

        until(is_free)  # a place is given back with its connection


@pytest.mark.full
def test_many_watchers_are_one_look_at_the_database(app: FastAPI, server: str):
    (number,) = large(app)
    with following(server, number, 12) as streams:
        lines = [stream.iter_lines() for stream in streams]
        for one in (
            lines
        ):  # each has had its first look; an iterator that is dropped would close its stream
            assert any(line.startswith("id: ") for line in one)
        with statements(app.state.runtime.database) as sent:
            began = time.monotonic()
            until(lambda: len([text for text in sent if "jobs.id IN" in text]) >= 4)
            took_s = time.monotonic() - began
    looks = [text for text in sent if "jobs.id IN" in text]
    assert len(looks) <= 2 + took_s / 0.5  # twelve times as many if each looked for itself


def test_stream_ends_when_its_key_is_withdrawn(app: FastAPI, server: str):
    (number,) = large(app)
    database = app.state.runtime.database
    with database.writing() as session:
        shown = [keys.create(session, name, "read", "tester") for name in ("leaving", "staying")]
    leaving, staying = ({"Authorization": f"Bearer {key}"} for key in shown)
    with (
        following(server, number, 1, headers=leaving) as (ends,),
        following(server, number, 1, headers=staying) as (on,),
    ):
        lines = on.iter_lines()
        while "id: 1" not in next(lines):
            pass
        with database.writing() as session:
            keys.withdraw(session, "leaving", "tester")
        ends.read()  # to its end, while its job goes on
        with database.writing() as session:
            session.execute(update(JobRow).values(state="cancelled", revision=2))
        assert "event: end" in list(lines)


def begun(stream: httpx.Response) -> Iterator[str]:
    """Lines of a stream after its first event."""
    lines = stream.iter_lines()
    while "id: 1" not in next(lines):
        pass
    return lines


def test_stream_without_a_key_ends_when_the_first_is_made(app: FastAPI, server: str):
    (number,) = large(app)
    with following(server, number, 1) as (stream,):
        lines = begun(stream)
        with app.state.runtime.database.writing() as session:
            keys.create(session, "first", "admin", "tester")
        assert "event: end" not in list(lines)


def test_stream_of_a_job_that_is_deleted_ends(app: FastAPI, server: str):
    (number,) = large(app)
    with following(server, number, 1) as (stream,):
        lines = begun(stream)
        with app.state.runtime.database.writing() as session:
            session.execute(delete(JobRow))
        assert "event: end" not in list(lines)
