"""Photographs on the pages: one row each, whatever kinds came of it; small, outlined, and beside
its light.
"""

import csv
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from model.errors import InvalidInputError
from model.imaging import MeasuredFlux, Quality
from service import store
from service.base.errors import BusyError
from service.base.settings import Settings
from service.sources.decode import decode_image
from service.store.columns import now
from service.store.database import Database
from service.store.listing import Period
from service.store.photographs import PhotographFilter, dated_groups, list_groups, undated_groups
from service.store.tables import TargetRow
from service.twin import runtime
from service.web.app import create_app
from service.web.resources import heliostats
from service.web.resources import photographs as photograph_list
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    Post,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.web.pages import HTML, text_of

HERE = "/heliostats/AA39/photographs"


def names_of(page: Page) -> list[str]:
    """Heliostats and names of the photographs in a page's table."""
    links = [link for row in page.all("th", scope="row") for link in row.all("a")[:1]]
    return [
        f"{link['href'].split('/')[2]} {link.words}"
        for link in links
        if link["href"].split("/")[3:4] == ["photographs"]
    ]


def rows_of(page: Page) -> list[str]:
    """Names of AA39's photographs in a page's table."""
    return [name.removeprefix("AA39 ") for name in names_of(page)]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """Three photographs: one in three kinds, a refused one in two, and an excluded one."""
    with filled_store(tmp_path_factory.mktemp("filled")) as client:
        yield client


