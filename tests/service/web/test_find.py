"""Finding heliostats: what is looked for, in which order, page by page, on the field's page and
over REST.
"""

import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service import store
from service.base.settings import Settings
from service.store.database import Database
from service.store.surface_versions import NewSurface, Trust
from service.twin.alarms import field_overview
from service.twin.alarms.field_filter import HeliostatFilter, filter_heliostats
from service.twin.alarms.field_overview import (
    ActiveSurface,
    FieldOverviewCache,
    FieldTotals,
    HeliostatOverview,
)
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import Rank
from service.web.app import create_app
from service.web.resources.field import FieldView
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    properties_document,
    tower_document,
    until,
)
from tests.service.web.pages import HTML, settled, text_of
from tests.waiting import WAIT_LIMIT_S

OF_1970 = field_overview.datetime.fromisoformat("2026-01-01T00:00:00+00:00")


def line(
    name: str, deviation: float | None = None, accuracy: float | None = None, **more: Any
) -> HeliostatOverview:
    """A heliostat; with a deviation it has a surface."""
    surface = None if deviation is None else ActiveSurface(1, 1, "refined", OF_1970, 0.1, True, [])
    figures = None if deviation is None else FieldTotals(deviation, None)
    return replace(
        HeliostatOverview(name, 0.0, 1.0, surface=surface, figures=figures, rank=Rank(accuracy, 1)),
        **more,
    )


LINES = [
    line("AA01", 0.3, 0.9, photographs=3),
    line("AA02", 0.1, 0.8, photographs=5, refused=2),
    line("AB01"),
    line(
        "AB02",
        0.3,
        surface=ActiveSurface(2, 4, "network", OF_1970, 0.2, False, ["strange"]),
        rank=Rank(None, 0),
    ),
]


@pytest.mark.parametrize(
    ("wanted", "names"),
    [
        ({}, "AA02 AA01 AB01 AB02"),  # the worst first, what is not known last
        ({"order": "down"}, "AA01 AA02 AB01 AB02"),
        ({"metric": "deviation_mm"}, "AA01 AB02 AA02 AB01"),
        ({"metric": "deviation_mm", "sort": "name"}, "AA01 AA02 AB01 AB02"),
        ({"sort": "name", "order": "down"}, "AB02 AB01 AA02 AA01"),
        ({"sort": "photographs"}, "AA02 AA01 AB01 AB02"),
        ({"sort": "trusted"}, "AB02 AA01 AA02 AB01"),
        ({"sort": "surface_version"}, "AB02 AA01 AA02 AB01"),
        ({"search": "ab"}, "AB01 AB02"),
        ({"search": "01", "sort": "name"}, "AA01 AB01"),
        ({"show": "flagged"}, "AB02"),
        ({"show": "unacknowledged"}, "AB02"),
        ({"show": "trusted"}, "AA02 AA01"),
        ({"show": "no_surface"}, "AB01"),
        ({"show": "surface", "sort": "name"}, "AA01 AA02 AB02"),
        ({"show": "unjudged"}, "AB02"),
        ({"show": "refused"}, "AA02"),
        ({"show": "no_photographs"}, "AB01 AB02"),
        ({"low": 85}, "AA01"),
        ({"low": 80, "high": 85}, "AA02"),
        ({"metric": "deviation_mm", "high": 0.2}, "AA02"),
        (
            {"metric": "deviation_mm", "low": "", "high": "", "search": "", "show": "", "sort": ""},
            "AA01 AB02 AA02 AB01",
        ),
    ],
)
def test_what_is_wanted_is_found_in_its_order(wanted: dict[str, Any], names: str):
    assert (
        " ".join(
            one.name for one in filter_heliostats(LINES, HeliostatFilter.model_validate(wanted))
        )
        == names
    )


