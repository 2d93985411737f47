"""plant.yaml: what is read, and that every mistake is named with its line and key."""

import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from model.actuator import LinearActuator
from model.errors import InvalidInputError
from model.locating import SheetEdges
from model.plant import Cylinder, TargetPlane
from model.receivers import Cavity
from model.sunshape import Buie, Pillbox
from model.sunshape.buie import csr_of_chi
from service.sources.heliostat_document import heliostat_from_json, heliostat_to_json
from service.sources.plant_file import read_plant
from tests.service.sources import plant_files
from tests.service.sources.plant_files import FACETS, LAYOUT, PLANT, RICH, write_plant


def test_contract_is_read(tmp_path: Path):
    plant = read_plant(write_plant(tmp_path))
    assert list(plant.plant.heliostats) == ["A1", "A2", "B1"]
    assert plant.type_of == {"A1": "large", "A2": "large", "B1": "small"}
    assert plant.receiver_of == {"A1": "main", "A2": "main", "B1": "board"}
    assert plant.plant.site.altitude_m == plant.altitude == 600
    assert plant.time_zone == "America/Los_Angeles"
    assert plant.optics.attenuation == (0.006789, 0.1046, -0.0107, 0.002845)
    assert isinstance(plant.optics.sun_shape, Pillbox)
    assert plant.optics.sun_shape.half_angle == pytest.approx(4.65e-3)
    assert plant.tower is not None
    assert plant.tower.radius == 8
    assert plant.tower.height == 140
    assert plant.marks_of == {"cal": "none"}
    assert plant.plant.targets["cal"].locator == SheetEdges()
    large = plant.plant.heliostats["A1"]
    assert len(large.facets) == 28
    assert large.area == pytest.approx(28 * 1.8 * 1.35)
    assert large.optics.reflectance == 0.95
    assert large.optics.slope_error == pytest.approx(1e-3)
    assert large.optics.pointing_error == pytest.approx(0.5e-3)
    main, board = plant.receivers["main"], plant.receivers["board"]
    assert isinstance(main, Cylinder)
    np.testing.assert_allclose(main.center, [0, 8, 150], atol=1e-12)
    assert main.absorptance == 0.94
    assert isinstance(board, TargetPlane)
    assert board.absorptance == 0.9


def test_facets_of_a_file(tmp_path: Path):
    small = read_plant(write_plant(tmp_path)).plant.heliostats["B1"]
    assert [facet.outline is not None for facet in small.facets] == [False, True, True]
    areas = [facet.area for facet in small.facets]
    assert areas == pytest.approx([1.9 * 2, 2.475, np.pi * 0.64], rel=1e-6)
    np.testing.assert_allclose(
        small.facet_normals[0], np.array([0.005, 0, 1]) / np.hypot(0.005, 1), atol=1e-12
    )


def test_canting_in_a_facets_file_is_the_slope(tmp_path: Path):
    facets = "x,y,z,canting_x_mrad,canting_y_mrad,width,height\n0,0,0,5,-2,1,1\n"
    small = read_plant(write_plant(tmp_path, facets=facets)).plant.heliostats["B1"]
    normal = small.facet_normals[0]
    np.testing.assert_allclose(-normal[:2] / normal[2], [5e-3, -2e-3], atol=1e-12)


def test_focus_on_a_cylinder_is_its_surface_toward_the_heliostat(tmp_path: Path):
    changed = PLANT.replace("facet_shape: flat", "facet_shape: slant_range")
    heliostats = read_plant(write_plant(tmp_path, changed)).plant.heliostats
    pivot_range = np.hypot(200 - 8, 150 - 6)
    assert heliostats["A1"].facets[0].focal_length == pytest.approx(pivot_range)
    assert heliostats["A2"].facets[0].focal_length == 250


def test_heliostats_in_line_and_numbered(tmp_path: Path):
    in_line = (
        "{heliostats: [{name: 7, type: large, east_m: 0, north_m: 100, up_m: 0},"
        " {name: '5E10', type: small, east_m: 9, north_m: 100, up_m: 0, receiver: cal}]}"
    )
    plant = read_plant(write_plant(tmp_path, PLANT.replace("{file: layout.csv}", in_line)))
    assert plant.receiver_of == {"7": "main", "5E10": "cal"}


