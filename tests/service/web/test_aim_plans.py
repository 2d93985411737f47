"""The job `aim-plans` on an imported plant, and its page."""

import re
import threading
from collections.abc import Callable, Iterator
from datetime import date, timedelta
from datetime import time as clock
from itertools import pairwise
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.aiming import kernels
from model.frames import sun_direction
from service import store
from service.base.fields import start_of_day
from service.jobs import kind
from service.jobs.kinds import aim_plans
from service.sources.documents import read_heliostat
from service.sources.folder import read_folder
from service.sources.plant_tables import read_aims
from service.sources.schema import STORED
from service.store.columns import now
from service.twin import plant_setup
from service.twin.importing import import_folder
from tests.page import Page
from tests.service import real
from tests.service.sources.aim_plant import write_aim_plant
from tests.service.web.pages import HTML
from tests.waiting import until

BODY = {
    "target": "main",
    "sun": {"azimuth_deg": 180, "elevation_deg": 55},
    "dni_w_m2": 900,
    "limit_w_m2": 80e3,
}


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    root = tmp_path_factory.mktemp("plant")
    write_aim_plant(root / "plant")
    with real.client_on(root / "store") as client:
        import_folder(real.runtime_of(client), read_folder(root / "plant", whole_field=True))
        yield client


def planned(client: TestClient, **changes: Any) -> dict[str, Any]:
    """The job of a plan, when it has ended."""
    return real.done_job(client, "/v1/jobs/aim-plans", **BODY | changes)


@pytest.fixture(scope="module")
def job(plant: TestClient) -> dict[str, Any]:
    """A plan of all heliostats for one sun."""
    return planned(plant)


def test_plan_keeps_the_limit_and_its_aims_do_what_it_says(plant: TestClient, job: dict[str, Any]):
    result = job["result"]
    assert result["peak_p95_w_m2"] <= 1.002 * 80e3
    assert result["power_w"] > result["baseline"]["power_w"]
    assert result["power_w"] <= result["bound_w"] < 1.02 * result["power_w"]
    assert result["inactive"] == []
    aims = result["aim_points_m"]
    assert len(aims) == result["heliostats"] > 40
    body = {key: BODY[key] for key in ("target", "sun", "dni_w_m2")}
    body |= {"aim_points_m": aims, "resolution": [32, 80]}
    forecast = real.run_job(plant, "/v1/jobs/forecasts", **body)
    assert forecast["field"]["intercepted_w"] == pytest.approx(result["power_w"], rel=0.005)
    assert forecast["peak_w_m2"] == pytest.approx(result["peak_w_m2"], rel=0.03)


def test_page_shows_the_plan_and_gives_its_aims(
    plant: TestClient, job: dict[str, Any], tmp_path: Path
):
    page = Page(plant.get(f"/jobs/{job['id']}", headers={"Accept": "text/html"}).text)
    for words in ("Most that any aims can give", "Peak in 95 % of cases", "not active", "Flux"):
        assert words in page.words
    (tmp_path / "aims.csv").write_text(plant.get(f"/jobs/{job['id']}/aims.csv").text)
    aims = read_aims(tmp_path / "aims.csv", job["result"]["aim_points_m"])
    assert {name: list(aim) for name, aim in aims.items() if aim is not None} == job["result"][
        "aim_points_m"
    ]


@pytest.mark.full
def test_plan_begins_with_aims_of_a_moment_before(plant: TestClient, job: dict[str, Any]):
    first = job["result"]
    again = planned(plant, aim_points_m=first["aim_points_m"])["result"]
    assert again["power_w"] > 0.995 * first["power_w"]
    assert again["peak_p95_w_m2"] <= 1.002 * 80e3


