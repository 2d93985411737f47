"""A study in a real browser, from its form to its adoption and back, with the real model on a store
that the product filled.
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.web.app import create_app
from tests.service import real
from tests.service.browser.browsing import (
    DESK,
    PHONE,
    GatedOperations,
    Served,
    expect,
    follow,
    violations,
)
from tests.service.conftest import free_port, serving


@pytest.fixture(scope="module")
def served(real_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The service with one worker on a copy of the real store."""
    folder = Path(shutil.copytree(real_store, tmp_path_factory.mktemp("studied") / "real"))
    settings = real.settings_of(folder, port=free_port(), job_workers=1, job_poll_s=0.05)
    app = create_app(settings)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, GatedOperations())


def require_readable(page: Any) -> None:
    """No rule of axe-core is broken, and the page does not scroll sideways."""
    assert not violations(page), page.url
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= page.viewport_size["width"], page.url


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_study_from_the_form_to_its_adoption_and_back(page: Any, size: Any, scheme: str):
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme)
    page.goto("/studies")
    follow(page, "text=New study")
    page.fill("input[name=heliostats]", "AA39, AC*")
    for box in page.locator("input[name=candidates]").all():
        box.set_checked(box.get_attribute("value") in real.CANDIDATES)
    cost = page.locator("#cost")  # scripts compute it after each change
    expect(cost).to_contain_text(re.compile(r"Effects to try\s*2"))
    follow(page, "text=Compute cost")
    expect(cost).to_contain_text(re.compile(r"Photographs\s*11"))
    expect(cost).to_contain_text(re.compile(r"Effects to try\s*2"))
    require_readable(page)

    follow(page, "text=Start study")
    expect(page.locator("main .state.done").first).to_be_visible()
    require_readable(page)
    follow(page, "main a[href^='/studies/']")
    study = page.url.rpartition("/")[2]
    expect(page.locator("#verdict-title")).to_contain_text("effect found")
    expect(page.locator("main")).to_contain_text("61% of the error beyond noise is unexplained")
    require_readable(page)

    follow(page, "text=Compute the change of 2 forecasts")
    expect(page.locator("h1")).to_contain_text("What adopting camera shoulder would change")
    expect(page.locator("#changes")).to_contain_text("AC43")
    require_readable(page)
    page.click("button:has-text('Adopt')")  # the browser asks for the tick
    assert page.url.endswith("/change")
    page.check("text=I have read this")
    page.fill("input[name=reason]", "the camera's data sheet says so")
    follow(page, "button:has-text('Adopt')")
    expect(page.locator("main")).to_contain_text("by local: the camera's data sheet says so")
    require_readable(page)

    page.goto("/studies")
    row = page.locator(f"#studies tr:has(th a[href='/studies/{study}'])")
    expect(row).to_contain_text("active")
    row.locator("summary:has-text('Withdraw')").click()
    require_readable(page)
    row.locator("input[name=reason]").fill("the data sheet is of another camera")
    with page.expect_navigation():
        row.locator("button:has-text('Withdraw')").click()
    expect(row).to_contain_text("withdrawn")
    expect(row.locator("summary")).to_contain_text("Adopt again")
    expect(page.locator("#models")).to_contain_text("the data sheet is of another camera")
    expect(page.locator("main")).to_contain_text("the declared model, without further effects")
    require_readable(page)
