"""Pages at a plant of 3000 heliostats: none carries all names, and nothing large is read to see if
it is there.
"""

import re
from collections.abc import Iterator

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service import store
from service.base.settings import Settings
from service.store import queue
from service.store.mounts import CalibrationState
from service.twin import calibration
from service.twin.caches import RecentResults
from service.web.app import create_app
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.statements import statements
from tests.service.studies import SLOPE
from tests.service.web.pages import HTML, form, keep_study, text_of

NAMES = [f"H{number:04d}" for number in range(3000)]


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(data_dir=tmp_path_factory.mktemp("large"), **QUIET), FakeOperations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA_39", json=properties_document())
        with app.state.runtime.database.writing() as session:
            for number, name in enumerate(NAMES):
                store.put_heliostat(
                    session, name, properties_document(), (number % 60, number // 60 + 30.0, 1.0)
                )
            queue.add_job(session, "predictions", {"heliostats": NAMES}, "tester")
            job = queue.claim(session, ["predictions"], "tester", 60.0, 3)
            assert job is not None
            half = (
                dict.fromkeys(NAMES[:1500], 1),
                dict.fromkeys(NAMES[1500:], "no photograph was accepted"),
            )
            queue.finish(session, queue.lease_of(job), {"surfaces": half[0], "skipped": half[1]})
        poster(client)(png(1), heliostat="H0000")
        sun = {"azimuth_deg": 200, "elevation_deg": 45}
        client.post(
            "/v1/forecasts",
            json={"heliostat": "H0000", "target": "lower", "sun": sun, "surface": "ideal"},
        )
        client.headers.update(HTML)
        yield client


PATHS = (
    "/forecast",
    "/forecast?heliostat=H2999",
    "/forecasts/1",
    "/heliostats/H0000",
    "/alarms",
    "/jobs",
    "/jobs/1",
    "/studies",
)


@pytest.mark.full
@pytest.mark.parametrize("path", PATHS)
def test_page_does_not_grow_with_the_field(large: TestClient, path: str):
    page = text_of(large, path)
    assert len(page.encode()) < 100_000
    assert len(set(re.findall(r"H\d{4}", page))) <= 201


def test_form_offers_names_that_begin_so(large: TestClient):
    def offered(**query: str) -> list[str]:
        answer = large.get("/forecast/heliostats", params=query)
        return [option["value"] for option in Page(answer.text).all("option")]

    assert offered()[:2] == ["AA_39", "H0000"]
    assert offered(heliostat="h29") == NAMES[2900:2920]
    assert offered(heliostat="H29", after="H2919") == NAMES[2920:2940]
    assert offered(heliostat="AA_") == ["AA_39"]
    assert offered(heliostat="H_") == offered(heliostat="%") == offered(heliostat="<script>") == []
    assert [
        item["name"] for item in large.get("/v1/heliostats?prefix=h299").json()["items"]
    ] == NAMES[2990:]
    page = text_of(large, "/forecast?heliostat=H2999")
    field = page.one("input", name="heliostat")
    assert (field["value"], field["list"]) == ("H2999", "offered")


def test_name_that_is_typed_and_wrong_is_said(large: TestClient):
    answer = large.post("/forecast", data=form(heliostat="H9999", surface="ideal"))
    assert answer.status_code == 404
    assert "there is no heliostat H9999" in answer.text
    assert (
        large.post(
            "/forecast", data=form(heliostat="H2999", surface="ideal"), follow_redirects=False
        ).status_code
        == 303
    )


def test_page_of_a_study_does_not_read_its_report(large: TestClient):
    app: FastAPI = large.app  # type: ignore[assignment]
    number = keep_study(app, SLOPE)
    with statements(app.state.runtime.database) as sent:
        assert "Open the report" in text_of(large, f"/studies/{number}")
    assert not [line for line in sent if re.search(r"studies\.html(?! IS NOT NULL)", line)]


def test_calibration_plan_looks_at_a_few_heliostats_of_all_over_the_field(
    large: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """Each that is looked at costs milliseconds; 20,000 held a request's place before the model for
    minutes.
    """
    seen = []
    look = calibration.with_drive_zeros
    monkeypatch.setattr(
        calibration,
        "with_drive_zeros",
        lambda row, origin: (seen.append(row.name), look(row, origin))[1],
    )
    answer = large.get("/v1/calibration-plan?at=2026-06-21T10:00:00Z&photographs=60").json()
    assert len({item["heliostat"] for item in answer["items"]}) == 60
    assert len(seen) == 128
    assert min(seen) < "H0100"
    assert max(seen) > "H2900"


def test_candidates_of_a_plan_are_unknown_or_known_by_little_or_from_long_ago():
    def state(number: int, measurements: int, year: int) -> CalibrationState:
        return CalibrationState(
            f"H{number:04}", measurements, f"{year}-05-01T12:00:00+00:00" if measurements else None
        )

    common = [state(number, 40, 2026) for number in range(100)]
    few, old = (
        [state(200, 3, 2026), state(201, 4, 2026)],
        [state(300, 40, 2019), state(301, 40, 2020)],
    )
    never = [state(400 + number, 0, 0) for number in range(9)]
    chosen = calibration.plan_candidates([*common, *few, *old, *never], 2)
    assert chosen == ["H0400", "H0408", "H0200", "H0201", "H0300", "H0301"]
    assert calibration.plan_candidates([*few, *old], 2) == ["H0200", "H0201", "H0300", "H0301"]


def test_results_of_a_large_field_are_reused_for_a_while(
    large: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """Each computes over all heliostats; a dashboard that asks without a pause kept others waiting
    for seconds.
    """
    computed = []
    assert (
        large.get("/v1/field").status_code == 200
    )  # how large the field is, is known once it was read
    app: FastAPI = large.app  # type: ignore[assignment]
    monkeypatch.setattr(app.state.field, "_recent", RecentResults(600.0))
    monkeypatch.setattr(
        "service.web.resources.field.filter_heliostats",
        lambda lines, wanted: (computed.append("field"), lines)[1],
    )
    for path in ("/v1/field", "/v1/field?limit=2"):
        for _ in range(3):
            assert large.get(path).status_code == 200, path
    assert computed == ["field"]
    poster(large)(png(2), heliostat="H0001")
    large.get("/v1/field")
    assert computed == ["field", "field"]
