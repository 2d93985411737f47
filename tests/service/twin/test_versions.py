"""Versions of the plant's model: which is current, who may change it, and what is made by it."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any, cast

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select

from model.effects import CATALOGUE, acting, model_version
from model.sunshape import Gaussian
from service import store
from service.base.errors import ConflictError, NotFoundError
from service.base.settings import Settings
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.store import audit, keys
from service.store.database import Database
from service.store.job_tables import AuditRow
from service.store.model_versions import put_declared
from service.store.tables import MODEL_VERSION
from service.twin import model_versions
from tests.service.command import exit_code
from tests.service.conftest import ORIGIN, FakeOperations, Post, png
from tests.service.studies import GAMMA, SLOPE, add, adopt, report_of

FORECAST = {
    "heliostat": "AA39",
    "target": "lower",
    "sun": {"azimuth_deg": 180, "elevation_deg": 45},
    "surface": "ideal",
    "resolution": 16,
}


def current(database: Database) -> str:
    with database.reading() as session:
        return model_versions.get_model(session).version


# --- versions
# --------------------------------------------------------------------------------------------------


def test_declared_model_is_the_first_version(database: Database):
    with database.reading() as session, pytest.raises(ConflictError, match="the plant is not set"):
        model_versions.get_model(session)
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
    with database.reading() as session:
        model = model_versions.get_model(session)
        assert (model.number, model.version, model.effects) == (1, "1:none", ())
        with pytest.raises(NotFoundError, match="no version 2"):
            model_versions.get_model(session, 2)


DECLARED = {"sun": {"shape": "gaussian", "sigma_mrad": 2.0}, "effects": [GAMMA]}


def test_declared_sun_and_effects_are_part_of_every_version(database: Database):
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        assert put_declared(session, DECLARED) is store.Change.CHANGED
        assert put_declared(session, DECLARED) is store.Change.UNCHANGED
    assert adopt(database, add(database, SLOPE)) == "2:slope_error"
    with database.reading() as session:
        first, second = model_versions.get_model(session, 1), model_versions.get_model(session, 2)
    assert (first.optics.sun_shape, second.optics.sun_shape) == (Gaussian(0.002), Gaussian(0.002))
    assert [effect.name for effect in first.effects] == ["camera_response"]
    assert [effect.name for effect in second.effects] == ["camera_response", "slope_error"]
    with (
        database.writing() as session,
        pytest.raises(ConflictError, match="studies were made with it"),
    ):
        put_declared(session, {})


def test_what_is_found_of_one_heliostat_is_adopted_for_it_alone(database: Database):
    assert (
        adopt(database, add(database, SLOPE | {"scope": {"kind": "set", "heliostats": ["AA39"]}}))
        == "2:slope_error"
    )
    with database.reading() as session:
        effects = model_versions.get_model(session).effects
    assert [len(acting(effects, None, name)) for name in ("AA39", "AB01")] == [1, 0]


def test_what_is_declared_otherwise_is_another_version(database: Database):
    """Version 1 was pillbox one day and Buie the next, under forecasts that name it."""
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
    with database.reading() as session:
        before = model_versions.get_model(session, 1)
    for number, sigma in ((2, 2.0), (3, 3.0)):
        declared = {"sun": {"shape": "gaussian", "sigma_mrad": sigma}, "effects": [GAMMA]}
        with database.writing() as session:
            assert put_declared(session, declared, "tester") is store.Change.CHANGED
            assert put_declared(session, declared, "tester") is store.Change.UNCHANGED
        assert current(database) == f"{number}:none"
    assert adopt(database, add(database, SLOPE, model=2), force=True) == "4:slope_error"
    with database.reading() as session:
        found = {number: model_versions.get_model(session, number) for number in (1, 2, 3, 4)}
    assert (repr(found[1].optics), found[1].effects) == (repr(before.optics), before.effects)
    assert [found[number].optics.sun_shape for number in (2, 3)] == [
        Gaussian(0.002),
        Gaussian(0.003),
    ]
    # The adopted version is based on the model that its study used.
    assert found[4].optics.sun_shape == Gaussian(0.002)
    assert [effect.name for effect in found[4].effects] == ["camera_response", "slope_error"]


def test_versions_build_upon_each_other_and_are_withdrawn_from_the_top(database: Database):
    first = add(database, GAMMA)
    assert adopt(database, first) == "2:camera_response"
    second = add(database, SLOPE, model=2)
    assert adopt(database, second) == "3:slope_error+camera_response"
    with database.reading() as session:
        found = {effect.name: effect for effect in model_versions.get_model(session).effects}
        assert (found["camera_response"].gamma, found["slope_error"].sigma_mrad) == (0.8, 1.5)
    with database.writing() as session, pytest.raises(ConflictError, match="withdraw version 3"):
        model_versions.withdraw(session, first, "tester")
    for study, before in ((second, "2:camera_response"), (first, "1:none")):
        with database.writing() as session:
            model_versions.withdraw(session, study, "other")
        assert current(database) == before
    with database.writing() as session, pytest.raises(ConflictError, match="is not adopted"):
        model_versions.withdraw(session, first, "tester")
    with database.reading() as session:
        kept = model_versions.list_models(session)
        assert [(row.number, row.adopted_by, row.withdrawn_by) for row in kept] == [
            (2, "tester", "other"),
            (3, "tester", "other"),
        ]
        assert model_versions.get_model(session, 3).version == "3:slope_error+camera_response"
    # Numbers are not given twice: forecasts name them.
    assert adopt(database, first) == "4:camera_response"


def test_study_of_another_version_takes_its_place_only_by_force(database: Database):
    first, second = add(database, GAMMA), add(database, SLOPE)
    adopt(database, first)
    with pytest.raises(ConflictError, match="made with version 1"):
        adopt(database, second)
    assert current(database) == "2:camera_response"
    assert adopt(database, second, force=True) == "3:slope_error"


def test_study_that_is_adopted_by_force_again_stays_one_version(database: Database):
    first, second = add(database, GAMMA), add(database, SLOPE)
    assert [adopt(database, first, force=True) for _ in range(8)] == ["2:camera_response"] * 8
    with database.reading() as session:
        assert len(model_versions.list_models(session)) == 1
        assert len(audit.entries(session, 10)) == 1
    # Over another that is current by now it is another version again.
    assert adopt(database, second, force=True) == "3:slope_error"
    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(lambda _: adopt(database, first, force=True), range(8))) == {
            "4:camera_response"
        }


def test_an_adopted_effect_gets_its_end_in_the_current_version(database: Database):
    """Another study was adopted since; its effects stay."""
    since = {"kind": "since", "since": "2026-06-01", "until": None, "heliostats": None}
    first = add(database, SLOPE | {"scope": since})
    adopt(database, first)
    adopt(database, add(database, GAMMA, model=2))
    with database.reading() as session:
        adopted = model_versions.adopted_effects(session)
    studies = {one.effect.name: one.study.id for one in adopted}
    assert studies == {"camera_response": first + 1, "slope_error": first}
    ends = {"slope_error": date(2026, 6, 7)}
    with database.changing() as session:
        row = model_versions.adopt(session, first, "tester", ends=ends)
        assert row.version == "4:slope_error+camera_response"
        assert [effect.get("scope") for effect in row.effects] == [
            since | {"until": "2026-06-07"},
            None,
        ]
    with database.reading() as session:
        assert [a.effect.name for a in model_versions.adopted_effects(session)] == [
            "camera_response"
        ]
        assert audit.entries(session, 1)[0].detail["until"] == {"slope_error": "2026-06-07"}


def test_study_that_found_nothing_is_not_adopted(database: Database):
    nothing, unexplained_study = add(database), add(database, GAMMA, verdict="unexplained")
    for force in (False, True):
        with pytest.raises(ConflictError, match="found no effect"):
            adopt(database, nothing, force)
        with pytest.raises(ConflictError, match="camera_response explains only part of the error"):
            adopt(database, unexplained_study, force)


def test_of_those_who_adopt_at_once_one_is_first(database: Database):
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
    studies = [add(database, GAMMA) for _ in range(4)]

    def attempt(study: int) -> str | None:
        try:
            return adopt(database, study)
        except ConflictError:
            return None

    with ThreadPoolExecutor(4) as pool:
        outcomes = sorted(pool.map(attempt, studies), key=str)
    assert outcomes == ["2:camera_response", None, None, None]


def test_name_of_a_model_with_every_effect_fits_its_column():
    assert len(model_version(kind() for kind in CATALOGUE.values())) + 10 <= MODEL_VERSION


# --- over HTTP
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def stored(client: TestClient) -> Database:
    """The service's database."""
    return cast(Database, cast(FastAPI, client.app).state.runtime.database)