@pytest.mark.full
def test_a_heliostat_in_the_towers_shadow_does_not_spoil_the_plan(tmp_path: Path):
    file = write_aim_plant(tmp_path / "plant")
    with file.open("a") as plant:
        plant.write("tower: {radius_m: 12, height_m: 75}\n")
    (tmp_path / "plant" / "layout.csv").write_text(
        "name,type,east_m,north_m,up_m\ndark,large,0,30,0\nlit,large,60,150,0\n"
    )
    with real.client_on(tmp_path / "store") as client:
        folder = read_folder(tmp_path / "plant", whole_field=True)
        import_folder(real.runtime_of(client), folder)
        result = planned(client)["result"]
        alone = planned(client, heliostats=["lit"])["result"]
    assert result["power_w"] == pytest.approx(alone["power_w"], rel=5e-3)
    assert result["power_w"] <= result["bound_w"]


@pytest.mark.full
def test_limit_over_the_map(plant: TestClient):
    result = planned(plant, limit_w_m2=[[200e3, 200e3], [70e3, 70e3]])["result"]
    assert result["limit_w_m2"] == pytest.approx(200e3)
    assert result["largest_share_of_limit"] <= 1.002


@pytest.mark.parametrize("limit", [0, -1, [], [[100, 100], [100]], [[100, 0]], "high", 1e9])
def test_a_wrong_limit_is_refused_by_its_name(plant: TestClient, limit: object):
    answer = plant.post("/v1/jobs/aim-plans", json=BODY | {"limit_w_m2": limit})
    assert answer.status_code == 422
    assert any("limit_w_m2" in error["field"] for error in answer.json()["errors"])


DAY = {
    "target": "main",
    "dni_w_m2": 900,
    "limit_w_m2": 80e3,
    "day": {"date": "2026-06-21", "first": "05:00", "last": "15:00", "step_minutes": 240},
}


@pytest.mark.full
def test_day_is_planned_step_by_step(plant: TestClient):
    """At 5 o'clock in Madrid the sun is below the horizon; each step keeps the limit."""
    job = real.done_job(plant, "/v1/jobs/aim-plans", **DAY)
    result = job["result"]
    assert (result["time_zone"], result["date"]) == ("Europe/Madrid", "2026-06-21")
    assert result["below_horizon"] == ["2026-06-21T03:00:00Z"]
    assert [step["at"] for step in result["steps"]] == [
        "2026-06-21T07:00:00Z",
        "2026-06-21T11:00:00Z",
    ]
    for step in result["steps"]:
        assert step["peak_p95_w_m2"] <= 1.002 * 80e3
        assert step["power_w"] <= step["bound_w"] < 1.03 * step["power_w"]
        assert step["seconds"]["all"] > 0
        assert step["single_aim_exceeded"]["places"] > 0
        assert step["single_aim_exceeded"]["worst"] > step["exceeded"]["worst"]
        assert step["drives"].keys() == step["aim_points_m"].keys()
    last = result["steps"][1]
    name, aim = next(iter(last["aim_points_m"].items()))
    drive = last["drives"][name]
    assert drive["motor_position"] is None
    assert drive["reason"] is None
    assert reflects(plant, name, drive["axis_angles_deg"], aim, last["sun"])
    page = Page(plant.get(f"/jobs/{job['id']}?step=1", headers={"Accept": "text/html"}).text)
    for words in ("Step 2: 2026-06-21 13:00 CEST", "exceed the limit, the worst by", "1 more"):
        assert words in page.words
    flux = plant.get(f"/v1/jobs/{job['id']}/flux?step=1", headers={"Accept": "application/json"})
    assert np.max(flux.json()["flux"]) == pytest.approx(last["peak_w_m2"])
    table = plant.get(f"/jobs/{job['id']}/aims.csv?step=1").text.splitlines()
    assert table[0].endswith(
        "active,motor_1_steps,motor_2_steps,axis_1_deg,axis_2_deg,drive_reason"
    )
    assert plant.get(f"/jobs/{job['id']}/aims.csv?step=2").status_code == 404
    assert day_plan_takes_the_aims(plant, job)


