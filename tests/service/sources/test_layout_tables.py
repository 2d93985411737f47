"""Tables of positions and layouts: each is read as what it is, or refused by what is wrong."""

from pathlib import Path

import pytest

from model.errors import InvalidInputError
from service.sources.plant_formats.formats import read_foreign
from service.sources.plant_formats.imported import ImportedPlant

COLUMNS = (
    "Template,In layout,Enabled,Loc. X,Loc. Y,Loc. Z,X focus,Y focus,Cant vect.,Cant vect.,Cant"
    " vect.,Aim pt. X,Aim pt. Y,Aim pt. Z,\n,,,[m],[m],[m],[m],[m],<i>,<j>,<k>,[m],[m],[m],\n"
)
ROW = "0,1,1,-20,80,5,NULL,NULL,NULL,NULL,NULL,0,4,60"
OLD = COLUMNS.replace("In layout,Enabled,", "").replace(",,,[m]", ",[m]")
RESULTS = "Heliostat ID,Pos-x,Pos-y,Pos-z,Aim-x,Aim-y,Aim-z"
TITLES = "\nSolar azimuth,180.00,deg\nSolar zenith,30.00,deg\nDNI,950.00,W/m2\n\n"


def read(folder: Path, text: str) -> ImportedPlant:
    """What a table is read as."""
    file = folder / "field.csv"
    file.write_text(text)
    return read_foreign(file)


@pytest.mark.parametrize(
    "text",
    [
        COLUMNS + ROW,
        COLUMNS + ROW + ",\n",
        COLUMNS.split("\n")[0] + "\n" + ROW,
        COLUMNS + ROW.lower(),
        OLD + ROW.replace("0,1,1,", "0,", 1),
        ROW,
        "0,1,1,-20,80,5\n",
        "0,1.0,1.0,-20,80,5,\n",
        '"0", "1","1","-20","80","5"\n'.replace(" ", ""),
        "0,-20,80,5,NULL,NULL\n",
        "sep=,\nx,y,z\n-20,80,5\n",
        f"{RESULTS}\n7,-20,80,5,0,4,60\n",
        f"{TITLES}{RESULTS},\n7,-20.00,80.00,5.00,0.00,4.00,60.00,\n",
    ],
)
def test_each_layout_is_read_as_it_is_meant(tmp_path: Path, text: str):
    (entry,) = read(tmp_path, text).heliostats
    assert (entry.east_m, entry.north_m, entry.up_m) == (-20, 80, 5)


@pytest.mark.parametrize(
    ("column", "cell", "reflectance"),
    [
        ("Reflectivity,Soiling", "0.94,0.95", 0.893),
        ("Reflectivity", "0.94", 0.94),
        ("Soiling", "0.95", 0.855),
        ("Total eff", "0.5", 0.9),
    ],
)
def test_reflectance_is_the_files_or_is_said_to_be_assumed(
    tmp_path: Path, column: str, cell: str, reflectance: float
):
    imported = read(tmp_path, f"{TITLES}{RESULTS},{column}\n7,-20,80,5,0,4,60,{cell}\n")
    assert imported.parts["heliostat_types"]["T0"]["reflectance"] == pytest.approx(reflectance)
    assert any(column.split(",")[-1] in note for note in imported.notes)
    assert any("Solar zenith 30.00 deg" in note for note in imported.notes)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("x y\n0 81\n", "line 1: cells are separated by blanks"),
        ("0   81   0\n", "line 1: cells are separated by blanks"),
        ("0,5;81,2\n", "line 1: cells are separated by semicolons"),
        (f"{TITLES}{RESULTS}\n7,1,2".replace(RESULTS, RESULTS.replace(",", "\t")), "by tabs"),
        ("1,0,81\n2,5,90\n", "the first cells count the lines"),
        ("101,0,81\n102,5,90\n103,6,95\n", "the first cells count the lines"),
        ("x,y,x\n0,81,3\n", "column 'x' is there twice"),
        (f"{RESULTS}\n", "no heliostat follows"),
        (COLUMNS + ROW.replace("NULL", "0.5"), "has a canting vector"),
    ],
)
def test_what_is_wrong_with_a_table_is_named(tmp_path: Path, text: str, error: str):
    with pytest.raises(InvalidInputError, match=error):
        read(tmp_path, text)
