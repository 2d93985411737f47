"""The pages as a client without a browser sees them: each answers, escapes what it shows, and asks
nobody else.
"""

import re
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.twin.alarms.field_filter import METRICS
from service.web.app import create_app
from service.web.auth import security
from service.web.responses.pages import ASSETS
from service.web.root.session import own_path
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    properties_document,
    tower_document,
)
from tests.service.studies import SLOPE
from tests.service.web.pages import (
    HTML,
    HTMX,
    PATHS,
    field_of,
    fill,
    form,
    keep_study,
    make_key,
    settled,
    text_of,
    work,
)


@pytest.fixture
def pages(client: TestClient) -> TestClient:
    """A filled store."""
    fill(client)
    return client


@pytest.mark.parametrize("path", PATHS)
def test_page_loads_nothing_from_other_hosts_and_runs_no_inline_code(shown: TestClient, path: str):
    answer = shown.get(path)
    assert answer.headers["Content-Type"].startswith("text/html")
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    for link in Page(answer.text).links:
        assert re.match(r"/(?!/)|data:image/|#|\?", link) or ":" not in link, link
    # What the policy would refuse must not be there.
    assert not re.search(
        r"<script(?![^>]* src=)|<[^>]*\s(?:on[a-z]+|style)=|<style|javascript:", answer.text
    )


@pytest.mark.parametrize("path", PATHS)
def test_page_has_landmarks_one_heading_and_labels(shown: TestClient, path: str):
    page = Page(shown.get(path).text)
    assert page.one("html")["lang"] == "en"
    assert page.one("main")
    assert page.one("h1")
    assert page.one("a", class_="skip")["href"] == "#main"
    labels = page.all("label")
    labelled = [control for label in labels for control in label.all()]
    named = {label["for"] for label in labels if "for" in label.attributes}
    for control in page.all("input") + page.all("select"):
        is_hidden = control.attributes.get("type") == "hidden"
        assert is_hidden or control in labelled or control["id"] in named, control
    for tag in ("svg", "canvas", "img", "progress"):
        for drawing in page.all(tag):
            given = drawing.attributes.keys()
            assert given & {"aria-label", "aria-labelledby", "alt"}, drawing
    ids = [one["id"] for one in page.all(id=True)]
    assert len(ids) == len(set(ids))


def test_what_senders_wrote_is_escaped(shown: TestClient):
    page = text_of(shown, "/jobs/1")
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script>alert" not in page
    for path in ("/studies", "/studies/1"):
        page = text_of(shown, path)
        assert "&lt;img src=x" in page
        assert "<img src=x" not in page
    for path in (
        "/?metric=<script>alert(1)</script>",
        "/heliostats/<script>alert(1)<script>",
        "/<script>alert(1)",
    ):
        assert "<script>alert" not in shown.get(path).text


def test_assets_come_from_the_package_and_stay_in_the_browser(shown: TestClient):
    links = [link for path in ("/", "/heliostats/AA39") for link in text_of(shown, path).links]
    found = {link for link in links if link.startswith("/static/")}
    assert {path.partition("?")[0] for path in found} == {
        f"/static/{name}"
        for name in (
            "app.css",
            "icon.svg",
            "connection.js",
            "htmx.min.js",
            "htmx-sse.min.js",
            "map.js",
            "surface3d.js",
            "plots.js",
            "uplot.min.css",
            "uplot.min.js",
        )
    }
    for path in found:
        answer = shown.get(path)
        assert answer.status_code == 200
        assert "immutable" in answer.headers["Cache-Control"]
        assert re.match(r"text/(css|javascript)|image/svg\+xml", answer.headers["Content-Type"])
    for path in (
        "/static/LICENSES.md",
        "/static/none.js",
        "/static/..%2fapp.py",
        "/static/%2e%2e/app.py",
    ):
        assert shown.get(path).status_code == 404


