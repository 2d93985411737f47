"""The pages in a real browser: what an operator does in a shift, by mouse and by keyboard, on a
desk and on a phone.
"""

import re
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from sqlalchemy import delete, update

from model.ephemeris import sun_angles_at
from service import store
from service.base.fields import plant_time_to_utc
from service.base.settings import Settings
from service.store import keys
from service.store.columns import now
from service.store.job_tables import KeyRow
from service.store.tables import HeliostatRow
from service.twin.alarms.field_updates import FieldStateWriter
from service.web.app import create_app
from tests.quick_services import write_state
from tests.service.browser.browsing import (
    DESK,
    PHONE,
    GatedOperations,
    Served,
    expect,
    follow,
    violations,
)
from tests.service.conftest import (
    ORIGIN,
    QUIET,
    FakeOperations,
    client_of,
    free_port,
    png,
    poster,
    properties_document,
    serving,
    tower_document,
)
from tests.service.studies import SLOPE, study_row

SCHEMES = ("light", "dark")
PATHS = (
    "/",
    "/heliostats/AA39",
    "/heliostats/AA39/photographs/100",
    "/heliostats/AB01",
    "/photographs",
    "/photographs/times",
    "/photographs/review",
    "/photographs/upload",
    "/forecast",
    "/forecasts/1",
    "/studies",
    "/alarms",
    "/alarms?sort=newest",
    "/alarms/history",
    "/calibration-plan?at=2026-06-21T10:00",
    "/studies/1",
    "/studies/1/change",
    "/studies/new",
    "/jobs",
    "/jobs/start",
    "/jobs/1",
    "/compare?heliostat=AA39&version=1&other_version=1",
    "/plans",
    "/plant",
    "/plant/settings",
    "/plant/keys",
    "/plant/audit",
)


