"""Pages of a store that an import of another plant filled: heliostats of 28 and of 3 facets."""

import csv
from collections.abc import Iterator

import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.surface import control_points
from service.sources.folder import read_folder
from service.twin.importing import import_folder
from tests.page import Page
from tests.service import real
from tests.service.sources.plant_folder import write_plant_folder
from tests.service.web.crawling import crawl

pytestmark = [pytest.mark.full]


@pytest.fixture(scope="module")
def other_plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A1 has a measured surface; that of B1 is predicted, and forecast."""
    root = tmp_path_factory.mktemp("other")
    folder = write_plant_folder(root / "plant")
    heliostat = read_folder(folder).plant.heliostats["A1"]
    z = np.random.default_rng(2).normal(0, 1e-4, (28, 8, 8))
    place = folder / "A1" / "Deflectometry" / "A1-nurbs-surface.npz"
    place.parent.mkdir()
    np.savez(place, control_points=control_points(heliostat, z))
    with real.client_on(root / "data") as client:
        import_folder(real.runtime_of(client), read_folder(folder))
        made = client.post("/v1/heliostats/B1/surfaces", json={"method": "network"})
        assert made.status_code == 201, made.text
        # No network knows its mirror.
        assert made.json()["source"] == "refined"
        for target in ("cal", "main"):
            asked = {"heliostat": "B1", "target": target, "sun": real.SUN}
            assert client.post("/v1/forecasts", json=asked).status_code == 201
        yield client


def test_every_page_and_every_file_on_it_answers(other_plant: TestClient):
    seen, refused = crawl(other_plant)
    assert {f"/heliostats/{name}" for name in ("A1", "B1")} < seen
    assert refused == {}


def test_page_has_the_mirrors_size_and_all_facets(other_plant: TestClient):
    page = Page(other_plant.get("/heliostats/A1", headers={"Accept": "text/html"}).text)
    assert "12.72" in page.words  # 7 facets of 1.8 m and the gaps between them
    table = other_plant.get("/heliostats/A1?figure=deviation&format=npz")
    assert table.status_code == 200


def test_page_of_the_plant_has_the_heliostat_types(other_plant: TestClient):
    page = Page(other_plant.get("/plant", headers={"Accept": "text/html"}).text)
    assert "28 of 1.8 × 1.35 m" in page.words
    assert "as in facets.csv" in page.words


_SQUARE = [[9, 9], [90, 9], [9, 90], [90, 90]]
_MATRIX = [[0.01, 0, -7], [0, -0.01, 7], [0, 0, 1]]
_POSE = {"position_m": [0, 90, 20], "look_at_m": [0, 5, 20], "field_of_view_deg": 20}


def test_page_of_the_plant_has_what_locates_targets(other_plant: TestClient):
    ways = {
        "L and T marks": {},
        "L brackets": {"marks": "l_brackets"},
        "edges": {"marks": "none"},
        "camera, by corners": {"camera": {"corners_px": _SQUARE}},
        "camera, by homography": {"camera": {"homography": _MATRIX}},
        "camera, by pose": {"camera": {"pose": _POSE}},
    }
    plane = {"center": [0, 5, 20], "normal": [0, 1, 0], "width": 8, "height": 8}
    for number, declared in enumerate(ways.values()):
        put = other_plant.put(f"/v1/targets/sheet-{number}", json={"plane": plane} | declared)
        assert put.status_code == 201, put.text
    page = other_plant.get("/plant?table=targets", headers={"Accept": "text/html"})
    rows = csv.DictReader(page.text.removeprefix("\ufeff").splitlines())
    shown = [row["Located by"] for row in rows if row["Target"].startswith("sheet")]
    assert shown == list(ways)
