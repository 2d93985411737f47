"""The guide's table of additions, each tried: into a copy of the packages goes the one file, and
the one line.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from tests import packages

ROOT = Path(__file__).parents[1]
ADDED = Path(__file__).parent / "additions"
DOCS = ROOT / "docs"
EXTENDING = DOCS / "how-to" / "developer" / "extend.md"

FILES = {
    "REST resource": "service/web/resources/greetings.py",
    "job kind": "service/jobs/kinds/doublings.py",
    "page": "service/web/pages/hello.py",
    "CLI verb": "heliotwin/cli/verbs/greet.py",
    "importer": "service/sources/importers/notes.py",
    "export format": "service/web/responses/table.py",
    "effect": "model/effects/dust_glow.py",
    "sun shape": "model/sunshape/cosine.py",
    "receiver": "model/wedge.py",
}
"""What is added, and its one file; `tests/additions` holds them."""

LINES = {
    "export format": ("service/web/responses/formats.py", "OFFERED = (", '"table", '),
    "effect": ("model/effects/catalogue.py", '    "background",\n', '    "dust_glow",\n'),
    "sun shape": ("model/sunshape/__init__.py", "DECLARABLE = (", '"cosine", '),
}
"""The addition in another file, and the text that it follows."""


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What came of each addition: "ok", or how it failed."""
    root = tmp_path_factory.mktemp("additions")
    for package in ("model", "service", "training", "migrations", "heliotwin"):
        shutil.copytree(
            ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    for path in FILES.values():
        assert not (root / path).exists()
        shutil.copy(ADDED / Path(path).name, root / path)
    for path, after, line in LINES.values():
        text = (root / path).read_text(encoding="utf-8")
        assert text.count(after) == 1
        (root / path).write_text(text.replace(after, after + line), encoding="utf-8")
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("HELIOTWIN_")
    }
    done = subprocess.run(
        [sys.executable, "-P", "-W", "error", str(ADDED / "trial.py"), str(root)],
        env=environment | {"PYTHONPATH": str(root), "HELIOTWIN_DATA_DIR": str(root / "data")},
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.mark.parametrize("addition", FILES)
def test_each_addition_is_one_file_and_at_most_one_line(tried, addition):
    if tried[addition].startswith("skipped"):
        pytest.skip(tried[addition])
    assert tried[addition] == "ok"


@pytest.mark.parametrize("addition", FILES)
def test_guide_says_where_each_goes(addition):
    """The row names the folder of the file, and the file of the line."""
    rows = EXTENDING.read_text(encoding="utf-8").splitlines()
    (row,) = (line for line in rows if line.startswith((f"| a {addition} |", f"| an {addition} |")))
    _, _, write, also, _ = row.split("|", 4)
    assert f"`{Path(FILES[addition]).parent}/NAME.py`" in write
    assert also.strip() == "-" or LINES[addition][0] in also
    assert (also.strip() == "-") == (addition not in LINES)


def test_the_words_of_the_glossary_are_those_of_the_code():
    """Each dotted name in the last column is a module, or something in one."""
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ")][2:]
    assert len(rows) > 30
    for name in (
        found for row in rows for found in re.findall(r"`(model\.[\w.]+|service\.[\w.]+)`", row)
    ):
        parts = name.split(".")
        for length in range(len(parts), 0, -1):
            try:
                thing = import_module(".".join(parts[:length]))
            except ModuleNotFoundError:
                continue
            for part in parts[length:]:
                assert hasattr(thing, part) or part in getattr(thing, "__annotations__", {}), name
                thing = getattr(thing, part, None)
            break


def test_architecture_has_the_table_of_packages():
    text = (DOCS / "explanation" / "architecture.md").read_text(encoding="utf-8")
    shown = text.partition("<!-- python -m tests.packages -->\n")[2].partition("\n<!-- end -->")[0]
    assert shown == packages.table(), "the page shows what `python -m tests.packages` printed once"
