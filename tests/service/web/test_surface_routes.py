"""Surfaces over HTTP: predicted from stored images, kept as versions, found by time."""

import io
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from tests.service.conftest import FakeOperations, Post, png, spot_of, sun_at

BASE = "/v1/heliostats/AA39/surfaces"


def test_prediction_is_kept_as_a_version(
    client: TestClient, post: Post, operations: FakeOperations
):
    post(png(1), id="1", sun=sun_at(170))
    post(png(2), id="2", sun=sun_at(210), motor_position=[5, 6])
    created = client.post(BASE, json={})
    assert created.status_code == 201
    assert created.headers["Location"] == f"{BASE}/1"
    body = created.json()
    assert (body["version"], body["source"], body["model"]) == (1, "network", "fake-000000000000")
    assert body["measurements"] == ["1", "2"]
    assert np.shape(body["z"]) == (4, 8, 8)
    assert np.shape(body["control_points"]) == (4, 8, 8, 3)
    second = client.post(BASE, json={"method": "refined", "measurements": ["2"]}).json()
    assert (second["version"], second["source"], second["measurements"]) == (2, "refined", ["2"])
    history = client.get(BASE).json()
    assert [item["version"] for item in history["items"]] == [1, 2]
    assert "z" not in history["items"][0]
    assert client.get(f"{BASE}/current").json() == second
    assert client.get(f"{BASE}/1").json() == body


def test_observation_is_what_was_measured(
    client: TestClient, post: Post, operations: FakeOperations
):
    post(png(1), id="1", sun=sun_at(90, 30), motor_position=[5, 6])
    client.post(BASE, json={})
    (observation,) = operations.predictions[0]
    assert observation.identifier == "1"
    np.testing.assert_allclose(observation.sun, [np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(
        observation.target.to_plane(observation.center_of_mass), [0.5, -0.25], atol=1e-9
    )
    np.testing.assert_array_equal(observation.motor_position, [5, 6])
    assert observation.flux.sum() == pytest.approx(100)


def test_spot_of_a_centered_image_is_the_given_one(
    client: TestClient, post: Post, operations: FakeOperations, tower: dict[str, Any]
):
    given = tower["lower"]["coordinates"]["upper_left"]
    post(png(1), id="1", kind="flux-centered", focal_spot_m=spot_of(*given))
    post(png(2), id="2", kind="flux-centered")
    client.post(BASE, json={"measurements": ["1", "2"]})
    first, second = operations.predictions[0]
    lower = first.target
    np.testing.assert_allclose(
        lower.to_plane(first.center_of_mass), [-lower.width / 2, lower.height / 2], atol=0.02
    )
    np.testing.assert_allclose(second.center_of_mass, lower.center)


def test_newest_images_with_the_sun_far_apart_are_chosen(
    client: TestClient, post: Post, operations: FakeOperations
):
    for day, azimuth in enumerate((0, 50, 1, 2, 3, -50)):
        post(
            png(day),
            id=str(day),
            sun=sun_at(180 - azimuth),
            taken_at=f"2024-05-{day + 1:02}T10:00:00Z",
        )
    client.post(BASE, json={"images": 2})
    assert [observation.identifier for observation in operations.predictions[0]] == ["5", "1"]
    client.post(BASE, json={"images": 1})
    assert [observation.identifier for observation in operations.predictions[1]] == ["5"]


def test_prediction_is_valid_from_its_newest_image(client: TestClient, post: Post):
    post(png(1), id="1", taken_at="2024-05-01T10:00:00Z")
    post(png(2), id="2", taken_at="2024-07-01T10:00:00Z")
    client.post(BASE, json={"measurements": ["1", "2"]})
    client.post(BASE, json={"measurements": ["1"]})
    assert client.get(f"{BASE}/current").json()["version"] == 1
    at = {"at": "2024-06-01T00:00:00+02:00"}
    assert client.get(BASE, params=at).json()["version"] == 2
    assert client.get(f"{BASE}/current", params=at).json()["version"] == 2
    before = client.get(BASE, params={"at": "2024-01-01T00:00:00Z"})
    assert before.status_code == 404
    picture = client.get(BASE, params=at, headers={"Accept": "image/png"})
    assert picture.headers["Content-Type"] == "image/png"
    for wrong in (
        "2024-06-01T00:00:00",
        "0001-01-01T00:00:00+14:00",
        "9999-12-31T23:59:59-12:00",
        "now",
        "",
    ):
        assert client.get(BASE, params={"at": wrong}).status_code == 422


def test_surface_in_every_representation(client: TestClient, post: Post):
    post()
    client.post(BASE, json={})
    npz = client.get(f"{BASE}/1", headers={"Accept": "application/x-npz"})
    arrays = np.load(io.BytesIO(npz.content), allow_pickle=False)
    shapes = {name: arrays[name].shape for name in arrays}
    assert shapes == {"z": (4, 8, 8), "z_std": (4, 8, 8), "control_points": (4, 8, 8, 3)}
    np.testing.assert_array_equal(arrays["z"], client.get(f"{BASE}/1").json()["z"])
    picture = client.get(f"{BASE}/current", headers={"Accept": "image/png"}).content
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).std() > 10
    assert client.get(f"{BASE}/1", headers={"Accept": "text/html"}).status_code == 406


def test_prediction_without_images(client: TestClient, post: Post):
    answer = client.post(BASE, json={})
    assert answer.status_code == 409
    assert "post target images" in answer.json()["detail"]
    post(png(refused=True), id="1")
    assert client.post(BASE, json={}).status_code == 409
    chosen = client.post(BASE, json={"measurements": ["1"]})
    assert chosen.status_code == 409
    assert "no_spot" in chosen.json()["detail"]
    assert client.post(BASE, json={"measurements": ["2"]}).status_code == 404


@pytest.mark.parametrize(
    "body",
    [
        {"method": "guess"},
        {"images": 0},
        {"images": 9},
        {"images": 1.5},
        {"measurements": []},
        {"measurements": ["1"] * 9},
        {"measurements": ["../1"]},
        {"what": 1},
        [],
    ],
)
def test_wrong_request(refusing: TestClient, body: Any):
    assert refusing.post(BASE, json=body).status_code == 422


@pytest.mark.parametrize("version", ["0", "-1", "x", "1.5", "99999999999999999999", "2147483648"])
def test_wrong_version(refusing: TestClient, version: str):
    assert refusing.get(f"{BASE}/{version}").status_code == 422


def test_what_is_not_there(refusing: TestClient):
    assert refusing.get(f"{BASE}/1").status_code == 404
    assert refusing.get(f"{BASE}/current").status_code == 404
    assert refusing.get("/v1/heliostats/AB01/surfaces").status_code == 404
    assert refusing.post("/v1/heliostats/AB01/surfaces", json={}).status_code == 404


def test_refinement_takes_more_images_than_the_network(
    client: TestClient, post: Post, operations: FakeOperations
):
    for number in range(1, 12):
        post(png(number))
    path = "/v1/heliostats/AA39/surfaces"
    refused = client.post(path, json={"method": "network", "images": 11})
    assert refused.status_code == 422
    assert "images must lie in 1 to 8 for the method network, got 11" in refused.json()["detail"]
    assert client.post(path, json={"method": "refined", "images": 11}).status_code == 201
    assert max(map(len, operations.predictions)) == 11  # parts of them judge the rest
