"""The example client against a live service: it sends all, loses nothing, and says why something is
not taken.
"""

import json
import runpy
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import ClassVar

import cv2
import httpx
import numpy as np
import pytest

from service.store import keys
from service.store.database import Database
from tests.faults.harness import Process, Store
from tests.service.conftest import free_port, metadata, png
from tests.waiting import WAIT_LIMIT_S, child_process

CLIENT = Path(__file__).parents[2] / "docker" / "example_client.py"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store with a plant and two heliostats."""
    store = Store(tmp_path_factory.mktemp("client") / "data", None)
    with Process(store) as service:
        service.client().set_up(2)
    return store


@pytest.fixture(scope="module")
def service(store: Store) -> Iterator[Process]:
    with Process(store) as running:
        yield running


def make_key(store: Store, folder: Path, role: str) -> Path:
    database = Database(store.settings.database)
    with database.writing() as session:
        key = keys.create(session, f"{role}-{folder.name}"[:32], role, "test")
    database.close()
    file = folder / f"{role}.key"
    file.write_text(f"{key}\n")
    return file


def spool(folder: Path, count: int, first: int = 0) -> Path:
    """A spool with photographs of two heliostats, one refused, and one of a target that is not
    known.
    """
    root = folder / "spool"
    for number in range(first, first + count):
        place = root / f"H{number % 2}"
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{number}.png").write_bytes(png(number, refused=number == first))
        target = "nowhere" if number == first + 1 else "lower"
        (place / f"{number}.json").write_text(json.dumps(metadata(id=f"m{number}", target=target)))
    return root


def run(base: str, key: Path, root: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-I",
        str(CLIENT),
        "--url",
        base,
        "--key-file",
        str(key),
        *options,
        str(root),
    ]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=WAIT_LIMIT_S
    )


def test_spool_is_sent_once_and_sorted(store: Store, service: Process, tmp_path: Path):
    key, root = make_key(store, tmp_path, "operate"), spool(tmp_path, 6)
    done = run(service.base, key, root, "--predict")
    assert done.returncode == 0, done.stderr
    assert "H0/m0: refused, no_spot" in done.stdout
    assert "H0: surface 1, forecast peak" in done.stdout
    assert len(list((root / "sent").glob("*/*.png"))) == 5
    (reason,) = (root / "rejected").glob("*/*.reason")
    assert "there is no target nowhere; known targets: lower, upper (request " in reason.read_text()
    assert run(service.base, key, root).stdout == ""
    with httpx.Client(
        base_url=service.base, headers={"Authorization": f"Bearer {key.read_text().strip()}"}
    ) as http:
        for file in (root / "sent").glob("*/*.png"):  # sent again, they are the same measurements
            shutil.copy(file, root / file.parent.name / file.name)
            shutil.copy(
                file.with_suffix(".json"), root / file.parent.name / file.with_suffix(".json").name
            )
        assert run(service.base, key, root).returncode == 0
        assert (
            sum(
                len(http.get(f"/v1/heliostats/H{n}/measurements").json()["items"]) for n in range(2)
            )
            == 5
        )


def test_ingest_key_may_send_and_not_predict(store: Store, service: Process, tmp_path: Path):
    key, root = make_key(store, tmp_path, "ingest"), spool(tmp_path, 4, first=10)
    done = run(service.base, key, root, "--predict")
    assert done.returncode == 1
    assert "403" in done.stderr
    assert len(list((root / "sent").glob("*/*.png"))) == 3


def test_what_is_not_whole_waits_and_the_others_go(store: Store, service: Process, tmp_path: Path):
    key, root = make_key(store, tmp_path, "ingest"), spool(tmp_path, 6, first=30)
    torn, unsaid = root / "H0" / "32.png", root / "H0" / "34.json"
    whole, said = torn.read_bytes(), unsaid.read_text()
    torn.write_bytes(whole[:-20])
    unsaid.write_text(said[:-5])
    photograph = cv2.imencode(".jpg", np.full((64, 64, 3), 90, np.uint8))[1].tobytes()
    (root / "H0" / "36.jpg").write_bytes(photograph)
    (root / "H0" / "36.json").write_text(json.dumps(metadata(id="m36", kind="cropped")))
    done = run(service.base, key, root)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("left for the next time") == 2
    assert (root / "sent" / "H0" / "36.jpg").is_file()
    assert {path.name for path in root.glob("H0/*.png")} == {"32.png", "34.png"}
    torn.write_bytes(whole)
    unsaid.write_text(said)
    assert "H0/m32: accepted" in run(service.base, key, root).stdout
    assert not list(root.glob("H*/*.*"))


def test_one_bad_photograph_or_folder_keeps_no_other(
    store: Store, service: Process, tmp_path: Path
):
    key, root = make_key(store, tmp_path, "ingest"), spool(tmp_path, 4, first=40)
    first = root / "H0" / "40"
    for heliostat in ("H 0", "H%2F0", "Hé"):
        shutil.copytree(root / "H1", root / heliostat)
    (root / "H0" / "folder.png").mkdir()
    (root / "H0" / "lists.json").write_text("[1, 2]")
    shutil.copy(first.with_suffix(".png"), root / "H0" / "lists.png")
    (root / "H0" / "50.tif").write_bytes(b"II*")
    done = run(service.base, key, root)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "H0/50.tif: left, it is neither .png" in done.stderr
    assert "H0/folder: left for the next time" in done.stdout
    assert {path.name for path in (root / "sent").glob("*/*.png")} == {"40.png", "42.png", "43.png"}
    reasons = {
        f"{path.parent.name}/{path.stem}": path.read_text()
        for path in (root / "rejected").glob("*/*.reason")
    }
    assert len(reasons) == 8
    assert all(
        name.split("/")[0] in ("H 0", "H%2F0", "Hé") or name in ("H0/lists", "H1/41")
        for name in reasons
    )


def test_wrong_key_or_address_leaves_all_where_it_is(
    store: Store, service: Process, tmp_path: Path
):
    make_key(store, tmp_path, "ingest")
    root, wrong = spool(tmp_path, 2, first=60), tmp_path / "wrong.key"
    wrong.write_text("nonsense")
    for base, says in ((service.base, "401"), ("127.0.0.1", "no heliotwin")):
        done = run(base, wrong, root, "--patience", "5")
        assert done.returncode == 1
        assert says in done.stderr
        assert "stopped, the rest is left for the next time" in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert len(list(root.glob("H*/*.png"))) == 2
    missing = run(service.base, tmp_path / "none.key", root)
    assert (missing.returncode, f"there is no file {tmp_path / 'none.key'}" in missing.stderr) == (
        2,
        True,
    )


def test_missing_spool_is_named(tmp_path: Path):
    key = tmp_path / "no.key"
    key.write_text("x")
    done = run("http://127.0.0.1:9", key, tmp_path / "spool")
    assert done.returncode == 2
    assert f"there is no folder {tmp_path / 'spool'}" in done.stderr


def test_service_that_is_away_is_waited_for(store: Store, service: Process, tmp_path: Path):
    key, root = make_key(store, tmp_path, "ingest"), spool(tmp_path, 4, first=20)
    command = [sys.executable, "-I", str(CLIENT), "--key-file", str(key), str(root), "--url"]
    port = free_port()
    base = f"http://127.0.0.1:{port}"
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with child_process([*command, base], **pipes) as process:
        assert process.stderr is not None
        assert "waiting" in process.stderr.readline()
        assert len(list(root.glob("H*/*.png"))) == 4
        with Process(store, port=port):
            assert process.wait(WAIT_LIMIT_S) == 0
    assert len(list((root / "sent").glob("*/*.png"))) == 3


def test_patience_ends(tmp_path: Path):
    root = spool(tmp_path, 2)
    key = tmp_path / "no.key"
    key.write_text("x")
    done = run("http://127.0.0.1:9", key, root, "--patience", "0.1")
    assert done.returncode == 1
    assert "stopped, the rest is left for the next time: POST /v1/heliostats/H" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(list(root.glob("H*/*.png"))) == 2


class _Flaky(BaseHTTPRequestHandler):
    """Answers as services and proxies do that fail, one way after the other, then well."""

    answers: ClassVar[list[tuple[int, str]]] = []

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        status, retry_after = self.answers.pop(0)
        if not status:
            return  # the connection ends without an answer
        self.send_response(status)
        if retry_after:
            self.send_header("Retry-After", retry_after)
        content = b'{"id": "1"}'
        self.send_header(
            "Content-Length", str(len(content) + (100 if retry_after == "torn" else 0))
        )
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *arguments: object) -> None:
        pass


def test_whatever_may_succeed_later_is_sent_again(monkeypatch: pytest.MonkeyPatch):
    """A torn answer, and a date in Retry-After, ended the client with a traceback."""
    slept: list[float] = []
    monkeypatch.setattr("time.sleep", slept.append)
    date = "Wed, 21 Oct 2026 07:28:00 GMT"
    _Flaky.answers = [
        (429, "7"),
        (503, date),
        (507, "60"),
        (408, ""),
        (0, ""),
        (201, "torn"),
        (201, ""),
    ]
    client = runpy.run_path(str(CLIENT))["Heliotwin"]
    with HTTPServer(("127.0.0.1", 0), _Flaky) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            answer = client(f"http://127.0.0.1:{server.server_port}").send_photograph(
                "AA39", b"image", {}
            )
        finally:
            server.shutdown()
            thread.join()
    assert answer == {"id": "1"}
    assert slept == [7.0, 1.0, 60.0, 4.0, 8.0, 16.0]
