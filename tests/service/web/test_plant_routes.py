"""Plant, targets and heliostats over HTTP."""

import copy
import json
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.page import Page

PLANE = {"center": [0, -3, 36], "normal": [0, 2, 0], "width": 8.6, "height": 7.2}


def test_plant_must_be_set_first(bare: TestClient, properties: dict[str, Any]):
    for answer in (
        bare.get("/v1/plant"),
        bare.put("/v1/heliostats/AA39", json=properties),
        bare.post("/v1/heliostats", json={"name": "AA39", "properties": properties}),
    ):
        assert answer.status_code == 409
        assert "/v1/plant" in answer.json()["detail"]


def test_plant_brings_its_targets(client: TestClient, tower: dict[str, Any]):
    assert client.get("/v1/plant").json() == {
        "name": "WRI1030197",
        "origin_wgs84": tower["power_plant_properties"]["coordinates"],
        "declared": None,
        "sun_shape": {"shape": "buie", "chi": 0.02, "csr": pytest.approx(0.0058, abs=1e-4)},
        "tower_size": None,
        "camera_choice": None,
    }
    listed = client.get("/v1/targets").json()
    assert [target["name"] for target in listed["items"]] == ["lower", "upper"]
    lower = client.get("/v1/targets/lower").json()
    assert lower["height"] == pytest.approx(7.0, abs=0.01)
    assert lower["normal"] == pytest.approx([0, 1, 0], abs=1e-3)
    assert lower["corners"]["upper_left"] == tower["lower"]["coordinates"]["upper_left"]
    assert client.put("/v1/plant", json=tower).status_code == 200


def test_sun_is_declared_by_its_true_circumsolar_share(client: TestClient, tower: dict[str, Any]):
    """And stated by both numbers, over REST and on its page."""
    sun = {"shape": "buie", "csr": 0.05}
    answer = client.put("/v1/plant?reason=surveyed", json=tower | {"declared": {"sun": sun}})
    assert answer.status_code == 200, answer.text
    found = answer.json()["sun_shape"]
    assert (found["shape"], found["csr"]) == ("buie", pytest.approx(0.05, abs=1e-4))
    assert found["chi"] != found["csr"]
    words = Page(client.get("/plant", headers={"Accept": "text/html"}).text).words
    assert "circumsolar share 5.0" in words
    wrong = {"declared": {"sun": sun | {"chi": 0.02}}}
    assert client.put("/v1/plant?reason=surveyed", json=tower | wrong).status_code == 422
    flat = {"declared": {"sun": {"shape": "pillbox", "half_angle_mrad": 4.65}}}
    assert (
        client.put("/v1/plant?reason=surveyed", json=tower | flat).json()["sun_shape"]
        == flat["declared"]["sun"]
    )
    words = Page(client.get("/plant", headers={"Accept": "text/html"}).text).words
    assert "half angle mrad 4.65" in words


def test_plant_does_not_move_under_its_heliostats(client: TestClient, tower: dict[str, Any]):
    moved = copy.deepcopy(tower)
    moved["power_plant_properties"]["coordinates"][2] = 90.0
    answer = client.put("/v1/plant?reason=surveyed", json=moved)
    assert answer.status_code == 409
    assert "origin is fixed" in answer.json()["detail"]


def test_target_names_are_checked_in_the_tower_document(bare: TestClient, tower: dict[str, Any]):
    tower["../lower"] = tower.pop("lower")
    answer = bare.put("/v1/plant", json=tower)
    assert answer.status_code == 422
    assert "../lower" in answer.json()["detail"]


def test_target_by_plane(client: TestClient):
    created = client.put("/v1/targets/screen", json={"plane": PLANE})
    assert created.status_code == 201
    assert created.json()["normal"] == [0, 1, 0]
    assert client.put("/v1/targets/screen", json={"plane": PLANE}).status_code == 200
    changed = client.put("/v1/targets/screen?reason=surveyed", json={"plane": PLANE | {"width": 5}})
    assert (changed.status_code, changed.json()["width"]) == (200, 5)
    assert client.get("/v1/targets/screen").json() == changed.json()


