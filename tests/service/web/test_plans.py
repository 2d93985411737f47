"""Plans: a day of light on a receiver as a job, and its page."""

import itertools
import tracemalloc
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select, update

from model.fleet import FleetFlux, Losses
from model.plant import Cylinder, TargetPlane
from service.jobs.kinds.field_forecasts import FleetIn
from service.jobs.kinds.plans import PlanIn, aim_on, load_of
from service.store import queue
from service.store.columns import now
from service.store.deletion import prune_jobs, prune_plans
from service.store.job_tables import JobRow, JobStepRow
from service.web.resources import plans
from tests.page import Page
from tests.service.conftest import FakeOperations
from tests.service.web.pages import field_of, make_key, text_of, work
from tests.service.web.plans import DAY, planned

FORM = {
    "name": "June",
    "target": "lower",
    "first_at": "2026-06-21T02:00",
    "last_at": "2026-06-21T10:00",
    "step_minutes": "120",
}


def test_day_is_a_series_by_twin_and_ideal_mirrors(
    app: FastAPI, two_heliostats: TestClient, operations: FakeOperations
):
    job = planned(app, two_heliostats, allowed_w_m2=1.5)
    result = job["result"]
    # At two o'clock it is night in Jülich; the heliostat without a surface has an ideal mirror by
    # the twin, too.
    assert [step["at"][11:16] for step in result["steps"]] == ["04:00", "06:00", "08:00", "10:00"]
    assert (result["left_out"], result["heliostats"], result["skipped"]) == (1, 2, {})
    assert result["ideal_surfaces"] == ["AB01"]
    assert result["warnings"] == [
        "1 of 2 heliostats have no surface and are forecast as ideal mirrors; "
        "POST /v1/jobs/predictions predicts surfaces"
    ]
    assert (
        text_of(two_heliostats, f"/plans/{job['id']}").count("1 of 2 heliostats have no surface")
        == 1
    )
    elevations = [step["sun"]["elevation_deg"] for step in result["steps"]]
    assert elevations == sorted(elevations)
    for step in result["steps"]:
        for kind in ("twin", "ideal"):
            load = step[kind]
            assert (load["peak_w_m2"], load["reflected_w"]) == (4.0, 120.0)
            assert load["intercept"] == 1.0
            assert load["exceeded_m2"] == pytest.approx(
                result["plane"]["width"] * result["plane"]["height"]
            )
    assert len(operations.fleets) == 8
    maps = two_heliostats.get(
        f"/v1/jobs/{job['id']}/flux", headers={"Accept": "application/json"}
    ).json()
    assert np.shape(maps["flux"]) == (64, 64)
    for mirrors in ("twin", "ideal"):
        path = f"/v1/jobs/{job['id']}/flux?step=3&mirrors={mirrors}"
        assert np.shape(
            two_heliostats.get(path, headers={"Accept": "application/json"}).json()["flux"]
        ) == (64, 64)
    assert two_heliostats.get(f"/v1/jobs/{job['id']}/flux?step=4&format=npz").status_code == 404


def test_plan_reads_the_layout_once(
    app: FastAPI, two_heliostats: TestClient, monkeypatch: pytest.MonkeyPatch
):
    read, calls = FleetIn.fleet, itertools.count()
    monkeypatch.setattr(FleetIn, "fleet", lambda *given: (next(calls), read(*given))[1])
    assert len(planned(app, two_heliostats)["result"]["steps"]) == 4
    assert next(calls) == 1


def test_what_is_wrong_is_named(two_heliostats: TestClient):
    for changes, said in (
        ({"last_at": "2026-06-20T00:00:00Z"}, "last_at: give a time after first_at"),
        (
            {"step_minutes": 1},
            "first_at, last_at, step_minutes, resolution: 481 times of 64 x 64 pixels are too many",
        ),
        ({"allowed_w_m2": 0}, "allowed_w_m2"),
        ({"name": " "}, "name"),
    ):
        answer = two_heliostats.post("/v1/jobs/plans", json=DAY | changes)
        assert answer.status_code == 422
        assert said in answer.json()["detail"]


