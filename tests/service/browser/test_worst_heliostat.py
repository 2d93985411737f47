"""From the worst heliostat on the home page to a promoted surface, in at most six clicks."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.web.app import create_app
from tests.service import real
from tests.service.browser.browsing import DESK, PHONE, GatedOperations, Served, expect, violations
from tests.service.browser.test_shift import AXE, LOW, TOO_WIDE
from tests.service.conftest import free_port, serving
from tests.service.twin.test_causes import add_photographs, lay_out, veil

PHOTOGRAPHS = ("216977", "217678", "218385", "219380", "219655", "220321")
VEILED = ("217678", "218385")
LIMIT = 0.91


@pytest.fixture
def served(stj: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The service, with the real model and a worker, on a store imported from a folder.

    It has two heliostats. Haze lies on two of the six photographs of AA39.
    """
    years = stj.parent / "stj-years"
    if not years.is_dir():
        pytest.skip(f"no photographs of years at {years}")
    folder = tmp_path_factory.mktemp("worst")
    plant = folder / "import" / "plant"
    lay_out(stj, plant)
    shutil.copytree(stj / "AC43", plant / "AC43")
    for image in add_photographs(years, plant, PHOTOGRAPHS):
        if image.name.startswith(VEILED):
            veil(image, 0.8)
    changes = {"alarm_accuracy": LIMIT, "port": free_port()}
    with real.client_on(folder, **changes) as client:
        real.run_job(client, "/v1/jobs/imports", folder="plant")
    settings = real.settings_of(folder, job_workers=1, **changes)
    app = create_app(settings)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, GatedOperations())


class Clicks:
    """Counts the clicks on a page; each waits for what it leads to."""

    def __init__(self, page: Any) -> None:
        self.page, self.count = page, 0

    def follow(self, selector: str) -> None:
        """Click a link or button, and wait for the page that it leads to."""
        with self.page.expect_navigation():
            self.click(selector)

    def click(self, selector: str) -> None:
        """Click."""
        self.count += 1
        self.page.click(selector)

    def write(self, selector: str, text: str) -> None:
        """Click a field, and write into it."""
        self.click(selector)
        self.page.keyboard.type(text)


def check(page: Any) -> None:
    """The page has no fault of axe-core, does not scroll sideways, and meets a finger."""
    assert violations(page, **AXE) == [], page.url
    assert page.evaluate(TOO_WIDE) <= 0, page.url
    if page.viewport_size == PHONE:
        assert page.evaluate(LOW) == [], page.url


@pytest.mark.parametrize(
    ("size", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk-light", "phone-dark"]
)
def test_worst_heliostat_gets_a_promoted_surface_in_six_clicks(
    page: Any, size: dict[str, int], scheme: str
):
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
    clicks = Clicks(page)
    page.goto("/")
    worst = "dl.tiles small a[href='/heliostats/AA39']"
    expect(page.locator(worst)).to_be_visible()
    clicks.follow(worst)
    expect(page.locator("#causes-title")).to_have_text("Why is it bad")
    expect(page.locator("ol.causes li").first).to_contain_text(
        "2 photographs of 6 contradict the others"
    )
    chosen = page.locator("[name=photographs]:checked")
    assert sorted(one.get_attribute("value") for one in chosen.all()) == sorted(VEILED)
    check(page)
    clicks.write("section:has(#outliers-title) [name=reason]", "haze")
    clicks.follow("text=Exclude, and predict again")
    expect(page.locator("#phase")).to_contain_text("fitting the surface to 4 images")
    expect(page.locator("#phase")).to_contain_text("left")
    expect(page.locator("progress")).not_to_have_attribute("value", "0.0")
    expect(page.locator("#progress-title")).to_have_text("done")  # without a reload
    expect(page.locator("a >> text=Compare and decide")).to_be_visible()
    check(page)
    clicks.follow("a >> text=Compare and decide")
    expect(page.locator("#decide-title")).to_have_text("Candidate 2 or version 1")
    expect(page.locator("section:has(#decide-title) figure")).to_have_count(3)
    check(page)
    clicks.write("form[action$='/take'] [name=reason] >> nth=0", "made from clear photographs")
    clicks.follow("text=Promote candidate 2")
    active = page.locator("tr:has(.state.done) th", has_text="active")
    expect(active).to_contain_text("2 active")
    assert clicks.count <= 6
    expect(page.locator(".decided").last).to_contain_text("Made from clear photographs")
    check(page)
    clicks.follow("text=Undo: back to version 1")
    expect(active).to_contain_text("1 active")
    excluded = page.locator("section:has(#excluded-title) li")
    expect(excluded).to_have_count(2)
    clicks.follow("section:has(#excluded-title) button >> nth=0")
    expect(excluded).to_have_count(1)
