"""The form of a study: what it would study and cost, and the job that it requests."""

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.base.settings import Settings
from tests.service import real
from tests.service.conftest import QUIET, Post, png
from tests.service.web.pages import HTML, text_of


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", time_zone="Europe/Berlin", **QUIET)


def words(client: TestClient, query: str = "") -> str:
    """The card of the cost, with plain blanks."""
    page = text_of(client, f"/studies/new{query}")
    return page.one("section", aria_labelledby="cost-title").words.replace("\xa0", " ")


def requested(client: TestClient, **form: Any) -> dict[str, Any]:
    """The payload of the job that the form requests."""
    answer = client.post("/studies", data=form, headers=HTML, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    payload: dict[str, Any] = client.get(f"/v1{answer.headers['Location']}").json()["payload"]
    return payload


def test_cost_is_known_before_the_study_starts(real_client: TestClient):
    jobs = real_client.get("/v1/jobs").json()["items"]
    assert "Photographs11of 2 heliostats; at most 400 Effects to try18" in words(real_client)
    assert "by 1 earlier study on this machine" in words(real_client)
    one = words(real_client, "?heliostats=AA39&candidates=camera_blur&candidates=soiling&images=4")
    assert "Photographs4of 1 heliostat;" in one
    assert "Effects to try2" in one
    assert "camera_blur" in text_of(real_client, "/studies/new")
    assert real_client.get("/v1/jobs").json()["items"] == jobs


@pytest.mark.full
def test_form_requests_what_it_shows(real_client: TestClient):
    payload = requested(real_client, heliostats="*a*, AC43", candidates="camera_shoulder", since="")
    assert payload["heliostats"] == ["AA39", "AC43"]
    assert payload["candidates"] == ["camera_shoulder"]
    assert payload["since"] is None
    assert requested(real_client, max_heliostats="3")["heliostats"] is None
    assert real.worker(real_client).work()
    (study, _) = real_client.get("/v1/studies").json()["items"]
    assert (study["verdict"], study["heliostats"]) == ("effect", ["AA39", "AC43"])


def test_days_are_those_of_the_plants_zone(client: TestClient, post: Post):
    for number, moment in enumerate(("2024-06-20T21:59:00Z", "2024-06-20T22:01:00Z")):
        assert post(png(number), id=f"10{number}", taken_at=moment).status_code == 201
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    query = "?images=2&since=2024-06-21&until=2024-06-21"
    assert "Photographs1of 1 heliostat;" in words(client, query)
    assert "at least 4 photographs" in words(client, query)
    assert "A day in Europe/Berlin" in text_of(client, "/studies/new")
    payload = requested(client, since="2024-06-21", until="2024-06-21")
    assert (payload["since"], payload["until"]) == ("2024-06-20T22:00:00Z", "2024-06-21T22:00:00Z")


@pytest.mark.parametrize(
    ("field", "value", "status", "remedy"),
    [
        ("heliostats", "ZZ99", 404, "ZZ99"),
        ("heliostats", "ZZ*", 422, "no heliostat has a name like ZZ*"),
        ("candidates", "magic", 422, "the catalogue of effects has"),
        ("since", "21.06.2024", 422, "since"),
        ("images", "64", 422, "400 at most"),
    ],
)
def test_wrong_fields_are_named(
    real_client: TestClient, field: str, value: str, status: int, remedy: str
):
    form = {field: value, "max_heliostats": "200"}
    for answer in (
        real_client.get("/studies/new", params=form, headers=HTML),
        real_client.post("/studies", data=form, headers=HTML),
    ):
        assert answer.status_code == status
        assert remedy in answer.text