def test_what_locates_a_target_is_stored_with_it(client: TestClient):
    camera = {"corners_px": [[100, 80], [900, 90], [110, 700], [890, 690]]}
    client.put("/v1/targets/screen", json={"plane": PLANE, "marks": "l_brackets"})
    assert client.get("/v1/targets/screen").json()["marks"] == "l_brackets"
    seen = client.put(
        "/v1/targets/screen?reason=surveyed", json={"plane": PLANE, "camera": camera}
    ).json()
    assert (seen["marks"], seen["camera"]) == ("none", camera)
    again = client.put("/v1/targets/screen?reason=surveyed", json={"plane": PLANE | {"width": 5}})
    moved = again.json()
    assert (moved["width"], moved["camera"]) == (5, camera)


@pytest.mark.parametrize(
    ("located", "named"),
    [
        ({"marks": "dots"}, "marks"),
        ({"marks": "l_brackets", "camera": {"homography": [[1, 0, 0]] * 3}}, "leave one of both"),
        ({"camera": {"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}}, "mirrored"),
        ({"camera": {"homographie": []}}, "did you mean homography"),
        ({"camera": {"pose": {"position_m": [0, -50, 0], "look_at_m": [0, -3, 36]}}}, "focal"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(
    refusing: TestClient, located: dict[str, Any], named: str
):
    answer = refusing.put("/v1/targets/screen", json={"plane": PLANE} | located)
    assert (answer.status_code, named in answer.text) == (422, True), answer.text


def test_target_by_corners(client: TestClient, tower: dict[str, Any]):
    names = ("upper_left", "upper_right", "lower_left", "lower_right")
    corners = {name: tower["lower"]["coordinates"][name] for name in names}
    created = client.put("/v1/targets/copy", json={"corners": corners})
    assert created.status_code == 201
    assert created.json() == client.get("/v1/targets/lower").json() | {"name": "copy"}


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"plane": PLANE, "corners": {}},
        {"plane": PLANE | {"normal": [0, 0, 0]}},
        {"plane": PLANE | {"normal": [0, 0, 1]}},
        {"plane": PLANE | {"width": 0}},
        {"plane": PLANE | {"depth": 1}},
        {
            "corners": {
                name: [50, 6, 100]
                for name in ("upper_left", "upper_right", "lower_left", "lower_right")
            }
        },
    ],
)
def test_target_that_is_no_rectangle(refusing: TestClient, body: dict[str, Any]):
    assert refusing.put("/v1/targets/screen", json=body).status_code == 422
    assert refusing.get("/v1/targets/screen").status_code == 404


CYLINDER = {
    "center": [0, 0, 55.2],
    "normal": [0, 1, 0],
    "radius": 4.1,
    "height": 5.2,
    "opening_deg": 60,
}
SUN = {"azimuth_deg": 180, "elevation_deg": 45}


@pytest.mark.parametrize(
    "plane", [PLANE | {"width": 0.3, "height": 6.1}, PLANE | {"width": 1000, "height": 0.01}]
)
def test_plane_is_no_more_than_twenty_times_as_long_as_wide(
    refusing: TestClient, plane: dict[str, Any]
):
    """The tracer's grid has pixels as fine as the shorter side asks, as far as the longer one
    reaches.
    """
    for answer in (
        refusing.put("/v1/targets/strip", json={"plane": plane}),
        refusing.post("/v1/forecasts", json={"heliostat": "AA39", "plane": plane, "sun": SUN}),
        refusing.post("/v1/jobs/forecasts", json={"plane": plane, "sun": SUN}),
    ):
        assert answer.status_code == 422
        assert "no more than 20 times the other; give a larger plane" in answer.json()["detail"]


def test_target_of_four_corners_has_the_same_bound(refusing: TestClient, tower: dict[str, Any]):
    corners = {
        name: place for name, place in tower["lower"]["coordinates"].items() if name != "center"
    }
    low = {name: [*place[:2], 30 + ("upper" in name) / 10] for name, place in corners.items()}
    answer = refusing.put("/v1/targets/strip", json={"corners": low})
    assert (answer.status_code, "target strip: width" in answer.json()["detail"]) == (422, True)
    answer = refusing.put(
        "/v1/plant", json=tower | {"strip": tower["lower"] | {"coordinates": low}}
    )
    assert (answer.status_code, "target strip: width" in answer.json()["detail"]) == (422, True)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"opening_deg": 1e-9}, "opening_deg"),
        ({"height": 100}, "20 times"),
        ({"radius": 0.2, "opening_deg": 360}, "20"),
    ],
)
def test_cylinder_that_is_next_to_a_line_is_refused(
    refusing: TestClient, change: dict[str, Any], named: str
):
    for answer in (
        refusing.put("/v1/receivers/line", json=CYLINDER | change),
        refusing.post("/v1/jobs/forecasts", json={"receiver": CYLINDER | change, "sun": SUN}),
    ):
        assert (answer.status_code, named in answer.json()["detail"]) == (422, True)


