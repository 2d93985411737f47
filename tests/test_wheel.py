"""The built wheel alone, in an environment that holds nothing but what it asks for: what a plain
installation gets.
"""

import errno
import json
import os
import shutil
import subprocess
import sys
import venv
from contextlib import suppress
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import heliotwin as heliotwin_package
from tests.docker.engine import clone
from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, child_process, until

pytestmark = pytest.mark.full


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


def _asked_for(site: Path) -> dict[str, Distribution]:
    """What the distributions in ``site`` ask for, and what that asks for; as installed here."""
    found: dict[str, Distribution] = {}
    waiting = [(one, "") for one in distributions(path=[str(site)])]
    while waiting:
        asking, extra = waiting.pop()
        for line in asking.requires or ():
            asked = Requirement(line)
            if asked.marker is None or asked.marker.evaluate({"extra": extra}):
                name = canonicalize_name(asked.name)
                extras = asked.extras if name in found else {"", *asked.extras}
                one = found.setdefault(name, distribution(asked.name))
                assert asked.specifier.contains(one.version, prereleases=True), line
                waiting += [(one, extra) for extra in extras]
    return found


def _put(one: Distribution, site: Path) -> None:
    """Put an installed distribution's files into ``site``, without its programs."""
    for file in one.files or ():
        if file.is_absolute() or ".." in file.parts:
            continue
        place = site / file
        place.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError, FileExistsError):  # bytecode that nothing needed
            try:
                os.link(str(one.locate_file(file)), place)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                shutil.copy2(str(one.locate_file(file)), place)


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a fresh environment with the wheel and what it asks for.

    That is linked from where it is installed here, which is much faster than to install it again.
    """
    folder = tmp_path_factory.mktemp("wheel")
    venv.create(folder / "environment")
    python = folder / "environment" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    probe = [
        "download",
        "--no-deps",
        "--no-cache-dir",
        "--dest",
        folder / "probe",
        "setuptools>=77",
    ]
    asked = subprocess.run([*pip, *probe], env=_bare(), capture_output=True, text=True, check=False)
    if asked.returncode:
        pytest.skip(f"no package registry answers: {asked.stderr.strip().splitlines()[-1]}")
    _run(*pip, "wheel", "--no-deps", "--wheel-dir", folder, clone(folder / "clone"), folder=folder)
    (wheel,) = folder.glob("heliotwin-*.whl")
    alone = ["install", "--no-deps", "--no-index", "--no-compile", wheel]
    _run(*pip, "--python", python, *alone, folder=folder)
    (site,) = (folder / "environment" / "lib").glob("python*/site-packages")
    for one in _asked_for(site).values():
        _put(one, site)
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
    said = _run(python, "-c", "import heliotwin; print(heliotwin.__version__)", folder=tmp_path)
    assert said.strip() == heliotwin_package.__version__
    assert heliotwin(python, tmp_path, "--version").strip() == f"heliotwin {said.strip()}"


def test_demonstration(python: Path, pair_plant: Path, tmp_path: Path):
    done = report(python, tmp_path, "demo", "--data", pair_plant, "--out", "demo")
    assert len(done["heliostats"]) == 2
    # These photographs have few rays: their noise may look like an error of the model.
    assert done["study"]["verdict"] in ("none", "unexplained")
    assert "<html" in (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")


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
        assert '<a href="/docs/guide">Guide</a>' in httpx.get(f"http://127.0.0.1:{port}/").text
        guide = httpx.get(f"http://127.0.0.1:{port}/docs/guide", follow_redirects=True)
        for page in ("", "how-to/operator/alarms.html", "reference/generated/settings.html"):
            answer = httpx.get(guide.url.join(page))
            assert (answer.status_code, "<h1" in answer.text) == (200, True), page
        process.terminate()
        assert process.wait(WAIT_LIMIT_S) in (0, -15)
    assert "Traceback" not in (tmp_path / "log").read_text(encoding="utf-8")
