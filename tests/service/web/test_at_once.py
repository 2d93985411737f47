"""Several who change the plant at one moment, on both databases; and what was made by mistake is
taken back.
"""

import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, cast

import psycopg
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL, text
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from service import store
from service.base.errors import NotFoundError
from service.base.settings import Settings
from service.store import audit
from service.store.database import Database
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow
from service.web.app import create_app
from service.web.responses.problems import database_away
from tests.service.conftest import QUIET, FakeOperations, client_of, png, poster
from tests.service.web.at_once import at_once
from tests.waiting import WAIT_LIMIT_S

PLANE = {"plane": {"center": [0, -3, 36], "normal": [0, 2, 0], "width": 8.6, "height": 7.2}}
CYLINDER = {
    "center": [0, 0, 55.2],
    "normal": [0, 1, 0],
    "radius": 4.1,
    "height": 5.2,
    "opening_deg": 60,
}


@pytest.fixture
def both(store_url: URL, tmp_path: Path) -> Iterator[TestClient]:
    """A service with an empty store, on each of the two databases."""
    address = store_url.render_as_string(hide_password=False)
    with client_of(
        create_app(Settings(data_dir=tmp_path, database_url=address, **QUIET), FakeOperations())
    ) as client:
        yield client


def test_target_and_receiver_never_have_one_name(both: TestClient):
    for number in range(12):
        name = f"n{number}"
        answers = at_once(
            lambda name=name: both.put(f"/v1/targets/{name}", json=PLANE),
            lambda name=name: both.put(f"/v1/receivers/{name}", json=CYLINDER),
        )
        assert sorted(answer.status_code for answer in answers) == [201, 409]


@pytest.mark.full
def test_plants_in_opposite_orders_do_not_wait_for_each_other(
    both: TestClient, tower: dict[str, Any]
):
    head = {"power_plant_properties": tower["power_plant_properties"]}
    names = [f"t{number}" for number in range(40)]

    def put(order: list[str], turn: int) -> int:
        targets = dict.fromkeys(order, tower[("lower", "upper")[turn % 2]])
        asked = {"reason": "surveyed"}
        return both.put("/v1/plant", json=head | targets, params=asked).status_code

    assert put(names, 0) == 200
    for turn in range(1, 4):
        calls = [
            partial(put, order, turn + place)
            for place, order in enumerate((names, names[::-1]) * 2)
        ]
        assert at_once(*calls) == [200] * 4


def test_heliostat_that_is_posted_twice_at_once_is_never_overwritten(
    both: TestClient, tower: dict[str, Any], properties: dict[str, Any]
):
    assert both.put("/v1/plant", json=tower).status_code == 200
    for number in range(8):
        bodies = [
            {"name": f"AB{number}", "properties": properties | {"note": note}}
            for note in ("one", "two")
        ]
        answers = at_once(
            *(lambda body=body: both.post("/v1/heliostats", json=body) for body in bodies)
        )
        assert sorted(answer.status_code for answer in answers) == [201, 409]
        (first,) = (answer.json() for answer in answers if answer.status_code == 201)
        assert both.get(f"/v1/heliostats/AB{number}").json()["properties"] == first["properties"]
    again = at_once(
        *(lambda: both.post("/v1/heliostats", json={"name": "AC1", "properties": properties}),) * 2
    )
    assert sorted(answer.status_code for answer in again) == [200, 201]


@pytest.mark.parametrize(
    "store_url", [pytest.param("postgres", marks=pytest.mark.postgres)], indirect=True
)
def test_transaction_is_retried_after_a_deadlock(database: Database):
    """A change and an import take two rows in opposite orders: PostgreSQL ends the change."""
    barrier, tried = threading.Barrier(2), list[str]()

    def add(session: Session, name: str) -> None:
        session.query(HeliostatRow).filter_by(name=name).with_for_update().one().east_m += 1
        session.flush()

    def change(session: Session) -> None:
        tried.append("change")
        session.execute(text("SET LOCAL deadlock_timeout = '100ms'"))
        add(session, "A")
        if len(tried) == 1:
            barrier.wait(WAIT_LIMIT_S)
        add(session, "B")

    def bring_in() -> None:
        with database.writing() as session:
            session.execute(text("SET LOCAL deadlock_timeout = '5min'"))
            add(session, "B")
            barrier.wait(WAIT_LIMIT_S)
            add(session, "A")

    with database.writing() as session:
        for name in ("A", "B"):
            store.put_heliostat(session, name, {}, (0, 0, 0))
    at_once(lambda: database.run_in_transaction(change), bring_in)
    with database.reading() as session:
        east = [store.get_heliostat(session, name).east_m for name in ("A", "B")]
    assert (tried, east) == (["change", "change"], [2, 2])


