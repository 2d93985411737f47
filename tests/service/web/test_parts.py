"""Parts of pages as files: tables as CSV, figures as CSV, arrays and pictures, by the links beside them."""

import csv
import html
import io
import re
from collections import Counter
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.faults import NotFoundError
from service.web.answers.pages import TEMPLATES
from service.web.answers.sheets import FILTERS, table_of
from tests.service.conftest import Post, png
from tests.service.web.test_pages import HTML, PATHS, shown, text_of
from tests.service.web.test_plans import pages, planned

__all__ = ["pages", "shown"]

_PART = re.compile(r'href="([^"]*[?&](?:amp;)?(?:table|figure)=[^"]*)"')


def parts_of(page: str) -> list[str]:
    return [html.unescape(link) for link in _PART.findall(page)]


def written(template: str, **context: Any) -> str:
    """A template as a table is read from it."""
    made = TEMPLATES.overlay()
    made.filters = {**made.filters, **FILTERS}
    return made.from_string(template).render(context)


TABLE = (
    '<table id="a"><thead><tr><th>Name</th><th abbr="Power of ideal">of ideal</th><th>Sun</th><th>Width [m]</th>'
    '<th><span class="hidden">Stop</span></th></tr></thead>'
    "<tr><th>{{ name }}</th><td>{{ watts | power }}</td><td>{{ sun | figure(1) }}°</td><td>{{ width | figure(2) }}</td>"
    "<td><form><button>Cancel</button></form></td></tr>"
    '<tr><td colspan="4">none</td><td></td></tr></table>'
)


def test_numbers_are_whole_and_units_stand_in_the_head():
    columns, (row, other) = table_of(written(TABLE, name="a", watts=1234.5678, sun=-12.3456, width=1 / 3), "a")
    assert columns == ["Name", "Power of ideal [W]", "Sun [°]", "Width [m]"]
    assert row == ["a", 1234.5678, -12.3456, 1 / 3]
    assert other == ["none", "", "", ""]


def test_what_is_not_known_is_empty():
    _, (row, _) = table_of(written(TABLE, name="–", watts=1, sun=None, width=None), "a")
    assert row == ["", 1.0, "", ""]


def test_rows_of_several_units_bear_their_own():
    template = (
        '<table id="a"><tr><th>Figure</th><th>First</th></tr>'
        '<tr><th>Deviation</th><td>{{ 0.25 | figure(3, "mm") }}</td></tr>'
        "<tr><th>Accuracy</th><td>{{ 0.9 | percent }}</td></tr></table>"
    )
    columns, rows = table_of(written(template), "a")
    assert (columns, rows) == (["Figure", "First"], [["Deviation [mm]", 0.25], ["Accuracy [%]", 90.0]])


def test_text_around_numbers_stays_text():
    template = '<table id="a"><tr><th>What</th></tr><tr><td>{{ 2.5 | figure(1, "m") }} off,<br>seen</td></tr></table>'
    assert table_of(written(template), "a")[1] == [["2.5 m off, seen"]]


def test_text_that_imitates_a_number_stays_text():
    rows = "<tr><td>{{ text }}</td></tr><tr><td>{{ 1e-7 | figure }}</td></tr>"
    template = f'<table id="a"><tr><th>What</th></tr>{rows}</table>'
    assert table_of(written(template, text="\x011-e\x02\x03"), "a")[1] == [["\x011-e\x02\x03"], [1e-7]]


def test_other_table_is_not_found():
    with pytest.raises(NotFoundError, match="no table 'b'"):
        table_of(written(TABLE, name="a", watts=1, sun=1, width=1), "b")


def test_every_table_and_figure_is_a_file(shown: TestClient):
    found = set()
    for path in PATHS:
        page = shown.get(path).text
        tables = re.findall(r'<table id="([^"]+)"', page)
        links = parts_of(page)
        assert [link for link in links if "table=" in link] == [
            link for name in tables for link in links if link.endswith(f"table={name}")
        ]
        figures = len(re.findall(r'<svg class="figure"', page))
        assert len({link.partition("&format")[0] for link in links if "figure=" in link}) >= figures
        for link in links:
            answer = shown.get(link)
            assert answer.status_code == 200, (link, answer.text)
            check(answer)
            found.add(re.sub(r"\d+", "N", link.partition("?")[2]))
    assert len(found) > 20, found


