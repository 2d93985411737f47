"""SolTrace's files: facets of one heliostat stay one, by any author."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from model.errors import InvalidInputError
from model.frames import sun_direction
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.formats import foreign_text, import_plant, read_foreign
from service.sources.plant_formats.soltrace_export import soltrace_text
from service.sources.plant_formats.soltrace_mirrors import NAMED_STAGE
from tests.service.sources.plant_files import write_plant
from tests.service.sources.test_plant_formats import SMALL

SUN_DEG = (160.0, 48.0)
HEAD = """\
plant: {{name: daggett, latitude_deg: 34.86, longitude_deg: -116.83, altitude_m: 600}}
heliostat_types:
  one:
    mount: {{kind: azimuth_elevation}}
    facets: {facets}
    facet_shape: {shape}
    canting: {canting}
    reflectance: 0.93
    slope_error_mrad: 1.2
    pointing_error_mrad: 0.3
layout: {{file: layout.csv}}
receivers: {receivers}
sun: {{shape: pillbox, half_angle_mrad: 4.65}}
"""
CYLINDER = "{kind: cylinder, center_m: [0, 0, 90], radius_m: 4, height_m: 10, absorptance: 0.95}"
PLANE = "{kind: plane, center_m: [0, 2, 80], normal: [0, 1, 0], width_m: 9, height_m: 8}"
PANELS = (
    "{kind: panels, panels: [{center_m: [-2, 1, 80], normal: [0, 1, 0], width_m: 4, height_m: 8},"
    " {center_m: [2, 1, 80], normal: [0, 1, 0], width_m: 4, height_m: 8}]}"
)
FACETS = """\
x_m,y_m,z_m,width_m,height_m,canting_x_mrad,canting_y_mrad
-1.6,0,0,3,3,4,0
1.6,0,0.05,3,2.8,-5,1
0,3.2,0,2.9,3,0,-3
"""


def made(
    folder: Path,
    facets: str = "{rows: 2, columns: 3, width_m: 1.8, height_m: 1.35, gap_m: 0.02}",
    shape: str = "slant_range",
    canting: str = "on_axis",
    receivers: str = f"{{main: {CYLINDER}}}",
    layout: str = "A1,one,-30,120,0\nA2,one,0,140,1\nA3,one,60,90,2\nA4,one,-90,-40,0\n",
) -> PlantDescription:
    """A plant of one type."""
    text = HEAD.format(facets=facets, shape=shape, canting=canting, receivers=receivers)
    path = write_plant(folder, text, layout="name,type,east_m,north_m,up_m\n" + layout)
    (folder / "facets.csv").write_text(FACETS)
    return read_plant(path)


def exported(plant: PlantDescription) -> str:
    return foreign_text(plant, "soltrace", SUN_DEG, {})


def six_digits(text: str) -> str:
    """As SolTrace's program saves it, which has no comments of ours."""
    lines = []
    for line in text.split("\n"):
        cells = line.split("\t")
        if len(cells) > 28:
            numbers = [f"{float(cell):g}" for cell in cells[1:8]]
            line = "\t".join([cells[0], *numbers, *cells[8:29], ""])
        lines.append(line)
    return "\n".join(lines)


def facet_poses(plant: PlantDescription, aims: dict[str, np.ndarray] | None = None) -> np.ndarray:
    """Origin and direction [m] of all elements that SolTrace gets of a plant."""
    lines = soltrace_text(plant, sun_direction(*SUN_DEG), aims or {}).split("\n")
    elements = [line.split("\t") for line in lines if line.startswith("1\t")]
    return np.array([[float(cell) for cell in cells[1:7]] for cells in elements])


