"""Lists over REST: pages of items, filters and orders; query parameters; jobs that name what is not
stored.
"""

from typing import Any, cast

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from model.fleet import LOSSES
from service.store.job_tables import JobRow
from tests.page import Page
from tests.service.conftest import Post, png, properties_document
from tests.service.web.pages import HTML

JSON = "application/json"


def assert_problem(answer: Any, status: int) -> dict[str, Any]:
    """The problem document of an answer; an invalid request's names the fields at fault."""
    assert answer.status_code == status, answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    problem = cast(dict[str, Any], answer.json())
    assert bool(problem.get("errors")) == (status == 422)
    return problem


def resolved(document: dict[str, Any], schema: dict[str, Any]) -> list[dict[str, Any]]:
    """The alternatives of a schema, with references resolved."""
    if "$ref" in schema:
        return resolved(
            document, document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
        )
    if "anyOf" in schema:
        return [one for choice in schema["anyOf"] for one in resolved(document, choice)]
    return [schema]


def test_every_list_is_a_page(bare: TestClient):
    """Of every answer that the OpenAPI document has: no bare list, and what has `items`
    has `next`.
    """
    document, pages = bare.get("/openapi.json").json(), set()
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for answer in operation["responses"].values():
                schema = answer.get("content", {}).get(JSON, {}).get("schema")
                for one in [] if schema is None else resolved(document, schema):
                    assert one.get("type") != "array", (method, path)
                    if "items" in one.get("properties", {}):
                        assert {"items", "next"} <= set(one["required"]), (method, path)
                        pages.add(path)
    for name in (
        "heliostats",
        "targets",
        "receivers",
        "forecasts",
        "studies",
        "jobs",
        "models",
        "alarms",
        "alarms/acknowledgements",
        "alarms/history",
        "audit",
    ):
        assert f"/v1/{name}" in pages
    for name in (
        "measurements",
        "surfaces",
        "surfaces/decisions",
        "mounts",
        "measurements/{measurement}/corrections",
    ):
        assert f"/v1/heliostats/{{name}}/{name}" in pages


@pytest.mark.parametrize("sort", [{"by": "name"}, {"by": "cosine"}])
def test_the_heliostats_of_a_job_are_all_a_page_away(
    bare: TestClient, app: FastAPI, sort: dict[str, str]
):
    """211 heliostats of a field forecast are three pages, and so are 211 skipped ones."""
    names = [f"H{number:03d}" for number in range(211)]
    factors = dict.fromkeys((*LOSSES, "optical_efficiency", "intercepted_w"), 0.5)
    result = {"by_heliostat": dict.fromkeys(names, factors), "skipped": dict.fromkeys(names, "")}
    job = JobRow(kind="forecasts", payload={}, state="done", created_by="tester", result=result)
    with app.state.runtime.database.writing() as session:
        session.add(job)
    path, seen, skipped = f"/jobs/{job.id}?by={sort['by']}", list[str](), list[str]()
    for number in (1, 2, 3):
        page = Page(bare.get(path, headers=HTML).text)
        assert f"Page {number} of 3" in page.words
        seen += page.texts("th", scope="row")
        skipped += page.texts("dt")
        path = "".join(link["href"] for link in page.all("a", rel="next"))
    assert (path, seen) == ("", names)
    assert set(names) <= set(skipped)


def test_lists_that_are_pages_have_no_more_than_a_page(real_client: TestClient):
    path = "/v1/heliostats/AA39/surfaces/decisions"
    choice = {"version": 2, "reason": "try"}
    assert real_client.put("/v1/heliostats/AA39/surfaces/current", json=choice).status_code == 200
    first = real_client.get(path, params={"limit": 1}).json()
    second = real_client.get(path, params={"limit": 1, "after": first["next"]}).json()
    assert first["items"][0]["reason"] == "try"
    assert first["items"] + second["items"] == real_client.get(path).json()["items"][:2]


