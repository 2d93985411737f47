"""The notebooks of ``docs/notebooks`` run from top to bottom on the demonstration's plant."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

from docs import run_notebooks

NOTEBOOKS = Path(__file__).parents[2] / "docs" / "notebooks"


@pytest.fixture
def run(
    made_plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], dict[str, Any]]:
    """Run a notebook where the demonstration's plant is made already; returns its variables."""
    (tmp_path / "out" / "demo").mkdir(parents=True)
    (tmp_path / "out" / "demo" / "plant").symlink_to(made_plant)
    monkeypatch.chdir(tmp_path)

    def execute(name: str) -> dict[str, Any]:
        with mpl.rc_context({"backend": "Agg"}):
            try:
                return runpy.run_path(str(NOTEBOOKS / f"{name}.py"))
            finally:
                plt.close("all")

    return execute


def test_all_are_run():
    tests = Path(__file__).read_text(encoding="utf-8")
    assert all(f'run("{path.stem}")' in tests for path in NOTEBOOKS.glob("*.py"))


@pytest.mark.parametrize("name", run_notebooks.NAMES)
def test_outputs_are_those_of_the_script(name: str):
    """`python -m docs.run_notebooks` records them again, after a change of the script."""
    known = json.loads((NOTEBOOKS / f"{name}.json").read_text(encoding="utf-8"))
    assert known["digest"] == run_notebooks.digest(name)
    notebook = json.loads(run_notebooks.notebook(name))
    outputs = [one for cell in notebook["cells"] for one in cell.get("outputs", ())]
    assert any("image/png" in one.get("data", {}) for one in outputs)


def test_surfaces_from_photographs(run):
    found = run("surfaces_from_photographs")
    errors, accuracies = found["errors_mm"], found["accuracies"]
    assert errors["refined"] < errors["ideal"] / 2
    assert errors["network"] < errors["ideal"]
    assert accuracies["refined"] > accuracies["ideal"] + 0.02


def test_forecast_anywhere(run):
    found = run("forecast_anywhere")
    assert found["total"].max() > max(one.peak_w_m2 for one in found["maps"])
    assert len(found["refused"]) == 3
    assert all(said.startswith("sun: ") for said in found["refused"])


def test_hidden_effect(run):
    found = run("hidden_effect")
    assert found["study"].verdict == "effect"
    assert found["study"].effects[0]["name"] == "camera_response"
    assert found["after"].mean() > found["before"].mean() + 0.01
