"""A client that a tool generates from the OpenAPI document goes through all that INTEGRATION.md tells a plant to do."""

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from service.base.settings import Settings
from service.store import keys
from service.web.answers.problems import TYPES
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    png,
    properties_document,
    serving,
    tower_document,
    until,
)

pytest.importorskip("openapi_python_client", reason="no generator of clients: pip install openapi-python-client")

GUIDE = (Path(__file__).parents[2] / "docker" / "INTEGRATION.md").read_text(encoding="utf-8")
CLIENT = "plant_client"


@dataclass
class Plant:
    """The generated package, talking to a service with a key."""

    client: Any

    def model(self, name: str, document: dict[str, Any]) -> Any:
        return getattr(importlib.import_module(f"{CLIENT}.models"), name).from_dict(document)

    def ask(self, call: str, *arguments: Any, **more: Any) -> Any:
        """Status and parsed answer of ``resource.operation``."""
        module = importlib.import_module(f"{CLIENT}.api.{call}")
        return module.sync_detailed(*arguments, client=self.client, **more)

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
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--path", str(document), "--meta", "none"]
    done = subprocess.run(
        [*command, "--output-path", str(folder / CLIENT)], capture_output=True, text=True, check=True, timeout=300
    )
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    folder = tmp_path_factory.mktemp("generated")
    app = create_app(Settings(data_dir=folder / "data", **QUIET | {"job_workers": 1}), FakeOperations())
    said = generate(app, folder)
    # The only part that it has no form for is an image of whatever kind it was sent in.
    assert said.count("WARNING") == said.count("image/*") // 2 == 1, said
    sys.path.insert(0, str(folder))
    try:
        with serving(app) as address:
            with app.state.runtime.database.writing() as session:
                key = keys.create(session, "plant", "operate", "tester")
            with importlib.import_module(CLIENT).AuthenticatedClient(base_url=address, token=key) as client:
                yield Plant(client)
    finally:
        sys.path.remove(str(folder))


def test_the_guide_from_the_plant_to_the_forecast(plant: Plant):
    # Once: the plant.
    tower = plant.model("TowerMeasurements", tower_document())
    assert plant.ask("plant.put_plant", body=tower).status_code == HTTPStatus.OK
    mirror = plant.model("HeliostatProperties", properties_document())
    assert plant.ask("heliostats.put_heliostat", "AA39", body=mirror).status_code == HTTPStatus.CREATED
    assert plant.ask("heliostats.put_heliostat", "AA39", body=mirror).status_code == HTTPStatus.OK
    # For each photograph: stored once, whoever sends it how often.
    known = {"id": "205363", "kind": "raw", "target_name": "lower", "sun_azimuth": -41.2, "sun_elevation": 33.5}
    known |= {"taken_at": "2024-06-01T09:14:03+00:00", "motor_position": [31234, 45012]}
    first = plant.photograph(png(1), known)
    assert (first.status_code, first.parsed.id, first.parsed.accepted) == (HTTPStatus.CREATED, "205363", True)
    assert plant.photograph(png(1), known).status_code == HTTPStatus.OK
    conflict = plant.photograph(png(1), known | {"sun_azimuth": 10.0})
    assert conflict.status_code == HTTPStatus.CONFLICT
    assert conflict.parsed.type_ == "urn:heliotwin:problem:conflict"
    assert "sun_azimuth: -41.2 is stored, 10.0 was sent" in conflict.parsed.detail
    refused = plant.photograph(png(2, refused=True), known | {"id": "205364"})
    assert (refused.status_code, refused.parsed.accepted, refused.parsed.reason) == (201, False, "no_spot")
    wrong = plant.photograph(png(3), known | {"id": "205365", "target_name": "nowhere"})
    assert (wrong.status_code, wrong.parsed.type_) == (404, "urn:heliotwin:problem:not-found")
    measured = plant.ask("measurements.get_measurement", "AA39", "205363").parsed
    assert measured.center_of_mass == [0.5, -0.25]
    flux = plant.ask("measurements.get_flux", "AA39", "205363").parsed
    assert (len(flux.flux), len(flux.centered)) == (256, 64)
    assert plant.ask("measurements.get_image", "AA39", "205363").content == png(1)
    correction = plant.model("CorrectionIn", {"reason": "the clock was wrong", "sun_azimuth": -40.0})
    assert plant.ask("measurements.patch_measurement", "AA39", "205363", body=correction).parsed.surfaces == []
    # Surfaces and forecasts.
    network = plant.model("SurfaceIn", {"method": "network"})
    made = plant.ask("surfaces.post_surface", "AA39", body=network)
    assert (made.status_code, made.parsed.version, made.parsed.trusted) == (HTTPStatus.CREATED, 1, True)
    assert plant.ask("surfaces.post_surface", "AA39", body=network).status_code == HTTPStatus.OK
    current = plant.ask("surfaces.get_current_surface", "AA39").parsed
    assert (current.version, len(current.z), len(current.control_points[0][0][0])) == (1, 4, 3)
    assert [item.version for item in plant.ask("surfaces.list_surfaces", "AA39").parsed.items] == [1]
    for sun in ({"azimuth_deg": -20.0, "elevation_deg": 45.0}, {"at": "2026-06-21T11:36:00+00:00"}):
        asked = plant.model("ForecastIn", {"heliostat": "AA39", "target": "lower", "sun": sun})
        forecast = plant.ask("forecasts.post_forecast", body=asked)
        assert (forecast.status_code, forecast.parsed.power_w) == (HTTPStatus.CREATED, 50.0)
        assert len(plant.ask("forecasts.get_forecast", forecast.parsed.id).parsed.flux) == 256


def test_the_guides_jobs(plant: Plant):
    asked = plant.model("PredictionsIn", {})
    begun = plant.ask("jobs.post_predictions_job", body=asked, idempotency_key="morning-1")
    again = plant.ask("jobs.post_predictions_job", body=asked, idempotency_key="morning-1")
    assert begun.status_code == HTTPStatus.ACCEPTED
    assert begun.parsed.id == again.parsed.id
    number = begun.parsed.id
    until(lambda: plant.ask("jobs.get_job", number).parsed.state in ("done", "failed"))
    assert plant.ask("jobs.get_job", number).parsed.state == "done"
    assert number in [job.id for job in plant.ask("jobs.list_jobs").parsed.items]
    assert "event: end" in plant.ask("jobs.get_job_events", number).content.decode()


def test_every_type_of_problem_is_in_the_guide():
    told = dict(re.findall(r"\| `urn:heliotwin:problem:([a-z-]+)` \| (\d+) \|", GUIDE))
    assert told == {name: str(status) for status, name in TYPES.items()}


def test_every_call_of_the_guide_is_in_the_document(plant: Plant, tmp_path: Path):
    paths = create_app(Settings(data_dir=tmp_path, **QUIET), FakeOperations()).openapi()["paths"]
    forms = {re.sub(r"\{[^}]*\}", "[^/]+", path): operations for path, operations in paths.items()}
    for method, path in re.findall(r"^(GET|PUT|POST|PATCH) +(/v1/[\w/.-]+)", GUIDE, re.MULTILINE):
        assert any(re.fullmatch(form, path) and method.lower() in given for form, given in forms.items()), (
            method,
            path,
        )
