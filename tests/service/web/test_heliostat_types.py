"""Heliostats of any type over REST: the same as an import of ``plant.yaml`` makes."""

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.jobs.kinds import predictions
from service.jobs.kinds.predictions import PredictionsIn
from service.sources.folder import read_folder
from service.twin.importing import import_folder
from tests.service import real
from tests.service.sources.plant_files import RICH, write_plant

A2 = {"type": "large", "east_m": -50, "north_m": 220, "up_m": 0, "focal_length_m": 250}
B1 = {"type": "small", "east_m": 30, "north_m": 120, "up_m": -1.5, "receiver": "board"}
MIRROR = {
    "mount": {"kind": "pitch_roll", "pivot_height_m": 2},
    "facets": {"rows": 1, "columns": 3, "width_m": 1.5, "height_m": 2, "gap_m": 0.01},
    "reflectance": 0.9,
}


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    folder = write_plant(tmp_path_factory.mktemp("rich"), RICH).parent
    with real.client_on(tmp_path_factory.mktemp("store")) as client:
        import_folder(real.runtime_of(client), read_folder(folder, whole_field=True))
        yield client


@pytest.mark.parametrize(("name", "body"), [("A2", A2), ("B1", B1)])
def test_heliostat_of_a_type_is_that_of_the_import(
    rich: TestClient, name: str, body: dict[str, Any]
):
    imported = rich.get(f"/v1/heliostats/{name}").json()["properties"]
    put = rich.put(f"/v1/heliostats/new-{name}", json=body)
    assert put.status_code == 201, put.text
    assert put.json()["properties"] == imported
    assert put.json()["position_m"] == [body["east_m"], body["north_m"], body["up_m"]]


def test_what_get_gives_can_be_put_again(rich: TestClient):
    for name in ("A1", "B1"):
        found = rich.get(f"/v1/heliostats/{name}").json()
        again = rich.put(f"/v1/heliostats/{name}", json=found["properties"])
        assert (again.status_code, again.json()) == (200, found)
        posted = rich.post("/v1/heliostats", json={"name": name, "properties": found["properties"]})
        assert (posted.status_code, posted.json()) == (200, found)


def test_type_written_out_is_stored_and_lights_the_receiver(rich: TestClient):
    place = {"east_m": 10, "north_m": 150, "up_m": 0, "receiver": "board"}
    body = {"name": "W1", "properties": {"type": MIRROR, **place}}
    posted = rich.post("/v1/heliostats", json=body)
    assert posted.status_code == 201, posted.text
    assert len(posted.json()["properties"]["facets"]) == 3
    sun = {"azimuth_deg": 150, "elevation_deg": 40}
    made = rich.post("/v1/forecasts", json={"heliostat": "W1", "target": "board", "sun": sun})
    assert made.json()["losses"]["mirror_area_m2"] == pytest.approx(9)
    assert made.json()["losses"]["reflectance"] == pytest.approx(0.9)


def test_job_of_predictions_takes_the_time_of_refinement_without_a_network(
    rich: TestClient, two_heliostats: TestClient
):
    other, juelich = real.runtime_of(rich), real.runtime_of(two_heliostats)
    without = PredictionsIn(heliostats=["A1", "A2", "B1"])
    assert predictions.expected_s(without, other) == 3 * predictions.EACH_S["refined"]
    assert predictions.expected_s(PredictionsIn(), juelich) == 2 * predictions.EACH_S["network"]
    assert (
        predictions.expected_s(PredictionsIn(method="refined"), juelich)
        == 2 * predictions.EACH_S["refined"]
    )


def test_own_facets_and_canting_replace_those_of_the_type(rich: TestClient):
    own = {"facets": MIRROR["facets"], "canting": "flat"}
    put = rich.put("/v1/heliostats/own", json=A2 | own)
    assert put.status_code == 201, put.text
    document = put.json()["properties"]
    assert (document["type"], len(document["facets"])) == ("", 3)
    assert {tuple(facet["half_width_m"]) for facet in document["facets"]} == {(0.75, 0.0, 0.0)}


@pytest.mark.parametrize(
    ("change", "field", "remedy"),
    [
        ({"type": "larg"}, "type", "did you mean large?"),
        ({"receiver": "mian"}, "receiver", "did you mean main?"),
        ({"facets": {"file": "other.csv"}}, "facets.file", "rows and columns"),
        ({"canting": "individual"}, "canting", "facets file"),
        ({"type": {**MIRROR, "reflectance": 2}}, "type.reflectance", "1 or less"),
        ({"type": {**MIRROR, "reflectence": 1}}, "reflectence", "did you mean reflectance?"),
        ({"north": 3}, "north", "did you mean north_m?"),
        ({"type": {**MIRROR, "mount": {"kind": "helio"}}}, "type.mount.kind", "pitch_roll"),
        ({"receiver": "board", "east_m": 0, "north_m": 0, "up_m": 56}, "east_m", "move one"),
    ],
)
def test_mistake_names_field_and_remedy(
    rich: TestClient, change: dict[str, Any], field: str, remedy: str
):
    refused = rich.put("/v1/heliostats/wrong", json=A2 | change)
    assert refused.status_code == 422, refused.text
    assert field in refused.json()["detail"]
    assert remedy in refused.json()["detail"]
    assert rich.get("/v1/heliostats/wrong").status_code == 404


@pytest.mark.parametrize(
    ("part", "change", "field"),
    [
        ("mount", {"first_axis": [0, 0, 2]}, "first_axis"),
        ("mount", {"zero_attitude": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "zero_attitude"),
        ("optics", {"reflectance": 0}, "optics.reflectance"),
    ],
)
def test_document_that_is_no_mirror_is_refused(
    rich: TestClient, part: str, change: dict[str, Any], field: str
):
    document = rich.get("/v1/heliostats/A1").json()["properties"]
    document[part] |= change
    refused = rich.put("/v1/heliostats/A1", json=document)
    assert refused.status_code == 422, refused.text
    assert field in refused.json()["detail"]
