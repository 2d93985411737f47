"""Epochs of a mirror: what begins one, what does not, and what confirms it."""

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from service import store
from service.base.errors import ConflictError
from service.base.settings import Settings
from service.store import decisions
from service.store.database import Database
from service.store.decisions import Justification
from service.store.mounts import CalibrationState
from service.store.surface_versions import NewSurface
from service.store.tables import HeliostatStateRow
from service.twin.alarms.causes import _confirming
from service.twin.calibration import _reason
from service.twin.surfaces.prediction import _begin_of_epoch
from service.twin.surfaces.present_shape import (
    FALL,
    AccuracyFall,
    Epoch,
    current_epoch,
    epoch_of,
    find_accuracy_fall,
    waiting_epochs,
)
from tests.service.conftest import ORIGIN, properties_document
from tests.service.store.rows import PLANE, new
from tests.service.studies import add as add_study
from tests.service.studies import adopt

FIRST = datetime(2026, 5, 1, 10, tzinfo=UTC)
CHANGED = FIRST + timedelta(days=10)
SETTINGS = Settings(database_url="sqlite://")
CANTED = {
    "name": "facet_canting",
    "parameters": {
        name: {"AA39": {"value": [2.0, 0.0, 0.0, 0.0], "unit": "mrad"}}
        for name in ("x_mrad", "y_mrad")
    },
    "scope": {"kind": "since", "since": "2026-05-12", "heliostats": ["AA39"]},
}


def fill(
    database: Database, photographs: int = 15, others: Mapping[int, float] | None = None
) -> None:
    """A heliostat whose accuracy fell, and accuracies of two ``others`` by day."""
    fall = AccuracyFall(CHANGED - timedelta(days=1), CHANGED, 0.96, 0.81, 0.12)
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        target, _ = store.put_target(session, PLANE)
        rows = [
            store.put_heliostat(session, name, properties_document(), (1, 2, 3))[0]
            for name in ("AA39", "AA40", "AA41")
        ]

        def photograph(number: int, heliostat: Any, day: int, accuracy: float | None) -> None:
            image, row = new(target, taken_at=FIRST + timedelta(days=day), external_id=f"{number}")
            image.sha256, row.forecast_accuracy = f"{number:064x}", accuracy
            store.add_measurement(session, heliostat, image, row)

        for day in range(photographs):
            photograph(day, rows[0], day, None)
        for place, (day, accuracy) in enumerate((others or {}).items()):
            for heliostat in (1, 2):
                number = 1000 + 2 * place + heliostat
                photograph(number, rows[heliostat], day, accuracy)
        state = HeliostatStateRow(heliostat_id=rows[0].id)
        state.fall = FALL.dump_python(fall, mode="json")
        session.add(state)


def epoch(database: Database) -> Epoch | None:
    with database.reading() as session:
        return current_epoch(session, store.get_heliostat(session, "AA39"), SETTINGS)


def add_surface(database: Database, epoch_since: datetime | None) -> int:
    z, points = np.zeros((4, 8, 8)), np.zeros((4, 8, 8, 3))
    with database.writing() as session:
        row = store.get_heliostat(session, "AA39")
        surface = NewSurface("network", z, z, points, valid_from=CHANGED, epoch_since=epoch_since)
        return store.add_surface(session, row, surface).row.version


def test_a_dated_fall_is_a_candidate_at_once(database: Database):
    fill(database, others=dict.fromkeys(range(15), 0.95))
    found = epoch(database)
    assert found is not None
    assert (found.since, found.is_confirmed, found.photographs) == (CHANGED, False, 5)
    assert "fell between 2026-05-10 10:00 UTC and 2026-05-11 10:00 UTC" in found.said
    assert found.missing == 0


def test_too_few_photographs_are_asked_for(database: Database):
    fill(database, photographs=13)
    found = epoch(database)
    assert found is not None
    with database.reading() as session:  # the calibration plan proposes it
        assert waiting_epochs(session, SETTINGS) == {"AA39": found}
    said = _reason(CalibrationState("AA39", 0, None), found)
    assert said.startswith("its accuracy by one surface fell between")
    assert said.endswith("more needed")
    with pytest.raises(ConflictError, match="3 photographs since, 2 more needed"):
        _begin_of_epoch("AA39", found)


