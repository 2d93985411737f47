"""The page of work that can be started: the cost of each, and the second click that starts it."""

import json
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.settings import Settings
from tests.service import real
from tests.service.conftest import QUIET, Post, png
from tests.service.spots import photographs
from tests.service.web.pages import HTML, make_key, text_of


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    root = tmp_path / "imports"
    (root / "stj" / "AB01" / "Properties").mkdir(parents=True)
    return Settings(data_dir=tmp_path / "data", import_root=root, **QUIET)


def _started(client: TestClient, path: str, **form: str) -> dict[str, Any]:
    """The job that a form starts, when it is done."""
    answer = client.post(path, data=form, headers=HTML, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    assert real.worker(client).work()
    job: dict[str, Any] = client.get(f"/v1{answer.headers['Location']}").json()
    return job


def test_predictions_show_their_cost_before_they_start(client: TestClient, post: Post):
    post(png(1))
    page = text_of(client, "/jobs/start")
    text = page.one("section", id="predictions").words
    assert "1 surface, about 3 min" in text.replace("\xa0", " ")
    assert client.get("/v1/jobs").json()["items"] == []
    job = _started(client, "/jobs/predictions", method="refined", heliostat="")
    assert job["state"] == "done"
    assert job["payload"]["heliostats"] is None
    text = text_of(client, "/jobs/start?heliostat=AA39").one("section", id="predictions").words
    assert "the median of 1 earlier job on this machine" in text
    assert "Predict AA39, refined" in text


def test_calibration_and_import_show_their_cost(
    client: TestClient, post: Post, settings: Settings, tower: Any, properties: Any
):
    for number, taken in enumerate(photographs(tower, properties)):
        assert post(png(number), **taken).status_code == 201
    page = text_of(client, "/jobs/start?folder=stj")
    assert "1 mount, about" in page.one("section", id="calibrations").words.replace("\xa0", " ")
    assert "0 images" in page.one("section", id="imports").words.replace("\xa0", " ")
    job = _started(client, "/jobs/calibrations", heliostat="AA39", since="2024-05-01T00:00")
    assert job["result"]["mounts"] == {"AA39": 1}
    root = settings.import_root
    assert root is not None
    (root / "stj" / "tower-measurements.json").write_text(json.dumps(tower))
    (root / "stj" / "AB01" / "Properties" / "AB01-heliostat-properties.json").write_text(
        json.dumps(properties)
    )
    assert (
        _started(client, "/jobs/imports", folder="stj")["result"]["counts"]["heliostats new"] == 1
    )


@pytest.mark.parametrize("folder", ["..", "nothing"])
def test_only_folders_of_the_allowed_one_are_offered(client: TestClient, folder: str):
    answer = client.get("/jobs/start", params={"folder": folder}, headers=HTML)
    assert answer.status_code == 422
    assert "under the one that may be imported" in answer.text
    assert client.post("/jobs/imports", data={"folder": folder}, headers=HTML).status_code == 422


def test_an_unknown_heliostat_is_named(client: TestClient):
    answer = client.get("/jobs/start?heliostat=ZZ99", headers=HTML)
    assert answer.status_code == 404
    assert "ZZ99" in answer.text


@pytest.mark.full
def test_a_calibration_shows_mounts_steps_outliers_and_why_it_skipped(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    taken = photographs(tower, properties, step_mrad=6.0)
    taken[3] = taken[3] | {
        "focal_spot_m": [x + 0.8 for x in taken[3]["focal_spot_m"][:1]]
        + taken[3]["focal_spot_m"][1:]
    }
    for number, one in enumerate(taken):
        assert post(png(number), **one).status_code == 201
    client.put("/v1/heliostats/AB01", json=properties)
    job = _started(client, "/jobs/calibrations")
    page = text_of(client, f"/jobs/{job['id']}")
    mounts = page.one("table", id="mounts").words
    assert mounts.count("±") == 5  # with the caption
    (step,) = page.one("table", id="steps").all("tr")[1:]
    assert "it likely lost steps" in step.words
    assert step.all("a", href="/heliostats/AA39/photographs/7")
    (outlier,) = page.one("table", id="outliers").all("tr")[1:]
    assert outlier.one("a")["href"] == "/heliostats/AA39/photographs/3"
    assert "no measurement with motor positions and a spot: AB01" in page.words
    sheet = client.get(f"/jobs/{job['id']}?table=mounts").text
    assert sheet.startswith("Heliostat,Version,")
    # A later calibration makes another version, and the page of this one stays as it is.
    _started(client, "/jobs/calibrations")
    assert text_of(client, f"/jobs/{job['id']}").one("table", id="mounts").words == mounts


def test_a_reader_sees_costs_and_no_buttons(app: FastAPI, client: TestClient, post: Post):
    post(png(1))
    client.headers["Authorization"] = f"Bearer {make_key(app, 'read')}"
    page = text_of(client, "/jobs/start?folder=stj")
    assert "1\xa0surface, about" in page.words
    assert page.words.count("Starting it needs the role operate.") == 3
    assert not [
        form for form in page.all("form") if "/jobs/" in form["action"] and form["method"] == "post"
    ]
    for path in ("/photographs/times", "/photographs/upload"):
        assert "needs the role operate" in text_of(client, path).words
