"""Every error is a problem document, and nothing of the inside shows in it."""

import json
import logging
from typing import Any

import jsonschema
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.errors import SchemaError
from service.base.settings import Settings
from service.web.app import create_app
from service.web.resources.measurements import MeasurementIn
from tests.service.conftest import client_of, metadata
from tests.service.web.problems import check


@pytest.mark.parametrize(
    "path",
    ["/nothing", "/v1", "/v1/nothing", "/v1/heliostats/", "/v1/heliostats/a/b", "/../etc/passwd"],
)
def test_unknown_path(refusing: TestClient, path: str):
    assert "docs" in check(refusing.get(path), 404)["detail"]


def test_unknown_method(refusing: TestClient):
    answer = refusing.delete("/v1/heliostats")
    check(answer, 405)
    assert "GET" in answer.headers["Allow"] or "POST" in answer.headers["Allow"]


def test_unreadable_body(refusing: TestClient):
    headers = {"Content-Type": "application/json"}
    check(refusing.post("/v1/heliostats", content=b"{", headers=headers), 422)
    check(refusing.post("/v1/heliostats", content=b"\xff\xfe", headers=headers), 422)
    check(refusing.post("/v1/heliostats", content=b"", headers=headers), 422)


@pytest.mark.parametrize(
    "content_type", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""]
)
def test_body_that_is_not_json(refusing: TestClient, content_type: str):
    headers = {"Content-Type": content_type} if content_type else {}
    for method, path in (
        ("POST", "/v1/heliostats"),
        ("PUT", "/v1/heliostats/A"),
        ("PUT", "/v1/targets/A"),
        ("PUT", "/v1/plant"),
        ("POST", "/v1/forecasts"),
        ("POST", "/v1/heliostats/A/surfaces"),
    ):
        check(refusing.request(method, path, content=b"{}", headers=headers), 415)


