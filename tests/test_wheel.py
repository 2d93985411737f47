"""The built wheel alone, in an environment that holds nothing but what it asks for: what a plain
installation gets.
"""

import json
import os
import subprocess
import venv
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.docker.engine import ROOT, clone
from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, child_process, until

pytestmark = [pytest.mark.slow]


def _bare() -> dict[str, str]:
    """This process's environment without what would lead to this checkout or its packages."""
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("HELIOTWIN_", "PYTHON", "VIRTUAL"))
    }


def _run(*command: str | Path, folder: Path, **settings: str) -> str:
    """What a command prints that must succeed, in the bare environment with ``settings``."""
    environment = _bare() | settings
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a fresh environment with the wheel and, by the locked versions, its
    dependencies.
    """
    folder = tmp_path_factory.mktemp("wheel")
    venv.create(folder / "environment", with_pip=True)
    python = folder / "environment" / "bin" / "python"
    pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check"]
    probe = [
        *pip,
        "download",
        "--no-deps",
        "--no-cache-dir",
        "--dest",
        str(folder / "probe"),
        "setuptools>=77",
    ]
    asked = subprocess.run(probe, env=_bare(), capture_output=True, text=True, check=False)
    if asked.returncode:
        pytest.skip(f"no package registry answers: {asked.stderr.strip().splitlines()[-1]}")
    _run(*pip, "wheel", "--no-deps", "--wheel-dir", folder, clone(folder / "clone"), folder=folder)
    (wheel,) = folder.glob("heliotwin-*.whl")
    # Without bytecode, which would be made of all packages and is needed of few.
    _run(*pip, "install", "--no-compile", "-c", ROOT / "constraints.txt", wheel, folder=folder)
    return python


def heliotwin(python: Path, folder: Path, *arguments: object) -> str:
    """What the installed command prints when it is run in ``folder``."""
    return _run(python.parent / "heliotwin", *map(str, arguments), folder=folder)


def report(python: Path, folder: Path, *arguments: object) -> dict[str, Any]:
    """The same of a verb with ``--json``."""
    document: dict[str, Any] = json.loads(heliotwin(python, folder, *arguments, "--json"))
    return document


def test_nothing_of_development_is_there(python: Path):
    names = ("httpx", "pytest", "ray", "onnx", "opentelemetry.sdk", "tests")
    ask = f"import importlib.util as u; print([name for name in {names} if u.find_spec(name)])"
    done = subprocess.run(
        [python, "-c", ask], cwd="/", env=_bare(), capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_verbs_on_a_folder(python: Path, pair_plant: Path, tmp_path: Path):
    assert "predict" in heliotwin(python, tmp_path, "--help")
    assert len(report(python, tmp_path, "flux", pair_plant, "--out", "flux")["images"]) == 8
    predicted = report(
        python, tmp_path, "predict", pair_plant, "--out", "predicted", "--images", 2
    )["heliostats"]
    for name in predicted:
        with np.load(
            tmp_path / "predicted" / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
        ) as surface:
            assert surface["z"].shape == (4, 8, 8)
    study = report(
        python, tmp_path, "study", pair_plant, "--out", "study.json", "--html", "study.html"
    )
    assert study["verdict"] in ("effect", "none", "unexplained")
    assert "<html" in (tmp_path / "study.html").read_text(encoding="utf-8")


def test_library(python: Path, made_plant: Path, tmp_path: Path):
    code = (
        "import heliotwin; plant = heliotwin.open_plant(%r); surface = plant.surface('AB12');"
        " print(plant.forecast(surface, on='calibration_target', sun=(200, 45)).flux.shape)"
    )
    said = _run(python, "-c", code % str(made_plant), folder=tmp_path)
    assert said.strip() == "(256, 256)"


def test_service(python: Path, tmp_path: Path):
    port = free_port()
    settings = {"HELIOTWIN_DATA_DIR": str(tmp_path / "data"), "HELIOTWIN_PORT": str(port)}
    program = str(python.parent / "heliotwin")
    _run(program, "migrate", folder=tmp_path, **settings)
    with (
        (tmp_path / "log").open("wb") as log,
        child_process(
            [program, "serve"], cwd=tmp_path, env=_bare() | settings, stderr=log
        ) as process,
    ):

        def answers() -> bool:
            assert process.poll() is None, (tmp_path / "log").read_text(encoding="utf-8")
            try:
                return httpx.get(f"http://127.0.0.1:{port}/livez").status_code == 200
            except httpx.TransportError:
                return False

        until(answers, "the service answers")
        assert httpx.get(f"http://127.0.0.1:{port}/readyz").json()["status"] == "ok"
        for path in ("/", "/openapi.json"):
            assert httpx.get(f"http://127.0.0.1:{port}{path}").status_code == 200
        process.terminate()
        assert process.wait(WAIT_LIMIT_S) in (0, -15)
    assert "Traceback" not in (tmp_path / "log").read_text(encoding="utf-8")
