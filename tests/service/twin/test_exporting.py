"""The store as a measurement folder: a round trip through it loses nothing that an import reads."""

import json
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from jsonschema import Draft7Validator
from jsonschema.protocols import Validator
from pystac.validation.local_validator import get_local_schema_cache
from referencing import Registry

from model.errors import InvalidInputError
from model.surface import control_points
from service import store
from service.base.arrays import unpack
from service.base.settings import Settings
from service.sources.folder import read_folder, read_surface
from service.store.models import declared_of, find_current
from service.store.surfaces import NewSurface
from service.twin.evidence import load_twin
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from tests.service.conftest import QUIET, FakeOperations, png, poster

RECEIVER = {"center": [0, -3, 55.2], "normal": [0, 1, 0], "radius": 4.1, "height": 5.2, "opening_deg": 60}


def jpeg(seed: int) -> bytes:
    pixels = np.random.default_rng(seed).integers(1, 255, (40, 50, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


@pytest.fixture
def filled(client: TestClient, tower: dict[str, Any]) -> TestClient:
    """Photographs with all that is known of them, a measured surface and a predicted one, a receiver, a model."""
    send, spot = poster(client), [50.9136, 6.3879, 123.0]
    known = {"taken_at": "2024-06-03T11:30:00Z", "motor_position": [31234.0, 45012.5], "focal_spot": spot}
    send(png(1), id="1", **known)
    send(png(2), id="1", kind="cropped", **known)
    send(png(3, refused=True), id="2", sun_azimuth=-33.25)
    send(jpeg(4), id="3", kind="raw", target_name="upper", taken_at="2024-06-04T09:00:00.25Z")
    send(png(5))
    send(png(6), id="bad")
    client.patch("/v1/heliostats/AA39/measurements/bad", json={"excluded": True, "reason": "a bird"})
    assert client.put("/v1/receivers/drum", json=RECEIVER).status_code in (200, 201)
    declared = {"sun": {"shape": "pillbox", "half_angle_mrad": 4.65}, "cameras": [{"transfer": {"gamma": 2.0}}]}
    assert client.put("/v1/plant", json=tower | {"declared": declared}).status_code == 200
    assert client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["1"]}).status_code == 201
    with client.app.state.runtime.database.writing() as session:  # type: ignore[attr-defined]
        z = np.random.default_rng(1).normal(0, 3e-4, (4, 8, 8))
        z -= z.mean(axis=(1, 2), keepdims=True)
        row = store.get_heliostat(session, "AA39")
        points = measured_points(client, z)
        since = datetime(1970, 1, 1, tzinfo=UTC)
        store.add_surface(session, row, NewSurface("measured", z, 0 * z, points, since), once=True)
    return client


def measured_points(client: TestClient, z: Any) -> Any:
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        return control_points(load_twin(session, "AA39").heliostat, z)


@pytest.fixture
def exported(filled: TestClient, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    app: FastAPI = filled.app  # type: ignore[assignment]
    return tmp_path / "out", export_folder(app.state.runtime, tmp_path / "out")


@pytest.fixture
def other(tmp_path: Path) -> Iterator[Runtime]:
    """An empty store."""
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path / "other", **QUIET), FakeOperations())
    runtime.database.upgrade()
    yield runtime
    runtime.close()


def told(runtime: Runtime) -> dict[str, Any]:
    """All that an import reads, of a store."""
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, "AA39")
        rows = store.list_measurements(session, heliostat, None)
        surface = store.find_measured_surface(session, heliostat)
        assert surface is not None
        plant = store.get_plant(session)
        return {
            "plant": (plant.name, plant.origin),
            "declared": declared_of(session, find_current(session)),
            "targets": {row.name: _place(row) for row in store.list_targets(session)},
            "receivers": {
                row.name: (*_place(row), row.radius_m, row.height_m, row.opening_deg)
                for row in store.list_receivers(session)
            },
            "properties": heliostat.properties,
            "surface in mm": (1e3 * unpack(surface.arrays)["z"]).tolist(),
            "measurements": {
                (row.external_id or row.identifier, row.kind): {
                    "target": row.target.name,
                    "sun": (row.sun_azimuth_deg, row.sun_elevation_deg),
                    "motors": (row.motor_axis_1, row.motor_axis_2),
                    "taken": row.taken_at,
                    "spot": row.focal_spot_wgs84,
                    "accepted": (row.accepted, row.reason),
                }
                for row in rows
                if row.reason != "excluded"
            },
        }


def _place(row: Any) -> tuple[Any, ...]:
    return row.center_m, row.normal, row.up


