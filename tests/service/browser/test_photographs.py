"""Photographs in a browser: reviewed by keys with undo, and a list that fits."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.web.app import create_app
from tests.service import real
from tests.service.browser.browsing import DESK, PHONE, GatedOperations, Served, expect, violations
from tests.service.browser.test_shift import AXE, LOW, TOO_WIDE
from tests.service.conftest import free_port, serving

WINDOWS = [
    pytest.param(DESK, "light", id="desk-light"),
    pytest.param(PHONE, "dark", id="phone-dark"),
]


@pytest.fixture
def served(real_copy: Path) -> Iterator[Served]:
    """A service with the real photographs of two heliostats."""
    settings = real.settings_of(real_copy, port=free_port())
    app = create_app(settings, GatedOperations())
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, app.state.runtime.operations)


@pytest.mark.parametrize(("size", "scheme"), WINDOWS)
def test_photographs_are_reviewed_by_keys_and_undone(page: Any, size: dict[str, int], scheme: str):
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
    page.goto("/photographs?heliostat=AA39")
    page.click("text=Review these")
    place, state = page.locator(".bar .note"), page.locator("#verdict-title")
    expect(place).to_have_text("1 of 9")
    first = page.locator("h1").inner_text()
    assert violations(page, **AXE) == []
    assert page.evaluate(TOO_WIDE) <= 0
    assert page.evaluate(LOW) == [] or size is DESK
    page.keyboard.press("r")
    page.keyboard.press("n")  # not on the target
    page.keyboard.press("Escape")
    page.keyboard.press("e")
    expect(place).to_have_text("2 of 9")
    expect(page.locator("[role=status]", has_text="was changed")).to_be_visible()
    page.keyboard.press("u")
    expect(page.locator("h1")).to_have_text(first)
    expect(state).to_have_text("used")
    page.keyboard.press("a")
    expect(place).to_have_text("2 of 9")
    page.keyboard.press("s")
    expect(place).to_have_text("3 of 9")
    page.keyboard.press("o")
    page.wait_for_url("**/heliostats/AA39/photographs/*")


@pytest.mark.parametrize(("size", "scheme"), WINDOWS)
def test_the_list_fits_and_shows_picture_and_verdict(page: Any, size: dict[str, int], scheme: str):
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
    for path in ("/photographs", "/heliostats/AA39"):
        page.goto(path)
        assert page.evaluate(TOO_WIDE) <= 0
        table = page.locator("#photographs")
        over = "e => e.closest('.scroll').scrollWidth - e.closest('.scroll').clientWidth"
        assert table.evaluate(over) <= 0, path
        row = table.locator("tbody tr").first
        for part in (".thumbnail", ".state"):
            box = row.locator(part).first.bounding_box()
            assert box is not None
            assert 0 <= box["x"] <= size["width"] - box["width"]
    assert violations(page, **AXE) == []
