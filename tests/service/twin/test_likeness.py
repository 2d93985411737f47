"""A photograph on arrival that is rather another heliostat's: warned of over REST, on pages and as
an alarm.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import URL

from model.errors import UnreachableError
from service.base.errors import BusyError
from service.base.settings import Settings
from service.twin.calibration import calibrate_store, store_mounts
from service.twin.photographs.likeness import CANDIDATES, find_like, is_suspicious
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    metadata_of,
    png,
    poster,
    properties_document,
    sun_at,
    tower_document,
)
from tests.service.spots import photographs

HTML = {"Accept": "text/html"}


@pytest.mark.parametrize(
    ("accuracy", "usual", "suspicious"),
    [
        (0.62, 0.87, True),
        (0.83, 0.87, False),
        (0.62, 0.64, False),
        (0.62, None, True),
        (0.91, None, False),
    ],
)
def test_what_is_clearly_below_the_usual_is_suspicious(
    accuracy: float, usual: float | None, suspicious: bool
):
    assert is_suspicious(accuracy, usual) == suspicious


@pytest.mark.parametrize(
    ("others", "like"),
    [
        ({"AC43": 0.91, "AA39": 0.80}, "AC43"),
        ({"AC43": 0.71}, None),  # by less than the margin
        ({"AC43": 0.74}, None),  # which fits no better than any mirror
        ({}, None),
    ],
)
def test_only_what_fits_much_better_is_named(others: dict[str, float], like: str | None):
    assert find_like(0.62, others) == like


@dataclass
class Likenesses(FakeOperations):
    """Forecasts whose accuracy is set by the heliostat's name, 1 otherwise; in ``failures``
    there is none.
    """

    accuracies: dict[str, float] = field(default_factory=dict)
    failures: dict[str, Exception] = field(default_factory=dict)
    compared: list[str] = field(default_factory=list)

    def render(self, heliostat: Any, observations: Any, z: Any, model: Any) -> Any:
        self.compared.append(heliostat.name)
        if heliostat.name in self.failures:
            raise self.failures[heliostat.name]
        right = super().render(heliostat, observations, z, model)
        share = (1 - self.accuracies.get(heliostat.name, 1.0)) / 2  # what is moved counts twice
        wrong = np.zeros_like(right)
        wrong[:, 0, 0] = 100
        return (1 - share) * right + share * wrong


@pytest.fixture
def fitting() -> Likenesses:
    return Likenesses()


@pytest.fixture
def field_of_twelve(store_url: URL, tmp_path: Path, fitting: Likenesses) -> Iterator[TestClient]:
    """Heliostats in a row, each with a surface but for the last; on each of the two databases."""
    address = store_url.render_as_string(hide_password=False)
    settings = Settings(data_dir=tmp_path / "data", database_url=address, **QUIET)
    with client_of(create_app(settings, fitting)) as client:
        assert client.put("/v1/plant", json=tower_document()).status_code == 200
        for number in range(12):
            properties = properties_document()
            properties["heliostat_position"][1] += 1e-4 * number
            name = f"H{number:02d}"
            assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
            post(client, name, 100 + number, taken_at=f"2024-05-{number + 1:02d}T12:00:00Z")
            if number < 11:
                made = client.post(f"/v1/heliostats/{name}/surfaces", json={"method": "network"})
                assert made.status_code == 201, made.text
        fitting.compared.clear()
        yield client


def post(client: TestClient, heliostat: str, seed: int, **changes: Any) -> dict[str, Any]:
    changes = {"taken_at": "2024-06-01T12:00:00Z", "id": f"{seed}"} | changes
    answer = poster(client)(png(seed), heliostat, **changes)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def unlike(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [warning for warning in document["warnings"] if warning["type"] == "unlike_heliostat"]


def test_a_photograph_that_fits_its_heliostat_costs_nothing_more(
    field_of_twelve: TestClient, fitting: Likenesses
):
    assert unlike(post(field_of_twelve, "H00", 1)) == []
    assert fitting.compared == ["H00"]


def test_a_photograph_that_fits_another_heliostat_is_warned_of(
    field_of_twelve: TestClient, fitting: Likenesses
):
    client = field_of_twelve
    fitting.accuracies = {f"H{number:02d}": 0.6 for number in range(12)} | {"H02": 0.9}
    fitting.failures = {"H01": UnreachableError("the target lies behind the mirror")}
    (warning,) = unlike(post(client, "H00", 1))
    assert warning["like"] == "H02"
    assert warning["detail"] == "unlike H00, like H02 (accuracy 0.60 against 0.90)"
    assert fitting.compared[0] == "H00"
    # The last that were photographed, H11 has no surface, and the nearest.
    assert {*fitting.compared[1:]} == {"H10", "H09", "H08", "H07", "H01", "H02", "H03", "H04"}
    assert len(fitting.compared[1:]) == CANDIDATES
    page = client.get("/heliostats/H00/photographs/1", headers=HTML).text
    assert "unlike H00, like H02 (accuracy 0.60 against 0.90)" in page
    assert 'href="/heliostats/H02"' in page
    listed = client.get("/photographs?warned=true&heliostat=H00", headers=HTML).text
    assert "like H02" in listed
    (item,) = client.get("/v1/alarms?reason=unlike_heliostat").json()["items"]
    assert item["message"] == "1 measurement that another heliostat explains much better"


def test_motors_that_fit_another_heliostat_name_it(
    field_of_twelve: TestClient, fitting: Likenesses
):
    """No surface fits much better, but the motors direct the light of another one to the spot."""
    client, taken = field_of_twelve, dict[str, list[dict[str, Any]]]()
    for number, name in ((2, "H02"), (4, "H04")):
        properties = properties_document()
        properties["heliostat_position"][1] += 1e-4 * number
        taken[name] = photographs(tower_document(), properties)
        for place, one in enumerate(taken[name][:14]):
            dated = {"taken_at": f"2024-05-{place + 13:02d}T11:00:00Z", "id": f"{name}-{place}"}
            post(client, name, 100 * number + place, **one | dated)
    runtime: Runtime = client.app.state.runtime  # type: ignore[attr-defined]
    done = calibrate_store(runtime, list(taken))
    with runtime.database.writing() as session:
        assert store_mounts(session, done).keys() == taken.keys()
    fitting.accuracies = {f"H{number:02d}": 0.6 for number in range(12)}
    later = {"taken_at": "2024-06-02T12:00:00Z"}
    own, others = (taken[name][15] | later for name in ("H02", "H04"))
    assert unlike(post(client, "H02", 300, **own | {"id": "own"})) == []
    (warning,) = unlike(post(client, "H02", 301, **others | {"id": "others"}))
    assert warning["detail"] == "unlike H02, like H04: its motors fit that one"


def test_the_warning_holds_until_sun_or_target_change(
    field_of_twelve: TestClient, fitting: Likenesses
):
    client = field_of_twelve
    fitting.accuracies = {"H00": 0.6}
    assert unlike(post(client, "H00", 1))
    path = "/v1/heliostats/H00/measurements/1"
    for change, is_warned in (
        ({"temperature_c": 20.0}, True),
        ({"taken_at": "2024-06-02T12:00:00Z"}, True),
    ):
        client.patch(path, json=change | {"reason": "log"})
        assert bool(unlike(client.get(path).json())) == is_warned
    client.patch(path, json={"sun": sun_at(159.0), "reason": "typing"})
    assert unlike(client.get(path).json()) == []
    assert client.get("/v1/alarms?reason=unlike_heliostat").json()["items"] == []


@pytest.mark.full
def test_a_heliostat_that_is_usually_forecast_badly_is_not_warned_of(
    field_of_twelve: TestClient, fitting: Likenesses
):
    fitting.accuracies = {"H00": 0.6}
    for number in range(5):
        assert unlike(
            post(field_of_twelve, "H00", number, taken_at=f"2024-06-0{number + 1}T12:00:00Z")
        )
    fitting.compared.clear()
    assert unlike(post(field_of_twelve, "H00", 9)) == []
    assert fitting.compared == ["H00"]


@pytest.mark.parametrize("failure", [BusyError("others are first"), ZeroDivisionError()])
def test_a_photograph_is_stored_if_the_comparison_fails(
    field_of_twelve: TestClient, fitting: Likenesses, failure: Exception
):
    fitting.accuracies = {"H00": 0.6}
    fitting.failures = {"H01": failure}
    assert unlike(post(field_of_twelve, "H00", 1)) == []


def test_undated_photographs_are_compared_too(field_of_twelve: TestClient, fitting: Likenesses):
    fitting.accuracies = {"H00": 0.6}
    assert unlike(post(field_of_twelve, "H00", 1, taken_at=None))
    assert "H10" in fitting.compared


def test_without_other_surfaces_there_is_nothing_to_compare(
    client: TestClient, operations: FakeOperations
):
    poster(client)(png(1), id="1")
    client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
    assert poster(client)(png(2), id="2").json()["warnings"] == []


# --- real photographs
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ["100809", "149576", "186792"])
def test_a_real_photograph_of_another_heliostat_is_warned_of(
    real_client: TestClient, stj: Path, number: str
):
    """Sent for its own heliostat first, then for the other one."""
    folder = stj.parent / "stj-years" / "AA39" / "Calibration"
    if not folder.is_dir():
        pytest.skip(f"no real photographs at {folder}")
    properties = json.loads((folder / f"{number}-calibration-properties.json").read_text())
    document = json.dumps(
        metadata_of(properties) | {"kind": "cropped", "force": True, "reason": "for a test"}
    )
    image = (folder / f"{number}-cropped.png").read_bytes()

    def send(heliostat: str) -> list[dict[str, Any]]:
        parts = {"image": ("spot.png", image, "image/png"), "metadata": (None, document)}
        answer = real_client.post(f"/v1/heliostats/{heliostat}/measurements", files=parts)
        assert (answer.status_code, answer.json()["accepted"]) == (201, True), answer.text
        return unlike(answer.json())

    assert send("AA39") == []
    (warning,) = send("AC43")
    assert warning["like"] == "AA39"
