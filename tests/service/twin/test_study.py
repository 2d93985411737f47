"""The closed loop on a stored plant: a study finds an effect, it is adopted, forecasts follow, it
is withdrawn.
"""

import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL, select

from heliotwin.demo.plant import ORIGIN, TARGET, properties
from model.effects.camera_response import CameraResponse
from model.forecast import View, align
from model.frames import sun_angles, sun_direction
from model.imaging.window import center_of_mass
from model.plant import Heliostat, Plant
from model.plant_model import JUELICH_MODEL
from model.setup import Setup
from model.site import JUELICH
from model.surface import control_points
from service import store
from service.base.arrays import pack, unpack
from service.base.settings import Settings
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.store.database import Database
from service.store.image_files import ImageStore
from service.store.surface_versions import NewSurface
from service.store.tables import ImageRow, MeasurementRow, SurfaceRow
from service.twin.runtime import Operations, Runtime
from service.twin.slots import ComputeSlots
from service.twin.studies.study import StudyIn, extent_of, load_study_inputs, study_store
from service.web.app import create_app
from tests.service.conftest import QUIET, client_of, until
from tests.service.twin.fields import heights
from tests.waiting import WAIT_LIMIT_S

GAMMA = 0.6
FIELD = {"AB12": (-44.0, 62.0, 1.7), "AK08": (-32.0, 138.0, 1.8)}
IMAGES = 6
BEGIN = datetime(2024, 6, 1, tzinfo=UTC)
FORECAST = {
    "heliostat": "AB12",
    "target": TARGET.name,
    "sun": {"azimuth_deg": 200.0, "elevation_deg": 45.0},
    "resolution": 32,
    "surface": 1,
}