def work(client: TestClient) -> None:
    runtime = cast(FastAPI, client.app).state.runtime
    assert Worker(runtime, KINDS, "tester", threading.Event()).work()


def test_models_are_listed_with_what_became_of_them(client: TestClient, stored: Database):
    declared = client.get("/v1/models/current").json()
    assert (declared["version"], declared["study"]) == (1, None)
    path = f"/v1/studies/{add(stored, GAMMA)}"
    assert client.get(path).json()["adopted"] is None
    client.post(f"{path}/adopt")
    adopted = client.get("/v1/models/current").json()
    assert (adopted["version"], adopted["adopted_by"]) == (2, "local")
    assert adopted["effects"] == [
        {"name": "camera_response", "parameters": {"gamma": 0.8, "saturation": 1.0}}
    ]
    assert [entry["is_current"] for entry in client.get("/v1/models").json()["items"]] == [
        False,
        True,
    ]
    client.post(f"{path}/withdraw")
    first, second = client.get("/v1/models").json()["items"]
    assert (first["is_current"], second["is_current"], second["withdrawn_by"]) == (
        True,
        False,
        "local",
    )


def test_studies_are_listed_newest_first(client: TestClient, stored: Database):
    first, second = add(stored, GAMMA), add(stored)
    client.post(f"/v1/studies/{first}/adopt")
    page = client.get("/v1/studies", params={"limit": 1}).json()
    assert [(item["id"], item["verdict"]) for item in page["items"]] == [(second, "none")]
    rest = client.get("/v1/studies", params={"after": page["next"]}).json()
    assert [(item["id"], item["adopted"]) for item in rest["items"]] == [(first, 2)]


