"""The command starts without the libraries that only some verbs need, and take seconds to load."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from heliotwin.cli.main import app

HEAVY = {"torch", "h5py", "matplotlib", "cv2", "onnxruntime", "fastapi", "scipy", "pvlib", "pandas"}

LOADED = """
import sys
from heliotwin.cli.main import main
sys.argv = ["heliotwin", *sys.argv[1:]]
try:
    main()
except SystemExit as ended:
    assert not ended.code, ended.code
print("loaded:", *{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


@pytest.mark.parametrize(
    "arguments",
    [("--help",), ("predict", "--help"), ("models", "--help"), ("keys", "list"), ("migrate",)],
)
def test_start_loads_no_library_that_the_verb_does_not_need(
    arguments: tuple[str, ...], tmp_path: Path
):
    environment = {"HELIOTWIN_DATA_DIR": str(tmp_path / "data"), "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", LOADED, *arguments],
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    loaded = set(done.stderr.strip().splitlines()[-1].removeprefix("loaded:").split())
    assert "service" in loaded
    assert not loaded & HEAVY


def test_help_of_every_verb_fits_80_columns():
    for path in _verbs(typer.main.get_command(app)):
        done = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "80"})
        assert done.exit_code == 0
        assert [line for line in done.stdout.splitlines() if len(line) > 80] == [], path


def _verbs(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """A command and those below it."""
    yield path
    for name, below in getattr(command, "commands", {}).items():
        yield from _verbs(below, (*path, name))
