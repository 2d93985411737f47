"""Workers write the state of heliostats and the alarms, whether or not anybody reads."""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL, func, select, update

from model.ephemeris import sun_angles_at
from service.base.settings import Settings
from service.store import acknowledgements, field_state
from service.store.columns import now
from service.store.job_tables import AlarmRow
from service.store.tables import HeliostatRow, HeliostatStateRow
from service.twin.alarms.field_updates import FieldStateWriter
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import (
    ORIGIN,
    QUIET,
    client_of,
    png,
    poster,
    properties_document,
    sun_at,
    tower_document,
    until,
)
from tests.service.web.test_alarms import Blind

WORKING = QUIET | {"job_workers": 1, "job_poll_s": 0.05}
BEGIN = (now() - timedelta(days=1)).replace(hour=11, minute=0, second=0, microsecond=0)


@pytest.fixture
def model() -> Blind:
    return Blind()


@pytest.fixture(params=[QUIET, WORKING], ids=["read later", "with workers"])
def app(request: pytest.FixtureRequest, store_url: URL, tmp_path: Path, model: Blind) -> FastAPI:
    return create_app(
        Settings(
            data_dir=tmp_path,
            database_url=store_url.render_as_string(hide_password=False),
            **request.param,
        ),
        model,
    )


@pytest.fixture
def client(app: FastAPI, model: Blind) -> Iterator[TestClient]:
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        model.is_blind = False
        photograph(client, 0)
        client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
        yield client


def photograph(client: TestClient, hour: int) -> datetime:
    """Send a photograph of yesterday; return its time."""
    taken_at = BEGIN + timedelta(hours=hour / 4)
    sun = sun_at(*sun_angles_at(taken_at, ORIGIN))
    sent = poster(client)(png(hour + 1), id=str(hour), taken_at=taken_at.isoformat(), sun=sun)
    assert sent.status_code == 201, sent.text
    return taken_at


def rows(app: FastAPI) -> list[AlarmRow]:
    """Alarms as they are stored: no reader of the service takes part."""
    with app.state.runtime.database.reading() as session:
        return list(session.scalars(select(AlarmRow).order_by(AlarmRow.since)))