def test_heliostat_comes_back_as_it_was_sent(client: TestClient, properties: dict[str, Any]):
    found = client.get("/v1/heliostats/AA39").json()
    assert found["properties"] == properties
    assert found["position_m"] == pytest.approx([13.25, 24.7, 1.69], abs=0.1)


def test_heliostat_posted_twice_is_one(client: TestClient, properties: dict[str, Any]):
    body = {"name": "AC43", "properties": properties}
    created = client.post("/v1/heliostats", json=body)
    assert created.status_code == 201
    assert created.headers["Location"] == "/v1/heliostats/AC43"
    assert client.post("/v1/heliostats", json=body).status_code == 200
    other = client.post(
        "/v1/heliostats", json={"name": "AC43", "properties": properties | {"width": 3.0}}
    )
    assert other.status_code == 409
    assert "PUT" in other.json()["detail"]
    assert (
        client.put(
            "/v1/heliostats/AC43?reason=surveyed", json=properties | {"width": 3.0}
        ).status_code
        == 200
    )
    assert client.get("/v1/heliostats/AC43").json()["properties"]["width"] == 3.0


def test_older_property_files_are_taken(client: TestClient, properties: dict[str, Any]):
    properties["kinematic_properties"] = properties.pop("kinematics_properties")
    assert client.put("/v1/heliostats/AA40", json=properties).status_code == 201


def test_heliostats_in_pages(client: TestClient, properties: dict[str, Any]):
    for name in ("AB01", "AB02"):
        client.put(f"/v1/heliostats/{name}", json=properties)
    first = client.get("/v1/heliostats?limit=2").json()
    assert [item["name"] for item in first["items"]] == ["AA39", "AB01"]
    assert "properties" not in first["items"][0]
    second = client.get(f"/v1/heliostats?limit=2&after={first['next']}").json()
    assert [item["name"] for item in second["items"]] == ["AB02"]
    assert second["next"] is None


def _without(document: dict[str, Any], *path: str) -> dict[str, Any]:
    copied = copy.deepcopy(document)
    inner = copied
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return copied


@pytest.mark.parametrize(
    ("path", "named"),
    [
        (("heliostat_position",), "heliostat_position"),
        (("width",), "width"),
        (("facet_properties", "facets"), "facets"),
        (("kinematics_properties",), "kinematics_properties"),
        (("kinematics_properties", "concentrator_translation_n"), "concentrator_translation_n"),
    ],
)
def test_missing_property_is_named(
    refusing: TestClient, properties: dict[str, Any], path: tuple[str, ...], named: str
):
    answer = refusing.put("/v1/heliostats/AA39", json=_without(properties, *path))
    assert answer.status_code == 422
    assert named in answer.json()["detail"]


