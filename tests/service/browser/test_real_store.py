"""A store that the product filled, in a real browser: adopt and withdraw a study; names of buttons
and links.
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
    MENUS,
    SCROLLING,
    GatedOperations,
    Served,
    expect,
    follow,
    violations,
)
from tests.service.conftest import free_port, serving


@pytest.fixture(scope="module")
def served(real_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The service, with the real model, on a copy of the real store; a job waits to be
    cancelled.
    """
    folder = Path(shutil.copytree(real_store, tmp_path_factory.mktemp("browsed") / "real"))
    settings = real.settings_of(folder, port=free_port())
    with real.client_on(folder) as client:
        assert client.post("/v1/jobs/predictions", json={}).status_code == 202
    app = create_app(settings)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, GatedOperations())


def test_operator_adopts_what_a_study_found_and_withdraws_it(page: Any):
    page.goto("/studies")
    follow(page, 'a[href="/studies/1"]')
    expect(page.locator("#verdict-title")).to_contain_text("effect found")
    page.check("text=I have read this")
    page.fill("input[name=reason]", "the camera is known")
    follow(page, "button:has-text('Adopt')")
    expect(page.locator("#verdict-title .state.done")).to_have_text("adopted")
    with page.expect_download() as csv:
        page.locator("summary").click()
        page.click('a[href*="table=parameters"]')
    assert "camera shoulder" in csv.value.path().read_text(encoding="utf-8")
    follow(page, "button:has-text('Withdraw it')")
    expect(page.locator("#verdict-title .state.done")).to_have_count(0)
    expect(page.locator("button:has-text('Adopt')")).to_be_visible()


# The page of a report runs no scripts. Lists elements with an explicit accessible name: the name
# and the visible text (WCAG 2.2, 2.5.3: the name contains the text).
MISNAMED = """() => {
    const plain = (text) => text.toLowerCase().replace(/\\s+/g, " ").trim();
    return [...document.querySelectorAll("a, button, summary, input, select, textarea, [role=button], [role=link]")]
        .filter((e) => e.hasAttribute("aria-label"))
        .map((e) => [e.getAttribute("aria-label"), e.labels?.[0]?.innerText ?? e.innerText ?? e.textContent])
        .filter(([name, text]) => !plain(name).includes(plain(text)));
}"""
PAGES = """() => [...document.querySelectorAll("a[href^='/']")].map((a) => a.getAttribute("href").split("#")[0])
    .filter((path) => !/^\\/(v1|docs)|[.]csv|report$|table=|figure=|format=/.test(path))"""


def test_names_contain_what_is_written_and_tables_fit_a_desk(page: Any):
    """On a page of every kind that links lead to; a panel has one menu of exports."""
    waiting, seen, misnamed = ["/"], {"/"}, {}
    while waiting:
        path = waiting.pop(0)
        page.goto(path)
        found = page.evaluate(MISNAMED)
        found += violations(page, runOnly=["label-content-name-mismatch"])
        found += page.evaluate(SCROLLING) + page.evaluate(MENUS)
        if found:
            misnamed[path] = found
        for link in page.evaluate(PAGES):
            kind = re.sub(r"\d+", "1", re.sub(r"=[^&]*", "", link))
            if kind not in seen:
                seen.add(kind)
                waiting.append(link)
    assert not misnamed
    assert len(seen) > 20
