"""A client that a tool generates from the OpenAPI document sends every request of the integrator's
guide, in its order.
"""

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import pytest
from fastapi import FastAPI

from service.base.settings import Settings
from service.store import keys
from service.web.app import create_app
from service.web.responses.problems import SPECIAL_TYPES, TYPES
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    png,
    properties_document,
    serving,
    sun_at,
    tower_document,
    until,
)
from tests.service.spots import photographs

pytest.importorskip(
    "openapi_python_client", reason="no generator of clients: pip install openapi-python-client"
)

DOCS = Path(__file__).parents[2] / "docs"
GUIDE = "\n".join(
    (DOCS / "how-to" / "integrator" / name).read_text(encoding="utf-8")
    for name in ("photographs.md", "forecasts.md")
)
CLIENT = "plant_client"
TARGET = "multi_focus_tower"
# PAINT's documents, which the guide does not repeat, and what it says in its table instead of an
# example.
BODIES: dict[str, dict[str, Any]] = {
    "put_plant": {**(tower := tower_document()), TARGET: tower["lower"]},
    "put_heliostat": properties_document(),
    "patch_measurement": {
        "reason": "the clock was wrong",
        "sun": {"azimuth_deg": 220.0, "elevation_deg": 33.5},
    },
}


@dataclass
class Call:
    """A request of the guide."""

    method: str
    path: str
    query: dict[str, str]
    body: dict[str, Any] | None


def guides_calls() -> list[Call]:
    """The requests of the guide in its order, each with the JSON that follows it."""
    calls, decoder = [], json.JSONDecoder()
    for found in re.finditer(
        r"(?:^|`)(GET|PUT|POST|PATCH) +(/v1|\.\.\.)(/[\w/.-]+)(?:\?(\S+))?", GUIDE, re.MULTILINE
    ):
        method, root, path, query = found.groups()
        path = (root if root == "/v1" else "/v1/heliostats/AA39") + path
        body = (
            re.match(r"[^\n{]*(?:\n\n)?(?=\{)", GUIDE[found.end() :])
            if method in ("POST", "PATCH")
            else None
        )
        document = decoder.raw_decode(GUIDE, found.end() + body.end())[0] if body else None
        calls.append(Call(method, path, dict(parse_qsl(query or "")), document))
    return calls


@dataclass
class Plant:
    """The generated package, talking to a service with a key."""

    client: Any
    document: dict[str, Any]

    def model(self, name: str, document: dict[str, Any]) -> Any:
        return getattr(importlib.import_module(f"{CLIENT}.models"), name).from_dict(document)

    def enum(self, name: str, value: str) -> Any:
        return getattr(importlib.import_module(f"{CLIENT}.models"), name)(value)

    def enumerated(self, operation: dict[str, Any], parameter: str, value: str) -> Any:
        """A query parameter's value as the generated function takes it: a member of its
        enumeration, if it has one.
        """
        (schema,) = (
            known["schema"] for known in operation["parameters"] if known["name"] == parameter
        )
        if "enum" not in schema:
            return value
        words = f"{operation['operationId']}_{parameter}".split("_")
        return self.enum("".join(word.capitalize() for word in words), value)

    def ask(self, call: str, *arguments: Any, **more: Any) -> Any:
        """Status and parsed answer of ``resource.operation``."""
        module = importlib.import_module(f"{CLIENT}.api.{call}")
        return module.sync_detailed(*arguments, client=more.pop("client", self.client), **more)

    def follow(self, call: Call) -> tuple[str, Any]:
        """Send a request of the guide by the client's function for it; that function's name, and
        the answer.
        """
        for form, operations in self.document["paths"].items():
            found = re.fullmatch(re.sub(r"\{[^}]*\}", "([^/]+)", form), call.path)
            if found and call.method.lower() in operations:
                break
        else:
            raise AssertionError(f"the document has no {call.method} {call.path}")
        operation = operations[call.method.lower()]
        name, content = (
            operation["operationId"],
            operation.get("requestBody", {}).get("content", {}),
        )
        body = call.body if call.body is not None else BODIES.get(name)
        arguments = [
            int(part) if part.isdecimal() and "number" in form else part for part in found.groups()
        ]
        if "multipart/form-data" in content:
            return name, self.photograph(png(1), body or {})
        more = {
            given: self.enumerated(operation, given, value) for given, value in call.query.items()
        }
        if content:
            schema = content["application/json"]["schema"]
            reference = schema.get("$ref") or schema["oneOf"][0]["$ref"]
            more["body"] = self.model(reference.rpartition("/")[2], body or {})
        return name, self.ask(f"{operation['tags'][0]}.{name}", *arguments, **more)

    def photograph(self, image: bytes, metadata: dict[str, Any]) -> Any:
        types = importlib.import_module(f"{CLIENT}.types")
        body = importlib.import_module(f"{CLIENT}.models").BodyPostMeasurement(
            image=types.File(payload=BytesIO(image), file_name="spot.png", mime_type="image/png"),
            metadata=self.model("MeasurementIn", metadata),
        )
        return self.ask("measurements.post_measurement", "AA39", body=body)


