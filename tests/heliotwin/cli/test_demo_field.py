"""The demonstration's field: each fault that it is made with is found."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from datetime import date, datetime, timedelta
from html import unescape
from pathlib import Path
from statistics import fmean, median
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from heliotwin.demo.field import FAULTS, Fault, _canted, plan_photographs
from heliotwin.demo.field_store import seed_field
from model.metrics import flux_accuracy
from service import store
from service.sources.plant_file import read_plant
from service.sources.plant_formats.imported import PLANT
from service.store.columns import now
from service.store.tables import HeliostatRow, MeasurementRow
from service.twin.measurements import accepted_measurement, heights_of, load_heliostat_context
from service.twin.surfaces.accuracy import forecasts_of
from tests.conftest import made_once
from tests.service.conftest import until
from tests.service.exported import MEASURED_AGAIN, require_round_trip
from tests.service.real import client_on, run_job, runtime_of
from tests.service.twin.test_causes import causes_of

ROWS = 4
"""Rows of heliostats: those with faults are in them."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of a small field; read it only."""

    def make(root: Path) -> None:
        totals, steps = [], []

        def counting(total: int) -> Callable[[str], None]:
            totals.append(total)
            return steps.append

        seed_field(root / "plant", root / "data", counting, rows=ROWS)
        assert totals == [len(steps)]  # a bar ends where it says

    return made_once(tmp_path_factory, "field", make)


@pytest.fixture(scope="module")
def client(made: Path) -> Iterator[TestClient]:
    """A client that only reads."""
    with client_on(made) as client:
        yield client


@pytest.fixture
def changing(made: Path, tmp_path: Path) -> Iterator[TestClient]:
    """A client on a copy of the store."""
    shutil.copytree(made, tmp_path / "copy")
    with client_on(tmp_path / "copy") as client:
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
def test_from_its_alarm_to_the_right_surface_of_a_changed_mirror(changing: TestClient, made: Path):
    """One click, or the same over REST: the surface is that of the changed mirror, by its truth."""
    (fault,) = (fault for fault in FAULTS if fault.kind == "facet canted")
    (name,) = fault.heliostats
    photographs = plan_photographs(read_plant(made / "plant" / PLANT).plant, now())
    changed = [one for one in photographs if one.mirror.name == name and fault.kind in one.faults]
    (alarm,) = (one for one in alarms_of(changing) if one["reason"] == "fell")
    since = datetime.fromisoformat(alarm["since"])
    assert abs(since - changed[0].taken_at) < timedelta(days=1)
    # The page offers the same as REST.
    page = changing.get(f"/heliostats/{name}", headers={"Accept": "text/html"}).text
    offered = [json.loads(unescape(one)) for one in re.findall(r'name="offer" value="(.*?)"', page)]
    (shown,) = (one["body"]["since"] for one in offered if "since" in one["body"])
    assert datetime.fromisoformat(shown) == since
    surfaces = f"/v1/heliostats/{name}/surfaces"

    truth = _canted(changed[0])

    def accuracy() -> float:
        """Of forecasts under the suns of all photographs, by the true mirror's fluxes."""
        runtime = runtime_of(changing)
        with runtime.database.reading() as session:
            twin = load_heliostat_context(session, name)
            recent = store.recent_measurements(session, twin.row, 24)
            names = [row.identifier for row in recent]
            rows = store.get_measurements(session, twin.row, names, arrays=True)
            z = heights_of(store.find_surface_at(session, twin.row))
        photos = [accepted_measurement(row, twin.origin) for row in rows]
        pairs = zip(*(forecasts_of(runtime, twin, photos, one) for one in (truth, z)), strict=True)
        return fmean(flux_accuracy(*pair) for pair in pairs)

    assert accuracy() < 0.85
    causes = changing.get(f"/v1/heliostats/{name}/causes").json()["items"]
    (offer,) = (one["offer"] for one in causes if one["kind"] == "mirror")
    assert (offer["method"], offer["path"]) == ("POST", "/v1/jobs/predictions")
    assert datetime.fromisoformat(offer["body"]["since"]) == since
    (judged,) = run_job(changing, offer["path"], **offer["body"])["judged"].values()
    assert judged["became_active"], judged
    assert "in cross-validation" in judged["reason"]
    assert accuracy() > 0.92
    assert changing.get(f"{surfaces}/current").json()["epoch_since"] == alarm["since"]
    assert "fell" not in {one["reason"] for one in alarms_of(changing) if one["heliostat"] == name}
    # The next prediction takes photographs of the epoch only.
    made_of = {"heliostats": [name], "method": "network"}
    run_job(changing, "/v1/jobs/predictions", **made_of)
    newest = changing.get(f"{surfaces}?limit=1&order=down").json()["items"][0]
    assert newest["epoch_since"] == alarm["since"]


@pytest.mark.full
def test_every_alarm_has_its_cause_and_clocks_have_a_common_one(client: TestClient):
    expected = {"dimmed": "soiled", "moved": "moved", "fell": "mirror"}
    expected |= {"sun_contradicts_time": "clock", "no_photograph": "no_photograph"}
    expected |= {"times_unknown": "times_unknown"}
    for alarm in alarms_of(client):
        if (name := alarm["heliostat"]) is not None and alarm["reason"] in expected:
            found = client.get(f"/v1/heliostats/{name}/causes").json()["items"]
            assert expected[alarm["reason"]] in {one["kind"] for one in found}, alarm
    causes = client.get("/v1/alarms/causes").json()["items"]
    (fault,) = (fault for fault in FAULTS if fault.kind == "clock")
    (clock,) = (one for one in causes if "sun_contradicts_time" in one["alarms"])
    assert set(clock["heliostats"]) == set(fault.heliostats)
    assert "1 h later" in clock["offer"]["label"]


@pytest.mark.full
def test_each_offer_is_accepted_as_it_is(changing: TestClient):
    """All that alarms, common causes and causes of heliostats offer, sent one after the other."""
    alarms = alarms_of(changing)
    names = sorted({one["heliostat"] for one in alarms if one["heliostat"]})
    paths = ["/v1/alarms/causes", *(f"/v1/heliostats/{name}/causes" for name in names)]
    found = [one for path in paths for one in changing.get(path).json()["items"]]
    offered = {str(offer): offer for one in (*alarms, *found) if (offer := one["offer"])}
    asked = {
        offer["path"].split("/")[2 if "jobs" not in offer["path"] else 3]
        for offer in offered.values()
    }
    assert asked >= {"predictions", "calibrations", "measurements", "alarms"}
    for offer in offered.values():
        if offer["path"] == "/v1/measurements/times" and len(offer["body"]["times"]) == 1:
            continue  # one clock explains them together with others
        answer = changing.request(offer["method"], offer["path"], json=offer["body"])
        is_done = answer.status_code == 409 and "already" in answer.text  # by the common cause
        assert answer.status_code < 300 or is_done, (offer, answer.text)


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
