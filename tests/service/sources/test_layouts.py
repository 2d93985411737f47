"""Layouts as CSV: what is read as a position, what is refused, and what is assumed."""

from pathlib import Path

import numpy as np
import pytest

from model.errors import InvalidInputError
from service.sources.plant_file import read_plant
from service.sources.plant_formats.formats import import_plant, read_foreign
from service.sources.plant_formats.imported import ImportedPlant
from service.sources.text_lines import csv_lines
from tests.service.command import ends, heliotwin


def imported(folder: Path, text: str) -> ImportedPlant:
    file = folder / "field.csv"
    file.write_text(text)
    return read_foreign(file)


def feet(plant: ImportedPlant) -> list[tuple[float, float, float]]:
    return [(one.east_m, one.north_m, one.up_m) for one in plant.heliostats]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0,1,1,10,20,3\n0,1,1,30,40,3\n", [(10, 20, 3), (30, 40, 3)]),
        ("0,1,1,10,20,3\n0,0,1,30,40,3\n0,1,0,30,50,3\n", [(10, 20, 3)]),
        ("0,1,1,10,20,3,NULL,NULL,NULL,NULL,NULL,0,0,60\n", [(10, 20, 3)]),
        ("0,1,1,10,20,3,NULL,NULL,NULL,NULL,NULL,0,0,60,\n", [(10, 20, 3)]),
        ("0,10,20,3,100,100\n0,30,40,3,100,100\n", [(10, 20, 3), (30, 40, 3)]),
        ('"x","y"\r\n"1.5","-2e1"\r\n,\r\n', [(1.5, -20, 0)]),
        ("North (m),East (m)\n7,8\n", [(8, 7, 0)]),
        ("# a\n\n 1 , 2 \n 3 ,4\n", [(1, 2, 0), (3, 4, 0)]),
    ],
)
def test_layouts_are_read(tmp_path: Path, text: str, expected: list[tuple[float, float, float]]):
    assert feet(imported(tmp_path, text)) == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1,0,81\n2,5,90\n3,9,95\n", "the first cells count the lines"),
        ("0,0,81,0\n1,5,90,0\n2,9,95,0\n", "the first cells count the lines"),
        ("x|y\n1|2\n", "separated by bars"),
        ("1 2 3\n4 5 6\n", "separated by blanks"),
        ("1;2\n3;4\n", "separated by semicolons"),
        ("1\t2\n3\t4\n", "separated by tabs"),
        ("X [ft],Y [ft]\n1,2\n", "columns are not understood"),
        ("0,1,1,10\n0,1,1,20\n0,1,1,\n", "line 3: has 3 cells"),
        ("0,0,1,10,20,3\n", "no heliostat that is enabled"),
        (
            "Heliostat ID,Pos-x,Pos-y,Pos-z,Aim-x,Aim-y,Aim-z\n1,2,3,0,0,0,9\n1,5,3,0,0,0,9\n",
            "line 3",
        ),
    ],
)
def test_what_may_be_something_else_is_refused(tmp_path: Path, text: str, said: str):
    with pytest.raises(InvalidInputError, match=said):
        imported(tmp_path, text)


def test_columns_that_are_left_out_are_named(tmp_path: Path):
    head = "Heliostat ID,Cosine,Pos-x,Pos-y,Pos-z,Aim-x,Aim-y,Aim-z,Soiling\n"
    plant = imported(tmp_path, head + "1,0.9,2,30,0,0,0,60,0.9\n2,0.8,9,30,0,0,0,60,0.8\n")
    reflectances = [k["reflectance"] for k in plant.parts["heliostat_types"].values()]
    assert reflectances == pytest.approx([0.81, 0.72])  # of mirrors of 0.9, as is said
    assert [one.type for one in plant.heliostats] == ["T0", "T1"]
    assert any("left out: Cosine" in note for note in plant.notes)


@pytest.mark.parametrize(
    ("signs", "normal"), [((1, -1), [0, -1, 0]), ((1, 1), [0, 1, 0]), ((0, 1), [1, 0, 0])]
)
def test_a_receiver_faces_its_field(tmp_path: Path, signs: tuple[int, int], normal: list[int]):
    """A field north, south or east of its tower."""
    along, side = signs
    places = [(offset, 100 + step) for offset in (-30, 0, 30) for step in (0, 20)]
    rows = [
        f"0,{x if along else y},{side * y if along else x},0,NULL,NULL,NULL,NULL,NULL,0,0,60"
        for x, y in places
    ]
    plant = imported(tmp_path, "\n".join(rows))
    receiver = plant.parts["receivers"]["main"]
    assert (receiver["kind"], receiver["normal"]) == ("plane", normal)


def test_a_field_all_around_gets_a_cylinder(tmp_path: Path):
    angles = np.arange(12) * np.pi / 6
    rows = [
        f"0,{100 * np.sin(a):.3f},{100 * np.cos(a):.3f},0,NULL,NULL,NULL,NULL,NULL,0,0,60"
        for a in angles
    ]
    receiver = imported(tmp_path, "\n".join(rows)).parts["receivers"]["main"]
    assert (receiver["kind"], receiver["center_m"]) == ("cylinder", [0, 0, 60])


def test_what_is_assumed_is_said_first_and_the_plant_has_the_files_name(tmp_path: Path):
    file = tmp_path / "my field.csv"
    file.write_text("x,y\n0,100\n5,120\n")
    done = heliotwin("plant", "import", file, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("Assumed, for the file does not say it")
    assert "Daggett" in lines[1]
    assert "pivot height 0 m" in done.stdout
    assert lines[-1].startswith("2 heliostats in")
    assert read_plant(tmp_path / "out" / "plant.yaml").plant.name == "my-field"


def test_a_corrected_file_can_be_imported_to_the_same_folder(tmp_path: Path):
    file, out = tmp_path / "field.csv", tmp_path / "out"
    file.write_text("x,y\n0,100\n0,100\n")
    ends(heliotwin("plant", "import", file, "--out", out), 2, f"{file}: makes no plant: layout.csv")
    assert not out.exists()
    file.write_text("x,y\n0,100\n5,120\n")
    import_plant(file, out)
    assert (out / "plant.yaml").exists()


def test_one_reader_of_csv_names_lines():
    lines = list(csv_lines("a.csv", '#\n"x","y"\n\n,\n1,"2"\n'))
    assert [(line.place, list(line.cells)) for line in lines] == [
        ("a.csv, line 2", ["x", "y"]),
        ("a.csv, line 5", ["1", "2"]),
    ]