def test_conflicts_say_what_to_do(client: TestClient, stored: Database):
    first, second = add(stored, GAMMA), add(stored, SLOPE)
    assert client.post(f"/v1/studies/{first}/withdraw").status_code == 409
    assert client.post(f"/v1/studies/{first}/adopt").status_code == 201
    again = client.post(f"/v1/studies/{second}/adopt", json={"force": False})
    assert (again.status_code, "make another study" in again.json()["detail"]) == (409, True)
    assert client.post(f"/v1/studies/{second}/adopt", json={"force": True}).status_code == 201
    for action in ("adopt", "withdraw", "report"):
        answer = client.request("GET" if action == "report" else "POST", f"/v1/studies/99/{action}")
        assert answer.status_code == 404
    assert client.get(f"/v1/studies/{first}/report").status_code == 404  # this one has no page


def test_audit_trail_names_who_adopted_and_withdrew(client: TestClient, stored: Database):
    path = f"/v1/studies/{add(stored, GAMMA)}"
    client.post(f"{path}/adopt")
    client.post(f"{path}/withdraw")
    with stored.reading() as session:
        entries = session.scalars(
            select(AuditRow).where(AuditRow.action.startswith("effect."))
        ).all()
    about = {"model": "2:camera_response"}
    assert [(e.actor, e.action, e.subject, e.detail) for e in entries] == [
        ("local", "effect.adopted", "study 1", about | {"effects": ["camera_response"]}),
        ("local", "effect.withdrawn", "study 1", about),
    ]


