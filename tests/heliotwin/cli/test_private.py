"""What the command writes of the store is its user's alone."""

import json
import stat
from pathlib import Path

import pytest
from sqlalchemy import URL

from tests.service.command import heliotwin_on
from tests.service.conftest import paint_measurement, png, properties_document, tower_document


def succeeds(folder: Path, *arguments: str, **settings: str) -> None:
    done = heliotwin_on(folder / "data", *arguments, **settings)
    assert done.returncode == 0, done.stderr


def open_to_others(root: Path) -> list[str]:
    """Files and folders that are not their owner's alone."""
    wrong = []
    for path in (root, *root.rglob("*")):
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode != (0o700 if path.is_dir() else 0o600):
            wrong.append(f"{path.relative_to(root)} {mode:o}")
    return wrong


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A measurement folder of one heliostat with a photograph."""
    calibration = tmp_path / "plant" / "AA39" / "Calibration"
    calibration.mkdir(parents=True)
    (tmp_path / "plant" / "AA39" / "Properties").mkdir()
    own = tmp_path / "plant" / "AA39" / "Properties" / "AA39-heliostat-properties.json"
    own.write_text(json.dumps(properties_document()))
    (tmp_path / "plant" / "plant-tower-measurements.json").write_text(json.dumps(tower_document()))
    (calibration / "1-calibration-properties.json").write_text(json.dumps(paint_measurement()))
    (calibration / "1-flux.png").write_bytes(png(1))
    return tmp_path


def test_store_and_back_up_are_their_user_s_alone(folder: Path):
    succeeds(folder, "import", str(folder / "plant"))
    succeeds(folder, "keys", "create", "reader", "--role", "read")
    succeeds(folder, "backup", str(folder / "backup"))
    assert len(list((folder / "data" / "images").rglob("*"))) >= 2
    assert open_to_others(folder / "data") == []
    assert open_to_others(folder / "backup") == []
    (folder / "again").mkdir()
    succeeds(folder / "again", "restore", str(folder / "backup"))
    assert open_to_others(folder / "again" / "data") == []
    succeeds(
        folder, "export", str(folder / "export")
    )  # what is meant for others is as their machine has it
    assert stat.S_IMODE((folder / "export").stat().st_mode) == 0o755


@pytest.mark.postgres
def test_back_up_of_postgres_is_its_user_s_alone(folder: Path, postgres_url: URL):
    url = postgres_url.set(drivername="postgresql").render_as_string(hide_password=False)
    succeeds(folder, "migrate", HELIOTWIN_DATABASE_URL=url)
    succeeds(folder, "backup", str(folder / "backup"), HELIOTWIN_DATABASE_URL=url)
    assert open_to_others(folder / "backup") == []