def test_drives_are_carried(tmp_path: Path):
    linear = (
        "{kind: linear, increment_steps_per_m: 154166666, initial_stroke_length_m: 0.075,"
        " offset_m: 0.34, pivot_radius_m: 0.3191, initial_angle_rad: -0.01, clockwise: false,"
        " max_increment_steps: 69296}"
    )
    rotary = "{kind: rotary, gear: 18000}"
    for drives in ([linear] * 2, [rotary, "{kind: ideal}"], [linear, rotary]):
        mount = f"{{kind: pitch_roll, drives: [{', '.join(drives)}]}}"
        text = PLANT.replace("mount: {kind: pitch_roll}", f"mount: {mount}")
        plant = read_plant(write_plant(tmp_path, text))
        found = plant.types["small"].mount.drives
        assert found is not None
        kinds = [isinstance(drive, LinearActuator) for drive in found]
        assert kinds == [drive == linear for drive in drives]
        assert plant.warnings == ()
    assert found[1].angle(18000) == pytest.approx(2 * np.pi)


def test_suns(tmp_path: Path):
    def sun(text: str) -> Buie:
        changed = PLANT.replace("{shape: pillbox, half_angle_mrad: 4.65}", text)
        shape = read_plant(write_plant(tmp_path, changed)).optics.sun_shape
        assert isinstance(shape, Buie)
        return shape

    assert sun("{shape: buie, chi: 0.05}").circumsolar_ratio == 0.05
    true_share = csr_of_chi(float(sun("{shape: buie, csr: 0.043}").circumsolar_ratio))
    assert true_share == pytest.approx(0.043)


def test_what_effects_need_of_a_type_is_read_and_stored(tmp_path: Path):
    text = PLANT.replace("mirror_offset_m: 0.2}", "mirror_offset_m: 0.2, jitter_axis: second}")
    text = text.replace("canting: on_axis", "canting: on_axis\n    reference_elevation_deg: 90")
    plants = [read_plant(write_plant(tmp_path, one)).plant for one in (text, PLANT)]
    changed, default = (plant.heliostats["A1"] for plant in plants)
    assert (changed.mount.jitter_axis, changed.reference_sine) == ("second", 1.0)
    assert (default.mount.jitter_axis, default.reference_sine) == ("first", 0.5)
    again = heliostat_from_json("A1", heliostat_to_json(changed))
    assert (again.mount.jitter_axis, again.reference_sine) == ("second", 1.0)
    assert "reference_sine" not in heliostat_to_json(default)


