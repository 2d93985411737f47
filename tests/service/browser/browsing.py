"""A real browser: what drives it, where it leads, and what it meets.

Needs Chromium, `HELIOTWIN_TEST_CHROMIUM` or one on the path, and its driver from the package
playwright.
"""

import os
import shutil
import threading
from dataclasses import dataclass
from typing import Any

import pytest
from fastapi import FastAPI

from tests.service.conftest import FakeOperations
from tests.waiting import WAIT_LIMIT_S

playwright = pytest.importorskip(
    "playwright.sync_api", reason="no browser driver: pip install playwright"
)
axe = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason="no axe: pip install axe-playwright-python"
)
expect = playwright.expect
expect.set_options(timeout=120_000)

CHROMIUM = (
    os.environ.get("HELIOTWIN_TEST_CHROMIUM")
    or shutil.which("chromium")
    or shutil.which("google-chrome")
)
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SCROLLING = """() => [...document.querySelectorAll(".scroll")]
    .filter((e) => e.getClientRects().length && e.scrollWidth > e.clientWidth)
    .map((e) => `${e.querySelector("table").id} is ${e.scrollWidth - e.clientWidth} px too wide`)"""
"""The visible tables that scroll sideways."""
MENUS = """() => [...document.querySelectorAll("section.card")]
    .filter((e) => e.querySelectorAll(".export").length > 1).map((e) => e.getAttribute("aria-labelledby"))"""
"""The panels with several menus of exports."""
DESK, PHONE = {"width": 1440, "height": 900}, {"width": 390, "height": 844}


class GatedOperations(FakeOperations):
    """Predicts while its gate is open."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = threading.Event()
        self.gate.set()

    def predict(self, *arguments: Any, **options: Any) -> Any:
        assert self.gate.wait(WAIT_LIMIT_S)
        return super().predict(*arguments, **options)


@dataclass
class Served:
    """A service that listens."""

    app: FastAPI
    address: str
    operations: GatedOperations


def follow(page: Any, selector: str) -> None:
    """Press a link or button and wait for where it leads."""
    with page.expect_navigation():
        page.click(selector)


def violations(page: Any, **options: Any) -> list[tuple[str, list[str]]]:
    """The rules of axe-core that a page breaks, each with the elements that break it."""
    asked = {"resultTypes": ["violations"]} | options
    found = axe.Axe().run(page, options=asked).response["violations"]
    return [(entry["id"], [node["html"] for node in entry["nodes"]]) for entry in found]
