"""A study is adopted for what comes: later photographs judge it, and end an effect."""

import json
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from heliotwin.cli.main import app as command
from model.effects import acting
from model.plant import Heliostat
from model.plant_model import PlantModel
from service.base.errors import ConflictError
from service.store.tables import StudyRow
from service.twin.model_versions import get_model, model_if_adopted
from service.twin.runtime import Runtime
from service.twin.studies.field_change import EffectGains, sample_photographs
from tests.service.conftest import ChangingOperations, FakeOperations, png, poster, until
from tests.service.statements import statements
from tests.service.studies import SLOPE, report_of
from tests.service.web.pages import HTML, keep_study

FIRST = datetime(2026, 6, 1, 12, tzinfo=UTC)
ENDS, LAST_STUDIED = date(2026, 6, 7), FIRST + timedelta(days=4)
SINCE = {"kind": "since", "since": "2026-06-01", "until": None, "heliostats": None}
DAYS = 12


class HazyOperations(ChangingOperations):
    """Haze until a day: surfaces forecast photographs exactly if the model has an effect then."""

    def misplaced(self, heliostat: Heliostat, taken_at: datetime, model: PlantModel) -> float:
        is_hazy = taken_at.date() < ENDS
        return 0.05 * (bool(acting(model.effects, taken_at, heliostat.name)) != is_hazy)


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


def alarms(client: TestClient, reason: str = "effect_ended") -> list[dict[str, Any]]:
    until(lambda: client.get("/v1/alarms").json()["pending"] == 0)
    items: list[dict[str, Any]] = client.get("/v1/alarms").json()["items"]
    return [one for one in items if one["reason"] == reason]


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


def keep_correction(app: FastAPI) -> str:
    """The path of a study of the first days that found what has no name."""
    study = keep(app)
    blur = {"kind": "blur", "name": "right", "value": 0.02, "of": None, "per": None}
    gain = {"before": 0.90, "after": 0.95}
    discrepancy = {"coefficients": [blur], "transfer": {"days": gain}, "explained_share": 0.8}
    with app.state.runtime.database.writing() as session:
        row = session.get_one(StudyRow, 1)
        row.verdict = "unexplained"
        row.report = report_of(verdict="unexplained") | {"discrepancy": discrepancy}
    return study


def test_adopted_correction_that_ended_gets_its_end(app: FastAPI, hazy: TestClient):
    study = keep_correction(app)
    assert hazy.post(f"{study}/adopt", json={}).status_code == 409
    forced = {"force": True, "reason": "it is so"}
    assert hazy.post(f"{study}/adopt", json=forced).status_code == 201
    (alarm,) = alarms(hazy)
    assert alarm["message"].startswith("correction makes 6 photographs since 2026-06-07 worse")
    offer = alarm["offer"]
    assert offer["body"] == {"until": {"correction": "2026-06-07"}, "reason": alarm["message"]}
    assert hazy.request(offer["method"], offer["path"], json=offer["body"]).status_code == 201
    assert effects(hazy)[0]["scope"] == SINCE | {"until": "2026-06-07"}
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
    assert alarm["offer"]["body"] == {
        "until": {"slope_error": "2026-06-07"},
        "reason": alarm["message"],
    }
    assert "End it by 2026-06-07, see" in hazy.get("/alarms", headers=HTML).text
    form = {"ended": "slope_error 2026-06-07", "current": "2"}
    assert hazy.post("/studies/1/adopt", data=form, follow_redirects=False).status_code == 303
    assert effects(hazy)[0]["scope"] == SINCE | {"until": "2026-06-07"}
    assert alarms(hazy) == []
    assert "End slope error" not in change_page(hazy)
    gain = hazy.get("/v1/studies/1/change").json()["whole"]["mean"]
    assert gain == pytest.approx(6 * 0.1 / 12, abs=0.001)


def test_a_study_that_helps_is_offered_with_its_end(app: FastAPI, hazy: TestClient):
    keep(app, SLOPE | {"scope": SINCE})
    (alarm,) = alarms(hazy, "study_undecided")
    assert "with its effects the accuracy changes by +5.0 points on 12 photo" in alarm["message"]
    offer = alarm["offer"]
    assert offer["label"] == "Adopt study 1, ended by 2026-06-07"
    assert offer["label"] in hazy.get("/alarms", headers=HTML).text
    assert hazy.request(offer["method"], offer["path"], json=offer["body"]).status_code == 201
    assert effects(hazy)[0]["scope"] == SINCE | {"until": "2026-06-07"}
    assert (alarms(hazy, "study_undecided"), alarms(hazy)) == ([], [])


