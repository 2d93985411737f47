"""The store as a measurement folder: a round trip through it loses nothing that cannot be made
again.
"""

import json
import shutil
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
from model.pointing.kinematics import NAMES
from model.surface import control_points
from service import store
from service.base.arrays import pack
from service.base.fields import Sun
from service.base.settings import Settings
from service.sources.folder import read_folder, read_surface
from service.sources.photograph import IncomingPhotograph
from service.store.mounts import add_mount
from service.store.surface_versions import NewSurface
from service.twin import model_versions
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.measurements import load_heliostat_context
from service.twin.photographs.ingest import ingest
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.conftest import made_once
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    spot_of,
    sun_at,
    tower_document,
)
from tests.service.exported import require_same
from tests.service.exported import rows_of as exported_rows
from tests.service.studies import SLOPE, study_row

RECEIVER = {
    "center": [0, -3, 55.2],
    "normal": [0, 1, 0],
    "radius": 4.1,
    "height": 5.2,
    "opening_deg": 60,
}


def jpeg(seed: int) -> bytes:
    pixels = np.random.default_rng(seed).integers(1, 255, (40, 50, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def mount_document(moment: str) -> dict[str, Any]:
    """Output of `heliotwin calibrate` for a mount that one photograph left at its prior."""
    zeros = [0.0, 0.0]
    return {
        "valid_from": moment,
        "sun": [],
        "measurements": 1,
        "predicted_error_mrad": {"median": None, "ci90": None, "measurements": 0},
        "parameters": {
            name: {"value": 0.0, "std": 0.01, "prior_std": 0.01, "unit": "rad"} for name in NAMES
        },
        "steps": [],
        "drift": {"zeros_mrad": zeros, "std_mrad": [0.1, 0.1], "is_sure": False},
        "outliers": {},
        "covariance": np.diag([1e-4] * len(NAMES)).tolist(),
        "history": {"at": [moment], "foreign": [], "predicted": [None]}
        | {name: [zeros] for name in ("drift", "jitter", "stepped", "residuals")},
    }


def fill(client: TestClient, tower: dict[str, Any]) -> None:
    """Photographs with all that is known of them, a measured surface and a predicted one, a
    receiver, a model.
    """
    send, spot = poster(client), spot_of(50.9136, 6.3879, 123.0)
    known = {
        "taken_at": "2024-06-03T11:30:00Z",
        "motor_position": [31234.0, 45012.5],
        "focal_spot_m": spot,
        "helios_spot_m": spot_of(50.9137, 6.3878, 123.5),
    }
    known |= {"wind_speed_m_s": 3.5, "wind_from_deg": 210.0, "temperature_c": -2.25}
    send(png(1), id="1", **known)
    send(png(1), id="one", **known)  # sent again under another id
    send(png(2), id="1", kind="cropped", **known)
    send(png(3, refused=True), id="2", sun=sun_at(213.25))
    send(
        jpeg(4),
        id="3",
        kind="raw",
        target="upper",
        taken_at="2024-06-04T09:00:00.25Z",
        helios_spot_m=spot,
    )
    send(png(5))
    send(png(6), id="bad")
    client.patch(
        "/v1/heliostats/AA39/measurements/bad", json={"excluded": True, "reason": "a bird"}
    )
    assert client.put("/v1/receivers/drum", json=RECEIVER).status_code in (200, 201)
    declared = {
        "sun": {"shape": "pillbox", "half_angle_mrad": 4.65},
        "cameras": [{"transfer": {"gamma": 2.0}}],
    }
    assert (
        client.put("/v1/plant?reason=surveyed", json=tower | {"declared": declared}).status_code
        == 200
    )
    assert (
        client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["1"]}).status_code == 201
    )
    with client.app.state.runtime.database.writing() as session:  # type: ignore[attr-defined]
        z = np.random.default_rng(1).normal(0, 3e-4, (4, 8, 8))
        z -= z.mean(axis=(1, 2), keepdims=True)
        row = store.get_heliostat(session, "AA39")
        points = measured_points(client, z)
        store.add_surface(session, row, NewSurface("measured", z, 0 * z, points), once=True)
        number = store.add_study(session, study_row(SLOPE, model=2)).id
        model_versions.adopt(session, number, "tester")
    assert (
        client.put(
            "/v1/heliostats/AA39/surfaces/current", json={"version": 1, "reason": "new"}
        ).status_code
        == 200
    )
    clock = {"sun": sun_at(211.5), "reason": "clock"}
    assert client.patch("/v1/heliostats/AA39/measurements/2", json=clock).status_code == 200
    with client.app.state.runtime.database.writing() as session:  # type: ignore[attr-defined]
        row = store.get_heliostat(session, "AA39")
        add_mount(session, row, mount_document("2024-06-03T11:30:00+00:00"))
        store.get_measurement(session, row, "1").forecast_accuracy = 0.875


