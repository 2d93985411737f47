"""Pages of the plant: targets and receivers, settings, keys, the audit trail; and the form for a
key.
"""

from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.store import keys
from service.web.app import create_app
from tests.service.conftest import QUIET, FakeOperations, Post, client_of
from tests.service.web.pages import HTML, make_key, text_of


@pytest.fixture
def pages(client: TestClient, post: Post) -> TestClient:
    assert post().status_code == 201
    client.headers.update(HTML)
    return client


def test_plant_shows_targets_with_their_photographs_and_the_sun_shape(pages: TestClient):
    page = text_of(pages, "/plant")
    assert page.index('<th scope="row">lower</th>') < page.index('<th scope="row">upper</th>')
    assert page.cells("lower")[3:5] == ["7.00", "1"]
    assert "circumsolar ratio 0.02" in page
    assert "Buie" in page


def test_receiver_is_on_the_page(pages: TestClient):
    receiver = {
        "center": [0, 0, 55.2],
        "normal": [0, 1, 0],
        "radius": 4.1,
        "height": 5.2,
        "opening_deg": 60,
    }
    assert pages.put("/v1/receivers/drum", json=receiver).status_code == 201
    page = text_of(pages, "/plant")
    assert page.cells("drum")[0] == "0.00, 0.00, 55.20"


def test_settings_are_shown_without_secrets(tmp_path: Path):
    secret = tmp_path / "password"
    secret.write_text("s3cret-of-the-file", encoding="utf-8")
    settings = Settings(
        data_dir=tmp_path,
        database_password_file=secret,
        otlp_endpoint="https://tracer:s3cret-of-traces@collector:4318/v1?token=s3cret-token",
        **QUIET,
    )
    rows = {row.name: row for row in settings.in_force}
    assert rows["HELIOTWIN_OTLP_ENDPOINT"].value == "https://tracer:***@collector:4318/v1?***"
    assert rows["HELIOTWIN_JOB_WORKERS"].value == "0"
    assert rows["HELIOTWIN_JOB_WORKERS"].is_set
    assert not rows["HELIOTWIN_PORT"].is_set
    assert rows["HELIOTWIN_MAP_SCALES"].value.startswith("accuracy 95 to 75, deviation_mm 0 to 2")
    assert all(row.about for row in settings.in_force)
    database = Settings(database_url="postgresql://helio:s3cret@db/twin?sslpassword=s3cret")
    shown = "".join(row.value for row in (*settings.in_force, *database.in_force))
    assert "s3cret" not in shown
    assert "postgresql://helio:***@db/twin?***" in shown
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), FakeOperations())) as client:
        page = text_of(client, "/plant/settings")
    assert page.cells("HELIOTWIN_DATA_DIR")[:2] == [str(tmp_path), "set"]


def test_keys_and_audit_are_for_administrators(app: FastAPI, pages: TestClient):
    made = {role: make_key(app, role) for role in ("read", "operate", "admin")}
    with app.state.runtime.database.writing() as session:
        keys.withdraw(session, "operate", "tester")
    pages.headers["Authorization"] = f"Bearer {made['read']}"
    assert "Audit trail" not in text_of(pages, "/plant")
    for path in ("/plant/settings", "/plant/keys", "/plant/audit"):
        assert "needs admin" in text_of(pages, path, 403)
    pages.headers["Authorization"] = f"Bearer {made['admin']}"
    assert "Audit trail" in text_of(pages, "/plant")
    page = text_of(pages, "/plant/keys")
    assert "withdrawn</span> <time" in page
    assert not [key for key in made.values() if key in page]
    audited = text_of(pages, "/plant/audit")
    assert audited.index("key.withdrawn") < audited.index("key.created")
    assert "role admin" in audited


def test_audit_goes_back_page_by_page(app: FastAPI, pages: TestClient):
    for number in range(101):
        make = f"/v1/targets/wall-{number}"
        plane = {"center": [0, -3.2, 35.9], "normal": [0, 1, 0], "width": 8.6, "height": 7.2}
        assert pages.put(make, json={"plane": plane}).status_code == 201
    page = text_of(pages, "/plant/audit")
    assert page.count("<tr>") == 101
    older = page.partition("/plant/audit?after=")[2].partition('"')[0]
    assert "plant.set" in text_of(pages, f"/plant/audit?after={older}")


def test_wrong_key_leads_back_to_the_form(app: FastAPI, pages: TestClient):
    make_key(app, "read")
    answer = pages.post("/login", data={"key": "htw_wrong", "next": "/jobs"})
    assert answer.status_code == 401
    assert "This key is not valid" in answer.text
    assert 'name="next" value="/jobs"' in answer.text
    assert "<form" in answer.text


def test_withdrawn_key_is_refused_with_its_reason(app: FastAPI, pages: TestClient):
    assert pages.post("/session", data={"key": make_key(app, "read")}).status_code < 400
    assert "Jobs" in text_of(pages, "/jobs")
    with app.state.runtime.database.writing() as session:
        keys.withdraw(session, "read", "tester")
    page = text_of(pages, "/jobs")  # goes by way of the login
    assert "session of this browser has ended" in page
    assert 'value="/jobs"' in page
