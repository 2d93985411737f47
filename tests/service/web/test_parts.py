"""Parts of pages as files: tables as CSV, figures as CSV, arrays and pictures, by the links beside
them.
"""

import csv
import io
import re
from collections import Counter
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.drawing.templates import figure, percent, prefixed
from service.web.responses.lists import PageTable
from tests.page import Page
from tests.service.conftest import Post, png
from tests.service.web.pages import HTML, PATHS, text_of
from tests.service.web.plans import planned


def parts_of(page: Page) -> list[str]:
    return [link for link in page.links if re.search("[?&](table|figure)=", link)]


def table_of(*rows: dict[str, Any], page_only: str = "") -> list[list[str]]:
    """Lines of the CSV of a table with these cells by heading."""
    table = PageTable()
    for row in rows:
        table.rows.append({})
        for heading, value in row.items():
            table.add(heading, value, "", None, heading == page_only)
    return list(csv.reader(io.StringIO(table.csv(), newline="")))


def test_numbers_have_all_digits_and_units_are_in_headings():
    columns, *rows = table_of(
        {"Name": "a", "Power": prefixed(1234.5678, "W"), "Width [m]": figure(1 / 3), "Stop": ""},
        {"Name": "–", "Power": figure(None, unit="W"), "Width [m]": figure(-2.0), "Stop": ""},
        page_only="Stop",
    )
    assert columns == ["Name", "Power [W]", "Width [m]"]
    assert rows == [["a", "1234.5678", repr(1 / 3)], ["", "", "-2.0"]]


@pytest.mark.parametrize(
    ("value", "shown"),
    [(3.54983e8, "355 MW"), (1_496_490, "1.50 MW"), (999_600, "1.00 MW"), (-4210, "−4.21 kW"),
     (999.4, "999 W"), (0, "0 W"), (None, "–")],
)  # fmt: skip
def test_powers_have_three_figures(value: float | None, shown: str):
    assert prefixed(value, "W").replace("\N{NO-BREAK SPACE}", " ") == shown


def test_rows_of_several_units_have_the_unit_in_the_first_cell():
    assert table_of(
        {"Figure": "Made", "First": ["refined, ", datetime(2026, 6, 21, tzinfo=UTC)]},
        {"Figure": "Deviation", "First": figure(0.25, 3, "mm")},
        {"Figure": "Accuracy", "First": percent(0.9)},
    ) == [
        ["Figure", "First"],
        ["Made", "refined, 2026-06-21T00:00:00Z"],
        ["Deviation [mm]", "0.25"],
        ["Accuracy [%]", "90.0"],
    ]


def test_numbers_in_texts_have_their_units():
    assert table_of({"What": [figure(2.5, 1, "m"), " off,\n seen"]}, {"What": figure(0.5)}) == [
        ["What"],
        ["2.5 m off, seen"],
        ["0.5"],
    ]


@pytest.mark.full
def test_every_table_and_figure_is_a_file(shown: TestClient):
    found = set()
    for path in PATHS:
        page = Page(shown.get(path).text)
        tables = [table["id"] for table in page.all("table", id=True)]
        links = parts_of(page)
        assert [link for link in links if "table=" in link] == [
            link for name in tables for link in links if link.endswith(f"table={name}")
        ]
        figures = len(page.all("svg", class_="figure"))
        assert len({link.partition("&format")[0] for link in links if "figure=" in link}) >= figures
        for link in links:
            answer = shown.get(link)
            assert answer.status_code == 200, (link, answer.text)
            check(answer)
            found.add(re.sub(r"\d+", "N", link.partition("?")[2]))
    assert len(found) > 20, found


def check(answer: Any) -> None:
    """A file of its kind."""
    shown, _, _ = answer.headers["Content-Disposition"].partition("; filename=")
    assert (shown == "inline") == (answer.headers["Content-Type"] == "image/png")
    match answer.headers["Content-Type"]:
        case "text/csv; charset=utf-8":
            head, *rows = csv.reader(io.StringIO(answer.text, newline=""))
            assert len(set(head)) == len(head)
            assert all(len(row) == len(head) for row in rows)
            assert not re.search(r"(^|,)\"?[=+@]", answer.text, re.MULTILINE)
        case "application/x-npz":
            assert np.load(io.BytesIO(answer.content)).files
        case kind:
            assert kind == "image/png"
            assert answer.content.startswith(b"\x89PNG")


def sheet(client: TestClient, path: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(client.get(path).text, newline="")))


