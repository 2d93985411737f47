"""The composition by hand: what its containers run, as processes with its environment, from an
empty PostgreSQL.
"""

import re
import signal
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest

from tests.docker.files import SECRET
from tests.faults.harness import postgres_database
from tests.forked import ForkedProcess
from tests.service.command import heliotwin_process
from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, until


def running(
    service: dict[str, Any], changes: dict[str, str], folder: Path
) -> AbstractContextManager[ForkedProcess]:
    """A container's command with its environment, with the places of this machine in it."""
    local = {"HELIOTWIN_HOST": "127.0.0.1", "HELIOTWIN_METRICS_HOST": "127.0.0.1"}
    settings = {**service.get("environment", {}), **local, **changes}
    return heliotwin_process(folder, *service["command"], **settings)


def healthy(service: dict[str, Any], changes: dict[str, str], process: ForkedProcess) -> None:
    """Wait for the container's own health check."""
    ports = {"8000": changes["HELIOTWIN_PORT"], "9100": changes["HELIOTWIN_METRICS_PORT"]}
    command = [
        re.sub(":(8000|9100)/", lambda found: f":{ports[found[1]]}/", word)
        for word in service["healthcheck"]["test"][1:]
    ]

    def ask() -> bool:
        assert process.poll() is None, "it ended"
        return (
            subprocess.run(
                [sys.executable, *command[1:]], capture_output=True, check=False
            ).returncode
            == 0
        )

    until(ask, "healthy")


@pytest.mark.full
@pytest.mark.postgres
def test_composition_starts_from_empty(compose: dict[str, Any], tmp_path: Path):
    services = compose["services"]
    (tmp_path / "import").mkdir()
    secret = tmp_path / "database_password"
    secret.write_text("not-asked-for\n")
    try:
        with postgres_database() as url:
            changes = {
                "HELIOTWIN_DATABASE_URL": url,
                "HELIOTWIN_DATABASE_PASSWORD_FILE": str(secret),
                "HELIOTWIN_DATA_DIR": str(tmp_path / "data"),
                "HELIOTWIN_IMPORT_ROOT": str(tmp_path / "import"),
                "HELIOTWIN_PORT": str(free_port()),
                "HELIOTWIN_METRICS_PORT": str(free_port()),
                "OMP_NUM_THREADS": "1",
            }
            of_worker = changes | {"HELIOTWIN_METRICS_PORT": str(free_port())}
            assert all(
                service["environment"]["HELIOTWIN_DATABASE_PASSWORD_FILE"] == SECRET
                for name, service in services.items()
                if name in ("migrate", "service", "worker")
            )
            with running(services["service"], changes, tmp_path) as early:
                assert early.wait(WAIT_LIMIT_S) == 1  # not before the migration
            with running(services["migrate"], changes, tmp_path) as migration:
                assert migration.wait(WAIT_LIMIT_S) == 0
            with (
                running(services["service"], changes, tmp_path) as service,
                running(services["worker"], of_worker, tmp_path) as worker,
            ):
                healthy(services["service"], changes, service)
                healthy(services["worker"], of_worker, worker)
                with httpx.Client(
                    base_url=f"http://127.0.0.1:{changes['HELIOTWIN_PORT']}", timeout=WAIT_LIMIT_S
                ) as http:
                    job = http.post("/v1/jobs/predictions", json={}).headers["Location"]
                    until(lambda: http.get(job).json()["state"] == "failed", "the worker works")
                    assert "the plant is not set yet" in http.get(job).json()["reason"]
                    assert "heliotwin_database_up 1.0" in http.get("/metrics").text
                for process in (worker, service):
                    process.send_signal(signal.SIGTERM)
                    assert process.wait(WAIT_LIMIT_S) in (0, -signal.SIGTERM)
    except psycopg.OperationalError as error:
        pytest.skip(f"no PostgreSQL server: {error}")
