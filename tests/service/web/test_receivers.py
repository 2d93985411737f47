"""Receivers of every kind over HTTP."""

from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

PLANE = {"center": [0, 0, 62], "normal": [0, 2, 0], "width": 8, "height": 6}
PANEL = {"normal": [0, 1, 0], "width": 3, "height": 12}
PANELS = [{"center": [x, -5, 100], **PANEL} for x in (3, 0, -3)]
OPENING = [[7, -1, 94], [-7, -1, 94], [-7, 1, 106], [7, 1, 106]]
CYLINDER = {"center": [0, 4, 55], "normal": [0, 1, 0], "radius": 4, "height": 5}
EVERY = {
    "board": {"kind": "plane", **PLANE, "absorptance": 0.9},
    "drum": {"kind": "cylinder", **CYLINDER, "absorptance": 0.94},
    "walls": {"kind": "panels", "panels": PANELS, "absorptance": 0.92},
    "cave": {"kind": "cavity", "aperture": OPENING, "panels": PANELS, "absorptance": 0.97},
}
SUN = {"azimuth_deg": 180, "elevation_deg": 45}


@pytest.mark.parametrize("name", EVERY)
def test_receiver_comes_back_as_it_was_put(client: TestClient, name: str):
    path = f"/v1/receivers/{name}"
    created = client.put(path, json=EVERY[name])
    assert created.status_code == 201, created.text
    found = client.get(path).json()
    assert found == created.json()
    assert found.pop("name") == name
    assert client.put(path, json=found).status_code == 200
    assert client.get(path).json() == {"name": name, **found}
    for key, value in EVERY[name].items():
        if key not in ("panels", "normal"):
            assert found[key] == value
    if "panels" in found:
        assert [panel["center"] for panel in found["panels"]] == [one["center"] for one in PANELS]
    assert {item["name"] for item in client.get("/v1/receivers").json()["items"]} >= {name}
    assert client.delete(f"{path}?reason=mistake").status_code == 204


def test_receiver_may_change_its_kind(client: TestClient):
    for document in (*EVERY.values(), EVERY["board"]):
        assert client.put("/v1/receivers/main?reason=new", json=document).status_code in (200, 201)
        assert client.get("/v1/receivers/main").json()["kind"] == document["kind"]
    assert set(client.get("/v1/receivers/main").json()) == {
        *("name", "kind", "center", "normal", "up", "width", "height", "absorptance")
    }


@pytest.mark.parametrize(
    ("document", "named"),
    [
        ({"kind": "cone"}, "must have a known `kind`: plane, cylinder (the default), panels"),
        ({"kind": None, **CYLINDER}, "must have a known `kind`"),
        ([], "must be a JSON object"),
        ({"kind": "cavity", "panels": PANELS}, "aperture: is missing"),
        (EVERY["cave"] | {"aperture": OPENING[:2]}, "aperture"),
        (EVERY["cave"] | {"aperture": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]]}, "a plane"),
        (EVERY["walls"] | {"panels": [*PANELS, {**PANELS[0], "height": 2}]}, "one height"),
        (EVERY["walls"] | {"panels": []}, "panels"),
        (EVERY["walls"] | {"radius": 2}, "radius: is not known here"),
        (EVERY["board"] | {"absorptance": 1.2}, "absorptance"),
        (EVERY["board"] | {"width": 0.1}, "20 times"),
    ],
)
def test_receiver_that_is_not_understood_is_refused(
    refusing: TestClient, document: Any, named: str
):
    for answer in (
        refusing.put("/v1/receivers/main", json=document),
        refusing.post("/v1/jobs/forecasts", json={"receiver": document, "sun": SUN}),
    ):
        assert answer.status_code == 422, answer.text
        assert named in answer.json()["detail"]
    assert refusing.get("/v1/receivers/main").status_code == 404


def test_plant_document_brings_receivers_and_tower(client: TestClient, tower: dict[str, Any]):
    more = {"receivers": EVERY, "tower_size": {"radius_m": 8, "height_m": 120}}
    answer = client.put("/v1/plant?reason=surveyed", json=tower | more)
    assert answer.status_code == 200, answer.text
    assert answer.json()["tower_size"] == {"radius_m": 8, "height_m": 120}
    names = [item["name"] for item in client.get("/v1/receivers").json()["items"]]
    assert names == sorted(EVERY)
    again = client.put("/v1/plant", json=tower)  # what it does not name stays
    assert again.json()["tower_size"] == {"radius_m": 8, "height_m": 120}


def test_answers_take_what_documents_may_bring_beyond_the_bounds_of_requests(
    client: TestClient, tower: dict[str, Any]
):
    """PAINT's corners have no bounds but the shape: a sheet of 1.8 km."""
    places = {
        f"{row}_{column}": [50.9, 6.3 + east, height]
        for row, height in (("upper", 1600.0), ("lower", 100.0))
        for column, east in (("left", 0.025), ("right", 0.0))
    }
    wide = {"wide": {"type": "planar", "coordinates": places}}
    assert client.put("/v1/plant?reason=surveyed", json=tower | wide).status_code == 200
    answer = client.get("/v1/targets/wide")
    assert answer.status_code == 200, answer.text
    assert answer.json()["width"] > 1e3


def test_part_of_an_unknown_type_is_refused_not_dropped(
    refusing: TestClient, tower: dict[str, Any]
):
    """A cavity in PAINT's document was dropped without a word."""
    answer = refusing.put("/v1/plant", json=tower | {"cave": {"type": "cavity", "panels": []}})
    assert answer.status_code == 422
    assert "cave.type: 'cavity' is not understood" in answer.json()["detail"]
    wrong = tower | {"receivers": {"cave": EVERY["cave"] | {"aperture": []}}}
    answer = refusing.put("/v1/plant", json=wrong)
    assert answer.status_code == 422
    assert "receivers.cave.aperture" in answer.json()["detail"]


def test_places_on_panels_are_counted_along_them():
    from service.base.plant import receiver_from_json
    from service.jobs.kinds.plans import aim_on

    panels = [{"up": [0, 0, 1], **panel} for panel in PANELS]
    walls = receiver_from_json("walls", {**EVERY["walls"], "panels": panels})
    aims = [aim_on(walls, right, 1.0) for right in (-4.4, -3.0, 0.0, 2.0, 4.4)]
    np.testing.assert_allclose([aim[0] for aim in aims], [4.4, 3.0, 0.0, -2.0, -4.4], atol=1e-9)
    np.testing.assert_allclose([aim[2] for aim in aims], 101.0)
