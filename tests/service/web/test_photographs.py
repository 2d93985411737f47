"""Photographs on the pages: one row each, whatever kinds came of it; small, outlined, and beside its light."""

import html
import re
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.imaging import MeasuredFlux, Quality
from service import store
from service.store.measurements import list_shots
from service.web.pages import heliostat
from tests.service.conftest import FakeOperations, Post, png
from tests.service.web.test_pages import HTML, text_of

HERE = "/heliostats/AA39/photographs"


def rows_of(page: str) -> list[str]:
    table = page.partition('id="photographs-title"')[2]
    return re.findall(r'<th scope="row"><a href="/heliostats/AA39/photographs/[\w-]+">(\w+)</a>', table)


@pytest.fixture
def filled(client: TestClient, post: Post) -> TestClient:
    """Three photographs: one in three kinds, a refused one in two, and an excluded one."""
    for seed, kind in enumerate(("raw", "cropped", "flux")):
        assert post(png(seed + 1), id="1", kind=kind).status_code == 201
    for seed, kind in enumerate(("cropped", "flux")):
        assert post(png(seed + 11, refused=True), id="2", kind=kind).status_code == 201
    assert post(png(21), id="3").status_code == 201
    excluded = client.patch("/v1/heliostats/AA39/measurements/3", json={"excluded": True, "reason": "a bird"})
    assert excluded.status_code == 200
    client.headers.update(HTML)
    return client


def test_photograph_has_one_row(filled: TestClient):
    page = text_of(filled, "/heliostats/AA39")
    assert rows_of(page) == ["3", "2", "1"]
    assert page.count("thumbnail.jpg") == 3
    assert re.findall(r'class="note" href="[^"]*">([\w-]+)</a>', page)[-3:] == ["flux", "cropped", "raw"]


@pytest.mark.parametrize(("verdict", "names"), [("used", ["1"]), ("refused", ["2"]), ("excluded", ["3"])])
def test_photographs_are_chosen_by_verdict(filled: TestClient, verdict: str, names: list[str]):
    page = text_of(filled, f"/heliostats/AA39?photographs={verdict}")
    assert rows_of(page) == names
    assert re.search(rf'aria-current="true">{verdict}</a>', page)
    assert ("no spot" in page) == (verdict == "refused")


def test_older_photographs_are_a_page_away(filled: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(heliostat, "MOST_PHOTOGRAPHS", 2)
    page = text_of(filled, "/heliostats/AA39")
    assert rows_of(page) == ["3", "2"]
    (older,) = re.findall(r'href="([^"]*newer=2)#', page)
    page = text_of(filled, html.unescape(older))
    assert rows_of(page) == ["1"]
    assert "newer=0" in page
    assert "newer=3" not in page


def test_other_verdicts_are_refused(filled: TestClient):
    assert filled.get("/heliostats/AA39?photographs=x").status_code == 422


def test_one_image_that_is_used_makes_a_photograph_used(client: TestClient, post: Post):
    post(png(1, refused=True), id="1", kind="raw")
    post(png(2), id="1", kind="flux")
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        (shot,) = list_shots(session, store.get_heliostat(session, "AA39"), 10)
    assert (shot.name, shot.verdict, [row.kind for row in shot.images]) == ("1", "used", ["flux", "raw"])


def test_thumbnail_is_small_and_is_sent_once(client: TestClient, post: Post):
    post(png(1, size=(300, 400)), id="1")
    answer = client.get(f"{HERE}/1/thumbnail.jpg")
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "image/jpeg")
    assert cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR).shape == (144, 192, 3)
    tag = {"If-None-Match": answer.headers["ETag"]}
    assert client.get(f"{HERE}/1/thumbnail.jpg", headers=tag).status_code == 304
    assert client.get(f"{HERE}/9/thumbnail.jpg").status_code == 404
    assert client.get(f"{HERE}/1/nothing.jpg").status_code == 422


class Finder(FakeOperations):
    """Finds the target of a raw photograph in its middle."""

    def measure(self, image: Any, kind: str, plane: Any, **more: Any) -> MeasuredFlux:
        made = super().measure(image, kind, plane, **more)
        if kind != "raw":
            return made
        corners = np.array([[8.0, 8], [24, 8], [8, 24], [24, 24]])
        crop = np.full((256, 256), 99, np.uint8)
        return MeasuredFlux(Quality(accepted=True), made.flux, made.centered, made.center_of_mass, 4.0, crop, corners)


class TestFound:
    @pytest.fixture
    def operations(self) -> FakeOperations:
        return Finder()

    def test_target_is_outlined_and_straightened(self, client: TestClient, post: Post):
        post(cv2.imencode(".png", np.full((32, 32), 200, np.uint8))[1].tobytes(), id="1", kind="raw")
        outlined = cv2.imdecode(
            np.frombuffer(client.get(f"{HERE}/1/outlined.jpg").content, np.uint8), cv2.IMREAD_COLOR
        ).astype(int)
        assert abs(outlined[16, 16] - 200).max() < 12
        assert abs(outlined[16, 8] - 200).max() > 40  # its left edge
        assert f'href="{HERE}/1/large.jpg"' in text_of(client, f"{HERE}/1")
        assert client.get(f"{HERE}/1/large.jpg").headers["Content-Type"] == "image/jpeg"
        crop = cv2.imdecode(np.frombuffer(client.get(f"{HERE}/1/crop.jpg").content, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert crop.shape == (256, 256)
        assert abs(crop.astype(int) - 99).max() < 3


def test_image_without_a_target_has_no_crop(client: TestClient, post: Post):
    post(png(1), id="1")
    assert client.get(f"{HERE}/1/crop.jpg").status_code == 404


def test_photograph_stands_beside_its_light_and_the_forecast(filled: TestClient):
    page = text_of(filled, f"{HERE}/1")  # the first that came: raw
    for shown in ("outlined.jpg", "crop.jpg", 'alt="measured flux of 1"', 'alt="forecast flux of 1"', "100.0"):
        assert shown in page
    assert page.count('class="scale"') == 2
    assert re.search(r'also as <a href="[^"]*/1-flux">flux</a>', page)
    refused = text_of(filled, f"{HERE}/2")
    assert "crop.jpg" in refused
    assert "measured flux" not in refused