def returned(text: str, folder: Path) -> tuple[PlantDescription, dict[str, np.ndarray]]:
    folder.mkdir(parents=True)
    file = folder / "plant.stinput"
    file.write_text(text)
    imported, _ = import_plant(file, folder / "plant")
    return read_plant(folder / "plant" / "plant.yaml"), dict(imported.aims)


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"canting": "flat", "shape": "flat"},
        {"canting": "{focal_length_m: 150}", "shape": "{focal_length_m: 200}"},
        {"facets": "{file: facets.csv}", "canting": "individual", "shape": "{focal_length_m: 200}"},
        {"facets": "{rows: 1, columns: 1, width_m: 9, height_m: 7}"},
        {"facets": "{rows: 1, columns: 2, width_m: 6, height_m: 1, gap_m: 0.05}"},
        {"receivers": f"{{main: {PLANE}}}", "layout": "A1,one,-30,120,0\nA2,one,10,140,1\n"},
        {"receivers": f"{{wall: {PANELS}, top: {CYLINDER}}}"},
    ],
)
@pytest.mark.parametrize("saved", [str, six_digits])
def test_an_export_returns_facet_by_facet(
    tmp_path: Path, parts: dict[str, str], saved: Callable[[str], str]
):
    before = made(tmp_path / "before", **parts)
    after, aims = returned(saved(exported(before)), tmp_path / "after")
    names = list(before.plant.heliostats)
    assert len(after.plant.heliostats) == len(names)
    assert len(after.types) == 1
    if saved is str:
        assert list(after.plant.heliostats) == names
    pair = [facet_poses(before), facet_poses(after, aims)]
    tolerance = 2e-5 if saved is str else 2e-2
    if "individual" in parts.values():  # no normal is the mirror's: to a millimetre
        tolerance = max(tolerance, 1e-3)
    np.testing.assert_allclose(pair[1][:, :3], pair[0][:, :3], atol=tolerance)
    np.testing.assert_allclose(pair[1][:, 3:], pair[0][:, 3:], atol=200 * tolerance)
    assert [r.absorptance for r in after.receivers.values()] == [
        r.absorptance for r in before.receivers.values()
    ]
    assert [type(r) for r in after.receivers.values()] == [
        type(r) for r in before.receivers.values()
    ]


@pytest.mark.full
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    rows=st.integers(1, 5),
    columns=st.integers(1, 5),
    width=st.floats(0.5, 4),
    height=st.floats(0.5, 4),
    gap=st.floats(0.0, 0.1),
    seed=st.integers(0, 99),
)
@example(rows=2, columns=1, width=0.5, height=2.0, gap=0.1, seed=0)  # apart by over a diagonal
def test_any_grid_of_facets_returns(
    tmp_path_factory: pytest.TempPathFactory,
    rows: int,
    columns: int,
    width: float,
    height: float,
    gap: float,
    seed: int,
):
    folder = tmp_path_factory.mktemp("grid")
    facets = (
        f"{{rows: {rows}, columns: {columns}, width_m: {width:.3f}, height_m: {height:.3f},"
        f" gap_m: {gap:.3f}}}"
    )
    free = float(np.hypot(rows * (height + gap), columns * (width + gap))) * 1.05
    rng = np.random.default_rng(seed)
    places = [
        (free * (x - 2) + 7, 60 + free * y + 0.01 * rng.random()) for x in range(4) for y in (0, 1)
    ]
    layout = "".join(f"H{n},one,{x:.3f},{y:.3f},0\n" for n, (x, y) in enumerate(places))
    before = made(folder / "before", facets=facets, layout=layout)
    after, aims = returned(six_digits(exported(before)), folder / "after")
    assert len(after.plant.heliostats) == len(places)
    after_poses, before_poses = facet_poses(after, aims), facet_poses(before)
    np.testing.assert_allclose(after_poses[:, :3], before_poses[:, :3], atol=3e-2)


def test_a_slot_between_halves_does_not_make_two_heliostats(tmp_path: Path):
    grid = "x_m,y_m,z_m,width_m,height_m\n" + "".join(
        f"{x},{y},0,2,2\n" for x in (-4.1, -2.05, 2.05, 4.1) for y in (-2.05, 0, 2.05)
    )
    made(tmp_path / "before", facets="{file: facets.csv}", canting="individual")
    (tmp_path / "before" / "slot.csv").write_text(grid)
    path = tmp_path / "before" / "plant.yaml"
    text = path.read_text().replace("facets.csv", "slot.csv").replace("individual", "on_axis")
    path.write_text(text)
    plant = read_plant(path)
    after, _ = returned(six_digits(exported(plant)), tmp_path / "after")
    assert [len(one.facets) for one in after.plant.heliostats.values()] == [12] * 4


def test_elements_that_touch_and_are_no_mirror_are_named(tmp_path: Path):
    first = next(line for line in SMALL.split("\n") if line.startswith("1\t"))
    beside = first.replace("1\t0\t100\t0\t0\t0\t200", "1\t2\t100\t0\t900\t0\t200")
    file = tmp_path / "crowd.stinput"
    file.write_text(
        SMALL.replace(first, f"{first}\n{beside}").replace("ELEMENTS\t1", "ELEMENTS\t2", 1)
    )
    with pytest.raises(InvalidInputError, match=r"2 elements touch, the first of .* line 12"):
        read_foreign(file)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "0.9\t0\t1\t0.2\t0\t0\t0\t0\t0\t0",
            "0.9\t0\t1\t0.2\t0\t0\t0\t0\t0\t0\t1\t1",
            "a table of",
        ),
        ("\tmirror\t2\t", "\tmirror\t1\t", "must have interaction 2"),
        ("OPTICAL\tg", "OPTICAL.v9\tg", "must be OPTICAL or OPTICAL.v2"),
    ],
)
def test_optics_that_are_not_read_are_named(tmp_path: Path, old: str, new: str, said: str):
    text = SMALL.replace(old, new, 1)
    if new.endswith("1\t1"):
        text = text.replace("\t1\t1\n", "\t1\t1\n0 0.9\n", 1)
    file = tmp_path / "small.stinput"
    file.write_text(text)
    with pytest.raises(InvalidInputError, match=said):
        read_foreign(file)


