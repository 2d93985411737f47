"""From a plan that exceeds the limit to aims that keep it, in a real browser, on an imported plant."""

from collections.abc import Iterator
from typing import Any

import pytest

from service.sources.folder import read_folder
from service.twin.importing import import_folder
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
from tests.service.sources.aim_plant import write_aim_plant
from tests.service.web.pages import work

NOON = "2026-06-21T11:00:00Z"
PLAN = {"target": "main", "dni_w_m2": 900, "allowed_w_m2": 80e3, "first_at": NOON, "last_at": NOON}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    root = tmp_path_factory.mktemp("plant")
    write_aim_plant(root / "plant")
    with real.client_on(root) as client:
        import_folder(real.runtime_of(client), read_folder(root / "plant", whole_field=True))
    settings = real.settings_of(root, port=free_port())
    app = create_app(settings)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, GatedOperations())


@pytest.mark.parametrize(
    ("size", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk-light", "phone-dark"]
)
def test_exceeded_plan_leads_to_aims_that_keep_the_limit(
    page: Any, served: Served, size: dict[str, int], scheme: str
):
    """By three buttons."""
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme)
    job = page.request.post("/v1/jobs/plans", data=PLAN | {"name": scheme}).json()["id"]
    work(served.app)
    page.goto(f"/plans/{job}")
    expect(page.locator("main")).to_contain_text("The flux exceeds the limit of 80.0")
    assert violations(page) == []
    follow(page, "text=Plan aims that keep the limit")
    work(served.app)
    page.reload()
    expect(page.locator("main")).to_contain_text("No place exceeds the limit")
    assert violations(page) == []
    follow(page, "text=Plan the day with these aims")
    follow(page, "form.stack button >> text=Plan >> nth=0")
    work(served.app)
    page.reload()
    expect(page.locator(".tiles").first).to_contain_text("kept at all times")
    assert violations(page) == []
