"""What the tests share: where the real data lie, and small scenes."""

import fcntl
import gc
import os
import shutil
import subprocess
import sys
import tempfile

# Two cores, several test processes: threads of linear algebra would only spin against each other.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import torch
from coverage import Coverage
from xdist.scheduler import LoadScopeScheduling

from benchmarks import data_folder
from heliotwin.demo.plant import write_plant
from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from tests.quick_services import copied_schema, shared_routes, written_state
from tests.undeclared import camera
from tests.waiting import WAIT_LIMIT_S
from tests.watched import NotWatchedError, environment, watching

torch.set_num_threads(1)

# Fixtures of the session belong here: two folders that import one have two of it, one in the other.
__all__ = ["copied_schema", "shared_routes", "written_state"]

OF_ONE_WORKER = (
    # A container that starts or stops changes the network, and a browser then drops its requests.
    ("tests/docker/test_composition.py", "tests/service/browser/"),
    ("tests/test_wheel.py",),
    ("tests/heliotwin/cli/test_demo_field.py",),
    ("tests/heliotwin/test_library.py",),
    ("tests/test_additions.py",),
    ("tests/model/test_refinement.py",),
    ("tests/docker/test_client.py",),
    ("tests/service/web/test_page_texts.py",),
    ("tests/service/web/test_aim_plans.py",),
)
"""Files and folders whose tests share what is expensive to make (an image, a browser, an
environment, a surface), or disturb each other. The longest come first, and they come before all
others.
"""
FULL = (
    "tests/docker/test_client.py",
    "tests/docker/test_composition.py",
    "tests/docker/test_generated_client.py",
    "tests/documents/test_commands.py",
    "tests/faults/",
    "tests/heliotwin/test_networks.py",
    "tests/heliotwin/test_notebooks.py",
    "tests/service/browser/",
    "tests/service/web/test_large_field.py",
    "tests/service/web/test_openapi_fuzz.py",
    "tests/test_additions.py",
    "tests/test_silence.py",
    "tests/test_wheel.py",
    "tests/undeclared/",
)
"""Files and folders that only ``make test-all`` runs: their tests have the marker ``full``."""

# Time limit of requests that set none: the default of 5 s would fail on a busy machine.
_patient = httpx.Timeout(WAIT_LIMIT_S)
for _phase in ("connect", "read", "write", "pool"):
    setattr(httpx._config.DEFAULT_TIMEOUT_CONFIG, _phase, getattr(_patient, _phase))


class FileScheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Distributes single tests, but those `OF_ONE_WORKER` together.

    It replaces pytest-xdist's ``loadgroup``, which has no effect from pytest 9.2 on: xdist 3.8
    writes the group to ``Item._nodeid``, which pytest does not read any more.
    """

    def _split_scope(self, nodeid: str) -> str:
        return next((places[0] for places in OF_ONE_WORKER if nodeid.startswith(places)), nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> FileScheduling | None:
    """The scheduler for ``--dist loadgroup``."""
    if config.getvalue("dist") != "loadgroup":
        return None
    config.option.loadscopereorder = False  # the order is that of the collection
    return FileScheduling(config, log)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark as ``full`` what lies in such a place, or needs PostgreSQL."""
    if item.nodeid.startswith(FULL) or item.get_closest_marker("postgres"):
        item.add_marker("full")


@pytest.hookimpl(trylast=True)  # after pytest has grouped those with the same parameters
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest, and with files that hold long tests: at the end no worker has one
    alone.
    """
    long = {item.path for item in items if item.get_closest_marker("full")}

    def order(item: pytest.Item) -> tuple[int, bool]:
        places = enumerate(OF_ONE_WORKER)
        place = next((n for n, own in places if item.nodeid.startswith(own)), len(OF_ONE_WORKER))
        return place, item.path not in long

    items.sort(key=order)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Spare the garbage collector what stays: modules and tests are millions of objects.

    Where coverage is measured, it is that of processes that tests start, too.
    """
    gc.freeze()
    if Coverage.current() is not None:
        os.environ["COVERAGE_PROCESS_START"] = str(session.config.rootpath / "pyproject.toml")
        os.environ["COVERAGE_FILE"] = str(session.config.rootpath / ".coverage")


