"""Tries each addition in a copy of the packages, which holds them: ``python -P trial.py COPY``.

The last line that it prints says of each "ok", or how it failed.
"""

import json
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typer.testing import CliRunner

from heliotwin.cli.main import app as command
from model.effects import CATALOGUE, effect_from_json
from model.fleet import Superposition, superpose, tile_of
from model.frames import sun_direction
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.site import JUELICH
from model.study import StudyOptions
from model.study.advice import photographs_to_distinguish
from model.surface import control_points
from model.tracing import Optics, Window
from service.base.settings import Settings
from service.sources.folder import read_declared, read_folder
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.importing import import_folder
from service.web.app import create_app

with warnings.catch_warnings():
    # Starlette's client prefers the successor of httpx, which the environment does not hold.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient

Client = Any
ROOT = Path(sys.argv[1])


def _facet(x: float, y: float) -> dict[str, Any]:
    return {
        "translation_vector": [x, y, 0.04],
        "canting_e": [0.8025, 0.0, 0.0],
        "canting_n": [0.0, 0.6375, 0.0],
    }


def _notes() -> Path:
    """A folder of the importer that was added."""
    folder = ROOT / "notes"
    folder.mkdir(exist_ok=True)
    joints = {f"joint_translation_{axis}_{stage}": 0.0 for axis in "enu" for stage in (1, 2)}
    heliostat = {
        "heliostat_position": [50.91396, 6.38782, 88.7],
        "height": 2.56,
        "width": 3.22,
        "kinematics_properties": {"actuators": [], **joints, "concentrator_translation_n": 0.175},
        "facet_properties": {"facets": [_facet(x, y) for y in (0.64, -0.64) for x in (-0.8, 0.8)]},
    }
    plant = {
        "origin": [50.91342, 6.38782, 87.0],
        "heliostats": {"N1": heliostat},
        "suns": [[200.0, 45.0]],
    }
    (folder / "notes.json").write_text(json.dumps(plant), encoding="utf-8")
    return folder


def resource(client: Client) -> None:
    assert client.get("/v1/greetings").json() == ["hello"]
    assert "/v1/greetings" in client.get("/openapi.json").json()["paths"]


def job_kind(client: Client) -> None:
    asked = client.post("/v1/jobs/doublings", json={"value": 21})
    assert asked.status_code == 202, asked.text
    while (job := client.get(asked.headers["location"]).json())["state"] in ("queued", "running"):
        time.sleep(0.05)
    assert job["result"] == {"doubled": 42}, job


def page(client: Client) -> None:
    answer = client.get("/hello")
    assert answer.headers["content-type"].startswith("text/html")
    assert "a page" in answer.text


def verb(client: Client) -> None:
    assert "Greet somebody" in CliRunner().invoke(command, ["--help"]).output
    assert CliRunner().invoke(command, ["greet", "you"]).output == "hello you\n"


def importer(client: Client) -> None:
    folder = read_folder(_notes())
    assert [measurement.key for measurement in folder.measurements("N1", with_images=False)] == [
        "N1/0"
    ]
    assert import_folder(client.app.state.runtime, folder)["counts"]["surfaces new"] == 1
    assert [item["name"] for item in client.get("/v1/heliostats").json()["items"]] == ["N1"]


def export_format(client: Client) -> None:
    surface = client.get("/v1/heliostats/N1/surfaces/current", headers={"Accept": "text/csv"})
    assert surface.headers["content-type"].startswith("text/csv")
    assert "N1-surface-1.csv" in surface.headers["content-disposition"]
    assert "# N1, surface 1 (measured): z" in surface.text
    documented = client.get("/openapi.json").json()["paths"]["/v1/forecasts/{number}"]["get"][
        "responses"
    ]["200"]
    assert "text/csv" in documented["content"]


def effect(client: Client) -> None:
    names = list(CATALOGUE)
    assert names[names.index("background") + 1] == "dust_glow"
    assert "dust_glow" in StudyOptions().candidates
    assert photographs_to_distinguish("dust_glow", "camera_blur")
    found = effect_from_json({"name": "dust_glow", "parameters": {"share": 0.1}})
    assert float(
        found.on_image(torch.tensor([[[0.0, 1.0]]]), Window(1, 1, 1, 2)).min()
    ) == torch.tensor(0.1)


def sun_shape(client: Client) -> None:
    (ROOT / "twin.json").write_text(
        '{"declared": {"sun": {"shape": "cosine", "rim_mrad": 5}}}', encoding="utf-8"
    )
    shape = read_declared(ROOT / "twin.json")[0].sun_shape
    assert type(shape).__name__ == "Cosine"
    assert shape.edges == (0.0, 0.005)
    assert _superposed(_wall(), Optics(sun_shape=shape)).max() > 0


def _wall() -> TargetPlane:
    return TargetPlane(
        "wall", np.array([0.0, 0, 40]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.0, 8.0
    )


def _superposed(receiver: Any, optics: Optics) -> Any:
    heliostat = Heliostat.juelich("H", np.array([0.0, 80.0, 1.8]), 90.0)
    setup = Setup(
        heliostat,
        control_points(heliostat),
        sun_direction(180.0, 50.0),
        receiver.middle,
        aim=receiver.center,
    )
    task = Superposition(receiver, PlantModel(JUELICH, optics), (16, 16))
    return superpose(task, [tile_of([setup])]).irradiance


def receiver(client: Client) -> None:
    wedge = import_module("model.wedge").Wedge("wedge", _wall(), 20.0)
    flat, folded = (_superposed(one, Optics()) for one in (_wall(), wedge))
    # Its edge is where the wall was, and both sides are turned away from the light by 20 degrees.
    assert 0.85 < folded.max() / flat.max() < 0.97
    assert receiver_as_json(wedge)["fold_deg"] == 20.0


TRIALS: dict[str, Callable[[Client], None]] = {
    "REST resource": resource,
    "job kind": job_kind,
    "page": page,
    "CLI verb": verb,
    "importer": importer,
    "export format": export_format,
    "effect": effect,
    "sun shape": sun_shape,
    "receiver": receiver,
}


def main() -> None:
    torch.set_num_threads(1)
    found = {}
    settings = Settings(job_poll_s=0.05, requests_per_s=1e6, requests_burst=10**6)
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as client:
        for name, trial in TRIALS.items():
            try:
                trial(client)
                found[name] = "ok"
            except Exception:  # noqa: BLE001 - whatever it is, the test shows it
                found[name] = traceback.format_exc()
    print(json.dumps(found))


if __name__ == "__main__":
    main()
