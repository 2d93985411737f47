"""Charts of a store that the product filled, in a real browser: hover, zoom, and without scripts."""

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
    MENUS,
    PHONE,
    SCROLLING,
    GatedOperations,
    Served,
    expect,
    violations,
)
from tests.service.conftest import free_port, serving

MOVED = "BF17"
"""A heliostat with motors and spots over three years."""
DAY = {
    "name": "June",
    "target": "receiver",
    "first_at": "2026-06-21T08:00:00Z",
    "last_at": "2026-06-21T14:00:00Z",
    "step_minutes": 120,
    "allowed_w_m2": 500.0,
    "resolution": [16, 16],
}
TIME = re.compile(r"2026-06-21 1[0-6]:\d\d")


@pytest.fixture(scope="module")
def served(
    real_store: Path, stj_pointing: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Served]:
    """The real store with a calibrated heliostat and a plan that exceeds its limit."""
    folder = Path(shutil.copytree(real_store, tmp_path_factory.mktemp("plotted") / "real"))
    motors = folder / "import" / "motors"
    shutil.copytree(stj_pointing / MOVED, motors / MOVED)
    shutil.copy(next(stj_pointing.glob("*tower-measurements.json")), motors)
    zone = {"time_zone": "Europe/Berlin"}
    with real.client_on(folder, **zone) as client:
        real.run_job(client, "/v1/jobs/imports", folder="motors")
        real.run_job(client, "/v1/jobs/calibrations", heliostats=[MOVED])
        receivers = [one["name"] for one in client.get("/v1/targets").json()["items"]]
        real.run_job(client, "/v1/jobs/plans", **DAY | {"target": receivers[-1]})
    settings = real.settings_of(folder, port=free_port(), **zone)
    app = create_app(settings)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, GatedOperations())


def plan_path(page: Any) -> str:
    page.goto("/plans")
    return str(page.locator("#plans tbody a").first.get_attribute("href"))


def middle(page: Any, place: int, share: float = 0.5) -> tuple[float, float]:
    """A point of a plot, at a share of its width."""
    over = page.locator(".plot .u-over").nth(place)
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    return box["x"] + share * box["width"], box["y"] + 0.7 * box["height"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_values_are_read_and_times_enlarged_on_all_charts(
    page: Any, scheme: str, size: dict[str, int]
):
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size(size)
    page.goto(plan_path(page))
    legends = page.locator(".plot .u-legend")
    expect(legends).to_have_count(3)
    expect(page.locator(".timeline > svg").first).to_be_hidden()
    page.mouse.move(*middle(page, 1))
    for place, words in enumerate((r"kW\b", r"kW/m² ▲ .* % beyond the limit", "%")):
        expect(legends.nth(place)).to_contain_text(TIME)
        expect(legends.nth(place)).to_contain_text(re.compile(words))
    zoomed = page.locator(".zoomed:not([hidden]) output")
    expect(zoomed).to_have_count(0)
    page.mouse.down()
    page.mouse.move(*middle(page, 1, 0.7), steps=4)
    page.mouse.up()
    expect(zoomed).to_have_count(3)
    assert len(set(zoomed.all_inner_texts())) == 1
    assert violations(page, runOnly=["wcag2a", "wcag2aa"]) == []
    page.mouse.dblclick(*middle(page, 0))
    expect(zoomed).to_have_count(0)
    page.mouse.move(1, 1)
    expect(legends.nth(2)).not_to_contain_text(TIME)
    # By keyboard.
    page.locator(".plot").first.focus()
    page.keyboard.press("ArrowRight")
    expect(legends.nth(2)).to_contain_text("2026-06-21 10:00")
    page.keyboard.press("+")
    expect(zoomed).to_have_count(3)
    page.locator("text=Whole time >> visible=true").first.click()
    expect(zoomed).to_have_count(0)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_exceeded_plan_says_so_in_words(page: Any):
    page.goto(plan_path(page))
    expect(page.locator("main")).to_contain_text("exceeds the limit of 0.500 kW/m² at 4 of 4 times")
    expect(page.locator("#series .beyond >> text=exceeds by")).to_have_count(4)


def test_tables_of_a_calibrated_field_and_its_plan_fit_a_desk(page: Any):
    for path in (
        plan_path(page),
        "/",
        "/?metric=pointing_error_mrad&sort=misfit",
        "/?sort=refused",
    ):
        page.goto(path)
        expect(page.locator("main")).not_to_contain_text("being computed")
        assert page.evaluate(SCROLLING) == [], path
        assert page.evaluate(MENUS) == [], path


def test_pointing_errors_over_years_have_their_limit(page: Any):
    page.goto(f"/heliostats/{MOVED}")
    chart = page.locator(".timeline", has_text="Pointing error")
    expect(chart.locator(".limit")).to_be_attached()
    page.mouse.move(*middle(page, 0))
    expect(chart.locator(".u-legend")).to_contain_text(
        re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d.*mrad")
    )


def test_photographs_of_unknown_time_are_not_drawn(page: Any):
    page.goto("/heliostats/AA39")
    chart = page.locator(".timeline", has_text="Forecast accuracy")
    expect(chart).to_contain_text("Time unknown, so not drawn")
    expect(chart.locator("svg")).to_have_count(0)
    chart.locator("summary").first.click()
    expect(chart.locator("tbody th").first).to_have_text("time unknown")


def test_charts_are_legible_without_scripts(browser: Any, served: Served):
    context = browser.new_context(base_url=served.address, java_script_enabled=False)
    page = context.new_page()
    page.goto(plan_path(page))
    expect(page.locator(".timeline > svg")).to_have_count(3)
    expect(page.locator(".timeline > svg").nth(1)).to_be_visible()
    expect(page.locator(".timeline > svg").nth(1)).to_contain_text("limit 0.5 kW/m²")
    expect(page.locator(".plot")).to_have_count(0)
    page.locator(".timeline > details > summary").nth(1).click()
    expect(page.locator(".timeline tbody tr >> visible=true")).to_have_count(4)
    context.close()
