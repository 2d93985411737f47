"""A damaged SQLite file is reported as such: by `check` in one line, and by readiness."""

import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest

from heliotwin.cli.main import main
from service.base.settings import Settings
from service.store.database import migrate
from service.web.app import create_app
from tests.service.conftest import FakeOperations, client_of


@pytest.fixture
def file(settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The embedded database, nobody's at the moment."""
    settings.data_dir.mkdir(parents=True)
    migrate(settings)
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(settings.data_dir))
    return settings.data_dir / "heliotwin.sqlite"


def spoil(file: Path, table: str | None) -> None:
    """Overwrite the first page, or that where a table begins."""
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        (size,) = connection.execute("PRAGMA page_size").fetchone()
        found = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)
        ).fetchone()
    with file.open("r+b") as opened:
        opened.seek(0 if found is None else (found[0] - 1) * size)
        opened.write(b"\xa5" * size)


@pytest.mark.parametrize("table", [None, "images", "measurements"])
def test_check_ends_in_one_line(
    file: Path,
    table: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    spoil(file, table)
    monkeypatch.setattr(sys, "argv", ["heliotwin", "check"])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err.strip()
    assert ended.value.code == 1
    assert "damaged" in said or "database:" in said
    assert "Traceback" not in said
    if table != "measurements":  # that one is read by SQLite's own check, which lists what it finds
        assert len(said.splitlines()) == 1


def test_readiness_says_so(file: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("service.web.root.health.default_predictor", lambda: None)
    with client_of(create_app(settings, FakeOperations())) as client:
        assert client.get("/readyz").status_code == 200
        spoil(file, "measurements")
        ready = client.get("/readyz")
    assert ready.status_code == 503
    assert ready.json()["checks"]["database"].startswith("damaged")
