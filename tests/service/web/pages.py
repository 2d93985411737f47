"""The pages as a client without a browser sees them, and what they show."""

import threading
from typing import Any

from fastapi import FastAPI
from fastapi.testclient import TestClient

from service import store
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.store import keys
from service.store.queue import add_job
from tests.page import Page
from tests.service.conftest import png, poster, sun_at
from tests.service.studies import study_row
from tests.waiting import until

HTML = {"Accept": "text/html,application/xhtml+xml"}
HTMX = {"HX-Request": "true"}


def fill(client: TestClient) -> None:
    """Photographs, one of them refused, two surfaces, a forecast, and a job that waits."""
    post = poster(client)
    assert post(png(1), id="101").status_code == 201
    assert post(png(2), id="102", sun=sun_at(210.0)).status_code == 201
    assert post(png(3, refused=True), id="103").status_code == 201
    for method in ("network", "refined"):
        assert (
            client.post(
                "/v1/heliostats/AA39/surfaces", json={"method": method, "measurements": ["101"]}
            ).status_code
            == 201
        )
    sun = {"azimuth_deg": 200, "elevation_deg": 45}
    assert (
        client.post(
            "/v1/forecasts", json={"heliostat": "AA39", "target": "lower", "sun": sun}
        ).status_code
        == 201
    )
    app: Any = client.app
    with app.state.runtime.database.writing() as session:
        add_job(session, "imports", {"folder": "<script>alert(1)</script>"}, "local")
    client.headers.update(HTML)


_REPORT = "<style>p{}</style><p>heliotwin study</p><p>found</p><script>alert(1)</script>"


def keep_study(app: FastAPI, *effects: dict[str, Any], **about: Any) -> int:
    """A study that somebody made, with what no report of ours would hold."""
    row = study_row(*effects, **about)
    row.conclusion, row.html = "<img src=x onerror=alert(1)>", _REPORT
    with app.state.runtime.database.writing() as session:
        return store.add_study(session, row).id


PATHS = (
    "/",
    "/?metric=age_days",
    "/heliostats/AA39",
    "/heliostats/AA39?version=1",
    "/heliostats/AA39/photographs/101",
    "/photographs",
    "/photographs/times",
    "/photographs/review",
    "/photographs/upload",
    "/forecast",
    "/forecast?heliostat=AA39",
    "/forecasts/1",
    "/jobs",
    "/jobs/start",
    "/jobs/1",
    "/studies",
    "/studies/1",
    "/studies/new",
    "/alarms",
    "/alarms?acknowledged=true",
    "/alarms?sort=newest",
    "/alarms/history",
    "/compare",
    "/plans",
    "/compare?heliostat=AA39",
    "/plant",
    "/plant/settings",
    "/plant/keys",
    "/plant/audit",
    "/login",
    "/nothing",
    "/heliostats/none",
)


def text_of(client: TestClient, path: str, status: int = 200) -> Page:
    """A page that answers so."""
    answer = client.get(path)
    assert answer.status_code == status, answer.text
    assert answer.headers["Content-Type"].startswith("text/html")
    return Page(answer.text)


def settled(client: TestClient, path: str = "/") -> Page:
    """The field's page after all background computations."""

    def page() -> Page | None:
        text = text_of(client, path)
        return None if "being computed" in text else text

    found: Page = until(page, "nothing is being computed any more")
    return found


def form(**changes: Any) -> dict[str, Any]:
    return {
        "heliostat": "AA39",
        "target": "lower",
        "azimuth_deg": "200",
        "elevation_deg": "45",
        "moment": "",
        **changes,
    }


def field_of(page: Page, name: str) -> str:
    """The value of a form's field."""
    return page.one("input", name=name)["value"]


def make_key(app: FastAPI, role: str) -> str:
    with app.state.runtime.database.writing() as session:
        return keys.create(session, role, role, "tester")


def work(app: FastAPI) -> None:
    """Work at all jobs that wait."""
    worker = Worker(app.state.runtime, KINDS, "tester", threading.Event())
    while worker.work():
        pass


def press(client: TestClient, page: Page, label: str, **changes: str) -> Any:
    """Submit the form of the first button that begins with ``label``, as shown with changes."""
    button = next(one for one in page.all("button") if one.words.startswith(label))
    element: Any = button
    while element.tag != "form":
        element = element.parent
    data = {
        one["name"]: one.attributes.get("value", "true")
        for one in element.all("input", name=True)
        if one.attributes.get("type") not in ("checkbox", "file") or "checked" in one.attributes
    }
    for one in element.all("select", name=True):
        chosen = [option for option in one.all("option") if "selected" in option.attributes]
        data[one["name"]] = (chosen or one.all("option"))[0].words
    if "name" in button.attributes:
        data[button["name"]] = button["value"]
    return client.post(element["action"], data=data | changes, headers=HTML)
