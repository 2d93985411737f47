"""Observability of the service: metrics, drift, logs, traces."""

import io
import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from prometheus_client import CollectorRegistry

from model.errors import InvalidInputError
from service import store
from service.base import monitoring
from service.base.errors import NotStartedError
from service.base.monitoring import serve_metrics
from service.base.settings import Settings
from service.store.queue import add_job
from service.store.tables import DriftRow, HeliostatRow
from service.twin.runtime import Runtime
from service.web import store_metrics
from tests.service.conftest import FakeOperations, Post, client_of, free_port, png
from tests.service.metrics import samples, value
from tests.waiting import WAIT_LIMIT_S, child_process, until

ROOT = Path(__file__).parents[3]


# --- metrics
# --------------------------------------------------------------------------------------------------


def test_photographs_refusals_and_model_time_are_counted(client: TestClient, post: Post):
    before = samples(client)
    post(png(1))
    post(png(1))
    post(png(2, refused=True))
    after = samples(client)

    def gained(name: str, **labels: str) -> float:
        return value(after, name, **labels) - value(before, name, **labels)

    for outcome in ("accepted", "known", "refused"):
        assert gained("heliotwin_photographs_total", outcome=outcome) == 1
    assert gained("heliotwin_photographs_refused_total", reason="no_spot") == 1
    assert gained("heliotwin_model_seconds_count", operation="measure") == 2
    route = "/v1/heliostats/{name}/measurements"
    assert gained("heliotwin_http_requests_total", method="POST", route=route, status="201") == 2


def test_senders_make_up_no_label(client: TestClient):
    before = set(samples(client))
    for number in range(20):
        client.get(f"/made/up/{number}")
        client.get(f"/v1/heliostats/UP{number}")
        client.request(f"MADEUP{number}", "/livez")
    made = {key for key in set(samples(client)) - before if "heliotwin_http_request" in key[0]}
    assert {dict(labels)["route"] for _, labels in made} <= {
        "none",
        "/v1/heliostats/{name}",
        "/metrics",
        "/livez",
    }
    assert "UP" not in client.get("/metrics").text.replace("# ", "")


def test_queue_is_told_by_kind_and_state(client: TestClient, app: FastAPI):
    with app.state.runtime.database.writing() as session:
        for _ in range(3):
            add_job(session, "predictions", {}, "tester")
    found = samples(client)
    assert value(found, "heliotwin_jobs", kind="predictions", state="queued") == 3
    assert 0 <= value(found, "heliotwin_jobs_oldest_seconds") < 60
    assert value(found, "heliotwin_database_up") == 1


def test_database_that_is_away_harms_no_other_figure(
    app: FastAPI, bare: TestClient, settings: Settings
):
    runtime = app.state.runtime
    runtime.database.close()
    for leftover in settings.data_dir.glob("heliotwin.sqlite*"):
        leftover.unlink()
    (settings.data_dir / "heliotwin.sqlite").mkdir()
    registry = store_metrics.registry(runtime, app.state.field)
    assert registry.get_sample_value("heliotwin_database_up") == 0
    assert any(family.name == "heliotwin_http_requests" for family in registry.collect())


def test_metrics_need_a_key_where_there_are_keys(client: TestClient, app: FastAPI):
    from service.store import keys

    with app.state.runtime.database.writing() as session:
        key = keys.create(session, "prometheus", "read", "tester")
    assert client.get("/metrics").status_code == 401
    assert client.get("/metrics", headers={"Authorization": f"Bearer {key}"}).status_code == 200


def test_port_for_metrics_opens_and_closes(tmp_path: Path):
    settings = Settings(data_dir=tmp_path, metrics_port=free_port())
    url = f"http://127.0.0.1:{settings.metrics_port}/metrics"
    with serve_metrics(settings, monitoring.PROCESS):
        assert "heliotwin_job_seconds" in httpx.get(url).text
    with pytest.raises(httpx.ConnectError):
        httpx.get(url)
    with serve_metrics(Settings(data_dir=tmp_path), CollectorRegistry()):
        pass


