"""Forms: times in the plant's time zone, several heliostats, and corrections without a change."""

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient

from model.ephemeris import sun_angles_at
from service.base.fields import plant_time_to_utc
from service.base.settings import Settings
from service.drawing.templates import form_time, times_in_zone
from service.store.columns import now
from service.web.app import create_app
from tests.service.conftest import (
    ORIGIN,
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.web.pages import HTML, Page, field_of, form, text_of

ZONE = "Europe/Madrid"


@pytest.fixture(scope="module")
def madrid(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("madrid"), time_zone=ZONE, **QUIET)
    with client_of(create_app(settings, FakeOperations())) as client:
        assert client.put("/v1/plant", json=tower_document()).status_code == 200
        for place, name in enumerate(("AA39", "AB01", "AC02")):
            properties = properties_document()
            properties["heliostat_position"][0] += 3e-4 * place
            assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
        sun = {"azimuth_deg": 201.2345678912, "elevation_deg": 45.9876543211}
        answer = poster(client)(
            png(1), id="101", sun=sun, taken_at="2024-05-01T10:00:00.250Z", heliostat="AA39"
        )
        assert answer.status_code == 201, answer.text
        client.headers.update(HTML)
        yield client


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("2026-06-21 13:00", "2026-06-21T11:00"),
        ("2026-06-21T13:00:05", "2026-06-21T11:00:05"),
        ("2026-01-21 13:00", "2026-01-21T12:00"),
        ("2026-10-25 02:30", "2026-10-25T00:30"),  # the first of two equal times
        ("2026-10-25 02:30+0100", "2026-10-25T01:30"),
    ],
)
def test_times_of_forms_are_the_plants(text: str, utc: str):
    at = plant_time_to_utc(datetime.fromisoformat(text), ZONE)
    assert at == datetime.fromisoformat(utc).replace(tzinfo=UTC)
    assert form_time(at, ZONE) == text.replace("T", " ")


def test_wrong_time_names_the_field_and_the_remedy(madrid: TestClient):
    answer = madrid.post("/forecast", data=form(sun_by="time", moment="06/21/2026 1 pm"))
    assert answer.status_code == 422
    assert "moment: give a date and a time as 2026-06-21 13:00, in the plant" in answer.text


def test_night_is_said_in_the_plants_time(madrid: TestClient):
    answer = madrid.post("/forecast", data=form(sun_by="time", moment="2026-06-21 23:30"))
    assert answer.status_code == 422
    assert re.search(r"moment: the sun is .* at 2026-06-21 23:30 CEST", answer.text)
    body = {"heliostat": "AA39", "target": "upper", "sun": {"at": "2026-06-21T21:30:00Z"}}
    assert "at 2026-06-21 21:30 UTC" in madrid.post("/v1/forecasts", json=body).text


def test_times_in_texts_are_moved():
    said = "between 2024-08-12 09:05 UTC and 2024-08-12T11:10:07Z, after 2024-01-12 23:10 UTC"
    moved = "between 2024-08-12 11:05 CEST and 2024-08-12 13:10 CEST, after 2024-01-13 00:10 CET"
    assert times_in_zone(said, ZONE) == moved
    assert times_in_zone(said.replace("T11:10:07Z", " 11:10 UTC"), "UTC").count("UTC") == 3


@pytest.mark.parametrize("path", ["/forecast", "/plans", "/calibration-plan"])
def test_forms_say_the_zone(madrid: TestClient, path: str):
    page = text_of(madrid, path)
    assert ZONE in page.one("main").words
    assert not page.all("input", type="datetime-local")


@pytest.mark.parametrize("path", ["/photographs", "/photographs/times", "/compare", "/studies/new"])
def test_days_are_texts_of_the_plants_zone(madrid: TestClient, path: str):
    page = text_of(madrid, path)
    assert not page.all("input", type="date")
    assert ZONE in page.one("main").words
    wrong = text_of(madrid, f"{path}?until=06/21/2026", 422)
    assert "until: give a day as 2026-06-21, in the plant's time zone" in wrong.words
    assert "year" in text_of(madrid, f"{path}?since=9999-12-31", 422)


