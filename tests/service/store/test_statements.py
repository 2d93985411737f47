"""How many SQL statements a read takes: as many for fifty rows as for two, and no transaction beside the disk."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, inspect

from service import store
from service.base.arrays import pack
from service.store.check import inspect_store
from service.store.database import Database
from service.store.images import ImageStore
from service.store.surfaces import NewSurface
from service.store.tables import ForecastRow, HeliostatRow, SurfaceRow
from service.twin import versions
from service.twin.accuracy import unseen_first
from service.twin.evidence import named_measurements
from service.twin.study import StudyRequest, gather
from tests.service.conftest import ORIGIN, properties_document
from tests.service.store.test_queries import PLANE, new
from tests.service.twin.test_versions import GAMMA, add, adopt


@contextmanager
def statements(database: Database) -> Iterator[list[str]]:
    """Those that are sent to the database meanwhile."""
    sent: list[str] = []

    def note(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        if not statement.startswith(("BEGIN", "PRAGMA")):
            sent.append(statement)

    event.listen(database.engine, "before_cursor_execute", note)
    try:
        yield sent
    finally:
        event.remove(database.engine, "before_cursor_execute", note)


def fill(database: Database, count: int) -> list[str]:
    """A heliostat with so many measurements and a surface of all of them; their identifiers."""
    arrays = pack({"centered": np.ones((64, 64), np.float32), "flux": np.ones((8, 8), np.float32)})
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        target, _ = store.put_target(session, PLANE)
        heliostat, _ = store.put_heliostat(session, "AA39", properties_document(), (1, 2, 3))
        rows = []
        for number in range(count):
            about = {"external_id": f"m{number}", "sun_azimuth_deg": 3.0 * number, "arrays": arrays}
            image, row = new(target, f"{number:02x}" * 32, **about, center_right_m=0.0, center_up_m=0.0)
            image.sha256 = f"{number:064x}"
            rows.append(store.add_measurement(session, heliostat, image, row)[0])
        z = np.zeros((4, 8, 8))
        points = np.zeros((4, 8, 8, 3))
        surface, _ = store.add_surface(session, heliostat, NewSurface("measured", z, z, points, measurements=rows))
        for _ in range(count):
            store.add_forecast(session, _forecast(heliostat, surface))
    return [row.identifier for row in rows]


def _forecast(heliostat: HeliostatRow, surface: SurfaceRow) -> ForecastRow:
    numbers = ("sun_azimuth_deg", "sun_elevation_deg", "dni_w_m2", "peak_w_m2", "power_w")
    return ForecastRow(
        heliostat_id=heliostat.id,
        surface_id=surface.id,
        plane={},
        normalised=False,
        rows=8,
        columns=8,
        model_version="1:none",
        flux=b"",
        **dict.fromkeys(numbers, 1.0),
    )


def test_forecasts_are_listed_without_what_hangs_on_them(database: Database):
    fill(database, 12)
    with database.reading() as session, statements(database) as sent:
        rows = store.list_forecasts(session, 50)
        assert [(row.heliostat.name, row.surface.version) for row in rows if row.surface] == [("AA39", 1)] * 12
        assert "properties" in inspect(rows[0].heliostat).unloaded
    assert len(sent) == 1
    assert "quality" not in sent[0]


@pytest.mark.parametrize("count", [2, 12])
def test_measurements_come_in_one_statement(database: Database, count: int):
    names = fill(database, count)
    with database.reading() as session:
        heliostat = store.get_heliostat(session, "AA39")
        with statements(database) as sent:
            assert [row.identifier for row in named_measurements(session, heliostat, names)] == names
        assert len(sent) == 1
        with statements(database) as sent:
            assert len(unseen_first(session, heliostat, ())[0]) == min(count, 8)
        assert len(sent) == 2


def test_study_asks_as_often_for_many_photographs_as_for_few(database: Database):
    fill(database, 12)
    asked = []
    for images in (2, 12):
        with database.reading() as session, statements(database) as sent:
            material = gather(session, StudyRequest(heliostats=["AA39"], images=images))
        assert len(material.photographs) + len(material.skipped) == images
        asked.append(len(sent))
    assert asked[0] == asked[1]


def test_studies_of_a_page_are_found_with_their_versions_at_once(database: Database):
    studies = [add(database, GAMMA) for _ in range(10)]
    for study in studies[:3]:
        adopt(database, study, force=True)
    with database.reading() as session, statements(database) as sent:
        found = versions.adopted_from(session, studies)
    assert {study: row.number for study, row in found.items()} == dict(zip(studies[:3], (2, 3, 4), strict=True))
    assert len(sent) == 1


def test_check_reads_images_outside_of_any_transaction(
    database: Database, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
):
    fill(database, 3)
    held = []
    monkeypatch.setattr(ImageStore, "read", lambda *_: held.append(database.engine.pool.checkedout()))  # type: ignore[attr-defined]
    inspect_store(database, ImageStore(tmp_path), lambda _: None)
    assert held == [0, 0, 0]
