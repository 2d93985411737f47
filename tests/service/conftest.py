"""A service on SQLite or PostgreSQL with a stand-in for the model, and small makers of what it
takes.
"""

import json
import os
import random
import shutil
import socket
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psycopg
import pytest
import uvicorn
from fastapi import FastAPI
from sqlalchemy import URL, make_url

from model.errors import UnreachableError
from model.fleet import FleetFlux, Losses, Superposition
from model.frames import wgs84_to_enu
from model.imaging import MeasuredFlux, Quality
from model.mount import Mount
from model.observation import Observation, SurfacePrediction
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.surface import control_points
from service.base.settings import Settings
from service.sources.paint_documents import azimuth_from_north
from service.store.columns import Base
from service.store.database import Database
from service.twin.operations import Forecast
from service.web.app import create_app
from tests.conftest import made_once
from tests.waiting import WAIT_LIMIT_S, until

with warnings.catch_warnings():
    # Starlette's client prefers the successor of httpx, which the environment does not hold.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient

POSTGRES = os.environ.get(
    "HELIOTWIN_TEST_POSTGRES", "postgresql://postgres@127.0.0.1:5432/postgres"
)
# No workers beside the test, and no bound on how fast it asks.
QUIET: dict[str, Any] = {"job_workers": 0} | {
    f"{whose}requests_{what}": 10**6 for whose in ("", "public_") for what in ("per_s", "burst")
}
ORIGIN = (50.913421122592574, 6.387824755874856, 87.0)


def free_port() -> int:
    """A port to listen on, below those that the system gives to outgoing connections at
    any moment.
    """
    while True:
        port = random.randint(20_000, 30_000)
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return port


@contextmanager
def serving(app: FastAPI, port: int | None = None, **options: Any) -> Iterator[str]:
    """The service behind a real socket; yields its address."""
    config = uvicorn.Config(app, host="127.0.0.1", port=port or 0, log_config=None, **options)
    with listening(config, app) as address:
        yield address


@contextmanager
def listening(config: uvicorn.Config, app: FastAPI) -> Iterator[str]:
    """The same with a server that is configured already."""
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        until(lambda: server.started or not thread.is_alive(), "the service listens")
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        app.state.stopping.set()
        server.should_exit = True
        thread.join(WAIT_LIMIT_S)
    assert not thread.is_alive()


# --- databases
# --------------------------------------------------------------------------------------------------


@contextmanager
def _postgres_database() -> Iterator[URL]:
    """A separate database on the PostgreSQL server, dropped at the end."""
    server = make_url(POSTGRES).set(drivername="postgresql")
    address = server.render_as_string(hide_password=False)
    name = f"heliotwin_test_{uuid.uuid4().hex[:12]}"
    try:
        with psycopg.connect(address, autocommit=True, connect_timeout=60) as connection:
            connection.execute(f'CREATE DATABASE "{name}"')
    except psycopg.OperationalError as error:
        pytest.skip(f"no PostgreSQL server at {server}: {str(error).splitlines()[0]}")
    yield server.set(drivername="postgresql+psycopg", database=name)
    with psycopg.connect(address, autocommit=True) as connection:
        connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)')


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[URL]:
    """A database with or without a schema, whose tables are empty."""
    with _postgres_database() as url:
        yield url


@pytest.fixture(scope="session")
def unmigrated_postgres_url() -> Iterator[URL]:
    """A second database, for tests of the migrations."""
    with _postgres_database() as url:
        yield url


def _empty_postgres(url: URL) -> None:
    database = Database(url)
    with database.writing() as session:
        for table in reversed(Base.metadata.sorted_tables):
            session.execute(table.delete())  # on a few rows much faster than TRUNCATE
    database.close()


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def empty_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[URL]:
    """A database without a schema, on each of the two engines."""
    if request.param == "sqlite":
        file = tmp_path / "store.sqlite"
        file.touch()
        yield URL.create("sqlite", database=str(file))
        return
    url: URL = request.getfixturevalue("unmigrated_postgres_url")
    address = url.set(drivername="postgresql").render_as_string(hide_password=False)
    with psycopg.connect(address, autocommit=True) as connection:
        connection.execute("DROP SCHEMA public CASCADE")  # what another test left
        connection.execute("CREATE SCHEMA public")
    yield url


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[URL]:
    """An empty store at the newest schema, on each of the two engines."""
    if request.param == "sqlite":
        url = URL.create("sqlite", database=str(tmp_path / "store.sqlite"))
    else:
        url = request.getfixturevalue("postgres_url")
    database = Database(url)
    database.upgrade()
    database.close()
    yield url
    if request.param == "postgres":
        _empty_postgres(url)