def test_photographs_of_a_day_are_those_of_the_plants(madrid: TestClient):
    for number, at in ((2, "2024-06-20T21:59:00Z"), (3, "2024-06-20T22:01:00Z")):
        answer = poster(madrid)(png(number), id=f"10{number}", taken_at=at, heliostat="AB01")
        assert answer.status_code == 201, answer.text
    query = "since=2024-06-21&until=2024-06-21"
    page = text_of(madrid, f"/photographs?{query}")
    assert "103" in page.words
    assert "102" not in page.words
    assert field_of(page, "since") == "2024-06-21"
    review = text_of(madrid, f"/photographs/review?{query}").words
    assert "103" in review
    shifted = {"since": "2024-06-21", "minutes": "1", "reason": "slow clock"}
    shown = Page(madrid.post("/photographs/times/shift", data=shifted).text).words
    assert "103" in shown
    assert "102" not in shown


def test_now_and_noon_tomorrow_are_filled_in(madrid: TestClient):
    here = datetime.fromisoformat(form_time(now(), ZONE))
    page = text_of(madrid, "/forecast?when=now&heliostat=AB01&target=upper")
    (first, second) = [link["href"] for link in page.all("a") if "when=" in link["href"]]
    assert abs(datetime.fromisoformat(field_of(page, "moment")) - here) < timedelta(minutes=2)
    assert page.one("input", name="sun_by", value="time").attributes.keys() >= {"checked"}
    assert (field_of(page, "heliostat"), "target=upper" in first) == ("AB01", True)
    noon = field_of(text_of(madrid, second), "moment")
    shown = datetime.fromisoformat(noon)
    assert shown.date() == (here + timedelta(days=1)).date()
    azimuth, _ = sun_angles_at(plant_time_to_utc(shown, ZONE), ORIGIN)
    assert azimuth == pytest.approx(180, abs=0.5)
    plan = text_of(madrid, "/plans?when=noon")
    assert field_of(plan, "first_at") == field_of(plan, "last_at") == noon


def test_several_heliostats_are_forecast_together(madrid: TestClient):
    asked = form(heliostat="AB01, AA39 AB01")
    path = madrid.post("/forecast", data=asked, follow_redirects=False).headers["Location"]
    job: Any = madrid.get(f"/v1{path}").json()
    assert job["payload"]["heliostats"] == ["AB01", "AA39"]
    again = text_of(madrid, f"/forecast?job={job['id']}")
    assert field_of(again, "heliostat") == "AB01, AA39"
    wrong = madrid.post("/forecast", data=form(heliostat="AA39, x/y"))
    assert wrong.status_code == 422
    assert "is no name" in wrong.text


def test_correction_without_a_change_returns_to_the_page(madrid: TestClient):
    path = "/heliostats/AA39/photographs/101"
    page = text_of(madrid, path)
    names = ("azimuth_deg", "elevation_deg", "taken_at")
    asked = {name: field_of(page, name) for name in names}
    assert asked == {
        "azimuth_deg": "201.2346",
        "elevation_deg": "45.9877",
        "taken_at": "2024-05-01 12:00",
    }
    answer = madrid.post(path, data=asked | {"reason": "none"})
    assert answer.status_code == 200
    assert "Nothing was corrected" in answer.text
    # One changed value changes no other one.
    madrid.post(path, data=asked | {"reason": "typed wrong", "elevation_deg": "45.5"})
    stored = madrid.get("/v1/heliostats/AA39/measurements/101").json()
    assert stored["sun"] == {"azimuth_deg": 201.2345678912, "elevation_deg": 45.5}
    assert stored["taken_at"].startswith("2024-05-01T10:00:00.25")
