"""What the integrators' guide promises of photographs, repeats, identity, ids and times: a test for
each promise, here or in `test_identity`.
"""

import itertools
import json
import re
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select

from model.imaging.quality import _REMEDY
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.store.columns import now
from service.store.tables import DriftRow
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.access import bearer, make_key
from tests.service.conftest import (
    Post,
    client_of,
    metadata,
    png,
    properties_document,
    spot_of,
    sun_at,
)
from tests.service.real import run_job
from tests.service.spots import photographs
from tests.service.web.promises import GUIDE, promise

BASE = "/v1/heliostats/AA39/measurements"
MOMENT = "2024-06-01T09:14:03Z"
SPOT = spot_of(50.9133, 6.3878, 122.9)


@pytest.fixture
def other(client: TestClient) -> TestClient:
    """The client, with a second heliostat, AB38."""
    assert client.put("/v1/heliostats/AB38", json=properties_document()).status_code == 201
    return client


def listed(client: TestClient, query: str = "") -> list[str]:
    return [item["id"] for item in client.get(f"{BASE}{query}").json()["items"]]


def reasons(client: TestClient) -> set[str]:
    return {item["reason"] for item in client.get("/v1/alarms").json()["items"]}


# --- what is sent
# --------------------------------------------------------------------------------------------------


@promise("your own name for the photograph, unique for the heliostat. Its kinds share it")
def test_an_id_is_unique_for_a_heliostat_and_shared_by_kinds(other: TestClient, post: Post):
    assert post(png(1), id="1", kind="flux").json()["id"] == "1"
    assert post(png(2), id="1", kind="raw").json()["id"] == "1-raw"
    assert post(png(3), id="1", heliostat="AB38").status_code == 201
    assert post(png(4), id="1", kind="flux").status_code == 409
    assert {item["external_id"] for item in other.get(BASE).json()["items"]} == {"1"}


@promise("Optional but wise: without it the service names it")
def test_without_an_id_the_service_names_it(client: TestClient, post: Post):
    document = post().json()
    assert document["external_id"] is None
    assert client.get(f"{BASE}/{document['id']}").json()["image_sha256"].startswith(document["id"])


@promise(
    "`none`: no image part, but `motor_position` and `focal_spot_m`, which calibrate the mount"
)
def test_kind_none_has_no_image_part(client: TestClient, tower: Any, properties: Any):
    for one in photographs(tower, properties):
        document = {**one, "kind": "none", "target": "lower"}
        assert (
            client.post(BASE, files={"metadata": (None, json.dumps(document))}).status_code == 201
        )
    with_image = client.post(
        BASE,
        files={"image": ("a.png", png(), "image/png"), "metadata": (None, json.dumps(document))},
    )
    assert (with_image.status_code, with_image.json()["detail"].startswith("kind: ")) == (422, True)
    assert run_job(client, "/v1/jobs/calibrations")["mounts"] == {"AA39": 1}


@promise("when it was taken, with zone. It orders photographs and surfaces, however late they come")
def test_times_order_photographs_and_surfaces_however_late_they_come(
    client: TestClient, post: Post
):
    for number, year in enumerate((2024, 2023)):
        assert (
            post(png(number), id=str(year), taken_at=f"{year}-06-01T12:00:00+02:00").status_code
            == 201
        )
        body = {"method": "network", "measurements": [str(year)]}
        assert client.post("/v1/heliostats/AA39/surfaces", json=body).status_code == 201
    assert listed(client, "?sort=taken_at") == ["2023", "2024"]
    current = client.get("/v1/heliostats/AA39/surfaces/current").json()
    assert (current["measurements"], current["valid_from"]) == (["2024"], "2024-06-01T10:00:00Z")
    then = client.get("/v1/heliostats/AA39/surfaces?at=2023-07-01T00:00:00Z").json()
    assert then["measurements"] == ["2023"]
    without_zone = post(png(9), taken_at="2024-06-01T12:00:00")
    assert (without_zone.status_code, "taken_at" in without_zone.json()["detail"]) == (422, True)


