"""A study is adopted for what comes: later photographs judge it, and end an effect."""

from datetime import UTC, date, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from model.effects import acting
from model.observation import Observation
from model.plant import Heliostat
from model.plant_model import PlantModel
from service.store.tables import StudyRow
from tests.service.conftest import FakeOperations, png, poster, until
from tests.service.studies import SLOPE
from tests.service.web.pages import HTML, keep_study

FIRST = datetime(2026, 6, 1, 12, tzinfo=UTC)
ENDS, LAST_STUDIED = date(2026, 6, 7), FIRST + timedelta(days=4)
SINCE = {"kind": "since", "since": "2026-06-01", "until": None, "heliostats": None}
DAYS = 12


class HazyOperations(FakeOperations):
    """Haze until a day: surfaces forecast photographs exactly if the model has an effect then."""

    def render(
        self, heliostat: Heliostat, observations: list[Observation], z: Any, model: PlantModel
    ) -> Any:
        right = super().render(heliostat, observations, z, model)
        for image, one in zip(right, observations, strict=True):
            assert one.taken_at is not None
            is_hazy = one.taken_at.date() < ENDS
            if bool(acting(model.effects, one.taken_at, heliostat.name)) != is_hazy:
                image *= 0.95
                image[0, 0] += 5
        return right


@pytest.fixture
def operations() -> FakeOperations:
    return HazyOperations()


@pytest.fixture
def hazy(client: TestClient) -> TestClient:
    """A heliostat with a surface, and a photograph of each day: six of haze, six without."""
    post = poster(client)
    for day in range(DAYS):
        at = (FIRST + timedelta(days=day)).isoformat()
        assert post(png(day), id=f"{100 + day}", taken_at=at).status_code == 201
    made = client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["100"]})
    assert made.status_code == 201
    return client


def keep(app: FastAPI, *effects: dict[str, Any]) -> str:
    """The path of a study of the first days."""
    number = keep_study(app, *effects)
    with app.state.runtime.database.writing() as session:
        row = session.get_one(StudyRow, number)
        row.first_taken_at, row.last_taken_at = FIRST, LAST_STUDIED
    return f"/v1/studies/{number}"


def alarms(client: TestClient) -> list[dict[str, Any]]:
    until(lambda: client.get("/v1/alarms").json()["pending"] == 0)
    items: list[dict[str, Any]] = client.get("/v1/alarms").json()["items"]
    return [one for one in items if one["reason"] == "effect_ended"]


def change_page(client: TestClient) -> str:
    return client.get("/studies/1/change", headers=HTML).text


def effects(client: TestClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get("/v1/models/current").json()["effects"]
    return found


@pytest.mark.parametrize("scope", [SINCE, {"kind": "set"}], ids=["since", "always"])
def test_later_photographs_refuse_an_effect_without_its_end(
    app: FastAPI, hazy: TestClient, scope: dict[str, Any]
):
    study = keep(app, SLOPE | {"scope": scope})
    change = hazy.get(f"{study}/change").json()
    counts = [change[part]["photographs"] for part in ("whole", "later")]
    assert (*counts, change["is_harmful"]) == (12, 7, True)
    assert change["later"]["mean"] == pytest.approx((0.1 - 6 * 0.1) / 7, abs=0.001)
    (found,) = change["contradicted"]
    assert (found["effect"], found["until"]) == ("slope_error", "2026-06-07")
    assert (found["can_end"], found["gain"]["photographs"]) == (True, 6)
    for body in ({}, {"force": True}, {"reason": "it is so"}):
        refused = hazy.post(f"{study}/adopt", json=body)
        assert refused.status_code == 409
        assert (
            'adopt it with this end, {"until": {"slope_error": "2026-06-07"}}'
            in (refused.json()["detail"])
        )
    assert effects(hazy) == []
    done = hazy.post(f"{study}/adopt", json={"until": {"slope_error": "2026-06-07"}})
    assert done.status_code == 201
    assert done.json()["effects"][0]["scope"] == SINCE | {"until": "2026-06-07"}
    assert alarms(hazy) == []


def test_adopted_effect_that_ended_raises_an_alarm_until_it_gets_its_end(
    app: FastAPI, hazy: TestClient
):
    study = keep(app, SLOPE | {"scope": SINCE})
    forced = {"force": True, "reason": "it is so"}
    assert hazy.post(f"{study}/adopt", json=forced).status_code == 201
    (alarm,) = alarms(hazy)
    assert (alarm["heliostat"], alarm["since"]) == (None, "2026-06-07T00:00:00Z")
    assert alarm["message"].startswith("slope error makes 6 photographs since 2026-06-07 worse")
    assert alarm["action"] == "end it by 2026-06-07, see /studies/1/change"
    change = change_page(hazy)
    assert "End slope error by 2026-06-07" in change
    form = {"ended": "slope_error 2026-06-07", "current": "2"}
    assert hazy.post("/studies/1/adopt", data=form, follow_redirects=False).status_code == 303
    assert effects(hazy)[0]["scope"] == SINCE | {"until": "2026-06-07"}
    assert alarms(hazy) == []
    assert "End slope error" not in change_page(hazy)
    gain = hazy.get("/v1/studies/1/change").json()["whole"]["mean"]
    assert gain == pytest.approx(6 * 0.1 / 12, abs=0.001)


def test_page_of_the_change_offers_the_end_first(app: FastAPI, hazy: TestClient):
    keep(app, SLOPE | {"scope": SINCE})
    answer = hazy.post("/studies/1/adopt", data={}, follow_redirects=False)
    assert answer.headers["Location"] == "/studies/1/change#adopt-title"
    page = change_page(hazy)
    assert page.index("Adopt slope error, ended by 2026-06-07") < page.index("nevertheless")
    form = {"read": "true", "reason": "it returns"}
    assert hazy.post("/studies/1/adopt", data=form, follow_redirects=False).status_code == 303
    assert effects(hazy)[0]["scope"] == SINCE


@pytest.mark.parametrize(
    ("ends", "says"),
    [
        ({"sun_shape": "2026-06-07"}, "found no sun_shape that acts still"),
        ({"slope_error": "2026-06-01"}, "must end after that day, got 2026-06-01"),
    ],
)
def test_an_end_is_of_an_effect_after_its_begin(
    app: FastAPI, hazy: TestClient, ends: dict[str, str], says: str
):
    study = keep(app, SLOPE | {"scope": SINCE})
    refused = hazy.post(f"{study}/adopt", json={"until": ends})
    assert refused.status_code == 422
    assert says in refused.text


def test_what_nobody_contradicts_is_adopted(app: FastAPI, hazy: TestClient):
    """An effect that ended by itself, and one that later photographs need as well."""
    ended = SINCE | {"until": "2026-06-07"}
    study = keep(app, SLOPE | {"scope": ended})
    assert hazy.get(f"{study}/change").json()["is_harmful"] is False
    assert hazy.post(f"{study}/adopt", json={}).status_code == 201
    assert np.isclose(hazy.get(f"{study}/change").json()["whole"]["mean"], 6 * 0.1 / 12, atol=0.001)
    assert alarms(hazy) == []
