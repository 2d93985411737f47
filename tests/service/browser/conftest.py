"""One browser for all tests of this package, and fresh windows of it."""

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    """Not of the session: while its driver runs, nothing else can run an event loop here."""
    from tests.service.browser.browsing import CHROMIUM, FLAGS, playwright

    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium, or set HELIOTWIN_TEST_CHROMIUM")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def page(browser: Any, served: Any) -> Iterator[Any]:
    """A fresh browser window on the module's service; at the end nothing went elsewhere, and no
    policy was broken.
    """
    from tests.service.browser.browsing import DESK

    context = browser.new_context(base_url=served.address, viewport=DESK)
    context.set_default_timeout(120_000)
    opened, elsewhere, complaints = context.new_page(), [], []
    context.on(
        "request",
        lambda r: None if r.url.startswith((served.address, "data:")) else elsewhere.append(r.url),
    )
    opened.on(
        "console",
        lambda message: complaints.append(message.text) if message.type == "error" else None,
    )
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    yield opened
    context.close()
    assert not elsewhere
    # Refusals that a test provokes are answers with a status; anything else is a fault of the page.
    assert not [
        text
        for text in complaints
        if "status of 4" not in text and "Status Error Code 4" not in text
    ]
