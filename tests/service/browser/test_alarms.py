"""A storm of 200 alarms in a real browser, on a desk and on a phone."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.service.browser.browsing import DESK, PHONE, SCROLLING, expect, follow, violations
from tests.service.browser.test_shift import AXE, TOO_WIDE
from tests.service.conftest import free_port, serving
from tests.service.storm import CLOCK, UNDATED, make_storm, storm_app

TRUNCATED = """() => [...document.querySelectorAll("select")].filter((one) => {
  const free = one.cloneNode(true);
  free.style.cssText = "position: absolute; width: max-content; max-width: none";
  one.after(free);
  const is_wider = free.offsetWidth > one.offsetWidth + 1;
  free.remove();
  return is_wider;
}).map((one) => one.name)"""
"""Names of the selections that are too narrow for their longest option."""


@pytest.fixture(scope="module")
def storm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service with the storm."""
    folder = tmp_path_factory.mktemp("storm")
    port = free_port()
    make_storm(storm_app(folder, port=port), folder)
    with serving(storm_app(folder, port=port), port, ws="none") as address:
        yield address


@pytest.mark.parametrize(
    ("size", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk-light", "phone-dark"]
)
def test_operator_reduces_a_storm_to_its_causes(
    browser: Any, storm: str, size: dict[str, int], scheme: str
):
    context = browser.new_context(base_url=storm, viewport=size, color_scheme=scheme)
    page = context.new_page()

    def check() -> None:
        assert page.evaluate(TOO_WIDE) <= 0
        assert page.evaluate(TRUNCATED) == []
        assert violations(page, **AXE) == []

    def acknowledge(why: str, words: str = "") -> None:
        page.select_option("[name=why]", why)
        page.fill("[name=words]", words)
        follow(page, ".acknowledging button")

    page.goto("/alarms")
    expect(page.locator("#causes-title")).to_have_text(
        "2 probable causes of 199 alarms, and 1 other"
    )
    expect(page.locator("#cause-1")).to_contain_text(f"{CLOCK} heliostats since")
    expect(page.locator("#reason-times_unknown")).to_have_text(
        f"Times unknown: {UNDATED} heliostats"
    )
    check()
    # The storm's cause is acknowledged as one, undone, and acknowledged again.
    page.locator("[name=groups]").first.check()
    acknowledge("Work is ordered", "the clock is being set")
    expect(page.locator(".done")).to_contain_text(
        f"{CLOCK} acknowledged by local: Work is ordered: the clock is being set"
    )
    expect(page.locator("#causes-title")).to_have_text("1 probable cause of 12 alarms, and 1 other")
    check()
    follow(page, ".done button")
    expect(page.locator("#causes-title")).to_contain_text("2 probable causes of 199 alarms")
    page.locator("[name=groups]").first.check()
    acknowledge("Other", "the clock of the camera")
    # All of a reason, and a single alarm.
    page.check("text=Tick all 12: times unknown")
    page.locator("[name=ids][value^='plant:queue']").check()
    acknowledge("Known; it can wait")
    expect(page.locator("#alarms")).to_contain_text("Nothing.")
    expect(page.locator("nav .count")).to_have_count(0)
    # Later it is undone from the history.
    follow(page, "text=History >> nth=-1")
    expect(page.locator("#alarms tbody tr")).to_have_count(100)
    assert page.evaluate(SCROLLING) == []
    check()
    for _ in range(2):
        follow(page, "#acknowledgements button >> nth=0")
    expect(page.locator("#acknowledgements button")).to_have_count(0)
    page.goto("/alarms")
    expect(page.locator("#causes-title")).to_contain_text("of 199 alarms")
    context.close()
