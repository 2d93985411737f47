"""Text that callers send: no NUL, no other control characters, no lone surrogates, wherever it may
be sent.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from pydantic import TypeAdapter
from sqlalchemy import URL

from model.errors import InvalidInputError
from service.base.settings import Settings
from service.base.validation import require_text
from service.sources.documents import read_json
from service.twin import history
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    Post,
    client_of,
    metadata,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.web.documents import operations, sample

JSON = {"Content-Type": "application/json"}
NOT_TEXT = ["a\x00b", "a\x1bb", "a\x7f", "\x85", "\ud800"]
DAY = {"first_at": "2026-06-21T06:00:00Z", "last_at": "2026-06-21T18:00:00Z"}
PLAN = {"name": "summer", "target": "lower", **DAY}


def with_each_string(document: Any, text: str) -> Iterator[Any]:
    """The document with ``text`` in place of one of its strings, one after the other."""
    if isinstance(document, str):
        yield text
    parts = (
        document.items()
        if isinstance(document, dict)
        else enumerate(document)
        if isinstance(document, list)
        else ()
    )
    for key, part in parts:
        for changed in with_each_string(part, text):
            whole = document.copy()
            whole[key] = changed
            yield whole


# --- every field
# --------------------------------------------------------------------------------------------------


def test_every_string_of_a_body_refuses_nul(refusing: TestClient):
    defs = refusing.get("/openapi.json").json()["components"]["schemas"]
    tried = 0
    for path, method, operation in operations(refusing):
        schema = (
            operation.get("requestBody", {})
            .get("content", {})
            .get("application/json", {})
            .get("schema", {})
        )
        for one in schema.get("oneOf", schema.get("anyOf", [schema] if schema else [])):
            url = path.format(name="AA39", measurement="1", number="1", version="1")
            for body in with_each_string(sample(one, defs), "a\x00b"):
                answer = refusing.request(method, url, content=json.dumps(body), headers=JSON)
                assert answer.status_code == 422, (method, url, body, answer.text)
                tried += 1
    assert tried > 30


def test_every_parameter_refuses_nul(refusing: TestClient):
    tried = set()
    for path, method, operation in operations(refusing):
        known = {"name": "AA39", "measurement": "1", "number": "1", "version": "1"}
        for parameter in operation.get("parameters", ()):
            if parameter["in"] == "header":
                continue  # no header can hold NUL: the server refuses the request's head
            name = parameter["name"]
            is_path = parameter["in"] == "path"
            url = path.format(**known | ({name: "a%00b"} if is_path else {}))
            query = {} if is_path else {name: "a\x00b"}
            is_form = "multipart/form-data" in operation.get("requestBody", {}).get("content", {})
            sent = (
                {"files": {"image": ("a.png", b"")}}
                if is_form
                else {"content": b"{}", "headers": JSON}
            )
            answer = refusing.request(method, url, params=query, **sent)
            assert answer.status_code == 422, (method, url, name, answer.text)
            tried.add(name)
    assert {"name", "search", "prefix", "after", "kind"} <= tried


def strings_of(schema: Any) -> Iterator[dict[str, Any]]:
    if isinstance(schema, dict):
        if schema.get("type") == "string":
            yield schema
        for part in schema.values():
            yield from strings_of(part)
    elif isinstance(schema, list):
        for part in schema:
            yield from strings_of(part)


def test_every_string_of_a_route_or_page_has_a_form(app: FastAPI):
    """Pages' forms are in no document: the types of all that routes take have a pattern, or a list
    of values.
    """
    checked = 0
    for context in iter_route_contexts(app.routes):
        dependant = getattr(context, "dependant", None)
        pending = [] if dependant is None else [dependant]
        while pending:
            found = pending.pop()
            pending.extend(found.dependencies)
            for field in (*found.path_params, *found.query_params, *found.body_params):
                kind = TypeAdapter(field.field_info.rebuild_annotation())
                for schema in strings_of(kind.json_schema(mode="validation")):
                    checked += 1
                    is_bound = {"pattern", "enum", "const", "format", "contentMediaType"} & set(
                        schema
                    )
                    assert is_bound, (context.path, field.name, schema)
    assert checked > 50


@pytest.mark.parametrize("text", NOT_TEXT)
def test_documents_that_are_kept_as_they_come_are_of_text(refusing: TestClient, text: str):
    for path, body in (
        ("heliostats/AA39", {**properties_document(), "renovation": text}),
        ("heliostats/AA39", {**properties_document(), "more": [{text: 1}]}),
        ("plant", {**tower_document(), "declared": {"effects": [{"name": text}]}}),
    ):
        answer = refusing.put(f"/v1/{path}", content=json.dumps(body), headers=JSON)
        assert answer.status_code == 422, answer.text
        assert "control characters" in answer.json()["detail"]


def test_metadata_of_a_photograph_is_of_text(refusing: TestClient):
    for changed in with_each_string(metadata(id="1", taken_at="2026-06-21T11:36:00Z"), "a\x00b"):
        form = {"metadata": json.dumps(changed)}
        answer = refusing.post(
            "/v1/heliostats/AA39/measurements",
            files={"image": ("a.png", png(), "image/png")},
            data=form,
        )
        assert answer.status_code == 422, changed


# --- both databases
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def stored(store_url: URL, tmp_path: Path) -> Iterator[TestClient]:
    """A service on each of the two databases, with a photograph and its surface."""
    url = store_url.set(drivername=store_url.get_backend_name()).render_as_string(
        hide_password=False
    )
    settings = Settings(
        data_dir=tmp_path / "data", database_url=url, max_image_pixels=500_000, **QUIET
    )
    with client_of(create_app(settings, FakeOperations())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        assert poster(client)(id="1").status_code == 201
        assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
        yield client


def requests_with(text: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Requests with ``text`` in each place that is stored or searched for: method, path, options of
    the client.
    """
    heliostat = "/v1/heliostats/AA39"
    for method, path, body in (
        ("POST", "/v1/jobs/plans", {**PLAN, "name": text}),
        ("PATCH", f"{heliostat}/measurements/1", {"excluded": True, "reason": text}),
        ("PUT", f"{heliostat}/surfaces/current", {"version": 1, "reason": text}),
        ("POST", "/v1/jobs/measurements", {"reason": text}),
        ("POST", "/v1/jobs/studies", {"candidates": [text]}),
        ("PUT", heliostat, {**properties_document(), "renovation": text}),
    ):
        yield method, path, {"content": json.dumps(body), "headers": JSON}
    if not text.isascii():
        return  # no query or form decodes to half a character
    for path in ("/v1/heliostats", "/v1/field", "/field.csv"):
        yield "GET", path, {"params": {"search": text}}
    for path, form in (
        (
            "/plans",
            {**PLAN, "first_at": "2026-06-21T06:00", "last_at": "2026-06-21T18:00", "name": text},
        ),
        ("/heliostats/AA39/surfaces/1/take", {"reason": text}),
        ("/heliostats/AA39/photographs/1", {"reason": text, "excluded": "true"}),
        ("/login", {"key": text}),
        ("/session", {"key": text}),
    ):
        yield "POST", path, {"data": form}


