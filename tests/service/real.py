"""A store that the product filled from real photographs: import, predictions, a forecast, a study
and its adoption.

The fixtures `real_store` (do not change it), `real_copy` and `real_client` (change them as you
like) are in `conftest`.
"""

import shutil
import threading
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, cast

from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import QUIET, client_of

HELIOSTATS = ("AA39", "AC43")
CANDIDATES = ["camera_response", "camera_shoulder"]
"""Of the catalogue's effects those that a study of all of them finds in these photographs: two of
them are cheap.
"""
REASON = {"reason": "the photographs that would decide are ordered"}
"""For adopting what that study found, because it leaves questions open."""
SUN = {"azimuth_deg": 200.0, "elevation_deg": 45.0}


def copy_measurements(stj: Path, root: Path) -> None:
    """Copy the plant, and of `HELIOSTATS` the measured surfaces and the 11 photographs that have a
    flux.
    """
    for name in HELIOSTATS:
        for part in ("Properties", "Deflectometry"):
            shutil.copytree(stj / name / part, root / name / part)
        calibration = root / name / "Calibration"
        calibration.mkdir()
        for image in (stj / name / "Calibration").glob("*-flux.png"):
            shutil.copy(image, calibration)
            shutil.copy(
                image.with_name(image.name.replace("flux.png", "calibration-properties.json")),
                calibration,
            )
    shutil.copy(stj / "WRI1030197-tower-measurements.json", root)


def settings_of(folder: Path, **changes: Any) -> Settings:
    """Settings of the service on the store in ``folder``; jobs run only where a test runs them
    (`run_job`).
    """
    return Settings(data_dir=folder / "data", import_root=folder / "import", **QUIET | changes)


def client_on(folder: Path, **changes: Any) -> AbstractContextManager[TestClient]:
    """A client of the service, with the real model, on the store in ``folder``."""
    return client_of(create_app(settings_of(folder, **changes)))


def runtime_of(client: TestClient) -> Runtime:
    """The runtime behind a client."""
    return cast(Runtime, cast(FastAPI, client.app).state.runtime)


def run_job(client: TestClient, path: str, **payload: Any) -> dict[str, Any]:
    """Post a job, run it here, and return its result."""
    return cast(dict[str, Any], done_job(client, path, **payload)["result"])


def done_job(client: TestClient, path: str, **payload: Any) -> dict[str, Any]:
    """Post a job, run it here, and return it when it is done."""
    answer = client.post(path, json=payload)
    assert answer.status_code == 202, answer.text
    assert worker(client).work()
    job: dict[str, Any] = client.get(answer.headers["Location"]).json()
    assert job["state"] == "done", job["reason"]
    return job


def fill(stj: Path, folder: Path) -> None:
    """Make the store in ``folder``: ``data`` is the service's folder, ``import/stj`` what it
    imported.
    """
    copy_measurements(stj, folder / "import" / "stj")
    with client_on(folder) as client:
        run_job(client, "/v1/jobs/imports", folder="stj")
        run_job(client, "/v1/jobs/predictions", images=4)
        body = {
            "heliostat": "AA39",
            "target": "multi_focus_tower",
            "sun": SUN,
            "surface": "current",
        }
        assert client.post("/v1/forecasts", json=body).status_code == 201
        study = run_job(client, "/v1/jobs/studies", candidates=CANDIDATES)
        assert study["verdict"] == "effect", study
        path = f"/v1/studies/{study['study']}"
        assert client.get(path).json()["effects"][0]["scope"] == {"kind": "set"}
        assert client.post(f"{path}/adopt", json=REASON).status_code == 201
        assert client.post(f"{path}/withdraw").status_code == 200


def worker(client: TestClient) -> Worker:
    """A worker of the service behind a client."""
    return Worker(runtime_of(client), KINDS, "tester", threading.Event())
