"""Falls of the whole field's accuracy: their day, and what of one heliostat's fall they are."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL

from model.plant import Heliostat
from model.plant_model import PlantModel
from service.base.settings import Settings
from service.store.tables import StudyRow
from service.twin.alarms.field_fall import LEAST, find_field_fall, levels_of
from service.twin.studies.field_change import SampledPhotograph
from service.twin.surfaces.present_shape import AccuracyFall
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    ChangingOperations,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
    until,
)
from tests.service.web.pages import HTML, keep_study

FIRST = datetime(2026, 5, 1, 9, tzinfo=UTC)


def photographs(days: int, heliostats: int) -> list[SampledPhotograph]:
    """One of each heliostat a day, an hour apart."""
    return [
        SampledPhotograph(
            day * heliostats + place,
            f"{day}-{place}",
            f"H{place}",
            FIRST + timedelta(days=day, hours=place),
            1,
        )
        for day in range(days)
        for place in range(heliostats)
    ]


def test_a_small_fall_of_all_is_dated_though_one_heliostat_is_far_off():
    taken, rng = photographs(30, 8), np.random.default_rng(0)
    relative = {
        one.id: rng.normal(0, 0.01)
        - 0.015 * (one.taken_at >= FIRST + timedelta(days=18))
        - 0.3 * (one.heliostat == "H3" and one.taken_at >= FIRST + timedelta(days=4))
        for one in taken
    }
    levels = levels_of(taken, relative)
    assert len(levels) == 30
    fall = find_field_fall(levels)
    assert fall is not None
    assert fall.since < FIRST + timedelta(days=18) <= fall.until
    assert abs(fall.earlier - fall.recent - 0.015) < 0.005


def test_what_is_small_or_has_recovered_is_no_fall_of_the_field():
    taken = photographs(30, 8)
    for size, days in ((LEAST / 2, range(18, 30)), (0.03, range(10, 17))):
        rng = np.random.default_rng(1)
        relative = {
            one.id: rng.normal(0, 0.004) - size * ((one.taken_at - FIRST).days in days)
            for one in taken
        }
        assert find_field_fall(levels_of(taken, relative)) is None, size


def test_small_falls_one_after_the_other_count_together():
    """A corrected week of haze leaves a little, and another camera is as small."""
    taken, rng = photographs(40, 8), np.random.default_rng(2)
    fell = [0.7 * LEAST * (day >= 18) + 0.7 * LEAST * (day >= 28) for day in range(40)]
    relative = {one.id: rng.normal(0, 0.002) - fell[(one.taken_at - FIRST).days] for one in taken}
    fall = find_field_fall(levels_of(taken, relative))
    assert fall is not None
    assert fall.since < FIRST + timedelta(days=18) <= fall.until


def test_days_of_few_heliostats_have_no_level():
    taken = photographs(10, 8)
    known = {one.id: 0.0 for one in taken if one.heliostat in ("H0", "H1")}
    assert levels_of(taken, known) == {}


def test_what_all_lost_is_not_one_heliostats():
    levels = {(FIRST + timedelta(days=day)).isoformat(): -0.03 * (day >= 10) for day in range(20)}
    then = FIRST + timedelta(days=10)
    fall = AccuracyFall(then - timedelta(days=1), then, 0.96, 0.88, 0.06)
    assert round(fall.of_field(levels), 6) == 0.03
    assert fall.of_field({}) == 0.0


# --- in the service
# --------------------------------------------------------------------------------------------------

NAMES = ("AA39", "AA40", "AA41", "AA42")
DAYS, CHANGED = 20, FIRST + timedelta(days=12)


class ChangedCamera(ChangingOperations):
    """Surfaces forecast photographs well until the camera changes, then with 0.08 less."""

    def misplaced(self, heliostat: Heliostat, taken_at: datetime, model: PlantModel) -> float:
        return 0.04 * (taken_at >= CHANGED) + 0.001 * (taken_at.minute % 7)


@pytest.fixture
def app(store_url: URL, tmp_path: Path) -> FastAPI:
    address = store_url.render_as_string(hide_password=False)
    return create_app(Settings(data_dir=tmp_path, database_url=address, **QUIET), ChangedCamera())


@pytest.fixture
def field(app: FastAPI) -> Iterator[TestClient]:
    """Four heliostats with surfaces, and a photograph of each on each day."""
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        for place, name in enumerate(NAMES):
            properties = properties_document()
            properties["heliostat_position"][1] += 1e-4 * place
            assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
        for day in range(DAYS):
            for place, name in enumerate(NAMES):
                number = 4 * day + place
                at = FIRST + timedelta(days=day, minutes=13 * number % 60)
                sent = poster(client)(png(number), name, id=f"{number}", taken_at=at.isoformat())
                assert sent.status_code == 201, sent.text
                if day == 0:
                    made = client.post(f"/v1/heliostats/{name}/surfaces", json={})
                    assert made.status_code == 201, made.text
        yield client


def falls(client: TestClient) -> list[dict[str, Any]]:
    until(lambda: client.get("/v1/alarms").json()["pending"] == 0)
    listed = client.get("/v1/alarms", params={"reason": "fell"}).json()["items"]
    return [one for one in listed if one["reason"] == "fell"]


def test_a_changed_camera_is_one_alarm_with_a_study_to_do(app: FastAPI, field: TestClient):
    """Each heliostat fell by more than is allowed, and by no more than all."""
    (alarm,) = falls(field)
    assert (alarm["heliostat"], alarm["id"].startswith("plant:fell:")) == (None, True)
    assert "the accuracy of the whole field fell between 2026-05-12" in alarm["message"]
    assert datetime.fromisoformat(alarm["since"]).date() == CHANGED.date()
    begin = datetime.fromisoformat(alarm["offer"]["body"]["since"])
    assert (CHANGED - begin).days in (20, 21)
    assert alarm["offer"]["label"] in field.get("/alarms", headers=HTML).text
    for name in NAMES:
        kinds = {one["kind"] for one in field.get(f"/v1/heliostats/{name}/causes").json()["items"]}
        assert "mirror" not in kinds
    number = keep_study(app)
    with app.state.runtime.database.writing() as session:
        row = session.get_one(StudyRow, number)
        row.heliostats, row.last_taken_at = list(NAMES), FIRST + timedelta(days=DAYS)
    (alarm,) = falls(field)
    assert alarm["offer"] is None  # it was studied