MISTAKES = [
    # what is written, in place of what; the line, the key, and a part of the remedy
    ("kind: azimuth_elevation", "kind: az-el", 4, "heliostat_types.large.mount.kind", "'az-el' is none of azimuth_elevation, juelich, pitch_roll, target_aligned"),
    ("reflectance: 0.95", "reflectance: 1.5", 8, "heliostat_types.large.reflectance", "1 or less, got 1.5"),
    ("reflectance: 0.95", "reflectance: 0", 8, "heliostat_types.large.reflectance", "greater than 0, got 0"),
    ("reflectance:", "reflectence:", 8, "heliostat_types.large.reflectence", "did you mean reflectance?"),
    ("slope_error_mrad: 1.0", "slope_error_mrad: -1", 9, "heliostat_types.large.slope_error_mrad", "got -1"),
    ("slope_error_mrad: 1.0", "slope_error: 0.001", 9, "heliostat_types.large.slope_error", "did you mean slope_error_mrad?"),
    ("canting: on_axis", "canting: onaxis", 7, "heliostat_types.large.canting", "did you mean on_axis?"),
    ("canting: on_axis", "canting: {off_axis: {azimuth_deg: 180, elevation_deg: -5}}", 7, "heliostat_types.large.canting.off_axis.elevation_deg", "greater than 0"),
    ("canting: on_axis", "canting: {}", 7, "heliostat_types.large.canting", "give one of focal_length_m, off_axis"),
    ("canting: on_axis", "canting: individual", 7, "heliostat_types.large.canting", "facets file"),
    ("mirror_offset_m: 0.2", "mirror_offset_m: 0.2, jitter_axis: third", 4, "heliostat_types.large.mount.jitter_axis", "'third' is none of first, second"),
    ("reflectance: 0.95", "reference_elevation_deg: 91", 8, "heliostat_types.large.reference_elevation_deg", "90 or less"),
    ("facets: {file: facets.csv}", "facets: {file: facets.csv}\n    canting: on_axis", 14, "heliostat_types.small.canting", "individual"),
    ("facet_shape: flat", "facet_shape: {focal_length: 3}", 6, "heliostat_types.large.facet_shape.focal_length", "did you mean focal_length_m?"),
    ("facet_shape: flat", "facet_shape: 320", 6, "heliostat_types.large.facet_shape", "{focal_length_m: ..}"),
    ("rows: 4", "rows: yes", 5, "heliostat_types.large.facets.rows", "must be a number"),
    ("rows: 4", "rows: 4.5", 5, "heliostat_types.large.facets.rows", "4.5"),
    ("rows: 4", "rows: 100", 5, "heliostat_types.large.facets", "at most 256"),
    ("rows: 4, ", "", 5, "heliostat_types.large.facets.rows", "is missing; add it"),
    ("{file: facets.csv}", "{file: /etc/hostname}", 13, "heliostat_types.small.facets.file", "outside"),
    ("{file: facets.csv}", "{file: mirrors.csv}", 13, "heliostat_types.small.facets.file", "no such file"),
    ("{file: layout.csv}", "{file: ../layout.csv}", 14, "layout.file", "outside"),
    ("{file: layout.csv}", "{}", 14, "layout", "give one of file, heliostats"),
    ("{file: layout.csv}", "{heliostats: [{name: 5E10, type: large, east_m: 0, north_m: 9, up_m: 0}]}", 14, "layout.heliostats[0].name", "quotes"),
    ("{file: layout.csv}", "{heliostats: [{name: a, type: large, east_m: 0, north_m: .nan, up_m: 0}]}", 14, "layout.heliostats[0].north_m", "number"),
    ("{file: layout.csv}", "{heliostats: [{name: a, type: larg, east_m: 0, north_m: 9, up_m: 0}]}", 14, "layout.heliostats[0]", "did you mean large?"),
    ("kind: cylinder, ", "", 16, "receivers.main.kind", "one of plane, cylinder, panels, cavity"),
    ("kind: cylinder", "kind: cone", 16, "receivers.main.kind", "'cone' is none of plane, cylinder, panels, cavity"),
    ("height_m: 16", "height_m: 161", 16, "receivers.main", "20 times"),
    ("[0, 0, 62]", "[0, 0]", 17, "receivers.board.center_m[2]", "is missing"),
    ("[0, 0, 62]", "[0, 0, x]", 17, "receivers.board.center_m[2]", "number, got 'x'"),
    ("[0, 1, 0], up: [0, 0, 1], width_m: 8", "[0, 0, 1], width_m: 8", 17, "receivers.board", "parallel"),
    ("  cal:", "  main:", 19, "targets.main", "rename"),
    ("width_m: 12,", "width_m: 12, marks: dots,", 19, "targets.cal.marks", "'dots' is none of none, l_brackets"),
    ("width_m: 12,", "width_m: 12, camera: {homography: [[1, 0, 0], [0, 1, 0], [0, 0, 0]]},", 19, "targets.cal.camera.homography", "invertible"),
    ("width_m: 12,", "width_m: 12, camera: {homography: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},", 19, "targets.cal.camera", "mirrored"),
    ("width_m: 12,", "width_m: 12, camera: {homographie: []},", 19, "targets.cal.camera.homographie", "did you mean homography?"),
    ("width_m: 12,", "width_m: 12, camera: {},", 19, "targets.cal.camera", "give one of homography, corners_px, pose"),
    ("width_m: 12,", "width_m: 12, camera: {corners_px: [[0, 0], [9, 0], [9, 9]]},", 19, "targets.cal.camera.corners_px", "4 items"),
    ("width_m: 12,", "width_m: 12, camera: {corners_px: [[0, 0], [9, 0], [9, 9], [0, 9]]},", 19, "targets.cal.camera.corners_px", "convex quadrilateral"),
    ("width_m: 12,", "width_m: 12, marks: l_brackets, camera: {corners_px: [[0, 0], [9, 0], [0, 9], [9, 9]]},", 19, "targets.cal.camera", "leave one of both out"),
    ("width_m: 12,", "width_m: 12, camera: {image_size_px: [64, 64], corners_px: [[0, 0], [90, 0], [0, 9], [90, 9]]},", 19, "targets.cal.camera.image_size_px", "outside of a photograph of 64 x 64"),
    ("width_m: 12,", "width_m: 12, camera: {pose: {position_m: [0, 90, 2], look_at_m: [0, 5, 40]}},", 19, "targets.cal.camera.pose", "focal_length_px, field_of_view_deg"),
    ("width_m: 12,", "width_m: 12, camera: {pose: {position_m: [0, -90, 2], look_at_m: [0, 5, 40], field_of_view_deg: 9}},", 19, "targets.cal.camera.pose.position_m", "behind the target"),
    ("tower: {radius_m: 8, height_m: 140}", "tower: 140", 20, "tower", "key: value, got 140"),
    ("cal: {kind: plane, ", "cal: {kind: cylinder, ", 19, "targets.cal.kind", "Put it into receivers; heliostats aim at those too"),
    ("tower: {radius_m: 8, height_m: 140}", "tower:", 20, "tower", "has no value"),
    ("tower:", "towers:", 20, "towers", "did you mean tower?"),
    ("shape: pillbox", "shape: disc", 21, "sun.shape", "'disc' is none of pillbox, gaussian, buie"),
    ("{shape: pillbox, half_angle_mrad: 4.65}", "{shape: buie, csr: 0.9}", 21, "sun.csr", "must lie in"),
    ("{shape: pillbox, half_angle_mrad: 4.65}", "{shape: buie, chi: 0.1, csr: 0.1}", 21, "sun", "give one of chi, csr"),
    ("{attenuation: [0.006789, 0.1046, -0.0107, 0.002845]}", "{visibility_km: 1}", 22, "atmosphere", "[5, 300]"),
    ("34.86", "north", 1, "plant.latitude_deg", "number, got 'north'"),
    ("America/Los_Angeles", "California", 1, "plant.time_zone", "IANA"),
    ("altitude_m: 600", "altitude_m: 600, altitude_m: 5", 1, "altitude_m", "twice"),
    ("  large:", "  large: &large", 3, "anchor", "leave it out"),
    ("reflectance: 0.95", "reflectance: !!python/name:os.system", 8, "tag", "leave it out"),
    ("tower: {", "tower: [", 20, "no YAML", "check indentation"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line", "key", "remedy"), MISTAKES)
def test_each_mistake_is_named(
    tmp_path: Path, old: str, new: str, line: int, key: str, remedy: str
):
    assert old in PLANT
    path = write_plant(tmp_path, PLANT.replace(old, new, 1))
    with pytest.raises(InvalidInputError) as refused:
        read_plant(path)
    said = str(refused.value)
    assert said.startswith(f"{path}, line {line}: "), said
    assert key in said
    assert remedy in said
    assert "\n" not in said


def test_a_cylinder_that_is_no_target_is_a_receiver(tmp_path: Path):
    """The remedy of its refusal."""
    cylinder = "  cal: {kind: cylinder, center_m: [0, 5, 40], radius_m: 3, height_m: 6}\n"
    begin, end = PLANT.index("targets:"), PLANT.index("tower:")
    text = (PLANT[:begin] + PLANT[end:]).replace("receivers:\n", f"receivers:\n{cylinder}")
    read = read_plant(write_plant(tmp_path, text))
    assert isinstance(read.receivers["cal"], Cylinder)


LAYOUT_MISTAKES = [
    ("up_m", "up", 1, "did you mean up_m?"),
    (",up_m", "", 1, "column up_m is missing"),
    ("east_m", "north_m", 1, "there twice"),
    ("A1,large", "A1,huge", 2, "type: 'huge' is no heliostat type"),
    ("A2,", "A1,", 3, "name: A1 is there twice"),
    ("A2,", "A 2,", 3, "name 'A 2'"),
    ("220", "nan", 3, "north_m: must be a number"),
    ("220", "", 3, "north_m: must be a number"),
    ("220", "1e9", 3, "north_m: must be a number in"),
    ("-50,220,0", "0,200,0", 3, "A2 is at the place of A1"),
    ("main", "mian", 3, "receiver: 'mian' is no receiver or target; did you mean main?"),
    (",250", ",-250", 3, "focal_length_m: must be a number"),
    (",board,", ",board", 4, "has 6 cells, 7 are the columns"),
    ("30,120,-1.5", "0,0,62.5", 4, "less than 1 m"),
]


@pytest.mark.parametrize(("old", "new", "line", "said"), LAYOUT_MISTAKES)
def test_each_mistake_of_the_layout_is_named(
    tmp_path: Path, old: str, new: str, line: int, said: str
):
    path = write_plant(tmp_path, layout=LAYOUT.replace(old, new, 1))
    with pytest.raises(InvalidInputError) as refused:
        read_plant(path)
    assert str(refused.value).startswith(f"{tmp_path / 'layout.csv'}, line {line}: ")
    assert said in str(refused.value)


FACET_MISTAKES = [
    ("normal_z,", "", "normal_z is missing beside normal_x"),
    ("1.9,2", "1.9,", "line 2: a facet needs width_m and height_m, or polygon, or radius_m"),
    ("0.9 0.5; 0 1", "0.9 0.5; 0", "line 3: polygon: must be 3 to 64 corners"),
    ("-0.9 -1; 0.9 -1; 0.9 0.5; 0 1", "-1 -1; 1 1; 1 -1; -1 1", "line 3: polygon: must have an area"),
    ("0.8\n", "-0.8\n", "line 4: radius_m: must be a number"),
    ("0.005,0,1,1.9", "1,0,-1,1.9", "line 2: normal_z: must be positive"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), FACET_MISTAKES)
def test_each_mistake_of_the_facets_is_named(tmp_path: Path, old: str, new: str, said: str):
    path = write_plant(tmp_path, facets=FACETS.replace(old, new, 1))
    with pytest.raises(InvalidInputError) as refused:
        read_plant(path)
    assert str(refused.value).startswith(str(tmp_path / "facets.csv"))
    assert said in str(refused.value)


@pytest.mark.full
@pytest.mark.parametrize(
    ("make", "count", "kind"),
    [
        (plant_files.gemasolar, 2650, Cylinder),
        (plant_files.ps10, 624, Cavity),
        (plant_files.solar_two, 1926, Cylinder),
        (plant_files.round_c, 522, TargetPlane),
    ],
)
def test_real_plants_are_read(tmp_path: Path, make: Callable[[Path], Path], count: int, kind: type):
    path = make(tmp_path)
    begin = time.process_time()
    plant = read_plant(path)
    assert time.process_time() - begin < 10
    assert len(plant.plant.heliostats) == count
    (receiver,) = plant.receivers.values()
    assert isinstance(receiver, kind)


def _refusal(path: Path) -> str:
    """What a plant is refused for; empty if it is read."""
    try:
        read_plant(path)
    except InvalidInputError as error:
        return str(error)
    return ""


_FRAGMENTS = st.sampled_from(
    ["", "{", "}", "[", "]", ":", "- ", "\n", "  ", "null", "~", "1e999", "-1", "0", "true", "'", '"',
     "&a ", "*a", "!!int ", "<<: ", "? ", "| ", "%", "\t", "#", "é", "\x00", "9" * 5000, ".inf", "kind: ",
     "cavity", "panels", "off_axis", "{focal_length_m: 1e-9}", "[[[[", "file", "layout.csv"]
)  # fmt: skip


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    cut=st.tuples(st.integers(0, len(PLANT)), st.integers(0, 25)),
    put=st.lists(_FRAGMENTS, max_size=3).map("".join),
    row=st.tuples(st.integers(0, len(LAYOUT)), st.integers(0, 8)),
    cell=_FRAGMENTS,
)
def test_nothing_but_a_refusal(
    tmp_path_factory: pytest.TempPathFactory,
    cut: tuple[int, int],
    put: str,
    row: tuple[int, int],
    cell: str,
):
    text = PLANT[: cut[0]] + put + PLANT[cut[0] + cut[1] :]
    layout = LAYOUT[: row[0]] + cell + LAYOUT[row[0] + row[1] :]
    path = write_plant(tmp_path_factory.mktemp("fuzz"), text, layout)
    for line in _refusal(path).splitlines():
        assert line.startswith((str(path), str(path.parent), "and "))


VALUES = [
    (text, found.span())
    for text in (PLANT, RICH)
    for found in re.finditer(r"(?<=[ \[])(-?[0-9.]+|[A-Za-z_/]+)(?=[,}\]\n])", text)
]
ODD = [
    "0",
    "-1",
    "1e-300",
    "1e300",
    "1e5",
    "-1e6",
    "360",
    "x",
    "[]",
    "{}",
    "null",
    "true",
    '""',
    "[1, 2, 3]",
]


@settings(max_examples=250, deadline=None, suppress_health_check=list(HealthCheck))
@given(value=st.sampled_from(VALUES), odd=st.sampled_from(ODD))
def test_odd_values_are_read_or_named_with_their_line(
    tmp_path_factory: pytest.TempPathFactory, value: tuple[str, tuple[int, int]], odd: str
):
    text, (begin, end) = value
    path = write_plant(tmp_path_factory.mktemp("odd"), text[:begin] + odd + text[end:])
    refusal = _refusal(path)
    assert not refusal or re.search(r", line [0-9]+: ", refusal)


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.binary(max_size=200))
def test_no_bytes_do_harm(tmp_path_factory: pytest.TempPathFactory, data: bytes):
    path = tmp_path_factory.mktemp("bytes") / "plant.yaml"
    path.write_bytes(data)
    with pytest.raises(InvalidInputError):
        read_plant(path)


