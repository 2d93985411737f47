"""Photographs uploaded from the browser, with their suns by their times."""

from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from model.ephemeris import sun_angles_at
from service.base.fields import parse_moment
from service.web.resources.photographs import time_in_name
from tests.page import Page
from tests.service.conftest import ORIGIN, png
from tests.service.web.pages import HTML, make_key, text_of

PATH = "/photographs/upload"
FORM = {"heliostat": "AA39", "target": "lower", "kind": "cropped"}


def upload(client: TestClient, *files: tuple[str, bytes], **fields: str) -> Any:
    empty = {"taken_at": "", "azimuth_deg": "", "elevation_deg": ""}
    return client.post(
        PATH, data=FORM | empty | fields, files=[("files", one) for one in files], headers=HTML
    )


def test_several_files_are_stored_with_their_suns(client: TestClient):
    assert text_of(client, PATH).one("input", name="files")["type"] == "file"
    files = [("2026-06-21_10-03-00.png", png(1)), ("20260621T120000.png", png(2))]
    answer = upload(client, *files, ("notes.txt", b"text"))
    assert answer.status_code == 200, answer.text
    page = Page(answer.text)
    assert "2 of 3 stored" in page.words
    items = client.get("/v1/heliostats/AA39/measurements").json()["items"]
    assert [item["taken_at"] for item in items] == ["2026-06-21T10:03:00Z", "2026-06-21T12:00:00Z"]
    azimuth, elevation = sun_angles_at(parse_moment(time_in_name(files[0][0], "UTC")), ORIGIN)
    assert items[0]["sun"] == pytest.approx({"azimuth_deg": azimuth, "elevation_deg": elevation})
    assert items[0]["warnings"] == []
    assert items[1]["external_id"] == "20260621T120000"
    assert page.one("a", href="/heliostats/AA39/photographs/20260621T120000")
    again = Page(upload(client, files[0]).text)
    assert "was stored before" in again.words


def test_a_file_without_a_time_needs_one_or_the_sun(client: TestClient):
    assert "no time in the file" in upload(client, ("a.png", png(1))).text
    assert client.get("/v1/heliostats/AA39/measurements").json()["items"] == []
    assert "1 of 1 stored" in upload(client, ("a.png", png(1)), taken_at="2026-06-21T10:00").text
    sun = {"azimuth_deg": "160", "elevation_deg": "45"}
    assert "1 of 1 stored" in upload(client, ("b.png", png(2)), **sun).text
    times = [
        item["taken_at"] for item in client.get("/v1/heliostats/AA39/measurements").json()["items"]
    ]
    assert times == ["2026-06-21T10:00:00Z", None]
    night = upload(client, ("c.png", png(3)), taken_at="2026-06-21T23:00")
    assert "below the horizon" in night.text


def test_what_is_wrong_is_named(app: FastAPI, client: TestClient):
    assert upload(client, ("a.png", png(1)), heliostat="ZZ99").status_code == 404
    assert upload(client, ("a.png", png(1)), kind="drawing").status_code == 422
    assert "the file is empty" in upload(client, ("a.png", b"")).text
    client.headers["Authorization"] = f"Bearer {make_key(app, 'read')}"
    assert upload(client, ("a.png", png(1))).status_code == 403


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("cam2_2026-06-21T12.03.07.tif", "2026-06-21 10:03:07+00:00"),
        ("20260621_1203.png", "2026-06-21 10:03:00+00:00"),
        ("20261321_1203.png", "None"),
        ("205363.png", "None"),
    ],
)
def test_times_in_names_are_the_plants(name: str, time: str):
    assert str(time_in_name(name, "Europe/Berlin")) == time