@contextmanager
def filled_store(folder: Path) -> Iterator[TestClient]:
    settings = Settings(data_dir=folder, **QUIET)
    with client_of(create_app(settings, FakeOperations())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        post = poster(client)
        for seed, kind in enumerate(("raw", "cropped", "flux")):
            assert post(png(seed + 1), id="1", kind=kind).status_code == 201
        for seed, kind in enumerate(("cropped", "flux")):
            assert post(png(seed + 11, refused=True), id="2", kind=kind).status_code == 201
        assert post(png(21), id="3").status_code == 201
        excluded = client.patch(
            "/v1/heliostats/AA39/measurements/3", json={"excluded": True, "reason": "a bird"}
        )
        assert excluded.status_code == 200
        client.headers.update(HTML)
        yield client


def test_photograph_has_one_row(filled: TestClient):
    page = text_of(filled, "/heliostats/AA39")
    assert rows_of(page) == ["3", "2", "1"]
    assert page.count("thumbnail.jpg") == 3
    assert page.texts("a", class_="note")[-3:] == ["flux", "cropped", "raw"]


@pytest.mark.parametrize(
    ("verdict", "names"), [("used", ["1"]), ("refused", ["2"]), ("excluded", ["3"])]
)
def test_photographs_are_chosen_by_verdict(filled: TestClient, verdict: str, names: list[str]):
    page = text_of(filled, f"/heliostats/AA39?photographs={verdict}")
    assert rows_of(page) == names
    assert verdict in page.texts("a", aria_current="true")
    assert ("no spot" in page) == (verdict == "refused")


def test_older_photographs_are_a_page_away(filled: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(heliostats, "MAX_PHOTOGRAPHS", 2)
    page = text_of(filled, "/heliostats/AA39")
    assert rows_of(page) == ["3", "2"]
    (older,) = [link for link in page.links if re.search(r"^/photographs.*after=\d+$", link)]
    page = text_of(filled, older)
    assert rows_of(page) == ["1"]
    assert 'href="/photographs?heliostat=AA39">Newest' in page


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """The same with another heliostat's on another target, of a day long ago."""
    with filled_store(tmp_path_factory.mktemp("field")) as client:
        properties = properties_document()
        assert client.put("/v1/heliostats/AB01", json=properties).status_code == 201
        answer = poster(client)(
            png(31), heliostat="AB01", id="4", target="upper", taken_at="2024-06-01T11:30:00Z"
        )
        assert answer.status_code == 201
        yield client


OF_FIELD = [
    "AB01 4",
    "AA39 3",
    "AA39 2",
    "AA39 1",
]  # those of an unknown time last, the last that came first


@pytest.mark.parametrize(
    ("asked", "shown"),
    [
        ("", [0, 1, 2, 3]),
        ("heliostat=AB01&verdict=&target=&since=&until=", [0]),
        ("verdict=used", [0, 3]),
        ("verdict=refused", [2]),
        ("verdict=excluded", [1]),
        ("target=lower", [1, 2, 3]),
        ("target=upper&verdict=used", [0]),
        ("since=2024-06-01&until=2024-06-01", [0]),
        ("dated=false", [1, 2, 3]),
        ("dated=true", [0]),
        ("dated=false&verdict=refused", [2]),
        ("dated=false&since=2024-06-01", []),
        ("until=2024-05-31", []),
        ("since=2024-06-02&heliostat=AA39&verdict=used", []),
    ],
)
def test_photographs_of_the_field_are_found(field: TestClient, asked: str, shown: list[int]):
    assert names_of(text_of(field, f"/photographs?{asked}")) == [OF_FIELD[at] for at in shown]


def test_pages_of_photographs_meet(field: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(photograph_list, "LISTED", 1)
    path, seen = "/photographs", []
    while path:
        page = text_of(field, path)
        seen += names_of(page)
        path = "".join(link["href"] for link in page.all("a", rel="next"))
    assert seen == OF_FIELD
    assert field.get("/photographs?after=999").status_code == 404
    assert field.get("/photographs?heliostat=XX99").status_code == 404


@pytest.mark.parametrize(
    ("asked", "shown"),
    [
        ({}, [0, 1, 2, 3]),
        ({"verdict": "refused", "dated": "false"}, [2]),
        ({"target": "upper", "since": "2024-06-01T11:30:00Z"}, [0]),
        ({"until": "2024-06-01T11:30:00Z"}, []),
        ({"heliostat": "AA39", "warned": "false"}, [1, 2, 3]),
    ],
)
def test_rest_lists_the_photographs_of_the_page(
    field: TestClient, asked: dict[str, str], shown: list[int]
):
    """One item for each photograph; pages of one item meet."""
    seen, after = [], ""
    while after is not None:
        query = {"limit": "1", **asked, **({"after": after} if after else {})}
        answer = field.get("/v1/measurements", params=query)
        assert answer.status_code == 200, answer.text
        seen += answer.json()["items"]
        after = answer.json()["next"]
    names = [f"{one['heliostat']} {one['external_id']}" for one in seen]
    assert names == [OF_FIELD[at] for at in shown]
    for one in seen:
        assert one["images"][one["kind"]] == one["id"]
        path = f"/v1/heliostats/{one['heliostat']}/measurements/{one['id']}"
        alone = field.get(path).json()
        assert {name: one[name] for name in alone} == alone


def test_rest_names_what_its_list_of_photographs_does_not_know(field: TestClient):
    for query, status in ({"after": 999}, 404), ({"heliostat": "XX99"}, 404), ({"time": 1}, 422):
        assert field.get("/v1/measurements", params=query).status_code == status


def test_photographs_are_a_table_for_spreadsheets(field: TestClient):
    rows = list(
        csv.DictReader(io.StringIO(field.get("/photographs?verdict=used&table=photographs").text))
    )
    assert [(row["Heliostat"], row["Target"], float(row["Sun elevation [°]"])) for row in rows] == [
        ("AB01", "upper", 45.0),
        ("AA39", "lower", 45.0),
    ]


@pytest.mark.parametrize(
    ("wanted", "index"),
    [
        (PhotographFilter(), "ix_measurements_taken_at_id"),
        (PhotographFilter(verdict="used"), "ix_measurements_accepted_taken_at_id"),
        (PhotographFilter(verdict="refused"), "ix_measurements_accepted_taken_at_id"),
        (PhotographFilter(verdict="excluded"), "ix_measurements_accepted_taken_at_id"),
        (PhotographFilter(target=TargetRow(id=1)), "ix_measurements_target_id_taken_at_id"),
        (PhotographFilter(taken=Period(now(), now())), "ix_measurements_taken_at_id"),
    ],
)
def test_page_is_read_in_the_order_of_an_index(
    client: TestClient, wanted: PhotographFilter, index: str
):
    database: Database = client.app.state.runtime.database  # type: ignore[attr-defined]
    with database.engine.connect() as connection:
        for query in (dated_groups(wanted, 50, (now(), 7)), undated_groups(wanted, 50, 7)):
            text = query.compile(connection, compile_kwargs={"literal_binds": True})
            explained = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}").all()
            plan = " ".join(row[-1] for row in explained)
            assert index in plan
            assert "TEMP B-TREE" not in plan


def test_other_verdicts_are_refused(filled: TestClient):
    assert filled.get("/heliostats/AA39?photographs=x").status_code == 422


def test_one_image_that_is_used_makes_a_photograph_used(client: TestClient, post: Post):
    post(png(1, refused=True), id="1", kind="raw")
    post(png(2), id="1", kind="flux")
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        (shot,) = list_groups(session, PhotographFilter(store.get_heliostat(session, "AA39")), 10)
    assert (shot.name, shot.verdict, [row.kind for row in shot.images]) == (
        "1",
        "used",
        ["flux", "raw"],
    )


def test_thumbnail_is_small_and_is_sent_once(client: TestClient, post: Post):
    post(png(1, size=(300, 400)), id="1")
    answer = client.get(f"{HERE}/1/thumbnail.jpg")
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "image/jpeg")
    assert cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR).shape == (
        144,
        192,
        3,
    )
    tag = {"If-None-Match": answer.headers["ETag"]}
    assert client.get(f"{HERE}/1/thumbnail.jpg", headers=tag).status_code == 304
    assert client.get(f"{HERE}/9/thumbnail.jpg").status_code == 404
    assert client.get(f"{HERE}/1/nothing.jpg").status_code == 422


