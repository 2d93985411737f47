"""Files as answers: styles and scripts for everybody, once; nothing beside them."""

from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.staticfiles import StaticFiles

from service.base.settings import Settings
from service.web.app import create_app
from service.web.auth import security
from service.web.responses.files import etag_matches

PATHS = ("/static/app.css", "/static/icon.svg", "/docs/swagger-ui.css", "/docs/start.js")


@pytest.mark.parametrize("path", PATHS)
def test_what_a_browser_holds_is_not_sent_again(bare: TestClient, path: str):
    answer = bare.get(path)
    assert answer.status_code == 200
    etag = answer.headers["ETag"]
    for tags in (etag, f'"other", W/{etag}', "*"):
        again = bare.get(path, headers={"If-None-Match": tags})
        assert (again.status_code, again.content) == (304, b"")
        for name in ("ETag", "Cache-Control"):
            assert again.headers[name] == answer.headers[name]
    assert bare.get(path, headers={"If-None-Match": '"other"'}).content == answer.content


@pytest.mark.parametrize("path", PATHS)
def test_head_has_the_same_headers_without_the_file(bare: TestClient, path: str):
    head, answer = bare.head(path), bare.get(path)
    assert (head.status_code, head.content) == (200, b"")
    for name in ("Content-Type", "Content-Length", "ETag", "Cache-Control"):
        assert head.headers[name] == answer.headers[name]
    assert int(head.headers["Content-Length"]) == len(answer.content)


@pytest.mark.parametrize("value", ["bytes=0-1", "bytes=9999999-", "nonsense"])
def test_range_is_ignored(bare: TestClient, value: str):
    answer = bare.get("/static/app.css", headers={"Range": value})
    assert answer.content == bare.get("/static/app.css").content
    assert "Accept-Ranges" not in answer.headers


def test_styles_stay_for_good_and_the_documentation_an_hour(bare: TestClient):
    assert (
        bare.get("/static/app.css?v=1").headers["Cache-Control"]
        == "public, max-age=31536000, immutable"
    )
    assert bare.get("/docs/start.js").headers["Cache-Control"] == "max-age=3600"


@pytest.mark.parametrize(
    "path",
    [
        "/static/",
        "/static/LICENSES.md",
        "/static/..%2fcharts.py",
        "/static/%2e%2e/charts.py",
        "/static/..%5ccharts.py",
        "/static/%2fetc/passwd",
        "/static/app.css%00",
        "/static/" + "a" * 5000,
        "/docs/",
        "/docs/other.js",
        "/docs/redoc.standalone.js",
        "/docs/..%2fdocumentation.py",
        "/docs/%2e%2e/documentation.py",
    ],
)
def test_nothing_else_is_served(bare: TestClient, path: str):
    answer = bare.get(path)
    assert answer.status_code == 404, answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert answer.json()["request_id"]


def test_files_cannot_be_written(bare: TestClient):
    answer = bare.post("/static/app.css", content=b"x")
    assert answer.status_code == 405
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert "GET" in answer.headers["Allow"]


def test_mounted_application_needs_to_be_public_on_purpose(tmp_path: Any):
    app: FastAPI = create_app(Settings())
    assert security.declared_roles(app)["*", "/static"] is None
    app.mount("/files", StaticFiles(directory=tmp_path))
    with pytest.raises(LookupError, match="/files"):
        security.require_declared_roles(app)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, False),
        ("", False),
        ("*", True),
        ('"a"', True),
        ('W/"a"', True),
        ('"b", "a"', True),
        ('"b"', False),
        ("a", False),
    ],
)
def test_if_none_match(given: str | None, expected: bool):
    assert etag_matches('"a"', given) is expected