def reflects(
    client: TestClient, name: str, angles_deg: list[float], aim: list[float], sun: dict[str, float]
) -> bool:
    """Whether a mirror of the imported plant at these axis angles sends the sun to an aim."""
    with real.runtime_of(client).database.reading() as session:
        row = store.get_heliostat(session, name)
        origin = store.get_plant(session).origin
    heliostat = read_heliostat(name, row.properties, np.array(origin), STORED)
    attitude = heliostat.mount.attitude(np.radians(angles_deg))
    center = heliostat.mount.mirror_center(heliostat.position, attitude)
    ray = -sun_direction(sun["azimuth_deg"], sun["elevation_deg"])
    normal = attitude[:, 2]
    sent = ray - 2 * (ray @ normal) * normal
    toward = (np.array(aim) - center) / np.linalg.norm(np.array(aim) - center)
    return bool(np.linalg.norm(sent - toward) < 1e-4)


def day_plan_takes_the_aims(client: TestClient, job: dict[str, Any]) -> bool:
    """Its flux is that of the aim plan's step, and its page links to the aim plan."""
    body = {
        "name": "June",
        "target": "main",
        "dni_w_m2": 900,
        "first_at": "2026-06-21T11:00:00Z",
        "last_at": "2026-06-21T11:00:00Z",
        "resolution": [32, 80],
        "aim_plan": job["id"],
    }
    plan = real.done_job(client, "/v1/jobs/plans", **body)
    step, aimed = plan["result"]["steps"][0], job["result"]["steps"][1]
    assert (plan["result"]["aim_plan"], step["aims_of_step"]) == (job["id"], 1)
    assert step["twin"]["power_w"] == pytest.approx(aimed["power_w"], rel=0.005)
    page = Page(client.get(f"/plans/{plan['id']}", headers={"Accept": "text/html"}).text)
    assert f"of aim plan {job['id']}" in page.words
    for changes, status in (({"aim_plan": plan["id"]}, 404), ({"target": "board"}, 409)):
        answer = client.post("/v1/jobs/plans", json=body | changes)
        assert (answer.status_code, "aim_plan" in answer.json()["detail"]) == (status, True)
    return True


@pytest.mark.full
def test_exceeded_plan_gets_new_aims_in_the_browser(plant: TestClient):
    """By forms only: a plan exceeds the limit, aims are found, and a plan with them keeps it."""
    form = {
        "name": "June",
        "target": "main",
        "first_at": "2026-06-21T11:00",
        "last_at": "2026-06-21T13:00",
        "step_minutes": "120",
        "allowed_kw_m2": "80",
        "dni_w_m2": "900",
    }
    plan = sent(plant, "/plans", form)
    assert re.search(r"exceeds the limit of 80\S*\skW/m² at 2 of 2 times", plan.words)
    (action,) = (one["action"] for one in plan.all("form") if one["action"].endswith("/aims"))
    aims = sent(plant, action, {})
    for words in ("2 steps", "13:00 CEST", "No place exceeds"):
        assert words in aims.words
    (link,) = (a["href"] for a in aims.all("a") if a.words == "Plan the day with these aims")
    again = Page(plant.get(link, headers={"Accept": "text/html"}).text)
    filled = {
        field["name"]: field.attributes.get("value", "") for field in again.one("main").all("input")
    }
    kept = sent(plant, "/plans", form | {name: filled[name] for name in ("name", "aim_plan")})
    assert "kept at all times" in kept.words


@pytest.mark.full
def test_aims_are_found_under_a_map_of_limits(plant: TestClient):
    """From the form alone, without a plan before."""
    form = {"name": "June", "target": "main", "limit_map_kw_m2": "200 200\n70, 70"}
    form |= {"first_at": "2026-06-21T11:00", "last_at": "2026-06-21T11:00", "dni_w_m2": "900"}
    assert "No place exceeds" in sent(plant, "/aims", form).words