def check(answer: Any) -> None:
    """A file of its kind."""
    assert answer.headers["Content-Disposition"].startswith("attachment; filename=")
    match answer.headers["Content-Type"]:
        case "text/csv; charset=utf-8":
            head, *rows = csv.reader(io.StringIO(answer.text, newline=""))
            assert len(set(head)) == len(head)
            assert all(len(row) == len(head) for row in rows)
            assert not re.search("[\x01-\x03]", answer.text)
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
    assert (float(forecast["Sun azimuth [°]"]), float(forecast["Sun elevation [°]"])) == (-20.0, 45.0)
    assert sheet(shown, "/plant?table=targets")[0]["Target"] == "lower"
    assert sheet(shown, "/studies/1?table=images") == [
        {"Photograph": "AA39/1", "Accuracy before [%]": "90.0", "Accuracy after [%]": "90.0"}
    ]


def test_attention_as_a_table(client: TestClient, post: Post):
    post(png(1), id="1", taken_at="2024-06-03T11:30:00Z")
    assert 'href="/attention.csv"' in client.get("/attention", headers=HTML).text
    (row,) = sheet(client, "/attention.csv")
    assert (row["reason"], row["heliostat"], row["acknowledged_by"]) == ("no_photograph", "AA39", "")


def test_figures_hold_what_they_show(shown: TestClient):
    arrays = np.load(io.BytesIO(shown.get("/heliostats/AA39?figure=deviation&format=npz").content))
    assert (arrays["unit"], arrays["size_m"].shape) == ("mm", (2,))
    z = np.load(io.BytesIO(shown.get("/v1/heliostats/AA39/surfaces/current?format=npz").content))["z"]
    assert np.nanmax(np.abs(arrays["values"])) == pytest.approx(1e3 * np.abs(z).max(), rel=0.3)
    rows = sheet(shown, "/heliostats/AA39?figure=history-1&format=csv")
    assert [row["name"] for row in rows] == ["version 1", "version 2"]
    field = np.load(io.BytesIO(shown.get("/?metric=deviation&figure=field&format=npz").content))
    assert (field["names"].tolist(), field["places_m"].shape, field["unit"]) == (["AA39"], (1, 2), "mm")
    assert field["values"][0] == pytest.approx(1e3 * np.sqrt(np.mean(z**2)), rel=0.3)


def test_formulas_of_senders_do_no_harm(client: TestClient, post: Post):
    post(png(1), id="1")
    client.patch("/v1/heliostats/AA39/measurements/1", json={"excluded": True, "reason": "=1+1"})
    client.headers.update(HTML)
    (row,) = sheet(client, "/heliostats/AA39/photographs/1?table=corrections")
    assert row["Reason"] == "'=1+1"


@pytest.mark.parametrize(
    "part", ["table=none", "figure=none&format=npz", "figure=deviation&format=xls", "figure=deviation"]
)
def test_what_a_page_does_not_have_is_not_found(shown: TestClient, part: str):
    assert shown.get(f"/heliostats/AA39?{part}").status_code == 404


def test_parts_need_what_their_page_needs(shown: TestClient):
    assert text_of(shown, "/heliostats/none?table=outliers", 404)
    assert shown.get("/v1/heliostats?table=x").headers["Content-Type"] == "application/json"


def test_plan_as_tables_maps_and_timelines(app: FastAPI, pages: TestClient):
    job = planned(app, pages)
    rows = sheet(pages, f"/plans/{job['id']}?table=series")
    steps = pages.get(f"/v1/jobs/{job['id']}").json()["result"]["steps"]
    assert [float(row["Power of ideal mirrors [W]"]) for row in rows] == [step["ideal"]["power_w"] for step in steps]
    assert [float(row["Sun elevation [°]"]) for row in rows] == [step["sun"]["elevation_deg"] for step in steps]
    links = parts_of(pages.get(f"/plans/{job['id']}", headers=HTML).text)
    formats = Counter(link.rpartition("=")[2] for link in links)
    assert formats == {"npz": 3, "png": 6, "csv": 3, "series": 1, "plans": 1}  # three maps, three timelines, two tables
    for link in links:
        check(pages.get(link))