def fill(app: FastAPI) -> None:
    with client_of(app) as client:
        assert client.put("/v1/plant", json=tower_document()).status_code == 200
        for name, north in (("AA39", 0.0), ("AB01", 3e-4)):
            properties = properties_document()
            properties["heliostat_position"][0] += north
            assert client.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
        send = poster(client)
        yesterday = now() - timedelta(days=1)
        for seed, hour in enumerate((10, 12)):
            moment = yesterday.replace(hour=hour)
            azimuth, elevation = sun_angles_at(moment, ORIGIN)
            sun = {"sun": {"azimuth_deg": azimuth, "elevation_deg": elevation}}
            answer = send(png(seed), id=f"10{seed}", taken_at=moment.isoformat(), **sun)
            assert (answer.status_code, answer.json()["warnings"]) == (201, [])
        assert (
            client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["100"]}).status_code
            == 201
        )
        sun = {"azimuth_deg": 200, "elevation_deg": 45}
        body = {"heliostat": "AA39", "target": "lower", "sun": sun}
        assert client.post("/v1/forecasts", json=body).status_code == 201
        study = study_row(SLOPE)
        study.html = "<p>heliotwin study</p><p>found</p>"
        with app.state.runtime.database.writing() as session:
            store.add_study(session, study)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service on a port of this machine, with one worker."""
    folder = tmp_path_factory.mktemp("served")
    options = QUIET | {"job_workers": 1, "time_zone": "Europe/Berlin"}
    settings = Settings(data_dir=folder, port=free_port(), job_poll_s=0.05, **options)
    fill(create_app(settings, FakeOperations()))
    operations = GatedOperations()
    app = create_app(settings, operations)
    with serving(app, settings.port, ws="none") as address:
        try:
            yield Served(app, address, operations)
        finally:
            operations.gate.set()


def test_operator_looks_at_the_field_and_at_a_heliostat(page: Any):
    page.goto("/")
    expect(page.locator("#map-title")).to_have_text("Forecast accuracy")
    expect(page.locator('[data-map] [data-texts^="100.0"]')).to_be_attached()
    page.select_option("#metric", "deviation_mm")
    expect(page.locator("#map-title")).to_have_text("Deviation from ideal")
    assert page.url.endswith("/?metric=deviation_mm")
    # By keyboard: one tab stop for the map, arrows to the neighbour, Enter to its page.
    link = page.locator('[data-map] a[tabindex="0"]')
    expect(link).to_have_count(1)
    link.focus()
    page.keyboard.press("ArrowUp")
    assert link.get_attribute("aria-label") == "AB01: not known"
    page.keyboard.press("ArrowDown")
    with page.expect_navigation():
        page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("Heliostat AA39")
    before = page.locator("canvas.space").screenshot()
    page.locator("canvas.space").focus()
    page.keyboard.press("ArrowRight")
    assert page.locator("canvas.space").screenshot() != before
    assert float(page.locator("[data-exaggeration]").inner_text()) > 1


def test_operator_finds_and_zooms(page: Any):
    page.goto("/")
    field = page.locator("[data-map]")
    whole = field.get_attribute("viewBox")
    expect(field.locator("text.name")).to_have_text(["AA39", "AB01"])
    page.click("[data-zoom=in]")
    seen = field.get_attribute("viewBox")
    assert seen != whole
    # Matches are highlighted. The map keeps its view, which is also part of the address.
    page.select_option("#show", "no_surface")
    expect(page.locator("tbody th[scope=row]")).to_have_text(["AB01"])
    expect(page).to_have_url(re.compile(r"/\?metric=accuracy&show=no_surface#map="))
    assert field.get_attribute("viewBox") == seen
    address = page.url
    page.goto("about:blank")
    page.goto(address)
    assert field.get_attribute("viewBox") == seen
    page.click("[data-zoom=whole]")
    assert field.get_attribute("viewBox") == whole
    page.fill("#search", "aa")
    page.keyboard.press("Enter")
    expect(page.locator("text=No heliostat matches.")).to_be_visible()
    follow(page, "#find a.button")
    assert page.url.endswith("/")
    # A press on a mirror leads to its page.
    field.scroll_into_view_if_needed()
    box = page.locator("path.mirrors").first.bounding_box()
    with page.expect_navigation():
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(page.locator("h1")).to_contain_text("Heliostat A")


def test_operator_asks_for_a_forecast(page: Any):
    page.goto("/forecast")
    page.fill("[name=moment]", "2026-06-21T00:00")  # what is typed is what is asked for
    expect(page.locator("[value=time]")).to_be_checked()
    page.click("form.stack button")
    expect(page.locator("#notice [role=alert]")).to_contain_text("below the horizon")
    page.fill("[name=azimuth_deg]", "200")
    page.fill("[name=elevation_deg]", "45")
    expect(page.locator("[value=position]")).to_be_checked()
    page.click("form.stack button")
    expect(page.locator("#result h2").first).to_have_text("AA39 on lower")
    expect(page.locator("#result svg image")).to_be_visible()
    expect(page.locator("#notice")).to_be_empty()
    assert "/forecasts/" in page.url
    # By a time of the day, and opened again, it is asked for by that time.
    page.fill("[name=moment]", "2026-06-21T11:36")
    page.click("form.stack button")
    expect(page.locator("#result .tiles")).to_contain_text("2026-06-21 11:36 CEST")
    page.reload()
    expect(page.locator("[value=time]")).to_be_checked()
    expect(page.locator("[name=moment]")).to_have_value("2026-06-21 11:36")
    # A time that the form offers is filled in, and is what is asked by.
    page.fill("[name=azimuth_deg]", "200")
    page.click("text=Solar noon tomorrow")
    moment = page.locator("[name=moment]")
    expect(moment).to_have_value(re.compile(r"^(?!2026-06-21)\d{4}-\d\d-\d\d \d\d:\d\d$"))
    at = plant_time_to_utc(datetime.fromisoformat(moment.input_value()), "Europe/Berlin")
    assert sun_angles_at(at, ORIGIN)[0] == pytest.approx(180, abs=0.5)
    expect(page.locator("[value=time]")).to_be_checked()
    assert "/forecasts/" in page.url


def test_form_offers_heliostats_as_they_are_typed(page: Any):
    page.goto("/forecast")
    expect(page.locator("#offered option")).to_have_count(2)
    page.locator("[name=heliostat]").press_sequentially("x")  # after the name in the field
    expect(page.locator("#offered option")).to_have_count(0)
    page.fill("[name=heliostat]", "")
    page.locator("[name=heliostat]").press_sequentially("ab")
    expect(page.locator("#offered option")).to_have_count(1)
    assert page.locator("#offered option").get_attribute("value") == "AB01"
    assert page.url.endswith("/forecast")


def test_operator_follows_and_cancels_a_job(page: Any, served: Served):
    served.operations.gate.clear()
    page.goto("/heliostats/AA39")
    follow(page, "text=Predict its surface")
    expect(page.locator("#predictions .cost")).to_contain_text("1 surface, about")
    follow(page, "text=Predict AA39, refined")
    first = page.url
    expect(page.locator("#progress-title")).to_have_text("running")
    # The one worker is held up, so another job waits, and ends as soon as it is cancelled.
    page.goto("/heliostats/AA39")
    follow(page, "text=Predict its surface")
    follow(page, "text=Predict AA39, refined")
    follow(page, "text=Cancel")
    expect(page.locator("#progress-title")).to_have_text("cancelled")
    page.goto(first)
    expect(page.locator("#progress-title")).to_have_text("running")
    served.operations.gate.set()
    expect(page.locator("#progress-title")).to_have_text(
        "done"
    )  # without a reload: by server-sent events
    expect(page.locator("#job-state")).to_have_text("done")
    expect(page.locator("text=AA39, version 2")).to_be_visible()
    page.goto("/jobs")
    expect(page.locator("tbody .state")).to_have_text(["cancelled", "done"])


def test_page_of_a_job_says_that_the_service_is_away_and_follows_it_when_it_is_back(
    browser: Any, tmp_path: Path
):
    """It used to show the last known progress, even if the service was away."""
    settings = Settings(data_dir=tmp_path, port=free_port(), **QUIET)
    context = browser.new_context(base_url=f"http://127.0.0.1:{settings.port}")
    opened = context.new_page()
    with serving(create_app(settings, FakeOperations()), settings.port, ws="none"):
        with client_of(create_app(settings, FakeOperations())) as client:
            number = client.post("/v1/jobs/predictions", json={}).json()["id"]
        opened.goto(f"/jobs/{number}")
        expect(opened.locator("#progress-title")).to_have_text("queued")
        expect(opened.locator("#connection")).to_be_empty()
    expect(opened.locator("#connection")).to_have_text("Connection to the service lost; retrying")
    with client_of(create_app(settings, FakeOperations())) as client:  # what happened meanwhile
        client.post(f"/v1/jobs/{number}/cancel")
    with serving(create_app(settings, FakeOperations()), settings.port, ws="none"):
        expect(opened.locator("#connection")).to_be_empty()
        expect(opened.locator("#progress-title")).to_have_text("cancelled")
        context.close()


@pytest.mark.parametrize("size", [DESK, PHONE])
def test_operator_sees_alarms(page: Any, served: Served, size: dict[str, int]):
    with (
        served.app.state.runtime.database.writing() as session
    ):  # another day each time, that nobody has seen
        days = timedelta(days=40 if size is DESK else 41)
        session.execute(
            update(HeliostatRow).where(HeliostatRow.name == "AB01").values(created_at=now() - days)
        )
    write_state(FieldStateWriter(served.app.state.runtime))
    page.set_viewport_size(size)
    page.goto("/")
    expect(page.locator("nav .count")).to_have_text("1 not acknowledged")
    follow(page, "text=Alarms")
    expect(page.locator(".alarms tbody tr")).to_contain_text("None was ever accepted.")
    page.check("[name=ids]")
    page.select_option("[name=why]", "Maintenance")
    follow(page, ".acknowledging button")
    expect(page.locator("#alarms")).to_contain_text("Nothing.")
    expect(page.locator("nav .count")).to_have_count(0)
    follow(page, "text=Acknowledged (1)")
    expect(page.locator(".alarms tbody tr")).to_contain_text("acknowledged by local")


# All rules of axe-core; it counts WCAG 2.5.3 (names contain visible texts) as experimental.
AXE: dict[str, Any] = {"rules": {"label-content-name-mismatch": {"enabled": True}}}


# What a finger shall meet and is less than 40 px high; heliostats on the map are met by their
# places.
LOW = """() => [...document.querySelectorAll("button, select, input, textarea, summary, .choice, a")]
    .filter((e) => !e.matches("[type=hidden], [type=radio], [type=checkbox], svg *") && e.getClientRects().length)
    .filter((e) => e.getBoundingClientRect().height < 39.5).map((e) => e.outerHTML.slice(0, 80))"""
TOO_WIDE = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
CONTRAST = (Path(__file__).parent / "contrast.js").read_text("utf-8")


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_pages_fit_and_can_be_read_and_pressed(page: Any, size: dict[str, int]):
    page.set_viewport_size(size)
    for path in (*PATHS, "/login"):
        page.goto(path)
        assert page.evaluate(TOO_WIDE) <= 0, path
        if size is PHONE:
            assert page.evaluate(LOW) == [], path
        for scheme in SCHEMES:
            # At once, without the moving from one colour to the other.
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
            # WCAG 2.2 AA: 4.5 for text; measured on what the browser computed.
            assert page.evaluate(CONTRAST) == [], (path, scheme)
            assert violations(page, **AXE) == [], (path, scheme)
        if path != "/login":  # which begins in its field
            page.keyboard.press("Tab")
            assert page.evaluate("document.activeElement.className") == "skip", path
            outline = "getComputedStyle(document.activeElement).outlineStyle"
            assert page.evaluate(outline) == "solid", path


def test_dark_is_dark(page: Any):
    page.emulate_media(color_scheme="dark")
    page.goto("/")
    assert (
        page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
        == "rgb(17, 24, 27)"
    )


# --- a phone
# --------------------------------------------------------------------------------------------------


# Where on the screen a heliostat's square on the map has its middle.
MIDDLE = """(name) => {
    const map = document.querySelector("[data-map]"), half = Number(map.dataset.side) / 2;
    const path = [...map.querySelectorAll("[data-names]")].find((p) => p.dataset.names.split("|").includes(name));
    const k = path.dataset.names.split("|").indexOf(name);
    const [, x, y] = [...path.getAttribute("d").matchAll(/M(-?[\\d.]+) (-?[\\d.]+)/g)][k].map(Number);
    const at = new DOMPoint(x + half, y + half).matrixTransform(map.getScreenCTM());
    return [at.x, at.y];
}"""


def test_tap_beside_a_heliostat_means_it(page: Any):
    page.set_viewport_size(PHONE)
    page.goto("/")
    page.locator("[data-map]").scroll_into_view_if_needed()
    x, y = page.evaluate(MIDDLE, "AB01")
    with page.expect_navigation():
        page.mouse.click(x + 12, y)
    expect(page.locator("h1")).to_have_text("Heliostat AB01")


def test_result_is_seen_after_a_tap(page: Any):
    page.set_viewport_size(PHONE)
    page.goto("/forecast")
    page.click("form.stack button")
    expect(page.locator("#result-title")).to_have_text("AA39 on lower")
    expect(page.locator("#result-title")).to_be_in_viewport()
    # So is an error message, wherever the form is on the page.
    page.fill("[name=moment]", "2026-06-21T00:00")
    page.click("form.stack button")
    expect(page.locator("#notice [role=alert]")).to_be_in_viewport()


def test_tables_show_that_they_scroll(page: Any):
    """A shade at the right, until the last column is in sight."""
    page.set_viewport_size(PHONE)
    page.goto("/plant")
    table = page.locator(".scroll").first
    before = table.screenshot()
    table.evaluate("e => e.scrollTo(e.scrollWidth, 0)")
    after = table.screenshot()
    darkness = [
        cv2.imdecode(np.frombuffer(shot, np.uint8), 0)[:, -3:].mean() for shot in (before, after)
    ]
    assert darkness[0] < darkness[1] - 20


def test_what_is_decided_by_needs_no_scrolling_at_a_desk(page: Any):
    page.goto("/heliostats/AA39")
    history = page.locator("[aria-labelledby=history-title].scroll")
    assert history.evaluate("e => e.scrollWidth - e.clientWidth") <= 0


def test_legend_is_below_the_map(page: Any):
    page.set_viewport_size(PHONE)
    page.goto("/?metric=deviation_mm")
    boxes = [
        page.locator(selector).bounding_box() for selector in ("svg.map", "svg.map + svg.scale")
    ]
    assert boxes[0]["y"] + boxes[0]["height"] <= boxes[1]["y"]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_operator_plans_a_day_and_compares_surfaces(page: Any, scheme: str):
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size(PHONE)
    page.goto("/plans")
    page.fill("[name=name]", f"by {scheme}")
    page.fill("[name=first_at]", "2026-06-21T08:00")
    page.fill("[name=last_at]", "2026-06-21T12:00")
    page.fill("[name=heliostats]", "AA39 0.5 -1")
    page.fill("[name=allowed_kw_m2]", "0.001")
    follow(page, "form.stack button")
    expect(page.locator("#maps-title")).to_contain_text("On the receiver")  # without a reload
    expect(page.locator(".timeline")).to_have_count(3)
    expect(page.locator(".timeline .limit")).to_have_count(1)
    assert violations(page, **AXE) == []
    follow(page, "tbody a >> nth=1")
    assert page.url.endswith("?at=1")
    follow(page, f"text=by {scheme} >> nth=-1")
    expect(page.locator("h1")).to_have_text(f"Plan by {scheme}")
    page.goto("/compare?heliostat=AA39&version=1&other_version=1")
    expect(page.locator("[role=status]:not(#connection)")).to_have_count(0)
    expect(page.locator("#compared .columns figure")).to_have_count(6)


@pytest.fixture
def key(served: Served) -> Iterator[str]:
    """A reader's key; while there is one, everybody needs one."""
    database = served.app.state.runtime.database
    with database.writing() as session:
        made = keys.create(session, "visitor", "read", "tester")
    yield made
    with database.writing() as session:
        session.execute(delete(KeyRow))


def test_who_has_no_key_logs_in_and_out(page: Any, key: str):
    page.goto("/heliostats/AA39")
    assert "/login" in page.url
    page.fill("[name=key]", "htw_nonsense")
    follow(page, "text=Log in >> nth=-1")
    expect(page.locator("[role=alert]")).to_contain_text("not valid")
    page.fill("[name=key]", key)  # the form is shown again, and knows the way
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("Heliostat AA39")
    assert page.locator("text=Predict its surface").count() == 0
    # The report is a separate page without scripts; its link back keeps the login.
    page.goto("/studies/1")
    follow(page, "text=Open the report")
    expect(page.locator("text=found")).to_be_visible()
    follow(page, "a[href='/studies/1']")
    expect(page.locator("h1")).to_have_text("Study 1")
    follow(page, "text=Log out")
    assert page.url.endswith("/login")
    assert page.locator("[role=alert]").count() == 0
