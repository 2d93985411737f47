"""A camera that changed is seen in its photographs, and clouds are not taken for it."""

from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from numpy.linalg import norm
from sqlalchemy import event

from service import store
from service.base.settings import Settings
from service.store.columns import now
from service.store.tables import ImageRow, MeasurementRow
from service.twin.studies.cameras import FIGURES, CameraWatch, find_camera_change
from tests.service.web.pages import HTML

SETTINGS = Settings()
SPREAD = (0.16, 0.2, 0.17)
"""How much days differ at Jülich's lower target (`python -m benchmarks.cameras`)."""


def days(
    rng: np.random.Generator, count: int, factor: float = 1.0, last: int = 0
) -> dict[date, Any]:
    """Medians of ``count`` days; on the ``last`` of them the spot's contrast is ``factor`` times
    as high.
    """
    values = rng.normal(0.8, 1.0, (count, 3)) * SPREAD
    if last:
        values[-last:, 0] += np.log(factor)
    return {date(2024, 5, 1) + timedelta(days=2 * number): one for number, one in enumerate(values)}


@pytest.mark.parametrize("factor", [3.0, 1 / 3])
def test_change_is_found_with_its_day(factor: float):
    rng = np.random.default_rng(3)
    for _ in range(20):
        found = find_camera_change("lower", days(rng, 40, factor, 7), SETTINGS)
        assert found is not None
        assert (found.target, found.figure) == ("lower", "signal_to_background")
        assert abs((found.day - date(2024, 7, 6)).days) <= 4
        assert found.ratio == pytest.approx(factor, rel=0.4)
        assert sum(found.days) == 40


def test_days_as_they_are_raise_no_alarm():
    rng = np.random.default_rng(4)
    assert (
        sum(find_camera_change("lower", days(rng, 45), SETTINGS) is not None for _ in range(200))
        <= 4
    )


def test_one_odd_day_and_too_few_days_are_no_change():
    rng = np.random.default_rng(5)
    for last in (1, 2):
        assert find_camera_change("lower", days(rng, 40, 4.0, last), SETTINGS) is None
    assert find_camera_change("lower", days(rng, 12, 4.0, 6), SETTINGS) is None


def kept(app: FastAPI, changed: int) -> None:
    """Four photographs on each of thirty days, on the last of which, so many, the camera sees
    otherwise.
    """
    rng, at = np.random.default_rng(6), now().replace(hour=11) - timedelta(days=30)
    for number in range(120):
        quality = dict(zip(FIGURES, np.exp(rng.normal((0.8, 5.5, -3.6), SPREAD)), strict=True))
        quality["sheet_share"] *= 3.0 if number // 4 >= 30 - changed else 1.0
        keep(app, number, "flux", quality, at + timedelta(days=number // 4, minutes=number % 4))


def keep(
    app: FastAPI,
    number: int,
    kind: str,
    quality: dict[str, Any],
    taken_at: datetime,
    sun: Sequence[float] = (180.0, 40.0),
) -> None:
    """A photograph of AA39 on the lower target, under a sun at an azimuth and elevation [deg]."""
    with app.state.runtime.database.writing() as session:
        heliostat, target = store.get_heliostat(session, "AA39"), store.get_target(session, "lower")
        row = MeasurementRow(
            kind=kind,
            target_id=target.id,
            accepted=True,
            quality=quality,
            sun_azimuth_deg=sun[0],
            sun_elevation_deg=sun[1],
            taken_at=taken_at,
        )
        image = {"sha256": f"{number:03x}" + 61 * "0", "media_type": "image/png"}
        store.add_measurement(
            session, heliostat, ImageRow(**image, size_bytes=1, width_px=1, height_px=1), row
        )


@pytest.mark.usefixtures("client")
def test_light_is_per_cosine_of_incidence(app: FastAPI):
    database = app.state.runtime.database
    with database.reading() as session:
        row, target = store.get_heliostat(session, "AA39"), store.get_target(session, "lower")
        way = np.subtract(target.geometry["center"], (row.east_m, row.north_m, row.up_m))
    towards = np.degrees(np.arctan2(way[0], way[1])), np.degrees(np.arcsin(way[2] / norm(way)))
    aside = towards[0] + 90, 0.0  # at a right angle: an incidence of 45 degrees
    at = now() - timedelta(hours=1)
    for number, (sun, share) in enumerate(((towards, 1.0), (aside, 0.5**0.5))):
        keep(app, number, "raw", dict.fromkeys(FIGURES, 2.0 * share), at, sun)
    with database.reading() as session:
        light = CameraWatch().read(session, SETTINGS).light
    assert [one.light for one in light] == pytest.approx([np.log(2.0)] * 2)


def of_camera(client: TestClient) -> list[dict[str, Any]]:
    return [item for item in client.get("/v1/alarms").json()["items"] if item["reason"] == "camera"]


def test_changed_camera_raises_an_alarm_without_a_study(app: FastAPI, client: TestClient):
    kept(app, 8)
    (item,) = of_camera(client)
    since = (now() - timedelta(days=8)).date()
    assert abs(
        datetime.fromisoformat(item["since"])
        - datetime(since.year, since.month, since.day, tzinfo=UTC)
    ) <= (timedelta(days=2))
    assert item["message"].startswith("on lower the sheet's own pattern is ")
    assert (
        'heliotwin_camera_change_ratio{figure="sheet_share",target="lower"} '
        in client.get("/metrics").text
    )
    assert "On lower the sheet&#39;s own pattern is " in client.get("/alarms", headers=HTML).text
    client.post("/v1/alarms/acknowledgements", json={"ids": [item["id"]], "reason": "seen"})
    assert of_camera(client)[0]["acknowledged_by"] == "local"


@pytest.mark.full
def test_days_before_today_are_read_once(app: FastAPI, client: TestClient):
    kept(app, 0)
    assert of_camera(client) == []
    asked: list[str] = []
    event.listen(
        app.state.runtime.database.engine, "before_cursor_execute", lambda *a: asked.append(a[2])
    )
    assert of_camera(client) == []
    assert sum("measurements.quality" in one for one in asked) == 1
