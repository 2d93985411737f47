"""What screens of 1440 x 900 need: scales of the data, axes that end, noon by the sun."""

from datetime import datetime
from types import SimpleNamespace
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from fastapi.testclient import TestClient

from model.ephemeris import sun_angles_at
from service.drawing.charts import PlanePicture
from service.drawing.timelines import Value, timeline
from service.twin.alarms.field_filter import METRICS
from service.twin.alarms.field_overview import HeliostatOverview
from service.web.resources.field import ColourEnds, colour_ends, draw
from service.web.resources.forecasts import time_of

LIMITS = ColourEnds(95.0, 75.0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([97.0, 90.0, 54.0], (97.0, 75.0)),  # what is poor has the last colour
        ([94.0, 88.0], (95.0, 85.0)),  # what is fine recedes, also the worst of the field
        ([96.0, 82.0], (96.0, 82.0)),
        ([], (95.0, 85.0)),
    ],
)
def test_colours_span_the_values_of_the_field(values: list[float], expected: tuple[float, float]):
    lines: list[Any] = [SimpleNamespace(rank=SimpleNamespace(accuracy=v / 100)) for v in values]
    ends = colour_ends(lines, METRICS["accuracy"], LIMITS)
    assert (ends.best, ends.worst) == pytest.approx(expected)


@pytest.mark.parametrize("count", [20, 40, 60])
def test_squares_on_the_map_are_as_large_as_their_neighbours_allow(count: int):
    lines = [
        HeliostatOverview(f"{east}-{north}", 10.0 * east, 10.0 * north)
        for east in range(count)
        for north in range(count)
    ]
    drawing = draw(lines, lines, METRICS["accuracy"], LIMITS)
    assert 0.5 < drawing.side / (10 * drawing.per_metre) < 0.9


def test_axes_of_shares_end_at_100_percent():
    days = [datetime(2026, 6, day, tzinfo=ZoneInfo("UTC")) for day in (1, 2, 3)]
    values = [Value(at, number) for at, number in zip(days, (88.0, 99.0, 97.0), strict=True)]
    chart = timeline("Accuracy", "%", {"": values}, 1)
    assert chart is not None
    assert chart.bounds.high == 100.0
    assert chart.bounds.low < 88.0


def test_noon_is_the_suns():
    """In Spain it is more than two hours after that of the clock, in summer."""
    origin = (37.56, -5.33, 0.0)
    plant: Any = SimpleNamespace(origin=origin)
    noon = time_of("noon", "Europe/Madrid", plant)
    assert sun_angles_at(noon, origin)[0] == pytest.approx(180.0, abs=1.0)
    clock = time_of("noon", "Europe/Madrid", None).astimezone(ZoneInfo("Europe/Madrid"))
    assert (clock.hour, clock.minute) == (12, 0)


def test_pictures_of_targets_have_axes_in_metres():
    seen = PlanePicture("the target", "crop.jpg", 8.0, 7.0)
    assert [tick.label for tick in seen.x_ticks] == ["-4", "-2", "0", "2", "4"]
    assert seen.y_ticks[0].label == "-2"


def test_the_page_of_the_api_has_a_way_back(client: TestClient):
    page = client.get("/docs").text
    assert 'href="/"' in page
    assert "prefers-color-scheme: dark" in client.get("/docs/docs.css").text
