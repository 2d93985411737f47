"""Photographs over HTTP: once each, kept when refused, bounded, read back in every
representation.
"""

import io
import json
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL

from model.ephemeris import sun_angles_at
from service.base.settings import Settings
from service.web.app import create_app
from tests.service.access import bearer, make_key
from tests.service.conftest import (
    ORIGIN,
    FakeOperations,
    Post,
    client_of,
    metadata,
    png,
    spot_of,
    sun_at,
)
from tests.waiting import WAIT_LIMIT_S

BASE = "/v1/heliostats/AA39/measurements"


def test_measurement_is_stored_and_read_back(client: TestClient, post: Post):
    sent = {
        "id": "205363",
        "taken_at": "2024-05-01T10:00:00+02:00",
        "motor_position": {"axis_1_motor_position": 30076, "axis_2_motor_position": 37935},
        "focal_spot_m": (spot := spot_of(50.9, 6.38, 122.0)),
        "helios_spot_m": (helios := spot_of(50.9, 6.38, 122.1)),
    }
    created = post(**sent)
    assert created.status_code == 201
    body = created.json()
    assert created.headers["Location"] == f"{BASE}/205363"
    assert body["id"] == body["external_id"] == "205363"
    assert (body["accepted"], body["reason"], body["center_of_mass_m"]) == (
        True,
        None,
        [0.5, -0.25],
    )
    assert body["motor_position"] == [30076, 37935]
    assert (body["focal_spot_m"], body["helios_spot_m"]) == (spot, helios)
    assert body["taken_at"] == "2024-05-01T08:00:00Z"
    assert body["quality"]["accepted"] is True
    assert (body.pop("filled"), body.pop("ignored")) == ([], [])
    assert client.get(f"{BASE}/205363").json() == body


def test_plain_pairs_are_taken_too(post: Post):
    body = post(motor_position=[1, 2], helios_spot_m=(spot := spot_of(50.9, 6.38, 122.0))).json()
    assert (body["motor_position"], body["focal_spot_m"]) == ([1, 2], spot)


def test_same_image_is_one_measurement(client: TestClient, post: Post, operations: FakeOperations):
    first, second = post(id="1"), post(id="1")
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json() == second.json()
    assert second.headers["Location"] == first.headers["Location"]
    assert operations.measured == 1
    assert len(client.get(BASE).json()["items"]) == 1


def test_refused_image_is_kept_with_its_reason(client: TestClient, post: Post):
    image = png(refused=True)
    created = post(image)
    assert created.status_code == 201
    body = created.json()
    assert (body["accepted"], body["reason"]) == (False, "no_spot")
    assert body["quality"]["detail"] == "no spot was found"
    assert client.get(f"{BASE}/{body['id']}/image").content == image
    octets = {"Accept": "application/octet-stream"}
    answer = client.get(f"{BASE}/{body['id']}/image", headers=octets)
    assert (answer.headers["Content-Type"], answer.content) == (octets["Accept"], image)
    flux = client.get(f"{BASE}/{body['id']}/flux")
    assert flux.status_code == 404
    assert "no_spot" in flux.json()["detail"]
    assert post(image).status_code == 200


def test_list_filters_and_pages(client: TestClient, post: Post):
    for seed in range(4):
        post(png(seed, refused=seed == 2), id=str(seed))
    assert [item["id"] for item in client.get(f"{BASE}?accepted=false").json()["items"]] == ["2"]
    page = client.get(f"{BASE}?accepted=true&limit=2").json()
    assert ([item["id"] for item in page["items"]], page["next"]) == (["0", "1"], "1")
    page = client.get(f"{BASE}?accepted=true&limit=2&after=1").json()
    assert ([item["id"] for item in page["items"]], page["next"]) == (["3"], None)
    assert client.get(f"{BASE}?after=nothing").status_code == 404


