"""Weights whose bits are flipped predict nothing: a real service on a damaged copy of
the package.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from model.checksums import read_verified
from model.errors import WeightsError
from model.network.predictor import WEIGHTS
from model.prior import PRIOR
from tests.service.conftest import free_port
from tests.waiting import child_process, until

ROOT = Path(__file__).parents[3]


def flip(path: Path) -> None:
    """Another byte in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@contextmanager
def service_of(checkout: Path, plant: Path) -> Iterator[httpx.Client]:
    """A client of a service that runs from a checkout, with a plant in its store."""
    port, program = free_port(), [sys.executable, "-m", "service"]
    environment = os.environ | {
        "HELIOTWIN_DATA_DIR": str(checkout / "data"),
        "HELIOTWIN_PORT": str(port),
    }
    environment["PYTHONPATH"] = str(checkout)
    environment.pop("HELIOTWIN_DATABASE_URL", None)
    options = {"cwd": checkout, "env": environment}
    subprocess.run([*program, "import", plant], check=True, capture_output=True, **options)
    with (
        (checkout / "log").open("wb") as log,
        child_process([*program, "serve"], **options, stderr=log) as process,
        httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=300) as client,
    ):

        def answers() -> bool:
            assert process.poll() is None, (checkout / "log").read_text(encoding="utf-8")
            try:
                return client.get("/livez").status_code == 200
            except httpx.TransportError:
                return False

        until(answers, "the service answers")
        yield client


@pytest.mark.full
@pytest.mark.parametrize("damaged", [WEIGHTS.name, PRIOR.name])
def test_damaged_weights_predict_nothing_and_everything_else_goes_on(
    damaged: str, pair_plant: Path, tmp_path: Path
):
    shutil.copytree(ROOT / "model", tmp_path / "model")
    for package in ("service", "migrations"):
        (tmp_path / package).symlink_to(ROOT / package)
    flip(tmp_path / "model" / "weights" / damaged)
    with service_of(tmp_path, pair_plant) as client:
        ready = client.get("/readyz")
        assert ready.status_code == 503
        assert damaged in ready.json()["checks"]["weights"]
        assert ready.json()["checks"]["database"] == "ok"
        name = client.get("/v1/heliostats").json()["items"][0]["name"]
        refused = client.post(f"/v1/heliostats/{name}/surfaces", json={"method": "network"})
        assert refused.status_code == 503, refused.text
        assert damaged in refused.json()["detail"]
        assert "install heliotwin again" in refused.json()["detail"]
        assert "Retry-After" in refused.headers
        target = client.get("/v1/targets").json()["items"][0]["name"]
        forecast = {
            "heliostat": name,
            "target": target,
            "sun": {"azimuth_deg": 180, "elevation_deg": 45},
            "surface": "ideal",
            "resolution": [16, 16],
        }
        assert client.post("/v1/forecasts", json=forecast).status_code == 201
        assert client.get(f"/heliostats/{name}", headers={"Accept": "text/html"}).status_code == 200


def test_shipped_files_are_those_of_their_cards(tmp_path: Path):
    for path in (WEIGHTS, PRIOR):
        assert read_verified(path) == path.read_bytes()
        with pytest.raises(WeightsError, match=f"{path.name} or its model card cannot be read"):
            read_verified(tmp_path / path.name)
