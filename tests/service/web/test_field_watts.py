"""Watts of field forecasts and plans, on receivers of every kind of an imported plant."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from heliotwin.field import FieldRequest, trace_field
from model.fleet import LOSSES
from service.sources.folder import read_folder
from service.sources.plant_file import PlantDescription, read_plant
from service.twin.importing import import_folder
from tests.page import Page
from tests.service import real
from tests.service.sources.plant_files import RICH, write_plant
from tests.service.sources.plant_folder import write_plant_folder

pytestmark = [pytest.mark.full]

SUN = {"azimuth_deg": 150.0, "elevation_deg": 35.0}
RECEIVERS = ("main", "board", "cave", "walls")
HTML = {"Accept": "text/html"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_plant_folder(tmp_path_factory.mktemp("rich"), RICH)


@pytest.fixture(scope="module")
def plant(folder: Path) -> PlantDescription:
    return read_plant(folder / "plant.yaml")


@pytest.fixture(scope="module")
def rich(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with real.client_on(tmp_path_factory.mktemp("store")) as client:
        report = import_folder(real.runtime_of(client), read_folder(folder))
        assert (report["counts"]["receivers new"], report["skipped"]) == (4, {})
        yield client


def done(client: TestClient, kind: str, body: dict[str, Any]) -> dict[str, Any]:
    """The job of a request, when it has ended."""
    return real.done_job(client, f"/v1/jobs/{kind}", **body)


@pytest.mark.parametrize("name", RECEIVERS)
def test_field_forecast_has_the_watts_of_the_plant_file(
    rich: TestClient, plant: PlantDescription, name: str
):
    """By the same names, and the same to a tenth of a percent, as ``heliotwin field``."""
    body = {"target": name, "sun": SUN, "surface": "ideal", "resolution": [48, 96]}
    result = done(rich, "forecasts", body | {"dni_w_m2": "clear_sky"})["result"]
    receiver = plant.receivers[name]
    names = {item["name"] for item in rich.get("/v1/heliostats").json()["items"]}
    feet = {one: heliostat.position for one, heliostat in plant.plant.heliostats.items()}
    aims = {one: receiver.aim_of(feet[one]) for one in names}
    request = FieldRequest(name, 150.0, 35.0, aims=aims, resolution=(48, 96))
    report = trace_field(plant, request, lambda _: None).report
    assert result["dni_w_m2"] == pytest.approx(report["dni_w_m2"])
    field = result["field"]
    assert set(field) == set(report["field"])
    for key, value in report["field"].items():
        if key != "peak_w_m2":
            assert field[key] == pytest.approx(value, rel=2e-3), key
    product = np.prod([field[factor] for factor in LOSSES])
    assert product == pytest.approx(field["optical_efficiency"], rel=1e-9)
    assert field["intercepted_w"] == pytest.approx(result["power_w"], rel=2e-3)
    assert field["absorptance"] == pytest.approx(receiver.absorptance)
    assert field["shading"] <= 1
    assert set(result["by_heliostat"]) == names - set(result["skipped"])
    assert result["skipped"] == report["skipped"]
    parts = sum(one["intercepted_w"] for one in result["by_heliostat"].values())
    assert parts == pytest.approx(field["intercepted_w"], rel=1e-9)


def test_heliostats_of_another_receiver_cast_shadows_only(tmp_path: Path):
    """As the layout says, and as ``heliotwin field`` has it: B1 lights the board."""
    described = read_plant(write_plant(tmp_path / "plant", RICH))
    with real.client_on(tmp_path / "store") as client:
        import_folder(real.runtime_of(client), read_folder(tmp_path / "plant", whole_field=True))
        for name, lit in (("main", {"A1", "A2"}), ("board", {"B1"}), ("walls", {"A1", "A2", "B1"})):
            body = {"target": name, "sun": SUN, "surface": "ideal", "resolution": [48, 96]}
            result = done(client, "forecasts", body)["result"]
            assert set(result["by_heliostat"]) | set(result["skipped"]) == lit
            if name == "walls":  # no heliostat is the walls' own
                continue
            request = FieldRequest(name, 150.0, 35.0, 1000.0, resolution=(48, 96))
            field = trace_field(described, request, lambda _: None).report["field"]
            for key in ("shading", "blocking", "intercepted_w"):
                assert result["field"][key] == pytest.approx(field[key], rel=2e-3), key


def test_one_heliostat_is_forecast_on_receivers_of_every_kind(rich: TestClient):
    for name in RECEIVERS:
        body = {"heliostat": "A1", "target": name, "sun": SUN, "resolution": [32, 64]}
        made = rich.post("/v1/forecasts", json=body)
        assert made.status_code == 201, made.text
        assert made.json()["power_w"] > 1e3
        camera = rich.get(f"/v1/forecasts/{made.json()['id']}?view=camera")
        assert camera.status_code == 409  # no camera looks at receivers


@pytest.mark.parametrize("name", RECEIVERS)
def test_single_forecast_has_the_losses_of_the_same_field_forecast(rich: TestClient, name: str):
    """By the names of ``field.json``: its factors multiply to its watts."""
    body = {"target": name, "sun": SUN, "resolution": [48, 96], "dni_w_m2": "clear_sky"}
    posted = rich.post("/v1/forecasts", json=body | {"heliostat": "A1"})
    assert posted.status_code == 201, posted.text
    made = rich.get(posted.headers["Location"]).json()
    losses = made["losses"]
    field = done(rich, "forecasts", body | {"heliostats": ["A1"], "neighbours": False})
    expected = field["result"]["field"]
    assert losses.keys() == expected.keys() - {"heliostats", "peak_w_m2"}
    # The field's tower, which hides nothing of A1 under this sun, is all that is traced besides.
    for key, value in losses.items():
        assert value == pytest.approx(expected[key], rel=5e-3), key
    product = np.prod([losses[factor] for factor in LOSSES])
    assert product == pytest.approx(losses["optical_efficiency"], rel=1e-9)
    assert losses["incident_w"] == pytest.approx(made["dni_w_m2"] * losses["mirror_area_m2"])
    assert losses["absorbed_w"] == pytest.approx(product * losses["incident_w"])
    assert losses["intercepted_w"] == pytest.approx(made["power_w"], rel=1e-3)
    page = rich.get(f"/forecasts/{made['id']}", headers=HTML).text
    assert "What becomes of the light" in Page(page).words
    table = rich.get(f"/forecasts/{made['id']}?table=losses", headers=HTML)
    lines = list(csv.DictReader(io.StringIO(table.text)))
    assert [line["Stage"] for line in lines] == ["on the mirrors' area", *LOSSES]
    assert float(lines[-1]["Left [W]"]) == pytest.approx(losses["absorbed_w"])


def test_losses_are_those_of_the_whole_plane_whatever_is_mapped(rich: TestClient):
    body = {"heliostat": "B1", "target": "board", "sun": SUN, "resolution": 64}
    whole, window = (
        rich.post("/v1/forecasts", json=body | some).json() for some in ({}, {"window_m": 0.5})
    )
    assert window["power_w"] < 0.9 * whole["power_w"]
    assert window["losses"] == pytest.approx(whole["losses"])


def test_tower_shades_the_field(rich: TestClient):
    """The sun in the south is low, and A1 is behind the tower."""
    sun = {"azimuth_deg": 180.0, "elevation_deg": 30.0}
    body = {"target": "main", "sun": sun, "heliostats": ["A1"], "resolution": 32}
    shaded = done(rich, "forecasts", body)["result"]["field"]["shading"]
    free = done(rich, "forecasts", body | {"neighbours": False})["result"]["field"]["shading"]
    assert free == 1
    assert shaded < 0.9


def test_page_shows_the_chain_of_losses_and_each_heliostat(rich: TestClient):
    job = done(rich, "forecasts", {"target": "cave", "sun": SUN, "resolution": 48})
    number, field = job["id"], job["result"]["field"]
    page = Page(rich.get(f"/jobs/{number}", headers=HTML).text)
    for words in ("What becomes of the light", "cosine", "absorptance", "By heliostat"):
        assert words in page.words
    table = rich.get(f"/jobs/{number}?table=losses", headers=HTML)
    lines = list(csv.DictReader(io.StringIO(table.text)))
    assert [line["Stage"] for line in lines] == ["on the mirrors' area", *LOSSES]
    assert float(lines[-1]["Left [W]"]) == pytest.approx(field["absorbed_w"])
    by_factor = job["result"]["by_heliostat"]
    for factor in ("cosine", "intercept"):
        sorted_page = rich.get(f"/jobs/{number}?by={factor}", headers=HTML).text
        mirrors = sorted_page[sorted_page.index("mirrors-title") :]
        first = min(by_factor, key=lambda name, factor=factor: by_factor[name][factor])
        other = next(name for name in by_factor if name != first)
        assert mirrors.index(f"/heliostats/{first}") < mirrors.index(f"/heliostats/{other}")
    assert rich.get(f"/jobs/{number}?by=size", headers=HTML).status_code == 422
    every = rich.get(f"/jobs/{number}/heliostats.csv")
    rows = {row["heliostat"]: row for row in csv.DictReader(io.StringIO(every.text))}
    assert set(rows) == set(by_factor)
    assert float(rows["A1"]["intercepted_w"]) == by_factor["A1"]["intercepted_w"]


def test_plan_states_the_losses_of_each_time(rich: TestClient):
    day = {"first_at": "2026-06-21T15:00:00Z", "last_at": "2026-06-21T21:00:00Z"}
    body = {"name": "June", "target": "main", "step_minutes": 180, "resolution": 32}
    job = done(rich, "plans", body | day | {"dni_w_m2": "clear_sky"})
    steps = job["result"]["steps"]
    suns = [step["dni_w_m2"] for step in steps]
    assert min(suns) > 600
    assert len(set(suns)) == len(suns) == 3
    for step in steps:
        for mirrors in ("twin", "ideal"):
            field = step[mirrors]["field"]
            assert field["incident_w"] == pytest.approx(step["dni_w_m2"] * field["mirror_area_m2"])
            assert field["intercepted_w"] == pytest.approx(step[mirrors]["power_w"], rel=1e-2)
    page = Page(rich.get(f"/plans/{job['id']}", headers=HTML).text)
    for words in ("Losses at", "of a clear sky", "efficiency", "Absorbed"):
        assert words in page.words


def test_plant_page_lists_receivers_of_every_kind(rich: TestClient):
    words = Page(rich.get("/plant", headers=HTML).text).words
    for name, kind in zip(RECEIVERS, ("cylinder", "plane", "cavity", "panels"), strict=True):
        assert f"{name} {kind}" in words
    assert "casts a shadow" in words