def test_no_asset_names_another_host():
    for entry in ASSETS.iterdir():
        if entry.name.endswith((".js", ".css", ".svg")):
            # The banner of a library names its origin, which nothing is fetched from.
            text = re.sub(r"^/\*!.*?\*/", "", entry.read_text("utf-8"))
            # The one name is that of SVG's vocabulary, which nothing is fetched from.
            hosts = set(re.findall(r"https?://[A-Za-z0-9.-]+", text)) - {"http://www.w3.org"}
            assert not hosts, entry.name
            assert (
                not re.search(r"@import|url\(|\beval\b(?!.*allowEval)", text)
                or entry.name == "htmx.min.js"
            )


def test_empty_store_says_what_to_do(bare: TestClient):
    bare.headers.update(HTML)
    assert "heliotwin import" in text_of(bare, "/")
    assert "import a folder first" in text_of(bare, "/forecast")
    assert "None yet" in text_of(bare, "/jobs")


@pytest.mark.parametrize(
    "metric", [name for name in METRICS if name not in ("pointing_error_mrad", "age_days")]
)
def test_field_shows_every_figure_as_colour_and_as_number(shown: TestClient, metric: str):
    page = settled(shown, f"/?metric={metric}")
    assert f'<h2 id="map-title">{METRICS[metric].label}</h2>' in page
    mark = page.one("path", class_="mirrors", data_names="AA39")
    assert re.fullmatch(r"var\(--s[0-8]\)", mark["fill"])
    number = mark["data-texts"].split("\N{NO-BREAK SPACE}")[0]
    assert re.search(rf'<td class="number">(<span title="[^"]*">)?{re.escape(number)}', page)


def test_surface_made_from_all_photographs_is_not_yet_evaluated(pages: TestClient):
    """What it was made from proves nothing of it."""
    assert 'data-texts="not yet evaluated"' not in settled(pages)
    pages.post("/v1/heliostats/AA39/surfaces", json={"method": "refined", "images": 2})
    page = settled(pages)
    assert 'data-names="AA39" data-texts="not yet evaluated"' in page
    assert '<small class="short">not yet evaluated</small>' in page
    page = text_of(pages, "/heliostats/AA39")
    assert "not yet evaluated" in page
    assert (
        "100.0\N{NO-BREAK SPACE}% on photographs that it was made from, which flatters it" in page
    )


@pytest.mark.full
def test_colours_mean_the_same_in_every_field(tmp_path: Path):
    """What is fine recedes, also the worst heliostat of the field; the ends are settings."""
    colours = {}
    for name, scales in (
        ("usual", {}),
        ("strict", {"accuracy": (100.0, 99.0)}),
        ("lax", {"accuracy": (200.0, 100.0)}),
    ):
        app = create_app(
            Settings(data_dir=tmp_path / name, map_scales=scales, **QUIET), FakeOperations()
        )
        with client_of(app) as client:
            client.put("/v1/plant", json=tower_document())
            client.put("/v1/heliostats/AA39", json=properties_document())
            fill(client)
            colours[name] = settled(client).one("path", class_="mirrors")["fill"]
    assert colours == {"usual": "var(--s0)", "strict": "var(--s0)", "lax": "var(--s8)"}


def test_accuracy_is_computed_once_for_each_surface(pages: TestClient, operations: FakeOperations):
    # The stand-in forecasts what was measured.
    assert 'data-names="AA39" data-texts="100.0' in settled(pages)
    rendered = operations.rendered
    assert rendered > 0
    settled(pages)
    assert operations.rendered == rendered
    wanted = {"method": "refined", "measurements": ["102"]}
    assert pages.post("/v1/heliostats/AA39/surfaces", json=wanted).status_code == 201
    settled(pages)
    assert operations.rendered == rendered + 3  # both surfaces to compare them, then the active


def test_heliostat_without_anything_is_drawn_hollow(pages: TestClient, properties: dict[str, Any]):
    assert pages.put("/v1/heliostats/AB01", json=properties).status_code == 201
    page = settled(pages)
    mark = page.one("path", class_="unknown", data_names="AB01")
    assert mark["class"] == "mirrors unknown"
    assert mark["data-texts"] == "not known"
    assert "No surface yet" in text_of(pages, "/heliostats/AB01")


