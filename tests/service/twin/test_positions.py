"""Motors and spots without an image: kept, calibrated by as from a folder, exported, and shown as
what they are.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from typer.testing import CliRunner

from heliotwin.cli.main import app as cli
from heliotwin.folder_pointing import calibrate_folder
from service import store
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.store import mounts
from service.store.backup import back_up, images_of, restore
from service.store.check import inspect_store
from service.store.database import Database
from service.store.tables import MeasurementRow
from service.twin.calibration import StoreMounts, calibrate_store
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from tests.service.conftest import QUIET, sun_at
from tests.service.spots import photographs

NAMES = ("BF17", "BI08", "BJ14", "BL14")
"""The heliostats of the fewest measurements; one of BF17's has no time."""

BASE = "/v1/heliostats/AA39/measurements"


@pytest.fixture(scope="module")
def positions(stj_pointing: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four real heliostats with 45 measurements, none of which has an image."""
    root = tmp_path_factory.mktemp("positions")
    for name in NAMES:
        shutil.copytree(stj_pointing / name, root / name)
    shutil.copy(next(stj_pointing.glob("*tower-measurements.json")), root)
    return root


@pytest.fixture(scope="module")
def stored(
    positions: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Settings, dict[str, Any]]:
    """A store into which they were imported, and what the import said."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("store"), **QUIET)
    runtime = Runtime.from_settings(settings)
    runtime.database.upgrade()
    report = import_folder(runtime, read_folder(positions), actor="tester")
    runtime.close()
    return settings, report


def calibrated(settings: Settings) -> StoreMounts:
    runtime = Runtime.from_settings(settings)
    try:
        return calibrate_store(runtime, NAMES)
    finally:
        runtime.close()


def test_all_are_kept_and_a_second_import_changes_nothing(
    stored: tuple[Settings, dict[str, Any]], positions: Path
):
    settings, first = stored
    assert first["counts"]["positions new"] == 45
    assert first["skipped"] == {}
    runtime = Runtime.from_settings(settings)
    try:
        second = import_folder(runtime, read_folder(positions))
        with runtime.database.reading() as session:
            rows = session.scalars(select(MeasurementRow)).all()
    finally:
        runtime.close()
    assert second["counts"]["positions unchanged"] == len(rows) == 45
    assert {(row.kind, row.image_sha256, row.accepted) for row in rows} == {("none", None, True)}
    assert sum(row.taken_at is None for row in rows) == 1


def test_mounts_of_the_store_are_those_of_the_folder(
    stored: tuple[Settings, dict[str, Any]], positions: Path, tmp_path: Path
):
    of_folder = calibrate_folder(read_folder(positions), tmp_path / "mounts.json")
    of_store = calibrated(stored[0])
    assert of_store.skipped == of_folder["skipped"] == {}
    assert vars(of_store.undated) == of_folder["undated"] == {"used": 1, "left_out": 0}
    for name in NAMES:
        mount, parameters = of_store.done.mounts[name], of_folder["heliostats"][name]["parameters"]
        reported = np.array([parameter["value"] for parameter in parameters.values()])
        off = np.abs(mount.parameters - reported) / mount.spread
        assert off.max() < 0.01, name  # WGS84 and back rounds
        assert len(mount.steps) == len(of_folder["heliostats"][name]["steps"])
        assert {*of_store.done.contradictions[name]} == {*of_folder["heliostats"][name]["outliers"]}


@pytest.mark.full
def test_they_go_through_export_and_back_up(
    stored: tuple[Settings, dict[str, Any]], tmp_path: Path
):
    settings, _ = stored
    runtime = Runtime.from_settings(settings)
    try:
        exported = export_folder(runtime, tmp_path / "out")
    finally:
        runtime.close()
    assert exported["skipped"] == {}
    other = Settings(data_dir=tmp_path / "other", **QUIET)
    runtime = Runtime.from_settings(other)
    try:
        runtime.database.upgrade()
        report = import_folder(runtime, read_folder(tmp_path / "out"))
        again = import_folder(runtime, read_folder(tmp_path / "out"))
    finally:
        runtime.close()
    assert report["skipped"] == again["skipped"] == {}
    assert report["counts"]["positions new"] == 45
    assert all("unchanged" in what for what in again["counts"])
    one, two = calibrated(settings), calibrated(other)
    for name in NAMES:
        np.testing.assert_allclose(
            one.done.mounts[name].parameters, two.done.mounts[name].parameters, atol=1e-6
        )
    back_up(settings, tmp_path / "backup")
    third = Settings(data_dir=tmp_path / "third", **QUIET)
    restore(third, tmp_path / "backup")
    database = Database(third.database)
    with database.reading() as session:
        assert store.counts(session)["measurements"] == 45
    assert inspect_store(database, images_of(third), lambda _: None).is_sound
    database.close()


@pytest.mark.full
def test_what_is_skipped_is_counted_by_reason(
    positions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = Path(shutil.copytree(positions, tmp_path / "folder"))
    for path in (folder / "BI08" / "Calibration").glob("*calibration-properties.json"):
        document = json.loads(path.read_text())
        del document["motor_position"]
        path.write_text(json.dumps(document))
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    done = CliRunner().invoke(cli, ["import", str(folder)])
    assert done.exit_code == 0, done.output
    (line,) = [line for line in " ".join(done.stderr.split()).split("skipped ")[1:] if line]
    assert line.startswith("9: motor_position: is missing")
    done = CliRunner().invoke(cli, ["import", str(folder), "--json"])
    report = json.loads(done.stdout)
    assert len(report["skipped"]) == 9
    assert list(report["skipped_by_reason"].values()) == [9]


# --- over HTTP
# --------------------------------------------------------------------------------------------------


def send(client: TestClient, **document: Any) -> Any:
    """Post a measurement's metadata without an image."""
    return client.post(BASE, files={"metadata": (None, json.dumps({**document, "kind": "none"}))})


@pytest.fixture
def taken(tower: dict[str, Any], properties: dict[str, Any]) -> list[dict[str, Any]]:
    return [{**one, "target": "lower"} for one in photographs(tower, properties)]


def test_motors_and_a_spot_are_a_measurement(client: TestClient, taken: list[dict[str, Any]]):
    answer = send(client, **taken[0])
    assert answer.status_code == 201, answer.text
    document = answer.json()
    assert (document["kind"], document["image_sha256"], document["accepted"]) == (
        "none",
        None,
        True,
    )
    assert send(client, **taken[0]).status_code == 200
    other = {**taken[0], "sun": sun_at(179.0, taken[0]["sun"]["elevation_deg"])}
    assert send(client, **other).status_code == 409
    unnamed = {name: value for name, value in taken[1].items() if name != "id"}
    first, second = send(client, **unnamed), send(client, **unnamed)
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json()["id"] == second.json()["id"]
    for part in ("image", "flux"):
        gone = client.get(f"{BASE}/0/{part}")
        assert (gone.status_code, "without an image" in gone.json()["detail"]) == (404, True)
    page = client.get("/heliostats/AA39/photographs/0", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert "no image: motors and a spot" in page.text
    listed = client.get("/photographs", headers={"Accept": "text/html"}).text
    assert listed.count("no image</a>") == 2
    assert client.get("/v1/heliostats/AA39/surfaces/current").status_code == 404
    refused = client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["0"]})
    assert (refused.status_code, "came without an image" in refused.json()["detail"]) == (409, True)


@pytest.mark.parametrize("field", ["motor_position", "focal_spot_m"])
def test_one_without_motors_or_spot_is_refused(
    client: TestClient, taken: list[dict[str, Any]], field: str
):
    answer = send(client, **{**taken[0], field: None})
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith(f"{field}: is missing")
    image = client.post(BASE, files={"metadata": (None, json.dumps({**taken[0], "kind": "raw"}))})
    assert (image.status_code, "image: is missing" in image.json()["detail"]) == (422, True)


def test_an_excluded_one_calibrates_nothing(client: TestClient, taken: list[dict[str, Any]]):
    for one in taken[:3]:
        send(client, **one)
    excluded = client.patch(
        f"{BASE}/1", json={"excluded": True, "reason": "another heliostat's spot"}
    )
    assert excluded.json()["measurement"]["accepted"] is False
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        rows = mounts.pointing_measurements(session, store.get_heliostat(session, "AA39"))
    assert [row.identifier for row in rows] == ["0", "2"]