@pytest.fixture
def database(store_url: URL) -> Iterator[Database]:
    opened = Database(store_url)
    yield opened
    opened.close()


# --- the model's stand-in
# ---------------------------------------------------------------------------------------------


@dataclass
class FakeOperations:
    """Answers like `service.twin.operations` at no cost, and remembers what it was asked.

    An image whose first pixel is 0 is refused; a forecast that aims below the ground is out of
    reach. Surfaces forecast every photograph exactly, the ideal mirror a little worse.
    """

    predictions: list[list[Observation]] = field(default_factory=list)
    models: list[PlantModel] = field(default_factory=list)
    forecasts: list[dict[str, Any]] = field(default_factory=list)
    fleets: list[dict[str, Any]] = field(default_factory=list)
    mounts: dict[str, Mount] = field(default_factory=dict)
    measured: int = 0
    rendered: int = 0

    def measure(
        self, image: Any, kind: str, plane: TargetPlane, *, corners: Any = None, camera: Any = None
    ) -> MeasuredFlux:
        self.measured += 1
        if np.ravel(image)[0] == 0:
            return MeasuredFlux(
                Quality(accepted=False, reason="no_spot", detail="no spot was found")
            )
        flux = np.full((256, 256), 100 / 256**2, dtype=np.float32)
        centered = np.full((64, 64), 100 / 64**2, dtype=np.float32)
        if kind == "flux-centered":
            return MeasuredFlux(Quality(accepted=True), centered=centered)
        return MeasuredFlux(Quality(accepted=True), flux, centered, np.array([0.5, -0.25]))

    def has_network(self, heliostat: Heliostat) -> bool:
        return len(heliostat.facets) == 4

    def predict(
        self,
        heliostat: Heliostat,
        observations: list[Observation],
        model: PlantModel,
        method: str = "network",
        progress: Any = None,
    ) -> SurfacePrediction:
        self.models.append(model)
        self.predictions.append(list(observations))
        self.mounts["predict"] = heliostat.mount
        z = np.linspace(-1e-3, 1e-3, 256).reshape(4, 8, 8)
        return SurfacePrediction(
            z=z,
            z_std=np.full_like(z, 1e-4),
            control_points=np.stack([z, z, z], axis=-1),
            method=method,
            weights="fake-000000000000",
            misfits=(0.05,) * len(observations),
            used=tuple(observation.identifier for observation in observations),
        )

    def render(
        self, heliostat: Heliostat, observations: list[Observation], z: Any, model: PlantModel
    ) -> Any:
        self.rendered += 1
        self.mounts["render"] = heliostat.mount
        right = np.stack([observation.flux for observation in observations])
        if z is not None:
            return right
        wrong = np.zeros_like(right)
        wrong[:, 0, 0] = 100
        return 0.9 * right + 0.1 * wrong

    def forecast(
        self,
        setup: Setup,
        model: PlantModel,
        resolution: tuple[int, int],
        window: float | None = None,
    ) -> Forecast:
        heliostat = setup.heliostat
        asked = vars(setup) | {
            "heliostat": heliostat.name,
            "mount": heliostat.mount,
            "model": model,
        }
        is_ideal = np.array_equal(setup.control_points, control_points(heliostat))
        self.forecasts.append(
            asked | {"is_ideal": is_ideal, "resolution": resolution, "window": window}
        )
        if setup.aim is not None and setup.aim[2] < 0:
            raise UnreachableError("the aim point lies behind the mirror")
        flux = np.full(resolution, 2.0, dtype=np.float32)
        center = np.array([0.1, 0.2])
        return Forecast(
            flux=flux,
            center_of_mass=center,
            peak=2.0,
            power=50.0,
            losses=Losses(30.0, 0.9, 1.0, 1.0, 0.9, 1.0, 0.95, 0.8, 1.0),
            camera_view=flux,
            model_version="fake",
        )

    def superpose(
        self,
        task: Superposition,
        parts: Any,
        engine: Any = None,
        before: Any = None,
        done: Any = lambda _: None,
    ) -> FleetFlux:
        asked: list[Any] = []
        self.fleets.append(
            {"receiver": task.receiver, "resolution": task.resolution, "tiles": asked}
        )
        made = before or FleetFlux(np.zeros(task.resolution))
        for tile in parts:
            asked.append(tile)
            count = len(tile)
            losses = {
                setup.heliostat.name: Losses(8.0, 0.75, *[1.0] * 6, task.receiver.absorptance)
                for setup in tile.setups
            }
            light = np.full(task.resolution, 2.0 * count)
            made += FleetFlux(light, 60.0 * count, count, losses=losses)
            done(made)
        return made