@pytest.mark.full
def test_worker_of_its_own_process_tells_of_its_jobs(tmp_path: Path):
    port = free_port()
    settings = Settings(data_dir=tmp_path / "data")
    runtime = Runtime.from_settings(settings, SimpleNamespace())  # type: ignore[arg-type]
    runtime.database.upgrade()
    with runtime.database.writing() as session:
        add_job(session, "squares", {"value": 3}, "tester")
        add_job(session, "squares", {"refuses": True}, "tester")
    environment = os.environ | {
        "HELIOTWIN_DATA_DIR": str(settings.data_dir),
        "HELIOTWIN_METRICS_PORT": str(port),
        "HELIOTWIN_LOG_FORMAT": "json",
    }
    command = [sys.executable, "-m", "tests.service.job_kinds"]
    runtime.close()
    with child_process(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE) as process:

        def metrics_text() -> str:
            assert process.poll() is None
            try:
                return httpx.get(f"http://127.0.0.1:{port}/metrics").text
            except httpx.TransportError:
                return ""

        failed, done = (
            f'heliotwin_job_attempts_total{{kind="squares",outcome="{outcome}"}} 1.0'
            for outcome in ("failed", "done")
        )
        until(lambda: failed in metrics_text(), "the second job has failed")
        assert done in metrics_text()
        process.terminate()
        _, log = process.communicate(timeout=WAIT_LIMIT_S)
    lines = [json.loads(line) for line in log.decode().splitlines()]
    assert {line["job"] for line in lines if "attempt" in line["message"]} == {1, 2}


# --- drift
# --------------------------------------------------------------------------------------------------


def drift(app: FastAPI) -> dict[str, float]:
    with app.state.runtime.database.reading() as session:
        return {row.measurement_id: row.accuracy for row in session.query(DriftRow)}


def test_new_photograph_is_held_against_the_current_surface(
    client: TestClient, app: FastAPI, post: Post, operations: FakeOperations
):
    post(png(1))
    assert drift(app) == {}  # there is no surface yet
    assert operations.rendered == 0
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    known = operations.rendered  # the surface itself was compared with the ideal mirror
    post(png(2), taken_at="2024-06-02T10:00:00Z")
    post(png(2), taken_at="2024-06-02T10:00:00Z")
    post(png(3, refused=True))
    assert drift(app) == {2: pytest.approx(1.0)}
    assert operations.rendered == known + 1
    assert value(
        samples(client), "heliotwin_heliostat_forecast_accuracy", heliostat="AA39"
    ) == pytest.approx(1.0)


def test_photograph_that_comes_late_does_not_replace_a_newer_one(
    client: TestClient, app: FastAPI, post: Post
):
    post(png(1), taken_at="2024-06-01T10:00:00Z")
    client.post("/v1/heliostats/AA39/surfaces", json={})
    for seed, day in ((2, 3), (3, 2), (4, 4)):
        post(png(seed), taken_at=f"2024-06-0{day}T10:00:00Z")
        assert set(drift(app)) == {4 if seed == 4 else 2}


def test_photograph_is_kept_though_its_drift_cannot_be_told(
    client: TestClient, post: Post, operations: FakeOperations, monkeypatch: pytest.MonkeyPatch
):
    post(png(1))
    client.post("/v1/heliostats/AA39/surfaces", json={})
    for seed, fault in ((2, InvalidInputError("no")), (3, ZeroDivisionError())):

        def fail(*_: Any, fault: Exception = fault) -> None:
            raise fault

        monkeypatch.setattr(operations, "render", fail)
        assert post(png(seed)).status_code == 201


def test_only_the_worst_heliostats_are_told(
    app: FastAPI, bare: TestClient, client: TestClient, post: Post
):
    post(png(1))
    client.post("/v1/heliostats/AA39/surfaces", json={})
    runtime = app.state.runtime
    with runtime.database.writing() as session:
        for number in range(5):
            row, _ = store.put_heliostat(session, f"B{number}", {}, (0, 0, 0))
            session.flush()
            accuracy = 0.9 - number / 10
            session.add(
                DriftRow(
                    heliostat_id=row.id,
                    measurement_id=1,
                    surface_id=1,
                    taken_at=row.created_at,
                    accuracy=accuracy,
                )
            )
    settings = runtime.settings.model_copy(update={"metrics_heliostats": 2})
    bounded_runtime = Runtime(settings, runtime.database, runtime.images, runtime.operations)
    bounded = store_metrics.registry(bounded_runtime, app.state.field)
    (family,) = [
        family
        for family in bounded.collect()
        if family.name == "heliotwin_heliostat_forecast_accuracy"
    ]
    assert {sample.labels["heliostat"]: sample.value for sample in family.samples} == {
        "B4": pytest.approx(0.5),
        "B3": pytest.approx(0.6),
    }
    with runtime.database.reading() as session:
        assert session.query(HeliostatRow).count() == 6


