"""No command opens a connection that nobody asked for: each is watched at the kernel's door, below
all libraries.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.faults.harness import ROOT
from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, child_process, until

pytestmark = [pytest.mark.slow]

CALLS = "connect,sendto,sendmsg,sendmmsg"
HELIOTWIN = [sys.executable, "-m", "service"]
# onnxruntime's telemetry, where it is on, looks its host up about ten seconds after it was loaded.
LONG_ENOUGH_S = 15.0


def watching(record: Path) -> list[str]:
    """What a command begins with whose connections are written to ``record``, and refused."""
    program = shutil.which("strace")
    if program is None:
        pytest.skip("strace is not installed: apt-get install strace")
    watch = [
        program,
        "-f",
        "-qq",
        "-e",
        "signal=none",
        "-e",
        f"trace={CALLS}",
        "-e",
        "inject=connect:error=ENETUNREACH",
    ]
    asked = subprocess.run(
        [*watch, "-o", str(record), "true"], capture_output=True, text=True, check=False
    )
    if asked.returncode:
        pytest.skip(f"this machine lets nobody watch a process: {asked.stderr.strip()}")
    return [*watch, "-o", str(record)]


def opened(record: Path) -> list[str]:
    """The connections that were tried; those of one machine's processes with each other
    are none.
    """
    lines = record.read_text(encoding="utf-8").splitlines()
    return [
        line for line in lines if re.search(r"sa_family=(?!AF_UNIX|AF_NETLINK|AF_UNSPEC)", line)
    ]


def watched(folder: Path, *command: object) -> tuple[str, list[str]]:
    """What a command prints, and the connections that it tried."""
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
    return done.stdout, opened(record)


def environment(folder: Path, **more: str) -> dict[str, str]:
    """That of a machine where nothing is set, not even that it is one for tests; some libraries
    mind those.
    """
    places = {"HOME": str(folder / "home"), "PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)}
    return places | {"HELIOTWIN_DATA_DIR": str(folder / "data"), "OMP_NUM_THREADS": "1"} | more


_CALLS_OUT = """
import socket
for ask in (lambda: socket.create_connection(("192.0.2.1", 443), 1), lambda: socket.getaddrinfo("plant.invalid", 443)):
    try:
        ask()
    except OSError:
        pass
"""


def test_a_connection_does_not_escape(tmp_path: Path):
    _, calls = watched(tmp_path, sys.executable, "-c", _CALLS_OUT)
    assert any("192.0.2.1" in call for call in calls)
    assert any("htons(53)" in call for call in calls)


@pytest.mark.parametrize("word", ["--help", "migrate"])
def test_verbs_of_the_store(tmp_path: Path, word: str):
    _, calls = watched(tmp_path, *HELIOTWIN, word)
    assert calls == []


@pytest.mark.parametrize(
    "words",
    [["predict", "--out", "out", "--images", "2"], ["study", "--out", "out.json"]],
    ids=lambda words: words[0],
)
def test_verbs_on_a_folder(tmp_path: Path, pair_plant: Path, words: list[str]):
    verb, *options = words
    _, calls = watched(tmp_path, *HELIOTWIN, verb, pair_plant, *options)
    assert calls == []


def test_demonstration(tmp_path: Path, pair_plant: Path):
    _, calls = watched(tmp_path, *HELIOTWIN, "demo", "--data", pair_plant)
    assert calls == []


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
