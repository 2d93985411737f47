"""Small files that failed, from public reports: what each is read as, or why it is refused.

They are in ``../shared/cases`` (`HELIOTWIN_CASES`), each with a README.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from model.errors import InvalidInputError
from service.sources.decode import decode_image
from service.sources.plant_file import read_plant
from service.sources.plant_formats.formats import import_plant, read_foreign
from service.sources.plant_formats.imported import ImportedPlant
from tests.service.sources.plant_files import ROOT


def case(name: str) -> Path:
    """A file of the cases; skips if they are not there."""
    root = Path(os.environ.get("HELIOTWIN_CASES", ROOT.parent / "shared" / "cases"))
    if not root.is_dir():
        pytest.skip(f"{root} is not there")
    return root / name


def places(imported: ImportedPlant) -> list[tuple[float, float, float]]:
    """Positions [m] of all heliostats."""
    return [(one.east_m, one.north_m, one.up_m) for one in imported.heliostats]


def test_flat_facets_of_even_control_points_are_no_measured_surface(tmp_path: Path):
    imported, _ = import_plant(case("artist-ideal-measured/ideal-even-grid.h5"), tmp_path)
    assert imported.surfaces == {}
    (kind,) = imported.parts["heliostat_types"].values()
    assert (kind["facet_shape"], kind["canting"]) == ("flat", "on_axis")
    facets = read_plant(tmp_path / "plant.yaml").plant.heliostats["H1"].facets
    assert len(facets) == 4


def test_a_scenario_of_artist_1_is_read(tmp_path: Path):
    imported, _ = import_plant(case("artist-v1/scenario-v1.h5"), tmp_path)
    assert len(imported.heliostats) == 2
    assert list(read_plant(tmp_path / "plant.yaml").plant.targets) == ["lower"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("quoted", [(0, 80, 0), (15, 80, 0)]),
        ("xyz", [(0, 81, 0), (-16.01, 79.402, 1)]),
        ("sam-positions", [(0, 81, 0), (-16.01, 79.402, 0)]),
        ("bom-crlf", [(0, 81, 0), (-16.01, 79.402, 0)]),
        ("excel-tail", [(0, 81, 0), (-16.01, 79.402, 0)]),
        ("leading-zero", [(0, 81, 0), (5, 90, 0)]),
        ("units-in-head", [(0, 81, 0), (5, 90, 0)]),
        ("mac-cr", [(0, 81, 0), (-16.01, 79.402, 0)]),
        ("comment", [(0, 81, 0), (5, 90, 0)]),
    ],
)
def test_tables_are_read(tmp_path: Path, name: str, expected: list[tuple[float, float, float]]):
    imported, _ = import_plant(case(f"csv-tables/{name}.csv"), tmp_path)
    assert places(imported) == expected


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("semicolon", "line 1: cells are separated by semicolons"),
        ("tab", "line 1: cells are separated by tabs"),
        ("dup-id", "dup-id.csv, line 3: name '1' is that of line 2"),
        ("duplicate-position", "H2 is at the place of H1"),
        ("slash", "line 2: name 'B/12'"),
    ],
)
def test_tables_that_are_refused_write_nothing(tmp_path: Path, name: str, said: str):
    with pytest.raises(InvalidInputError) as refused:
        import_plant(case(f"csv-tables/{name}.csv"), tmp_path / "out")
    assert f"{name}.csv" in str(refused.value)
    assert said in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_a_layout_that_solarpilots_program_exports_is_read():
    imported = read_foreign(case("solarpilot-gui-export/layout-export.csv"))
    assert places(imported) == [(-20, 80, 0), (20, 80, 0)]
    np.testing.assert_allclose(imported.aims["H2"], [0, 4, 60])
    assert any("not in the layout: 1 heliostat." in note for note in imported.notes)


def test_reflectivity_and_soiling_are_read():
    imported = read_foreign(case("solarpilot-reflectivity/solarpilot-results.csv"))
    assert imported.parts["heliostat_types"]["T0"]["reflectance"] == pytest.approx(0.893)


@pytest.mark.parametrize(
    "name",
    [
        "crlf",
        "latin1-name",
        "old-without-header",
        "saved-by-soltrace-2012",
        "saved-by-soltrace-3",
        "solarpilot-style",
    ],
)
def test_soltrace_files_as_programs_save_them(name: str):
    imported = read_foreign(case(f"soltrace-gui-file/{name}.stinput"))
    np.testing.assert_allclose(places(imported), [(-20, 80, 4), (0, 90, 4), (20, 80, 4)])
    lengths = [one.focal_length_m for one in imported.heliostats]
    np.testing.assert_allclose(lengths, [99.6795, 106, 99.6795], rtol=1e-5)
    (kind,) = imported.parts["heliostat_types"].values()
    assert (kind["reflectance"], kind["slope_error_mrad"], kind["pointing_error_mrad"]) == (
        0.93,
        1.2,
        0.3,
    )
    assert imported.parts["receivers"]["main"]["absorptance"] == 0.95


def test_a_lamp_is_no_sun():
    with pytest.raises(InvalidInputError, match="line 2: a point source, PTSRC 1, is no sun"):
        read_foreign(case("soltrace-point-source/pt.stinput"))


@pytest.mark.parametrize("name", ["o-exif6", "p-exif3"])
def test_photographs_are_turned_as_their_exif_says(name: str):
    light = decode_image(case(f"exif-orientation/{name}.jpg").read_bytes())[..., 1]
    assert light.shape == (1080, 1440)
    light[:60] = 0  # its caption
    row, column = np.argwhere(light > 0.95 * light.max()).mean(axis=0) / light.shape
    assert (row, column) == pytest.approx((0.47, 0.45), abs=0.03)
