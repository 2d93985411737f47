"""The main job over HTTP with the real model, on real measurements of the Solar Tower Juelich where
they are.
"""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from benchmarks import data_folder
from model.frames import wgs84_to_enu
from service.base.settings import Settings
from service.sources.documents import read_targets, read_tower_base
from service.sources.paint_documents import azimuth_from_north
from service.web.app import create_app
from tests.service.conftest import client_of

STJ = data_folder()
CALIBRATION = STJ / "AA39" / "Calibration"

pytestmark = pytest.mark.skipif(
    not CALIBRATION.is_dir(), reason=f"no measurements of AA39 under {STJ}"
)


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("real"))
    with client_of(create_app(settings)) as client:
        assert (
            client.put(
                "/v1/plant", json=read(STJ / "WRI1030197-tower-measurements.json")
            ).status_code
            == 200
        )
        properties = read(STJ / "AA39" / "Properties" / "AA39-heliostat-properties.json")
        assert client.put("/v1/heliostats/AA39", json=properties).status_code == 201
        yield client


def send(client: TestClient, number: str, kind: str = "flux") -> Any:
    """Post an image with what PAINT says of it."""
    document = read(CALIBRATION / f"{number}-calibration-properties.json")
    tower = read(STJ / "WRI1030197-tower-measurements.json")
    origin = tower["power_plant_properties"]["coordinates"]
    azimuth_deg = azimuth_from_north(document["sun_azimuth"])
    metadata = {
        "kind": kind,
        "id": number,
        "target": document["target_name"],
        "sun": {"azimuth_deg": azimuth_deg, "elevation_deg": document["sun_elevation"]},
        "motor_position": document["motor_position"],
        "focal_spot_m": wgs84_to_enu(document["focal_spot"]["UTIS"], origin).tolist(),
    }
    image = (CALIBRATION / f"{number}-{kind}.png").read_bytes()
    return client.post(
        "/v1/heliostats/AA39/measurements",
        files={"image": (f"{number}-{kind}.png", image, "image/png")},
        data={"metadata": json.dumps(metadata)},
    )


def test_real_image_to_flux_surface_and_forecast(real: TestClient):
    created = send(real, "205363")
    assert created.status_code == 201, created.text
    assert created.json()["accepted"], created.json()["quality"]
    assert send(real, "205363").status_code == 200

    flux = real.get("/v1/heliostats/AA39/measurements/205363/flux").json()
    assert np.sum(flux["centered"]) == pytest.approx(100, rel=1e-3)

    surface = real.post("/v1/heliostats/AA39/surfaces", json={"images": 4})
    assert surface.status_code == 201, surface.text
    z = np.array(surface.json()["z"])
    assert z.shape == (4, 8, 8)
    assert 1e-5 < np.abs(z).max() < 0.02

    forecast = real.post(
        "/v1/forecasts",
        json={
            "heliostat": "AA39",
            "target": "multi_focus_tower",
            "sun": {"azimuth_deg": 200.0, "elevation_deg": 45.0},
            "surface": "current",
        },
    )
    assert forecast.status_code == 201, forecast.text
    body = forecast.json()
    # 4 facets of 1.605 m x 1.275 m send at most their area times the irradiance
    assert 4000 < body["power_w"] < 8200
    npz = real.get(f"/v1/forecasts/{body['id']}", headers={"Accept": "application/x-npz"})
    irradiance = np.load(io.BytesIO(npz.content))["flux"]
    assert irradiance.shape == (256, 256)
    assert irradiance.max() == pytest.approx(body["peak_w_m2"], rel=1e-5)


def test_measured_spot_lies_where_paint_saw_it(real: TestClient):
    """Of the separated flux the centre of mass is PAINT's UTIS spot within two decimetres."""
    answer = send(real, "151375").json()
    document = read(CALIBRATION / "151375-calibration-properties.json")
    tower = read(STJ / "WRI1030197-tower-measurements.json")
    origin = read_tower_base(tower)
    expected = read_targets(tower)[document["target_name"]].to_plane(
        wgs84_to_enu(document["focal_spot"]["UTIS"], origin)
    )
    np.testing.assert_allclose(answer["center_of_mass_m"], expected, atol=0.2)


def test_sun_behind_the_mirror_is_the_callers_error(real: TestClient):
    plane = {"center": [13, 80, 2], "normal": [0, 1, 0], "width": 5, "height": 5}
    answer = real.post(
        "/v1/forecasts",
        json={
            "heliostat": "AA39",
            "plane": plane,
            "sun": {"azimuth_deg": 180, "elevation_deg": 20},
            "surface": "ideal",
        },
    )
    assert answer.status_code == 422, answer.text


def test_service_with_the_shipped_weights_is_ready(real: TestClient):
    assert real.get("/readyz").json()["checks"] == {
        "database": "ok",
        "migrations": "ok",
        "weights": "ok",
    }
