"""How verbs end: one clear line and the right code, whatever went wrong."""

import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.console import Console
from sqlalchemy import text

from heliotwin import folder as verbs
from heliotwin.cli import demo
from heliotwin.cli.main import main
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.store.database import Database, migrate
from tests.forked import Output, forked_process
from tests.service.command import ends, heliotwin_on, heliotwin_process
from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, child_process, until

ROOT = Path(__file__).parents[3]


def process_on(data: Path, *arguments: object, **settings: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a separate process: a service or a worker."""
    folder = data.parent
    for name in ("stdout", "stderr"):
        (folder / name).unlink(missing_ok=True)
    with heliotwin_process(folder, *arguments, HELIOTWIN_DATA_DIR=str(data), **settings) as process:
        code = process.wait(WAIT_LIMIT_S)
    said = ((folder / name).read_text(encoding="utf-8") for name in ("stdout", "stderr"))
    return subprocess.CompletedProcess(arguments, code, *said)


def test_a_database_that_cannot_be_read_is_one_line(tmp_path: Path):
    data = tmp_path / "data"
    data.mkdir()
    (data / "heliotwin.sqlite").write_bytes(
        b"no database at all, but long enough to look like one" * 100
    )
    for verb in (("keys", "list"), ("models", "list"), ("migrate",)):
        ends(heliotwin_on(data, *verb), 1, "heliotwin: the database: file is not a database")


def test_lists_take_no_lock_and_migrate_nothing(made_plant: Path, tmp_path: Path):
    data = tmp_path / "data"
    for verb in ("keys", "models"):
        assert heliotwin_on(data, verb, "list").returncode == 0
    assert not data.exists()
    settings = Settings(data_dir=data)
    assert migrate(settings)
    database = Database(settings.database)
    database.downgrade("base")
    database.close()
    ends(heliotwin_on(data, "keys", "list"), 1, "heliotwin migrate")
    ends(
        heliotwin_on(data, "import", made_plant, HELIOTWIN_MIGRATE_ON_START="false"),
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


@pytest.mark.parametrize(
    "verb",
    ["serve", "worker", "migrate", "export", "backup", "check", "keys list", "models list"]
    + ["models withdraw 1", "import"],
)
def test_a_store_of_an_earlier_schema_is_refused_in_one_line(
    made_plant: Path, tmp_path: Path, verb: str
):
    settings = Settings(data_dir=tmp_path / "data")
    database = Database(settings.database)
    database.upgrade()
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '0025'"))
    database.close()
    folder = {"import": [made_plant], "export": [tmp_path / "a"], "backup": [tmp_path / "b"]}
    arguments = [*verb.split(), *folder.get(verb, ())]
    ends(heliotwin_on(settings.data_dir, *arguments), 1, "(schema 0025, not")
    assert not (tmp_path / "a").exists()


@pytest.mark.full
def test_an_open_door_is_refused_in_one_line(tmp_path: Path):
    done = process_on(tmp_path / "data", "serve", "--host", "0.0.0.0")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if "holds no key" in line]
    assert len(errors) == 1
    assert done.stderr.strip().splitlines()[-1] == errors[0]


@pytest.mark.parametrize("window", ["-4", "0", "nan", "1e9"])
def test_a_window_that_is_none_is_bad_input(made_plant: Path, tmp_path: Path, window: str):
    done = heliotwin_on(
        tmp_path / "data", "forecast", made_plant, "--out", tmp_path / "out", "--window", window
    )
    ends(done, 2, "--window must lie in 0 to 1000 m")


def test_version(tmp_path: Path):
    done = heliotwin_on(tmp_path / "data", "--version")
    assert done.returncode == 0
    assert done.stdout.startswith("heliotwin")


@pytest.mark.full
def test_an_interrupted_prediction_leaves_what_was_done(
    made_plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder, calls = read_folder(made_plant), []
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


@pytest.mark.full
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


@pytest.mark.parametrize("form", [(), pytest.param(("--json",), marks=pytest.mark.full)])
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
    settings = {"HELIOTWIN_DATA_DIR": str(tmp_path / "data")}
    output = tmp_path / "stdout"
    with heliotwin_process(
        tmp_path, "serve", "--port", free_port(), "--json", **settings
    ) as process:

        def first_line() -> str | None:
            assert process.poll() is None, (tmp_path / "stderr").read_text(encoding="utf-8")
            line, end, _ = (
                output.read_text(encoding="utf-8").partition("\n")
                if output.is_file()
                else ("", "", "")
            )
            return line if end else None

        url = json.loads(until(first_line, "it says where it listens"))["url"]
        assert httpx.get(f"{url}/livez").status_code == 200


@pytest.mark.full
def test_the_last_line_of_the_demonstration_starts_the_service(tmp_path: Path):
    """As it is printed, whatever the folder is called."""
    printed = StringIO()
    demo._print(Console(file=printed, width=40), [], None, tmp_path, tmp_path / "a store's folder")
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


def _predict_for_hours(begun: str, *arguments: str) -> None:
    def long(*_: Any) -> None:
        Path(begun).touch()
        time.sleep(3600)

    verbs.predict_heliostat = long  # type: ignore[assignment]
    sys.argv = ["heliotwin", "predict", *arguments]
    # A shell that runs the tests in the background has it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main()


@pytest.mark.full
def test_an_interrupted_verb_ends_by_130(made_plant: Path, tmp_path: Path):
    """Ctrl-C: the exit code that a shell expects of an interrupted program, and no traceback."""
    begun, errors, out = (tmp_path / name for name in ("begun", "stderr", "out"))
    with forked_process(
        _predict_for_hours,
        os.environ,
        *map(str, (begun, made_plant, "--out", out)),
        output=Output(tmp_path / "stdout", errors),
    ) as process:

        def has_begun() -> bool:
            assert process.poll() is None, errors.read_text(encoding="utf-8")
            return begun.is_file()

        until(has_begun, "the prediction begins")
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_LIMIT_S) == 130, errors.read_text(encoding="utf-8")
    assert "Traceback" not in errors.read_text(encoding="utf-8")
    assert (out / "predictions.json").is_file()