def same(one: Any, other: Any) -> bool:
    """Whether two answers are the same, numbers to a millionth: places go to degrees and back."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == pytest.approx(other, abs=1e-6, rel=0)) if isinstance(one, float) else bool(one == other)


def test_round_trip_loses_nothing(filled: TestClient, exported: tuple[Path, dict[str, Any]], other: Runtime):
    folder, report = exported
    assert report["skipped"] == {"AA39/bad": "excluded"}
    done = import_folder(other, read_folder(folder))
    assert done["skipped"] == {}
    app: FastAPI = filled.app  # type: ignore[assignment]
    before, after = told(app.state.runtime), told(other)
    assert len(before["measurements"]) == 5
    for name, value in before.items():
        assert same(value, after[name]), (name, value, after[name])


def test_pixels_are_the_same(exported: tuple[Path, dict[str, Any]]):
    folder = exported[0] / "AA39" / "Calibration"
    assert (folder / "1-flux.png").read_bytes() == png(1)
    sent = cv2.imdecode(np.frombuffer(jpeg(4), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(cv2.imread(str(folder / "3-raw.png")), sent)


def test_predicted_surface_lies_apart_and_is_read_there(exported: tuple[Path, dict[str, Any]]):
    folder = exported[0] / "surfaces"
    heliostat = read_folder(exported[0]).plant.heliostats["AA39"]
    found = read_surface(folder, heliostat)
    assert found is not None
    assert found[0].shape == (4, 8, 8, 3)


@pytest.fixture(scope="module")
def stac() -> Callable[[str], Validator]:
    """The validator of a kind of document: by the official schemas, which come with pystac."""
    schemas = get_local_schema_cache()
    registry: Registry[Any] = Registry().with_contents(schemas.items())
    (version,) = {name.split("/")[3] for name in schemas if "stacspec" in name}

    def of(kind: str) -> Validator:
        schema = schemas[f"https://schemas.stacspec.org/{version}/{kind}-spec/json-schema/{kind}.json"]
        return Draft7Validator(schema, registry=registry, format_checker=Draft7Validator.FORMAT_CHECKER)

    return of


def items_of(folder: Path) -> dict[str, dict[str, Any]]:
    """The items that the catalogue links to, by their paths."""
    links = json.loads((folder / "catalog.json").read_text())["links"]
    return {link["href"]: json.loads((folder / link["href"]).read_text()) for link in links if link["rel"] == "item"}


def test_catalogue_and_items_are_stac(exported: tuple[Path, dict[str, Any]], stac: Callable[[str], Validator]):
    folder, report = exported
    stac("catalog").validate(json.loads((folder / "catalog.json").read_text()))
    items = items_of(folder)
    assert len(items) == report["counts"]["STAC items"] == 7  # properties, two surfaces, four photographs
    assert len({item["id"] for item in items.values()}) == 7
    for path, item in items.items():
        stac("item").validate(item)
        beside = (folder / path).parent
        for place in [*item["assets"].values(), *item["links"]]:
            assert (beside / place["href"]).resolve().is_file()


def test_items_say_whose_they_are(exported: tuple[Path, dict[str, Any]]):
    told = items_of(exported[0])["./AA39/Calibration/2-calibration-item-stac.json"]["properties"]
    assert told["heliotwin:heliostat"] == "AA39"
    assert told["heliotwin:target"] == "lower"
    assert (told["heliotwin:sun_azimuth_deg"], told["heliotwin:sun_elevation_deg"]) == (-33.25, 45.0)


def test_unknown_times_are_periods(exported: tuple[Path, dict[str, Any]]):
    items = items_of(exported[0])
    whens = {path: item["properties"] for path, item in items.items() if item["properties"]["datetime"] is None}
    measured = "./AA39/Deflectometry/AA39-surface-item-stac.json"
    assert {*whens} >= {measured, "./AA39/Calibration/2-calibration-item-stac.json"}
    for when in whens.values():  # before they came, and nothing else is sure
        first, last = (datetime.fromisoformat(when[name]) for name in ("start_datetime", "end_datetime"))
        assert first < datetime.now(UTC) - timedelta(days=365)
        assert datetime.now(UTC) - timedelta(hours=1) < last < datetime.now(UTC)


def test_folder_that_holds_something_is_left_alone(filled: TestClient, tmp_path: Path):
    (tmp_path / "mine").write_text("mine")
    app: FastAPI = filled.app  # type: ignore[assignment]
    with pytest.raises(InvalidInputError, match="not empty"):
        export_folder(app.state.runtime, tmp_path)


def test_photograph_that_was_corrected_in_one_kind_keeps_both(filled: TestClient, tmp_path: Path, other: Runtime):
    answer = filled.patch("/v1/heliostats/AA39/measurements/1-cropped", json={"sun_azimuth": 1.5, "reason": "clock"})
    assert answer.status_code == 200
    app: FastAPI = filled.app  # type: ignore[assignment]
    export_folder(app.state.runtime, tmp_path / "out")
    import_folder(other, read_folder(tmp_path / "out"))
    suns = {key: value["sun"][0] for key, value in told(other)["measurements"].items()}
    assert (suns["1", "flux"], suns["1-cropped", "cropped"]) == (20.0, 1.5)