def test_tables_say_what_pages_say(shown: TestClient):
    jobs = sheet(shown, "/jobs?table=list")
    assert [(row["Job"], row["What"], row["State"], row["Progress [%]"]) for row in jobs] == [
        ("1", "imports", "queued", "0.0")
    ]
    assert "Stop" not in jobs[0]
    compared = {row["Figure"]: row for row in sheet(shown, "/compare?heliostat=AA39&table=figures")}
    deviation = compared["Deviation from ideal [mm]"]
    values = [float(deviation[f"AA39, version {version}"]) for version in (1, 2)]
    assert float(deviation["Difference"]) == pytest.approx(values[1] - values[0])
    (forecast,) = sheet(shown, "/forecast?table=recent")
    assert (float(forecast["Sun azimuth [°]"]), float(forecast["Sun elevation [°]"])) == (
        200.0,
        45.0,
    )
    assert sheet(shown, "/plant?table=targets")[0]["Target"] == "lower"
    assert sheet(shown, "/studies/1?table=images") == [
        {"Photograph": "AA39/1", "Accuracy before [%]": "90.0", "Accuracy after [%]": "90.0"}
    ]


def test_alarms_as_a_table(client: TestClient, post: Post):
    post(png(1), id="1", taken_at="2024-06-03T11:30:00Z")
    assert 'href="/alarms.csv"' in client.get("/alarms", headers=HTML).text
    rows = sheet(client, "/alarms.csv")
    assert [(row["reason"], row["heliostat"], row["acknowledged_by"]) for row in rows] == [
        ("sun_contradicts_time", "AA39", ""),
        ("no_photograph", "AA39", ""),
    ]


def test_figures_hold_what_they_show(shown: TestClient):
    arrays = np.load(io.BytesIO(shown.get("/heliostats/AA39?figure=deviation&format=npz").content))
    assert (arrays["unit"], arrays["size_m"].shape) == ("mm", (2,))
    z = np.load(io.BytesIO(shown.get("/v1/heliostats/AA39/surfaces/current?format=npz").content))[
        "z"
    ]
    assert np.nanmax(np.abs(arrays["values"])) == pytest.approx(1e3 * np.abs(z).max(), rel=0.3)
    rows = sheet(shown, "/heliostats/AA39?figure=history-1&format=csv")
    assert [row["name"] for row in rows] == ["version 1", "version 2"]
    field = np.load(io.BytesIO(shown.get("/?metric=deviation_mm&figure=field&format=npz").content))
    assert (field["names"].tolist(), field["places_m"].shape, field["unit"]) == (
        ["AA39"],
        (1, 2),
        "mm",
    )
    assert field["values"][0] == pytest.approx(1e3 * np.sqrt(np.mean(z**2)), rel=0.3)


def test_formulas_of_senders_do_no_harm(client: TestClient, post: Post):
    post(png(1), id="1")
    client.patch("/v1/heliostats/AA39/measurements/1", json={"excluded": True, "reason": "=1+1"})
    client.headers.update(HTML)
    (row,) = sheet(client, "/heliostats/AA39/photographs/1?table=corrections")
    assert row["Reason"] == "'=1+1"


@pytest.mark.parametrize(
    "part",
    ["table=none", "figure=none&format=npz", "figure=deviation&format=xls", "figure=deviation"],
)
def test_what_a_page_does_not_have_is_not_found(shown: TestClient, part: str):
    assert shown.get(f"/heliostats/AA39?{part}").status_code == 404


def test_parts_need_what_their_page_needs(shown: TestClient):
    assert text_of(shown, "/heliostats/none?table=outliers", 404)
    assert shown.get("/v1/heliostats?table=x").status_code == 422  # which only pages take


@pytest.mark.full
def test_plan_as_tables_maps_and_timelines(app: FastAPI, two_heliostats: TestClient):
    job = planned(app, two_heliostats)
    rows = sheet(two_heliostats, f"/plans/{job['id']}?table=series")
    steps = two_heliostats.get(f"/v1/jobs/{job['id']}").json()["result"]["steps"]
    assert [float(row["Power of ideal mirrors [W]"]) for row in rows] == [
        step["ideal"]["power_w"] for step in steps
    ]
    assert [float(row["Sun elevation [°]"]) for row in rows] == [
        step["sun"]["elevation_deg"] for step in steps
    ]
    links = parts_of(text_of(two_heliostats, f"/plans/{job['id']}"))
    formats = Counter(link.rpartition("=")[2] for link in links)
    assert formats == {
        "npz": 3,
        "png": 6,
        "csv": 3,
        "losses": 1,
        "series": 1,
        "plans": 1,
    }  # three maps, three timelines, three tables
    for link in links:
        check(two_heliostats.get(link))


def test_columns_of_photographs_are_chosen(shown: TestClient):
    path = "/heliostats/AA39?photographs=used&columns=Target&columns=Saturated"
    page = Page(shown.get(path, headers={"Accept": "text/html"}).text)
    table = page.one("table", id="photographs")
    assert [one.words for one in table.all("th", scope="col")] == [
        "Photograph",
        "Target",
        "Saturated",
    ]
    assert {len(row.all("td")) for row in table.all("tr")[1:]} == {2}
    ticked = [one["value"] for one in page.all("input", name="columns", checked=True)]
    assert ticked == ["Target", "Saturated"]
    assert page.one("input", type="hidden", name="photographs")["value"] == "used"
    assert "Judged" in sheet(shown, f"{path}&table=photographs")[0]  # the CSV has all
