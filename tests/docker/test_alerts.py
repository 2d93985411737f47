"""Alerts by real Prometheus and Alertmanager, with the files that the composition mounts.

Needs their binaries on the path, or in the folder `HELIOTWIN_TEST_PROMETHEUS`. Debian's packages
are prometheus and prometheus-alertmanager.
"""

import http.server
import json
import re
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from sqlalchemy import update

from service.base.settings import Settings
from service.store import queue
from service.store.columns import now
from service.store.tables import HeliostatRow
from service.twin.alarms.field_updates import FieldStateWriter
from service.web.app import create_app
from tests.docker.engine import binary
from tests.docker.files import drawn_expressions
from tests.quick_services import write_state
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    free_port,
    png,
    poster,
    properties_document,
    serving,
    tower_document,
)
from tests.service.spots import photographs
from tests.waiting import child_process, until

DOCKER = Path(__file__).parents[2] / "docker"


def test_rules_and_configurations_are_sound():
    for command in (
        (binary("promtool"), "check", "rules", DOCKER / "prometheus-rules.yml"),
        (binary("promtool"), "check", "config", "--syntax-only", DOCKER / "prometheus.yml"),
        (binary("amtool"), "check-config", DOCKER / "alertmanager.yml"),
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


def test_the_dashboard_asks_what_prometheus_understands(tmp_path: Path):
    asked = [
        {"record": f"drawn:{place}", "expr": expression}
        for place, expression in enumerate(drawn_expressions())
    ]
    rules = tmp_path / "drawn.yml"
    rules.write_text(
        yaml.safe_dump({"groups": [{"name": "drawn", "rules": asked}]}), encoding="utf-8"
    )
    done = subprocess.run(
        (binary("promtool"), "check", "rules", rules), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@contextmanager
def webhook_receiver(port: int) -> Iterator[list[dict[str, Any]]]:
    """Alerts that come in at a webhook on this port."""
    alerts: list[dict[str, Any]] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            alerts.extend(
                json.loads(self.rfile.read(int(self.headers["Content-Length"])))["alerts"]
            )
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield alerts
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def running(folder: Path, *command: str) -> Iterator[None]:
    place = folder / f"{Path(command[0]).name}.log"
    with place.open("wb") as log, child_process(command, cwd=folder, stdout=log, stderr=log):
        yield


def configure(folder: Path, service: str, alertmanager: int, webhook: int) -> None:
    """The composition's files with addresses of this machine, and without its patience."""
    rules = (DOCKER / "prometheus-rules.yml").read_text(encoding="utf-8")
    (folder / "rules.yml").write_text(re.sub(r"for: \d+[mh]", "for: 0s", rules), encoding="utf-8")
    prometheus = yaml.safe_load((DOCKER / "prometheus.yml").read_text(encoding="utf-8"))
    prometheus |= {
        "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
        "rule_files": ["rules.yml"],
        "scrape_configs": [{"job_name": "heliotwin", "static_configs": [{"targets": [service]}]}],
    }
    prometheus["alerting"]["alertmanagers"][0]["static_configs"][0]["targets"] = [
        f"127.0.0.1:{alertmanager}"
    ]
    (folder / "prometheus.yml").write_text(yaml.safe_dump(prometheus), encoding="utf-8")
    sending = yaml.safe_load((DOCKER / "alertmanager.yml").read_text(encoding="utf-8"))
    sending["route"] |= {"group_wait": "0s", "group_interval": "1s"}
    sending["receivers"][0]["webhook_configs"] = [
        {"url": f"http://127.0.0.1:{webhook}/", "send_resolved": True}
    ]
    (folder / "alertmanager.yml").write_text(yaml.safe_dump(sending), encoding="utf-8")


@pytest.mark.full
def test_alert_is_delivered_and_ends_when_it_is_acknowledged(tmp_path: Path):
    prometheus, alertmanager = (
        binary("prometheus"),
        binary("alertmanager", "prometheus-alertmanager"),
    )
    app = create_app(Settings(data_dir=tmp_path / "data", **QUIET), FakeOperations())
    port, sender, webhook = free_port(), free_port(), free_port()
    listen = "--web.listen-address=127.0.0.1:"
    with ExitStack() as stack:
        alerts = stack.enter_context(webhook_receiver(webhook))
        address = stack.enter_context(serving(app))
        service = stack.enter_context(httpx.Client(base_url=address))
        service.put("/v1/plant", json=tower_document())
        service.put("/v1/heliostats/AA39", json=properties_document())
        with app.state.runtime.database.writing() as session:
            session.execute(update(HeliostatRow).values(created_at=now() - timedelta(days=40)))
        write_state(FieldStateWriter(app.state.runtime))
        configure(tmp_path, address.removeprefix("http://"), sender, webhook)
        sends = (
            "--config.file=alertmanager.yml",
            "--storage.path=sent",
            "--cluster.listen-address=",
        )
        stack.enter_context(running(tmp_path, alertmanager, *sends, f"{listen}{sender}"))
        asks = ("--config.file=prometheus.yml", "--storage.tsdb.path=series")
        stack.enter_context(running(tmp_path, prometheus, *asks, f"{listen}{port}"))

        def of(status: str) -> list[dict[str, Any]]:
            wanted = ("HeliotwinNoPhotograph", status)
            return [
                alert
                for alert in alerts
                if (alert["labels"]["alertname"], alert["status"]) == wanted
            ]

        until(lambda: bool(of("firing")), "the alert is delivered")
        assert of("firing")[0]["annotations"]["summary"].startswith(
            "1 heliostats have no recent photograph"
        )
        (item,) = service.get("/v1/alarms").json()["items"]
        service.post("/v1/alarms/acknowledgements", json={"ids": [item["id"]], "reason": "seen"})
        until(lambda: bool(of("resolved")), "its end is delivered")


def fill(service: httpx.Client) -> None:
    """Some of everything that the dashboard draws: photographs, a surface that is judged, a mount,
    jobs.
    """
    service.put("/v1/plant", json=tower_document())
    service.put("/v1/heliostats/AA39", json=properties_document())
    send = poster(service)
    taken = photographs(tower_document(), properties_document())
    for number, one in enumerate(taken[:12]):
        assert send(png(number), **one).status_code == 201
    send(png(90, refused=True), id="refused")
    assert (
        service.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["0", "1"]}).status_code
        == 201
    )
    for kind in ("calibrations", "predictions"):
        path = service.post(f"/v1/jobs/{kind}", json={}).headers["Location"]
        until(lambda path=path: service.get(path).json()["state"] in ("done", "failed"))  # type: ignore[misc]
    for number, one in enumerate(taken[12:], 12):
        assert send(png(number), **one).status_code == 201


