"""Adopting an effect: surfaces made with the old model are listed, and made again."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from heliotwin.cli.main import app as command
from service.store import outdated_surfaces
from tests.service.conftest import FakeOperations, Post, png
from tests.service.studies import SLOPE, report_of
from tests.service.web.pages import HTML, keep_study, make_key, text_of, work


@pytest.fixture
def pages(client: TestClient, post: Post, properties: dict[str, Any]) -> TestClient:
    """Two heliostats with predicted surfaces, and one without."""
    for name in ("AB01", "AB02"):
        assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
    for number, name in enumerate(("AA39", "AB01")):
        assert post(png(number), heliostat=name, id=f"10{number}").status_code == 201
        assert client.post(f"/v1/heliostats/{name}/surfaces", json={}).status_code == 201
    client.headers.update(HTML)
    return client


def test_adopting_names_the_surfaces_of_the_old_model(app: FastAPI, pages: TestClient):
    number = keep_study(app, SLOPE)
    assert "another version of the model" not in text_of(pages, "/studies")
    answer = pages.post(f"/v1/studies/{number}/adopt", headers={"Accept": "application/json"})
    assert answer.json()["outdated_surfaces"] == {"AA39": 1, "AB01": 1}
    for path in ("/studies", f"/studies/{number}"):
        page = text_of(pages, path)
        assert "Of the active surfaces 2 were made by another version" in page
        assert (
            '<a href="/heliostats/AB01">AB01</a> (version 1, by model version 1, no effects)'
            in page
        )
        assert "Predict these 2 again" in page
    # Withdrawn, the old model is the current one again, and its surfaces are in order.
    assert pages.post(f"/studies/{number}/withdraw", follow_redirects=False).status_code == 303
    assert "another version of the model" not in text_of(pages, "/studies")


def test_open_questions_need_a_tick_and_a_reason(real_client: TestClient):
    """The real study finds an effect with a look-alike, and most of the error stays."""
    rest, page = "/v1/studies/1", text_of(real_client, "/studies/1")
    unexplained = "61% of the error beyond noise is unexplained"
    alike = "the photographs cannot distinguish camera shoulder from camera response"
    assert real_client.get(rest).json()["open_questions"] == [unexplained, alike]
    for text in (unexplained, alike.capitalize(), "To decide, photograph a lamp"):
        assert text in page
    assert page.one("input", name="read").attributes.keys() >= {"required"}
    for body in ({}, {"force": True}):
        refused = real_client.post(f"{rest}/adopt", json=body)
        assert refused.status_code == 409
        detail = refused.json()["detail"]
        assert detail.startswith("reason: ")
        assert unexplained in detail
        assert alike in detail
    form = {"reason": "the lamp said so"}
    assert "tick" in real_client.post("/studies/1/adopt", data=form).json()["detail"]
    assert real_client.post("/studies/1/adopt", data={"read": "true"}).status_code == 409
    done = real_client.post(
        "/studies/1/adopt", data=form | {"read": "true"}, follow_redirects=False
    )
    assert done.status_code == 303
    assert real_client.get("/v1/models/current").json()["reason"] == "the lamp said so"
    assert "the lamp said so" in text_of(real_client, "/studies/1")
    back = {"reason": "it was another lamp"}
    assert real_client.post(f"{rest}/withdraw", json=back).status_code == 200
    versions = real_client.get("/v1/models").json()["items"]
    assert versions[-1]["withdrawn_reason"] == "it was another lamp"
    entries = [entry["detail"] for entry in real_client.get("/v1/audit").json()["items"][:2]]
    assert [entry["reason"] for entry in entries] == ["it was another lamp", "the lamp said so"]


def test_list_adopts_withdraws_and_adopts_again(real_client: TestClient):
    def state() -> str:
        table = real_client.get("/studies", params={"table": "studies"}).text.splitlines()
        (line,) = csv.DictReader(table)
        assert (line["Verdict"], line["Found"]) == ("effect found", "camera shoulder")
        assert float(line["Unexplained [%]"]) == pytest.approx(60.84)
        return line["State"]

    def post(action: str) -> None:
        form = {"read": "true", "reason": "as agreed", "back": "list"}
        answer = real_client.post(f"/studies/1/{action}", data=form, follow_redirects=False)
        assert answer.headers["Location"] == "/studies#studies-title"

    assert state() == "withdrawn (version 2)"
    assert "Adopt again" in text_of(real_client, "/studies")
    post("adopt")
    assert state() == "active (version 3)"
    page = text_of(real_client, "/studies")
    assert "as agreed" in page
    assert "Adopt again" not in page
    post("withdraw")
    assert state() == "withdrawn (version 3)"


def test_change_is_shown_before_it_is_adopted(real_client: TestClient):
    page = text_of(real_client, "/studies/1")
    assert "Compute the change of 2 forecasts" in page
    assert "5 better, 0 worse" in page
    change = text_of(real_client, "/studies/1/change")
    assert "The flux stays the same: camera shoulder acts on the photographs" in change
    rows = list(
        csv.DictReader(real_client.get("/studies/1/change?table=changes").text.splitlines())
    )
    assert [row["Heliostat"] for row in rows] == ["AA39", "AC43"]
    for row in rows:
        assert row["Peak before [W/m²]"] == row["Peak after [W/m²]"]
        assert float(row["Largest change [%]"]) == 0
        assert float(row["In the camera's image [%]"]) > 5
    assert "I have read this" in change
    # It changes nothing.
    assert real_client.get("/v1/models/current").json()["version"] == 1


def test_job_predicts_outdated_surfaces_again(
    app: FastAPI, pages: TestClient, operations: FakeOperations
):
    pages.post(f"/v1/studies/{keep_study(app, SLOPE)}/adopt")
    path = pages.post(
        "/studies/predictions", data={"method": "network"}, follow_redirects=False
    ).headers["Location"]
    job = pages.get(f"/v1{path}").json()
    assert (job["payload"]["heliostats"], job["payload"]["method"]) == (["AA39", "AB01"], "network")
    work(app)
    assert [effect.name for effect in operations.models[-1].effects] == ["slope_error"]
    with app.state.runtime.database.reading() as session:
        left = outdated_surfaces(session, "2:slope_error")
    assert left == []  # they are no worse, so they are active
    assert "another version of the model" not in text_of(pages, "/studies")
    assert pages.post("/studies/predictions").status_code == 409


def test_what_waits_aside_is_not_offered_again(app: FastAPI, pages: TestClient):
    pages.post(f"/v1/studies/{keep_study(app, SLOPE)}/adopt")
    assert pages.post("/v1/heliostats/AB01/surfaces", json={}).status_code == 201
    back = {"version": 1, "reason": "the old one was better"}
    assert pages.put("/v1/heliostats/AB01/surfaces/current", json=back).status_code == 200
    page = text_of(pages, "/studies")
    assert "one made by the current model waits aside" in page
    assert "Predict it again" in page
    path = pages.post("/studies/predictions", follow_redirects=False).headers["Location"]
    assert pages.get(f"/v1{path}").json()["payload"]["heliostats"] == ["AA39"]


def test_readers_see_outdated_surfaces_without_a_button(app: FastAPI, pages: TestClient):
    pages.post(f"/v1/studies/{keep_study(app, SLOPE)}/adopt")
    pages.headers["Authorization"] = f"Bearer {make_key(app, 'read')}"
    page = text_of(pages, "/studies")
    assert "Of the active surfaces 2" in page
    assert "/studies/predictions" not in page
    assert pages.post("/studies/predictions").status_code == 403


def test_command_line_names_them_too(
    app: FastAPI, pages: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(app.state.runtime.settings.data_dir))
    report = tmp_path / "report.json"
    report.write_text(
        json.dumps(report_of(SLOPE, verdict="effect") | {"known_effects": []}), encoding="utf-8"
    )
    done = CliRunner().invoke(command, ["models", "adopt", str(report)])
    assert done.exit_code == 0, done.output
    assert "AA39, AB01" in done.output.replace("\n", " ")
    document = report_of(SLOPE | {"lookalikes": ["sun_shape"]})
    report.write_text(json.dumps(document), encoding="utf-8")
    refused = CliRunner().invoke(command, ["models", "adopt", str(report)])
    assert "cannot distinguish slope error from sun shape" in str(refused.exception)
    options = ["--reason", "no haze"]
    assert CliRunner().invoke(command, ["models", "adopt", str(report), *options]).exit_code == 0