@promise(
    "lists by time have the photograph last, and no filter by time finds it",
    "an alarm asks for times",
)
def test_without_a_time_lists_by_time_have_it_last(client: TestClient, post: Post):
    post(png(1), id="undated")
    assert client.get(f"{BASE}/undated").json()["taken_at"] is None
    assert "times_unknown" in reasons(client)
    post(png(2), id="dated", taken_at=MOMENT)
    assert (
        listed(client, "?sort=taken_at")
        == listed(client, "?sort=taken_at&order=down")
        == ["dated", "undated"]
    )
    assert (
        listed(client, "?since=1970-01-01T00:00:00Z")
        == listed(client, "?until=2100-01-01T00:00:00Z")
        == ["dated"]
    )


@promise("It says nothing of drift, steps or the newest state")
def test_without_a_time_it_is_never_the_newest(app: FastAPI, client: TestClient, post: Post):
    def drift() -> int | None:
        with app.state.runtime.database.reading() as session:
            return session.scalar(select(DriftRow.measurement_id))

    last = now() - timedelta(days=365)
    post(png(1), id="1", taken_at=last.isoformat())
    client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
    post(png(2), id="2")
    (line,) = client.get("/v1/field").json()["items"]
    assert (round(line["age_days"]), drift()) == (365, None)
    post(png(3), id="3", taken_at=(last + timedelta(days=1)).isoformat())
    assert drift() == 3