def test_haze_and_a_camera_begin_none(database: Database):
    """Others were forecast worse on the same days, too."""
    fill(database, others={day: 0.95 if day < 10 else 0.80 for day in range(15)})
    assert epoch(database) is None


def test_a_fall_below_the_limit_begins_none(database: Database):
    fill(database)
    with database.reading() as session:
        row = store.get_heliostat(session, "AA39")
        tolerant = SETTINGS.model_copy(update={"alarm_accuracy_drop": 0.2})
        assert current_epoch(session, row, tolerant) is None


def test_promotion_of_its_surface_confirms_it(database: Database):
    fill(database)
    old, version = add_surface(database, None), add_surface(database, CHANGED)
    found = epoch(database)
    assert found is not None
    assert (found.since, found.is_confirmed, found.missing) == (CHANGED, True, 0)
    with database.writing() as session:
        row = store.get_heliostat(session, "AA39")
        surfaces = [store.get_surface(session, row, number) for number in (old, version)]
        # Photographs of the former epoch judge the former surface only.
        assert [epoch_of(session, row, one).since for one in surfaces] == [None, CHANGED]
        assert [epoch_of(session, row, one).until for one in surfaces] == [CHANGED, None]
        decisions.apply_decision(session, row, surfaces[0], True, "tester", Justification("not so"))
    found = epoch(database)
    assert found is not None
    assert not found.is_confirmed


@pytest.mark.parametrize(("after", "is_offered"), [(0.91, True), (0.83, False)])
def test_a_person_may_confirm_a_surface_of_too_few_photographs(
    database: Database, after: float, is_offered: bool
):
    fill(database, photographs=13)
    add_surface(database, None)
    found = epoch(database)
    assert found is not None
    assert found.missing == 2
    with database.writing() as session:
        row = store.get_heliostat(session, "AA39")
        assert _confirming(session, row, found) is None
        z, points = np.zeros((4, 8, 8)), np.zeros((4, 8, 8, 3))
        of_epoch = store.get_measurements(session, row, ["10", "11", "12"], arrays=True)
        made = NewSurface("refined", z, z, points, epoch_since=CHANGED, measurements=of_epoch)
        surface = store.add_surface(session, row, made).row
        said = Justification("forecasts 3 photographs better", 0.81, after, 3)
        decisions.apply_decision(session, row, surface, False, "tester", said)
        offer = _confirming(session, row, found)
    expected = {"version": 2, "reason": "version 2 forecasts 3 photographs better"}
    assert (offer and offer["body"]) == (expected if is_offered else None)


def test_a_later_change_is_another_candidate(database: Database):
    fill(database)
    add_surface(database, CHANGED - timedelta(days=5))
    found = epoch(database)
    assert found is not None
    assert (found.since, found.is_confirmed) == (CHANGED, False)


def test_canting_that_a_study_dates_is_a_candidate_until_it_is_adopted(database: Database):
    fill(database, others={day: 0.95 if day < 10 else 0.80 for day in range(15)})
    study = add_study(database, CANTED)
    found = epoch(database)
    assert found is not None
    assert (found.since, found.study) == (datetime(2026, 5, 12, tzinfo=UTC), study)
    adopt(database, study, force=True)
    assert epoch(database) is None


@pytest.mark.parametrize(
    "scope",
    [
        CANTED["scope"] | {"until": "2026-05-14"},  # it ended
        CANTED["scope"] | {"heliostats": ["AA40"]},
        {"kind": "set"},
    ],
)
def test_other_effects_of_a_study_begin_none(database: Database, scope: dict[str, Any]):
    fill(database, others={day: 0.95 if day < 10 else 0.80 for day in range(15)})
    add_study(database, CANTED | {"scope": scope})
    add_study(database, CANTED | {"name": "soiling"})
    assert epoch(database) is None


def test_a_fall_that_recovered_is_none():
    times = [FIRST + timedelta(days=day) for day in range(24)]
    hazy = [0.95, 0.96] * 4 + [0.85, 0.86] * 3 + [0.95, 0.96] * 5
    assert find_accuracy_fall(times, hazy) is None