class ChangingOperations(FakeOperations):
    """Surfaces forecast photographs exactly, but for a misplaced share of the light."""

    def misplaced(self, heliostat: Heliostat, taken_at: datetime, model: PlantModel) -> float:
        """Share [1] that a forecast puts into its first pixel; half of the lost accuracy."""
        raise NotImplementedError

    def render(
        self, heliostat: Heliostat, observations: list[Observation], z: Any, model: PlantModel
    ) -> Any:
        right = super().render(heliostat, observations, z, model)
        for image, one in zip(right, observations, strict=True):
            assert one.taken_at is not None
            share = self.misplaced(heliostat, one.taken_at, model)
            image *= 1 - share
            image[0, 0] += 100 * share
        return right


@pytest.fixture
def operations() -> FakeOperations:
    return FakeOperations()


# --- the service
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        data_dir=tmp_path / "data", max_image_bytes=200_000, max_image_pixels=500_000, **QUIET
    )


def client_of(app: FastAPI) -> TestClient:
    """A client that sees a failure as the caller would, instead of its exception."""
    return TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False)


@pytest.fixture
def app(settings: Settings, operations: FakeOperations) -> FastAPI:
    return create_app(settings, operations)


@pytest.fixture
def bare(app: FastAPI) -> Iterator[TestClient]:
    """A service with an empty store."""
    with client_of(app) as client:
        yield client


@pytest.fixture(scope="session")
def known_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data of a service that knows the tower and the heliostat AA39; copy it."""

    def fill(root: Path) -> None:
        with client_of(create_app(Settings(data_dir=root, **QUIET), FakeOperations())) as client:
            _tell(client)

    return made_once(tmp_path_factory, "known-store", fill)


def _tell(client: TestClient) -> None:
    assert client.put("/v1/plant", json=tower_document()).status_code == 200
    known = client.put("/v1/heliostats/AA39", json=properties_document())
    assert known.status_code == 201


@pytest.fixture
def client(settings: Settings, app: FastAPI, known_store: Path) -> Iterator[TestClient]:
    """A service that knows a tower with two targets, and the heliostat AA39."""
    shutil.copytree(known_store, settings.data_dir, dirs_exist_ok=True)
    with client_of(app) as client:
        if settings.database_url:  # of another file, or of PostgreSQL
            _tell(client)
        yield client


@pytest.fixture(scope="session")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service for requests that must be refused: shared, because they change nothing; checked at
    the end.
    """
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("refusing"),
        max_image_bytes=200_000,
        max_image_pixels=500_000,
        **QUIET,
    )
    with client_of(create_app(settings, FakeOperations())) as client:
        _tell(client)

        def state() -> list[str]:
            paths = (
                "plant",
                "targets",
                "heliostats",
                "heliostats/AA39",
                "heliostats/AA39/measurements",
                "forecasts",
            )
            return [client.get(f"/v1/{path}").text for path in paths]

        before = state()
        yield client
        assert state() == before
        assert not [path for path in (settings.data_dir / "images").rglob("*") if path.is_file()]


# --- things to send
# --------------------------------------------------------------------------------------------------


def _target(altitude: float) -> dict[str, Any]:
    east, west, north = 6.387885982262168, 6.387763286988281, 50.913392
    return {
        "type": "planar",
        "normal_vector": [0, 1, 0],
        "coordinates": {
            "center": [north, (east + west) / 2, altitude],
            "upper_left": [north, east, altitude + 3.5],
            "upper_right": [north, west, altitude + 3.5],
            "lower_left": [north, east, altitude - 3.5],
            "lower_right": [north, west, altitude - 3.5],
        },
    }


def tower_document() -> dict[str, Any]:
    return {
        "power_plant_properties": {"ID": "WRI1030197", "coordinates": list(ORIGIN)},
        "lower": _target(122.9),
        "upper": _target(130.1),
        "receiver": {"type": "convex_cylinder", "radius": 4.14},
    }


def _actuator(clockwise: int, initial_angle: float) -> dict[str, Any]:
    return {
        "type_axis": "linear",
        "min_increment": 0,
        "max_increment": 70000,
        "increment": 154166.6667,
        "initial_stroke_length": 0.0775,
        "offset": 0.338,
        "pivot_radius": 0.325,
        "clockwise_axis_movement": clockwise,
        "initial_angle": initial_angle,
    }


