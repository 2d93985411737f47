"""The home page, and what every page has: the menu, the search, and the banner."""

from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    properties_document,
    tower_document,
)
from tests.service.web.pages import HTML, text_of

NAMES = ("AA39", "AA3", "AB01")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    folder = tmp_path_factory.mktemp("home")
    settings = Settings(data_dir=folder, attention_photograph_days=1e-6, **QUIET)
    with client_of(create_app(settings, FakeOperations())) as client:
        assert client.put("/v1/plant", json=tower_document()).status_code == 200
        for place, name in enumerate(NAMES):
            properties = properties_document()
            properties["heliostat_position"][0] += 3e-4 * place
            assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
        client.headers.update(HTML)
        yield client


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
    assert (first["href"], first.words.split()[0]) == ("/attention", "Alarms")
    forms = [form["action"] for form in page.all("form", role="search")]
    assert forms.count("/find") == (2 if status == 404 else 1)
    assert "everybody on this machine" in page.one("aside", class_="banner").words


def test_menu_has_the_count_of_alarms_without_scripts(home: TestClient):
    assert home.get("/attention/count").text
    menu = text_of(home, "/").one("nav", aria_label="Pages")
    assert menu.one("span", class_="count").words == f"{len(NAMES)} not acknowledged"
