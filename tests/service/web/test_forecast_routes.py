"""Forecasts over HTTP."""

import io
from typing import Any, cast

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.store.model_versions import put_declared
from tests.service.conftest import FakeOperations, Post

SUN = {"azimuth_deg": 180.0, "elevation_deg": 30.0}
PLANE = {"center": [0, -3, 36], "normal": [0, 1, 0], "width": 8.0, "height": 6.0}


def ask(client: TestClient, **changes: Any) -> Any:
    return client.post(
        "/v1/forecasts", json={"heliostat": "AA39", "sun": SUN, "surface": "ideal", **changes}
    )


def test_forecast_on_a_target(client: TestClient, operations: FakeOperations):
    created = ask(client, target="lower")
    assert created.status_code == 201
    body = created.json()
    assert created.headers["Location"] == f"/v1/forecasts/{body['id']}"
    assert (body["target"], body["surface_version"], body["unit"]) == ("lower", None, "W/m2")
    assert (body["peak_w_m2"], body["power_w"], body["center_of_mass_m"]) == (2.0, 50.0, [0.1, 0.2])
    assert body["resolution"] == [256, 256]
    assert "flux" not in body
    asked = operations.forecasts[0]
    assert asked["is_ideal"]
    assert asked["aim"] is None
    assert asked["model"].optics.dni == 1000
    np.testing.assert_allclose(asked["sun"], [0, -np.cos(np.pi / 6), 0.5], atol=1e-12)
    listed = client.get("/v1/forecasts").json()
    assert listed["items"] == [body]


def test_forecast_for_a_time(client: TestClient, operations: FakeOperations):
    body = ask(client, target="lower", sun={"at": "2026-06-21T13:36:00+02:00"}).json()
    assert body["at"] == "2026-06-21T11:36:00Z"
    assert body["sun"]["elevation_deg"] == pytest.approx(62.5, abs=0.1)
    np.testing.assert_allclose(operations.forecasts[0]["sun"][2], 0.887, atol=0.002)
    for sun, field in (
        ({"at": "2026-06-21T00:00:00Z"}, "at"),
        ({"at": "2026-06-21T11:36:00"}, "sun.at"),
        ({"at": "0001-01-01T12:00:00Z"}, "sun.at"),
        ({"azimuth_deg": 180}, "sun.elevation_deg"),
    ):
        answer = ask(client, target="lower", sun=sun)
        assert answer.status_code == 422
        assert answer.json()["detail"].startswith(f"{field}: ")


def test_forecast_on_any_plane(client: TestClient, operations: FakeOperations):
    body = ask(
        client,
        plane=PLANE,
        aim_point_m=[0, -3, 37],
        dni_w_m2=850,
        resolution=[16, 32],
        window_m=4,
        normalised=True,
    ).json()
    asked = operations.forecasts[0]
    np.testing.assert_array_equal(asked["plane"].center, PLANE["center"])
    np.testing.assert_array_equal(asked["aim"], [0, -3, 37])
    assert (asked["resolution"], asked["window"], asked["model"].optics.dni) == ((16, 32), 4, 850)
    assert (body["unit"], body["window_m"], body["target"]) == ("1", 4, None)
    flux = client.get(f"/v1/forecasts/{body['id']}").json()["flux"]
    assert np.shape(flux) == (16, 32)
    assert np.sum(flux) == pytest.approx(100, rel=1e-4)


def test_forecast_in_every_representation(client: TestClient):
    number = ask(client, target="lower", resolution=32).json()["id"]
    path = f"/v1/forecasts/{number}"
    npz = client.get(path, headers={"Accept": "application/vnd.numpy.npz"})
    flux = np.load(io.BytesIO(npz.content), allow_pickle=False)["flux"]
    assert (flux.shape, flux.dtype, flux[0, 0]) == ((32, 32), np.float32, 2.0)
    assert client.get(path).json()["flux"][0][0] == 2.0
    picture = client.get(path, headers={"Accept": "image/png"})
    assert picture.content.startswith(b"\x89PNG")
    assert client.get(path, headers={"Accept": "audio/*"}).status_code == 406


