"""No command opens a connection that nobody asked for: each is watched at the kernel's door, below
all libraries.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, child_process, until
from tests.watched import NotWatchedError, environment, opened, watching

HELIOTWIN = [sys.executable, "-m", "service"]
# onnxruntime's telemetry, where it is on, looks its host up about ten seconds after it was loaded.
LONG_ENOUGH_S = 15.0


@pytest.fixture(scope="module", autouse=True)
def can_watch() -> None:
    try:
        watching(Path(os.devnull))
    except NotWatchedError as reason:
        pytest.skip(str(reason))


def watched(folder: Path, *command: object) -> list[str]:
    """The connections that a command tries."""
    record = folder / "calls"
    done = subprocess.run(
        [*watching(record), *map(str, command)],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return opened(record)


_CALLS_OUT = """
import socket
for ask in (lambda: socket.create_connection(("192.0.2.1", 443), 1), lambda: socket.getaddrinfo("plant.invalid", 443)):
    try:
        ask()
    except OSError:
        pass
"""


def test_a_connection_does_not_escape(tmp_path: Path):
    calls = watched(tmp_path, sys.executable, "-c", _CALLS_OUT)
    assert any("192.0.2.1" in call for call in calls)
    assert any("htons(53)" in call for call in calls)


@pytest.mark.parametrize("word", ["--help", "migrate"])
def test_verbs_of_the_store(tmp_path: Path, word: str):
    calls = watched(tmp_path, *HELIOTWIN, word)
    assert calls == []


@pytest.mark.parametrize(
    "words",
    [["predict", "--out", "out", "--images", "2"], ["study", "--out", "out.json"]],
    ids=lambda words: words[0],
)
def test_verbs_on_a_folder(tmp_path: Path, pair_plant: Path, words: list[str]):
    verb, *options = words
    calls = watched(tmp_path, *HELIOTWIN, verb, pair_plant, *options)
    assert calls == []


def test_demonstration(demonstration: Path):
    assert opened(demonstration / "calls") == []


def test_service(tmp_path: Path):
    port, record = free_port(), tmp_path / "calls"
    command = [*watching(record), *HELIOTWIN, "serve"]
    options = {
        "cwd": tmp_path,
        "env": environment(tmp_path, HELIOTWIN_PORT=str(port)),
        "stderr": subprocess.DEVNULL,
    }
    with child_process(command, **options) as process:

        def is_ready() -> bool:
            assert process.poll() is None, "it ended"
            try:
                return httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200
            except httpx.TransportError:
                return False

        try:
            until(is_ready, "the service is ready")
            for path in ("/", "/docs", "/metrics", "/forecast"):
                assert httpx.get(f"http://127.0.0.1:{port}{path}").status_code == 200
            time.sleep(LONG_ENOUGH_S)
        finally:
            (child,) = (
                Path(f"/proc/{process.pid}/task/{process.pid}/children")
                .read_text(encoding="utf-8")
                .split()
            )
            os.kill(
                int(child), signal.SIGTERM
            )  # watched to its end, which the watcher's own would cut off
            process.wait(WAIT_LIMIT_S)
    assert opened(record) == []
