"""Tables as CSV and figures as files, by links beside them."""

import csv
import io
import re
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from service.web.responses.lists import cell
from tests.service.conftest import Post, png
from tests.service.web.pages import HTML, fill, settled


@pytest.mark.parametrize(
    "text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", '=HYPERLINK("http://x")']
)
def test_text_is_never_a_formula(text: str):
    assert cell(text) == f"'{text}"


def test_numbers_stay_numbers():
    moment = datetime(2026, 6, 21, tzinfo=UTC)
    values: list[Any] = [-1.5, 0, None, True, "a=b", moment, ["101", "102"]]
    cells = [-1.5, 0, "", "yes", "a=b", "2026-06-21T00:00:00Z", "101 102"]
    assert [cell(value) for value in values] == cells


def sheet(client: TestClient, path: str) -> list[dict[str, str]]:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    assert answer.headers["Content-Type"] == "text/csv; charset=utf-8"
    assert answer.headers["Content-Disposition"].startswith("attachment; filename=")
    return list(csv.DictReader(io.StringIO(answer.text, newline="")))


@pytest.fixture
def pages(client: TestClient) -> TestClient:
    fill(client)
    return client


def test_field_as_a_table(pages: TestClient):
    page = settled(pages)
    (link,) = [link for link in page.links if link.startswith("/field.csv")]
    (row,) = sheet(pages, link)
    assert (row["name"], row["accuracy"], row["photographs"], row["refused"]) == (
        "AA39",
        "1.0",
        "3",
        "1",
    )
    assert float(row["deviation_mm"]) > 0
    assert sheet(pages, "/field.csv?search=nobody") == []
    narrow = settled(pages, "/?show=surface&metric=age_days")
    assert 'href="/field.csv?show=surface&amp;metric=age_days"' in narrow


def test_photographs_as_a_table(pages: TestClient, post: Post):
    post(png(9), id="104", motor_position=[1.0, 2.5])
    rows = sheet(pages, "/heliostats/AA39/photographs.csv")
    assert [row["photograph"] for row in rows] == ["101", "102", "103", "104"]
    assert (rows[1]["sun_azimuth_deg"], rows[2]["reason"], rows[3]["motor_axis_2"]) == (
        "210.0",
        "no_spot",
        "2.5",
    )
    assert pages.get("/heliostats/none/photographs.csv").status_code == 404


def test_surfaces_as_a_table(pages: TestClient):
    rows = sheet(pages, "/heliostats/AA39/surfaces.csv")
    assert [(row["version"], row["source"], row["is_active"]) for row in rows] == [
        ("1", "network", "no"),
        ("2", "refined", "yes"),
    ]
    assert rows[0]["photographs"] == "101"


def test_sender_who_writes_a_formula_does_no_harm(client: TestClient, post: Post):
    post(png(1), id="1")
    client.patch("/v1/heliostats/AA39/measurements/1", json={"excluded": True, "reason": "=1+1"})
    client.headers.update(HTML)
    assert not re.search(
        r"(^|,)\"?[=+@]", client.get("/heliostats/AA39/photographs.csv").text, re.MULTILINE
    )


@pytest.mark.parametrize(
    "path",
    [
        "/v1/heliostats/AA39/surfaces/2",
        "/v1/heliostats/AA39/measurements/102/flux",
        "/v1/forecasts/1",
    ],
)
def test_figure_has_its_files(pages: TestClient, path: str):
    for suffix, kind in (("npz", "application/x-npz"), ("png", "image/png")):
        answer = pages.get(f"{path}?format={suffix}")
        assert answer.headers["Content-Type"] == kind
        assert f'.{suffix}"' in answer.headers["Content-Disposition"]
    assert np.load(io.BytesIO(pages.get(f"{path}?format=npz").content)).files
    assert pages.get(f"{path}?format=json").headers["Content-Type"] == "application/json"
    assert pages.get(f"{path}?format=xls").status_code == 422
