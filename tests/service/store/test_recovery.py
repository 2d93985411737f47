"""Back-up, restore and check, on both databases: what comes back is what was there, and nothing is
overwritten.
"""

import json
import shutil
import threading
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, update
from typer.testing import CliRunner

from heliotwin.cli.main import app as cli
from model.errors import InvalidInputError
from service.base.errors import ConflictError
from service.base.settings import Settings
from service.store import queue
from service.store.backup import back_up, images_of, restore
from service.store.check import inspect_store
from service.store.columns import Base
from service.store.database import Database
from service.store.job_tables import JobRow, JobStepRow
from service.store.tables import MeasurementRow
from service.twin.photographs.ingest import ingest
from service.twin.runtime import Runtime
from tests.service.conftest import png
from tests.service.store.stores import PHOTOGRAPH


def contents(database: Database) -> dict[str, list[Any]]:
    """Every row of every table."""
    with database.engine.connect() as connection:
        return {
            name: [
                tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key))
            ]
            for name, table in Base.metadata.tables.items()
        }


def test_what_comes_back_is_what_was_there(runtime: Runtime, elsewhere: Settings, tmp_path: Path):
    manifest = back_up(runtime.settings, tmp_path / "one")
    assert (manifest.images, manifest.damaged) == (5, [])
    before = contents(runtime.database)
    assert all(
        before[name]
        for name in ("measurements", "surfaces", "surface_measurements", "drift", "jobs", "audit")
    )
    restore(elsewhere, tmp_path / "one")
    database = Database(elsewhere.database)
    assert contents(database) == before
    assert inspect_store(database, images_of(elsewhere), lambda _: None).is_sound
    restored = Runtime.from_settings(elsewhere, runtime.operations)
    row, is_new = ingest(restored, "AA39", PHOTOGRAPH, png(20))  # numbers go on after the last
    assert is_new
    # The server may have given numbers to other tests before.
    assert row.id == 1 + max(identity for identity, *_ in before["measurements"])
    restored.close()
    database.close()


def test_back_up_while_photographs_come_is_of_one_moment(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path
):
    stop, sent = threading.Event(), []

    def send() -> None:
        while not stop.is_set():
            sent.append(ingest(runtime, "AA39", PHOTOGRAPH, png(100 + len(sent)))[0].identifier)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        while len(sent) < 5:
            stop.wait(0.01)
        acknowledged = list(sent)
        back_up(runtime.settings, tmp_path / "one")
    finally:
        stop.set()
        thread.join()
    restore(elsewhere, tmp_path / "one")
    database = Database(elsewhere.database)
    assert inspect_store(database, images_of(elsewhere), lambda _: None).is_sound
    with database.reading() as session:
        assert set(acknowledged) <= set(session.scalars(select(MeasurementRow.identifier)))
    database.close()


def test_nothing_is_overwritten(runtime: Runtime, elsewhere: Settings, tmp_path: Path):
    back_up(runtime.settings, tmp_path / "one")
    with pytest.raises(InvalidInputError, match="exists"):
        back_up(runtime.settings, tmp_path / "one")
    before = contents(runtime.database)
    with pytest.raises(ConflictError, match="overwrites nothing"):
        restore(runtime.settings, tmp_path / "one")
    assert contents(runtime.database) == before
    stranger = images_of(elsewhere)
    stranger.put(b"of another store")
    with pytest.raises(ConflictError, match="not of this back-up"):
        restore(elsewhere, tmp_path / "one")


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("what", ["database", "image", "lost image", "list", "manifest"])
def test_damaged_back_up_is_not_restored(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path, what: str
):
    folder = tmp_path / "one"
    back_up(runtime.settings, folder)
    image = next(path for path in (folder / "images").rglob("*") if path.is_file())
    database = next(
        path
        for path in folder.iterdir()
        if path.name in ("database.sqlite", "measurements.copy.gz")
    )
    file = {
        "database": database,
        "list": folder / "images.txt",
        "manifest": folder / "manifest.json",
    }.get(what, image)
    if what == "manifest":
        file.write_text(file.read_text()[:-20])
    elif what == "lost image":
        file.unlink()
    else:
        _flip(file)
    with pytest.raises(InvalidInputError, match=r"damaged|cannot be read"):
        restore(elsewhere, folder)
    restored = Database(elsewhere.database)
    assert restored.revision() is None
    restored.close()
    assert not elsewhere.data_dir.exists() or not any(images_of(elsewhere).root.rglob("*"))


