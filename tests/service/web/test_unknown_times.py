"""An unknown time is null everywhere, never the current time, and may be added later."""

import csv
import io
import json
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from heliotwin.cli.main import app as cli
from model.ephemeris import sun_angles_at
from model.frames import sun_direction
from model.times import format_minute
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.store.columns import now
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import ORIGIN, QUIET, Post, client_of, png, sun_at
from tests.service.spots import calibrate, photographs

HTML = {"Accept": "text/html"}
BASE = "/v1/heliostats/AA39/measurements"
NAMES = ("BF17", "BG14")


@pytest.fixture(scope="module")
def undated(stj_pointing: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two real heliostats' motors and spots over three years, without their times."""
    root = tmp_path_factory.mktemp("undated")
    for name in NAMES:
        shutil.copytree(
            stj_pointing / name, root / name, ignore=shutil.ignore_patterns("*-item-stac.json")
        )
    shutil.copy(next(stj_pointing.glob("*tower-measurements.json")), root)
    return root


@pytest.fixture
def imported(undated: Path, tmp_path: Path) -> Iterator[TestClient]:
    """A service with what was imported from that folder."""
    settings = Settings(data_dir=tmp_path, **QUIET | {"job_workers": 1, "job_poll_s": 0.05})
    runtime = Runtime.from_settings(settings)
    runtime.database.upgrade()
    import_folder(runtime, read_folder(undated))
    runtime.close()
    with client_of(create_app(settings)) as client:
        yield client


@pytest.mark.full
def test_an_import_without_times_invents_no_steps(imported: TestClient):
    """They had come two seconds apart, and their order was taken for that of years."""
    job = calibrate(imported)
    assert job["state"] == "done", job
    assert (job["result"]["steps"], job["result"]["clock"]) == ({}, None)
    assert job["result"]["undated"] == {"used": 43, "left_out": 0}
    for name in NAMES:
        mount = imported.get(f"/v1/heliostats/{name}/mounts/current").json()
        assert mount["valid_from"] is None
        assert not mount["drift"]["is_sure"]
        assert mount["predicted_error_mrad"]["median"] < 3
        pointing = imported.get(f"/v1/heliostats/{name}/pointing").json()
        assert (pointing["error_mrad"], pointing["moved"]) == (None, None)
        assert "none of which has a time" in imported.get(f"/heliostats/{name}", headers=HTML).text
    late = calibrate(imported, until=now().isoformat())
    assert late["state"] == "failed"  # it asks for a time, and of none it is known


def test_a_time_is_null_and_never_1970(imported: TestClient, tmp_path: Path):
    items = imported.get("/v1/heliostats/BG14/measurements?dated=false").json()["items"]
    assert len(items) == 24
    assert {item["taken_at"] for item in items} == {None}
    assert imported.get("/v1/heliostats/BG14/measurements?dated=true").json()["items"] == []
    rows = list(csv.DictReader(io.StringIO(imported.get("/heliostats/BG14/photographs.csv").text)))
    assert {row["taken_at"] for row in rows} == {""}
    page = imported.get("/photographs?dated=false&heliostat=BG14", headers=HTML).text
    assert page.count("time unknown") == 24
    assert "1970" not in page
    assert (
        "No photograph matches" in imported.get("/photographs?since=2000-01-01", headers=HTML).text
    )
    export_folder(imported.app.state.runtime, tmp_path / "out")  # type: ignore[attr-defined]
    report = json.loads(
        (tmp_path / "out" / "history" / "heliostats" / "BG14" / "history.json").read_text()
    )
    assert {one["taken_at"] for one in report["photographs"]} == {None}
    item = json.loads(
        next((tmp_path / "out" / "BG14" / "Calibration").glob("*-stac.json")).read_text()
    )
    assert item["properties"]["datetime"] is None  # and STAC demands a period, then
    assert item["properties"]["start_datetime"] < item["properties"]["end_datetime"]


def alarms_of(client: TestClient, reason: str) -> list[dict[str, Any]]:
    return list(client.get(f"/v1/alarms?reason={reason}").json()["items"])


def test_alarm_asks_for_times_and_goes_by_those_that_are_known(
    app: FastAPI, client: TestClient, post: Post
):
    post(png(1), id="1")
    (item,) = alarms_of(client, "times_unknown")
    assert "the time of its one accepted photograph is unknown" in item["message"]
    assert "PATCH /v1/measurements/times" in item["action"]
    assert alarms_of(client, "no_photograph") == []
    last = now() - timedelta(days=365)
    post(png(2), id="2", taken_at=last.isoformat())
    post(png(3), id="3")
    (item,) = alarms_of(client, "no_photograph")  # that some came today says nothing
    assert (
        item["message"]
        == f"the last accepted one is of {format_minute(last)}; the time of 2 more is unknown"
    )
    assert alarms_of(client, "times_unknown") == []
    assert "Times unknown:" not in client.get("/alarms", headers=HTML).text


def test_undated_photographs_are_no_news(client: TestClient, post: Post):
    """A surface of photographs without times has no beginning, and none of them says that forecasts
    got worse.
    """
    post(png(1), id="1")
    surface = client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"}).json()
    assert surface["valid_from"] is None
    assert "valid since an unknown time" in client.get("/heliostats/AA39", headers=HTML).text
    post(png(2), id="2")
    field = client.get("/v1/field").json()["items"][0]
    assert field["age_days"] is None
    assert "1970" not in client.get("/heliostats/AA39/surfaces.csv").text


# --- times that are given afterwards
# ----------------------------------------------------------------------------------


def give(
    client: TestClient, *times: tuple[str, str, str], reason: str = "from the cameras' log"
) -> Any:
    listed = [
        {"heliostat": name, "id": number, "taken_at": taken_at} for name, number, taken_at in times
    ]
    return client.patch("/v1/measurements/times", json={"reason": reason, "times": listed})


def test_times_are_given_in_bulk_as_corrections(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    taken = photographs(tower, properties, step_mrad=6.0)
    for number, one in enumerate(taken):
        assert post(png(number), **{**one, "taken_at": None}).status_code == 201
    times = [("AA39", one["id"], one["taken_at"]) for one in taken]
    assert give(client, *times).json() == {"given": 16, "changed": 16}
    assert give(client, *times).json() == {"given": 16, "changed": 0}
    (correction,) = client.get(f"{BASE}/3/corrections").json()["items"]
    assert (correction["reason"], correction["before"]) == (
        "from the cameras' log",
        {"taken_at": None},
    )
    actions = [item["action"] for item in client.get("/v1/audit").json()["items"]]
    assert actions[:2] == ["times.corrected", "measurement.corrected"]
    assert alarms_of(client, "times_unknown") == []


def test_one_wrong_entry_keeps_all_times_out(client: TestClient, post: Post):
    for number in "12":
        post(png(int(number)), id=number)
    moment, ahead = "2024-06-01T12:00:00Z", (now() + timedelta(days=9)).isoformat()
    answer = give(
        client,
        ("AA39", "1", moment),
        ("AA39", "7", moment),
        ("ZZ99", "1", moment),
        ("AA39", "2", ahead),
    )
    assert answer.status_code == 422
    assert {error["field"] for error in answer.json()["errors"]} == {
        "times.1",
        "times.2",
        "times.3",
    }
    twice = give(client, ("AA39", "1", moment), ("AA39", "1", moment))
    assert (twice.status_code, "named twice" in twice.json()["detail"]) == (422, True)
    assert client.get(f"{BASE}/1").json()["taken_at"] is None


def test_times_come_out_of_a_table(tmp_path: Path, undated: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    assert CliRunner().invoke(cli, ["import", str(undated)]).exit_code == 0
    numbers = [
        path.name.split("-")[0]
        for path in sorted((undated / "BG14" / "Calibration").glob("*.json"))
    ]
    table = tmp_path / "times.csv"
    lines = [f"BG14,{number},2022-06-{day:02d}T12:00:00Z" for day, number in enumerate(numbers, 1)]
    table.write_text("\n".join(["heliostat,id,taken_at", *lines]))
    done = CliRunner().invoke(cli, ["times", str(table), "--reason", "log", "--json"])
    assert (done.exit_code, json.loads(done.stdout)) == (0, {"given": 24, "changed": 24})
    table.write_text("heliostat,id,taken_at\nBG14,1,yesterday\n")
    done = CliRunner().invoke(cli, ["times", str(table), "--reason", "log"])
    assert (done.exit_code, "line 2: taken_at: must be a time" in str(done.exception)) == (1, True)


# --- a sun that contradicts its time
# ----------------------------------------------------------------------------------


def test_a_sun_that_contradicts_its_time_is_a_warning_everywhere(client: TestClient, post: Post):
    moment = datetime(2024, 6, 21, 10, 0, tzinfo=UTC)
    azimuth, elevation = sun_angles_at(moment, ORIGIN)
    sun = sun_at(azimuth, elevation)
    assert post(png(1), id="1", taken_at=moment.isoformat(), sun=sun).json()["warnings"] == []
    sun["azimuth_deg"] = (azimuth + 110) % 360
    document = post(png(2), id="2", taken_at=moment.isoformat(), sun=sun).json()
    (warning,) = document["warnings"]
    assert warning["type"] == "sun_contradicts_time"
    assert warning["detail"] == document["quality"]["clock"]
    apart = sun_direction(np.array([azimuth, sun["azimuth_deg"]]), np.full(2, elevation))
    assert warning["angle_deg"] == pytest.approx(
        np.degrees(np.arccos(apart[0] @ apart[1])), abs=0.01
    )
    listed = client.get(f"{BASE}?warned=true").json()["items"]
    assert [item["id"] for item in listed] == ["2"]
    assert (
        "The sun contradicts the time"
        in client.get("/heliostats/AA39/photographs/2", headers=HTML).text
    )
    page = client.get("/photographs?warned=true", headers=HTML).text
    assert "/photographs/2" in page
    assert "/photographs/1" not in page
    assert "sun contradicts time" in page
    (item,) = alarms_of(client, "sun_contradicts_time")
    assert (item["heliostat"], item["message"]) == (
        "AA39",
        "1 measurement with a sun that contradicts the time",
    )
    right = {"reason": "typing", "sun": sun_at(azimuth, elevation)}
    assert client.patch(f"{BASE}/2", json=right).json()["measurement"]["warnings"] == []
    assert alarms_of(client, "sun_contradicts_time") == []


def test_warnings_are_dated_by_their_change(client: TestClient, post: Post):
    """One warning is chance; the change is where they become usual."""
    moment = datetime(2024, 6, 15, 10, 0, tzinfo=UTC)
    for day in range(12):
        at = moment + timedelta(days=day)
        azimuth, elevation = sun_angles_at(at, ORIGIN)
        is_wrong = day == 2 or day >= 6
        sun = sun_at((azimuth + 110 * is_wrong) % 360, elevation)
        sent = post(png(day), id=str(day), taken_at=at.isoformat(), sun=sun)
        assert bool(sent.json()["warnings"]) == is_wrong
    (item,) = alarms_of(client, "sun_contradicts_time")
    assert item["message"] == (
        "7 measurements with a sun that contradicts the time,"
        " most since a time after 2024-06-20 10:00 UTC"
    )
    assert item["since"] == "2024-06-21T10:00:00Z"