def test_a_stage_without_a_name_and_what_is_switched_off(tmp_path: Path):
    first = next(line for line in SMALL.split("\n") if line.startswith("1\t"))
    off = "0" + first[1:].replace("\t0\t100", "\t50\t100", 1)
    text = SMALL.replace("Heliostat field", "").replace(first, f"{first}\n{off}")
    file = tmp_path / "small.stinput"
    file.write_text(text.replace("ELEMENTS\t1", "ELEMENTS\t2", 1))
    imported = read_foreign(file)
    assert len(imported.heliostats) == 1
    assert any("switched off: 1 element." in note for note in imported.notes)


def with_cells(text: str, change: Callable[[int, list[str]], list[str]]) -> str:
    """A file whose lines of elements of the first stage are changed; they are counted from 0."""
    lines, number = text.split("\n"), 0
    for index, line in enumerate(lines):
        cells = line.split("\t")
        if len(cells) > 28 and not cells[27].startswith("receiver"):
            lines[index] = "\t".join(change(number, cells))
            number += 1
    return "\n".join(lines)


@pytest.mark.parametrize("title", ["{0}", "facet {1}", "H{0}-{1}", "{2}", "heliostat {0}"])
def test_comments_of_any_kind_leave_facets_together(tmp_path: Path, title: str):
    """A heliostat's name, a facet's number or both: six facets of one mirror are one heliostat."""

    def comment(n: int, cells: list[str]) -> list[str]:
        return [*cells[:29], title.format(n // 6 + 1, n % 6 + 1, n)]

    before = made(tmp_path / "before")
    text = with_cells(six_digits(exported(before)), comment).replace(NAMED_STAGE, "field")
    after, _ = returned(text, tmp_path / "after")
    assert [len(one.facets) for one in after.plant.heliostats.values()] == [6] * 4


def test_heliostats_that_touch_return_from_our_export(tmp_path: Path):
    layout = "".join(f"A{n},one,{3.05 * n},120,0\n" for n in range(4))
    facets = "{rows: 1, columns: 1, width_m: 3, height_m: 2}"
    before = made(tmp_path / "before", facets=facets, layout=layout, canting="flat", shape="flat")
    after, _ = returned(exported(before), tmp_path / "after")
    assert list(after.plant.heliostats) == ["A0", "A1", "A2", "A3"]


def test_canted_facets_with_the_rotation_of_their_mirror_are_read(tmp_path: Path):
    """As SolarPILOT writes them; their sides are not quite along those of the mirror."""
    before = made(tmp_path / "before", canting="{focal_length_m: 60}")
    text = six_digits(exported(before))
    angles = [float(line.split("\t")[7]) for line in text.split("\n") if line.count("\t") > 28]
    rotations = np.degrees(np.unwrap(np.radians(angles[:24]).reshape(4, 6))).mean(axis=1)
    turned = with_cells(text, lambda n, c: [*c[:7], f"{rotations[n // 6]:g}", *c[8:]])
    file = tmp_path / "turned.stinput"
    file.write_text(turned)
    imported = read_foreign(file)
    assert len(imported.heliostats) == 4
    assert any("mrad in the mirror's plane are left out" in note for note in imported.notes)


def test_programs_write_zeros_titles_and_names_of_files_in_their_way(tmp_path: Path):
    """soltrace-api writes 0.000000; SolarPILOT leaves out an empty table, and names files .txt."""
    zeros = SMALL.replace("XYZ\t0\t0\t0\tAIM\t0\t0\t1\tZROT\t0", _ZEROS)
    file = tmp_path / "small.txt"
    file.write_text(zeros.replace("USER SHAPE DATA\t0\n", ""))
    (entry,) = read_foreign(file).heliostats
    assert entry.focal_length_m == 125


_ZEROS = "XYZ\t0.000000\t0.000000\t0.000000\tAIM\t0.000000\t0.000000\t1.000000\tZROT\t0.000000"
