"""The service as a process: it starts on an empty folder, answers, and stops on a signal."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from service.base.settings import Settings
from service.store.database import migrate
from tests.service.conftest import free_port, metadata, png, properties_document, tower_document
from tests.waiting import WAIT_LIMIT_S, child_process, until

_SERVE = (
    "from service.web.app import serve; from service.base.settings import Settings;"
    " serve(Settings())"
)


def _wait(url: str, process: subprocess.Popen[bytes]) -> httpx.Response:
    """What the service answers, once it does."""

    def ask() -> tuple[httpx.Response] | None:  # an error is an answer, too, and false by itself
        assert process.poll() is None, "the service ended"
        try:
            return (httpx.get(url),)
        except httpx.TransportError:
            return None

    (answer,) = until(ask, "the service answers")
    return answer


def _environment(tmp_path: Path, port: int) -> dict[str, str]:
    """Environment of a process with a separate store that imports this checkout."""
    root = str(Path(__file__).parents[3])
    return os.environ | {
        "HELIOTWIN_PORT": str(port),
        "HELIOTWIN_DATA_DIR": str(tmp_path / "data"),
        "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
    }


@pytest.mark.full
def test_process_starts_answers_and_stops(tmp_path: Path):
    port = free_port()
    environment = _environment(tmp_path, port)
    options = {"cwd": tmp_path, "env": environment, "stderr": subprocess.PIPE}
    with child_process([sys.executable, "-c", _SERVE], **options) as process:
        base = f"http://127.0.0.1:{port}"
        assert _wait(f"{base}/livez", process).json()["status"] == "ok"
        answer = httpx.get(f"{base}/v1/heliostats", headers={"X-Request-ID": "trace-me-42"})
        assert answer.json() == {"items": [], "next": None}
        assert "server" not in answer.headers
        process.send_signal(signal.SIGTERM)
        _, log = process.communicate(timeout=WAIT_LIMIT_S)
    assert b"trace-me-42 GET /v1/heliostats 200" in log
    assert b"Finished server process" in log


def test_migrate_makes_the_embedded_store(tmp_path: Path):
    settings = Settings(data_dir=tmp_path / "new" / "store")
    assert migrate(settings) == migrate(settings)
    assert (tmp_path / "new" / "store" / "heliotwin.sqlite").is_file()


_SLOW = """
import os
from service.base.settings import Settings
from service.twin import runtime, slots
from service.web.app import serve
from tests.service.conftest import FakeOperations

class Slow(FakeOperations):
    def predict(self, *arguments, **options):
        # One write: print writes the end of the line separately, and two threads print.
        os.write(1, b"begun\\n")
        os.read(0, 1)  # until the test closes it
        return super().predict(*arguments, **options)

class Telling(slots.ComputeSlots):
    def enter(self, timeout_s=None, check=None):
        if not self._free:
            os.write(1, b"waits\\n")
        super().enter(timeout_s, check)

runtime.ComputeSlots = Telling
runtime.load_operations = lambda *_: Slow()
serve(Settings())
"""


@pytest.mark.full
@pytest.mark.parametrize("signal_number", [signal.SIGTERM, signal.SIGINT])
def test_requests_for_the_model_get_retry_after_when_the_service_stops(
    tmp_path: Path, signal_number: signal.Signals
):
    """Two that the model keeps and one that waits for it: 503 with Retry-After, and nothing of them
    is kept.

    By SIGTERM the process ends while the model still computes; by SIGINT it waits for that.
    """
    port = free_port()
    environment = _environment(tmp_path, port)
    command = [sys.executable, "-c", _SLOW]
    with ExitStack() as held:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        process = held.enter_context(child_process(command, cwd=tmp_path, env=environment, **pipes))
        threads = held.enter_context(ThreadPoolExecutor(3))
        held.callback(process.kill)
        assert process.stdin is not None
        assert process.stdout is not None
        base = f"http://127.0.0.1:{port}"
        _wait(f"{base}/livez", process)
        httpx.put(f"{base}/v1/plant", json=tower_document())
        httpx.put(f"{base}/v1/heliostats/AA39", json=properties_document())
        form = {"metadata": json.dumps(metadata())}
        files = {"image": ("spot.png", png(), "image/png")}
        assert (
            httpx.post(
                f"{base}/v1/heliostats/AA39/measurements", files=files, data=form
            ).status_code
            == 201
        )
        asked = [
            threads.submit(httpx.post, f"{base}/v1/heliostats/AA39/surfaces", json={})
            for _ in range(3)
        ]
        assert sorted(process.stdout.readline() for _ in range(3)) == [
            b"begun\n",
            b"begun\n",
            b"waits\n",
        ]
        process.send_signal(signal_number)
        answers = [future.result() for future in asked]
        assert [answer.status_code for answer in answers] == [503] * 3
        for answer in answers:
            assert answer.headers["Retry-After"]
            assert answer.headers["Content-Type"] == "application/problem+json"
            assert answer.headers["X-Request-ID"] == answer.json()["request_id"]
        assert any("stopping" in answer.json()["detail"] for answer in answers)
        if signal_number == signal.SIGINT:
            process.stdin.close()
        process.wait(WAIT_LIMIT_S)
    with sqlite3.connect(tmp_path / "data" / "heliotwin.sqlite") as store:
        assert store.execute("SELECT count(*) FROM surfaces").fetchone() == (0,)
    store.close()
