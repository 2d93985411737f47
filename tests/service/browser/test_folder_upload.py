"""A measurement folder on the operator's computer, imported in a real browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.web.app import create_app
from tests.service import real
from tests.service.archives import zipped
from tests.service.browser.browsing import DESK, PHONE, GatedOperations, Served, expect, follow
from tests.service.browser.test_study_task import require_readable
from tests.service.conftest import free_port, serving


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """An empty service, with the real model and one worker."""
    settings = real.settings_of(tmp_path, port=free_port(), job_workers=1, job_poll_s=0.05)
    app = create_app(settings)
    with serving(app, settings.port, ws="none") as address:
        yield Served(app, address, GatedOperations())


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_folder_is_uploaded_counted_and_imported(
    page: Any, served: Served, stj: Path, tmp_path: Path, size: Any, scheme: str
):
    real.copy_measurements(stj, tmp_path / "stj")
    file = {"name": "stj.zip", "mimeType": "application/zip", "buffer": b"no ZIP file"}
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=scheme)
    page.goto("/jobs/start")
    require_readable(page)
    page.set_input_files("input[name=file]", file)
    follow(page, "text=Upload and count")
    expect(page.locator("main")).to_contain_text("file: no readable ZIP file")
    page.go_back()
    page.set_input_files("input[name=file]", file | {"buffer": zipped(tmp_path / "stj", "stj/")})
    follow(page, "text=Upload and count")
    expect(page.locator("#imports")).to_contain_text("2 heliostats and 11 measurements.")
    expect(page.locator("#imports .cost")).to_contain_text("11 images, about")
    require_readable(page)
    follow(page, "#imports button:has-text('Import stj-')")
    expect(page.locator("main .state.done").first).to_be_visible()
    page.goto("/heliostats/AA39")
    expect(page.locator("#photographs tbody tr")).to_have_count(9)
    assert list(served.app.state.runtime.settings.uploads_dir.iterdir()) == []