def test_forecast_form_leads_to_its_flux_map(pages: TestClient, operations: FakeOperations):
    answer = pages.post("/forecast", data=form(), follow_redirects=False)
    assert (answer.status_code, answer.headers["Location"]) == (303, "/forecasts/2")
    assert "0.002\N{NO-BREAK SPACE}kW/m²" in text_of(pages, "/forecasts/2")
    assert operations.forecasts[-1]["heliostat"] == "AA39"


def test_forecast_form_takes_a_time(pages: TestClient, operations: FakeOperations):
    """At noon of a June day the sun is high in the south of Jülich."""
    answer = pages.post(
        "/forecast", data=form(sun_by="time", moment="2026-06-21T11:36"), follow_redirects=False
    )
    assert answer.status_code == 303
    east, north, up = operations.forecasts[-1]["sun"]
    assert abs(east) < 0.02
    assert north < 0
    assert up == pytest.approx(0.887, abs=0.002)


def test_forecast_page_keeps_the_request(pages: TestClient):
    """A forecast that is requested again from its page is the same forecast."""
    asked = form(sun_by="time", moment="2026-06-21T11:36", surface="ideal", dni_w_m2="850")
    page = text_of(
        pages, pages.post("/forecast", data=asked, follow_redirects=False).headers["Location"]
    )
    assert 'value="time" checked' in page
    assert 'value="position" checked' not in page
    assert (field_of(page, "moment"), field_of(page, "dni_w_m2")) == ("2026-06-21 11:36", "850")
    assert 'value="ideal" selected' in page
    assert "2026-06-21 11:36 UTC" in page
    by_position = text_of(pages, "/forecasts/1")
    assert 'value="position" checked' in by_position
    assert field_of(by_position, "moment") == ""  # the form has the requested values
    assert (field_of(by_position, "azimuth_deg"), field_of(by_position, "elevation_deg")) == (
        "200.0",
        "45.0",
    )


def test_times_are_read_and_shown_in_the_plants_zone(tmp_path: Path, operations: FakeOperations):
    app = create_app(Settings(data_dir=tmp_path, time_zone="Europe/Berlin", **QUIET), operations)
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        fill(client)
        asked = form(sun_by="time", moment="2026-06-21T11:36")
        page = text_of(
            client, client.post("/forecast", data=asked, follow_redirects=False).headers["Location"]
        )
        assert field_of(page, "moment") == "2026-06-21 11:36"
        assert '<time datetime="2026-06-21T09:36:00Z">2026-06-21 11:36 CEST</time>' in page


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sun_by": "time", "moment": "0001-01-01T12:00"}, "moment: give a year from 1970 on"),
        (
            {"sun_by": "time", "moment": "0001-01-01T12:00+14:00"},
            "moment: give a year from 1970 on",
        ),
        ({"sun_by": "time", "moment": "9000-01-01T12:00"}, "moment: give a year before 9000"),
        # Without JavaScript, typing a time does not change the choice.
        (
            {"sun_by": "position", "moment": "2026-06-21T11:36"},
            "moment: a time and a position are both given",
        ),
        ({"moment": "2026-06-21T11:36"}, "moment: a time and a position are both given"),
        ({"sun_by": "time", "moment": "2026-06-21T00:00"}, "below the horizon"),
        ({"sun_by": "time"}, "say when"),
        ({"azimuth_deg": "", "elevation_deg": ""}, "give the position of the sun"),
        ({"elevation_deg": "91"}, "elevation_deg"),
        ({"target": "<b>"}, "target"),
        ({"dni_w_m2": "nan"}, "dni_w_m2"),
    ],
)
def test_forecast_form_says_what_is_wrong(shown: TestClient, changes: dict[str, str], said: str):
    answer = shown.post("/forecast", data=form(**changes))
    assert answer.status_code == 422
    assert said in answer.text
    assert "<h1" in answer.text
    part = shown.post("/forecast", data=form(**changes), headers=HTMX)
    assert part.text.startswith('<p class="alert" role="alert">')
    assert part.headers["HX-Retarget"] == "#notice"


def test_forecast_of_all_heliostats_is_a_job(pages: TestClient):
    answer = pages.post("/forecast", data=form(heliostat=""), follow_redirects=False)
    assert (answer.status_code, answer.headers["Location"]) == (303, "/jobs/2")
    assert (
        pages.post("/forecast", data=form(heliostat=""), headers=HTMX).headers["HX-Redirect"]
        == "/jobs/3"
    )


