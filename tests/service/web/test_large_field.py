"""Pages at a plant of 3000 heliostats: none carries all names, and nothing large is read to see if it is there."""

import re
from collections.abc import Iterator

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service import store
from service.base.settings import Settings
from service.store import queue
from service.web.app import create_app
from tests.service.conftest import QUIET, FakeOperations, client_of, png, poster, properties_document, tower_document
from tests.service.store.test_statements import statements
from tests.service.twin.test_versions import SLOPE
from tests.service.web.test_pages import HTML, form, keep_study, text_of

NAMES = [f"H{number:04d}" for number in range(3000)]


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(data_dir=tmp_path_factory.mktemp("large"), **QUIET), FakeOperations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA_39", json=properties_document())
        with app.state.runtime.database.writing() as session:
            for number, name in enumerate(NAMES):
                store.put_heliostat(session, name, properties_document(), (number % 60, number // 60 + 30.0, 1.0))
            queue.add_job(session, "predictions", {"heliostats": NAMES}, "tester")
            job = queue.claim(session, ["predictions"], "tester", 60.0, 3)
            assert job is not None
            half = dict.fromkeys(NAMES[:1500], 1), dict.fromkeys(NAMES[1500:], "no photograph was accepted")
            queue.finish(session, queue.lease_of(job), {"surfaces": half[0], "skipped": half[1]})
        poster(client)(png(1), heliostat="H0000")
        sun = {"azimuth_deg": -20, "elevation_deg": 45}
        client.post("/v1/forecasts", json={"heliostat": "H0000", "target": "lower", "sun": sun, "surface": "ideal"})
        client.headers.update(HTML)
        yield client


PATHS = (
    "/forecast",
    "/forecast?heliostat=H2999",
    "/forecasts/1",
    "/heliostats/H0000",
    "/attention",
    "/jobs",
    "/jobs/1",
    "/studies",
)


@pytest.mark.parametrize("path", PATHS)
def test_page_does_not_grow_with_the_field(large: TestClient, path: str):
    page = text_of(large, path)
    assert len(page.encode()) < 100_000
    assert len(set(re.findall(r"H\d{4}", page))) <= 201


def test_form_offers_names_that_begin_so(large: TestClient):
    def offered(**query: str) -> list[str]:
        return re.findall(r'<option value="([^"]*)">', large.get("/forecast/heliostats", params=query).text)

    assert offered()[:2] == ["AA_39", "H0000"]
    assert offered(heliostat="h29") == NAMES[2900:2920]
    assert offered(heliostat="H29", after="H2919") == NAMES[2920:2940]
    assert offered(heliostat="AA_") == ["AA_39"]
    assert offered(heliostat="H_") == offered(heliostat="%") == offered(heliostat="<script>") == []
    assert [item["name"] for item in large.get("/v1/heliostats?prefix=h299").json()["items"]] == NAMES[2990:]
    page = text_of(large, "/forecast?heliostat=H2999")
    assert re.search(r'<input name="heliostat" value="H2999" list="offered"', page)


def test_name_that_is_typed_and_wrong_is_said(large: TestClient):
    answer = large.post("/forecast", data=form(heliostat="H9999", surface="ideal"))
    assert answer.status_code == 404
    assert "there is no heliostat H9999" in answer.text
    assert (
        large.post("/forecast", data=form(heliostat="H2999", surface="ideal"), follow_redirects=False).status_code
        == 303
    )


def test_page_of_a_study_does_not_read_its_report(large: TestClient):
    app: FastAPI = large.app  # type: ignore[assignment]
    number = keep_study(app, SLOPE)
    with statements(app.state.runtime.database) as sent:
        assert "Open the report" in text_of(large, f"/studies/{number}")
    assert not [line for line in sent if re.search(r"studies\.html(?! IS NOT NULL)", line)]