def photographs(
    mirror: Heliostat, z: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Suns (IMAGES, 3) and 8-bit images of the whole target by a camera with a gamma that nobody
    declared.
    """
    suns = sun_direction(180 - np.linspace(-60, 60, IMAGES), np.linspace(25, 60, IMAGES))
    points = control_points(mirror, z)
    shots = [
        Setup(mirror, points, sun, TARGET, spot=TARGET.to_enu(rng.uniform(-0.4, 0.4, 2)))
        for sun in suns
    ]
    images = (
        align(shots, JUELICH_MODEL.with_effects([CameraResponse(gamma=GAMMA)]))
        .images(View(128, 128))
        .numpy()
    )
    counts = 240 * images / images.max(axis=(1, 2), keepdims=True) + rng.normal(
        0, 0.5, images.shape
    )
    return suns, np.clip(np.round(counts), 0, 255)


def fill(database: Database) -> None:
    """The plant: two heliostats with measured surfaces and their photographs, one a day."""
    rng = np.random.default_rng(7)
    plant = Plant("demo", ORIGIN)
    with database.writing() as session:
        store.put_plant(session, "demo", ORIGIN)
        target = store.put_target(session, TARGET)[0]
        for name, position in FIELD.items():
            mirror = Heliostat.juelich(
                name, position, float(np.linalg.norm(position - TARGET.center))
            )
            row = store.put_heliostat(session, name, properties(mirror, plant), position)[0]
            z = heights(rng)
            surface = NewSurface(
                "measured", z, np.zeros_like(z), control_points(mirror, z), valid_from=BEGIN
            )
            store.add_surface(session, row, surface)
            for index, (sun, image) in enumerate(zip(*photographs(mirror, z, rng), strict=True)):
                store.add_measurement(
                    session, row, *measurement(target, f"{name}{index}", sun, image, index)
                )


def measurement(
    target: Any, number: str, sun: np.ndarray, image: np.ndarray, day: int
) -> tuple[ImageRow, MeasurementRow]:
    azimuth, elevation = sun_angles(sun)
    right, up = center_of_mass(image, (TARGET.width, TARGET.height)).tolist()
    arrays = {"flux": image.astype(np.float32), "centered": np.ones((64, 64), np.float32)}
    sha = f"{int.from_bytes(number.encode(), 'big'):064x}"
    return ImageRow(
        sha256=sha, media_type="image/png", size_bytes=10, width_px=128, height_px=128
    ), MeasurementRow(
        kind="flux",
        target_id=target.id,
        sun_azimuth_deg=float(azimuth),
        sun_elevation_deg=float(elevation),
        accepted=True,
        quality={"accepted": True},
        external_id=number,
        taken_at=BEGIN + timedelta(days=day),
        center_right_m=right,
        center_up_m=up,
        arrays=pack(arrays),
    )


# --- the loop, with the real model
# ------------------------------------------------------------------------------------


@pytest.fixture
def settings(store_url: URL, tmp_path: Path) -> Settings:
    url = store_url.render_as_string(hide_password=False).replace("+psycopg", "")
    return Settings(data_dir=tmp_path / "data", database_url=url, **QUIET)


@pytest.fixture
def looped(settings: Settings) -> Iterator[TestClient]:
    """A service with the real model on the stored plant."""
    app = create_app(settings)
    with client_of(app) as client:
        fill(app.state.runtime.database)
        yield client


def done(client: TestClient, path: str, **payload: Any) -> dict[str, Any]:
    """The result of a job, worked at here."""
    answer = client.post(path, json=payload)
    assert answer.status_code == 202, answer.text
    runtime: Runtime = cast(FastAPI, client.app).state.runtime
    assert Worker(runtime, KINDS, "tester", threading.Event()).work()
    job = client.get(answer.headers["Location"]).json()
    assert job["state"] == "done", job["reason"]
    return cast(dict[str, Any], job["result"])


def forecast(client: TestClient, **changes: Any) -> tuple[str, np.ndarray]:
    """Model version of a forecast, and what the camera shows of it."""
    answer = client.post("/v1/forecasts", json=FORECAST | changes)
    assert answer.status_code == 201, answer.text
    return answer.json()["model_version"], np.array(
        client.get(f"{answer.headers['Location']}?view=camera").json()["flux"]
    )


def test_effect_is_found_adopted_used_and_withdrawn(looped: TestClient):
    result = done(looped, "/v1/jobs/studies", candidates=["camera_response", "camera_blur"])
    assert result["verdict"] == "effect"
    path = f"/v1/studies/{result['study']}"
    study = looped.get(path).json()
    assert [effect["name"] for effect in study["effects"]] == ["camera_response"]
    assert study["effects"][0]["parameters"]["gamma"]["value"] == pytest.approx(GAMMA, abs=0.03)
    assert study["after"]["accuracy_mean"] > study["before"]["accuracy_mean"] + 0.1
    assert (study["heliostats"], study["model_version"], study["adopted"]) == (
        sorted(FIELD),
        1,
        None,
    )
    assert study["first_taken_at"].startswith("2024-06-01")
    assert set(study["before"]["per_image"]) <= {
        f"{name}/{name}{index}" for name in FIELD for index in range(IMAGES)
    }
    page = looped.get(f"{path}/report")
    assert "camera response" in page.text
    assert "script" not in page.headers["Content-Security-Policy"]

    version, declared = forecast(looped)
    assert version == 1
    adopted = looped.post(f"{path}/adopt")
    assert adopted.status_code == 201, adopted.text
    assert (adopted.json()["version"], adopted.json()["is_current"]) == (2, True)
    assert looped.get(path).json()["adopted"] == 2

    version, photographed = forecast(looped)
    assert version == 2
    assert photographed.sum() > 1.2 * declared.sum()  # a gamma below one lifts the faint parts
    version, earlier = forecast(looped, model_version=1)
    assert version == 1
    np.testing.assert_array_equal(earlier, declared)

    assert looped.post(f"{path}/withdraw").json()["version"] == 1
    version, again = forecast(looped)
    assert version == 1
    np.testing.assert_array_equal(again, declared)
    version, withdrawn = forecast(looped, model_version=2)
    assert version == 2
    np.testing.assert_array_equal(withdrawn, photographed)


@pytest.mark.full
def test_study_that_knows_the_effect_finds_no_more(looped: TestClient):
    candidates = ["camera_response", "camera_blur"]
    first = done(looped, "/v1/jobs/studies", candidates=candidates)["study"]
    looped.post(f"/v1/studies/{first}/adopt", json={})
    second = done(looped, "/v1/jobs/studies", candidates=candidates)
    assert second["verdict"] == "none"
    study = looped.get(f"/v1/studies/{second['study']}").json()
    assert study["model_version"] == 2
    assert study["before"]["accuracy_mean"] > 0.97
    assert "found no effect" in looped.post(f"/v1/studies/{second['study']}/adopt").json()["detail"]


# --- what a study takes out of the store
# ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    """The stored plant, to look at only."""
    database = Database(
        URL.create("sqlite", database=str(tmp_path_factory.mktemp("filled") / "store.sqlite"))
    )
    database.upgrade()
    fill(database)
    yield database
    database.close()


def test_photograph_shows_its_heliostat_with_the_stored_surface(filled: Database):
    with filled.reading() as session:
        material = load_study_inputs(session, StudyIn(heliostats=["AB12"]))
        row = store.get_surface(session, store.get_heliostat(session, "AB12"), 1)
    assert material.heliostats == ["AB12"]
    assert not material.skipped
    photograph = min(material.photographs, key=lambda p: p.key)
    assert photograph.key == "AB12/AB120"
    points = unpack(row.arrays)["control_points"]
    np.testing.assert_allclose(photograph.setup.control_points, points, atol=1e-9)
    center = center_of_mass(photograph.image, (TARGET.width, TARGET.height))
    np.testing.assert_allclose(photograph.setup.spot, TARGET.to_enu(center), atol=1e-6)


def test_study_lets_others_at_the_model_between_its_steps(filled: Database, tmp_path: Path):
    """A request that comes during the first step is done before the second begins, and the slot is
    free at the end.
    """
    order: list[str] = []

    def ask() -> None:
        with runtime.for_requests().computing("forecast"):
            order.append("a request")

    def study(photographs: Any, model: Any, options: Any, step: Any) -> None:
        request = threading.Thread(target=ask)
        step("one")
        request.start()
        until(lambda: len(runtime.compute_slots._queue) == 1)
        order.append("step one")
        step("two")
        order.append("step two")
        request.join(WAIT_LIMIT_S)

    operations = cast(Operations, SimpleNamespace(study=study))
    runtime = Runtime(
        Settings(data_dir=tmp_path),
        filled,
        ImageStore(tmp_path),
        operations,
        compute_slots=ComputeSlots(1),
    )
    study_store(runtime, StudyIn(surfaces="measured"))
    assert order == ["step one", "a request", "step two"]
    with runtime.compute_slots.slot(0.0):
        pass


def test_time_and_number_of_photographs_are_bounded(filled: Database):
    since, until = BEGIN + timedelta(days=1), BEGIN + timedelta(days=4)
    with filled.reading() as session:
        material = load_study_inputs(session, StudyIn(since=since, until=until))
        few = load_study_inputs(session, StudyIn(images=2, max_heliostats=1))
        none = load_study_inputs(session, StudyIn(until=BEGIN))
    assert sorted(p.key for p in material.photographs) == [
        f"{h}/{h}{day}" for h in sorted(FIELD) for day in (1, 2, 3)
    ]
    assert material.span == (since, until - timedelta(days=1))
    assert (len(few.photographs), len(few.heliostats)) == (2, 1)
    assert set(none.skipped) == set(FIELD)


def test_measured_surface_goes_before_a_newer_prediction(store_url: URL):
    database = Database(store_url)
    fill(database)
    with database.writing() as session:
        for name in FIELD:
            row = store.get_heliostat(session, name)
            flat = np.zeros((4, 8, 8))
            store.add_surface(
                session, row, NewSurface("network", flat, flat, np.zeros((4, 8, 8, 3)))
            )
        of_heliostat = select(SurfaceRow).where(SurfaceRow.heliostat_id == row.id)
        measured = session.scalars(of_heliostat.where(SurfaceRow.source == "measured")).first()
        assert measured is not None
        session.delete(measured)
    with database.reading() as session:
        both = load_study_inputs(session, StudyIn())
        only = load_study_inputs(session, StudyIn(surfaces="measured", heliostats=list(FIELD)))
    assert (both.heliostats, only.heliostats) == (["AB12", "AK08"], ["AB12"])
    assert "no measured surface" in only.skipped["AK08"]
    depth = {p.heliostat: np.ptp(p.setup.control_points[0, :, :, 2]) for p in both.photographs}
    flat_depth = np.ptp(control_points(both.photographs[-1].setup.heliostat)[0, :, :, 2])
    assert depth["AK08"] == pytest.approx(flat_depth)
    database.close()


def test_photograph_of_another_heliostat_is_left_out_by_name(store_url: URL):
    database = Database(store_url)
    fill(database)
    with database.writing() as session:
        (row,) = store.get_measurements(session, store.get_heliostat(session, "AB12"), ["AB121"])
        row.warnings = [{"type": "unlike_heliostat", "detail": "unlike AB12, like AK08"}]
    with database.reading() as session:
        material = load_study_inputs(session, StudyIn())
        extent = extent_of(session, StudyIn())
    assert material.skipped == extent.skipped == {"AB12/AB121": "unlike AB12, like AK08"}
    assert "AB12/AB121" not in {p.key for p in material.photographs}
    assert extent.n_photographs == len(material.photographs)
    database.close()


def test_photograph_that_cannot_have_been_is_left_out_by_name(filled: Database):
    with filled.reading() as session:
        material = load_study_inputs(session, StudyIn())
    whole, behind = material.photographs[0], material.photographs[1]
    shot = replace(behind.setup, plane=replace(TARGET, normal=-TARGET.normal))
    odd = replace(material, photographs=[whole, replace(behind, setup=shot)])
    left = odd.without_untraceable(JUELICH)
    assert [p.key for p in left.photographs] == [whole.key]
    assert set(left.skipped) == {behind.key}
    assert whole.taken_at is not None
    assert left.span == (whole.taken_at,) * 2


@pytest.mark.parametrize(
    ("up", "reason"), [(None, "no place on the target"), (9.0, "off its target"), (0.5, None)]
)
def test_centred_flux_needs_a_spot_on_its_target(
    database: Database, up: float | None, reason: str | None
):
    fill(database)
    spot = (
        None
        if up is None
        else tuple(float(v) for v in Plant("demo", ORIGIN).to_wgs84(TARGET.to_enu((0.25, up))))
    )
    with database.writing() as session:
        row = store.get_heliostat(session, "AB12")
        target = store.get_target(session, TARGET.name)
        image, about = measurement(target, "centred", sun_direction(180, 40), np.ones((64, 64)), 20)
        about.arrays = pack({"centered": np.ones((64, 64), np.float32)})
        about.center_right_m = about.center_up_m = None
        about.focal_spot_wgs84, about.kind = None if spot is None else list(spot), "flux-centered"
        store.add_measurement(session, row, image, about)
        material = load_study_inputs(
            session, StudyIn(heliostats=["AB12"], since=BEGIN + timedelta(days=19))
        )
    if reason is not None:
        assert reason in material.skipped["AB12/centred"]
        return
    (photograph,) = material.photographs
    assert (photograph.setup.plane.width, photograph.image.shape) == (4.0, (64, 64))
    np.testing.assert_allclose(photograph.setup.plane.center, TARGET.to_enu((0.25, 0.5)), atol=1e-6)


def test_too_few_photographs_end_the_job_with_the_reasons(client: TestClient):
    answer = client.post("/v1/jobs/studies", json={})
    runtime = cast(FastAPI, client.app).state.runtime
    Worker(runtime, KINDS, "tester", threading.Event()).work()
    job = client.get(answer.headers["Location"]).json()
    assert (job["state"], client.get("/v1/studies").json()["items"]) == ("failed", [])
    assert "at least 4 photographs" in job["reason"]


@pytest.mark.parametrize(
    "payload",
    [
        {"candidates": ["magic"]},
        {"surfaces": "ideal"},
        {"images": 1},
        {"since": "2024-06-01"},
        {"x": 1},
    ],
)
def test_malformed_request_is_refused(refusing: TestClient, payload: dict[str, Any]):
    answer = refusing.post("/v1/jobs/studies", json=payload)
    assert answer.status_code == 422
    assert next(iter(payload)) in answer.json()["detail"]
