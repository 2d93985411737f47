"""Forecasts of a whole field over HTTP, with the real tracer, on both databases."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from heliotwin.demo.plant import TARGET
from model.fleet import Superposition
from model.frames import sun_direction
from service.jobs.kinds import KINDS, field_forecasts
from service.jobs.worker import Worker
from service.sources.documents import read_receivers
from service.sources.folder import read_folder
from service.store import queue
from service.twin import model_versions
from service.twin.forecasts import field_forecast
from tests.service.conftest import FakeOperations, Post, png
from tests.service.studies import add, adopt
from tests.service.twin.fields import FIELD, FLEET, SUN, runtime_of


def fleet(client: TestClient, **changes: Any) -> tuple[dict[str, Any], np.ndarray]:
    """Result and map of a fleet forecast that is worked at here."""
    answer = client.post("/v1/jobs/forecasts", json=FLEET | changes)
    assert answer.status_code == 202, answer.text
    assert Worker(runtime_of(client), KINDS, "tester", threading.Event()).work()
    job = client.get(answer.headers["Location"]).json()
    assert job["state"] == "done", job["reason"]
    return job["result"], np.array(client.get(answer.headers["Location"] + "/flux").json()["flux"])


def alone(client: TestClient, name: str, **changes: Any) -> np.ndarray:
    answer = client.post(
        "/v1/forecasts", json={"heliostat": name, "measured_states": False} | FLEET | changes
    )
    assert answer.status_code == 201, answer.text
    return np.array(client.get(answer.headers["Location"]).json()["flux"])


def test_field_is_the_sum_of_its_heliostats(field: TestClient):
    result, flux = fleet(field, neighbours=False)
    assert result["heliostats"] == 9
    assert (result["skipped"], result["ideal_surfaces"]) == ({}, ["B22"])
    assert result["warnings"] == [
        "1 of 9 heliostats have no surface and are forecast as ideal mirrors; "
        "POST /v1/jobs/predictions predicts surfaces"
    ]
    assert result["power_w"] < result["reflected_w"] < 9 * 8.3e3
    single = sum(alone(field, name) for name in FIELD)
    assert np.abs(flux - single).sum() < 0.01 * single.sum()
    assert result["peak_w_m2"] == pytest.approx(flux.max())


def test_neighbours_take_light_and_can_be_left_out(field: TestClient):
    names = ["B02", "B01", "B00", "B12"]
    free, _ = fleet(field, heliostats=names, neighbours=False)
    hidden, _ = fleet(field, heliostats=names, neighbours=True)
    assert hidden["reflected_w"] < 0.95 * free["reflected_w"]


def test_heliostats_aim_at_given_points(field: TestClient):
    aside = list(TARGET.to_enu((1.5, 0.0)))
    _, flux = fleet(field, heliostats=["B00", "B01"], aim_points_m={"B01": aside}, neighbours=False)
    expected = alone(field, "B00") + alone(field, "B01", aim_point_m=aside)
    assert np.abs(flux - expected).sum() < 0.01 * expected.sum()


def test_receiver_is_stored_and_forecast_on(field: TestClient):
    cylinder = {
        "center": [0, 0, 40],
        "normal": [0, 2, 0],
        "radius": 2.5,
        "height": 8,
        "opening_deg": 180,
    }
    created = field.put("/v1/receivers/ring", json=cylinder)
    assert created.status_code == 201, created.text
    assert created.json()["normal"] == [0, 1, 0]
    assert field.put("/v1/receivers/ring", json=cylinder).status_code == 200
    assert field.get("/v1/receivers").json()["items"] == [field.get("/v1/receivers/ring").json()]
    stored, flux = fleet(field, target="ring", surface="ideal")
    assert flux.shape == (32, 32)
    assert stored["plane"]["width"] == pytest.approx(2.5 * np.pi)
    assert 0.9 * stored["reflected_w"] < stored["power_w"] < stored["reflected_w"]
    given, same = fleet(field, target=None, receiver=cylinder, surface="ideal")
    np.testing.assert_array_equal(same, flux)
    assert given["plane"]["radius"] == 2.5
    assert field.put(f"/v1/receivers/{TARGET.name}", json=cylinder).status_code == 409
    plane = {"center": [0, 0, 40], "normal": [0, 1, 0], "width": 3, "height": 3}
    assert field.put("/v1/targets/ring", json={"plane": plane}).status_code == 409


def test_one_heliostat_is_forecast_on_a_cylinder(field: TestClient):
    """Its map was 409, with the advice to ask for a field of one."""
    cylinder = {
        "center": [0, 0, 40],
        "normal": [0, 2, 0],
        "radius": 2.5,
        "height": 8,
        "opening_deg": 180,
    }
    field.put("/v1/receivers/ring", json=cylinder)
    _, expected = fleet(field, target="ring", heliostats=["B00"], measured_states=False)
    flux = alone(field, "B00", target="ring")
    np.testing.assert_array_equal(flux, expected)
    np.testing.assert_array_equal(alone(field, "B00", target=None, receiver=cylinder), flux)
    body = {"heliostat": "B00", **FLEET, "target": "ring", "measured_states": False}
    made = field.post("/v1/forecasts", json=body).json()
    assert made["plane"]["radius"] == 2.5
    assert made["plane"]["width"] == pytest.approx(2.5 * np.pi)
    assert np.abs(made["center_of_mass_m"]).max() < 0.2
    assert made["power_w"] == pytest.approx(
        flux.sum() * made["plane"]["width"] * 8 / flux.size, rel=1e-4
    )
    assert field.post("/v1/forecasts", json=body | {"window_m": 2.0}).status_code == 422
    page = field.get(f"/forecasts/{made['id']}", headers={"Accept": "text/html"}).text
    assert "the cylinder is unrolled" in page


@pytest.mark.full
def test_field_forecast_that_is_begun_again_goes_on_from_its_checkpoint(
    field: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """After a restart 2,000 mirrors began again at the first; and the sum is the same to the last
    bit.
    """
    monkeypatch.setattr(field_forecast, "tile_size", lambda _: 2)
    monkeypatch.setattr(field_forecasts, "_CHECKPOINT_EVERY_S", 0.0)
    runtime, traced = runtime_of(field), []
    trace = Superposition.__call__
    monkeypatch.setattr(
        Superposition,
        "__call__",
        lambda self, tile: (traced.append(len(tile)), trace(self, tile))[1],
    )
    whole, expected = fleet(field)
    assert traced == [2, 2, 2, 2, 1]
    traced.clear()
    number = int(
        field.post("/v1/jobs/forecasts", json=FLEET).headers["Location"].rpartition("/")[2]
    )
    stopping = threading.Event()
    keep = queue.save_checkpoint

    def keep_and_stop(session: Any, lease: Any, *part: Any) -> None:
        keep(session, lease, *part)
        stopping.set()

    with monkeypatch.context() as patched:
        patched.setattr(queue, "save_checkpoint", keep_and_stop)
        assert Worker(runtime, KINDS, "stopped", stopping).work()
    job = field.get(f"/v1/jobs/{number}").json()
    assert (job["state"], job["phase"], job["n_total"]) == ("queued", "tiles of the field", 5)
    before = len(traced)
    assert Worker(runtime, KINDS, "another", threading.Event()).work()
    job = field.get(f"/v1/jobs/{number}").json()
    assert (job["state"], job["result"]) == ("done", whole)
    assert len(traced) - before < 5
    np.testing.assert_array_equal(
        np.array(field.get(f"/v1/jobs/{number}/flux").json()["flux"]), expected
    )


def test_camera_changes_no_light_on_a_receiver(field: TestClient):
    database = runtime_of(field).database
    _, light = fleet(field)
    blur = {"name": "slope_error", "parameters": {"sigma_mrad": {"value": 2.0}}}
    gamma = {"name": "camera_response", "parameters": {"gamma": {"value": 0.5}}}
    for effect, is_same in ((gamma, True), (blur, False)):
        with database.reading() as session:
            current = model_versions.current_number(session)
        adopt(database, add(database, effect, model=current))
        result, seen = fleet(field)
        assert result["model_version"] == current + 1
        assert np.allclose(seen, light) == is_same
        plane = {
            "center": list(TARGET.center),
            "normal": list(TARGET.normal),
            "width": 4,
            "height": 4,
        }
        bare = alone(field, "B00", target=None, plane=plane, model_version=1)
        assert np.allclose(alone(field, "B00", target=None, plane=plane), bare) == is_same


def test_one_forecast_or_those_of_the_field(
    client: TestClient, operations: FakeOperations, post: Post
):
    post(png(1))
    body = {"target": "lower", "sun": SUN, "surface": "ideal"}
    assert client.post("/v1/forecasts", json=body | {"heliostat": "AA39"}).status_code == 201
    headers = {"Idempotency-Key": "noon"}
    asked = [
        client.post("/v1/jobs/forecasts", json=body, headers=headers).headers["Location"]
        for _ in range(2)
    ]
    assert asked[0] == asked[1]
    for path, wrong, named in (
        ("forecasts", body | {"heliostat": "AA39", "resolution": 4096}, "resolution.0: "),
        ("forecasts", body | {"heliostat": "AA39", "receiver": {}}, "receiver.center: is missing"),
        ("forecasts", body, "heliostat: is missing"),
        ("jobs/forecasts", body | {"resolution": 4096}, "resolution.0: "),
        ("jobs/forecasts", {"sun": SUN}, "give either target or plane, or receiver"),
        ("jobs/forecasts", [], "body: must be a JSON object"),
    ):
        answer = client.post(f"/v1/{path}", json=wrong)
        assert answer.status_code == 422
        assert named in answer.json()["detail"]


def test_receiver_of_the_tower_file(stj: Path):
    """Its edges lie where the inner corners were surveyed."""
    folder = read_folder(stj)
    cylinder = folder.plant.receivers["receiver"]
    assert (cylinder.radius, cylinder.opening_deg) == (4.14, 60)
    assert cylinder.height == pytest.approx(5.22, abs=0.01)
    edges = [cylinder.tangent(side * np.radians(30), 0.1, 0.1) for side in (-1, 1)]
    for plane, east in zip(edges, (2.06, -2.07), strict=True):
        np.testing.assert_allclose(
            plane.to_enu((0.0, cylinder.height / 2)), [east, 0.61, 57.59], atol=0.03
        )
        np.testing.assert_allclose(
            plane.to_enu((0.0, -cylinder.height / 2)), [east, -1.62, 52.86], atol=0.03
        )
    assert cylinder.normal @ sun_direction(0.0, -25.0) == pytest.approx(1, abs=1e-6)


def test_receiver_without_a_survey_is_left_out(tower: dict[str, Any]):
    assert read_receivers(tower) == {}