@pytest.mark.full
def test_each_panel_of_the_dashboard_draws_something(tmp_path: Path):
    """Of a live service, as a real Prometheus has it."""
    program, port = binary("prometheus"), free_port()
    settings = Settings(
        data_dir=tmp_path / "data", image_quota_gb=1.0, **QUIET | {"job_workers": 1}
    )
    with ExitStack() as stack:
        app = create_app(settings, FakeOperations())
        address = stack.enter_context(serving(app))
        service = stack.enter_context(httpx.Client(base_url=address))
        fill(service)
        with app.state.runtime.database.writing() as session:
            queue.add_job(session, "other", {}, "tester")  # no worker takes it: it waits
        configure(tmp_path, address.removeprefix("http://"), free_port(), free_port())
        asks = ("--config.file=prometheus.yml", "--storage.tsdb.path=series")
        stack.enter_context(
            running(tmp_path, program, *asks, f"--web.listen-address=127.0.0.1:{port}")
        )
        prometheus = stack.enter_context(httpx.Client(base_url=f"http://127.0.0.1:{port}"))

        def drawn(expression: str) -> bool:
            try:
                answer = prometheus.get("/api/v1/query", params={"query": expression})
            except httpx.TransportError:  # it is starting
                return False
            if answer.status_code == 503:
                return False
            assert answer.json()["status"] == "success", (expression, answer.text)
            return bool(answer.json()["data"]["result"])

        empty = set(drawn_expressions())

        def all_drawn() -> bool:
            empty.difference_update([expression for expression in empty if drawn(expression)])
            return not empty

        with suppress(AssertionError):
            until(all_drawn)
        assert not empty