@pytest.fixture(scope="session")
def filled_store(known_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data of a service that knows all that an export holds; copy it."""

    def make(root: Path) -> None:
        shutil.copytree(known_store, root, dirs_exist_ok=True)
        with client_of(create_app(Settings(data_dir=root, **QUIET), FakeOperations())) as client:
            fill(client, tower_document())

    return made_once(tmp_path_factory, "filled-store", make)


@pytest.fixture
def filled(settings: Settings, app: FastAPI, filled_store: Path) -> Iterator[TestClient]:
    shutil.copytree(filled_store, settings.data_dir, dirs_exist_ok=True)
    with client_of(app) as client:
        yield client


def measured_points(client: TestClient, z: Any) -> Any:
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        return control_points(load_heliostat_context(session, "AA39").heliostat, z)


@pytest.fixture
def exported(filled: TestClient, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    app: FastAPI = filled.app  # type: ignore[assignment]
    return tmp_path / "out", export_folder(app.state.runtime, tmp_path / "out")


@pytest.fixture
def other(tmp_path: Path) -> Iterator[Runtime]:
    """An empty store."""
    runtime = Runtime.from_settings(
        Settings(data_dir=tmp_path / "other", **QUIET), FakeOperations()
    )
    runtime.database.upgrade()
    yield runtime
    runtime.close()


def test_round_trip_loses_nothing(
    filled: TestClient, exported: tuple[Path, dict[str, Any]], other: Runtime
):
    folder, report = exported
    assert report["skipped"] == {}
    done = import_folder(
        other, read_folder(folder), actor="cli tester"
    )  # who sent each photograph is kept
    assert done["skipped"] == {}
    app: FastAPI = filled.app  # type: ignore[assignment]
    before = exported_rows(app.state.runtime)
    assert {name: len(rows) for name, rows in before.items()} == {
        "plant": 1,
        "heliostats": 1,
        "targets": 2,
        "receivers": 1,
        "images": 6,
        "measurements": 6,
        "measurement_aliases": 1,
        "corrections": 3,
        "surfaces": 2,
        "surface_decisions": 1,
        "mounts": 1,
        "studies": 1,
        "models": 2,
        "surface_measurements": 1,
        "drift": 0,
    }
    require_same(app.state.runtime, other)


def test_forced_and_deleted_photographs_go_through_an_export(
    client: TestClient, properties: dict[str, Any], other: Runtime, tmp_path: Path
):
    """Two heliostats with one image stay so; a deleted photograph is in no export; one of before
    brings it back.
    """
    app: FastAPI = client.app  # type: ignore[assignment]
    runtime, send = app.state.runtime, poster(client)
    client.put("/v1/heliostats/AA01", json=properties)  # before AA39 in every order
    send(png(1), id="1")
    send(png(1), id="1", heliostat="AA01", force=True, reason="a photograph of both")
    send(png(2), id="2", sun=sun_at(210.0))
    assert (
        client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["1", "2"]}).status_code
        == 201
    )
    export_folder(runtime, tmp_path / "before")
    client.delete("/v1/heliostats/AA39/measurements/2", params={"reason": "of another heliostat"})
    export_folder(runtime, tmp_path / "after")
    done = import_folder(other, read_folder(tmp_path / "after"))
    assert done["skipped"] == {}
    assert done["counts"]["images new"] == 2
    with other.database.reading() as session:
        forced = store.get_measurement(session, store.get_heliostat(session, "AA01"), "1")
        surface = store.get_surface(session, store.get_heliostat(session, "AA39"), 1)
    assert (forced.forced, surface.deleted) == ("a photograph of both", ["2"])
    assert [row.identifier for row in surface.measurements] == ["1"]
    again = import_folder(runtime, read_folder(tmp_path / "before"))
    assert again["counts"]["images new"] == 1
    assert again["skipped"]["AA39 history"].startswith("the store has other surfaces or mounts")
    assert client.get("/v1/heliostats/AA39/measurements/2").status_code == 200
    assert client.get("/v1/heliostats/AA39/surfaces/1").json()["deleted"] == ["2"]


def test_import_skips_an_image_that_another_heliostat_has_and_goes_on(
    client: TestClient, properties: dict[str, Any], tmp_path: Path
):
    app: FastAPI = client.app  # type: ignore[assignment]
    runtime, send = app.state.runtime, poster(client)
    send(png(1), id="1")
    send(png(2), id="2", sun=sun_at(210.0))
    export_folder(runtime, tmp_path / "out")
    client.delete("/v1/heliostats/AA39/measurements/1", params={"reason": "of AA01"})
    client.put("/v1/heliostats/AA01", json=properties)
    send(png(1), id="1", heliostat="AA01")
    client.delete("/v1/heliostats/AA39/measurements/2", params={"reason": "to see it come back"})
    done = import_folder(runtime, read_folder(tmp_path / "out"))
    assert done["skipped"]["AA39/1 flux"].startswith("image: heliostat AA01 has it already")
    assert done["counts"]["images new"] == 1


def test_second_import_changes_nothing(exported: tuple[Path, dict[str, Any]], other: Runtime):
    import_folder(other, read_folder(exported[0]))
    before = exported_rows(other)
    done = import_folder(other, read_folder(exported[0]))
    assert done["counts"]["histories unchanged"] == 2
    assert not [name for name in done["counts"] if name.endswith(" new")]
    assert exported_rows(other) == before


def test_photograph_that_is_sent_again_is_known(
    exported: tuple[Path, dict[str, Any]], other: Runtime
):
    import_folder(other, read_folder(exported[0]))
    photograph = IncomingPhotograph(
        "upper", "raw", Sun(**sun_at()), "3", datetime(2024, 6, 4, 9, 0, 0, 250000, tzinfo=UTC)
    )
    row, is_new = ingest(other, "AA39", photograph, jpeg(4))
    assert (row.identifier, is_new) == ("3", False)


def test_excluded_photograph_is_used_by_nobody(
    exported: tuple[Path, dict[str, Any]], other: Runtime
):
    folder = read_folder(exported[0])
    assert "bad" not in {measurement.external_id for measurement in folder.measurements("AA39")}
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
    assert done["skipped"]["AA39 history"].startswith("the store has other surfaces or mounts")
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


def test_wrong_arrays_are_named_and_nothing_is_half_restored(
    exported: tuple[Path, dict[str, Any]], other: Runtime
):
    file = exported[0] / "history" / "heliostats" / "AA39" / "surface-2.npz"
    for content in (b"nothing", pack({"z": np.zeros((4, 8, 8))})):
        file.write_bytes(content)
        done = import_folder(other, read_folder(exported[0]))
        assert str(file) in done["skipped"]["AA39 history"]
        assert not exported_rows(other)["surfaces"]


def test_history_that_contradicts_itself_is_refused(
    exported: tuple[Path, dict[str, Any]], other: Runtime
):
    file = exported[0] / "history" / "heliostats" / "AA39" / "history.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document | {"surfaces": document["surfaces"] * 2}))
    done = import_folder(other, read_folder(exported[0]))
    assert "contradicts itself" in done["skipped"]["AA39 history"]
    file.write_text(json.dumps(document | {"surfaces": document["surfaces"][1:]}))
    done = import_folder(other, read_folder(exported[0]))
    assert "a decision is of version 1" in done["skipped"]["AA39 history"]
    assert not exported_rows(other)["surfaces"]


def _model(document: dict[str, Any]) -> None:
    document["models"][0]["effects"] = [{"name": "nothing", "parameters": {}}]


def _declared(document: dict[str, Any]) -> None:
    document["declared"] = {"sun": {"shape": "square"}}


def _found(document: dict[str, Any]) -> None:
    document["studies"][0]["report"]["effects"] = [{"name": "nothing", "parameters": {}}]


def _verdict(document: dict[str, Any]) -> None:
    document["studies"][0]["verdict"] = "perhaps"


@pytest.mark.full
@pytest.mark.parametrize("spoil", [_model, _declared, _found, _verdict])
def test_a_model_that_could_not_be_computed_with_is_not_brought_back(
    exported: tuple[Path, dict[str, Any]], other: Runtime, spoil: Callable[[dict[str, Any]], None]
):
    file = exported[0] / "history" / "plant.json"
    document = json.loads(file.read_text())
    spoil(document)
    file.write_text(json.dumps(document))
    done = import_folder(other, read_folder(exported[0]))
    assert str(file) in done["skipped"]["plant history"]
    assert done["counts"]["heliostats new"] == 1
    assert not exported_rows(other)["models"]
    with other.database.reading() as session:
        assert model_versions.get_model(session).effects == ()


def _drift(document: dict[str, Any]) -> None:
    del document["mounts"][0]["document"]["drift"]


def _moments(document: dict[str, Any]) -> None:
    document["mounts"][0]["document"]["history"]["at"] = []


def _correction(document: dict[str, Any]) -> None:
    corrections = [
        one for photograph in document["photographs"] for one in photograph["corrections"]
    ]
    corrections[0]["before"] = {}


def _elevation(document: dict[str, Any]) -> None:
    document["photographs"][0]["sun"]["elevation_deg"] = 500.0


def _year(document: dict[str, Any]) -> None:
    document["surfaces"][0]["valid_from"] = "9999-12-31T23:59:59-12:00"


def _number(document: dict[str, Any]) -> None:
    document["surfaces"][0]["version"] = 2**70


def _corners(document: dict[str, Any]) -> None:
    document["photographs"][0]["corners_px"] = {}


@pytest.mark.parametrize(
    "spoil", [_drift, _moments, _correction, _elevation, _year, _number, _corners]
)
def test_a_history_that_no_page_could_show_is_not_brought_back(
    exported: tuple[Path, dict[str, Any]], other: Runtime, spoil: Callable[[dict[str, Any]], None]
):
    file = exported[0] / "history" / "heliostats" / "AA39" / "history.json"
    document = json.loads(file.read_text())
    spoil(document)
    file.write_text(json.dumps(document))
    done = import_folder(other, read_folder(exported[0]))
    assert str(file) in done["skipped"]["AA39 history"]
    assert done["counts"]["heliostats new"] == 1
    assert not exported_rows(other)["mounts"]


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
        schema = schemas[
            f"https://schemas.stacspec.org/{version}/{kind}-spec/json-schema/{kind}.json"
        ]
        return Draft7Validator(
            schema, registry=registry, format_checker=Draft7Validator.FORMAT_CHECKER
        )

    return of


def items_of(folder: Path) -> dict[str, dict[str, Any]]:
    """The items that the catalogue links to, by their paths."""
    links = json.loads((folder / "catalog.json").read_text())["links"]
    return {
        link["href"]: json.loads((folder / link["href"]).read_text())
        for link in links
        if link["rel"] == "item"
    }


def test_catalogue_and_items_are_stac(
    exported: tuple[Path, dict[str, Any]], stac: Callable[[str], Validator]
):
    folder, report = exported
    stac("catalog").validate(json.loads((folder / "catalog.json").read_text()))
    items = items_of(folder)
    assert (
        len(items) == report["counts"]["STAC items"] == 7
    )  # properties, two surfaces, four photographs
    assert len({item["id"] for item in items.values()}) == 7
    for path, item in items.items():
        stac("item").validate(item)
        beside = (folder / path).parent
        for place in [*item["assets"].values(), *item["links"]]:
            assert (beside / place["href"]).resolve().is_file()


def test_items_say_whose_they_are(exported: tuple[Path, dict[str, Any]]):
    item = items_of(exported[0])["./AA39/Calibration/2-calibration-item-stac.json"]["properties"]
    assert item["heliotwin:heliostat"] == "AA39"
    assert item["heliotwin:target"] == "lower"
    assert (item["heliotwin:sun_azimuth_deg"], item["heliotwin:sun_elevation_deg"]) == (211.5, 45.0)


def test_unknown_times_are_periods(exported: tuple[Path, dict[str, Any]]):
    items = items_of(exported[0])
    whens = {
        path: item["properties"]
        for path, item in items.items()
        if item["properties"]["datetime"] is None
    }
    measured = "./AA39/Deflectometry/AA39-surface-item-stac.json"
    assert {*whens} >= {measured, "./AA39/Calibration/2-calibration-item-stac.json"}
    for when in whens.values():  # before they came, and nothing else is sure
        first, last = (
            datetime.fromisoformat(when[name]) for name in ("start_datetime", "end_datetime")
        )
        assert first < datetime.now(UTC) - timedelta(days=365)
        assert datetime.now(UTC) - timedelta(hours=1) < last < datetime.now(UTC)


def test_folder_that_holds_something_is_left_alone(filled: TestClient, tmp_path: Path):
    (tmp_path / "mine").write_text("mine")
    app: FastAPI = filled.app  # type: ignore[assignment]
    with pytest.raises(InvalidInputError, match="not empty"):
        export_folder(app.state.runtime, tmp_path)
