"""What each page shows of a store that the service filled: ``pytest --snapshot-update`` renews it.

Numbers with decimals and digests are masked: they are results, which other
tests check, and they differ in their last digit between processors.
"""

import re
from collections.abc import Iterator
from datetime import UTC, datetime, tzinfo
from typing import Any

import pytest
from fastapi.testclient import TestClient
from syrupy.assertion import SnapshotAssertion

from service.base.settings import Settings
from service.store import columns
from service.web.app import create_app
from tests.page import Page, lines_of
from tests.service.access import bearer, make_key
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    sun_at,
    tower_document,
)
from tests.service.spots import photographs
from tests.service.studies import SLOPE
from tests.service.web.pages import HTML, form, keep_study, settled, work
from tests.service.web.plans import DAY, DRUM
from tests.waiting import until

MASKS = {
    r"(?: \N{MIDDLE DOT} )?[^\[\]\n\N{MIDDLE DOT}]*\[/docs/guide[^\]]*\]": "",  # if it is built
    r"/\S*/texts\d+/": "/",
    r"htw_\w+": "htw_(key)",
    r"\b(?=[a-f]*\d)[0-9a-f]{8,64}\b": "(digest)",
    r"[-\N{MINUS SIGN}]?\d+\.\d+(e[-+]?\d+)?": "0.0",
}


class Frozen(datetime):
    """A clock with one fixed time: ages on pages do not change."""

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> "Frozen":
        return cls(2026, 6, 21, 9, 0, tzinfo=tz or UTC)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A plant of three heliostats with all that pages show, made by requests and jobs."""
    root = tmp_path_factory.mktemp("texts")
    (root / "import" / "plant").mkdir(parents=True)
    settings = Settings(data_dir=root / "data", import_root=root / "import", **QUIET)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "datetime", Frozen)
        with client_of(create_app(settings, FakeOperations())) as client:
            _fill(client)
            yield client


def _fill(client: TestClient) -> None:
    app: Any = client.app
    _send_plant(client)
    _send_photographs(client)
    jobs = {
        "calibrations": {},
        "predictions": {"heliostats": ["AA39"], "method": "refined"},
        "forecasts": {"target": "lower", "sun": sun_at(), "dni_w_m2": 900},
        "plans": DAY | {"step_minutes": 120, "allowed_w_m2": 1.5},
        "imports": {"folder": "plant"},
    }
    for kind, body in jobs.items():
        answer = client.post(f"/v1/jobs/{kind}", json=body)
        assert answer.status_code == 202, answer.text
    work(app)
    forecast = {"heliostat": "AA39", "target": "lower", "sun": sun_at()}
    assert client.post("/v1/forecasts", json=forecast).status_code == 201
    for effects, verdict in (([SLOPE], None), ([SLOPE], "unexplained"), ([], None)):
        keep_study(app, *effects, verdict=verdict)
    assert client.post("/v1/studies/1/adopt", json={}).status_code == 201
    client.headers.update(HTML)
    for path in ("/", "/heliostats/AA39", "/alarms"):
        settled(client, path)
    client.headers.update(bearer(make_key(app, "operator", "admin")))


def _send_plant(client: TestClient) -> None:
    tower = tower_document() | {"declared": {"cameras": [{"transfer": {"gamma": 2.0}}]}}
    assert client.put("/v1/plant", json=tower).status_code == 200
    for name in ("AA39", "AB01", "AB02"):
        assert client.put(f"/v1/heliostats/{name}", json=properties_document()).status_code == 201
    assert client.put("/v1/receivers/drum", json=DRUM).status_code in (200, 201)


def _send_photographs(client: TestClient) -> None:
    post, base = poster(client), "/v1/heliostats/AA39/measurements"
    for number, one in enumerate(photographs(tower_document(), properties_document())):
        assert post(png(number), heliostat="AA39", **one).status_code == 201
    for seed, given in enumerate(
        ({"id": "101", "taken_at": "2026-06-01T10:00:00Z"}, {"id": "102"}, {"id": "103"})
    ):
        assert post(png(100 + seed, refused=seed == 1), **given).status_code == 201
    assert post(png(200), heliostat="AB01", id="201").status_code == 201
    for used in (["101"], ["0", "1", "2"]):
        body = {"method": "network", "measurements": used}
        assert client.post("/v1/heliostats/AA39/surfaces", json=body).status_code == 201
    changes = {"excluded": True, "reason": "a cloud"}
    assert client.patch(f"{base}/103", json=changes).status_code == 200
    changes = {"taken_at": "2026-06-01T11:00:00Z", "reason": "the clock"}
    assert client.patch(f"{base}/101", json=changes).status_code == 200


PATHS = [
    "/",
    "/?metric=age_days",
    "/alarms",
    "/alarms?acknowledged=true",
    "/alarms/history",
    "/calibration-plan",
    "/compare",
    "/compare?heliostat=AA39",
    "/compare?heliostat=AB01",
    "/forecast",
    "/forecast?heliostat=AA39",
    "/forecasts/1",
    "/heliostats/AA39",
    "/heliostats/AA39?version=1",
    "/heliostats/AB01",
    "/heliostats/AB02",
    "/heliostats/AA39/photographs/101",
    "/heliostats/AA39/photographs/102",
    "/heliostats/AA39/photographs/103",
    "/heliostats/none",
    "/jobs",
    "/jobs/start",
    "/jobs/1",
    "/jobs/2",
    "/jobs/3",
    "/jobs/4",
    "/jobs/5",
    "/login",
    "/photographs",
    "/photographs?heliostat=AB02",
    "/photographs/review",
    "/photographs/times",
    "/photographs/upload",
    "/plans",
    "/plans/4",
    "/plant",
    "/plant/audit",
    "/plant/keys",
    "/studies",
    "/studies/1",
    "/studies/2",
    "/studies/3",
    "/studies/new",
]


def shown_lines(text: str) -> str:
    """The lines of a page's main part, masked."""
    lines = "\n".join(lines_of(Page(text).one("main")))
    for pattern, mask in MASKS.items():
        lines = re.sub(pattern, mask, lines)
    return lines.strip()


@pytest.mark.parametrize("path", PATHS)
def test_page_shows(filled: TestClient, path: str, snapshot: SnapshotAssertion):
    def text() -> str | None:
        page = filled.get(path).text
        return None if "being computed" in page else page

    assert shown_lines(until(text, "nothing is being computed")) == snapshot


def test_navigation(filled: TestClient, snapshot: SnapshotAssertion):
    lines = lines_of(Page(filled.get("/").text).one("header"))
    assert [line for line in lines if "/docs/guide" not in line] == snapshot  # if it is built


def test_forms_repeat_what_was_given_and_say_what_is_wrong(
    filled: TestClient, snapshot: SnapshotAssertion
):
    answer = filled.post("/forecast", data=form(elevation_deg="91"))
    assert (answer.status_code, shown_lines(answer.text)) == (422, snapshot)
