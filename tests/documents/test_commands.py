"""Every command of README, tutorials and how-to guides runs, on the demonstration's plant.

A block that cannot run has the comment ``<!-- not run: REASON -->`` before it, and its reason is
listed here.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.base.settings import Settings
from service.web.app import create_app
from tests.service.command import heliotwin_program
from tests.service.conftest import QUIET, serving

from .prose import DOCS, ROOT

PAGES = [
    ROOT / "README.md",
    *sorted((DOCS / "tutorials").glob("*.md")),
    *sorted((DOCS / "how-to").rglob("*.md")),
]

NOT_RUN = {
    "asks the image registry",
    "asks the package index",
    "installs on several machines",
    "later examples on this page's store would need the key",
    "makes the demonstration, from which the tests start, and serves until it is stopped",
    "needs a PostgreSQL server and a supervisor",
    "needs a checkout of the repository and photographs",
    "needs the image",
    "serves until it is stopped; the tests have a service running",
    "starts a cluster on several machines",
    "starts containers",
    "takes a minute; a test demonstrates a smaller plant",
    "takes forty minutes",
    "takes forty minutes and needs the real surfaces",
    "takes hours",
    "the requests of this page would need the key",
    "the tests start from its result",
    "the tests take many minutes and install packages",
}
"""Reasons for which a block is not run: `tests/docker` runs the containers where it can."""

# A comment before the block, if any; the language; and the block.
_BLOCK = re.compile(
    r"(?:<!-- not run: ([^>]*) -->\n)?^```(bash|console|sh)\n(.*?)^```", re.MULTILINE | re.DOTALL
)
ADDRESS = "http://127.0.0.1:8000"
CURL = "curl --no-progress-meter --fail-with-body "
FORECASTS = ("forecasts/5", "forecasts/3")
"""The next forecast after those of the shipped demonstration, one for each of four heliostats; and
after those of the tests' demonstration, which has two.
"""
EMPTY = "first-photograph.md"
"""The page whose service begins without a plant."""


def blocks(page: Path) -> list[tuple[str, str]]:
    """The blocks of a page: the reason why it is not run, or an empty text; and its commands."""
    text = page.read_text(encoding="utf-8")
    return [(reason, code) for reason, _, code in _BLOCK.findall(text)]


def runs(page: Path) -> bool:
    return any(not reason for reason, _ in blocks(page))


def test_blocks_are_run_or_have_a_listed_reason():
    found = {reason for page in PAGES for reason, _ in blocks(page) if reason}
    assert found == NOT_RUN
    assert sum(map(runs, PAGES)) > 8


@pytest.fixture
def folder(demonstration: Path, tmp_path: Path) -> Iterator[Path]:
    """A checkout after the demonstration, with ``heliotwin`` and ``python`` in ``bin``."""
    shutil.copytree(demonstration / "out", tmp_path / "out")
    (tmp_path / "docs").symlink_to(DOCS)
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "python").symlink_to(sys.executable)
    with heliotwin_program(programs / "heliotwin"):
        yield tmp_path


@pytest.mark.skipif(shutil.which("curl") is None, reason="no curl")
@pytest.mark.parametrize("page", [*filter(runs, PAGES)], ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_of_a_page_run_in_its_order(page: Path, folder: Path):
    """Each page begins with the demonstration's store. An HTTP error is a failure."""
    data = folder / "out" / ("empty" if page.name == EMPTY else "demo/store-demo")
    script = "\n".join(code for reason, code in blocks(page) if not reason)
    environment = {
        "PATH": f"{folder / 'bin'}:/usr/local/bin:/usr/bin:/bin",
        "HOME": str(folder),
        "HELIOTWIN_DATA_DIR": str(data),
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    }

    def run(text: str) -> None:
        done = subprocess.run(
            ["bash", "-e", "-c", text],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        said = done.stdout + done.stderr
        assert done.returncode == 0, said
        assert "urn:heliotwin:problem" not in said, said
        assert "Traceback" not in said, said

    if ADDRESS not in script:
        run(script)
        return
    script = script.replace(*FORECASTS)
    settings = Settings(data_dir=data, **QUIET | {"job_workers": 1})
    with serving(create_app(settings)) as address:
        run(script.replace(ADDRESS, address).replace("curl ", CURL))