def test_forecast_of_all_heliostats_shows_its_light(app: FastAPI, pages: TestClient):
    asked = form(heliostat="", sun_by="time", moment="2026-06-21T11:36", dni_w_m2="900")
    path = pages.post("/forecast", data=asked, follow_redirects=False).headers["Location"]
    work(app)
    page = text_of(pages, path)
    assert "62.5° high" in page
    assert "sunat 2026-06-21 11:36 UTC" in page.words
    assert 'href="data:image/png' in page
    assert "{" not in page.partition("<main")[2]  # nothing as Python writes it
    again = text_of(pages, f"/forecast?job={path.rpartition('/')[2]}")
    assert (field_of(again, "heliostat"), field_of(again, "dni_w_m2")) == ("", "900")
    assert field_of(again, "moment") == "2026-06-21 11:36"
    assert pages.get("/forecast?job=1").status_code == 404


def test_jobs_are_requested_followed_and_cancelled(pages: TestClient):
    asked = pages.post(
        "/jobs/predictions", data={"heliostat": "AA39", "method": "refined"}, follow_redirects=False
    )
    assert asked.headers["Location"] == "/jobs/2"
    page = text_of(pages, "/jobs/2")
    assert 'sse-connect="/v1/jobs/2/events"' in page
    assert 'hx-trigger="every 2s"' in text_of(pages, "/jobs")
    assert pages.get("/v1/jobs/2").json()["payload"]["heliostats"] == ["AA39"]
    cancelled = pages.post("/jobs/2/cancel", follow_redirects=False)
    assert cancelled.headers["Location"] == "/jobs/2"
    page = text_of(pages, "/jobs/2")
    assert "cancelled" in page
    assert "sse-connect" not in page
    actions = [entry["action"] for entry in pages.get("/v1/audit").json()["items"]]
    assert actions[:2] == ["job.cancelled", "job.created"]


def test_report_of_a_study_is_a_page_that_runs_nothing(shown: TestClient):
    report = shown.get("/studies/1/report")
    assert "<p>found</p>" in report.text
    assert '<a href="/studies/1">1</a>' in report.text
    policy = report.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src" not in policy
    assert policy.endswith("frame-ancestors 'none'; sandbox allow-same-origin")
    assert report.headers["X-Frame-Options"] == "DENY"


def test_study_is_adopted_and_withdrawn(app: FastAPI, pages: TestClient):
    number = keep_study(app, SLOPE)
    assert pages.post(f"/studies/{number}/adopt", follow_redirects=False).status_code == 303
    assert "version <strong>2</strong>: slope error" in text_of(pages, "/studies")
    assert pages.post(f"/studies/{number}/withdraw", follow_redirects=False).status_code == 303
    assert "version <strong>1</strong>: the declared model" in text_of(pages, "/studies")
    assert pages.post(f"/studies/{number}/withdraw").status_code == 409
    actions = [entry["action"] for entry in pages.get("/v1/audit").json()["items"]]
    assert actions[:2] == ["effect.withdrawn", "effect.adopted"]


def test_what_explains_only_a_part_is_not_adopted(app: FastAPI, pages: TestClient):
    number, empty = keep_study(app, SLOPE, verdict="unexplained"), keep_study(app)
    for path in (f"/studies/{number}", "/studies"):
        assert not text_of(pages, path).all("form", action=f"/studies/{number}/adopt")
    for path, body in (("", {"data": {"read": "true"}}), ("/v1", {"json": {"force": True}})):
        refused = pages.post(f"{path}/studies/{number}/adopt", **body)
        assert refused.status_code == 409
        assert "slope_error explains only part of the error" in refused.text
    assert "Slope error explains only part of the error" in text_of(pages, f"/studies/{number}")
    assert "nothing to adopt" in text_of(pages, f"/studies/{empty}")