def _facet(x: float, y: float) -> dict[str, Any]:
    return {
        "translation_vector": [x, y, 0.04],
        "canting_e": [0.8025, 0.0, 0.0],
        "canting_n": [0.0, 0.6375, 0.0],
    }


@pytest.fixture
def tower() -> dict[str, Any]:
    """PAINT's tower measurements."""
    return tower_document()


def properties_document() -> dict[str, Any]:
    translations = {f"joint_translation_{axis}_{stage}": 0.0 for axis in "enu" for stage in (1, 2)}
    return {
        "heliostat_position": [50.913643297719794, 6.3880132701249455, 88.68894196],
        "height": 2.56,
        "width": 3.22,
        "kinematics_properties": {
            "actuators": [_actuator(0, 0.039), _actuator(1, 0.944)],
            **translations,
            "concentrator_translation_n": 0.175,
        },
        "facet_properties": {
            "number_of_facets": 4,
            "facets": [
                _facet(-0.8, 0.64),
                _facet(0.8, 0.64),
                _facet(-0.8, -0.64),
                _facet(0.8, -0.64),
            ],
        },
        "renovation": "2021-04-15",
    }


@pytest.fixture
def properties() -> dict[str, Any]:
    """PAINT's heliostat properties."""
    return properties_document()


def png(seed: int = 1, size: tuple[int, int] = (32, 32), refused: bool = False) -> bytes:
    """A small image; another for every seed."""
    pixels = np.random.default_rng(seed).integers(1, 255, size, dtype=np.uint8)
    pixels[0, 0] = 0 if refused else 200
    return cv2.imencode(".png", pixels)[1].tobytes()


def sun_at(azimuth_deg: Any = 160.0, elevation_deg: Any = 45.0) -> dict[str, Any]:
    """A sun position as JSON."""
    return {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}


def spot_of(latitude_deg: float, longitude_deg: float, altitude_m: float) -> list[float]:
    """A place in the plant's frame: east, north, up [m], to a micrometre."""
    spot: list[float] = (
        wgs84_to_enu((latitude_deg, longitude_deg, altitude_m), ORIGIN).round(6).tolist()
    )
    return spot


def metadata(**changes: Any) -> dict[str, Any]:
    """What goes with an image."""
    return {"kind": "flux", "target": "lower", "sun": sun_at(160.0), **changes}


def paint_measurement() -> dict[str, Any]:
    """The same as PAINT's ``calibration-properties.json``."""
    return {"target_name": "lower", "sun_azimuth": 20.0, "sun_elevation": 45.0}


def metadata_of(paint: dict[str, Any]) -> dict[str, Any]:
    """Metadata of REST, without an image's, of PAINT's ``calibration-properties.json``."""
    azimuth_deg = azimuth_from_north(paint["sun_azimuth"])
    return {"target": paint["target_name"], "sun": sun_at(azimuth_deg, paint["sun_elevation"])}


Post = Callable[..., Any]


def poster(client: TestClient) -> Post:
    def send(
        image: bytes | None = None, heliostat: str = "AA39", raw: str | None = None, **changes: Any
    ) -> Any:
        document = json.dumps(metadata(**changes)) if raw is None else raw
        return client.post(
            f"/v1/heliostats/{heliostat}/measurements",
            files={"image": ("spot.png", png() if image is None else image, "image/png")},
            data={"metadata": document},
        )

    return send


@pytest.fixture
def post(client: TestClient) -> Post:
    """Posts an image of AA39 with its metadata."""
    return poster(client)


@pytest.fixture
def refused_post(refusing: TestClient) -> Post:
    """The same to a service that must refuse it."""
    return poster(refusing)


# --- what the product made of real photographs
# ------------------------------------------------------------------------


@pytest.fixture(scope="session")
def real_store(stj: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a store that the product filled (`tests.service.real.fill`); read it only."""
    from tests.service import real  # it needs this module

    return made_once(tmp_path_factory, "real-store", lambda folder: real.fill(stj, folder))


@pytest.fixture
def real_copy(real_store: Path, tmp_path: Path) -> Path:
    """A copy of it, which a test may change."""
    return Path(shutil.copytree(real_store, tmp_path / "real"))


@pytest.fixture
def real_client(real_copy: Path) -> Iterator[TestClient]:
    """The service, with the real model, on that copy; it works at no job by itself."""
    from tests.service import real  # it needs this module

    with real.client_on(real_copy) as client:
        yield client
