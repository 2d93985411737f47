"""Slopes of a mirror by SOFAST, and of its surface: ``python -m benchmarks.sofast``.

The mirror is OpenCSP's example, one facet of the NSTTF.
"""

import tempfile
from pathlib import Path

import h5py
import numpy as np

from benchmarks.record import log_row, recording
from model.surface import control_points, heights
from service.sources.folder import read_surface
from service.sources.hdf5 import SOFAST_SHAPE
from tests.service.sources import plant_files
from tests.service.sources.test_sofast import FACETS, slope_rms_mrad, write_folder


def main() -> None:
    """Print and record what each surface leaves of the slopes."""
    source = plant_files.published() / "opencsp" / "data.h5"
    with h5py.File(source) as data:
        solved = data[f"{FACETS}/facet_000/SlopeSolverData"]
        points, slopes = solved["v_surf_points_facet"][()], solved["slopes_facet_xy"][()]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        heliostat = write_folder(folder, shape="{focal_length_m: 110}")
        (folder / "A1" / "Deflectometry" / "sofast.h5").write_bytes(source.read_bytes())
        surface = read_surface(folder, heliostat)
    assert surface is not None
    stored = control_points(heliostat, heights(heliostat, *surface))
    surfaces = {
        f"as read, {SOFAST_SHAPE[0]} x {SOFAST_SHAPE[1]} heights": surface[0],
        "as stored, 8 x 8 heights": stored,
        "paraboloid of plant.yaml, 110 m": control_points(heliostat),
    }
    for row, tried in surfaces.items():
        left = slope_rms_mrad(tried[0], points, slopes, heliostat)
        print(f"{row}: {left:.3f} mrad")
        log_row(
            "Slopes of SOFAST's mirror",
            row,
            {"rms difference [mrad]": left},
            n=int(np.size(points) // 3),
            of="points of one facet",
            compared_with="SOFAST (OpenCSP's example)",
        )


if __name__ == "__main__":
    with recording("sofast"):
        main()