def test_restore_that_is_interrupted_can_be_tried_again(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    back_up(runtime.settings, tmp_path / "one")
    on_sqlite = elsewhere.database.get_backend_name() == "sqlite"
    with monkeypatch.context() as broken:
        broken.setattr(
            "shutil.copyfile" if on_sqlite else "service.store.backup._copy_in", interrupt
        )
        with pytest.raises(KeyboardInterrupt):
            restore(elsewhere, tmp_path / "one")
    restore(elsewhere, tmp_path / "one")
    database = Database(elsewhere.database)
    assert contents(database) == contents(runtime.database)
    database.close()


def test_damaged_image_in_the_store_ends_no_back_up(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path
):
    image = next(path for path in runtime.images.root.rglob("*") if path.is_file())
    _flip(image)
    manifest = back_up(runtime.settings, tmp_path / "one")
    assert len(manifest.damaged) == 1
    assert manifest.images == 4
    restore(elsewhere, tmp_path / "one")
    database = Database(elsewhere.database)
    report = inspect_store(database, images_of(elsewhere), lambda _: None)
    assert [found["reason"] for found in report.bad.values()] == ["missing"]
    database.close()


def test_back_up_of_another_engine_or_a_newer_schema_is_refused(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path
):
    folder = tmp_path / "one"
    back_up(runtime.settings, folder)
    document = json.loads((folder / "manifest.json").read_text())
    for change in ({"revision": "9999"}, {"engine": "oracle"}, {"format": 2}):
        (folder / "manifest.json").write_text(json.dumps(document | change))
        with pytest.raises(InvalidInputError):
            restore(elsewhere, folder)
    for text, says in (
        ("{", "is no JSON, wrong at line 1, column 1"),
        ("[]", "must be a JSON object"),
        (json.dumps({"format": document["format"]}), "engine: is missing"),
    ):
        (folder / "manifest.json").write_text(text)
        with pytest.raises(InvalidInputError, match=says):
            restore(elsewhere, folder)


# --- check
# --------------------------------------------------------------------------------------------------


def test_check_names_what_is_lost(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    first, second, third, *_ = sorted(
        path for path in runtime.images.root.rglob("*") if path.is_file()
    )
    _flip(first)
    second.write_bytes(second.read_bytes()[:10])
    third.unlink()
    (runtime.images.root / ".new-x").write_bytes(b"cut")
    runtime.images.put(b"of no row")
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(runtime.settings.data_dir))
    monkeypatch.setenv("HELIOTWIN_DATABASE_URL", str(runtime.settings.database_url))
    done = CliRunner().invoke(cli, ["check", "--json"])
    assert done.exit_code == 1
    report = json.loads(done.stdout)
    assert [
        report["bad"][path.parent.name + path.name]["reason"] for path in (first, second, third)
    ] == ["damaged", "damaged", "missing"]
    assert all(found["measurements"][0].startswith("AA39/") for found in report["bad"].values())
    assert (report["unused"], report["leftovers"]) == (1, 1)
    for seed in (0, 1, 2, 3, 9):  # posted again, they are whole again
        assert not ingest(runtime, "AA39", PHOTOGRAPH, png(seed))[1]
    assert CliRunner().invoke(cli, ["check"]).exit_code == 0


def test_verbs_of_the_command_line(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path, monkeypatch: Any
):
    folder = str(tmp_path / "one")
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(runtime.settings.data_dir))
    monkeypatch.setenv("HELIOTWIN_DATABASE_URL", str(runtime.settings.database_url))
    assert CliRunner().invoke(cli, ["backup", folder]).exit_code == 0
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(elsewhere.data_dir))
    monkeypatch.setenv("HELIOTWIN_DATABASE_URL", elsewhere.database_url or "")
    done = CliRunner().invoke(cli, ["restore", folder, "--json"])
    assert done.exit_code == 0
    assert json.loads(done.stdout)["images"] == 5
    assert CliRunner().invoke(cli, ["check"]).exit_code == 0
    assert CliRunner().invoke(cli, ["migrate", "--json"]).exit_code == 0
    shutil.rmtree(folder)


# --- jobs that are old
# ------------------------------------------------------------------------------------------------


def test_old_jobs_are_deleted_and_numbers_are_not_given_twice(runtime: Runtime):
    with runtime.database.writing() as session:
        for _ in range(5):
            queue.add_job(session, "squares", {}, "tester")
        at = queue.database_time(session)
        session.execute(update(JobRow).values(state="done", finished_at=at - timedelta(days=10)))
        numbers = sorted(session.scalars(select(JobRow.id)))
        for number, state in ((numbers[1], "running"), (numbers[2], "failed")):
            session.execute(update(JobRow).where(JobRow.id == number).values(state=state))
        session.execute(update(JobRow).where(JobRow.id == numbers[3]).values(finished_at=at))
        session.add(JobStepRow(job_id=numbers[0], name="part", result={}))
    with runtime.database.writing() as session:
        assert queue.purge(session, timedelta(days=5), most=2) == 2
        assert queue.purge(session, timedelta(days=5)) == 1
        assert queue.purge(session, timedelta(days=5)) == 0
        assert sorted(session.scalars(select(JobRow.id))) == [numbers[1], numbers[3], numbers[5]]


def test_clock_that_was_set_back_stalls_no_queue(runtime: Runtime):
    """Moments that lie further ahead than any pause or lease are those of a clock that
    was wrong.
    """
    with runtime.database.writing() as session:
        session.execute(
            update(JobRow).values(not_before=queue.database_time(session) + timedelta(hours=5))
        )
        row = queue.claim(session, ["predictions"], "one", 30.0, 3)
        assert row is not None
        assert not queue.has_claimable(session, ["predictions"], 30.0)
        row.lease_until = queue.database_time(session) + timedelta(hours=5)
        session.flush()
        taken = queue.claim(session, ["predictions"], "two", 30.0, 3)
        assert taken is not None
        assert taken.worker == "two"
        queue.retry(session, queue.lease_of(taken), "later", 300.0)
        session.flush()
        assert not queue.has_claimable(session, ["predictions"], 30.0)
