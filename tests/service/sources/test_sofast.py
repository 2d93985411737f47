"""Mirrors that OpenCSP's SOFAST measured, as surfaces of a plant's heliostats."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from model.errors import InvalidInputError
from model.plant import Heliostat
from model.surface import basis, control_points, evaluate
from service.sources.folder import read_folder, read_surface
from service.sources.hdf5 import SOFAST_SHAPE
from service.sources.plant_file import read_plant
from tests.service.sources import plant_files

FACETS = "DataSofastCalculation/facet"
GRIDS = {
    "one": "{rows: 1, columns: 1, width_m: 1.2192, height_m: 1.2192}",
    "four": "{rows: 2, columns: 2, width_m: 1.2, height_m: 1.1, gap_m: 0.05}",
}
PLANT = """\
plant: {{name: nsttf, latitude_deg: 34.96, longitude_deg: -106.5}}
heliostat_types:
  kind:
    mount: {{kind: azimuth_elevation}}
    facets: {grid}
    facet_shape: {shape}
layout: {{heliostats: [{{name: A1, type: kind, east_m: 0, north_m: 100, up_m: 0}}]}}
receivers:
  main: {{kind: plane, center_m: [0, 0, 60], normal: [0, 1, 0], width_m: 6, height_m: 6}}
"""


def write_folder(root: Path, grid: str = "one", shape: str = "flat") -> Heliostat:
    """A folder with a heliostat; the heliostat."""
    (root / "A1" / "Deflectometry").mkdir(parents=True)
    path = root / "plant.yaml"
    path.write_text(PLANT.format(grid=GRIDS[grid], shape=shape))
    return read_plant(path).plant.heliostats["A1"]


def write_sofast(root: Path, heliostat: Heliostat, surface: np.ndarray) -> Path:
    """The measurement of control points (F, I, J, 3) by SOFAST; ensembles are in another order."""
    path = root / "A1" / "Deflectometry" / "mirror.h5"
    centers, axes, _ = heliostat.facet_frames
    grid = np.linspace(0.01, 0.99, 40)
    with h5py.File(path, "w") as file:
        for number, facet in enumerate(np.roll(np.arange(len(surface)), 1)):
            points, normals = (a.reshape(-1, 3) for a in evaluate(surface[facet], grid, grid))
            where, suffix = "CalculationEnsemble", "ensemble"
            slopes = "slopes_ensemble_xy"
            if len(surface) == 1:
                points, normals = (points - centers[0]) @ axes[0].T, normals @ axes[0].T
                where, suffix, slopes = "SlopeSolverData", "facet", "slopes_facet_xy"
            group = file.create_group(f"{FACETS}/facet_{number:03d}/{where}")
            group[f"v_surf_points_{suffix}"] = points.T
            group[slopes] = -(normals[:, :2] / normals[:, 2:]).T
    return path


@pytest.mark.parametrize("grid", ["one", "four"])
@pytest.mark.parametrize("shape", ["flat", "{focal_length_m: 110}"])
def test_slopes_become_the_surface_they_are_of(tmp_path: Path, grid: str, shape: str):
    heliostat = write_folder(tmp_path, grid, shape)
    z = np.random.default_rng(3).normal(0, 2e-4, (len(heliostat.facets), *SOFAST_SHAPE))
    z -= z.mean(axis=(1, 2), keepdims=True)
    surface = control_points(heliostat, z)
    write_sofast(tmp_path, heliostat, surface)
    found = read_folder(tmp_path).measured_surface("A1")
    assert found is not None
    assert found[0].shape == surface.shape
    assert np.abs(found[0] - surface).max() < 1e-5


def test_the_published_measurement_is_recovered(tmp_path: Path):
    source = plant_files.published() / "opencsp" / "data.h5"
    heliostat = write_folder(tmp_path, shape="{focal_length_m: 110}")
    (tmp_path / "A1" / "Deflectometry" / "sofast.h5").write_bytes(source.read_bytes())
    found = read_surface(tmp_path, heliostat)
    assert found is not None
    with h5py.File(source) as data:
        solved = data[f"{FACETS}/facet_000/SlopeSolverData"]
        points, slopes = solved["v_surf_points_facet"][()], solved["slopes_facet_xy"][()]
    assert slope_rms_mrad(found[0][0], points, slopes, heliostat) < 0.16
    assert slope_rms_mrad(control_points(heliostat)[0], points, slopes, heliostat) > 0.7


def slope_rms_mrad(
    surface: np.ndarray, points: np.ndarray, slopes: np.ndarray, heliostat: Heliostat
) -> float:
    """Root mean square of slope differences [mrad] of control points (I, J, 3) at SOFAST's."""
    _, axes, half_sizes = heliostat.facet_frames
    u, v = points[:2] / (2 * half_sizes[0][:, None]) + 0.5
    along_u, along_v = (basis(n, 3, x) for n, x in zip(surface.shape[:2], (u, v), strict=True))
    tangents = [
        np.einsum("ni,ijc,nj->nc", a, surface @ axes[0].T, b)
        for a, b in ((along_u.slopes, along_v.values), (along_u.values, along_v.slopes))
    ]
    normals = np.cross(*tangents)
    apart = -normals[:, :2] / normals[:, 2:] - slopes.T
    return float(1e3 * np.sqrt((apart**2).sum(axis=1).mean()))