# --- answers
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sun": sun_at(159.0)}, "sun.azimuth_deg: 160.0 is stored, 159.0 was sent"),
        ({"sun": sun_at(elevation_deg=46.0)}, "sun.elevation_deg: 45.0 is stored, 46.0 was sent"),
        ({"target": "upper"}, "target: lower is stored, upper was sent"),
        ({"taken_at": "2024-06-01T09:14:04Z"}, "taken_at: 2024-06-01T09:14:03Z is stored"),
        ({"motor_position": [1, 3]}, "motor_position: [1.0, 2.0] is stored, [1.0, 3.0] was sent"),
        ({"kind": "raw"}, "kind: flux is stored, raw was sent"),
        ({"heliostat": "AB38"}, "image: heliostat AA39 has it already"),
        ({"image": png(2)}, "id: 1 of heliostat AA39 has another flux image already"),
        ({"id": "2"}, "id: 2 is another image of heliostat AA39"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
@promise(
    "the image is known with another sun, target, time, motor position or kind, or at another"
    " heliostat, or the `id` belongs to another image",
    "`detail` has what is stored and the remedy",
)
def test_409_has_what_is_stored_and_the_remedy(
    other: TestClient, post: Post, changes: dict[str, Any], said: str
):
    sent: dict[str, Any] = {
        "image": png(1),
        "id": "1",
        "taken_at": MOMENT,
        "motor_position": [1, 2],
    }
    assert post(**sent).status_code == 201
    assert post(png(3), id="2").status_code == 201
    answer = post(**sent | changes)
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:heliotwin:problem:conflict")
    assert answer.json()["detail"].startswith(said)
    assert re.search(
        r"(PATCH|DELETE) /v1/heliostats/AA39/measurements/1\b|send this one's own id", answer.text
    )
    assert listed(other) == ["1", "2"]


@promise("An operator corrects it by `PATCH .../measurements/205363`")
def test_what_409_asks_for_helps(client: TestClient, post: Post):
    post(id="205363")
    assert post(id="205363", sun=sun_at(159.0)).status_code == 409
    corrected = client.patch(f"{BASE}/205363", json={"sun": sun_at(159.0), "reason": "typing"})
    assert corrected.status_code == 200
    assert post(id="205363", sun=sun_at(159.0)).status_code == 200


@pytest.mark.parametrize(
    ("changes", "status", "says"),
    [
        ({"heliostat": "ZZ99"}, 404, "ZZ99"),
        ({"target": "nowhere"}, 404, "known targets: lower, upper"),
        ({"image": b"x" * 200_001}, 413, "image: "),
        ({"image": b"no image"}, 415, "PNG, JPEG"),
        ({"sun": sun_at(elevation_deg=91.0)}, 422, "sun.elevation_deg: must be 90 or less"),
    ],
)
@promise("| 404, 413, 415, 422 | it cannot be taken. `detail` says why and what to change |")
def test_what_cannot_be_taken_says_why(
    refused_post: Post, changes: dict[str, Any], status: int, says: str
):
    answer = refused_post(**changes)
    assert (answer.status_code, says in answer.json()["detail"]) == (status, True), answer.text


@promise("| 401, 403 | the key is wrong or may not do this |")
def test_keys_are_checked(app: FastAPI, client: TestClient, post: Post):
    reader = make_key(app, "reader", "read")
    assert post().status_code == 401
    client.headers.update(bearer("ht_wrong"))
    assert post().status_code == 401
    client.headers.update(bearer(reader))
    assert post().status_code == 403


# --- identity
# --------------------------------------------------------------------------------------------------


@promise(
    "the same image of the same heliostat is one measurement, independent of sender, repetition and"
    " order"
)
def test_measurement_is_independent_of_sender_repetition_and_order(
    app: FastAPI, client: TestClient, post: Post, settings: Settings
):
    sent: list[tuple[str, dict[str, Any]]] = [
        ("a", {}),
        ("b", {"taken_at": MOMENT, "id": "1"}),
        ("c", {"motor_position": [1, 2], "focal_spot_m": SPOT, "id": "1"}),
    ]
    keys = {name: make_key(app, name, "ingest") for name, _ in sent}
    known = []
    for seed, order in enumerate(itertools.permutations(sent)):
        for name, changes in (*order, *order):
            client.headers.update(bearer(keys[name]))
            named = changes | ({"id": f"n{seed}"} if "id" in changes else {})
            assert post(png(seed), **named).status_code in (200, 201)
        document = client.get(f"{BASE}/n{seed}").json()
        known.append(
            {
                name: document[name]
                for name in ("taken_at", "motor_position", "focal_spot_m", "external_id")
            }
        )
        assert known[-1] | {"external_id": ""} == known[0] | {"external_id": ""}
        assert document["external_id"] == f"n{seed}"
    assert len(listed(client)) == len(known) == 6


@promise(
    "A photograph that was sent by mistake is deleted by `DELETE"
    " .../measurements/205363?reason=...`. This needs the role `operate`. It deletes all its"
    " images, with `only_this=true` one of them.",
    "surfaces made from it name it in `deleted`",
)
def test_what_was_sent_by_mistake_is_deleted(app: FastAPI, client: TestClient, post: Post):
    post(png(1), id="205363", kind="flux")
    post(png(2), id="205363", kind="raw")
    client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["205363"]})
    keys = {role: bearer(make_key(app, role, role)) for role in ("ingest", "operate")}
    path, query = f"{BASE}/205363", {"reason": "another heliostat's"}
    assert client.delete(path, params=query, headers=keys["ingest"]).status_code == 403
    client.headers.update(keys["operate"])
    one = client.delete(f"{BASE}/205363-raw", params=query | {"only_this": True})
    assert one.json()["deleted"] == ["205363-raw"]
    post(png(2), id="205363", kind="raw")
    assert client.delete(path, params=query).json()["deleted"] == ["205363", "205363-raw"]
    assert listed(client) == []
    assert client.get("/v1/heliostats/AA39/surfaces/1").json()["deleted"] == ["205363"]


@promise("An import of a folder that holds it brings it back.")
def test_an_import_brings_back_what_was_deleted(
    app: FastAPI, client: TestClient, post: Post, tmp_path: Path
):
    runtime: Runtime = app.state.runtime
    post(id="1", taken_at=MOMENT)
    export_folder(runtime, tmp_path / "out")
    client.delete(f"{BASE}/1", params={"reason": "a cloud"})
    assert listed(client) == []
    assert import_folder(runtime, read_folder(tmp_path / "out"))["counts"]["images new"] == 1
    assert listed(client) == ["1"]
    assert client.get(f"{BASE}/1").json()["taken_at"] == MOMENT


# --- what is kept
# --------------------------------------------------------------------------------------------------


@promise("by default an image for two years, a refused one for 90 days, their figures without end")
def test_images_are_kept_for_two_years_by_default(tmp_path: Path):
    """That figures stay is
    `test_pruned.test_deleted_image_is_gone_and_its_measurement_is_not`.
    """
    settings = Settings(data_dir=tmp_path)
    assert (settings.image_retention_days, settings.refused_image_retention_days) == (730, 90)