# --- logs
# --------------------------------------------------------------------------------------------------


@pytest.fixture(params=["text", "json"])
def log(request: pytest.FixtureRequest) -> Iterator[tuple[str, io.StringIO]]:
    """The root logger as `logs.configure_logging` makes it, writing to memory."""
    stream, root = io.StringIO(), logging.getLogger()
    handlers, level = root.handlers[:], root.level
    root.handlers = []
    monitoring.configure_logging(Settings(log_format=request.param))
    root.handlers[0].setStream(stream)  # type: ignore[attr-defined]
    yield request.param, stream
    root.handlers, root.level = handlers, level


def test_every_line_bears_the_request_id(
    bare: TestClient, log: tuple[str, io.StringIO], monkeypatch: Any
):
    def note(*_: Any) -> list[Any]:  # in a thread of the pool
        logging.getLogger("heliotwin.test").warning("from the inside")
        return []

    monkeypatch.setattr("service.store.list_heliostats", note)
    answer = bare.get("/v1/heliostats", headers={"X-Request-ID": "mine-12345678"})
    assert answer.headers["X-Request-ID"] == "mine-12345678"
    lines = [line for line in log[1].getvalue().splitlines() if "heliotwin." in line]
    assert len(lines) == 2
    assert all("mine-12345678" in line for line in lines)
    if log[0] == "json":
        entry = json.loads(lines[1])
        assert entry["request_id"] == "mine-12345678"
        assert (entry["method"], entry["path"], entry["status"], entry["key"]) == (
            "GET",
            "/v1/heliostats",
            200,
            "local",
        )
        assert entry["level"] == "INFO"
        assert entry["time"]


def test_nobody_forges_a_line(bare: TestClient, log: tuple[str, io.StringIO]):
    bare.get("/v1/heliostats/%0a2026-11-21 00:00:00 INFO forged%0d%1b[2J%E2%80%A8")
    try:
        raise ValueError("no\n2026-11-21 00:00:00 INFO forged")
    except ValueError:
        logging.getLogger("heliotwin.test").exception("bad\ninput %s", "\n2026-11-21 forged\x00")
    lines = [
        line
        for line in log[1].getvalue().split("\n")
        if line and "httpx" not in line and "alembic" not in line
    ]
    assert not any(
        line.startswith("2026-11-21 00:00:00 INFO forged") or line.startswith("forged")
        for line in lines
    )
    assert not any(character in log[1].getvalue() for character in "\r\x1b\x00\u2028")
    if log[0] == "json":
        assert len(lines) == 2
        assert "ValueError" in json.loads(lines[1])["exception"]


def test_schema_is_told_at_start_and_readiness_asks_in_silence(
    app: FastAPI, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.INFO)
    with client_of(app) as client:
        newest = app.state.runtime.database.revisions()[-1]
        logged = [
            record.getMessage() for record in caplog.records if record.name == "heliotwin.service"
        ]
        assert [line for line in logged if "schema" in line] == [
            f"the store's schema is at {newest}, its newest version"
        ]
        caplog.clear()
        for _ in range(3):
            assert client.get("/readyz").json()["checks"]["migrations"] == "ok"
        assert [record.getMessage() for record in caplog.records if record.name != "httpx"] == []


# --- traces
# --------------------------------------------------------------------------------------------------


def test_requests_and_the_model_are_traced(
    app: FastAPI, client: TestClient, post: Post, monkeypatch: Any
):
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(monitoring, "_tracer", provider.get_tracer("test"))
    post(png(1))
    assert {span.name for span in exporter.get_finished_spans()} == {"wait", "measure"}


def test_without_the_extra_packages_the_setting_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monitoring.configure_tracing(Settings(data_dir=tmp_path), "test")
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(NotStartedError, match=r"heliotwin\[otel\]"):
        monitoring.configure_tracing(
            Settings(data_dir=tmp_path, otlp_endpoint="http://127.0.0.1:1"), "test"
        )