def test_image_comes_back_byte_for_byte(client: TestClient, post: Post):
    image = png(5)
    body = post(image).json()
    answer = client.get(f"{BASE}/{body['id']}/image")
    assert answer.content == image
    assert answer.headers["Content-Type"] == "image/png"
    assert answer.headers["ETag"] == f'"{body["image_sha256"]}"'
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_image_that_the_client_holds_is_not_sent_again(client: TestClient, post: Post):
    body = post(png(5)).json()
    path = f"{BASE}/{body['id']}/image"
    etag = client.get(path).headers["ETag"]
    for tags in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        answer = client.get(path, headers={"If-None-Match": tags})
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["ETag"] == etag
        assert "no-cache" in answer.headers["Cache-Control"]
    answer = client.get(path, headers={"If-None-Match": f'"{"0" * 64}"', "Range": "bytes=0-9"})
    assert (answer.status_code, answer.content) == (200, png(5))
    assert client.get(f"{BASE}/nothing/image", headers={"If-None-Match": "*"}).status_code == 404


def test_damaged_image_file_is_no_answer(client: TestClient, post: Post, settings: Settings):
    body = post(png(5)).json()
    sha256 = body["image_sha256"]
    (settings.data_dir / "images" / sha256[:2] / sha256[2:]).write_bytes(b"rotten")
    answer = client.get(f"{BASE}/{body['id']}/image", headers={"If-None-Match": '"other"'})
    assert answer.status_code == 500
    assert str(settings.data_dir) not in answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert b"rotten" not in answer.content
    assert post(png(5)).status_code == 200  # the caller's copy mends it
    assert client.get(f"{BASE}/{body['id']}/image").content == png(5)


def test_flux_in_every_representation(client: TestClient, post: Post):
    post(id="7")
    as_json = client.get(f"{BASE}/7/flux")
    assert as_json.headers["Content-Type"] == "application/json"
    assert as_json.headers["Vary"] == "Accept"
    assert np.shape(as_json.json()["flux"]) == (256, 256)
    assert np.sum(as_json.json()["centered"]) == pytest.approx(100)
    for media_type in ("application/x-npz", "application/vnd.numpy.npz"):
        answer = client.get(f"{BASE}/7/flux", headers={"Accept": media_type})
        assert answer.headers["Content-Type"] == media_type
        arrays = np.load(io.BytesIO(answer.content), allow_pickle=False)
        assert {name: arrays[name].shape for name in arrays} == {
            "flux": (256, 256),
            "centered": (64, 64),
        }
    picture = client.get(f"{BASE}/7/flux", headers={"Accept": "image/png"})
    assert picture.headers["Content-Type"] == "image/png"
    assert cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR).ndim == 3
    refused = client.get(f"{BASE}/7/flux", headers={"Accept": "text/csv"})
    assert refused.status_code == 406
    assert refused.json()["offered"] == as_json.json().get("x", refused.json()["offered"])
    assert "image/png" in refused.json()["offered"]


def test_centered_image_has_no_place_on_the_target(client: TestClient, post: Post):
    body = post(id="7", kind="flux-centered").json()
    assert body["center_of_mass_m"] is None
    flux = client.get(f"{BASE}/7/flux").json()
    assert flux["flux"] is None
    assert np.shape(flux["centered"]) == (64, 64)
    assert client.get(f"{BASE}/7/flux", headers={"Accept": "image/png"}).status_code == 200


# --- what is refused
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sun": sun_at(elevation_deg=91)}, "sun.elevation_deg"),
        ({"sun": sun_at(elevation_deg=0)}, "sun.elevation_deg"),
        ({"sun": sun_at("x")}, "sun.azimuth_deg"),
        ({"kind": "photo"}, "kind"),
        ({"target": "../x"}, "target"),
        ({"id": "a/b"}, "id"),
        ({"taken_at": "2024-05-01T10:00:00"}, "taken_at"),
        ({"motor_position": [1]}, "motor_position"),
        ({"motor_position": {"axis_1_motor_position": 1}}, "motor_position"),
        ({"focal_spot_m": [1, 2]}, "focal_spot_m"),
        ({"focal_spot": [1, 2, 3]}, "focal_spot"),
        ({"corners": [[0, 0]] * 3}, "corners"),
        ({"typo": 1}, "typo"),
    ],
)
def test_wrong_metadata_is_named(refused_post: Post, changes: dict[str, Any], named: str):
    answer = refused_post(**changes)
    assert answer.status_code == 422
    assert any(error["field"].startswith(named) for error in answer.json()["errors"]), answer.json()


