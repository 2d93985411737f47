"""Versions of calibrated mounts, on both engines."""

from datetime import UTC, datetime
from typing import Any

import pytest

from service import store
from service.base.errors import NotFoundError
from service.store import mounts
from service.store.database import Database
from tests.service.conftest import ORIGIN


def document(valid_from: str, measurements: int = 3) -> dict[str, Any]:
    return {"valid_from": valid_from, "measurements": measurements}


def test_mounts_are_found_by_the_time_they_are_valid(database: Database):
    with database.writing() as session:
        store.put_plant(session, "P", ORIGIN)
        first, _ = store.put_heliostat(session, "AA39", {}, (0.0, 1.0, 2.0))
        other, _ = store.put_heliostat(session, "AB01", {}, (0.0, 1.0, 2.0))
        for heliostat in (first, other):
            mounts.add_mount(session, heliostat, document("2024-05-01T00:00:00+00:00"))
        mounts.add_mount(session, first, document("2024-06-01T00:00:00+00:00"))
    with database.reading() as session:
        row = store.get_heliostat(session, "AA39")
        assert mounts.get_mount_at(session, row).version == 2
        assert mounts.get_mount_at(session, row, datetime(2024, 5, 20, tzinfo=UTC)).version == 1
        assert [one.version for one in mounts.list_mounts(session, row, 10)] == [1, 2]
        assert [one.version for one in mounts.list_mounts(session, row, 10, after=1)] == [2]
        newest = {
            heliostat.name: mount.version for heliostat, mount in mounts.current_mounts(session)
        }
        assert newest == {"AA39": 2, "AB01": 1}
        assert [heliostat.name for heliostat, _ in mounts.current_mounts(session, ["AB01"])] == [
            "AB01"
        ]
        with pytest.raises(NotFoundError, match="no calibrated mount"):
            mounts.get_mount_at(session, row, datetime(2024, 4, 1, tzinfo=UTC))


def test_each_calibration_is_a_version_also_of_the_same_state(database: Database):
    with database.writing() as session:
        store.put_plant(session, "P", ORIGIN)
        heliostat, _ = store.put_heliostat(session, "AA39", {}, (0.0, 1.0, 2.0))
        mounts.add_mount(session, heliostat, document("2024-05-01T00:00:00+00:00"))
    with database.writing() as session:
        heliostat = store.get_heliostat(session, "AA39")
        again = mounts.add_mount(
            session, heliostat, document("2024-05-01T00:00:00+00:00", measurements=4)
        )
        assert again.version == 2
    with database.reading() as session:
        heliostat = store.get_heliostat(session, "AA39")
        rows = mounts.list_mounts(session, heliostat, 10)
        assert [row.document["measurements"] for row in rows] == [3, 4]
        assert mounts.get_mount_at(session, heliostat).version == 2


def test_states_of_all_mounts_are_told_without_their_documents(database: Database):
    moments = ["2024-05-01T00:00:00+00:00", "2024-05-03T00:00:00+00:00"]
    driven = {"kinematics_properties": {"actuators": [{"type_axis": "linear"}] * 2}}
    older = {"kinematic_properties": driven["kinematics_properties"]}
    with database.writing() as session:
        store.put_plant(session, "P", ORIGIN)
        for name, properties in (("AB01", older), ("AA39", driven), ("AC01", {})):
            store.put_heliostat(session, name, properties, (0.0, 1.0, 2.0))
        row = store.get_heliostat(session, "AA39")
        for valid_from in moments:
            mounts.add_mount(session, row, document(valid_from, 2) | {"history": {"at": moments}})
    with database.reading() as session:
        assert mounts.calibration_states(session) == [
            mounts.CalibrationState("AA39", 2, moments[-1]),
            mounts.CalibrationState("AB01", 0, None),
        ]
