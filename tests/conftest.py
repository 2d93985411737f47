"""What the tests share: where the real data lie, and small scenes."""

import os

# Two cores, several test processes: threads of linear algebra would only spin against each other.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from tests.benchmarks import data_folder
from tests.undeclared import camera

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def drawn_sheets() -> Iterator[None]:
    """The generator's sets are the same with or without the real data: their sheets are drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera, "sheet", camera.drawn_sheet)
        yield


@pytest.fixture(scope="session")
def stj() -> Path:
    """The real measurements of the Solar Tower Juelich; tests that need them skip where they are absent."""
    root = data_folder()
    if not root.is_dir():
        pytest.skip(f"no real measurements at {root}; set HELIOTWIN_STJ")
    return root


@pytest.fixture(scope="session")
def undeclared(stj: Path) -> Path:
    """The six sets of images with unknown effects, which lie beside the real measurements."""
    root = stj.parent / "undeclared"
    if not root.is_dir():
        pytest.skip(f"no sets at {root}")
    return root


def flat_heliostat(
    position=(0.0, 60.0, 1.8), focal_length: float | None = None, mount: Mount | None = None
) -> Heliostat:
    """Four facets of 1.605 m x 1.275 m, flat in one plane or canted to a focal length [m]."""
    return Heliostat.juelich("flat", position, focal_length, mount=mount, facet_depth=0.0)


def target(size: float = 8.0, center=(0.0, 0.0, 40.0)) -> TargetPlane:
    """A square target on the tower that faces the field in the north."""
    return TargetPlane("target", np.array(center), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), size, size)