@pytest.fixture
def roles(client: TestClient, stored: Database) -> dict[str, dict[str, str]]:
    """Headers by role."""
    with stored.writing() as session:
        made = {
            role: keys.create(session, role, role, "tester")
            for role in ("read", "ingest", "operate", "admin")
        }
    return {role: {"Authorization": f"Bearer {key}"} for role, key in made.items()}


def test_only_operators_change_the_model(
    client: TestClient, stored: Database, roles: dict[str, dict[str, str]]
):
    path = f"/v1/studies/{add(stored, GAMMA)}"
    for role in ("read", "ingest"):
        for action in ("adopt", "withdraw"):
            assert client.post(f"{path}/{action}", headers=roles[role]).status_code == 403
        assert client.post("/v1/jobs/studies", json={}, headers=roles[role]).status_code == 403
        assert client.get(path, headers=roles[role]).status_code == 200
        assert client.get("/v1/models/current", headers=roles[role]).json()["version"] == 1
    assert client.post(f"{path}/adopt", headers=roles["operate"]).json()["adopted_by"] == "operate"
    assert client.post(f"{path}/withdraw", headers=roles["admin"]).status_code == 200


def test_everything_that_is_made_uses_the_model_that_is_asked_for(
    client: TestClient, stored: Database, post: Post, operations: FakeOperations
):
    post(png(1))
    client.post(f"/v1/studies/{add(stored, GAMMA)}/adopt")
    plane = {key: FORECAST[key] for key in ("target", "sun", "surface", "resolution")}
    for wanted, version, names in (({}, 2, ["camera_response"]), ({"model_version": 1}, 1, [])):
        forecast = client.post("/v1/forecasts", json=FORECAST | wanted).json()
        surface = client.post("/v1/heliostats/AA39/surfaces", json=wanted).json()
        assert (forecast["model_version"], surface["model_version"]) == (version, version)
        assert [effect.name for effect in operations.forecasts[-1]["model"].effects] == names
        assert [effect.name for effect in operations.models[-1].effects] == names
        fleet = client.post("/v1/jobs/forecasts", json=plane | wanted)
        work(client)
        assert client.get(fleet.headers["Location"]).json()["result"]["model_version"] == version
        client.post("/v1/jobs/predictions", json=wanted)
        work(client)
        assert client.get("/v1/heliostats/AA39/surfaces/current").json()["model_version"] == version
    assert operations.models
    sites = [model.site.origin for model in (operations.forecasts[-1]["model"], *operations.models)]
    assert set(sites) == {ORIGIN}


def test_forecast_is_made_under_the_declared_sun(
    client: TestClient, stored: Database, operations: FakeOperations
):
    with stored.writing() as session:
        put_declared(session, {"sun": {"shape": "gaussian", "sigma_mrad": 2.0}})
    assert client.get("/v1/plant").json()["declared"]["sun"]["shape"] == "gaussian"
    client.post("/v1/forecasts", json=FORECAST | {"dni_w_m2": 800})
    optics = operations.forecasts[-1]["model"].optics
    assert (optics.sun_shape, optics.dni) == (Gaussian(0.002), 800)


def test_forecast_by_the_first_version_stays_the_same(
    client: TestClient, stored: Database, operations: FakeOperations
):
    wanted = FORECAST | {"model_version": 1}
    client.post("/v1/forecasts", json=wanted)
    with stored.writing() as session:
        put_declared(session, DECLARED, "tester")
    again = client.post("/v1/forecasts", json=wanted).json()
    first, second = (made["model"] for made in operations.forecasts)
    assert (repr(first.optics), first.effects) == (repr(second.optics), second.effects)
    assert again["model_version"] == 1
    assert client.post("/v1/forecasts", json=FORECAST).json()["model_version"] == 2
    listed = client.get("/v1/models").json()["items"]
    assert [(m["version"], m["declared"], m["study"]) for m in listed] == [
        (1, None, None),
        (2, DECLARED, None),
    ]
    assert "another declaration" in client.get("/studies").text


