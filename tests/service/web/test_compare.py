"""The page that holds two surfaces against each other."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.surface import greville
from service.drawing.timelines import Value, timeline
from service.twin.alarms.field_overview import surface_errors
from tests.service.conftest import FakeOperations, Post, png, sun_at
from tests.service.web.pages import HTML, settled, text_of

DAYS = ("2024-06-01", "2024-07-01", "2024-08-01")


@pytest.fixture
def pages(client: TestClient, post: Post, properties: dict[str, Any]) -> TestClient:
    """Three photographs of a summer, and two surfaces: of the first, and of the first two."""
    for number, day in enumerate(DAYS, 1):
        taken = f"{day}T11:30:00Z"
        assert (
            post(
                png(number), id=f"10{number}", taken_at=taken, sun=sun_at(180 - 10.0 * number)
            ).status_code
            == 201
        )
    for used in (["101"], ["101", "102"]):
        assert (
            client.post("/v1/heliostats/AA39/surfaces", json={"measurements": used}).status_code
            == 201
        )
    assert client.put("/v1/heliostats/AB01", json=properties).status_code == 201
    client.headers.update(HTML)
    return client


def test_versions_are_compared_with_their_forecasts(pages: TestClient, operations: FakeOperations):
    page = settled(pages, "/compare?heliostat=AA39")
    assert page.count('<svg class="figure" viewBox="0 0 430') == 6
    assert [made["resolution"] for made in operations.forecasts[-2:]] == [(128, 128)] * 2
    # Only the third photograph has been seen by neither.
    assert "the 1 newest photographs that neither was made from" in page
    accuracies = page.cells("Forecast accuracy")[:2]
    assert [accuracy.split() for accuracy in accuracies] == [["100.0", "%"]] * 2


def test_active_surface_is_compared_with_the_version_before(pages: TestClient):
    """Whatever waits aside is newer, and would turn the difference round."""
    assert (
        pages.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["103"]}).status_code
        == 201
    )
    for todays, pair in ((2, (1, 2)), (1, (1, 3))):
        choice = {"version": todays, "reason": "it stays"}
        assert pages.put("/v1/heliostats/AA39/surfaces/current", json=choice).status_code == 200
        page = settled(pages, "/compare?heliostat=AA39")
        assert f"AA39, version {pair[0]} with AA39, version {pair[1]}" in page
    assert "version 2 with AA39, version 3" in settled(
        pages, "/compare?heliostat=AA39&other_version=3"
    )


def test_time_range_of_the_link_bounds_what_is_shown(pages: TestClient):
    def dots(path: str) -> int:
        charts = settled(pages, path).partition("Over time")[2]
        return charts.partition('id="timeline-2-caption"')[0].count("<circle")

    path = "/compare?heliostat=AA39&version=1&other_version=2"
    assert dots(path) == 6
    assert dots(f"{path}&since=2024-07-01&until=2024-07-31") == 2
    page = settled(pages, f"{path}&since=2030-01-01")
    assert "Nothing is in this time" in page
    assert 'name="since" value="2030-01-01"' in page


def test_versions_are_marked_in_time(pages: TestClient):
    charts = settled(pages, "/compare?heliostat=AA39").partition("Over time")[2]
    assert charts.count('class="noted"') == 6
    for label in ("v1", "v2"):
        assert f">{label}</text>" in charts


def test_two_heliostats_are_compared(pages: TestClient, post: Post):
    assert "AB01" in text_of(pages, "/compare?heliostat=AA39&other=AB01", 404)
    assert (
        post(png(9), heliostat="AB01", id="201", taken_at="2024-06-15T11:30:00Z").status_code == 201
    )
    assert pages.post("/v1/heliostats/AB01/surfaces", json={}).status_code == 201
    page = settled(pages, "/compare?heliostat=AA39&other=AB01")
    assert "AA39, version 2 with AB01, version 1" in page
    assert (
        page.count('<polyline class="series other"') == 3
    )  # accuracy, deviation, canting; no mount is calibrated
    assert "AB01 1</text>" in page


@pytest.mark.parametrize(
    "query", ["heliostat=none", "heliostat=AB01&version=1", "heliostat=AA39&version=9"]
)
def test_what_is_not_there_is_named(pages: TestClient, query: str):
    assert "<h1>Not Found" in text_of(pages, f"/compare?{query}", 404)


@pytest.mark.parametrize("query", ["since=yesterday", "version=x", "elevation_deg=91"])
def test_bad_links_are_refused_by_name(pages: TestClient, query: str):
    assert query.partition("=")[0] in text_of(pages, f"/compare?heliostat=AA39&{query}", 422)


def test_tilted_facets_are_canting_and_no_waviness():
    """One mrad about each axis of every facet of a 4 m x 2 m mirror."""
    x, y = np.meshgrid(2 * (greville(8) - 0.5), 1 * (greville(8) - 0.5), indexing="ij")
    shape = surface_errors(np.stack([1e-3 * (x + y)] * 4), np.array([[2.0, 1.0]] * 4))
    assert shape.canting_mrad == pytest.approx(2**0.5, rel=1e-9)
    assert shape.waviness_mm == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "span_s", [1e-3, 1.0, 100.0, 170.0, 7200.0, 10_000.0, 80_000.0, 2e5, 7.7e6, 8e6, 9e7, 9e8]
)
def test_time_has_ticks_whatever_its_span(span_s: float):
    begin = datetime(2024, 5, 1, 7, 3, tzinfo=UTC)
    values = [Value(begin, 1.0), Value(begin + timedelta(seconds=span_s), 2.0)]
    chart = timeline("", "", {"": values}, 1)
    assert chart is not None
    assert 1 <= len(chart.x_ticks.ticks) <= 8
