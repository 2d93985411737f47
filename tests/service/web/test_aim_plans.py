"""The job `aim-plans` on an imported plant, and its page."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.sources.folder import read_folder
from service.sources.plant_tables import read_aims
from service.twin.transfer.importing import import_folder
from tests.page import Page
from tests.service import real
from tests.service.sources.aim_plant import write_aim_plant

BODY = {
    "target": "main",
    "sun": {"azimuth_deg": 180, "elevation_deg": 55},
    "dni_w_m2": 900,
    "limit_w_m2": 80e3,
}


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    root = tmp_path_factory.mktemp("plant")
    write_aim_plant(root / "plant")
    with real.client_on(root / "store") as client:
        import_folder(real.runtime_of(client), read_folder(root / "plant", whole_field=True))
        yield client


def planned(client: TestClient, **changes: Any) -> dict[str, Any]:
    """The job of a plan, when it has ended."""
    return real.done_job(client, "/v1/jobs/aim-plans", **BODY | changes)


def test_plan_keeps_the_limit_and_its_aims_do_what_it_says(plant: TestClient):
    job = planned(plant)
    result = job["result"]
    assert result["peak_p95_w_m2"] <= 1.002 * 80e3
    assert result["power_w"] > result["baseline"]["power_w"]
    assert result["power_w"] <= result["bound_w"] < 1.02 * result["power_w"]
    assert result["inactive"] == []
    aims = result["aim_points_m"]
    assert len(aims) == result["heliostats"] > 40
    body = {key: BODY[key] for key in ("target", "sun", "dni_w_m2")}
    body |= {"aim_points_m": aims, "resolution": [32, 80]}
    forecast = real.run_job(plant, "/v1/jobs/forecasts", **body)
    assert forecast["field"]["intercepted_w"] == pytest.approx(result["power_w"], rel=0.005)
    assert forecast["peak_w_m2"] == pytest.approx(result["peak_w_m2"], rel=0.03)


def test_page_shows_the_plan_and_gives_its_aims(plant: TestClient, tmp_path: Path):
    job = planned(plant)
    page = Page(plant.get(f"/jobs/{job['id']}", headers={"Accept": "text/html"}).text)
    for words in ("Most that any aims can give", "Peak in 95 % of draws", "not active", "Flux"):
        assert words in page.words
    (tmp_path / "aims.csv").write_text(plant.get(f"/jobs/{job['id']}/aims.csv").text)
    aims = read_aims(tmp_path / "aims.csv", job["result"]["aim_points_m"])
    assert {name: list(aim) for name, aim in aims.items() if aim is not None} == job["result"][
        "aim_points_m"
    ]


def test_plan_begins_with_aims_of_a_moment_before(plant: TestClient):
    first = planned(plant)["result"]
    again = planned(plant, aim_points_m=first["aim_points_m"])["result"]
    assert again["power_w"] > 0.995 * first["power_w"]
    assert again["peak_p95_w_m2"] <= 1.002 * 80e3


def test_limit_over_the_map(plant: TestClient):
    result = planned(plant, limit_w_m2=[[200e3, 200e3], [70e3, 70e3]])["result"]
    assert result["limit_w_m2"] == pytest.approx(200e3)
    assert result["largest_share_of_limit"] <= 1.002


@pytest.mark.parametrize("limit", [0, -1, [], [[100, 100], [100]], [[100, 0]], "high", 1e9])
def test_a_wrong_limit_is_refused_by_its_name(plant: TestClient, limit: object):
    answer = plant.post("/v1/jobs/aim-plans", json=BODY | {"limit_w_m2": limit})
    assert answer.status_code == 422
    assert any("limit_w_m2" in error["field"] for error in answer.json()["errors"])