def test_version_that_is_not_there_is_not_found(client: TestClient, post: Post):
    post(png(1))
    for path, body in (("forecasts", FORECAST), ("heliostats/AA39/surfaces", {})):
        answer = client.post(f"/v1/{path}", json=body | {"model_version": 7})
        assert (answer.status_code, "/v1/models" in answer.json()["detail"]) == (404, True)
    job = client.post("/v1/jobs/predictions", json={"model_version": 7}).headers["Location"]
    work(client)
    assert "no version 7" in client.get(job).json()["reason"]


# --- the command line
# -------------------------------------------------------------------------------------------------


def set_plant() -> None:
    """Make the store that the environment names, with a plant."""
    assert exit_code("migrate") == 0
    database = Database(Settings().database)
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
    database.close()


def test_report_of_a_folder_is_adopted_and_withdrawn_by_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    set_plant()
    capsys.readouterr()
    file = tmp_path / "report.json"
    file.write_text(json.dumps(report_of(GAMMA)))
    assert exit_code("migrate") == 0
    capsys.readouterr()
    assert exit_code("models", "adopt", str(file), "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "study": 1,
        "version": 2,
        "outdated_surfaces": {},
    }
    assert exit_code("models", "list", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert [(entry["version"], entry["is_current"]) for entry in listed] == [(1, False), (2, True)]
    assert listed[1]["adopted_by"].startswith("cli")
    assert exit_code("models", "withdraw", "1") == 0
    assert capsys.readouterr().out.strip() == "version 1 is current"
    assert exit_code("models", "withdraw", "1") == 1
    assert exit_code("models", "list") == 0
    assert "current" in capsys.readouterr().out


def test_report_is_adopted_into_the_version_that_it_was_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    set_plant()
    capsys.readouterr()
    file = tmp_path / "report.json"

    def adopt(found: dict[str, Any], known: list[dict[str, Any]]) -> int:
        file.write_text(json.dumps(report_of(found) | {"model": {"effects": known}}))
        return exit_code("models", "adopt", str(file))

    slope = {
        "name": "slope_error",
        "parameters": {"sigma_mrad": {"value": 0.5, "ci95": [0.4, 0.6], "unit": "mrad"}},
    }
    assert exit_code("migrate") == 0
    assert adopt(slope, [GAMMA]) == 1
    assert "camera_response" in capsys.readouterr().err
    assert adopt(GAMMA, []) == 0
    assert adopt(slope, [GAMMA]) == 0
    capsys.readouterr()
    assert adopt(slope, []) == 1  # made with version 1, and version 3 is current
    assert "version 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("document", "word"),
    [
        ([], "report"),
        (report_of(GAMMA) | {"verdict": "perhaps"}, "verdict"),
        (report_of(GAMMA) | {"before": 3}, "before"),
        (report_of({"name": "magic"}), "magic"),
        (
            report_of(
                {
                    "name": "slope_error",
                    "parameters": {"sigma_mrad": {"value": 99, "ci95": [98, 99], "unit": "mrad"}},
                }
            ),
            "sigma_mrad",
        ),
    ],
)
def test_file_that_is_no_report_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    document: Any,
    word: str,
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    assert exit_code("migrate") == 0
    capsys.readouterr()
    file = tmp_path / "report.json"
    file.write_text(json.dumps(document))
    assert exit_code("migrate") == 0
    assert exit_code("models", "adopt", str(file)) == 2
    assert word in capsys.readouterr().err
    capsys.readouterr()
    assert exit_code("models", "list", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)) == 1
