"""The store's functions: idempotent, paged, and safe against others who write the same thing."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service import store
from service.base.arrays import pack, unpack
from service.base.errors import ConflictError, NotFoundError
from service.store import keys, queue
from service.store.columns import now
from service.store.database import Database
from service.store.job_tables import KeyRow
from service.store.measurements import MeasurementFilter
from service.store.rows import Change
from service.store.surface_versions import NewSurface
from service.store.tables import HeliostatRow, SurfaceRow, TargetRow
from tests.service.conftest import ORIGIN
from tests.service.store.rows import PLANE, new
from tests.waiting import WAIT_LIMIT_S


def setup(session: Session) -> tuple[HeliostatRow, TargetRow]:
    store.put_plant(session, "plant", ORIGIN)
    return store.put_heliostat(session, "AA39", {"a": 1}, (1, 2, 3))[0], store.put_target(
        session, PLANE
    )[0]


def test_plant_target_and_heliostat_are_written_once(database: Database):
    for expected in (Change.NEW, Change.UNCHANGED):
        with database.writing() as session:
            assert store.put_plant(session, "plant", ORIGIN) is expected
            assert store.put_target(session, PLANE)[1] is expected
            assert store.put_heliostat(session, "AA39", {"a": [1, None]}, (1, 2, 3))[1] is expected
    with database.writing() as session:
        assert (
            store.put_heliostat(session, "AA39", {"a": [2, None]}, (1, 2, 3))[1] is Change.CHANGED
        )
    with database.reading() as session:
        assert store.counts(session)["heliostats"] == 1
        plane = store.target_plane(store.get_target(session, "lower"))
        np.testing.assert_allclose(plane.axes, PLANE.axes)


def test_corners_stay_known_while_the_plane_is_the_same(database: Database):
    corners = {"upper_left": [50.0, 6.0, 100.0]}
    with database.writing() as session:
        store.put_target(session, PLANE, corners)
        row, change = store.put_target(session, PLANE)
        assert (row.corners, change) == (corners, Change.UNCHANGED)
        row, change = store.put_target(session, replace(PLANE, width=5.0))
        assert (row.corners, change) == (None, Change.CHANGED)
        assert store.put_target(session, replace(PLANE, width=5.0), corners)[1] is Change.CHANGED


@pytest.mark.parametrize("name", ["", "a b", "../a", "a" * 33, "-a", "a\n"])
def test_names_that_no_path_could_hold_are_refused(database: Database, name: str):
    with database.writing() as session:
        heliostat, target = setup(session)
        with pytest.raises(InvalidInputError, match="heliostat"):
            store.put_heliostat(session, name, {}, (0, 0, 0))
        with pytest.raises(InvalidInputError, match="target"):
            store.put_target(session, replace(PLANE, name=name))
        with pytest.raises(InvalidInputError, match="id"):
            store.add_measurement(session, heliostat, *new(target, external_id=name * 2))


def test_origin_is_fixed_once_something_stands_on_it(database: Database):
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        assert store.put_plant(session, "plant", (50.0, 6.0, 80.0)) is Change.CHANGED
        store.put_target(session, PLANE)
        assert store.put_plant(session, "renamed", (50.0, 6.0, 80.0)) is Change.CHANGED
        with pytest.raises(ConflictError, match="origin is fixed"):
            store.put_plant(session, "plant", ORIGIN)


def test_missing_things_are_named(database: Database):
    with database.writing() as session:
        with pytest.raises(ConflictError, match="plant is not set"):
            store.get_plant(session)
        heliostat, _ = setup(session)
        with pytest.raises(NotFoundError, match="heliostat B"):
            store.get_heliostat(session, "B")
        with pytest.raises(NotFoundError, match="known targets: lower"):
            store.get_target(session, "upper")
        with pytest.raises(NotFoundError, match="no measurement x"):
            store.get_measurement(session, heliostat, "x")
        with pytest.raises(NotFoundError, match="surface version 1"):
            store.get_surface(session, heliostat, 1)
        with pytest.raises(NotFoundError, match="no surface yet"):
            store.get_surface_at(session, heliostat)
        with pytest.raises(NotFoundError, match="no forecast 1"):
            store.get_forecast(session, 1)


def test_properties_come_back_as_they_were(database: Database):
    properties = {"z": 1, "a": [1.5, -0.0, 1e-17], "ü": {"null": None, "true": True}, "big": 2**60}
    with database.writing() as session:
        setup(session)
        store.put_heliostat(session, "B1", properties, (0, 0, 0))
    with database.reading() as session:
        found = store.get_heliostat(session, "B1").properties
    assert found == properties
    assert list(found) == list(properties)


def test_images_of_one_measurement_in_several_kinds(database: Database):
    with database.writing() as session:
        heliostat, target = setup(session)
        rows = [
            store.add_measurement(session, heliostat, *new(target, image, kind, external_id="7"))[0]
            for image, kind in (("a", "flux"), ("b", "raw"), ("c", "flux-centered"))
        ]
        assert [row.identifier for row in rows] == ["7", "7-raw", "7-flux-centered"]
        with pytest.raises(ConflictError, match="another flux image"):
            store.add_measurement(session, heliostat, *new(target, "d", "flux", external_id="7"))
        with pytest.raises(ConflictError, match="another raw image"):
            store.add_measurement(session, heliostat, *new(target, "d", "raw", external_id="7"))
        assert [row.identifier for row in store.recent_measurements(session, heliostat, 8)] == ["7"]


def test_same_image_of_two_heliostats_is_kept_once(database: Database):
    with database.writing() as session:
        heliostat, target = setup(session)
        other, _ = store.put_heliostat(session, "AB12", {}, (0, 0, 0))
        store.add_measurement(session, heliostat, *new(target))
        image, forced = new(target)
        forced.forced = "both have it"
        assert store.add_measurement(session, other, image, forced)[1]
        assert store.counts(session) == {
            "heliostats": 2,
            "targets": 1,
            "images": 1,
            "measurements": 2,
            "surfaces": 0,
            "forecasts": 0,
        }


def test_refused_image_keeps_its_reason_and_is_not_used(database: Database):
    refused = {
        "accepted": False,
        "reason": "no_spot",
        "arrays": None,
        "quality": {"detail": "dark"},
    }
    with database.writing() as session:
        heliostat, target = setup(session)
        row, _ = store.add_measurement(session, heliostat, *new(target, **refused))
    with database.reading() as session:
        found = store.get_measurement(session, heliostat, row.identifier, arrays=True)
        assert (found.accepted, found.reason, found.quality, found.arrays) == (
            False,
            "no_spot",
            {"detail": "dark"},
            None,
        )
        assert store.recent_measurements(session, heliostat, 8) == []


def test_measurement_comes_back_as_it_was(database: Database):
    taken = datetime(2024, 5, 1, 10, tzinfo=UTC)
    with database.writing() as session:
        heliostat, target = setup(session)
        given = {
            "motor_axis_1": 1.0,
            "motor_axis_2": 2.0,
            "taken_at": taken,
            "focal_spot_wgs84": list(ORIGIN),
            "center_right_m": 0.5,
            "center_up_m": -1,
            "arrays": pack(
                {"flux": np.eye(256, dtype=np.float32), "centered": np.ones((64, 64), np.float32)}
            ),
        }
        row, _ = store.add_measurement(session, heliostat, *new(target, **given))
    with database.reading() as session:
        found = store.get_measurement(session, heliostat, row.identifier, arrays=True)
    assert (found.motor_axis_1, found.motor_axis_2, found.taken_at) == (1.0, 2.0, taken)
    assert found.focal_spot_wgs84 == list(ORIGIN)
    assert (found.center_right_m, found.center_up_m) == (0.5, -1)
    arrays = unpack(found.arrays or b"")
    np.testing.assert_array_equal(arrays["flux"], np.eye(256))
    assert arrays["centered"].dtype == np.float32


def test_pages_follow_each_other(database: Database):
    with database.writing() as session:
        heliostat, target = setup(session)
        for name in ("C", "A", "B"):
            store.put_heliostat(session, name, {}, (0, 0, 0))
        for image in "abc":
            store.add_measurement(
                session, heliostat, *new(target, image, accepted=image != "b", external_id=image)
            )
    with database.reading() as session:
        assert [row.name for row in store.list_heliostats(session, 2)] == ["A", "AA39"]
        assert [row.name for row in store.list_heliostats(session, 9, "AA39")] == ["B", "C"]
        listed = store.list_measurements(session, heliostat, 9, after="a")
        assert [row.identifier for row in listed] == ["b", "c"]
        assert [
            row.identifier
            for row in store.list_measurements(
                session, heliostat, 9, filters=MeasurementFilter(accepted=False)
            )
        ] == ["b"]


def surface(value: float = 0.0, **changes: Any) -> NewSurface:
    z = np.full((4, 8, 8), value)
    return NewSurface(
        **(
            {"source": "network", "z": z, "z_std": z, "control_points": np.stack([z] * 3, -1)}
            | changes
        )
    )


def test_surfaces_are_versions_in_time(database: Database):
    start = datetime(2024, 1, 1, tzinfo=UTC)
    with database.writing() as session:
        heliostat, target = setup(session)
        used, _ = store.add_measurement(session, heliostat, *new(target))
        for days in (0, 20, 10):
            moment = start + timedelta(days=days)
            store.add_surface(
                session, heliostat, surface(days, valid_from=moment, measurements=[used])
            )
    with database.reading() as session:
        assert [row.version for row in store.list_surfaces(session, heliostat, 9)] == [1, 2, 3]
        assert [row.version for row in store.list_surfaces(session, heliostat, 9, after=2)] == [3]
        at = [
            store.get_surface_at(session, heliostat, start + timedelta(days=days)).version
            for days in (1, 10, 19, 99)
        ]
        assert at == [1, 3, 3, 2]
        assert store.find_surface_at(session, heliostat, start - timedelta(seconds=1)) is None
        found = store.get_surface(session, heliostat, 2)
        assert [row.identifier for row in found.measurements] == [used.identifier]
        np.testing.assert_array_equal(unpack(found.arrays)["z"], np.full((4, 8, 8), 20.0))


def test_imported_surface_is_stored_once(database: Database):
    with database.writing() as session:
        heliostat, _ = setup(session)
        results = [
            store.add_surface(session, heliostat, surface(v, source="measured"), once=True)
            for v in (1, 1, 2)
        ]
        assert [is_new for _, is_new in results] == [True, False, True]
        assert [row.version for row, _ in results] == [1, 1, 2]
        # predictions may repeat: each is a separate version
        assert [store.add_surface(session, heliostat, surface(1))[0].version for _ in range(2)] == [
            3,
            4,
        ]


def test_many_writers_of_one_heliostat_make_one(database: Database):
    def write(_: int) -> Change:
        with database.writing() as session:
            return store.put_heliostat(session, "AA39", {"a": 1}, (1, 2, 3))[1]

    with ThreadPoolExecutor(8) as pool:
        changes = list(pool.map(write, range(16)))
    assert sorted(changes) == [Change.NEW] + 15 * [Change.UNCHANGED]


def test_many_writers_of_one_measurement_in_other_kinds(database: Database):
    with database.writing() as session:
        setup(session)

    def write(kind: str) -> str:
        with database.writing() as session:
            heliostat = store.get_heliostat(session, "AA39")
            measurement = new(
                store.get_target(session, "lower"), f"{len(kind):x}", kind, external_id="7"
            )
            return store.add_measurement(session, heliostat, *measurement)[0].identifier

    kinds = ["raw", "cropped", "flux", "flux-centered"]
    with ThreadPoolExecutor(4) as pool:
        names = list(pool.map(write, kinds))
    assert sorted(names.count(name) for name in names) == [1, 1, 1, 1]
    assert names.count("7") == 1


def test_many_writers_of_surfaces_make_consecutive_versions(database: Database):
    with database.writing() as session:
        setup(session)

    def write(number: int) -> int:
        with database.writing() as session:
            heliostat = store.get_heliostat(session, "AA39")
            return store.add_surface(session, heliostat, surface(number))[0].version

    with ThreadPoolExecutor(4) as pool:
        assert sorted(pool.map(write, range(8))) == list(range(1, 9))


def test_many_creators_of_a_key_make_one(database: Database):
    def write(_: int) -> str:
        try:
            with database.writing() as session:
                return keys.create(session, "plant", "read", "tester")
        except ConflictError as error:
            return str(error)

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(write, range(8)))
    made = [answer for answer in answers if answer.startswith("htw_")]
    assert len(made) == 1
    assert all("choose another name" in answer for answer in answers if answer not in made)
    with database.reading() as session:
        found = keys.find(session, made[0])
        assert found is not None
        assert found.name == "plant"


def test_what_another_writer_undoes_is_free_again(database: Database):
    """The second of two writers waits for the first; where that one fails, the second is the one
    that wrote.
    """
    waiting, failing = threading.Event(), RuntimeError("on purpose")

    def fail() -> None:
        with database.writing() as session:
            store.put_heliostat(session, "AA39", {"a": 1}, (1, 2, 3))
            waiting.set()
            time.sleep(0.3)
            raise failing

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(fail)
        assert waiting.wait(WAIT_LIMIT_S)
        with database.writing() as session:
            row, change = store.put_heliostat(session, "AA39", {"a": 2}, (1, 2, 3))
        assert first.exception() is failing
    assert (change, row.properties) == (Change.NEW, {"a": 2})


def test_inserted_row_has_what_the_database_made(database: Database):
    with database.writing() as session:
        row = KeyRow(name="a", prefix="b", sha256="c", role="read")
        assert store.insert(session, row)
    assert row.id >= 1
    assert row.withdrawn_at is None
    assert row.created_at.tzinfo is UTC
    with database.writing() as session:
        kept = session.merge(row, load=False)
        kept.role = "ingest"  # it is the session's: a change of it is written
    with database.writing() as session:
        again = KeyRow(name="a", prefix="d", sha256="e", role="read")
        assert not store.insert(session, again)
        assert session.get_one(KeyRow, row.id).role == "ingest"


def test_what_a_check_forbids_is_no_other_writers_fault(database: Database):
    """It was reported as too many writers, or not at all.

    The cause was that every violated constraint counted as a lost race.
    """
    with database.writing() as session:
        heliostat, target = setup(session)
    with pytest.raises(IntegrityError, match="ck_measurements_kind"), database.writing() as session:
        store.add_measurement(session, heliostat, *new(target, kind="photo"))
    with pytest.raises(IntegrityError, match="ck_surfaces_source"), database.writing() as session:
        store.add_surface(session, heliostat, replace(surface(1), source="guess"))
    nowhere = SurfaceRow(heliostat_id=99, version=1, valid_from=now(), source="network", arrays=b"")
    with pytest.raises(IntegrityError, match=r"(?i)foreign key"), database.writing() as session:
        store.insert(session, nowhere)
    with database.reading() as session:
        assert store.counts(session)["measurements"] == 0


def test_outdated_surfaces_are_those_of_today_by_another_version_of_the_model(database: Database):
    with database.writing() as session:
        heliostat, _ = setup(session)
        measured, bare = (
            store.put_heliostat(session, name, {}, (0, 0, 0))[0] for name in ("AB01", "AB02")
        )
        store.add_surface(session, heliostat, surface(1, model_version="1:none"))
        store.add_surface(session, measured, surface(2, source="measured"))
        assert bare.id
    with database.writing() as session:
        assert store.outdated_surfaces(session, "1:none") == []
        expected = store.Outdated("AA39", 1, "network", "1:none", waits=False)
        assert store.outdated_surfaces(session, "2:slope_error") == [expected]
        heliostat = store.get_heliostat(session, "AA39")
        row, _ = store.add_surface(session, heliostat, surface(3, model_version="2:slope_error"))
        row.is_candidate = True
    with database.reading() as session:
        assert store.outdated_surfaces(session, "2:slope_error") == [replace(expected, waits=True)]


def test_plans_are_listed_newest_first_under_way_or_done(database: Database):
    payload = {"name": "June", "target": "lower", "first_at": "2026-06-21T04:00:00Z"}
    with database.writing() as session:
        first, _ = queue.add_job(session, "plans", payload, "tester", None)
        first.result, first.state = {"peak_w_m2": 1.5}, "done"
        queue.add_job(session, "predictions", {}, "tester", None)
        queue.add_job(session, "plans", payload | {"name": "July"}, "tester", None)
    with database.reading() as session:
        plans = store.list_plans(session, 10)
    assert [(plan.name, plan.state, plan.peak_w_m2) for plan in plans] == [
        ("July", "queued", None),
        ("June", "done", 1.5),
    ]