def shrunk(file: h5py.File) -> None:
    file[f"{FACETS}/facet_000/SlopeSolverData/v_surf_points_facet"][...] *= 0.7


def fewer(file: h5py.File) -> None:
    del file[f"{FACETS}/facet_000/SlopeSolverData/slopes_facet_xy"]
    file[f"{FACETS}/facet_000/SlopeSolverData/slopes_facet_xy"] = np.zeros((2, 7))


def more(file: h5py.File) -> None:
    file.create_group(f"{FACETS}/facet_001")


def flat(file: h5py.File) -> None:
    del file[f"{FACETS}/facet_000/SlopeSolverData/slopes_facet_xy"]
    file[f"{FACETS}/facet_000/SlopeSolverData/slopes_facet_xy"] = np.zeros((3, 1600))


def unsolved(file: h5py.File) -> None:
    del file[f"{FACETS}/facet_000/SlopeSolverData"]


@pytest.mark.parametrize(
    ("change", "refusal"),
    [
        (shrunk, r"SlopeSolverData: measures 0\.836 x 0\.836 m, the plant's facet is 1\.219"),
        (fewer, r"'v_surf_points_facet' has 1600 points, 'slopes_facet_xy' has 7"),
        (more, r"DataSofastCalculation/facet: has 2 facets, heliostat A1 has 1; measure all"),
        (flat, r"'slopes_facet_xy' must be numbers of shape \(2, n\), got float64 \(3, 1600\)"),
        (unsolved, r"facet_000: 'SlopeSolverData' is missing"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, change: Callable[[h5py.File], None], refusal: str):
    heliostat = write_folder(tmp_path)
    path = write_sofast(tmp_path, heliostat, control_points(heliostat))
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InvalidInputError, match=refusal) as error:
        read_surface(tmp_path, heliostat)
    assert str(path) in str(error.value)


def test_facets_without_an_ensemble_or_elsewhere_are_named(tmp_path: Path):
    heliostat = write_folder(tmp_path, "four")
    path = write_sofast(tmp_path, heliostat, control_points(heliostat))
    with h5py.File(path, "r+") as file:
        file[f"{FACETS}/facet_001/CalculationEnsemble/v_surf_points_ensemble"][0] += 0.5
    with pytest.raises(InvalidInputError, match=r"no measured facet is at .* where facet 1 of A1"):
        read_surface(tmp_path, heliostat)
    with h5py.File(path, "r+") as file:
        del file[f"{FACETS}/facet_002/CalculationEnsemble"]
    with pytest.raises(InvalidInputError, match="facet_002: 'CalculationEnsemble' is missing"):
        read_surface(tmp_path, heliostat)