def test_a_study_stays_on_offer_after_others(app: FastAPI, hazy: TestClient):
    keep(app, SLOPE | {"scope": SINCE})
    keep(app)
    (alarm,) = alarms(hazy, "study_undecided")
    assert alarm["offer"]["label"] == "Adopt study 1, ended by 2026-06-07"


def test_an_effect_that_never_acted_is_withdrawn(app: FastAPI, hazy: TestClient):
    study = keep(app, SLOPE | {"scope": SINCE | {"since": "2026-06-07"}})
    forced = {"force": True, "reason": "it is so"}
    assert hazy.post(f"{study}/adopt", json=forced).status_code == 201
    (alarm,) = alarms(hazy)
    offer = alarm["offer"]
    assert offer["path"] == f"{study}/withdraw"
    assert hazy.request(offer["method"], offer["path"], json=offer["body"]).status_code == 200
    assert (effects(hazy), alarms(hazy)) == ([], [])
    assert alarms(hazy, "study_undecided") == []  # a person decided


def test_photographs_are_chosen_by_one_query(app: FastAPI, hazy: TestClient):
    runtime: Runtime = app.state.runtime
    with runtime.database.reading() as session, statements(runtime.database) as sent:
        found = sample_photographs(session)
    assert len(sent) <= 2  # the other one reads active surfaces
    assert [one.taken_at.date() for one in found] == [
        (FIRST + timedelta(days=day)).date() for day in reversed(range(DAYS))
    ]


def test_gains_are_computed_again_for_another_version_of_the_model(app: FastAPI, hazy: TestClient):
    """Another version may declare another camera, which measures photographs again."""
    runtime: Runtime = app.state.runtime
    number = keep_study(app, SLOPE | {"scope": SINCE})
    gains = EffectGains(runtime)
    with runtime.database.reading() as session:
        before, sampled = get_model(session), sample_photographs(session)
        after = model_if_adopted(session, session.get_one(StudyRow, number))
    first = gains.of(sampled, before, after)
    with statements(runtime.database) as sent:
        assert gains.of(sampled, before, after) == first
        assert sent == []
        assert gains.of(sampled, replace(before, number=before.number + 1), after) == first
        assert sent != []


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


def test_effect_by_day_gets_an_end_on_other_days(app: FastAPI, hazy: TestClient):
    by_day = {"2026-06-02": 0.4, "2026-06-03": 0.6}
    value = SLOPE["parameters"]["sigma_mrad"] | {"by_day": by_day}
    effect = SLOPE | {"scope": {"kind": "day"}, "parameters": {"sigma_mrad": value}}
    study = keep(app, effect)
    (found,) = hazy.get(f"{study}/change").json()["contradicted"]
    assert (found["until"], found["can_end"]) == ("2026-06-07", True)
    done = hazy.post(f"{study}/adopt", json={"until": {found["effect"]: found["until"]}})
    assert done.json()["effects"][0]["scope"] == {"kind": "day", "until": "2026-06-07"}


def test_command_line_asks_later_photographs_too(
    app: FastAPI, hazy: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(app.state.runtime.settings.data_dir))
    monkeypatch.setattr(Runtime, "from_settings", lambda settings: app.state.runtime)
    monkeypatch.setattr(Runtime, "close", lambda runtime: None)
    document = report_of(SLOPE | {"scope": SINCE}, verdict="effect")
    seen = {f"AA39/{100 + day}": 0.9 for day in range(5)}
    document |= {"known_effects": [], "before": document["before"] | {"per_image": seen}}
    report = tmp_path / "report.json"
    report.write_text(json.dumps(document), encoding="utf-8")
    refused = CliRunner().invoke(command, ["models", "adopt", str(report), "--force"])
    assert isinstance(refused.exception, ConflictError)
    assert "this report: accuracy changes by" in str(refused.exception)
    assert "force it and give the reason" in str(refused.exception)
    assert effects(hazy) == []
    forced = ["models", "adopt", str(report), "--force", "--reason", "it returns"]
    assert CliRunner().invoke(command, forced).exit_code == 0
    assert len(effects(hazy)) == 1
