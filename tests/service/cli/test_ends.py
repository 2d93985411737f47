"""How verbs end: one clear line and the right code, whatever went wrong."""

import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from io import StringIO
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.console import Console

from service.base.settings import Settings
from service.cli import demo
from service.cli import folder as verbs
from service.cli.demo_plant import write_plant
from service.sources.folder import read_folder
from service.store.database import migrate
from tests.service.command import ends, heliotwin_on
from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, child_process

ROOT = Path(__file__).parents[3]


def process_on(data: Path, *arguments: object, **settings: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a separate process: a service or a worker."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("HELIOTWIN_")
    }
    environment |= {"HELIOTWIN_DATA_DIR": str(data), "PYTHONPATH": str(ROOT)} | settings
    command = [sys.executable, "-m", "service", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=data.parent, check=False
    )


def test_a_database_that_cannot_be_read_is_one_line(tmp_path: Path):
    data = tmp_path / "data"
    data.mkdir()
    (data / "heliotwin.sqlite").write_bytes(
        b"no database at all, but long enough to look like one" * 100
    )
    for verb in (("keys", "list"), ("models", "list"), ("migrate",)):
        ends(heliotwin_on(data, *verb), 1, "heliotwin: the database: file is not a database")


def test_lists_take_no_lock_and_migrate_nothing(tmp_path: Path):
    data = tmp_path / "data"
    for verb in ("keys", "models"):
        assert heliotwin_on(data, verb, "list").returncode == 0
    assert not data.exists()
    settings = Settings(data_dir=data)
    assert migrate(settings, "0001")
    ends(heliotwin_on(data, "keys", "list"), 1, "heliotwin migrate")
    ends(
        heliotwin_on(data, "import", _plant(tmp_path), HELIOTWIN_MIGRATE_ON_START="false"),
        1,
        "heliotwin migrate",
    )
    migrate(settings)
    held = sqlite3.connect(data / "heliotwin.sqlite", isolation_level=None)
    held.execute("BEGIN IMMEDIATE")
    try:
        for verb in ("keys", "models"):
            assert heliotwin_on(data, verb, "list").returncode == 0
    finally:
        held.close()


def _plant(folder: Path) -> Path:
    write_plant(folder / "plant", images=1, rays=30_000)
    return folder / "plant"


def test_an_open_door_is_refused_in_one_line(tmp_path: Path):
    done = process_on(tmp_path / "data", "serve", "--host", "0.0.0.0")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if "holds no key" in line]
    assert len(errors) == 1
    assert done.stderr.strip().splitlines()[-1] == errors[0]


@pytest.mark.parametrize("window", ["-4", "0", "nan", "1e9"])
def test_a_window_that_is_none_is_bad_input(tmp_path: Path, window: str):
    done = heliotwin_on(
        tmp_path / "data",
        "forecast",
        _plant(tmp_path),
        "--out",
        tmp_path / "out",
        "--window",
        window,
    )
    ends(done, 2, "--window must lie in 0 to 1000 m")


def test_version(tmp_path: Path):
    done = heliotwin_on(tmp_path / "data", "--version")
    assert done.returncode == 0
    assert done.stdout.startswith("heliotwin")


def test_an_interrupted_prediction_leaves_what_was_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder, calls = read_folder(_plant(tmp_path)), []
    predict = verbs.predict_heliostat

    def interrupted(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return predict(*arguments)

    monkeypatch.setattr(verbs, "predict_heliostat", interrupted)
    with pytest.raises(KeyboardInterrupt):
        verbs.predict_folder(folder, tmp_path / "out")
    first, *others = folder.plant.heliostats
    report = json.loads((tmp_path / "out" / "predictions.json").read_text())
    assert list(report["heliostats"]) == [first]
    assert report["skipped"] == dict.fromkeys(others, "interrupted")


def test_more_workers_than_the_connections_allow_are_one_line(tmp_path: Path):
    """The option counts like the setting; both databases have their pool of these connections."""
    few = {"HELIOTWIN_DATABASE_CONNECTIONS": "12"}
    done = process_on(tmp_path / "data", "worker", "--count", "4", **few)
    ends(
        done,
        2,
        "heliotwin: setting combination: database_connections: 12 are too few for job_workers"
        " 4 and",
    )
    assert not done.stdout
    assert (
        "schema is at None" in process_on(tmp_path / "data", "worker", "--count", "1", **few).stderr
    )


@pytest.mark.parametrize("form", [(), ("--json",)])
def test_what_does_not_listen_says_nothing_of_it(tmp_path: Path, form: tuple[str, ...]):
    refused = process_on(tmp_path / "data", "serve", "--host", "0.0.0.0", *form)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "listens" not in refused.stderr
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        refused = process_on(tmp_path / "data", "serve", "--port", taken.getsockname()[1], *form)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "listens" not in refused.stderr


def test_what_listens_says_where_and_answers(tmp_path: Path):
    port = free_port()
    environment = os.environ | {
        "HELIOTWIN_DATA_DIR": str(tmp_path / "data"),
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-m", "service", "serve", "--port", str(port), "--json"]
    with child_process(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["url"]
        assert httpx.get(f"{url}/livez").status_code == 200


def test_the_last_line_of_the_demonstration_starts_the_service(tmp_path: Path):
    """As it is printed, whatever the folder is called."""
    printed = StringIO()
    demo._print(Console(file=printed, width=40), [], tmp_path, tmp_path / "a store's folder")
    line, port = printed.getvalue().splitlines()[-1], free_port()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = ["bash", "-c", f"exec env {line} --port {port} --json"]
    with child_process(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["url"]
        assert httpx.get(f"{url}/livez").status_code == 200
        assert (tmp_path / "a store's folder" / "heliotwin.sqlite").is_file()


_INTERRUPTED = """
import signal, sys, time
from service.cli import folder
from service.cli.main import main

def long(*_):
    print("begun", file=sys.stderr, flush=True)
    time.sleep(3600)

folder.predict_heliostat = long
sys.argv = ["heliotwin", *sys.argv[1:]]
# A shell that runs the tests in the background has it ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""


def test_an_interrupted_verb_ends_by_130(tmp_path: Path):
    """Ctrl-C: the exit code that a shell expects of an interrupted program, and no traceback."""
    command = [
        sys.executable,
        "-c",
        _INTERRUPTED,
        "predict",
        _plant(tmp_path),
        "--out",
        tmp_path / "out",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with child_process(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment
    ) as process:
        assert process.stderr is not None
        while b"begun" not in (line := process.stderr.readline()):
            assert line, "it ended before it was interrupted"
        process.send_signal(signal.SIGINT)
        errors = process.stderr.read()
        assert process.wait(WAIT_LIMIT_S) == 130, errors
    assert b"Traceback" not in errors
    assert (tmp_path / "out" / "predictions.json").is_file()