def test_large_photographs_are_decoded_one_at_a_time(
    app: FastAPI, client: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """Ordinary ones pass meanwhile; a second large one waits, and is refused if the first takes too
    long.
    """
    monkeypatch.setattr(runtime, "LARGE_PIXELS", 100 * 100)
    patient: runtime.Runtime = replace(app.state.runtime, timeout_s=0.05)
    large, ordinary = png(1, size=(101, 100)), png(2, size=(100, 100))
    with patient.decoded(large) as pixels:
        assert pixels.shape[:2] == (101, 100)
        for _ in range(5):
            with patient.decoded(ordinary) as others:
                assert others.shape[:2] == (100, 100)
        with pytest.raises(BusyError), patient.decoded(large):
            pass
    with patient.decoded(large):
        pass
    few = replace(
        patient, settings=patient.settings.model_copy(update={"max_image_pixels": 100 * 90})
    )
    with pytest.raises(InvalidInputError, match="more than 9000 allowed"), few.decoded(ordinary):
        pass


def test_thumbnail_is_made_once(client: TestClient, post: Post, monkeypatch: pytest.MonkeyPatch):
    """However long a photograph takes to decode, nobody can have it decoded again and again."""
    post(png(1, size=(300, 400)), id="1")
    first = client.get(f"{HERE}/1/thumbnail.jpg").content
    monkeypatch.delattr(runtime, "decode_image")
    assert client.get(f"{HERE}/1/thumbnail.jpg").content == first


def test_a_photograph_is_decoded_before_it_takes_the_model(
    client: TestClient, post: Post, monkeypatch: pytest.MonkeyPatch
):
    computing, free = client.app.state.runtime.compute_slots, []  # type: ignore[attr-defined]

    def decode(data: bytes, **options: Any) -> Any:
        free.append(computing._free)
        return decode_image(data, **options)

    monkeypatch.setattr(runtime, "decode_image", decode)
    slots = computing._free
    assert post(png(1), id="1").status_code == 201
    assert free == [slots]


class Finder(FakeOperations):
    """Finds the target of a raw photograph in its middle."""

    def measure(self, image: Any, kind: str, plane: Any, **more: Any) -> MeasuredFlux:
        made = super().measure(image, kind, plane, **more)
        if kind != "raw":
            return made
        corners = np.array([[8.0, 8], [24, 8], [8, 24], [24, 24]])
        crop = np.full((256, 256), 99, np.uint8)
        return MeasuredFlux(
            Quality(accepted=True),
            made.flux,
            made.centered,
            made.center_of_mass,
            4.0,
            crop,
            corners,
        )


class TestFound:
    @pytest.fixture
    def operations(self) -> FakeOperations:
        return Finder()

    def test_target_is_outlined_and_straightened(self, client: TestClient, post: Post):
        post(
            cv2.imencode(".png", np.full((32, 32), 200, np.uint8))[1].tobytes(), id="1", kind="raw"
        )
        outlined = cv2.imdecode(
            np.frombuffer(client.get(f"{HERE}/1/outlined.jpg").content, np.uint8), cv2.IMREAD_COLOR
        ).astype(int)
        assert abs(outlined[16, 16] - 200).max() < 12
        assert abs(outlined[16, 8] - 200).max() > 40  # its left edge
        assert f'href="{HERE}/1/large.jpg"' in text_of(client, f"{HERE}/1")
        assert client.get(f"{HERE}/1/large.jpg").headers["Content-Type"] == "image/jpeg"
        crop = cv2.imdecode(
            np.frombuffer(client.get(f"{HERE}/1/crop.jpg").content, np.uint8), cv2.IMREAD_GRAYSCALE
        )
        assert crop.shape == (256, 256)
        assert abs(crop.astype(int) - 99).max() < 3


def test_image_without_a_target_has_no_crop(client: TestClient, post: Post):
    post(png(1), id="1")
    assert client.get(f"{HERE}/1/crop.jpg").status_code == 404


def test_photograph_is_next_to_its_flux_and_the_forecast(filled: TestClient):
    page = text_of(filled, f"{HERE}/1")  # the first that came: raw, forecast by the ideal mirror
    for shown in ("outlined.jpg", "crop.jpg", "measured flux of 1", "forecast flux of 1", "80.0"):
        assert shown in page
    assert len(page.all("lineargradient")) == 3  # flux, forecast and difference
    assert "also as flux" in page.words
    assert [a.words for a in page.all("a") if a["href"].endswith("/1-flux")] == ["flux"]
    refused = text_of(filled, f"{HERE}/2")
    assert "crop.jpg" in refused
    assert "measured flux" not in refused