def test_deadlock_is_not_reported_as_unavailable_database():
    scope = {"type": "http", "path": "/v1/plant", "headers": [], "method": "PUT"}
    answer = database_away(
        scope, OperationalError("", {}, psycopg.errors.DeadlockDetected("deadlock detected"))
    )
    assert (answer.status_code, answer.headers["Retry-After"]) == (503, "1")
    assert b"does not answer" not in answer.body
    assert b"send it again" in answer.body


# --- taking back
# --------------------------------------------------------------------------------------------------


def test_what_nothing_refers_to_is_deleted(
    both: TestClient, tower: dict[str, Any], properties: dict[str, Any]
):
    both.put("/v1/plant", json=tower)
    both.put("/v1/targets/screen", json=PLANE)
    both.put("/v1/receivers/drum", json=CYLINDER)
    both.put("/v1/heliostats/AA39", json=properties)
    why = {"reason": "a mistake"}
    for path in ("targets/screen", "receivers/drum", "heliostats/AA39"):
        assert both.delete(f"/v1/{path}", params=why).status_code == 204
        assert both.get(f"/v1/{path}").status_code == 404
        assert both.delete(f"/v1/{path}", params=why).status_code == 404
    # The name is free again, for either.
    assert both.put("/v1/receivers/screen", json=CYLINDER).status_code == 201
    with cast(FastAPI, both.app).state.runtime.database.reading() as session:
        deleted = [
            entry.subject
            for entry in audit.entries(session, 100)
            if entry.action.endswith(".deleted")
        ]
    assert deleted == ["heliostat AA39", "receiver drum", "target screen"]


def test_what_is_referred_to_stays_and_says_by_what(
    both: TestClient, tower: dict[str, Any], properties: dict[str, Any]
):
    both.put("/v1/plant", json=tower)
    both.put("/v1/receivers/drum", json=CYLINDER)
    both.put("/v1/heliostats/AA39", json=properties)
    assert poster(both)(png(1)).status_code == 201
    sun = {"azimuth_deg": 180, "elevation_deg": 45}
    forecast = {
        "heliostat": "AA39",
        "target": "upper",
        "sun": sun,
        "surface": "ideal",
        "resolution": 16,
    }
    assert both.post("/v1/forecasts", json=forecast).status_code == 201
    both.post("/v1/jobs/forecasts", json={"target": "drum", "sun": sun, "surface": "ideal"})
    for path, by in (
        ("targets/lower", "measurements (1)"),
        ("targets/upper", "forecasts (1)"),
        ("receivers/drum", "jobs (1)"),
        ("heliostats/AA39", "measurements (1), forecasts (1)"),
    ):
        answer = both.delete(f"/v1/{path}?reason=mistake")
        assert (answer.status_code, by in answer.json()["detail"]) == (409, True), answer.text
        assert both.get(f"/v1/{path}").status_code == 200


def test_what_is_deleted_meanwhile_is_not_referred_to(database: Database):
    """A photograph that is measured while its heliostat is deleted is refused, and no constraint
    breaks.
    """
    with database.writing() as session:
        row, _ = store.put_heliostat(session, "A", {}, (0, 0, 0))
    with database.writing() as session:
        store.remove_heliostat(session, "A")
    with (
        database.writing() as session,
        pytest.raises(NotFoundError, match="heliostat A was deleted"),
    ):
        store.add_measurement(session, row, ImageRow(), MeasurementRow())