# --- query parameters
# -------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_unknown_query_parameters_are_refused_on_every_path(refusing: TestClient):
    """By name and with those that are known; a `GET` of every path of the document."""
    paths = refusing.get("/openapi.json").json()["paths"]
    asked = [
        path
        for path, operations in paths.items()
        if path.startswith("/v1/") and "get" in operations
    ]
    assert len(asked) > 30
    for path in asked:
        filled = path.replace("{name}", "AA39").replace("{measurement}", "1")
        filled = filled.replace("{number}", "1").replace("{version}", "1")
        problem = assert_problem(refusing.get(f"{filled}?limits=5&at=now"), 422)
        assert problem["errors"][0]["field"] == "limits", path
    problem = assert_problem(refusing.get("/v1/jobs?sate=done&limit=2"), 422)
    assert problem["errors"] == [
        {
            "field": "sate",
            "message": (
                "is not a parameter of this path; known are limit, after, since, until, order,"
                " state, kind"
            ),
        }
    ]
    assert (
        "this path takes none"
        in assert_problem(refusing.post("/v1/jobs/1/cancel?now=1"), 422)["detail"]
    )


def test_known_query_parameters_pass(refusing: TestClient):
    for path in (
        "field?show=trusted&sort=name&order=up",
        "heliostats?limit=3",
        "alarms?reason=camera",
    ):
        assert refusing.get(f"/v1/{path}").status_code == 200, path


# --- filters and orders
# -----------------------------------------------------------------------------------------------


def names(client: TestClient, path: str, name: str = "id", **query: Any) -> list[Any]:
    """What items of a list are called, page by page of two; the same as the list at once."""
    found: list[Any] = []
    after: dict[str, Any] = {}
    while True:
        page = client.get(path, params=query | {"limit": 2} | after).json()
        found += [item[name] for item in page["items"]]
        if page["next"] is None:
            break
        after = {"after": page["next"]}
    assert found == [item[name] for item in client.get(path, params=query).json()["items"]]
    return found


def test_measurements_are_filtered_and_sorted(client: TestClient, post: Post):
    times = [
        "2026-06-03T10:00:00Z",
        "2026-06-01T10:00:00Z",
        None,
        "2026-06-02T10:00:00Z",
        "2026-06-02T10:00:00Z",
        None,
    ]
    for number, moment in enumerate(times):
        known_time = {} if moment is None else {"taken_at": moment}
        target = "upper" if number == 1 else "lower"
        kind = "cropped" if number == 4 else "flux"
        assert (
            post(png(number), id=str(number), target=target, kind=kind, **known_time).status_code
            == 201
        )
    assert post(png(9, refused=True), id="9").status_code == 201
    path = "/v1/heliostats/AA39/measurements"
    assert names(client, path) == ["0", "1", "2", "3", "4", "5", "9"]
    assert names(client, path, order="down") == ["9", "5", "4", "3", "2", "1", "0"]
    assert names(client, path, sort="taken_at") == ["1", "3", "4", "0", "2", "5", "9"]
    assert names(client, path, sort="taken_at", order="down") == ["0", "4", "3", "1", "9", "5", "2"]
    assert names(client, path, since="2026-06-02T00:00:00Z", until="2026-06-03T00:00:00Z") == [
        "3",
        "4",
    ]
    assert names(client, path, target="upper") == ["1"]
    assert names(client, path, kind="cropped") == ["4"]
    assert names(client, path, accepted="false") == ["9"]
    assert_problem(client.get(path, params={"target": "middle"}), 404)


def test_surfaces_are_filtered_and_sorted(real_client: TestClient):
    path = "/v1/heliostats/AA39/surfaces"
    assert names(real_client, path, "version") == [1, 2]
    assert names(real_client, path, "version", order="down") == [2, 1]
    assert names(real_client, path, "version", source="measured") == [1]
    assert names(real_client, path, "version", sort="valid_from", order="down") == [2, 1]
    assert names(real_client, path, "version", is_candidate="true") == [2]
    # The one was measured before anything else, the other was made from photographs of unknown
    # times.
    for times in ({"since": "1990-01-01T00:00:00Z"}, {"until": "2100-01-01T00:00:00Z"}):
        assert 2 not in names(real_client, path, "version", **times)


def test_surfaces_are_filtered_by_time(client: TestClient, post: Post):
    for number, day in enumerate((1, 3, 2)):
        assert (
            post(png(number), id=str(number), taken_at=f"2026-06-0{day}T10:00:00Z").status_code
            == 201
        )
        assert client.post("/v1/heliostats/AA39/surfaces", json={"images": 1}).status_code in (
            200,
            201,
        )
    path = "/v1/heliostats/AA39/surfaces"
    found = {item["version"]: item["valid_from"] for item in client.get(path).json()["items"]}
    assert len(found) > 1
    # The newest photograph was of an earlier day.
    assert names(client, path, "version", sort="version", order="down") == sorted(found)[::-1]
    for bound in sorted(found.values()):
        assert names(client, path, "version", since=bound) == [
            name for name, at in found.items() if at >= bound
        ]
        assert names(client, path, "version", until=bound) == [
            name for name, at in found.items() if at < bound
        ]
    in_order = sorted(found, key=lambda name: (found[name], name))
    assert names(client, path, "version", sort="valid_from") == in_order