@pytest.fixture(scope="session", autouse=True)
def drawn_sheets() -> Iterator[None]:
    """The generator's sets are the same with or without the real data: their sheets are drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera, "sheet", camera.drawn_sheet)
        yield


@pytest.fixture(scope="session")
def stj() -> Path:
    """The real measurements of the Solar Tower Juelich; tests that need them skip where they are
    absent.
    """
    root = data_folder()
    if not root.is_dir():
        pytest.skip(f"no real measurements at {root}; set HELIOTWIN_STJ")
    return root


@pytest.fixture(scope="session")
def stj_pointing(stj: Path) -> Path:
    """Motors and spots of 16 real heliostats, which lie beside the real measurements."""
    root = stj.parent / "stj-pointing"
    if not root.is_dir():
        pytest.skip(f"no real motors and spots at {root}")
    return root


@pytest.fixture(scope="session")
def undeclared(stj: Path) -> Path:
    """The six sets of images with unknown effects, which lie beside the real measurements."""
    root = stj.parent / "undeclared"
    if not root.is_dir():
        pytest.skip(f"no sets at {root}")
    return root


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first of several test processes makes and all share; read it only."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    folder = base / f"shared-{name}"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            unfinished = Path(tempfile.mkdtemp(dir=base))
            make(unfinished)
            unfinished.rename(folder)
    return folder


@pytest.fixture(scope="session")
def made_plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration's plant with few images and rays; read it only."""
    return made_once(
        tmp_path_factory, "plant", lambda root: write_plant(root, images=4, rays=60_000)
    )


def _some_of(plant: Path, root: Path, *heliostats: str) -> None:
    """Copy the plant with these heliostats."""
    for path in plant.iterdir():
        if path.is_file():
            shutil.copy(path, root)
        elif path.name in heliostats:
            shutil.copytree(path, root / path.name)


@pytest.fixture(scope="session")
def pair_plant(made_plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same plant with two of its heliostats, for what holds for each alone; read it only."""
    return made_once(
        tmp_path_factory, "pair-plant", lambda root: _some_of(made_plant, root, "AB12", "AC31")
    )


@pytest.fixture(scope="session")
def single_plant(made_plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same plant with one heliostat, for what holds for each photograph; read it only."""
    return made_once(
        tmp_path_factory, "single-plant", lambda root: _some_of(made_plant, root, "AB12")
    )


@pytest.fixture(scope="session")
def demonstration(pair_plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which ``heliotwin demo`` ran; read it only.

    ``out/demo`` is what it leaves, ``said`` what it said. ``calls`` is the record of its
    connections (`tests.watched`), where they can be watched.
    """

    def make(folder: Path) -> None:
        shutil.copytree(pair_plant, folder / "out" / "demo" / "plant")
        watch: list[str] = []
        with suppress(NotWatchedError):
            watch = watching(folder / "calls")
        command = [*watch, sys.executable, "-m", "service", "demo", "--data", "out/demo/plant"]
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment(folder),
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        (folder / "said").write_text(done.stderr, encoding="utf-8")

    return made_once(tmp_path_factory, "demonstration", make)


def flat_heliostat(
    position=(0.0, 60.0, 1.8), focal_length: float | None = None, mount: Mount | None = None
) -> Heliostat:
    """Four facets of 1.605 m x 1.275 m, flat in one plane or canted to a focal length [m]."""
    return Heliostat.juelich("flat", position, focal_length, mount=mount, facet_depth=0.0)


def target(size: float = 8.0, center=(0.0, 0.0, 40.0)) -> TargetPlane:
    """A square target on the tower that faces the field in the north."""
    return TargetPlane(
        "target", np.array(center), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), size, size
    )