def sent(client: TestClient, path: str, form: dict[str, str]) -> Page:
    """The page that a form leads to, when its job is done."""
    answer = client.post(path, data=form, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    assert real.worker(client).work()
    return Page(client.get(answer.headers["Location"], headers={"Accept": "text/html"}).text)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "allowed_kw_m2"),
        ({"limit_map_kw_m2": "800 900\n800 x"}, "limit_map_kw_m2"),
        ({"limit_map_kw_m2": "800 900\n800"}, "rows of the same length"),
    ],
)
def test_a_wrong_form_of_aims_is_refused(plant: TestClient, changes: dict[str, str], said: str):
    times = {"first_at": "2026-06-21T11:00", "last_at": "2026-06-21T13:00"}
    answer = plant.post("/aims", data={"name": "June", "target": "main"} | times | changes)
    assert answer.status_code == 422
    assert said in answer.text


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sun": {"azimuth_deg": 180, "elevation_deg": 55}}, "either sun or day"),
        ({"day": None}, "either sun or day"),
        ({"day": {"date": "2026-06-21", "step_minutes": 1}}, "at most 100"),
        ({"day": {"date": "2026-06-21", "first": "12:00", "last": "11:00"}}, "after first"),
        ({"day": {"date": "2026-06-21", "first": "12:00Z"}}, "without a zone"),
        ({"day": {"date": "1969-06-21"}}, "1970"),
    ],
)
def test_a_wrong_day_is_refused_by_its_name(plant: TestClient, changes: dict[str, Any], said: str):
    answer = plant.post("/v1/jobs/aim-plans", json=DAY | changes)
    assert answer.status_code == 422
    assert said in str(answer.json())


