"""The demonstration's field: each fault that it is made with is found."""

import shutil
from collections.abc import Callable, Iterator
from datetime import date, timedelta
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.cli.demo_field import FAULTS, Fault
from service.cli.demo_field_store import seed_field
from service.store.columns import now
from service.store.tables import HeliostatRow, MeasurementRow
from tests.conftest import made_once
from tests.service.conftest import until
from tests.service.exported import MEASURED_AGAIN, require_round_trip
from tests.service.real import client_on, runtime_of
from tests.service.twin.test_causes import causes_of

ROWS = 4
"""Rows of heliostats: those with faults are in them."""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A client on the store of a small field; it only reads."""

    def make(root: Path) -> None:
        totals, steps = [], []

        def counting(total: int) -> Callable[[str], None]:
            totals.append(total)
            return steps.append

        seed_field(root / "plant", root / "data", counting, rows=ROWS)
        assert totals == [len(steps)]  # a bar ends where it says

    made = made_once(tmp_path_factory, "field", make)
    with client_on(made) as client:
        yield client


def alarms_of(client: TestClient) -> list[dict[str, Any]]:
    """All alarms, after the results behind them are computed."""
    path = "/v1/alarms?limit=500"
    until(lambda: client.get(path).json()["pending"] == 0, "the field is computed")
    items: list[dict[str, Any]] = client.get(path).json()["items"]
    return items


@pytest.mark.full
@pytest.mark.parametrize("fault", [f for f in FAULTS if f.alarm], ids=lambda fault: fault.kind)
def test_faults_of_heliostats_raise_their_alarms(client: TestClient, fault: Fault):
    found = {one["heliostat"] for one in alarms_of(client) if one["reason"] == fault.alarm}
    assert found == set(fault.heliostats)


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "cause"), [("drives stepped", "It moved"), ("facet canted", "The mirror changed")]
)
def test_the_card_of_a_heliostat_ranks_its_fault(client: TestClient, kind: str, cause: str):
    alarms_of(client)
    (name,) = next(fault.heliostats for fault in FAULTS if fault.kind == kind)
    first, model = causes_of(client, name)
    assert first.startswith(cause)
    # The study of the hazy days included it, and found what the model lacks.
    assert model.startswith("The model lacks something")
    assert "study 1 of its photographs" in model


def result_of(client: TestClient, kind: str) -> dict[str, Any]:
    """The result of the only job of a kind."""
    (job,) = client.get("/v1/jobs", params={"kind": kind}).json()["items"]
    result: dict[str, Any] = client.get(f"/v1/jobs/{job['id']}").json()["result"]
    return result


@pytest.mark.full
def test_forecasts_and_aims_know_the_soiled_mirror_and_the_drives_that_stepped(client: TestClient):
    """Haze of all is no loss, and 0.7 m still land on a receiver of 6 m: its spot is wider."""
    result = result_of(client, "forecasts")
    states, light = result["states"], result["by_heliostat"]
    (soiled,) = (fault for fault in FAULTS if fault.kind == "soiled")
    (stepped,) = (fault for fault in FAULTS if fault.kind == "drives stepped")
    (dirty,), (off,) = soiled.heliostats, stepped.heliostats
    clean = states[dirty]["cleanliness"]
    assert clean["source"] == "measured"
    assert clean["value"] == pytest.approx(1 - soiled.size, abs=0.08)
    assert clean["ci95"][0] < clean["value"] < clean["ci95"][1]
    assert light[dirty]["cleanliness"] == pytest.approx(clean["value"], rel=1e-3)
    pointing = states[off]["pointing_error_mrad"]
    assert pointing["source"] == "measured"
    assert pointing["ci95"][0] < stepped.size / 1.18 < pointing["ci95"][1]
    assert min(one["cleanliness"] for name, one in light.items() if name != dirty) > 0.8
    assert result["field"]["cleanliness"] == pytest.approx(1 - soiled.size / len(light), abs=0.01)
    for of_all in (result["sources"], result_of(client, "aim-plans")["sources"]):
        assert of_all["cleanliness"]["measured"] < 0.05 * len(light)
        assert of_all["pointing_error_mrad"]["measured"] >= 1
        assert sum(of_all["pointing_error_mrad"].values()) == len(light)
    assert result_of(client, "plans")["sources"]["cleanliness"]["measured"] >= 1
    aims = result_of(client, "aim-plans")
    assert aims["peak_p95_w_m2"] > 1.001 * aims["peak_w_m2"]


@pytest.mark.full
def test_a_hazy_week_is_seen_in_all_accuracies_and_then_gone(client: TestClient):
    (haze,) = (fault for fault in FAULTS if fault.kind == "hazy")
    query = select(MeasurementRow.taken_at, MeasurementRow.forecast_accuracy).join(HeliostatRow)
    query = query.where(MeasurementRow.forecast_accuracy.is_not(None))
    with runtime_of(client).database.reading() as session:
        dated = [row for row in session.execute(query) if row[0] is not None]
    first, last = (now() - timedelta(days=days - 0.5) for days in haze.days)
    during = median(accuracy for at, accuracy in dated if first < at < last)
    before, after = (
        median(accuracy for at, accuracy in dated if is_then(at))
        for is_then in (lambda at: at < first, lambda at: at > last)
    )
    assert during < min(before, after) - 0.03


@pytest.mark.full
@pytest.mark.parametrize("fault", [f for f in FAULTS if f.refusal], ids=lambda fault: fault.kind)
def test_faults_of_photographs_refuse_them(client: TestClient, fault: Fault):
    for name in fault.heliostats:
        items = client.get(f"/v1/heliostats/{name}/measurements").json()["items"]
        assert fault.refusal in {one["reason"] for one in items}


@pytest.mark.full
def test_a_study_of_the_hazy_days_finds_wider_light(client: TestClient):
    (study,) = client.get("/v1/studies").json()["items"]
    assert study["verdict"] == "effect"
    (found,) = client.get(f"/v1/studies/{study['id']}").json()["effects"]
    assert found["name"] in ("sun_shape", "slope_error", "camera_blur")


@pytest.fixture
def changing(client: TestClient, tmp_path: Path) -> Iterator[TestClient]:
    """A client on a copy of the store, which may change it."""
    data = runtime_of(client).settings.data_dir
    shutil.copytree(data, tmp_path / "data")
    with client_on(tmp_path) as copy:
        yield copy


@pytest.mark.full
def test_the_study_of_the_hazy_days_is_adopted_with_its_end_only(changing: TestClient):
    """It saw no photograph after the haze; those that came later ask for its end."""
    (haze,) = (fault for fault in FAULTS if fault.kind == "hazy")
    ended = (now() - timedelta(days=haze.days[1] - 1)).date()
    (found,) = changing.get("/v1/studies/1").json()["effects"]
    refused = changing.post("/v1/studies/1/adopt", json={"reason": "it gains", "force": False})
    assert refused.status_code == 409
    change = changing.get("/v1/studies/1/change").json()
    (contradicted,) = change["contradicted"]
    assert abs(date.fromisoformat(contradicted["until"]) - ended) <= timedelta(days=1)
    assert change["later"]["ci95"][1] < -0.002
    forced = {"reason": "it gains", "force": True}
    assert changing.post("/v1/studies/1/adopt", json=forced).status_code == 201
    (alarm,) = (one for one in alarms_of(changing) if one["reason"] == "effect_ended")
    assert contradicted["until"] in alarm["action"]
    body = {"until": {found["name"]: contradicted["until"]}}
    assert changing.post("/v1/studies/1/adopt", json=body).status_code == 201
    assert not [one for one in alarms_of(changing) if one["reason"] == "effect_ended"]
    gained = changing.get("/v1/studies/1/change").json()
    assert gained["whole"]["mean"] > 0
    assert not gained["is_harmful"]


@pytest.mark.full
def test_all_jobs_are_done(client: TestClient):
    jobs = client.get("/v1/jobs").json()["items"]
    assert {one["state"] for one in jobs} == {"done"}
    assert {one["kind"] for one in jobs} >= {"predictions", "calibrations", "studies", "aim-plans"}


def test_a_store_that_exists_stays(tmp_path: Path):
    (tmp_path / "data").mkdir()
    seed_field(tmp_path / "plant", tmp_path / "data")
    assert not list((tmp_path / "data").iterdir())
    assert not (tmp_path / "plant").exists()


@pytest.mark.full
def test_the_field_goes_through_an_export(client: TestClient, tmp_path: Path):
    require_round_trip(runtime_of(client), None, tmp_path, MEASURED_AGAIN)
