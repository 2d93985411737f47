"""How many SQL statements a read takes: as many for fifty rows as for two, and no transaction
beside the disk.
"""

from typing import Any

import pytest
from sqlalchemy import inspect

from service import store
from service.store.check import inspect_store
from service.store.database import Database
from service.store.image_files import ImageStore
from service.store.listing import Portion
from service.twin import model_versions
from service.twin.measurements import named_measurements
from service.twin.studies.study import StudyIn, load_study_inputs
from service.twin.surfaces.accuracy import held_out_first
from tests.service.statements import statements
from tests.service.store.rows import fill
from tests.service.studies import GAMMA, add, adopt


def test_forecasts_are_listed_without_what_hangs_on_them(database: Database):
    fill(database, 12)
    with database.reading() as session, statements(database) as sent:
        rows = store.list_forecasts(session, Portion(50))
        assert [(row.heliostat.name, row.surface.version) for row in rows if row.surface] == [
            ("AA39", 1)
        ] * 12
        assert "properties" in inspect(rows[0].heliostat).unloaded
    assert len(sent) == 1
    assert "quality" not in sent[0]


@pytest.mark.parametrize("count", [2, 12])
def test_measurements_come_in_one_statement(database: Database, count: int):
    names = fill(database, count)
    with database.reading() as session:
        heliostat = store.get_heliostat(session, "AA39")
        with statements(database) as sent:
            assert [
                row.identifier for row in named_measurements(session, heliostat, names)
            ] == names
        assert len(sent) == 1
        with statements(database) as sent:
            assert len(held_out_first(session, heliostat, ())[0]) == min(count, 8)
        assert len(sent) == 2


def test_study_asks_as_often_for_many_photographs_as_for_few(database: Database):
    fill(database, 12)
    asked = []
    for images in (2, 12):
        with database.reading() as session, statements(database) as sent:
            material = load_study_inputs(session, StudyIn(heliostats=["AA39"], images=images))
        assert len(material.photographs) + len(material.skipped) == images
        asked.append(len(sent))
    assert asked[0] == asked[1]


def test_studies_of_a_page_are_found_with_their_versions_at_once(database: Database):
    studies = [add(database, GAMMA) for _ in range(10)]
    for study in studies[:3]:
        adopt(database, study, force=True)
    with database.reading() as session, statements(database) as sent:
        found = model_versions.newest_of(session, studies)
    assert {study: row.number for study, row in found.items()} == dict(
        zip(studies[:3], (2, 3, 4), strict=True)
    )
    assert len(sent) == 1


def test_check_reads_images_outside_of_any_transaction(
    database: Database, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
):
    fill(database, 3)
    held = []
    monkeypatch.setattr(
        ImageStore, "read", lambda *_: held.append(database.engine.pool.checkedout())
    )  # type: ignore[attr-defined]
    inspect_store(database, ImageStore(tmp_path), lambda _: None)
    assert held == [0, 0, 0]