def test_accuracy_is_computed_again_for_another_model(
    app: FastAPI, pages: TestClient, operations: FakeOperations
):
    number = keep_study(app, SLOPE)
    settled(pages)
    rendered = operations.rendered
    assert pages.post(f"/studies/{number}/adopt", follow_redirects=False).status_code == 303
    settled(pages)
    assert operations.rendered == rendered + 1


def test_study_is_requested(pages: TestClient):
    assert pages.post("/studies", follow_redirects=False).headers["Location"] == "/jobs/2"
    assert pages.get("/v1/jobs/2").json()["kind"] == "studies"


def test_rest_answers_browsers_in_json_as_ever(shown: TestClient):
    answer = shown.get("/v1/heliostats/none")
    assert answer.headers["Content-Type"] == "application/problem+json"


# --- the door
# --------------------------------------------------------------------------------------------------


def test_browser_without_a_key_is_sent_to_the_login(app: FastAPI, pages: TestClient):
    make_key(app, "read")
    answer = pages.get("/heliostats/AA39?version=1", follow_redirects=False)
    assert (answer.status_code, answer.headers["Location"]) == (
        303,
        "/login?next=%2Fheliostats%2FAA39%3Fversion%3D1",
    )
    assert 'value="/heliostats/AA39?version=1"' in pages.get(answer.headers["Location"]).text
    part = pages.get("/jobs", headers=HTMX)
    assert (part.status_code, part.headers["HX-Redirect"]) == (401, "/login?next=%2Fjobs")
    assert pages.get("/", headers={"Accept": "*/*"}).status_code == 401
    assert pages.post("/forecast", data=form(), follow_redirects=False).status_code == 401
    assert pages.get("/v1/heliostats", follow_redirects=False).status_code == 401


def test_login_keeps_the_key_and_logout_removes_it(app: FastAPI, pages: TestClient):
    key = make_key(app, "read")
    assert pages.post("/login", data={"key": "htw_wrong"}).status_code == 401
    answer = pages.post("/login", data={"key": f" {key} ", "next": "/jobs"}, follow_redirects=False)
    assert (answer.status_code, answer.headers["Location"]) == (303, "/jobs")
    assert "HttpOnly" in answer.headers["Set-Cookie"]
    assert "SameSite=strict" in answer.headers["Set-Cookie"]
    page = text_of(pages, "/jobs")
    assert 'read <span class="role">read</span>' in page
    assert pages.post("/logout", follow_redirects=False).headers["Location"] == "/login"
    assert pages.cookies.get(security.COOKIE) is None
    assert pages.get("/jobs", follow_redirects=False).status_code == 303


def test_reader_sees_no_buttons_and_may_not_press_them(app: FastAPI, pages: TestClient):
    pages.headers["Authorization"] = f"Bearer {make_key(app, 'read')}"
    assert "Predict" not in settled(pages)
    assert "Cancel" not in text_of(pages, "/jobs/1")
    assert "forecasts need the role operate" in text_of(pages, "/forecast")
    assert "New study" not in text_of(pages, "/studies")
    for path in (
        "/forecast",
        "/jobs/predictions",
        "/jobs/1/cancel",
        "/studies",
        "/studies/1/adopt",
    ):
        answer = pages.post(path, data=form() if path == "/forecast" else {})
        assert answer.status_code == 403
        assert "needs operate" in answer.text


def test_form_of_another_site_changes_nothing(shown: TestClient):
    answer = shown.post("/jobs/1/cancel", headers={"Sec-Fetch-Site": "cross-site"})
    assert answer.status_code == 403
    assert shown.get("/v1/jobs/1").json()["state"] == "queued"


@pytest.mark.parametrize(
    "wanted",
    [
        "//evil.example",
        "/\\evil.example",
        "https://evil.example",
        "evil",
        "/a\r\nSet-Cookie: b=c",
        "/%2f/evil",
        "",
        "/\t/x",
    ],
)
def test_login_leads_nowhere_else(wanted: str):
    assert own_path(wanted) == "/"


@pytest.mark.parametrize(
    "wanted", ["/", "/?metric=age_days", "/heliostats/AA39?version=2", "/jobs/7"]
)
def test_login_leads_back(wanted: str):
    assert own_path(wanted) == wanted
