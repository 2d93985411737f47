"""The home page, and what every page has: the menu, the search, and the banner."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from model.ephemeris import sun_angles_at
from service.base.settings import Settings
from service.drawing.templates import ASSETS
from service.store.columns import now
from service.twin.alarms.field_overview import HeliostatOverview
from service.twin.alarms.field_state import FieldAccuracy, field_accuracy
from service.twin.surfaces.accuracy import Rank
from service.web.app import create_app
from service.web.resources.field import STEPS
from tests.service.conftest import (
    ORIGIN,
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.web.pages import HTML, settled, text_of

NAMES = ("AA39", "AA3", "AB01")


@contextmanager
def field_in(folder: Path) -> Iterator[TestClient]:
    """A field of three heliostats without photographs."""
    settings = Settings(data_dir=folder, alarm_photograph_days=1e-9, **QUIET)
    with client_of(create_app(settings, FakeOperations())) as client:
        assert client.put("/v1/plant", json=tower_document()).status_code == 200
        for place, name in enumerate(NAMES):
            properties = properties_document()
            properties["heliostat_position"][0] += 3e-4 * place
            assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
        client.headers.update(HTML)
        yield client


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with field_in(tmp_path_factory.mktemp("home")) as client:
        yield client


@pytest.fixture(scope="module")
def photographed(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[TestClient, dict[int, datetime]]]:
    """The field with a surface and photographs of AA39, and their times by days ago."""
    with field_in(tmp_path_factory.mktemp("photographed")) as client:
        send, made = poster(client), {}
        for seed, days in enumerate((50, 45, 10)):
            at = (now() - timedelta(days=days)).replace(hour=11, minute=0)
            azimuth, elevation = sun_angles_at(at, ORIGIN)
            sun = {"azimuth_deg": azimuth, "elevation_deg": elevation}
            answer = send(png(seed), id=f"10{seed}", taken_at=at.isoformat(), sun=sun)
            assert answer.status_code == 201, answer.text
            made[days] = at
            if not seed:
                body = {"measurements": ["100"]}
                assert client.post("/v1/heliostats/AA39/surfaces", json=body).status_code == 201
        yield client, made


@pytest.mark.parametrize(
    ("typed", "path"),
    [
        ("AA39", "/heliostats/AA39"),
        (" aa3 ", "/heliostats/AA3"),  # a whole name, although another begins with it
        ("b0", "/heliostats/AB01"),  # the only one
        ("AA", "/?search=AA"),
        ("x", "/?search=x"),
        ("", "/"),
    ],
)
def test_search_leads_to_the_heliostat_or_to_those_that_match(
    home: TestClient, typed: str, path: str
):
    answer = home.get("/find", params={"find": typed}, follow_redirects=False)
    assert (answer.status_code, answer.headers["Location"]) == (303, path)


@pytest.mark.parametrize(("path", "status"), [("/", 200), ("/plant", 200), ("/nothing", 404)])
def test_every_page_has_alarms_first_search_and_a_banner(home: TestClient, path: str, status: int):
    page = text_of(home, path, status)
    first = page.one("nav", aria_label="Pages").all("a")[0]
    assert (first["href"], first.words.split()[0]) == ("/alarms", "Alarms")
    forms = [form["action"] for form in page.all("form", role="search")]
    assert forms.count("/find") == (2 if status == 404 else 1)
    banner = page.one("aside", class_="banner").words
    assert "everybody on this machine" in banner
    store = home.app.state.runtime.settings.store  # type: ignore[attr-defined]
    assert f"{store} heliotwin keys create NAME --role admin" in banner


def test_menu_has_the_count_of_alarms_without_scripts(home: TestClient):
    assert home.get("/alarms/count").text
    menu = text_of(home, "/").one("nav", aria_label="Pages")
    assert menu.one("span", class_="count").words == f"{len(NAMES)} not acknowledged"


# --- colours of the map
# --------------------------------------------------------------------------------------------------


def luminance(colour: str) -> float:
    """Relative luminance by WCAG 2.2."""
    values = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    red, green, blue = (
        one / 12.92 if one <= 0.04045 else ((one + 0.055) / 1.055) ** 2.4 for one in values
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_worse_is_more_conspicuous_on_the_map(scheme: int):
    style = ASSETS.joinpath("app.css").read_text()
    card = re.findall(r"--card: (#[0-9a-f]{6})", style)[scheme]
    contrasts = []
    for step in range(STEPS):
        colour = re.findall(rf"--s{step}: (#[0-9a-f]{{6}})", style)[scheme]
        low, high = sorted((luminance(colour), luminance(card)))
        contrasts.append((high + 0.05) / (low + 0.05))
    assert contrasts == sorted(contrasts)
    assert contrasts[0] >= 3
    assert contrasts[-1] >= 2 * contrasts[0]


# --- state of the field
# --------------------------------------------------------------------------------------------------


def test_accuracy_of_the_field():
    ranks = {"A": 0.9, "B": 0.7, "C": None, "D": 0.8, "E": 0.95, "F": 0.6, "G": 0.99}
    lines = [HeliostatOverview(name, 0, 0, rank=Rank(one, 1)) for name, one in ranks.items()]
    found = field_accuracy([*lines, HeliostatOverview("H", 0, 0)], 0.75)
    assert (found.evaluated, found.below) == (6, 2)
    assert found.mean == pytest.approx(0.8233, abs=1e-4)
    assert found.worst == [("F", 0.6), ("B", 0.7), ("D", 0.8), ("A", 0.9), ("E", 0.95)]
    assert field_accuracy([], 0.75) == FieldAccuracy(None, 0, 0, [])


def tile(client: TestClient, label: str, period: str = "30") -> str:
    """What a tile of the home page says."""
    tiles = settled(client, f"/?period={period}").all("div", class_="tile")
    (found,) = [one for one in tiles if one.words.startswith(label)]
    parts = [found.one("dd"), *found.all("small")]
    return ": ".join(one.words for one in parts).replace("\N{NO-BREAK SPACE}", " ")


def test_tiles_of_a_field_without_photographs(home: TestClient):
    assert tile(home, "Alarms").endswith(": 0 act now, 0 act today, 3 when there is time")
    assert tile(home, "Mean").endswith(": no photograph was forecast in 30 days")


def test_tiles_have_the_state_of_the_plant(photographed: tuple[TestClient, dict[int, datetime]]):
    home, made = photographed
    assert "100.0 % in 30 days, 100.0 % in those before" in tile(home, "Mean")
    assert "no photograph was forecast in 7 days" in tile(home, "Mean", "7")
    assert "in 90 days, nothing to compare before" in tile(home, "Mean", "90")
    assert "100.0 % of photographs as they came" in tile(home, "Mean", "all")
    assert "0 of 1 evaluated" in tile(home, "Below")
    assert tile(home, "Worst").endswith(": AA39 100.0 %")
    assert tile(home, "Last").startswith(f"{made[10]:%Y-%m-%d %H:%M} UTC")
    assert tile(home, "Jobs").endswith(": 0 waiting, 0 failed in 30 days")
    page = text_of(home, "/?period=7")
    assert "Updated 20" in page.one(id="state").words
    assert page.one("input", name="period")["value"] == "7"  # the filter keeps it


def test_comparison_with_one_surface_says_how_to_get_another(
    photographed: tuple[TestClient, dict[int, datetime]],
):
    home, _ = photographed
    page = text_of(home, "/compare?heliostat=AA39")
    assert "Heliostat AA39 has one surface only" in page.words
    assert "/jobs/start?heliostat=AA39" in page.links
    assert page.one("input", name="heliostat")["value"] == "AA39"
    text_of(home, "/compare?heliostat=AA3")  # one without a surface
    text_of(home, "/compare?heliostat=none", 404)


def test_pictures_are_links(photographed: tuple[TestClient, dict[int, datetime]]):
    home, _ = photographed
    for path in ("/heliostats/AA39/photographs/102", "/heliostats/AA39"):
        page = text_of(home, path)
        pictures = [one for one in page.all("img") if one.attributes.get("alt")]
        assert pictures
        for picture in pictures:
            assert picture.parent is not None
            assert picture.parent.tag == "a", picture.attributes
