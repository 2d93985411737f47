"""What operators decide, in a real browser at a desk and on a phone: trust, correct, compare, find,
export, plan.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from model.imaging import MeasuredFlux
from service import store
from service.base.settings import Settings
from service.web.app import create_app
from tests.service.browser.browsing import DESK, PHONE, GatedOperations, Served, expect, follow
from tests.service.conftest import (
    QUIET,
    client_of,
    free_port,
    png,
    poster,
    properties_document,
    serving,
    sun_at,
    tower_document,
    until,
)
from tests.service.studies import SLOPE, study_row
from tests.service.web.pages import work

SIZES = pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])


class Operations(GatedOperations):
    """Finds the target of raw photographs; explains none under a sun in the east; forecasts too
    little on the left.
    """

    def measure(self, image: Any, kind: str, plane: Any, **more: Any) -> MeasuredFlux:
        made = super().measure(image, kind, plane, **more)
        if kind != "raw" or not made.quality.accepted:
            return made
        corners = np.array([[8.0, 8], [24, 8], [8, 24], [24, 24]])
        crop = np.full((256, 256), 99, np.uint8)
        return MeasuredFlux(
            made.quality, made.flux, made.centered, made.center_of_mass, 4.0, crop, corners
        )

    def predict(self, heliostat: Any, observations: Any, *rest: Any, **more: Any) -> Any:
        made = super().predict(heliostat, observations, *rest, **more)
        return replace(
            made, misfits=tuple(0.31 if one.sun[0] > 0.5 else 0.05 for one in observations)
        )

    def render(self, *arguments: Any, **options: Any) -> Any:
        forecast = super().render(*arguments, **options).copy()
        forecast[..., :32] *= 0.5
        return forecast


def fill(settings: Settings) -> None:
    app = create_app(settings, Operations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        for name in ("AA39", "AB01"):
            client.put(f"/v1/heliostats/{name}", json=properties_document())
        send = poster(client)
        for number in range(1, 4):
            sun = {"sun": sun_at(180 + 20.0 * number), "taken_at": f"2026-06-0{number}T11:30:00Z"}
            assert send(png(number), id=str(number), kind="raw", **sun).status_code == 201
        assert send(png(9, refused=True), id="9").status_code == 201
        for used in (["1"], ["1", "2"]):
            assert (
                client.post("/v1/heliostats/AA39/surfaces", json={"measurements": used}).status_code
                == 201
            )
        for number, azimuth in ((1, 180.0), (2, 90.0)):
            assert (
                send(png(20 + number), "AB01", id=str(number), sun=sun_at(azimuth)).status_code
                == 201
            )
        assert (
            client.post("/v1/heliostats/AB01/surfaces", json={"method": "refined"}).status_code
            == 201
        )
        sun = {"azimuth_deg": 200, "elevation_deg": 45}
        made = client.post("/v1/jobs/forecasts", json={"target": "lower", "sun": sun})
        assert made.status_code == 202
        work(app)
        with app.state.runtime.database.writing() as session:
            store.add_study(session, study_row(SLOPE))
            store.add_study(session, study_row(verdict="none"))


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("operators"), port=free_port(), **QUIET)
    fill(settings)
    operations = Operations()
    app = create_app(settings, operations)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, operations)


@pytest.fixture
def seen(page: Any, size: dict[str, int]) -> Any:
    page.set_viewport_size(size)
    return page


@SIZES
def test_active_surface_is_chosen_and_the_choice_undone(seen: Any):
    seen.goto("/heliostats/AA39")
    active = seen.locator("tr:has(.state.done) th", has_text="active")
    expect(active).to_have_text("2 active")
    follow(seen, "text=Make it active")
    expect(active).to_have_text("1 active")
    follow(seen, "text=Undo: back to version 2")
    expect(active).to_have_text("2 active")
    expect(seen.locator(".decided")).to_contain_text("in place of")


@SIZES
def test_what_is_not_trusted_nor_judged_says_so(seen: Any):
    seen.goto("/?show=flagged")
    expect(seen.locator("tbody th")).to_have_text(["AB01"])
    expect(seen.locator("tbody")).to_contain_text("not yet evaluated")
    follow(seen, "tbody th a")
    expect(seen.locator("#warnings-title")).to_contain_text("not trusted since")
    expect(seen.locator(".tiles")).to_contain_text("not yet evaluated")
    card = seen.locator("section:has(#warnings-title)")
    seen.fill("section:has(#warnings-title) [name=reason]", "a mirror of the old type")
    follow(seen, "section:has(#warnings-title) button")
    expect(card).to_contain_text("Acknowledged by local")
    expect(card).to_contain_text("a mirror of the old type")
    follow(seen, "section:has(#warnings-title) >> text=Undo")
    expect(card).not_to_contain_text("Acknowledged")


@SIZES
def test_photograph_is_found_looked_at_and_corrected(seen: Any, size: dict[str, int]):
    seen.goto("/")
    if size is PHONE:
        seen.click("text=Menu")
    follow(seen, "nav >> text=Photographs")
    expect(seen.locator("tbody th[scope=row]")).to_have_count(6)
    small = "[...document.images].filter((e) => e.className == 'thumbnail')"
    seen.evaluate("document.querySelectorAll('.thumbnail').forEach((e) => (e.loading = 'eager'))")
    # Waited for from without: the page's own policy lets nobody evaluate strings in it.
    until(lambda: seen.evaluate(f"{small}.every((e) => e.complete && e.naturalWidth > 0)"))
    seen.select_option("[name=verdict]", "refused")
    follow(seen, "text=Find")
    expect(seen.locator("tbody th[scope=row]")).to_have_count(1)
    seen.select_option("[name=verdict]", "used")
    seen.fill("[name=heliostat]", "AA39")
    seen.fill("[name=since]", "2026-06-03")
    seen.fill("[name=until]", "2026-06-03")
    follow(seen, "text=Find")
    follow(seen, "tbody th a >> nth=0")
    expect(seen.locator("h1")).to_have_text("Photograph 3 of AA39")
    for shown in ("img[src$='outlined.jpg']", "image[href$='crop.jpg']"):
        expect(seen.locator(shown)).to_be_visible()
    expect(seen.locator(".columns figcaption")).to_contain_text(
        ["photograph", "target", "its light", "forecast", "diff"]
    )
    expect(seen.locator("main")).to_contain_text("red where the forecast is brighter")
    azimuth = f"{240 + size['width'] / 1e4:g}"
    seen.fill("[name=azimuth_deg]", azimuth)
    seen.fill("[name=reason]", "by hand")
    seen.check("[name=excluded]")
    follow(seen, "button >> text=Correct")
    expect(seen.locator("#known-title")).to_have_text("excluded")
    expect(seen.locator("#corrections")).to_contain_text(f"→ {azimuth}; excluded")
    seen.fill("[name=reason]", "it was right")
    seen.uncheck("[name=excluded]")
    follow(seen, "button >> text=Correct")
    expect(seen.locator("#known-title")).to_have_text("accepted")


@SIZES
def test_maps_of_all_versions_have_one_scale(seen: Any):
    scales = []
    for version in (1, 2):
        seen.goto(f"/heliostats/AA39?version={version}")
        scales.append(seen.locator("#deviation-title").text_content().rpartition("; ")[2])
    assert scales == ["from -2 to 2 mm"] * 2
    expect(seen.locator("#compare-title + p")).to_contain_text("3 photographs, the newest")
    expect(seen.locator("svg.scale").last).to_have_attribute(
        "aria-label", "Colours from -0.3 to 0.3 of the measured peak"
    )
    seen.goto("/compare?heliostat=AA39&version=1&other_version=2")
    expect(seen.locator("#compared .columns figure")).to_have_count(6)
    expect(seen.locator("#compared [role=status]")).to_have_count(0)
    assert seen.locator("#surface-first-title").text_content().endswith(scales[0])


@SIZES
def test_study_says_what_matters_and_adopting_what_is_of_before(seen: Any):
    seen.goto("/studies/2")
    expect(seen.locator("#verdict-title")).to_have_text("nothing missing")
    expect(seen.locator("section p >> nth=1")).to_contain_text(
        "of the light falls elsewhere than forecast"
    )
    seen.goto("/studies/1")
    follow(seen, "button >> text=Adopt")
    expect(seen.locator("main")).to_contain_text("2 were made by another version of the model")
    expect(seen.locator("form[action='/studies/predictions'] button")).to_be_visible()
    follow(seen, "text=Withdraw it")
    expect(seen.locator("button >> text=Adopt")).to_be_visible()


@SIZES
def test_flux_of_the_field_has_units(seen: Any):
    seen.goto("/jobs/1")
    expect(seen.locator(".tiles").nth(0)).to_contain_text("Reflected by the mirrors")
    expect(seen.locator("figure svg image")).to_be_visible()
    text = seen.locator("main").inner_text()
    assert "{" not in text
    assert "reflected_w" not in text


@SIZES
def test_tables_and_figures_are_taken_along(seen: Any):
    seen.goto("/heliostats/AA39")
    seen.click("section:has(#surface-title) .export summary")
    for suffix in ("npz", "png"):
        with seen.expect_download() as taken:
            seen.click(f"a[href*='figure=deviation&format={suffix}']")
        assert taken.value.suggested_filename.endswith(f"deviation.{suffix}")
    seen.goto("/photographs?verdict=used")
    with seen.expect_download() as taken:
        seen.click("text=CSV")
    assert taken.value.suggested_filename.endswith("photographs.csv")


@SIZES
def test_plan_is_deleted_by_who_asked_twice(seen: Any, served: Served):
    day = {"first_at": "2026-06-21T08:00:00Z", "last_at": "2026-06-21T10:00:00Z"}
    job = seen.request.post(
        "/v1/jobs/plans", data=day | {"name": "to go", "target": "lower"}
    ).json()["id"]
    work(served.app)
    seen.goto(f"/plans/{job}")
    seen.click("summary >> text=Delete this plan")
    follow(seen, "text=Delete to go for good")
    assert seen.url.endswith("/plans")
    expect(seen.locator("#plans-title + p")).to_contain_text("None yet")