ENDLESS = [
    {"first_at": "1970-01-01T00:00:00Z", "last_at": "8999-12-31T00:00:00Z", "step_minutes": 1},
    {"last_at": "2036-06-21T10:00:00Z"},
    {"last_at": "2026-06-25T10:00:00Z", "resolution": 1024},
    {"resolution": [1024, 1024], "last_at": "2026-06-21T20:00:00Z"},
]


@pytest.mark.parametrize("changes", ENDLESS)
def test_plan_of_too_many_times_is_refused_without_making_them(
    two_heliostats: TestClient, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
):
    """A plan from 1970 to 8999 by the minute blocked the event loop, then memory ran out.

    99 large maps took 4.3 GB.
    """
    monkeypatch.setattr(PlanIn, "times", lambda _: pytest.fail("the times were made"))
    answer = two_heliostats.post("/v1/jobs/plans", json=DAY | {"step_minutes": 60} | changes)
    assert answer.status_code == 422
    said = answer.json()["detail"]
    assert "first_at, last_at, step_minutes, resolution" in said
    assert "at most 100 times, and 10000000 pixels in all" in said
    if "resolution" not in changes:
        form = {name: changes[name][:16] for name in ("first_at", "last_at") if name in changes}
        answer = two_heliostats.post("/plans", data=FORM | form | {"step_minutes": "1"})
        assert answer.status_code == 422


@pytest.mark.full
def test_memory_of_a_plan_and_its_page_does_not_grow_with_its_times(
    app: FastAPI, two_heliostats: TestClient
):
    """32 maps of 512 x 512 by twin and ideal mirrors are 64 MB; they are kept and read
    one by one.
    """
    asked = {"resolution": 512, "first_at": "2026-06-21T06:00:00Z", "step_minutes": 7.5}
    path = two_heliostats.post("/v1/jobs/plans", json=DAY | asked).headers["Location"]
    tracemalloc.start()
    try:
        work(app)
        made = tracemalloc.get_traced_memory()[1]
        tracemalloc.reset_peak()
        assert "06:07" in text_of(two_heliostats, path.replace("/v1/jobs", "/plans"))
        shown = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert two_heliostats.get(path).json()["result"]["times"] == 33
    assert made < 32e6
    assert shown < 32e6


def test_plan_that_is_begun_again_goes_on_with_the_time_it_stood_at(
    app: FastAPI,
    two_heliostats: TestClient,
    operations: FakeOperations,
    monkeypatch: pytest.MonkeyPatch,
):
    superpose, calls = operations.superpose, itertools.count(1)

    def fails_once(*arguments: Any, **options: Any) -> Any:
        if next(calls) == 5:
            raise OSError("once")
        return superpose(*arguments, **options)

    monkeypatch.setattr(operations, "superpose", fails_once)
    fast = replace(
        app.state.runtime, settings=app.state.runtime.settings.model_copy(update={"job_retry_s": 0})
    )
    monkeypatch.setattr(app.state, "runtime", fast)
    job = planned(app, two_heliostats)
    assert (job["state"], job["attempts"], len(job["result"]["steps"])) == ("done", 2, 4)
    assert len(operations.fleets) == 8
    assert {fleet["resolution"] for fleet in operations.fleets} == {(64, 64)}


def test_plan_of_the_night_fails_with_its_reason(app: FastAPI, two_heliostats: TestClient):
    job = planned(app, two_heliostats, last_at="2026-06-21T02:30:00Z")
    assert job["state"] == "failed"
    assert "night" in job["reason"]
    assert "night" in text_of(two_heliostats, f"/plans/{job['id']}")