def generate(app: FastAPI, folder: Path) -> str:
    """The package in ``folder``, and what the generator said."""
    document = folder / "openapi.json"
    document.write_text(json.dumps(app.openapi()), encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "openapi_python_client",
        "generate",
        "--path",
        str(document),
        "--meta",
        "none",
    ]
    done = subprocess.run(
        [*command, "--output-path", str(folder / CLIENT)],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """The document, while the package made of it can be imported."""
    folder = tmp_path_factory.mktemp("generated")
    app = create_app(Settings(data_dir=folder / "data", **QUIET), FakeOperations())
    said = generate(app, folder)
    assert "WARNING" not in said, said
    sys.path.insert(0, str(folder))
    yield app.openapi()
    sys.path.remove(str(folder))


@contextmanager
def plant_at(folder: Path, document: dict[str, Any], role: str = "operate") -> Iterator[Plant]:
    app = create_app(
        Settings(data_dir=folder / "data", **QUIET | {"job_workers": 1}), FakeOperations()
    )
    with serving(app) as address:
        with app.state.runtime.database.writing() as session:
            key = keys.create(session, "plant", role, "tester")
        with importlib.import_module(CLIENT).AuthenticatedClient(
            base_url=address, token=key
        ) as client:
            yield Plant(client, document)


def test_every_request_of_the_guide_in_its_order(generated: dict[str, Any], tmp_path: Path):
    calls = guides_calls()
    assert len(calls) > 15
    parsed: dict[str, Any] = {}
    with plant_at(tmp_path, generated) as plant:
        for call in calls:
            name, answer = plant.follow(call)
            assert answer.status_code in (HTTPStatus.OK, HTTPStatus.CREATED, HTTPStatus.ACCEPTED), (
                call,
                answer.content.decode(errors="replace"),
            )
            parsed[name] = answer.parsed
            if name == "post_predictions_job":
                until(lambda: plant.ask("jobs.get_job", 1).parsed.state == "done")
        until(lambda: plant.ask("jobs.get_job", 2).parsed.state == "done")
    assert parsed["get_job"].to_dict()["result"]["unchanged"] == {"AA39": 1}
    known = {"accepted": True, "id": "205363", "target": TARGET, "motor_position": [31234, 45012]}
    assert {key: getattr(parsed["post_measurement"], key) for key in known} == known
    assert parsed["post_measurement"].taken_at == datetime(2024, 6, 1, 9, 14, 3, tzinfo=UTC)
    assert parsed["get_measurement"].sun.azimuth_deg == 220.0
    assert (len(parsed["get_flux"].flux), len(parsed["get_flux"].centered)) == (256, 64)
    assert (parsed["post_surface"].version, parsed["post_surface"].trusted) == (1, True)
    assert np.shape(parsed["get_current_surface"].control_points) == (4, 8, 8, 3)
    assert parsed["post_forecast"].power_w == 50.0
    assert parsed["list_field"].items == []  # no heliostat has warnings
    assert parsed["post_motors"].motor_position[0] > 0
    assert {job.id for job in parsed["list_jobs"].items} == {1, 2}
    assert "event: end" in parsed["get_job_events"]
    assert [photograph.id for photograph in parsed["list_measurements"].items] == ["205363"]


@pytest.fixture(scope="module")
def plant(generated: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    """A plant that did what the guide says is done once."""
    with plant_at(tmp_path_factory.mktemp("plant"), generated) as plant:
        plant.ask("plant.put_plant", body=plant.model("TowerMeasurements", BODIES["put_plant"]))
        mirror = plant.model("HeliostatProperties", BODIES["put_heliostat"])
        assert (
            plant.ask("heliostats.put_heliostat", "AA39", body=mirror).status_code
            == HTTPStatus.CREATED
        )
        assert (
            plant.ask("heliostats.put_heliostat", "AA39", body=mirror).status_code == HTTPStatus.OK
        )
        yield plant


KNOWN = next(call.body for call in guides_calls() if call.path.endswith("/measurements")) or {}


def test_what_the_guide_says_of_answers(plant: Plant):
    """Each line of its table that a client can bring about."""
    first = plant.photograph(png(1), KNOWN)
    assert (first.status_code, first.parsed.id, first.parsed.accepted) == (
        HTTPStatus.CREATED,
        "205363",
        True,
    )
    assert plant.photograph(png(1), KNOWN).status_code == HTTPStatus.OK
    refused = plant.photograph(png(2, refused=True), KNOWN | {"id": "205364"})
    assert (refused.status_code, refused.parsed.accepted, refused.parsed.reason) == (
        201,
        False,
        "no_spot",
    )
    with_weather = {"wind_speed_m_s": 3.5, "wind_from_deg": 270.0, "temperature_c": 21.0}
    corners = {"corners": [[0.0, 0.0], [31.0, 0.0], [0.0, 31.0], [31.0, 31.0]]}
    more = plant.photograph(png(4), KNOWN | {"id": "205366"} | with_weather | corners).parsed
    assert {name: getattr(more, name) for name in with_weather} == with_weather
    for image, changes, status, kind, words in (
        (
            png(1),
            {"sun": sun_at(170.0, 33.5)},
            409,
            "conflict",
            "sun.azimuth_deg: 221.2 is stored, 170.0 was sent",
        ),
        (png(3), {"id": "205363"}, 409, "conflict", "205363"),
        (png(3), {"id": "205365", "target": "nowhere"}, 404, "not-found", "known targets: "),
        (b"no image", {"id": "205365"}, 415, "unsupported-media-type", "PNG, JPEG"),
        (bytes(2**26 + 1), {"id": "205365"}, 413, "too-large", "bytes"),
        (
            png(3),
            {"id": "205365", "taken_at": "2924-06-01T09:14:03+00:00"},
            422,
            "invalid",
            "taken_at: ",
        ),
    ):
        answer = plant.photograph(image, KNOWN | changes)
        assert (answer.status_code, answer.parsed.type_) == (
            status,
            f"urn:heliotwin:problem:{kind}",
        ), answer
        assert words in answer.parsed.detail
        assert len(answer.parsed.request_id) >= 8


def test_keys_that_do_not_open(plant: Plant, generated: dict[str, Any], tmp_path: Path):
    address = plant.client.get_httpx_client().base_url
    with importlib.import_module(CLIENT).AuthenticatedClient(
        base_url=str(address), token="x"
    ) as stranger:
        answer = plant.ask("plant.get_plant", client=stranger)
    assert (answer.status_code, answer.parsed.type_) == (401, "urn:heliotwin:problem:key-needed")
    with plant_at(tmp_path, generated, "read") as reader:
        answer = reader.photograph(png(1), KNOWN)
        assert (answer.status_code, answer.parsed.type_) == (
            403,
            "urn:heliotwin:problem:not-allowed",
        )


def test_what_else_the_guide_offers(plant: Plant):
    plant.photograph(png(1), KNOWN)
    assert plant.ask("measurements.get_image", "AA39", "205363").parsed.payload.read() == png(1)
    plant.ask("surfaces.post_surface", "AA39", body=plant.model("SurfaceIn", {"method": "refined"}))
    at = plant.ask("surfaces.list_surfaces", "AA39", at=datetime(2024, 6, 2, tzinfo=UTC)).parsed
    assert (at.version, np.shape(at.z)) == (1, (4, 8, 8))
    later = {"heliostat": "AA39", "target": TARGET, "sun": {"at": "2026-06-21T11:36:00+00:00"}}
    forecast = plant.ask("forecasts.post_forecast", body=plant.model("ForecastIn", later))
    assert np.shape(plant.ask("forecasts.get_forecast", forecast.parsed.id).parsed.flux) == (
        256,
        256,
    )
    field = plant.ask(
        "heliostats.list_field", metric=plant.enum("ListFieldMetric", "age_days"), low=0.0, high=1e5
    )
    assert [line.name for line in field.parsed.items] == ["AA39"]
    with plant.client.with_headers({"X-Request-ID": "the-plants-own-1"}) as named:
        assert (
            plant.ask("plant.get_plant", client=named).headers["X-Request-ID"] == "the-plants-own-1"
        )


def test_maps_as_files_come_over_the_clients_connection(plant: Plant):
    """What it parses is JSON, for it has one form for each status."""
    plant.photograph(png(1), KNOWN)
    path = "/v1/heliostats/AA39/measurements/205363/flux"
    http = plant.client.get_httpx_client()
    arrays = np.load(BytesIO(http.get(path, headers={"Accept": "application/x-npz"}).content))
    assert arrays["flux"].shape == (256, 256)
    assert http.get(path, params={"format": "png"}).content.startswith(b"\x89PNG")


def test_the_guides_jobs(plant: Plant):
    for number, taken in enumerate(photographs(tower_document(), properties_document())):
        answer = plant.photograph(png(100 + number), taken | {"target": "lower"})
        assert answer.status_code == HTTPStatus.CREATED, answer.content
    asked = plant.model("CalibrationIn", {})
    begun = plant.ask("jobs.post_calibrations_job", body=asked, idempotency_key="morning-1")
    again = plant.ask("jobs.post_calibrations_job", body=asked, idempotency_key="morning-1")
    assert begun.status_code == HTTPStatus.ACCEPTED
    assert begun.parsed.id == again.parsed.id
    number = begun.parsed.id
    until(lambda: plant.ask("jobs.get_job", number).parsed.state in ("done", "failed"))
    done = plant.ask("jobs.get_job", number).parsed
    assert (done.state, done.result["mounts"]) == ("done", {"AA39": 1})
    events = plant.ask("jobs.get_job_events", number).parsed
    assert events.rstrip().rpartition("event: end")[1]
    last = re.findall(r"^id: (\S+)", events, re.MULTILINE)[-1]
    assert plant.ask("jobs.get_job_events", number, last_event_id=last).status_code in (200, 204)
    aimed = {"target": TARGET, "sun": {"at": "2024-06-03T11:30:00+00:00"}}
    assert (
        plant.ask(
            "mounts.post_motors", "AA39", body=plant.model("AimIn", aimed)
        ).parsed.mount_version
        == 1
    )
    unknown = plant.ask(
        "jobs.post_predictions_job", body=plant.model("PredictionsIn", {"heliostats": ["ZZ99"]})
    )
    assert (unknown.status_code, "ZZ99" in unknown.parsed.detail) == (404, True)
    mirror = plant.model("HeliostatProperties", BODIES["put_heliostat"])
    assert (
        plant.ask("heliostats.put_heliostat", "AB39", body=mirror).status_code == HTTPStatus.CREATED
    )
    failing = plant.ask(
        "jobs.post_predictions_job", body=plant.model("PredictionsIn", {"heliostats": ["AB39"]})
    ).parsed
    until(lambda: plant.ask("jobs.get_job", failing.id).parsed.state == "failed")
    assert "AB39" in plant.ask("jobs.get_job", failing.id).parsed.reason


def test_every_type_of_problem_is_documented():
    text = (DOCS / "reference" / "problem-types.md").read_text(encoding="utf-8")
    documented = dict(re.findall(r"\| `urn:heliotwin:problem:([a-z-]+)` \| (\d+) \|", text))
    special = dict.fromkeys(SPECIAL_TYPES.values(), "422")
    assert documented == {name: str(status) for status, name in TYPES.items()} | special
