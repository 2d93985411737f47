"""Facets in pictures: at their places and in their outlines, for mirrors of an imported plant."""

import io
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.plant import Heliostat
from model.surface import control_points
from service.drawing.facets import FacetPlaces
from service.sources.folder import read_folder
from service.sources.plant_file import read_plant
from service.twin.importing import import_folder
from tests.page import Page
from tests.service import real
from tests.service.sources.plant_files import write_plant
from tests.service.sources.plant_folder import write_plant_folder

HTML = {"Accept": "text/html"}


def rising(heliostat: Heliostat) -> np.ndarray:
    """A surface whose facets (F, 8, 8) [m] rise to the right, each a tenth of a millimetre more."""
    rise = 1e-4 * np.tile(np.linspace(-1, 1, 8)[:, None], (1, 8))
    return np.asarray(np.arange(1, 1 + len(heliostat.facets))[:, None, None] * rise)


def test_each_facet_is_drawn_where_it_lies(tmp_path: Path):
    """B1 has a rectangle, a polygon and a circle."""
    heliostat = read_plant(write_plant(tmp_path)).plant.heliostats["B1"]
    places = FacetPlaces.of(heliostat)
    np.testing.assert_allclose(places.box, [[-1.95, -1.0], [1.9, 3.8]], atol=2e-3)
    image = places.image(np.arange(1, 4)[:, None, None] * np.ones((5, 5)))
    (left, bottom), (right, top) = places.box.tolist()

    def shown(x: float, y: float) -> float:
        rows, columns = image.shape
        row, column = (top - y) / (top - bottom) * rows, (x - left) / (right - left) * columns
        return float(image[int(row), int(column)])

    assert [shown(-1, 0), shown(1.2, 0), shown(0, 3)] == [1, 2, 3]
    # Between facets, in a corner that the polygon leaves out, and beside the circle.
    assert np.isnan([shown(0, 0), shown(0.2, 0.9), shown(0.7, 3.7)]).all()
    pixel = (right - left) * (top - bottom) / image.size
    areas = [facet.area for facet in heliostat.facets]
    drawn = [float((image == number).sum()) * pixel for number in (1, 2, 3)]
    np.testing.assert_allclose(drawn, areas, rtol=0.03)


def test_a_turned_facet_keeps_its_width_and_height():
    """A facet of 2 m by 1 m, turned by 37 degrees."""
    along = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0]])
    i, j = np.meshgrid([-1.0, 1.0], [-0.5, 0.5], indexing="ij")
    points = i[..., None] * along[0] + j[..., None] * along[1]
    np.testing.assert_allclose(FacetPlaces.of_control_points(points[None]).sizes, [[2.0, 1.0]])


def test_heights_rise_as_they_do_on_the_facet(tmp_path: Path):
    """i runs along x to the right, and j along y upwards."""
    places = FacetPlaces.of(read_plant(write_plant(tmp_path)).plant.heliostats["A1"])
    rise = np.linspace(0, 1, 7)
    for heights, axis, sign in (
        (rise[:, None] + 0 * rise, 1, 1),
        (rise + 0 * rise[:, None], 0, -1),
    ):
        steps = sign * np.diff(places.image(np.tile(heights, (28, 1, 1))), axis=axis)
        assert np.nanmedian(steps) > 0


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A store with measured surfaces of 28 and of 3 facets."""
    root = tmp_path_factory.mktemp("facets")
    folder = write_plant_folder(root / "plant")
    for name, heliostat in read_folder(folder).plant.heliostats.items():
        place = folder / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
        place.parent.mkdir()
        np.savez(place, control_points=control_points(heliostat, rising(heliostat)))
    with real.client_on(root / "store") as client:
        import_folder(real.runtime_of(client), read_folder(folder))
        # A1's photographs are of another mirror, so its surface is a candidate until it is chosen.
        chosen = {"version": 1, "reason": "a test"}
        assert client.put("/v1/heliostats/A1/surfaces/current", json=chosen).status_code == 200
        yield client


@pytest.mark.full
@pytest.mark.parametrize(("name", "facets", "width"), [("A1", 28, 12.72), ("B1", 3, 3.85)])
def test_page_has_every_facet_in_its_outline(
    other: TestClient, name: str, facets: int, width: float
):
    page = Page(other.get(f"/heliostats/{name}", headers=HTML).text)
    assert len(page.all("svg", class_="figure")[0].all("polygon", class_="edge")) == facets
    space = json.loads(str(page.one("canvas")["data-surface"]))
    assert (len(space["facets"]), space["size"][0]) == (facets, pytest.approx(width, abs=1e-3))
    known = [height for row in space["facets"][-1]["heights"] for height in row]
    assert (None in known) == (name == "B1")  # the last is a circle
    maps = other.get(f"/heliostats/{name}?figure=deviation&format=npz").content
    with np.load(io.BytesIO(maps)) as read:
        np.testing.assert_allclose(np.nanmax(read["values"]), 0.1 * facets, rtol=0.05)
        assert read["size_m"][0] == pytest.approx(width, abs=1e-3)
    answer = other.get(f"/v1/heliostats/{name}/surfaces/1", headers={"Accept": "image/png"})
    assert cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR) is not None


@pytest.mark.full
def test_mirrors_of_other_facets_are_not_compared(other: TestClient):
    """One with another number of facets was an error of the server."""
    answer = other.get("/compare?heliostat=A1&other=B1")
    assert answer.status_code == 422
    assert "A1, version 1 has 28 facets, and B1, version 1 has 3" in answer.json()["detail"]
    page = other.get("/heliostats/A1", headers=HTML).text
    assert "/compare?heliostat=A1" not in page  # it has one surface