def test_text_that_a_database_does_not_take_is_refused(stored: TestClient):
    """One of them in a plan's name made the list of plans answer 500, for everybody, on
    PostgreSQL.
    """
    for text in NOT_TEXT:
        for method, path, options in requests_with(text):
            answer = stored.request(method, path, **options)
            assert answer.status_code == 422, (path, text, answer.text)
    for path in ("/", "/plans", "/jobs", "/heliostats/AA39", "/v1/jobs", "/v1/audit"):
        assert stored.get(path).status_code == 200, path
    for name in ("Sommer, 21. Juni: 40 °C", "夏至", "צל", "plan 😀"):
        assert stored.post("/v1/jobs/plans", json={**PLAN, "name": name}).status_code == 202, name
        assert name in stored.get("/plans").text


def test_reason_fits_its_column(client: TestClient):
    """The job took 500 characters for a column of 200, and failed on PostgreSQL."""
    assert client.post("/v1/jobs/measurements", json={"reason": "x" * 200}).status_code == 202
    assert client.post("/v1/jobs/measurements", json={"reason": "x" * 201}).status_code == 422


# --- files
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", NOT_TEXT)
def test_files_of_an_import_are_of_text(tmp_path: Path, text: str):
    file = tmp_path / "AA39-heliostat-properties.json"
    file.write_text(json.dumps({"facet_properties": {"facets": [{"name": text}]}}))
    with pytest.raises(
        InvalidInputError, match=r"facets\[0\]\.name: must be text without control characters"
    ):
        read_json(file)


@pytest.mark.parametrize("text", NOT_TEXT)
def test_history_of_an_export_is_of_text(tmp_path: Path, post: Post, client: TestClient, text: str):
    """As an export writes it, but for a reason."""
    post(id="1")
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        exported = history.plant_history(session)
    document = {**exported.model_dump(mode="json"), "declared": {"effects": [text]}}
    file = tmp_path / history.PLANT
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps(document))
    with pytest.raises(InvalidInputError, match=r"plant\.json"):
        history._load(file, history._Models)


@pytest.mark.parametrize(
    ("document", "place"),
    [
        ({"a": [{"b": 1}, {"c": "\x00"}]}, r"document\.a\[1\]\.c"),
        ([[], {}, [1, [2, float("inf")]]], r"document\[2\]\[1\]\[1\]"),
        ({"a": {"\x00": 1}}, r"document\.a"),
        ("\ud800", "document"),
    ],
)
def test_place_of_what_is_no_text_is_named(document: Any, place: str):
    with pytest.raises(InvalidInputError, match=f"^{place}: must be"):
        require_text(document, "document")


def test_text_may_have_several_lines():
    require_text({"a": ["line\nline\r\n\tline"]}, "document")
