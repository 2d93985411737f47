"""The guide at ``/docs/guide``: served if it was built, for those who may read."""

from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.twin.alarms.reasons import REASONS
from service.web.responses import pages
from service.web.root import documentation
from tests.service.access import bearer, make_key

PAGE = "<html><body><h1>heliotwin</h1></body></html>"


@pytest.fixture
def guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a guide with one page."""
    folder = tmp_path / "guide"
    (folder / "how-to").mkdir(parents=True)
    (folder / "index.html").write_text(PAGE, encoding="utf-8")
    (folder / "how-to" / "page.html").write_text(PAGE, encoding="utf-8")
    (folder / "theme.css").write_text("p {}", encoding="utf-8")
    (tmp_path / "secret.txt").write_text("not for readers", encoding="utf-8")
    for module in (pages, documentation):
        monkeypatch.setattr(module, "GUIDE", folder)
    return folder


def test_pages_and_styles_are_served(client: TestClient, guide: Path):
    assert client.get("/docs/guide").text == PAGE  # after a redirect, for links are relative
    answer = client.get("/docs/guide/how-to/page.html")
    assert answer.headers["content-type"].startswith("text/html")
    assert "script-src" not in answer.headers["content-security-policy"]
    assert client.get("/docs/guide/theme.css").headers["content-type"].startswith("text/css")
    assert client.head("/docs/guide/index.html").status_code == 200


@pytest.mark.parametrize(
    "path", ["nothing.html", "how-to", "..%2fsecret.txt", "%2fetc%2fpasswd", "%00", "x" * 999]
)
def test_nothing_else_is_served(client: TestClient, guide: Path, path: str):
    answer = client.get(f"/docs/guide/{path}")
    assert answer.status_code in (404, 422)
    assert "not for readers" not in answer.text


def test_without_a_guide_it_says_so(
    client: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pages, "GUIDE", tmp_path / "none")
    answer = client.get("/docs/guide")
    assert answer.status_code == 404
    assert answer.json()["detail"] == "this installation has no guide; `make docs` builds it"
    assert "/docs/guide" not in client.get("/").text


def test_pages_link_to_it(client: TestClient, guide: Path):
    assert '<a href="/docs/guide">Guide</a>' in client.get("/").text


def test_it_needs_a_key_as_pages_do(app: FastAPI, client: TestClient, guide: Path):
    key = make_key(app, "reader", "read")
    assert client.get("/docs").status_code == 200
    assert client.get("/docs/guide/index.html").status_code == 401
    browser = client.get(
        "/docs/guide/index.html", headers={"Accept": "text/html"}, follow_redirects=False
    )
    assert browser.headers["location"].startswith("/login")
    assert client.get("/docs/guide/index.html", headers=bearer(key)).text == PAGE


def test_reasons_have_names_that_anchors_allow():
    assert all(reason.replace("_", "").isalpha() for reason in REASONS)