def test_what_a_camera_would_show_is_a_view_of_its_own(client: TestClient):
    database = cast(FastAPI, client.app).state.runtime.database
    with database.writing() as session:
        put_declared(
            session, {"effects": [{"name": "background", "parameters": {"level": 0.1}}]}, "tester"
        )
    path = f"/v1/forecasts/{ask(client, target='lower', resolution=32).json()['id']}"
    light, shown = (
        client.get(f"{path}{view}").json()["flux"][0][0] for view in ("", "?view=camera")
    )
    assert (light, shown) == (2.0, pytest.approx(2.2))
    refused = client.get(f"/v1/forecasts/{ask(client, plane=PLANE).json()['id']}?view=camera")
    assert (refused.status_code, "stored targets" in refused.json()["detail"]) == (409, True)


def test_surface_of_a_forecast(client: TestClient, post: Post, operations: FakeOperations):
    answer = ask(client, target="lower", surface="current")
    assert answer.status_code == 201, "a heliostat without a surface was refused"
    said = answer.json()
    assert (said["surface"], said["surface_version"]) == ("ideal", None)
    assert said["warnings"] == [
        "heliostat AA39 has no surface: this is the forecast of its ideal mirror; "
        "POST /v1/heliostats/AA39/surfaces predicts one"
    ]
    assert operations.forecasts[-1]["is_ideal"]
    page = client.get(f"/forecasts/{said['id']}", headers={"Accept": "text/html"}).text
    assert "AA39 has no surface: this is the forecast of its ideal mirror" in page
    assert ask(client, target="lower", surface="ideal").json()["warnings"] == []
    assert ask(client, target="lower", surface=1).status_code == 404
    post()
    client.post("/v1/heliostats/AA39/surfaces", json={})
    for surface in ("current", 1):
        said = ask(client, target="lower", surface=surface).json()
        assert (said["surface"], said["surface_version"], said["warnings"]) == ("stored", 1, [])
        assert not operations.forecasts[-1]["is_ideal"]


def test_forecasts_in_pages(client: TestClient, properties: dict[str, Any]):
    client.put("/v1/heliostats/AC43", json=properties)
    numbers = [
        ask(client, target="lower", heliostat=name).json()["id"]
        for name in ("AA39", "AC43", "AA39")
    ]
    page = client.get("/v1/forecasts?limit=2").json()
    assert [item["id"] for item in page["items"]] == numbers[:2]
    rest = client.get(f"/v1/forecasts?limit=2&after={page['next']}").json()
    assert [item["id"] for item in rest["items"]] == numbers[2:]
    of_one = client.get("/v1/forecasts?heliostat=AC43").json()
    assert [item["id"] for item in of_one["items"]] == [numbers[1]]
    assert client.get("/v1/forecasts?heliostat=AZ99").status_code == 404


def test_out_of_reach_is_the_callers_error(refusing: TestClient):
    answer = ask(refusing, target="lower", aim_point_m=[0, 0, -5])
    assert answer.status_code == 422
    assert "behind the mirror" in answer.json()["detail"]


def test_what_is_not_there(refusing: TestClient):
    assert ask(refusing, target="middle").status_code == 404
    assert ask(refusing, target="lower", heliostat="AB01").status_code == 404
    assert refusing.get("/v1/forecasts/1").status_code == 404


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({}, "target or plane"),
        ({"target": "lower", "plane": PLANE}, "target or plane"),
        (
            {"target": "lower", "sun": {"azimuth_deg": 180, "elevation_deg": 95}},
            "sun.elevation_deg",
        ),
        ({"target": "lower", "sun": {"azimuth_deg": 180}}, "sun.elevation_deg"),
        ({"target": "lower", "dni_w_m2": -1}, "dni_w_m2"),
        ({"target": "lower", "resolution": 4096}, "resolution"),
        ({"target": "lower", "resolution": [256]}, "resolution"),
        ({"target": "lower", "window_m": 0}, "window_m"),
        ({"target": "lower", "surface": "best"}, "surface"),
        ({"target": "lower", "surface": 0}, "surface"),
        ({"target": "lower", "aim_point_m": [1e300, 0, 0]}, "aim_point_m"),
        ({"plane": PLANE | {"up": [0, 1, 0]}}, "up"),
        ({"plane": PLANE | {"width": 1e9}}, "plane.width"),
        ({"target": "lower", "colour": "red"}, "colour"),
    ],
)
def test_wrong_field_is_named(refusing: TestClient, changes: dict[str, Any], named: str):
    answer = ask(refusing, **changes)
    assert answer.status_code == 422
    assert named in answer.json()["detail"]