def test_all_mistakes_are_named_one_a_line(tmp_path: Path):
    text = PLANT.replace("latitude_deg: 34.86", "latitude_deg: 134").replace("radius_m: 8, h", "h")
    for folder in ("schema", "layout"):
        (tmp_path / folder).mkdir()
    said = _refusal(write_plant(tmp_path / "schema", text)).split("\n")
    assert [line.split(", ")[1].split(":")[0] for line in said] == ["line 1", "line 16", "line 20"]
    layout = "name,type,east_m,north_m,up_m\nA1,large,0,x,0\nA2,large,0,y,0\n"
    said = _refusal(write_plant(tmp_path / "layout", layout=layout)).split("\n")
    assert [line.partition(": north_m")[0][-6:] for line in said] == ["line 2", "line 3"]


def test_mistakes_of_document_and_layout_are_named_at_once(tmp_path: Path):
    text = PLANT.replace("latitude_deg: 34.86", "latitude_deg: 134.86, colour: red")
    text = text.replace("width_m: 1.8, height_m: 1.35", "widht_m: 1.8, height_m: -1")
    layout = "name,type,east_m,north_m,up_m\nA1,large,x,80,0\nA2,large,0,90\nA3,large,1,2,3\n"
    path = write_plant(tmp_path, text, layout=layout)
    with pytest.raises(InvalidInputError) as refused:
        read_plant(path)
    said = str(refused.value)
    for part in ("latitude_deg: must be 90 or less", "colour: is not known", "height_m: must be"):
        assert part in said
    assert "widht_m: is not known here; did you mean width_m?" in said
    assert "width_m: is missing" not in said
    assert said.count("layout.csv, line ") == 2
    path = write_plant(tmp_path, PLANT, layout=f"{layout}A3,larg,1,2,3\n")
    with pytest.raises(InvalidInputError) as refused:
        read_plant(path)
    lines = [re.search(r"line (\d+): (.{9})", line) for line in str(refused.value).split("\n")]
    found = [(line[1], line[2]) for line in lines if line]
    assert found == [
        ("2", "east_m: m"),
        ("3", "has 4 cel"),
        ("5", "name: A3 "),
        ("5", "A3 is at "),
        ("5", "type: 'la"),
    ]