def test_body_that_is_too_large(bare: TestClient, settings: Settings):
    headers = {"Content-Type": "application/json"}
    check(
        bare.post("/v1/heliostats", content=bytes(settings.max_json_bytes + 1), headers=headers),
        413,
    )

    def chunks() -> Any:
        for _ in range(settings.max_json_bytes // 1000 + 100):
            yield b" " * 1000

    check(bare.post("/v1/heliostats", content=chunks(), headers=headers), 413)


def test_every_wrong_field_is_listed(refusing: TestClient):
    document = check(
        refusing.post("/v1/forecasts", json={"heliostat": "a b", "sun": {"azimuth_deg": "x"}}), 422
    )
    assert {error["field"] for error in document["errors"]} == {
        "heliostat",
        "sun.azimuth_deg",
        "sun.elevation_deg",
    }


def test_text_in_errors_can_always_be_sent(refusing: TestClient):
    body = json.dumps({"heliostat": "A", "sun": {}, "\ud800": 1})
    check(
        refusing.post("/v1/forecasts", content=body, headers={"Content-Type": "application/json"}),
        422,
    )


def test_unexpected_failure_says_nothing_of_the_inside(
    app: FastAPI,
    bare: TestClient,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    def fail(*_: Any) -> None:
        raise ZeroDivisionError("the secret inside")

    monkeypatch.setattr("service.store.list_heliostats", fail)
    with caplog.at_level(logging.ERROR, "heliotwin.service"):
        document = check(bare.get("/v1/heliostats"), 500)
    assert "secret" not in json.dumps(document)
    assert document["request_id"] in caplog.text
    assert "the secret inside" in caplog.text


def test_database_that_is_away_is_said(app: FastAPI, bare: TestClient, settings: Settings):
    """The embedded database is replaced by a folder, which no connection opens."""
    app.state.runtime.database.close()
    file = settings.data_dir / "heliotwin.sqlite"
    for leftover in settings.data_dir.glob("heliotwin.sqlite*"):
        leftover.unlink()
    file.mkdir()
    answer = bare.get("/v1/heliostats")
    check(answer, 503)
    assert answer.headers["Retry-After"]
    ready = bare.get("/readyz")
    assert ready.status_code == 503
    assert ready.json()["checks"]["database"] == "unavailable"
    assert bare.get("/livez").status_code == 200


def test_request_id_is_the_callers_where_it_is_well_formed(refusing: TestClient):
    given = refusing.get("/livez", headers={"X-Request-ID": "abc-12345"})
    assert given.headers["X-Request-ID"] == "abc-12345"
    for bad in ("short", "a" * 65, "with space here", "a\tb3456789"):
        assert refusing.get("/livez", headers={"X-Request-ID": bad}).headers["X-Request-ID"] != bad


def test_openapi_document_is_tidy(refusing: TestClient):
    document = refusing.get("/openapi.json").json()
    assert refusing.get("/docs").status_code == 200
    operations = [
        (path, method, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    names = [operation["operationId"] for _, _, operation in operations]
    assert len(set(names)) == len(names)
    for path, method, operation in operations:
        assert operation["tags"], path
        assert operation.get("summary"), path
        for status, response in operation["responses"].items():
            if int(status) >= 400 and path.startswith("/v1"):
                assert list(response["content"]) == ["application/problem+json"], (
                    path,
                    method,
                    status,
                )
    schemas = document["components"]["schemas"]
    assert "HTTPValidationError" not in schemas
    assert not [name for name in schemas if "__" in name], (
        "two models share a name; generated clients refuse that"
    )
    jsonschema.Draft202012Validator.check_schema({"$defs": document["components"]["schemas"]})


def test_every_number_says_its_unit(refusing: TestClient):
    """Numbers in requests and answers carry a unit in their description, their name, or are known
    to have none.
    """
    unitless = {
        "normal", "up", "version", "images", "surface", "resolution", "misfit", "id",
        "surface_version", "status", "accepted", "power_plant_properties",
    }  # fmt: skip
    schemas = refusing.get("/openapi.json").json()["components"]["schemas"]
    missing = [
        f"{name}.{key}"
        for name, schema in schemas.items()
        for key, field in schema.get("properties", {}).items()
        if '"number"' in json.dumps(field) and key not in unitless
        if "[" not in field.get("description", "")
        and not key.endswith(("_deg", "_m", "_w_m2", "_w"))
    ]
    assert missing == []


def test_unready_until_migrated(
    settings: Settings, operations: Any, app: FastAPI, bare: TestClient
):
    app.state.runtime.database.downgrade("base")
    ready = bare.get("/readyz")
    assert ready.status_code == 503
    assert "heliotwin migrate" in ready.json()["checks"]["migrations"]


def test_service_does_not_start_on_an_unmigrated_store(settings: Settings, operations: Any):
    app = create_app(settings.model_copy(update={"migrate_on_start": False}), operations)
    with pytest.raises(SchemaError, match="heliotwin migrate"), client_of(app):
        pass


def test_ready(bare: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("service.web.root.health.default_predictor", lambda: None)
    ready = bare.get("/readyz")
    assert ready.status_code == 200
    assert ready.json() == {
        "status": "ok",
        "checks": {"database": "ok", "migrations": "ok", "weights": "ok"},
    }


def test_unready_without_weights(bare: TestClient, monkeypatch: pytest.MonkeyPatch):
    def missing() -> None:
        raise FileNotFoundError("/inside/weights.onnx")

    monkeypatch.setattr("service.web.root.health.default_predictor", missing)
    ready = bare.get("/readyz")
    assert ready.status_code == 503
    assert ready.json()["checks"]["weights"] == "unavailable"
    assert "inside" not in ready.text


def test_problem_names_its_kind_the_field_and_the_remedy(refusing: TestClient):
    broken = refusing.post(
        "/v1/forecasts", content='{"heliostat": oops}', headers={"Content-Type": "application/json"}
    )
    assert broken.json()["type"] == "urn:heliotwin:problem:invalid"
    assert broken.json()["detail"].startswith("body: is no JSON, wrong at character 14; make it")
    unknown = refusing.post("/v1/heliostats/AA39/surfaces", json={"metod": "network"}).json()
    assert unknown["errors"] == [
        {"field": "metod", "message": "is not known here; leave it out, or check its spelling"}
    ]
    missing = refusing.post("/v1/forecasts", json={"heliostat": "AA39", "target": "lower"}).json()
    assert missing["detail"] == "sun: is missing; send it"
    assert refusing.get("/v1/nothing").json()["type"] == "urn:heliotwin:problem:not-found"


def test_metadata_may_come_as_a_file_of_json(refusing: TestClient):
    """So Swagger's page sends them, and what its form begins with is taken."""
    schemas = refusing.get("/openapi.json").json()["components"]["schemas"]
    MeasurementIn.model_validate(schemas["MeasurementIn"]["examples"][0])
    sent = {
        "metadata": ("blob", b"{", "application/json"),
        "image": ("spot.png", b"x", "image/png"),
    }
    answer = refusing.post("/v1/heliostats/AA39/measurements", files=sent)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "metadata"
    sent["metadata"] = ("blob", json.dumps(metadata()).encode(), "application/json")
    answer = refusing.post("/v1/heliostats/AA39/measurements", files=sent)
    assert answer.status_code == 415  # the metadata were taken; the image is none


def test_a_wrong_word_in_a_query_or_header_is_named_plainly(refusing: TestClient):
    answer = refusing.get("/v1/jobs", params={"limit": "abc"})
    assert answer.json()["detail"] == "limit: must be a whole number"
    answer = refusing.post("/v1/jobs/predictions", json={}, headers={"Idempotency-Key": "x" * 129})
    assert answer.json()["detail"] == (
        "Idempotency-Key: must be 1 to 128 letters, digits and signs of ASCII without blanks"
    )
