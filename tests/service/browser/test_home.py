"""The home page, the menu and the search in a real browser, at a desk and on a phone."""

import re
from collections.abc import Iterator
from typing import Any

import pytest

from service.base.settings import Settings
from service.web.app import create_app
from tests.service.browser.browsing import DESK, PHONE, GatedOperations, Served, expect, violations
from tests.service.browser.test_shift import AXE, TOO_WIDE, fill
from tests.service.conftest import QUIET, FakeOperations, free_port, serving


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("home")
    settings = Settings(data_dir=folder, port=free_port(), alarm_photograph_days=1e-6, **QUIET)
    fill(create_app(settings, FakeOperations()))
    operations = GatedOperations()
    app = create_app(settings, operations)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, operations)


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_menu_and_search(page: Any, size: dict[str, int], scheme: str):
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme)
    page.goto("/")
    assert page.evaluate(TOO_WIDE) <= 0
    expect(page.locator("nav .count")).to_be_visible()
    header = page.locator("header.top")
    assert header.bounding_box()["height"] <= 0.08 * size["height"]
    menu = page.locator("nav >> text=Plant")
    if size is PHONE:
        expect(menu).to_be_hidden()
        page.click("text=Menu")
    expect(menu).to_be_visible()
    assert violations(page, **AXE) == []
    # What is typed is offered, and leads to the heliostat.
    page.locator("[name=find]").press_sequentially("aa")
    expect(page.locator("#named option")).to_have_count(1)
    with page.expect_navigation():
        page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("Heliostat AA39")


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_map_is_beside_the_table(page: Any, size: dict[str, int], scheme: str):
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme)
    page.goto("/?period=7&metric=deviation_mm")
    expect(page.locator('[data-map] [fill^="var("]')).to_be_attached()
    field, table = (
        page.locator(f"section[aria-labelledby={name}]").bounding_box()
        for name in ("map-title", "table-title")
    )
    if size is DESK:
        assert field["x"] + field["width"] <= table["x"]
        assert abs(field["y"] - table["y"]) < 2
    else:
        assert field["y"] + field["height"] <= table["y"]
    assert page.evaluate(TOO_WIDE) <= 0
    assert violations(page, **AXE) == []
    page.select_option("#show", "surface")
    expect(page).to_have_url(re.compile("show=surface&period=7"))
    with page.expect_navigation():
        page.click("text=90 days")
    expect(page.locator("#state [aria-current]")).to_have_text("90\N{NO-BREAK SPACE}days")
    expect(page.locator("#show")).to_have_value("surface")