@pytest.mark.parametrize(
    "number", ["NaN", "Infinity", "-Infinity", "1e999", "1" + "0" * 400, "1" + "0" * 5000]
)
@pytest.mark.parametrize("place", ["width", "renovation", "deep"])
def test_numbers_that_are_none_are_refused_anywhere(
    refusing: TestClient, properties: dict[str, Any], place: str, number: str
):
    properties[place] = "@"
    text = json.dumps(
        properties | ({"deep": {"list": [1, "@"]}} if place == "deep" else {})
    ).replace('"@"', number)
    answer = refusing.put(
        "/v1/heliostats/AA39", content=text, headers={"Content-Type": "application/json"}
    )
    assert answer.status_code in (400, 422)
    assert answer.headers["Content-Type"] == "application/problem+json"


@pytest.mark.parametrize(
    "wrong",
    [
        {"facet_properties": {"facets": ["x"]}},
        {"facet_properties": {"facets": [None] * 4}},
        {"facet_properties": {"facets": [{"translation_vector": "abc"}]}},
        {
            "facet_properties": {
                "facets": [
                    {
                        "translation_vector": [0, 0, 0],
                        "canting_e": [0, 0, 0],
                        "canting_n": [0, 0, 0],
                    }
                ]
            }
        },
        {"kinematics_properties": {"actuators": [1, 2]}},
        {"kinematics_properties": []},
        {"kinematics_properties": None},
        {"heliostat_position": [91, 0, 0]},
        {"heliostat_position": [1, 2]},
        {"width": -1},
    ],
)
def test_properties_of_the_wrong_shape(
    refusing: TestClient, properties: dict[str, Any], wrong: dict[str, Any]
):
    assert (
        refusing.put("/v1/heliostats/AA39?reason=surveyed", json=properties | wrong).status_code
        == 422
    )


def test_declared_effects_may_be_of_one_heliostat(client: TestClient, tower: dict[str, Any]):
    rough = {
        "name": "slope_error",
        "parameters": {"sigma_mrad": 1.0},
        "scope": {"kind": "set", "heliostats": ["AA39"]},
    }
    declared = {"effects": [rough]}
    assert (
        client.put("/v1/plant?reason=surveyed", json=tower | {"declared": declared}).json()[
            "declared"
        ]
        == declared
    )
    hazy = {"name": "sun_shape", "parameters": {"circumsolar_ratio": 0.1}, "scope": rough["scope"]}
    refused = client.put(
        "/v1/plant?reason=surveyed", json=tower | {"declared": {"effects": [hazy]}}
    )
    assert refused.status_code == 422
    assert (
        "sun_shape: the sun and the camera are the same for all heliostats"
        in refused.json()["detail"]
    )


def test_declared_optics_make_the_light_of_forecasts(
    client: TestClient, tower: dict[str, Any], operations: Any
):
    request = {
        "heliostat": "AA39",
        "target": "lower",
        "surface": "ideal",
        "sun": {"azimuth_deg": 160, "elevation_deg": 45},
        "dni_w_m2": 800,
    }
    assert client.post("/v1/forecasts", json=request).status_code == 201
    assert operations.forecasts[-1]["model"].optics.reflectivity == 1.0
    bad = client.put(
        "/v1/plant?reason=surveyed", json=tower | {"declared": {"optics": {"reflectivity": 1.5}}}
    )
    assert bad.status_code == 422
    assert "optics: reflectivity: must be 1 or less" in bad.json()["detail"]
    declared = {"optics": {"reflectivity": 0.9, "attenuation": [0.01, 0.1]}}
    assert (
        client.put("/v1/plant?reason=surveyed", json=tower | {"declared": declared}).json()[
            "declared"
        ]
        == declared
    )
    assert client.post("/v1/forecasts", json=request).status_code == 201
    optics = operations.forecasts[-1]["model"].optics
    assert (optics.dni, optics.reflectivity, optics.attenuation) == (800, 0.9, (0.01, 0.1))
    assert client.put("/v1/plant", json=tower).json()["declared"] == declared