@promise(
    "| 201 | stored for good, also if the power fails now. Read `accepted`, `reason` and `warnings`"
    " | next |"
)
def test_201_is_stored_for_good(settings: Settings, client: TestClient, post: Post):
    """Another process finds it; that it outlives a kill is tests/faults."""
    document = post(id="1").json()
    assert (document["accepted"], document["reason"], document["warnings"]) == (True, None, [])
    with client_of(create_app(settings)) as again:
        assert again.get(f"{BASE}/1/image").content == png()


@promise(
    "`accepted: false` is no error: the photograph is kept, but shows no spot to learn from.",
    "`quality.detail` says what to do at the camera",
)
def test_a_refused_photograph_is_kept(client: TestClient, post: Post):
    answer = post(png(1, refused=True), id="1")
    assert (answer.status_code, answer.json()["accepted"], answer.json()["reason"]) == (
        201,
        False,
        "no_spot",
    )
    assert answer.json()["quality"]["detail"]
    assert client.get(f"{BASE}/1/image").status_code == 200
    named = re.search(r"`reason` is one of (.*?) by an operator", GUIDE)
    assert named is not None
    assert set(re.findall(r"`(\w+)`", named[1])) == {*_REMEDY, "target_not_found", "excluded"}


# --- times
# --------------------------------------------------------------------------------------------------


@promise(
    "`sun_contradicts_time`: the sun was not where it was recorded at `taken_at` (`angle_deg` is"
    " the angle between both). It refuses nothing"
)
def test_a_sun_that_contradicts_its_time_is_warned_of(client: TestClient, post: Post):
    document = post(id="1", taken_at=MOMENT).json()
    (warning,) = document["warnings"]
    assert (warning["type"], document["accepted"]) == ("sun_contradicts_time", True)
    assert f"{warning['angle_deg']:.1f} degrees" in warning["detail"]


@promise(
    "Times that are found later are given together, all or none, as corrections (role `operate`)",
    "PATCH /v1/measurements/times",
)
def test_times_are_given_together_all_or_none(app: FastAPI, client: TestClient, post: Post):
    for number in (1, 2):
        post(png(number), id=str(number))
    keys = {role: bearer(make_key(app, role, role)) for role in ("ingest", "operate")}
    given = [{"heliostat": "AA39", "id": str(number), "taken_at": MOMENT} for number in (1, 2)]
    body = {"reason": "the cameras' log", "times": given}
    assert (
        client.patch("/v1/measurements/times", json=body, headers=keys["ingest"]).status_code == 403
    )
    client.headers.update(keys["operate"])
    wrong = client.patch(
        "/v1/measurements/times", json=body | {"times": [*given, given[0] | {"id": "9"}]}
    )
    assert wrong.status_code == 422
    assert client.get(f"{BASE}/1").json()["taken_at"] is None
    assert client.patch("/v1/measurements/times", json=body).json() == {"given": 2, "changed": 2}
    (correction,) = client.get(f"{BASE}/2/corrections").json()["items"]
    assert correction["reason"] == "the cameras' log"
    assert client.get(f"{BASE}/1").json()["taken_at"] == MOMENT


@promise(
    "`taken_at` may be ahead of the service's clock by a day at most. A photograph from further in"
    " the future is refused (422)"
)
def test_a_photograph_of_the_future_is_refused(client: TestClient, post: Post):
    def at(hours: int) -> str:
        return (now() + timedelta(hours=hours)).isoformat()

    assert post(png(1), taken_at=at(23)).status_code == 201
    answer = post(png(2), taken_at=at(25))
    assert (answer.status_code, answer.json()["errors"][0]["field"]) == (422, "taken_at")
    # Nor by another way.
    assert post(png(1), taken_at=at(25)).status_code == 422
    document = metadata(kind="none", motor_position=[1, 2], focal_spot_m=SPOT, taken_at=at(25))
    assert client.post(BASE, files={"metadata": (None, json.dumps(document))}).status_code == 422
