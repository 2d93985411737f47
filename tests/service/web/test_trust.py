"""Surfaces that do not trust themselves: pages, metrics and REST say so, with why, since when and
who has seen it.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    client_of,
    png,
    poster,
    properties_document,
    sun_at,
    tower_document,
)
from tests.service.web.operations import Doubter

BASE = "/v1/heliostats/AA39/surfaces"
HTML = {"Accept": "text/html"}


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), Doubter())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        post = poster(client)
        post(png(1), id="1", sun=sun_at(180.0, 45.0))
        post(png(2), id="2", sun=sun_at(90.0, 45.0))
        yield client


def predict(client: TestClient, method: str, *measurements: str) -> Any:
    return client.post(BASE, json={"method": method, "measurements": measurements}).json()


def acknowledge(client: TestClient) -> Any:
    return client.post(f"{BASE}/1/acknowledge", json={"reason": "snow"})


def test_trusted_surface_says_so(client: TestClient):
    body = predict(client, "network", "1")
    assert (body["trusted"], body["warnings"], body["suspicious"], body["warned_since"]) == (
        True,
        [],
        [],
        None,
    )
    assert (body["mahalanobis_distance"], body["sun_span_deg"]) == (1.0, pytest.approx(0, abs=1e-4))
    assert 'heliotwin_surfaces{trusted="yes"} 1.0' in client.get("/metrics").text
    assert acknowledge(client).status_code == 409


def test_warnings_are_shown_with_reasons_and_time(client: TestClient):
    body = predict(client, "refined", "1", "2")
    assert (body["trusted"], body["suspicious"], body["warned_since"]) == (
        False,
        ["2"],
        body["created_at"],
    )
    assert body["warnings"][0] == "photograph 2 is not explained: 31% of it is missed"
    assert body["warnings"][1].startswith("the mirror is unlike those known: 2.40 ")
    assert body["sun_span_deg"] == pytest.approx(60)
    (line,) = client.get("/v1/field", params={"metric": "sun_span_deg", "low": 50}).json()["items"]
    assert (line["trusted"], line["sun_span_deg"]) == (False, pytest.approx(60))
    assert (
        client.get("/v1/field", params={"metric": "sun_span_deg", "low": 61}).json()["items"] == []
    )
    header, row = client.get("/field.csv").text.splitlines()
    assert float(row.split(",")[header.split(",").index("sun_span_deg")]) == pytest.approx(60)
    metrics = client.get("/metrics").text
    assert 'heliotwin_surfaces{trusted="no"} 1.0' in metrics
    (span,) = re.findall(r'heliotwin_heliostat_sun_span_degrees{heliostat="AA39"} (.*)', metrics)
    assert float(span) == pytest.approx(60)
    assert (
        'heliotwin_heliostat_warned_since_seconds{acknowledged="no",heliostat="AA39"} 1.' in metrics
    )
    field, page = (
        client.get("/?metric=sun_span_deg", headers=HTML).text,
        client.get("/heliostats/AA39", headers=HTML).text,
    )
    assert 'class="flagged"' in field
    assert "Span of suns [°]" in field
    assert re.search(r"no, \d</span>", field)  # and not acknowledged
    for html_page in (field, page):
        assert "hotograph 2 is not explained: 31% of it is missed" in html_page
    assert "Acknowledge</button>" in page
    # Both lead to where the photograph is corrected or excluded.
    (item,) = client.get("/v1/alarms?reason=untrusted").json()["items"]
    assert (item["measurements"], item["action"][:20]) == (["2"], "look at photograph 2")
    for html_page in (page, client.get("/alarms", headers=HTML).text):
        assert '<a href="/heliostats/AA39/photographs/2">2</a>' in html_page
    assert (
        "Excluded: nothing is made from it"
        in client.get("/heliostats/AA39/photographs/2", headers=HTML).text
    )


def test_acknowledgement_holds_while_the_warnings_are_the_same(client: TestClient):
    first = predict(client, "network", "1", "2")
    path = "/heliostats/AA39/surfaces/1/acknowledge"
    assert client.post(path, headers=HTML, follow_redirects=False).status_code == 422
    for is_first in (True, False):  # it is undone once
        page = client.post(path, data={"reason": "dew on it"}, headers=HTML).text
        assert re.search(r"Acknowledged by local, .*: dew on it\.", page)
        (undo,) = re.findall(r'action="(/alarms/acknowledgements/.*?)"', page)
        (item,) = client.get("/v1/alarms?reason=untrusted").json()["items"]
        assert item["acknowledged_reason"] == "dew on it"
        if is_first:
            page = client.post(undo.replace("&amp;", "&"), headers=HTML).text
            assert "<h1>Heliostat AA39</h1>" in page
            assert client.get(f"{BASE}/1").json()["acknowledged_by"] is None
    kept = client.get(f"{BASE}/1").json()
    assert kept["acknowledged_by"] == "local"
    assert (
        acknowledge(client).json()["acknowledged_at"] == kept["acknowledged_at"]
    )  # the first who did
    again = predict(client, "refined", "1", "2")
    assert (again["warned_since"], again["acknowledged_by"]) == (first["warned_since"], "local")
    other = predict(client, "refined", "2")
    assert (other["suspicious"], other["warnings"][0][:12]) == (["2"], "photograph 2")
    assert predict(client, "network", "1")["warned_since"] is None
    assert (
        predict(client, "network", "2")["acknowledged_by"] is None
    )  # trusted in between: it is a new warning


def test_undo_of_an_acknowledgement_leaves_that_of_another_version(client: TestClient):
    assert predict(client, "network", "1", "2")["version"] == 1
    assert acknowledge(client).status_code == 200
    (item,) = client.get("/v1/alarms?reason=untrusted").json()["items"]
    assert predict(client, "network", "1")["trusted"]
    assert predict(client, "network", "2")["version"] == 3  # other warnings, from later on
    choice = {"version": 3, "reason": "to look at it"}
    assert client.put(f"{BASE}/current", json=choice).status_code == 200
    answer = client.post(f"{BASE}/3/acknowledge", json={"reason": "dew"})
    assert answer.status_code == 200, answer.text
    undo = f"/v1/alarms/acknowledgements/{item['acknowledgement']}/undo"
    assert client.post(undo).status_code == 200
    seen = [client.get(f"{BASE}/{version}").json()["acknowledged_by"] for version in (1, 3)]
    assert seen == [None, "local"]
    (item,) = client.get("/v1/alarms?reason=untrusted").json()["items"]
    assert item["acknowledged_reason"] == "dew"