@pytest.mark.parametrize("text", ["", "{", "null", "[]", "x" * 10_000, '{"kind": "flux"}'])
def test_metadata_that_is_none(refused_post: Post, text: str):
    assert refused_post(raw=text).status_code == 422


@pytest.mark.parametrize(
    "data", [b"", b"GIF89a", b"<svg xmlns='http://www.w3.org/2000/svg'/>", b"\x00" * 100]
)
def test_file_of_another_format(refused_post: Post, data: bytes):
    answer = refused_post(data)
    assert answer.status_code == 415
    assert "PNG" in answer.json()["detail"]


def test_too_many_pixels(refused_post: Post):
    flat = cv2.imencode(".png", np.full((1000, 1000), 7, np.uint8))[1].tobytes()
    answer = refused_post(flat)
    assert answer.status_code == 422
    assert "pixels" in answer.json()["detail"]


def test_too_many_bytes(post: Post, settings: Settings):
    for size in (settings.max_image_bytes + 1, settings.max_image_bytes + 200_000):
        answer = post(png() + bytes(size - len(png())))
        assert answer.status_code == 413
        assert "bytes allowed" in answer.json()["detail"]


def test_body_without_announced_length_is_stopped(client: TestClient, settings: Settings):
    sent = 0

    def endless() -> Any:
        nonlocal sent
        yield b'--b\r\nContent-Disposition: form-data; name="image"; filename="a.png"\r\n\r\n'
        while sent < 100 * settings.max_image_bytes:
            sent += 50_000
            yield bytes(50_000)

    answer = client.post(
        BASE, content=endless(), headers={"Content-Type": "multipart/form-data; boundary=b"}
    )
    assert answer.status_code == 413


@pytest.mark.parametrize("content_type", ["application/json", "image/png", "text/plain", ""])
def test_body_that_is_no_form(refusing: TestClient, content_type: str):
    headers = {"Content-Type": content_type} if content_type else {}
    answer = refusing.post(BASE, content=png(), headers=headers)
    assert answer.status_code == 415
    assert "multipart/form-data" in answer.json()["detail"]


def test_form_without_its_parts(refusing: TestClient):
    answer = refusing.post(BASE, files={"other": ("x", b"y")})
    assert answer.status_code == 422
    assert {error["field"] for error in answer.json()["errors"]} == {"other"}
    empty = refusing.post(BASE, files={"image": ("x.png", png(1))})
    assert {error["field"] for error in empty.json()["errors"]} == {"metadata"}
    broken = refusing.post(
        BASE, content=b"nothing", headers={"Content-Type": "multipart/form-data; boundary=b"}
    )
    assert broken.status_code in (400, 422)
    no_boundary = refusing.post(
        BASE, content=b"nothing", headers={"Content-Type": "multipart/form-data"}
    )
    assert no_boundary.status_code in (400, 422)


@pytest.mark.parametrize("part", ["image", "metadata"])
def test_a_part_that_is_there_twice(client: TestClient, part: str):
    parts = [("image", ("a.png", png(1))), ("metadata", (None, json.dumps(metadata())))]
    parts.append(next(one for one in parts if one[0] == part))
    answer = client.post(BASE, files=parts)
    assert answer.status_code == 422
    assert f"{part}: is there twice" in answer.json()["detail"]


@pytest.mark.parametrize("end", ['"kind": "raw"}', '"sun": {"azimuth_deg": 1, "azimuth_deg": 2}}'])
def test_a_key_of_metadata_that_is_there_twice(client: TestClient, end: str):
    text = json.dumps(metadata())[:-1] + ", " + end
    answer = client.post(BASE, files={"image": ("a.png", png(1))}, data={"metadata": text})
    assert answer.status_code == 422
    assert "is there twice; keep one" in answer.text


