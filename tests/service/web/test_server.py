"""The service as a process: it starts on an empty folder, answers, and stops when told to."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from service.base.settings import Settings
from service.store.database import migrate
from tests.service.conftest import free_port, metadata, png, properties_document, tower_document

_SERVE = "from service.web.server import serve; from service.base.settings import Settings; serve(Settings())"


def _wait(url: str, process: subprocess.Popen[bytes]) -> httpx.Response:
    for _ in range(300):
        assert process.poll() is None, "the service ended"
        try:
            return httpx.get(url, timeout=10)
        except httpx.TransportError:
            time.sleep(0.1)
    pytest.fail("the service does not answer")


def _environment(tmp_path: Path, port: int) -> dict[str, str]:
    """Of a process with a store of its own that finds this checkout."""
    root = str(Path(__file__).parents[3])
    return os.environ | {
        "HELIOTWIN_PORT": str(port),
        "HELIOTWIN_DATA_DIR": str(tmp_path / "data"),
        "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
    }


def test_process_starts_answers_and_stops(tmp_path: Path):
    port = free_port()
    environment = _environment(tmp_path, port)
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


_SLOW = """
import os
import time
from service.base.settings import Settings
from service.twin import runtime
from service.web.server import serve
from tests.service.conftest import FakeOperations

class Slow(FakeOperations):
    def predict(self, *arguments, **options):
        os.write(1, b"begun\\n")  # at once: print writes the line's end by itself, and two threads print
        time.sleep(20)
        return super().predict(*arguments, **options)

runtime.load_operations = Slow
serve(Settings())
"""


@pytest.mark.parametrize("told", [signal.SIGTERM, signal.SIGINT])
def test_requests_at_the_model_are_told_to_come_again_when_the_service_stops(tmp_path: Path, told: signal.Signals):
    """Two at the model and one that waits for it: 503 with Retry-After within seconds, and nothing of them is kept."""
    port = free_port()
    environment = _environment(tmp_path, port)
    command = [sys.executable, "-c", _SLOW]
    with ExitStack() as held:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        process = held.enter_context(subprocess.Popen(command, cwd=tmp_path, env=environment, **pipes))
        threads = held.enter_context(ThreadPoolExecutor(3))
        held.callback(process.kill)
        assert process.stdout is not None
        base = f"http://127.0.0.1:{port}"
        _wait(f"{base}/livez", process)
        httpx.put(f"{base}/v1/plant", json=tower_document())
        httpx.put(f"{base}/v1/heliostats/AA39", json=properties_document())
        form = {"metadata": json.dumps(metadata())}
        files = {"image": ("spot.png", png(), "image/png")}
        assert httpx.post(f"{base}/v1/heliostats/AA39/measurements", files=files, data=form).status_code == 201
        asked = [
            threads.submit(httpx.post, f"{base}/v1/heliostats/AA39/surfaces", json={}, timeout=60) for _ in range(3)
        ]
        assert [process.stdout.readline() for _ in range(2)] == [b"begun\n"] * 2
        time.sleep(0.5)  # for the third, which waits
        started = time.monotonic()
        process.send_signal(told)
        answers = [future.result() for future in asked]
        assert time.monotonic() - started < 12
        assert [answer.status_code for answer in answers] == [503] * 3
        for answer in answers:
            assert answer.headers["Retry-After"]
            assert answer.headers["Content-Type"] == "application/problem+json"
            assert answer.headers["X-Request-ID"] == answer.json()["request_id"]
        assert any("stopping" in answer.json()["detail"] for answer in answers)
        process.wait(60)
        assert time.monotonic() - started < 40
    with sqlite3.connect(tmp_path / "data" / "heliotwin.sqlite") as store:
        assert store.execute("SELECT count(*) FROM surfaces").fetchone() == (0,)
    store.close()