def history(client: TestClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get("/v1/alarms/history?reason=accuracy").json()["items"]
    return found


def test_alarm_that_begins_and_ends_between_two_readers_has_the_times_of_the_data(
    client: TestClient, model: Blind
):
    """Even if both photographs came before a worker looked."""
    model.is_blind = True
    began = photograph(client, 1)
    photograph(client, 2)
    model.is_blind = False
    ended = photograph(client, 3)
    photograph(client, 4)
    until(lambda: client.get("/v1/alarms").json()["pending"] == 0)
    (entry,) = history(client)
    assert (entry["reason"], entry["heliostat"]) == ("accuracy", "AA39")
    assert datetime.fromisoformat(entry["since"]) == began
    assert datetime.fromisoformat(entry["ended_at"]) == ended
    assert datetime.fromisoformat(entry["recorded_at"]) > now() - timedelta(minutes=10)
    assert client.get("/v1/alarms?reason=accuracy").json()["items"] == []


@pytest.mark.parametrize("app", [WORKING], indirect=True, ids=["with workers"])
def test_state_and_alarms_are_written_though_nobody_reads(
    app: FastAPI, client: TestClient, model: Blind
):
    model.is_blind = True
    began = photograph(client, 1)
    until(lambda: any(row.reason == "accuracy" for row in rows(app)), "the alarm is written")
    model.is_blind = False
    ended = photograph(client, 2)
    until(lambda: all(row.ended_at for row in rows(app)), "its end is written")
    (row,) = rows(app)
    assert (row.since, row.ended_at) == (began, ended)

    def state() -> HeliostatStateRow | None:
        with app.state.runtime.database.reading() as session:
            return session.scalar(
                select(HeliostatStateRow).where(HeliostatStateRow.accuracy_key.is_not(None))
            )

    until(lambda: client.get("/v1/alarms").json()["pending"] == 0, "the state is written")
    (line,) = client.get("/v1/field").json()["items"]
    found = state()
    assert found is not None
    assert (line["accuracy"], line["deviation_mm"]) == (
        pytest.approx(found.accuracy),
        pytest.approx(found.deviation_mm),
    )


def test_accuracy_on_arrival_is_traced_again_only_after_a_change_of_what_it_is_based_on(
    client: TestClient, model: Blind, monkeypatch: pytest.MonkeyPatch
):
    render, traced = model.render, list[int]()

    def count(heliostat: Any, observations: Any, *others: Any, **options: Any) -> Any:
        traced.append(len(observations))
        return render(heliostat, observations, *others, **options)

    def accuracy() -> Any:
        until(lambda: client.get("/v1/alarms").json()["pending"] == 0)
        (line,) = client.get("/v1/field").json()["items"]
        return line["accuracy"]

    assert accuracy() is None  # the surface was computed from the only photograph
    monkeypatch.setattr(model, "render", count)
    model.is_blind = True
    photograph(client, 1)
    poor = accuracy()
    assert traced == [1]  # on arrival
    model.is_blind = False
    assert client.put("/v1/heliostats/AA39", json=properties_document()).status_code == 200
    assert accuracy() == poor
    changed = properties_document()
    changed["heliostat_position"][2] += 0.1
    answer = client.put("/v1/heliostats/AA39?reason=surveyed", json=changed)
    assert answer.status_code == 200, answer.text
    assert accuracy() > poor
    assert sum(traced) == 3  # both photographs again


@pytest.fixture
def stale(store_url: URL, tmp_path: Path) -> Iterator[Runtime]:
    """A store with a heliostat that nobody photographed for a year, and no service beside it."""
    settings = Settings(
        data_dir=tmp_path, database_url=store_url.render_as_string(hide_password=False), **QUIET
    )
    with client_of(create_app(settings, Blind())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        runtime = client.app.state.runtime  # type: ignore[attr-defined]
        with runtime.database.writing() as session:
            long_ago = now() - timedelta(days=365)
            session.execute(update(HeliostatRow).values(created_at=long_ago))
        yield runtime


def test_two_workers_write_an_alarm_once(stale: Runtime):
    writers = [FieldStateWriter(stale) for _ in range(2)]
    begin = threading.Barrier(2)

    def work(writer: FieldStateWriter) -> None:
        for _ in range(5):
            begin.wait()
            writer.update()

    threads = [threading.Thread(target=work, args=(writer,)) for writer in writers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with stale.database.reading() as session:
        assert session.scalar(select(func.count()).select_from(AlarmRow)) == 1


def test_worker_that_read_before_another_wrote_writes_nothing(
    stale: Runtime, monkeypatch: pytest.MonkeyPatch
):
    slow, quick = FieldStateWriter(stale), FieldStateWriter(stale)
    read = slow._read

    def read_early() -> Any:
        """The other worker sees that a photograph ended the alarm."""
        reading = read()
        with stale.database.writing() as session:
            session.execute(update(HeliostatRow).values(created_at=now()))
        quick.update()
        return reading

    monkeypatch.setattr(slow, "_read", read_early)
    slow.update()
    with stale.database.reading() as session:
        assert acknowledgements.open_alarms(session) == []
        assert field_state.read_field_state(session).revision > 0


class _OneRound(threading.Event):
    """Ends with the first rest, and keeps its length [s]."""

    def wait(self, timeout: float | None = None) -> bool:
        self.rest_s = timeout or 0.0
        self.set()
        return True


@pytest.mark.parametrize("computed", [0, 1])
def test_worker_rests_after_all_is_computed(
    stale: Runtime, monkeypatch: pytest.MonkeyPatch, computed: int
):
    """Photographs that come all the time do not keep the processor from requests."""
    writer, stopping = FieldStateWriter(stale), _OneRound()
    read = writer._read

    def read_slowly() -> Any:
        time.sleep(0.3)
        reading = read()
        return reading._replace(
            lines=[replace(one, pending={"surface": 1}) for one in reading.lines]
        )

    monkeypatch.setattr(writer, "_read", read_slowly)
    monkeypatch.setattr(writer, "_compute", lambda *_: computed)
    writer.run(stopping)
    assert stopping.rest_s >= 0.9 if computed else stopping.rest_s == 0