def test_form_leads_to_the_plan_which_can_be_reopened(app: FastAPI, two_heliostats: TestClient):
    asked = FORM | {
        "heliostats": "AA39 0.5 -1\n\nAB01",
        "allowed_kw_m2": "0.0015",
        "dni_w_m2": "900",
    }
    path = two_heliostats.post("/plans", data=asked, follow_redirects=False).headers["Location"]
    assert 'hx-trigger="every 2s"' in text_of(two_heliostats, path)
    work(app)
    page = text_of(two_heliostats, path)
    assert "hx-trigger" not in page.partition("<main")[2]
    assert page.count('class="limit"') == 1
    # The form holds what was asked, and the list leads back.
    assert "AA39 0.5 -1\nAB01</textarea>" in page
    assert field_of(page, "allowed_kw_m2") == "0.0015"
    assert 'value="2026-06-21 02:00"' in page
    assert "2026-06-21 06:00 UTC</time></h2>" in text_of(two_heliostats, f"{path}?at=1")
    assert "2026-06-21 10:00 UTC</time></h2>" in text_of(two_heliostats, f"{path}?at=99")
    assert f'href="{path}">Open plan “June”</a>' in text_of(
        two_heliostats, path.replace("plans", "jobs")
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"heliostats": "AA39\nAB01 1"}, "line 2"),
        ({"heliostats": "AA39 a b"}, "line 1"),
        ({"heliostats": "AA/39"}, "heliostats"),
        ({"heliostats": "AA39 nan 1"}, "aim_offsets_m"),
        ({"last_at": "2026-06-20T02:00"}, "after first_at"),
        ({"first_at": ""}, "first_at"),
    ],
)
def test_form_says_what_is_wrong(two_heliostats: TestClient, changes: dict[str, str], said: str):
    answer = two_heliostats.post("/plans", data=FORM | changes)
    assert answer.status_code == 422
    assert said in answer.text


def test_only_a_plan_with_a_limit_leads_to_aims(two_heliostats: TestClient):
    answers = []
    for limit in ({}, {"allowed_kw_m2": "0.0015"}):
        asked = {"data": FORM | limit, "follow_redirects": False}
        path = two_heliostats.post("/plans", **asked).headers["Location"]
        answers.append(two_heliostats.post(f"{path}/aims", follow_redirects=False))
    refused, enqueued = answers
    assert (refused.status_code, "has no limit; plan it again" in refused.text) == (409, True)
    assert enqueued.status_code == 303
    job = two_heliostats.get(
        f"/v1{enqueued.headers['Location']}", headers={"Accept": "application/json"}
    ).json()
    assert (job["kind"], job["payload"]["limit_w_m2"]) == ("aim-plans", 1.5)


def test_form_names_heliostats_that_are_not_stored(two_heliostats: TestClient):
    answer = two_heliostats.post("/plans", data=FORM | {"heliostats": "AA39\nZZ99"})
    assert answer.status_code == 404
    assert "heliostats: ZZ99 not found" in answer.text


def test_errors_are_shown_next_to_the_form(two_heliostats: TestClient):
    """Which keeps what was typed: only the sentence is exchanged, or the browser goes on to the
    plan.
    """
    by_htmx = {"HX-Request": "true"}
    answer = two_heliostats.post("/plans", data=FORM | {"heliostats": "ZZ99"}, headers=by_htmx)
    assert (answer.status_code, answer.headers["HX-Retarget"]) == (404, "#notice")
    assert "heliostats: ZZ99 not found" in answer.text
    assert "<form" not in answer.text
    assert (
        two_heliostats.post("/plans", data=FORM, headers=by_htmx)
        .headers["HX-Redirect"]
        .startswith("/plans/")
    )


def test_plan_is_no_other_job(app: FastAPI, two_heliostats: TestClient):
    number = two_heliostats.post("/v1/jobs/predictions", json={}).json()["id"]
    assert "is no plan" in text_of(two_heliostats, f"/plans/{number}", 404)
    key = make_key(app, "read")
    two_heliostats.headers["Authorization"] = f"Bearer {key}"
    assert "plans need the role operate" in text_of(two_heliostats, "/plans")
    assert two_heliostats.post("/plans", data=FORM).status_code == 403