def test_too_many_pixels_for_the_heliostats_are_refused(
    plant: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """Before a job is queued, also by the form, whose map has the default resolution."""
    answer = plant.post("/v1/jobs/aim-plans", json=BODY | {"resolution": [1024, 1024]})
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("resolution: 1024 x 1024 pixels for each of")
    monkeypatch.setattr(kernels, "MAX_PAIRS", 1000)
    for body in (BODY, DAY):
        assert plant.post("/v1/jobs/aim-plans", json=body).status_code == 422
    form = {"name": "June", "target": "main", "allowed_kw_m2": "80"}
    form |= {"first_at": "2026-06-21T11:00", "last_at": "2026-06-21T11:00"}
    answer = plant.post("/aims", data=form)
    assert (answer.status_code, "pixels for each of" in answer.text) == (422, True)


def test_a_day_of_too_many_pixels_is_refused(plant: TestClient):
    day = {"day": DAY["day"] | {"step_minutes": 60}, "resolution": [1024, 1024]}
    answer = plant.post("/v1/jobs/aim-plans", json=DAY | day)
    assert answer.status_code == 422
    assert "resolution: 11 steps of 1024 x 1024 pixels" in str(answer.json())


@pytest.mark.full
def test_a_plan_of_many_pixels_waits_for_another_one(
    plant: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """It is cancelled while another one has the memory, and no images were traced."""
    monkeypatch.setattr(aim_plans, "LARGE_PAIRS", 0)
    monkeypatch.setattr(kind, "_REPORT_EVERY_S", 0.0)
    traces = counted(monkeypatch, "trace_kernels", lambda _: None)
    runtime = real.runtime_of(plant)
    body = BODY | {"heliostats": some_names(plant)[:3]}
    path = plant.post("/v1/jobs/aim-plans", json=body).headers["Location"]
    worker = threading.Thread(target=real.worker(plant).work)
    with runtime.large_plan_slots.slot():
        worker.start()
        until(lambda: plant.get(path).json()["state"] == "running")
        plant.post(f"{path}/cancel")
        worker.join()
    assert (plant.get(path).json()["state"], traces) == ("cancelled", [])
    assert plant.get(path.removeprefix("/v1"), headers=HTML).status_code == 200
    assert planned(plant, **body)["state"] == "done"


def test_a_plan_of_many_pixels_is_no_short_job(plant: TestClient):
    runtime, names = real.runtime_of(plant), some_names(plant)
    coarse, fine = (
        aim_plans.expected_plan_s(
            aim_plans.AimPlanIn(**BODY, heliostats=names, resolution=resolution), runtime
        )
        for resolution in (None, (1024, 1024))
    )
    assert coarse < runtime.settings.short_job_s < fine


@pytest.mark.parametrize(
    ("zone", "day", "hours"),
    [
        ("America/Los_Angeles", date(2026, 3, 8), 23),
        ("America/Los_Angeles", date(2026, 11, 1), 25),
        ("Europe/Berlin", date(2026, 3, 29), 23),
        ("Europe/Berlin", date(2026, 10, 25), 25),
        ("Europe/Berlin", date(2026, 6, 21), 24),
    ],
)
def test_a_day_ends_when_its_clocks_say(zone: str, day: date, hours: int):
    """Also on a day of a clock change."""
    times = aim_plans.DayIn(date=day).times(zone)
    assert len(times) == hours
    assert {at.astimezone(ZoneInfo(zone)).date() for at in times} == {day}
    until_noon = aim_plans.DayIn(date=day, last=clock(12)).times(zone)
    assert until_noon[-1].astimezone(ZoneInfo(zone)).time() == clock(12)
    assert {b - a for a, b in pairwise(times)} == {timedelta(hours=1)}
    # The day of cameras and of lost light is as long.
    begin, end = (start_of_day(day, zone, later) for later in (0, 1))
    assert begin is not None
    assert end == begin + timedelta(hours=hours)


def test_a_longer_day_has_no_more_steps_than_others(plant: TestClient):
    """The clocks of Madrid show two o'clock twice."""
    day = {"date": "2026-10-25", "first": "01:30", "last": "03:05", "step_minutes": 1}
    answer = plant.post("/v1/jobs/aim-plans", json=DAY | {"day": day})
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("day.step_minutes: 156 steps are too many")


def outdated(client: TestClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get(
        "/v1/alarms", params={"reason": "aims_outdated"}
    ).json()["items"]
    return found


@pytest.mark.full
def test_a_change_since_todays_plan_raises_an_alarm_until_a_new_plan(plant: TestClient):
    noon = now().astimezone(ZoneInfo("Europe/Madrid")).replace(hour=13, minute=0, second=0)
    today = BODY | {"sun": {"at": noon.isoformat()}, "heliostats": some_names(plant)}
    job = real.done_job(plant, "/v1/jobs/aim-plans", **today)
    assert outdated(plant) == []
    name = today["heliostats"][0]
    path = f"/v1/heliostats/{name}"
    properties = plant.get(path).json()["properties"]
    properties["position_m"][2] += 0.01
    with real.runtime_of(plant).database.writing() as session:
        plant_setup.set_heliostat(
            session, plant_setup.Authorship("tester", "surveyed"), name, properties
        )
    (alarm,) = outdated(plant)
    assert f"plan {job['id']} of aims for today on main" in alarm["message"]
    assert f"properties of 1: {name}" in alarm["message"]
    metrics = plant.get("/metrics").text
    assert 'heliotwin_alarms{acknowledged="no",reason="aims_outdated",severity="1"} 1.0' in metrics
    real.done_job(plant, "/v1/jobs/aim-plans", **today)
    assert outdated(plant) == []


def some_names(client: TestClient) -> list[str]:
    return [row["name"] for row in client.get("/v1/heliostats").json()["items"][:20]]


def counted(monkeypatch: pytest.MonkeyPatch, name: str, then: Callable[[int], None]) -> list[str]:
    """Call ``then`` with the number of each call of a function of the job, before it is done."""
    function, calls = getattr(aim_plans, name), list[str]()

    def counting(*arguments: Any, **options: Any) -> Any:
        calls.append(name)
        then(len(calls))
        return function(*arguments, **options)

    monkeypatch.setattr(aim_plans, name, counting)
    return calls


@pytest.mark.full
def test_another_limit_takes_the_same_images(plant: TestClient, monkeypatch: pytest.MonkeyPatch):
    body: dict[str, Any] = {"sun": {"azimuth_deg": 170, "elevation_deg": 50}}
    traces = counted(monkeypatch, "trace_kernels", lambda _: None)
    first, lower = (planned(plant, limit_w_m2=limit, **body)["result"] for limit in (90e3, 70e3))
    assert len(traces) == 1
    assert lower["power_w"] < (1 + 1e-4) * first["power_w"]  # the target is large
    assert lower["peak_p95_w_m2"] <= 1.002 * 70e3
    assert lower["single_aim_power_w"] == first["single_aim_power_w"]
    name = next(iter(first["aim_points_m"]))
    properties = plant.get(f"/v1/heliostats/{name}").json()["properties"]
    properties["position_m"][2] += 0.01
    with real.runtime_of(plant).database.writing() as session:
        plant_setup.set_heliostat(
            session, plant_setup.Authorship("tester", "surveyed"), name, properties
        )
    planned(plant, limit_w_m2=70e3, **body)
    assert len(traces) == 2


@pytest.mark.full
def test_cancelled_day_ends_between_steps(plant: TestClient, monkeypatch: pytest.MonkeyPatch):
    path = plant.post("/v1/jobs/aim-plans", json=DAY).headers["Location"]

    def cancel(call: int) -> None:
        if call == 2:
            plant.post(f"{path}/cancel")

    monkeypatch.setattr(kind, "_REPORT_EVERY_S", 0.0)
    plans = counted(monkeypatch, "plan_aims", cancel)
    assert real.worker(plant).work()
    job = plant.get(path).json()
    assert (job["state"], job["result"], len(plans)) == ("cancelled", None, 2)
    assert plant.get(path.removeprefix("/v1"), headers=HTML).status_code == 200


@pytest.mark.full
def test_stopped_day_goes_on_with_its_step(plant: TestClient, monkeypatch: pytest.MonkeyPatch):
    path = plant.post("/v1/jobs/aim-plans", json=DAY).headers["Location"]
    worker = real.worker(plant)

    def stop(call: int) -> None:
        if call == 2:
            worker.stopping.set()

    plans = counted(monkeypatch, "plan_aims", stop)
    assert worker.work()
    assert plant.get(path).json()["state"] == "queued"
    assert real.worker(plant).work()
    job = plant.get(path).json()
    assert (job["state"], len(job["result"]["steps"]), len(plans)) == ("done", 2, 3)


@pytest.mark.full
def test_new_surface_and_new_model_raise_the_alarm(real_client: TestClient):
    noon = now().replace(hour=11, minute=0, second=0)  # of a plant without a time zone
    body = {"target": "multi_focus_tower", "sun": {"at": noon.isoformat()}, "limit_w_m2": 60e3}
    job = real.done_job(real_client, "/v1/jobs/aim-plans", **body)
    assert outdated(real_client) == []
    other = real_client.get("/v1/heliostats/AA39/surfaces", params={"source": "network"})
    choice = {"version": other.json()["items"][0]["version"], "reason": "better"}
    answer = real_client.put("/v1/heliostats/AA39/surfaces/current", json=choice)
    assert answer.status_code == 200, answer.text
    (alarm,) = outdated(real_client)
    assert f"plan {job['id']} of aims for today" in alarm["message"]
    assert "surface of 1: AA39" in alarm["message"]
    (study,) = real_client.get("/v1/studies").json()["items"]
    assert real_client.post(f"/v1/studies/{study['id']}/adopt", json=real.REASON).status_code == 201
    (alarm,) = outdated(real_client)
    assert "model" in alarm["message"]
