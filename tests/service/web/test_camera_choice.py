"""The camera of a store's images: found once, shown to a person, and declared by a person."""

from typing import Any, cast

import pytest
from fastapi.testclient import TestClient

from model.effects import CATALOGUE
from service.base.arrays import unpack
from service.store.tables import MeasurementRow
from service.twin.alarms.field_updates import FieldStateWriter
from service.twin.model_versions import add_model
from tests.service.real import run_job, runtime_of, worker
from tests.service.web.pages import HTML


@pytest.mark.full
def test_the_camera_is_chosen_shown_and_declared(real_client: TestClient):
    client = real_client
    assert client.get("/v1/plant").json()["camera_choice"] is None
    found = run_job(client, "/v1/jobs/camera-choices")
    assert (found["answer"], found["by"], found["images"]) == ("srgb", "measured", 10)
    assert client.get("/v1/plant").json()["camera_choice"] == found
    page = client.get("/plant", headers=HTML).text
    assert "differences of sRGB counts" in page
    assert "twin.json" in page

    path = "/v1/heliostats/AA39/surfaces"
    (network,) = (
        one["version"] for one in client.get(path).json()["items"] if one["source"] == "network"
    )
    assert (
        client.put(f"{path}/current", json={"version": network, "reason": "a test"}).status_code
        == 200
    )
    runtime = runtime_of(client)
    with runtime.database.reading() as session:
        rows = session.query(MeasurementRow).filter(MeasurementRow.kind == "flux")
        before = {row.id: unpack(row.arrays)["flux"] for row in rows}
    FieldStateWriter(runtime).update()
    (alarm,) = client.get("/v1/alarms", params={"reason": "camera_undeclared"}).json()["items"]
    assert "as differences of sRGB counts" in alarm["message"]
    assert alarm["offer"]["path"] == "/v1/jobs/measurements"
    result = run_job(client, alarm["offer"]["path"], **alarm["offer"]["body"])
    again = client.post("/v1/jobs/measurements", json={"camera": "linear"})
    assert (again.status_code, result["changed"]) == (409, len(before))
    while worker(client).work():
        pass
    with runtime.database.reading() as session:
        for row in session.query(MeasurementRow).filter(MeasurementRow.id.in_(before)):
            assert unpack(row.arrays)["flux"].max() > before[row.id].max()
    FieldStateWriter(runtime).update()
    reasons = {one["reason"] for one in client.get("/v1/alarms").json()["items"]}
    assert not reasons & {"camera", "camera_undeclared", "fell", "accuracy"}
    newest = max(client.get(path).json()["items"], key=lambda one: one["version"])
    assert newest["outdated"] == []
    assert newest["model_version"] != client.get(f"{path}/{network}").json()["model_version"]
    assert client.get("/v1/plant").json()["camera_choice"] is None


@pytest.mark.full
def test_a_curve_that_was_adopted_is_not_declared_again(real_client: TestClient):
    """Both together would correct the counts twice."""
    runtime = runtime_of(real_client)

    def undeclared() -> list[Any]:
        FieldStateWriter(runtime).update()
        listed = real_client.get("/v1/alarms", params={"reason": "camera_undeclared"})
        return cast(list[Any], listed.json()["items"])

    run_job(real_client, "/v1/jobs/camera-choices")
    assert len(undeclared()) == 1
    with runtime.database.writing() as session:
        add_model(session, [CATALOGUE["camera_shoulder"](compression=1.1)], {}, None, "tester")
    assert undeclared() == []
    assert real_client.get("/v1/plant").json()["camera_choice"] is None
    assert run_job(real_client, "/v1/jobs/camera-choices")["answer"] != "srgb"
    assert undeclared() == []


@pytest.mark.full
def test_light_changes_nothing(real_client: TestClient):
    declared = run_job(real_client, "/v1/jobs/measurements", camera="linear", reason="simulated")
    assert declared["changed"] == 0
    assert real_client.get("/v1/models/current").json()["declared"]["cameras"] == []
    FieldStateWriter(runtime_of(real_client)).update()
    alarms = real_client.get("/v1/alarms").json()["items"]
    assert "camera" not in {one["reason"] for one in alarms}