LATER, EARLIER = "2100-01-01T00:00:00Z", "2000-01-01T00:00:00Z"


def test_forecasts_jobs_and_studies_are_filtered_and_sorted(real_client: TestClient):
    for path, found in (("forecasts", [1]), ("studies", [1]), ("jobs", [3, 2, 1])):
        assert names(real_client, f"/v1/{path}") == found
        assert names(real_client, f"/v1/{path}", since=EARLIER, until=LATER) == found
        assert (
            names(real_client, f"/v1/{path}", since=LATER)
            == names(real_client, f"/v1/{path}", until=EARLIER)
            == []
        )
    assert names(real_client, "/v1/jobs", order="up") == [1, 2, 3]
    assert names(real_client, "/v1/jobs", kind="studies", state="done") == [3]
    assert names(real_client, "/v1/studies", verdict="effect") == [1]
    assert names(real_client, "/v1/studies", verdict="none") == []
    assert names(real_client, "/v1/forecasts", target="multi_focus_tower", heliostat="AA39") == [1]
    assert names(real_client, "/v1/forecasts", target="solar_tower_juelich_lower") == []


# --- jobs that name what is not stored
# --------------------------------------------------------------------------------

DAY = {"name": "day", "first_at": "2026-06-21T10:00:00Z", "last_at": "2026-06-21T11:00:00Z"}
SUN = {"azimuth_deg": 180.0, "elevation_deg": 45.0}


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("jobs/predictions", {}),
        ("jobs/calibrations", {}),
        ("jobs/measurements", {}),
        ("jobs/studies", {}),
        ("jobs/forecasts", {"target": "lower", "sun": SUN}),
        ("jobs/plans", {"target": "lower"} | DAY),
    ],
)
def test_jobs_name_heliostats_that_are_stored(
    refusing: TestClient, path: str, body: dict[str, Any]
):
    names = ["AA39", "ZZ98", "ZZ99"]
    problem = assert_problem(refusing.post(f"/v1/{path}", json=body | {"heliostats": names}), 404)
    assert (
        problem["detail"] == "heliostats: ZZ98, ZZ99 not found; GET /v1/heliostats lists the names"
    )
    if "target" in body:
        problem = assert_problem(
            refusing.post(f"/v1/{path}", json=body | {"target": "middle"}), 404
        )
        assert "middle" in problem["detail"]
        aims = {"ZZ99": [0.0, 0.0, 30.0]}
        problem = assert_problem(
            refusing.post(f"/v1/{path}", json=body | {"aim_points_m": aims}), 404
        )
        assert problem["detail"].startswith("aim_points_m: ZZ99 not found")
    assert refusing.get("/v1/jobs").json()["items"] == []


# --- errors
# --------------------------------------------------------------------------------------------------


FLAT = {"center": [0, 0, 9], "width": 5, "height": 5}
WITHOUT_ACTUATORS = properties_document()
del WITHOUT_ACTUATORS["kinematics_properties"]["actuators"]


@pytest.mark.parametrize(
    ("method", "path", "body", "field"),
    [
        (
            "POST",
            "forecasts",
            {"heliostat": "AA39", "target": "lower", "sun": {"at": "2026-01-01T00:00:00Z"}},
            "at",
        ),
        ("GET", "calibration-plan?at=2026-01-01T00:00:00Z", None, "at"),
        ("PUT", "heliostats/AA40", WITHOUT_ACTUATORS, "actuators"),
        ("PUT", "targets/flat", {"plane": FLAT | {"normal": [0, 0, 0]}}, "normal"),
    ],
)
def test_every_invalid_request_names_its_field(
    refusing: TestClient, method: str, path: str, body: dict[str, Any] | None, field: str
):
    problem = assert_problem(refusing.request(method, f"/v1/{path}", json=body), 422)
    assert [error["field"].rpartition(".")[2] for error in problem["errors"]] == [field], problem
    assert all(error["message"] for error in problem["errors"])