@pytest.mark.parametrize("name", ["m.json", None])
def test_metadata_may_begin_with_a_byte_order_mark(client: TestClient, name: str | None):
    text = b"\xef\xbb\xbf" + json.dumps(metadata()).encode()
    files = {"image": ("a.png", png(1)), "metadata": (name, text)}
    assert client.post(BASE, files=files).status_code == 201


def test_a_part_that_is_not_known_is_not_dropped(client: TestClient):
    files = {"image": ("a.png", png(1)), "image2": ("b.png", png(2))}
    answer = client.post(BASE, files=files, data={"metadata": json.dumps(metadata())})
    assert answer.status_code == 422
    assert answer.json()["detail"] == (
        "image2: is not a part of this form; known are metadata, image"
    )


@pytest.mark.parametrize("when", [20260621, "20260621", "1781000000", "1781000000.5"])
def test_a_number_is_no_time(client: TestClient, when: object):
    text = json.dumps(metadata() | {"taken_at": when})
    answer = client.post(BASE, files={"image": ("a.png", png(1))}, data={"metadata": text})
    assert answer.json()["detail"] == "taken_at: must be a time such as 2026-06-21T11:36:00Z"


# --- at the same time
# -------------------------------------------------------------------------------------------------


def test_same_image_from_many_clients_is_one_measurement(
    store_url: URL, tmp_path: Path, tower: dict[str, Any], properties: dict[str, Any]
):
    """All requests pass the first look-up before any of them writes, and still one measurement
    comes of them.
    """
    clients = 6
    together = threading.Barrier(clients)

    class Waiting(FakeOperations):
        def measure(self, *arguments: Any, **options: Any) -> Any:
            together.wait(timeout=WAIT_LIMIT_S)
            return super().measure(*arguments, **options)

    url = store_url.render_as_string(hide_password=False)
    settings = Settings(data_dir=tmp_path / "data", database_url=url, parallel_computations=clients)
    files = {"image": ("spot.png", png(), "image/png")}
    with client_of(create_app(settings, Waiting())) as client:
        client.put("/v1/plant", json=tower)
        client.put("/v1/heliostats/AA39", json=properties)
        with ThreadPoolExecutor(clients) as pool:
            sending = [
                pool.submit(
                    client.post, BASE, files=files, data={"metadata": json.dumps(metadata(id="7"))}
                )
                for _ in range(clients)
            ]
            answers = [future.result() for future in sending]
        assert sorted(answer.status_code for answer in answers) == [200] * (clients - 1) + [201]
        assert len({answer.text for answer in answers}) == 1
        assert len(client.get(BASE).json()["items"]) == 1


@pytest.mark.parametrize(("hours", "says"), [(0, None), (2, "2 h ahead")])
def test_time_that_disagrees_with_the_sun_is_reported(post: Post, hours: int, says: str | None):
    moment = datetime(2024, 6, 21, 10, 0, tzinfo=UTC)
    azimuth, elevation = sun_angles_at(moment, ORIGIN)
    taken_at = (moment + timedelta(hours=hours)).isoformat()
    answer = post(png(1), sun=sun_at(azimuth, elevation), taken_at=taken_at)
    clock = answer.json()["quality"]["clock"]
    assert answer.status_code == 201
    assert clock is None if says is None else says in clock


def test_photograph_names_the_key_that_sent_it(client: TestClient, app: FastAPI, post: Post):
    post(png(1), id="1")
    key = bearer(make_key(app, "calibration", "ingest"))
    client.headers.update(key)
    assert post(png(2), id="2").json()["sent_by"] == "calibration"
    client.headers.update(bearer(make_key(app, "another", "ingest")))
    assert (
        post(png(2), id="2").json()["sent_by"] == "calibration"
    )  # sending it again by another key changes nothing
    listed = client.get("/v1/heliostats/AA39/measurements").json()["items"]
    assert [item["sent_by"] for item in listed] == ["local", "calibration"]
    assert "sent by calibration" in client.get("/heliostats/AA39/photographs/2").text
    table = client.get("/heliostats/AA39/photographs.csv").text.splitlines()
    at = table[0].split(",").index("sent_by")
    assert [line.split(",")[at] for line in table[1:]] == ["local", "calibration"]
