"""Surfaces that do not trust themselves: pages, metrics and REST say so, with why, since when and who has seen it."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from model.observation import Observation
from model.plant import Heliostat
from service.base.settings import Settings
from service.web.app import create_app
from tests.service.conftest import QUIET, FakeOperations, client_of, png, poster, properties_document, tower_document

BASE = "/v1/heliostats/AA39/surfaces"
HTML = {"Accept": "text/html"}


class Doubter(FakeOperations):
    """Explains no photograph under a sun in the east, and finds refined mirrors strange."""

    def predict(self, heliostat: Heliostat, observations: list[Observation], *rest: Any, **more: Any) -> Any:
        made = super().predict(heliostat, observations, *rest, **more)
        misfits = tuple(0.31 if observation.sun[0] > 0.5 else 0.05 for observation in observations)
        return replace(made, misfits=misfits, mahalanobis=2.4 if made.method == "refined" else 1.0)


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), Doubter())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        post = poster(client)
        post(png(1), id="1", sun_azimuth=0.0, sun_elevation=45.0)
        post(png(2), id="2", sun_azimuth=90.0, sun_elevation=45.0)
        yield client


def predict(client: TestClient, method: str, *measurements: str) -> Any:
    return client.post(BASE, json={"method": method, "measurements": measurements}).json()


def test_trusted_surface_says_so(client: TestClient):
    body = predict(client, "network", "1")
    assert (body["trusted"], body["doubts"], body["suspicious"], body["doubted_since"]) == (True, [], [], None)
    assert (body["strangeness"], body["sun_span_deg"]) == (1.0, pytest.approx(0, abs=1e-4))
    assert 'heliotwin_surfaces{trusted="yes"} 1.0' in client.get("/metrics").text
    assert client.post(f"{BASE}/1/seen").status_code == 409


def test_doubts_are_told_with_why_and_since_when(client: TestClient):
    body = predict(client, "refined", "1", "2")
    assert (body["trusted"], body["suspicious"], body["doubted_since"]) == (False, ["2"], body["created_at"])
    assert body["doubts"][0] == "photograph 2 is not explained: 31% of it is missed"
    assert body["doubts"][1].startswith("the mirror is unlike those known: 2.4 ")
    assert body["sun_span_deg"] == pytest.approx(60)
    (line,) = client.get("/v1/field", params={"metric": "sun_span", "low": 50}).json()["items"]
    assert (line["trusted"], line["sun_span"]) == (False, pytest.approx(60))
    assert client.get("/v1/field", params={"metric": "sun_span", "low": 61}).json()["items"] == []
    header, row = client.get("/field.csv").text.splitlines()
    assert float(row.split(",")[header.split(",").index("sun_span [°]")]) == pytest.approx(60)
    metrics = client.get("/metrics").text
    assert 'heliotwin_surfaces{trusted="no"} 1.0' in metrics
    (span,) = re.findall(r'heliotwin_heliostat_sun_span_degrees{heliostat="AA39"} (.*)', metrics)
    assert float(span) == pytest.approx(60)
    assert 'heliotwin_heliostat_doubted_since_seconds{heliostat="AA39",seen="no"} 1.' in metrics
    field, page = client.get("/", headers=HTML).text, client.get("/heliostats/AA39", headers=HTML).text
    assert 'class="doubted"' in field
    assert "Span of suns [°]" in field
    assert "Seen by nobody yet" in field
    for told in (field, page):
        assert "hotograph 2 is not explained: 31% of it is missed" in told
    assert "I have seen it" in page
    # Both lead to where the photograph is corrected or excluded.
    (item,) = client.get("/v1/attention").json()["items"]
    assert (item["photographs"], item["todo"][:20]) == (["2"], "look at photograph 2")
    for told in (page, client.get("/attention", headers=HTML).text):
        assert '<a href="/heliostats/AA39/photographs/2">2</a>' in told
    assert "Excluded: nothing is made from it" in client.get("/heliostats/AA39/photographs/2", headers=HTML).text


def test_who_has_seen_it_is_kept_while_the_doubts_are_the_same(client: TestClient):
    first = predict(client, "network", "1", "2")
    seen = client.post("/heliostats/AA39/surfaces/1/seen", headers=HTML, follow_redirects=False)
    assert seen.status_code == 303
    kept = client.get(f"{BASE}/1").json()
    assert kept["seen_by"] == "local"
    assert client.post(f"{BASE}/1/seen").json()["seen_at"] == kept["seen_at"]  # the first who did
    again = predict(client, "refined", "1", "2")
    assert (again["doubted_since"], again["seen_by"]) == (first["doubted_since"], "local")
    other = predict(client, "refined", "2")
    assert (other["suspicious"], other["doubts"][0][:12]) == (["2"], "photograph 2")
    assert predict(client, "network", "1")["doubted_since"] is None
    assert predict(client, "network", "2")["seen_by"] is None  # trusted in between: it is a new doubt