def test_every_view_has_an_address():
    view = FieldView.model_validate({"search": "A", "metric": "age_days", "page": 3})
    assert view.link() == "/?search=A&metric=age_days"
    assert view.link(page=4) == "/?page=4&search=A&metric=age_days"
    assert FieldView().link() == FieldView().link(search=None) == "/"
    assert FieldView().sorted_by("accuracy") == "/?sort=accuracy&order=down"
    assert FieldView(sort="name").sorted_by("name") == "/?sort=name&order=down"
    assert FieldView(sort="name", order="down").sorted_by("name") == "/?sort=name"
    assert FieldView(sort="name", order="down").sorted_by("refused") == "/?sort=refused"


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """250 heliostats; each tenth has a surface, which is not trusted of each hundredth."""
    app = create_app(Settings(data_dir=tmp_path_factory.mktemp("large"), **QUIET), FakeOperations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        with app.state.runtime.database.writing() as session:
            for number in range(250):
                place = (6.0 * (number % 25), 6.0 * (number // 25), 1.0)
                row, _ = store.put_heliostat(session, f"H{number:03}", properties_document(), place)
                if number % 10 == 0:
                    store.add_surface(session, row, surface(number / 1e6, number % 100 == 0))
        client.headers.update(HTML)
        yield client


def surface(height: float, is_doubted: bool) -> NewSurface:
    z = field_overview.np.full((4, 8, 8), height)
    warnings = ("it is strange",) if is_doubted else ()
    points, trust = field_overview.np.stack([z, z, z], -1), Trust(warnings, (), 1.0, 40.0)
    return NewSurface("refined", z, 0 * z, points, datetime.now(UTC), trust=trust)


def names_in(page: Page) -> list[str]:
    rows = page.all("th", scope="row")
    return [link["href"].removeprefix("/heliostats/") for row in rows for link in row.all("a")]


def test_table_comes_in_pages_of_a_hundred(large: TestClient):
    first = settled(large, "/?sort=name")
    assert names_in(first) == [f"H{number:03}" for number in range(100)]
    assert "1 to 100 of 250" in first
    assert 'rel="next" href="/?page=2&amp;sort=name"' in first
    assert 'rel="prev"' not in first
    last = text_of(large, "/?sort=name&page=3")
    assert names_in(last) == [f"H{number:03}" for number in range(200, 250)]
    assert 'rel="next"' not in last
    assert names_in(text_of(large, "/?sort=name&page=99")) == names_in(last)
    assert len(first.encode()) < 100_000


def test_map_shows_all_and_highlights_matches(large: TestClient):
    def drawn(page: Page, kind: str) -> int:
        return sum(path["d"].count("M") for path in page.all("path", class_=kind))

    page = settled(large)
    assert (drawn(page, "mirrors"), drawn(page, "left-out"), drawn(page, "flagged")) == (250, 0, 3)
    page = settled(large, "/?show=flagged&metric=deviation_mm")
    assert (drawn(page, "mirrors"), drawn(page, "left-out")) == (3, 247)
    assert names_in(page) == ["H200", "H100", "H000"]
    assert '<a class="button" href="/?metric=deviation_mm">All</a>' in page
    none = text_of(large, "/?search=nobody")
    assert "0 of 250 heliostats" in none
    assert (drawn(none, "mirrors"), drawn(none, "left-out")) == (0, 250)


def test_columns_lead_to_their_order_and_back(large: TestClient):
    page = settled(large, "/?metric=deviation_mm")
    (link,) = page.one("th", aria_sort="descending").all("a")
    assert link["href"] == "/?metric=deviation_mm&sort=deviation_mm&order=up"
    assert names_in(page)[:2] == ["H240", "H230"]
    assert names_in(text_of(large, "/?metric=deviation_mm&sort=deviation_mm&order=up"))[:2] == [
        "H000",
        "H010",
    ]


@pytest.mark.parametrize(
    "query", ["show=x", "sort=x", "order=x", "page=0", "low=nan", "high=x", f"search={'x' * 33}"]
)
def test_question_that_makes_no_sense_is_refused(large: TestClient, query: str):
    for path in ("/", "/v1/field"):
        if not (path == "/v1/field" and query == "page=0"):
            answer = large.get(f"{path}?{query}")
            assert answer.status_code == 422
            assert query.partition("=")[0] in answer.text


def test_rest_has_the_same_field(large: TestClient):
    settled(large)
    found = large.get(
        "/v1/field", params={"show": "surface", "metric": "deviation_mm", "limit": 3}
    ).json()
    assert [item["name"] for item in found["items"]] == ["H240", "H230", "H220"]
    assert found["items"][0] == {
        "name": "H240",
        "position_m": [90.0, 54.0],
        "accuracy": None,
        "judged_by": None,
        "deviation_mm": pytest.approx(0.24),
        "uncertainty_mm": None,
        "misfit": None,
        "sun_span_deg": 40.0,
        "age_days": pytest.approx(0, abs=1),
        "pointing_error_mrad": None,
        "surface_version": 1,
        "source": "refined",
        "trusted": True,
        "warnings": [],
        "warned_since": None,
        "acknowledged_by": None,
        "photographs": 0,
        "refused": 0,
    }
    names, after = [], None
    while True:
        page = large.get(
            "/v1/field", params={"sort": "name", "limit": 99} | ({"after": after} if after else {})
        ).json()
        names += [item["name"] for item in page["items"]]
        after = page["next"]
        if after is None:
            break
    assert names == [f"H{number:03}" for number in range(250)]
    assert large.get("/v1/field?show=flagged&after=H001").status_code == 404


def test_rest_finds_names_by_a_part(large: TestClient):
    found = large.get("/v1/heliostats?search=24").json()["items"]
    assert [item["name"] for item in found] == [
        "H024",
        "H124",
        "H224",
        *(f"H{number}" for number in range(240, 250)),
    ]
    assert large.get("/v1/heliostats?search=%25").json()["items"] == []


# --- what is read once
# ------------------------------------------------------------------------------------------------


@pytest.fixture
def cache(database: Database, settings: Settings) -> Iterator[FieldOverviewCache]:
    runtime = Runtime.from_settings(
        settings.model_copy(update={"database_url": str(database.url)}), FakeOperations()
    )
    made = FieldOverviewCache(runtime)
    made._runtime = replace(runtime, database=database)
    yield made
    made.close()
    runtime.close()


def put(database: Database, name: str) -> None:
    with database.writing() as session:
        store.put_heliostat(session, name, properties_document(), (1.0, 2.0, 3.0))


def now(cache: FieldOverviewCache, database: Database) -> tuple[list[str], bool]:
    with database.reading() as session:
        found = cache.read(session)
    return [one.name for one in found.lines], found.is_behind


def test_changed_part_of_the_field_is_read_again(
    cache: FieldOverviewCache, database: Database, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(field_overview, "_QUICK_S", WAIT_LIMIT_S)  # no field is large
    reads, read = [], field_overview.read_summaries
    monkeypatch.setattr(
        field_overview, "read_summaries", lambda session: reads.append(1) or read(session)
    )
    put(database, "AA01")
    assert [now(cache, database) for _ in range(3)] == [(["AA01"], False)] * 3
    assert len(reads) == 1
    put(database, "AA02")
    assert [now(cache, database) for _ in range(3)] == [(["AA01", "AA02"], False)] * 3
    assert len(reads) == 2


def test_large_field_is_shown_as_it_was_until_it_is_read(
    cache: FieldOverviewCache, database: Database, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(field_overview, "_QUICK_S", 0.0)  # every field is large
    put(database, "AA01")
    assert now(cache, database) == (["AA01"], False)
    go, read = threading.Event(), field_overview.read_summaries
    monkeypatch.setattr(
        field_overview, "read_summaries", lambda session: go.wait(WAIT_LIMIT_S) and read(session)
    )
    put(database, "AA02")
    assert now(cache, database) == (["AA01"], True)
    go.set()
    until(lambda: now(cache, database) == (["AA01", "AA02"], False))


def test_transaction_that_ends_late_is_seen(database: Database):
    """It began before others, whose rows have higher numbers."""
    from service.store.tables import HeliostatRow

    def row(number: int) -> HeliostatRow:
        properties = properties_document()
        return HeliostatRow(
            id=number, name=f"H{number}", properties=properties, east_m=0.0, north_m=0.0, up_m=0.0
        )

    with database.writing() as session:
        session.add(row(2))
    with database.reading() as session:
        before = field_overview.read_marks(session)
    with database.writing() as session:
        session.add(row(1))
    with database.reading() as session:
        assert field_overview.read_marks(session) != before


def test_app_has_the_field(app: FastAPI) -> None:
    assert "/v1/field" in app.openapi()["paths"]
