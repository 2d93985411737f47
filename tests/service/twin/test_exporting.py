"""The store as a measurement folder: a round trip through it loses nothing that cannot be made again."""

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
from sqlalchemy import select

from model.errors import InvalidInputError
from model.surface import control_points
from service import store
from service.base.arrays import pack
from service.base.settings import Settings
from service.sources.folder import read_folder, read_surface
from service.sources.photograph import Photograph
from service.store.columns import Base
from service.store.surfaces import NewSurface
from service.store.tables import (
    CorrectionRow,
    DecisionRow,
    HeliostatRow,
    ImageRow,
    MeasurementRow,
    ModelRow,
    MountRow,
    PlantRow,
    ReceiverRow,
    StudyRow,
    SurfaceRow,
    TargetRow,
    surface_measurements,
)
from service.twin import versions
from service.twin.evidence import load_twin
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.ingest import ingest
from service.twin.runtime import Runtime
from tests.service.conftest import QUIET, FakeOperations, png, poster
from tests.service.twin.test_versions import SLOPE, study_row

RECEIVER = {"center": [0, -3, 55.2], "normal": [0, 1, 0], "radius": 4.1, "height": 5.2, "opening_deg": 60}


def jpeg(seed: int) -> bytes:
    pixels = np.random.default_rng(seed).integers(1, 255, (40, 50, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


@pytest.fixture
def filled(client: TestClient, tower: dict[str, Any]) -> TestClient:
    """Photographs with all that is known of them, a measured surface and a predicted one, a receiver, a model."""
    send, spot = poster(client), [50.9136, 6.3879, 123.0]
    both = {"UTIS": spot, "HeliOS": [50.9137, 6.3878, 123.5]}
    known = {"taken_at": "2024-06-03T11:30:00Z", "motor_position": [31234.0, 45012.5], "focal_spot": both}
    known |= {"wind_speed_m_s": 3.5, "wind_from_deg": 210.0, "temperature_c": -2.25}
    send(png(1), id="1", **known)
    send(png(2), id="1", kind="cropped", **known)
    send(png(3, refused=True), id="2", sun_azimuth=-33.25)
    helios = {"HeliOS": spot}
    send(jpeg(4), id="3", kind="raw", target_name="upper", taken_at="2024-06-04T09:00:00.25Z", focal_spot=helios)
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
        number = store.add_study(session, study_row(SLOPE, model=2)).id
        versions.adopt(session, number, "tester")
    assert client.put("/v1/heliostats/AA39/surfaces/current", json={"version": 1, "reason": "new"}).status_code == 200
    clock = {"sun_azimuth": -31.5, "reason": "clock"}
    assert client.patch("/v1/heliostats/AA39/measurements/2", json=clock).status_code == 200
    with client.app.state.runtime.database.writing() as session:  # type: ignore[attr-defined]
        row = store.get_heliostat(session, "AA39")
        store.mounts.add_mount(session, row, {"valid_from": "2024-06-03T11:30:00+00:00", "residual_mrad": [0.25]})
        store.get_measurement(session, row, "1").forecast_accuracy = 0.875
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


# Of every table that an export promises: columns that it does not, which this store alone knows of.
PROMISED: dict[type[Base], set[str]] = {
    PlantRow: set(),
    HeliostatRow: {"created_at", "updated_at"},
    TargetRow: {"updated_at", "corners"},
    ReceiverRow: {"updated_at"},
    ImageRow: {"created_at"},  # when it came to this store, from which it is kept
    MeasurementRow: set(),
    CorrectionRow: set(),
    SurfaceRow: set(),
    DecisionRow: set(),
    MountRow: set(),
    StudyRow: set(),
    ModelRow: set(),
}


def told(runtime: Runtime) -> dict[str, list[dict[str, Any]]]:
    """All rows of the promised tables; rows that they refer to by their places."""
    found, places = {}, {}
    with runtime.database.reading() as session:
        for kind, without in PROMISED.items():
            table = kind.__table__
            key = next(iter(table.primary_key))
            rows = session.execute(select(table).order_by(key)).mappings().all()
            places[table.name] = {row[key.name]: place for place, row in enumerate(rows)}
            found[table.name] = [
                {
                    column.name: places[reference.column.table.name].get(row[column])
                    if (reference := next(iter(column.foreign_keys), None)) is not None
                    else row[column]
                    for column in table.columns
                    if column.name not in {*without, "id"}
                }
                for row in rows
            ]
        links = session.execute(select(surface_measurements)).all()
    of = places["surfaces"], places["measurements"]
    return found | {"links": sorted(tuple(there[key] for there, key in zip(of, link, strict=True)) for link in links)}


def same(one: Any, other: Any) -> bool:
    """Whether two answers are the same, numbers to a millionth: places go to degrees and back."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == pytest.approx(other, abs=1e-6, rel=0)) if isinstance(one, float) else bool(one == other)


def test_round_trip_loses_nothing(filled: TestClient, exported: tuple[Path, dict[str, Any]], other: Runtime):
    folder, report = exported
    assert report["skipped"] == {}
    done = import_folder(other, read_folder(folder))
    assert done["skipped"] == {}
    app: FastAPI = filled.app  # type: ignore[assignment]
    before, after = told(app.state.runtime), told(other)
    assert {name: len(rows) for name, rows in before.items()} == {
        "plant": 1,
        "heliostats": 1,
        "targets": 2,
        "receivers": 1,
        "images": 6,
        "measurements": 6,
        "corrections": 2,
        "surfaces": 2,
        "surface_decisions": 1,
        "mounts": 1,
        "studies": 1,
        "models": 2,
        "links": 1,
    }
    for name, rows in before.items():
        assert same(rows, after[name]), (name, rows, after[name])


def test_second_import_changes_nothing(exported: tuple[Path, dict[str, Any]], other: Runtime):
    import_folder(other, read_folder(exported[0]))
    before = told(other)
    done = import_folder(other, read_folder(exported[0]))
    assert done["counts"]["histories unchanged"] == 2
    assert not [name for name in done["counts"] if name.endswith(" new")]
    assert told(other) == before


def test_photograph_that_is_sent_again_is_known(exported: tuple[Path, dict[str, Any]], other: Runtime):
    import_folder(other, read_folder(exported[0]))
    photograph = Photograph("upper", "raw", 20.0, 45.0, "3", datetime(2024, 6, 4, 9, 0, 0, 250000, tzinfo=UTC))
    row, is_new = ingest(other, "AA39", photograph, jpeg(4))
    assert (row.identifier, is_new) == ("3", False)


def test_excluded_photograph_is_used_by_nobody(exported: tuple[Path, dict[str, Any]], other: Runtime):
    folder = read_folder(exported[0])
    assert "bad" not in {measurement.identifier for measurement in folder.measurements("AA39")}
    import_folder(other, folder)
    with other.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, "AA39"), "bad")
    assert (row.accepted, row.reason) == (False, "excluded")


def test_what_the_store_has_of_its_own_stays(exported: tuple[Path, dict[str, Any]], other: Runtime):
    """A heliostat that has surfaces gets no others; the rest is imported."""
    folder = read_folder(exported[0])
    import_folder(other, folder)
    with other.database.writing() as session:
        row = store.get_surface(session, store.get_heliostat(session, "AA39"), 2)
        row.misfit = 0.5
    done = import_folder(other, folder)
    assert done["skipped"]["AA39 history"].startswith("the store has surfaces or mounts of its own")
    with other.database.reading() as session:
        assert store.get_surface(session, store.get_heliostat(session, "AA39"), 2).misfit == 0.5


def test_wrong_history_is_named(exported: tuple[Path, dict[str, Any]], other: Runtime):
    file = exported[0] / "history" / "heliostats" / "AA39" / "history.json"
    document = json.loads(file.read_text())
    document["photographs"][0]["image"] = "../../../secret.png"
    file.write_text(json.dumps(document))
    done = import_folder(other, read_folder(exported[0]))
    assert "photographs.0.image" in done["skipped"]["AA39 history"]
    assert str(file) in done["skipped"]["AA39 history"]


def test_wrong_arrays_are_named_and_nothing_is_half_restored(exported: tuple[Path, dict[str, Any]], other: Runtime):
    file = exported[0] / "history" / "heliostats" / "AA39" / "surface-2.npz"
    for content in (b"nothing", pack({"z": np.zeros((4, 8, 8))})):
        file.write_bytes(content)
        done = import_folder(other, read_folder(exported[0]))
        assert str(file) in done["skipped"]["AA39 history"]
        assert not told(other)["surfaces"]


def test_history_that_contradicts_itself_is_refused(exported: tuple[Path, dict[str, Any]], other: Runtime):
    file = exported[0] / "history" / "heliostats" / "AA39" / "history.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document | {"surfaces": document["surfaces"] * 2}))
    done = import_folder(other, read_folder(exported[0]))
    assert "contradicts itself" in done["skipped"]["AA39 history"]
    file.write_text(json.dumps(document | {"surfaces": document["surfaces"][1:]}))
    done = import_folder(other, read_folder(exported[0]))
    assert "a decision is of version 1" in done["skipped"]["AA39 history"]
    assert not told(other)["surfaces"]


def test_images_are_those_that_came(exported: tuple[Path, dict[str, Any]]):
    folder = exported[0] / "AA39" / "Calibration"
    assert (folder / "1-flux.png").read_bytes() == png(1)
    assert (folder / "3-raw.jpg").read_bytes() == jpeg(4)


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
    assert (told["heliotwin:sun_azimuth_deg"], told["heliotwin:sun_elevation_deg"]) == (-31.5, 45.0)


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