def test_offset_lies_on_the_receiver():
    plane = TargetPlane(
        "wall", np.array([0.0, 0, 50]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.0, 6.0
    )
    # Seen from the north, right is west.
    assert aim_on(plane, 1.0, -2.0) == pytest.approx((-1.0, 0.0, 48.0))
    drum = Cylinder(
        "drum",
        np.array([0.0, 4, 50]),
        np.array([0.0, 1, 0]),
        np.array([0.0, 0, 1]),
        4.0,
        6.0,
        360.0,
    )
    assert aim_on(drum, np.pi / 2 * 4, 1.0) == pytest.approx((-4.0, 0.0, 51.0))


def test_load_is_what_lands_and_what_is_too_much():
    """Four pixels of a square metre each: 3 and 1 W/m2 on two of them, of 8 W that the mirrors
    reflect.
    """
    plane = TargetPlane("wall", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 2.0, 2.0)
    losses = {"AA39": Losses(10.0, 0.8, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.9)}
    image = np.array([[3.0, 1.0], [0.0, 0.0]])
    load = load_of(FleetFlux(image, power=8.0, heliostats=1, losses=losses), plane, 2.0, 1.0)
    assert (load["power_w"], load["intercept"], load["spillage"], load["exceeded_m2"]) == (
        4.0,
        0.5,
        0.5,
        1.0,
    )
    field = load["field"]
    assert field is not None
    assert (field["incident_w"], field["intercepted_w"]) == (10.0, 4.0)
    assert (field["optical_efficiency"], field["absorbed_w"]) == pytest.approx((0.36, 3.6))
    dark = load_of(FleetFlux(np.zeros((2, 2))), plane, None, 1.0)
    assert (dark["intercept"], dark["field"]) == (None, None)


def aged(app: FastAPI) -> None:
    """Make all jobs end a year ago, and add a newer one."""
    with app.state.runtime.database.writing() as session:
        session.execute(update(JobRow).values(finished_at=now() - timedelta(days=365)))
        queue.add_job(session, "prunings", {}, "tester")


def purge(app: FastAPI) -> int:
    with app.state.runtime.database.writing() as session:
        return prune_jobs(session, timedelta(days=90))


def test_plans_outlive_other_jobs_and_can_be_deleted(app: FastAPI, two_heliostats: TestClient):
    job = planned(app, two_heliostats, name="kept")
    aged(app)
    assert purge(app) == 0
    assert ">kept</a>" in text_of(two_heliostats, "/plans")
    assert two_heliostats.get(f"/v1/jobs/{job['id']}/flux?format=npz").status_code == 200
    assert (
        two_heliostats.post(f"/plans/{job['id']}/delete", follow_redirects=False).headers[
            "Location"
        ]
        == "/plans"
    )
    assert ">kept</a>" not in text_of(two_heliostats, "/plans")
    document = two_heliostats.get(f"/v1/jobs/{job['id']}").json()
    assert (document["state"], document["result"], document["reason"]) == (
        "cancelled",
        None,
        "deleted by local",
    )
    (entry,) = [
        one
        for one in two_heliostats.get("/v1/audit").json()["items"]
        if one["action"] == "plan.deleted"
    ]
    assert (entry["actor"], entry["detail"]) == ("local", {"name": "kept"})
    assert two_heliostats.delete(f"/v1/jobs/{job['id']}").status_code == 409  # it is gone
    assert two_heliostats.delete("/v1/jobs/999").status_code == 404
    assert purge(app) == 1


def test_plans_expire_with_their_maps(app: FastAPI, two_heliostats: TestClient):
    """They were kept for ever: 580 MB each."""
    assert app.state.runtime.settings.plan_retention_days == 365
    planned(app, two_heliostats, name="old")
    aged(app)
    with app.state.runtime.database.writing() as session:
        assert prune_plans(session, timedelta(days=364)) == 1
        assert session.scalars(select(JobStepRow.name)).all() == []
    assert ">old</a>" not in text_of(two_heliostats, "/plans")
    (entry,) = [
        one
        for one in two_heliostats.get("/v1/audit").json()["items"]
        if one["action"] == "plans.pruned"
    ]
    assert entry["detail"] == {"older_than_days": 364}


def listed(page: Page) -> list[str]:
    return [name for name in page.texts("a") if name.startswith("plan ")]


def test_all_plans_are_listed(
    app: FastAPI, two_heliostats: TestClient, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(plans, "LISTED", 2)
    for number in range(3):
        two_heliostats.post("/v1/jobs/plans", json=DAY | {"name": f"plan {number}"})
    page = text_of(two_heliostats, "/plans")
    assert listed(page) == ["plan 2", "plan 1"]
    older = page.one("a", rel="next")["href"]
    assert listed(text_of(two_heliostats, older)) == ["plan 0"]
