"""The service as a process: it starts on an empty folder, answers, and stops when told to."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from service.base.settings import Settings
from service.store.database import migrate
from tests.service.conftest import free_port

_SERVE = "from service.web.server import serve; from service.base.settings import Settings; serve(Settings())"


def _wait(url: str, process: subprocess.Popen[bytes]) -> httpx.Response:
    for _ in range(300):
        assert process.poll() is None, "the service ended"
        try:
            return httpx.get(url, timeout=10)
        except httpx.TransportError:
            time.sleep(0.1)
    pytest.fail("the service does not answer")


def test_process_starts_answers_and_stops(tmp_path: Path):
    port = free_port()
    root = str(Path(__file__).parents[3])
    environment = os.environ | {
        "HELIOTWIN_PORT": str(port),
        "HELIOTWIN_DATA_DIR": str(tmp_path / "data"),
        "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
    }
    process = subprocess.Popen([sys.executable, "-c", _SERVE], cwd=tmp_path, env=environment, stderr=subprocess.PIPE)
    try:
        base = f"http://127.0.0.1:{port}"
        assert _wait(f"{base}/livez", process).json()["status"] == "ok"
        answer = httpx.get(f"{base}/v1/heliostats", headers={"X-Request-ID": "trace-me-42"})
        assert answer.json() == {"items": [], "next": None}
        assert "server" not in answer.headers
    finally:
        process.send_signal(signal.SIGTERM)
        _, log = process.communicate(timeout=30)
    assert b"trace-me-42 GET /v1/heliostats 200" in log
    assert b"Finished server process" in log


def test_migrate_makes_the_embedded_store(tmp_path: Path):
    settings = Settings(data_dir=tmp_path / "new" / "store")
    assert migrate(settings) == migrate(settings)
    assert (tmp_path / "new" / "store" / "heliotwin.sqlite").is_file()
