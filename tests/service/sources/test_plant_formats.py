"""Plants of other programs: what is imported, and that it returns as it came."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from model.errors import InvalidInputError
from model.frames import sun_angles
from model.plant import Cylinder
from model.receivers import Cavity, Panels
from service.drawing.pictures import surface_lines
from service.sources.plant_file import read_plant
from service.sources.plant_formats.formats import (
    ExportOptions,
    foreign_text,
    read_foreign,
    write_foreign,
)
from service.sources.plant_formats.soltrace import SolTraceInput, parse_soltrace, read_soltrace
from tests.service.command import ends, heliotwin
from tests.service.sources.plant_files import ps10, published, round_c, write_plant

AFTERNOON = "Power-tower-surround_singlefacet_large_afternoon.stinput"
SURROUND = "Power-tower-surround_singlefacet.stinput"


def solar_two() -> Path:
    return published() / "layouts" / "SolarTwo_layout.csv"


def pose_error_mrad(first: SolTraceInput, second: SolTraceInput) -> float:
    """The largest angle between axes of heliostats; half a turn leaves a rectangle as it is."""
    axes = [np.array([e.axes for e in given.stages[0]]) for given in (first, second)]
    cosines = np.abs(np.einsum("nij,nij->ni", *axes)).clip(max=1)
    sines = np.linalg.norm(np.cross(*axes), axis=-1)
    return float(1e3 * np.arctan2(sines, cosines).max())


@pytest.mark.parametrize(
    ("name", "count"), [(AFTERNOON, 2370), pytest.param(SURROUND, 6282, marks=pytest.mark.full)]
)
def test_soltrace_returns_as_it_came(tmp_path: Path, name: str, count: int):
    """Poses by our mounts from sun and aim points against those of the file."""
    before = parse_soltrace(published() / "soltrace" / name)
    imported = read_soltrace(published() / "soltrace" / name)
    plant = read_plant(imported.write(tmp_path)[0])
    assert len(plant.plant.heliostats) == count
    azimuth, elevation = sun_angles(before.sun)
    sun = float(azimuth) % 360, float(elevation)
    again = tmp_path / "again.stinput"
    again.write_text(foreign_text(plant, "soltrace", sun, imported.aims))
    after = parse_soltrace(again)
    assert pose_error_mrad(before, after) < 0.1
    np.testing.assert_allclose(after.sun, before.sun, atol=1e-8)
    for first, second in zip(before.stages[0], after.stages[0], strict=True):
        assert (first.aperture, first.surface) == (second.aperture, second.surface)
        np.testing.assert_allclose(first.origin, second.origin, atol=1e-6)
        np.testing.assert_allclose(first.size, second.size, rtol=1e-6)
        np.testing.assert_allclose(first.shape, second.shape, rtol=1e-6)
    (optics,) = (pair for pair in after.optics if not pair.startswith("receiver"))
    assert after.optics[optics] == before.optics["Template 1"]
    receivers = [given.stages[1][0] for given in (before, after)]
    assert [r.aperture + r.surface for r in receivers] == ["lt", "lt"]
    np.testing.assert_allclose(receivers[1].size, receivers[0].size)
    np.testing.assert_allclose(receivers[1].shape, receivers[0].shape, rtol=1e-4)
    middles = [r.origin + r.axes[2] / r.shape[0] for r in receivers]
    np.testing.assert_allclose(middles[1], middles[0], atol=1e-3)


@pytest.mark.full
def test_aim_points_of_soltrace_are_on_its_receiver(tmp_path: Path):
    imported = read_soltrace(published() / "soltrace" / AFTERNOON)
    points = np.array(list(imported.aims.values()))
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), 7.75, atol=1e-3)
    assert 180 - 11 < points[:, 2].min() < points[:, 2].max() < 180 + 11


@pytest.mark.parametrize(
    ("name", "count", "aims"),
    [
        pytest.param("solarpilot/test_field.csv", 8661, 0, marks=pytest.mark.full),
        ("halos/flat-daggett-50.csv", 656, 656),
        ("halos/radial-daggett-50.csv", 904, 904),
        ("opencsp/NSTTF_Heliostats_origin_at_torque_tube.csv", 218, 0),
        pytest.param("layouts/Gemasolar_layout.csv", 2650, 0, marks=pytest.mark.full),
        ("layouts/SolarTwo_layout.csv", 1926, 0),
    ],
)
def test_layouts_are_imported(tmp_path: Path, name: str, count: int, aims: int):
    done = heliotwin("plant", "import", published() / name, "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["heliostats"] == count
    assert report["notes"]
    assert (tmp_path / "aims.csv").exists() == bool(aims)
    assert len(read_plant(tmp_path / "plant.yaml").plant.heliostats) == count
    ends(heliotwin("plant", "import", published() / name, "--out", tmp_path), 2, "exists")


def test_receiver_is_where_the_aim_points_are(tmp_path: Path):
    imported = read_foreign(published() / "halos" / "radial-daggett-50.csv")
    plant = read_plant(imported.write(tmp_path)[0])
    for name, aim in imported.aims.items():
        foot = plant.plant.heliostats[name].position
        assert np.linalg.norm(plant.receivers["main"].aim_of(foot) - aim) < 0.02


def test_mirrors_of_opencsp(tmp_path: Path):
    imported = read_foreign(published() / "opencsp" / "NSTTF_Heliostats_origin_at_torque_tube.csv")
    plant = read_plant(imported.write(tmp_path)[0])
    heliostat = plant.plant.heliostats["5E10"]
    assert len(heliostat.facets) == 25
    assert heliostat.area == pytest.approx(25 * 1.2192**2)
    np.testing.assert_allclose(heliostat.position + heliostat.mount.joint, [92.61, 57.92, 5.45])


def test_positions_keep_their_names_and_types(tmp_path: Path):
    plant = read_plant(read_foreign(solar_two()).write(tmp_path)[0])
    assert {plant.type_of[name] for name in plant.type_of} == {"MM", "LUGO"}
    np.testing.assert_allclose(plant.plant.heliostats["H2"].position, [-179.2, -183.6, 0])


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("id,x,y\n", "line 1: no heliostat follows"),
        ("id,x,y,height\n1,2,3,4\n", "line 1: column 'height' is not understood"),
        ("x,y\n1,2\n3,north\n", "line 3: cell 2 must be a number"),
        ("x,y,type\n1,2\n", "line 2: has no cell for type"),
        ("x,y,name\n1,2,a b\n", "line 2: name 'a b'"),
        ("x,y,name\n1,2,a\n3,4,a\n", "a"),
    ],
)
def test_positions_that_are_refused(tmp_path: Path, text: str, error: str):
    file = tmp_path / "field.csv"
    file.write_text(text)
    ends(heliotwin("plant", "import", file, "--out", tmp_path / "out"), 2, error)


def test_solarpilot_returns_as_it_came(tmp_path: Path):
    path = round_c(tmp_path / "plant")
    aims = tmp_path / "aims.csv"
    aims.write_text("name,east_m,north_m,up_m\nH1,1,0,63\n")
    out = tmp_path / "layout.csv"
    done = heliotwin(
        "plant", "export", path, "--format", "solarpilot", "--aims", aims, "--out", out
    )
    assert done.returncode == 0, done.stderr
    first = out.read_text().splitlines()[0]
    assert (
        first
        == "0,-239.680159,528.702968,0.000000,NULL,NULL,NULL,NULL,NULL,1.000000,0.000000,63.000000"
    )
    imported = read_foreign(out)
    plant = read_plant(path).plant
    np.testing.assert_allclose(imported.aims["H2"], [0, 0, 62], atol=1e-6)
    for entry in imported.heliostats:
        foot = plant.heliostats[entry.name].position
        np.testing.assert_allclose([entry.east_m, entry.north_m, entry.up_m], foot, atol=1e-6)


@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 30))
def test_any_layout_returns_from_solarpilot(
    tmp_path_factory: pytest.TempPathFactory, seed: int, count: int
):
    """Places and aims to the micrometre that the format has, and types by their order."""
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("layout")
    places = np.round(rng.uniform((-500, 50, -20), (500, 900, 20), (count, 3)), 3)
    kinds = rng.choice(["large", "small"], count)
    rows = [
        f"H{n},{k},{x},{y},{z}\n"
        for n, (k, (x, y, z)) in enumerate(zip(kinds, places.tolist(), strict=True))
    ]
    path = write_plant(folder, layout="".join(["name,type,east_m,north_m,up_m\n", *rows]))
    aims = {f"H{n}": rng.uniform(-5, 5, 3) + (0, 0, 150) for n in range(count)}
    out = folder / "layout.csv.out.csv"
    write_foreign(read_plant(path), "solarpilot", out, ExportOptions(aims=dict(aims)))
    imported = read_foreign(out)
    assert [one.name for one in imported.heliostats] == [f"H{n + 1}" for n in range(count)]
    found = [(one.east_m, one.north_m, one.up_m) for one in imported.heliostats]
    np.testing.assert_allclose(found, places, atol=1e-6)
    np.testing.assert_allclose(list(imported.aims.values()), list(aims.values()), atol=1e-6)
    alike = {(kind, one.type) for kind, one in zip(kinds, imported.heliostats, strict=True)}
    assert len(alike) == len(set(kinds))


def test_facets_of_any_type_are_written_for_soltrace(tmp_path: Path):
    path, out = write_plant(tmp_path), tmp_path / "plant.stinput"
    done = heliotwin(
        *("plant", "export", path, "--format", "soltrace", "--sun", 180, 60, "--out", out)
    )
    assert done.returncode == 0, done.stderr
    mirrors, receivers = parse_soltrace(out).stages
    assert len(mirrors) == 2 * 28 + 3
    assert [mirror.aperture for mirror in mirrors[-3:]] == ["r", "q", "c"]
    assert [receiver.aperture for receiver in receivers] == ["l", "r"]
    plant = read_plant(path).plant
    heliostat = plant.heliostats["B1"]
    normals = np.array([mirror.axes[2] for mirror in mirrors[-3:]])
    np.testing.assert_allclose(
        normals @ normals.T, heliostat.facet_normals @ heliostat.facet_normals.T, atol=1e-9
    )


def test_lines_of_a_cylinder_are_its_rims_and_five_between_them():
    """A quarter of a cylinder, whose axis is 2 m south of the middle of its lit surface."""
    south, up = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    drum = Cylinder("drum", np.array([0.0, 2.0, 50.0]), -south, up, 2.0, 6.0, 90.0)
    low, high, *between = surface_lines(drum)
    for rim, height in ((low, 47.0), (high, 53.0)):
        np.testing.assert_allclose(np.hypot(rim[:, 0], rim[:, 1]), 2.0)
        np.testing.assert_allclose(rim[:, 2], height)
        np.testing.assert_allclose(np.abs(rim[[0, -1], 0]), np.sqrt(2))
    assert len(between) == 5
    for line in between:
        np.testing.assert_allclose(line[1] - line[0], 6.0 * up, atol=1e-12)


def test_a_cavity_is_read_as_nothing_else(tmp_path: Path):
    """Heliostats aim at its aperture, a picture shows that, and SolTrace does not get panels."""
    plant = read_plant(ps10(tmp_path))
    cavity = plant.receivers["cavity"]
    assert isinstance(cavity, Cavity)
    assert not isinstance(cavity, Panels)
    np.testing.assert_allclose(cavity.aim_of(np.zeros(3)), cavity.aperture.mean(axis=0))
    assert len(surface_lines(cavity)) == 1 + len(cavity.panels)
    with pytest.raises(InvalidInputError, match="a cavity is not written for SolTrace"):
        foreign_text(plant, "soltrace", (180.0, 50.0), {})


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--format", "soltrace"), "give --sun AZIMUTH ELEVATION"),
        (("--format", "soltrace", "--sun", "180", "-5"), "elevation must lie in (0, 90]"),
        (("--format", "solarpilot", "--aims", "{aims}"), "not active"),
        (("--format", "tonatiuh"), "--format"),
    ],
)
def test_export_is_refused(tmp_path: Path, arguments: tuple[str, ...], said: str):
    path, aims = write_plant(tmp_path), tmp_path / "aims.csv"
    aims.write_text("name,east_m,north_m,up_m,active\nA1,0,0,150,false\n")
    options = [argument.format(aims=aims) for argument in arguments]
    ends(heliotwin("plant", "export", path, *options, "--out", tmp_path / "out"), 2, said)
    assert not (tmp_path / "out").exists()


SMALL = """\
# SOLTRACE VERSION 2012.7.6 INPUT FILE
SUN\tPTSRC\t0\tSHAPE\tp\tSIGMA\t4.65\tHALFWIDTH\t4.65
XYZ\t0\t-5000\t8000\tUSELDH\t0\tLDH\t0\t0\t0
USER SHAPE DATA\t0
OPTICS LIST COUNT\t1
OPTICAL PAIR\tmirror
OPTICAL\tg\t0\t0\t0\t0.9\t0\t1\t0.2\t0\t0\t0\t0\t0\t0
OPTICAL\tg\t0\t0\t0\t0\t0\t1\t0.2\t0\t0\t0\t0\t0\t0
STAGE LIST COUNT\t2
STAGE\tXYZ\t0\t0\t0\tAIM\t0\t0\t1\tZROT\t0\tVIRTUAL\t0\tMULTIHIT\t1\tELEMENTS\t1\tTRACETHROUGH\t0
Heliostat field
1\t0\t100\t0\t0\t0\t200\t0\tr\t10\t8\t0\t0\t0\t0\t0\t0\tp\t0.004\t0.004\t0\t0\t0\t0\t0\t0\t\tmirror\t2\t
STAGE\tXYZ\t0\t0\t0\tAIM\t0\t0\t1\tZROT\t0\tVIRTUAL\t0\tMULTIHIT\t1\tELEMENTS\t1\tTRACETHROUGH\t0
Receiver
1\t0\t0\t60\t0\t100\t60\t0\tr\t8\t6\t0\t0\t0\t0\t0\t0\tf\t0\t0\t0\t0\t0\t0\t0\t0\t\tmirror\t2\t
"""


def test_small_soltrace_input_is_read(tmp_path: Path):
    file = tmp_path / "small.stinput"
    file.write_text(SMALL)
    (entry,) = read_soltrace(file).heliostats
    assert entry.focal_length_m == 125


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("# SOLTRACE", "# TONATIUH", 1, "must begin with # SOLTRACE"),
        ("SHAPE\tp", "SHAPE\tx", 2, "none of p, g, d"),
        ("USELDH\t0", "USELDH\t1", 3, "give its position"),
        ("OPTICAL\tg", "OPTICAL\tp", 7, "not Gaussian"),
        ("0.9", "1.9", 7, "must be a number in [0, 1]"),
        ("ZROT\t0\tVIRTUAL", "ZROT\t9\tVIRTUAL", 10, "is not read"),
        ("r\t10", "h\t10", 12, "aperture 'h' of a heliostat is not read"),
        ("r\t10", "r\t0", 12, "width and height"),
        ("p\t0.004\t0.004", "p\t0.004\t0.005", 12, "surface 'p' of a heliostat is not read"),
        ("200\t0\tr", "200\t30\tr", 12, "rolled about its normal"),
        ("r\t8", "c\t8", 15, "only receivers that are"),
    ],
)
def test_each_mistake_of_soltrace_is_named(
    tmp_path: Path, old: str, new: str, line: int, said: str
):
    file = tmp_path / "small.stinput"
    file.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(InvalidInputError) as refused:
        read_soltrace(file)
    assert str(refused.value).startswith(f"{file}, line {line}: ")
    assert said in str(refused.value)


LAYOUTS = (
    "0,10,20,0\n1,30,40,0\n",
    "0,10,20,0,NULL,NULL,NULL,NULL,NULL,0,0,60\n",
    "Heliostat ID,Pos-x,Pos-y,Pos-z,Aim-x,Aim-y,Aim-z\n1,2,30,0,0,0,60\n",
    "Name,X,Y,Z,Num. Facets,Num. Rows,Num. Cols,Pivot Height,Pivot Offset,Facet Width,Facet Height\n"
    "5E10,92.61,57.92,5.45,25,5,5,4.02,0.1778,1.2192,1.2192\n",
)


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    text=st.sampled_from([SMALL, *LAYOUTS]),
    place=st.floats(0, 1),
    cut=st.integers(0, 30),
    put=st.sampled_from(["", "\t", "\n", ",", "0", "-1", "1e300", "nan", "NULL", "é", "x", "\x00"]),
)
def test_foreign_files_do_no_harm(
    tmp_path_factory: pytest.TempPathFactory, text: str, place: float, cut: int, put: str
):
    at = int(place * len(text))
    suffix = "stinput" if text is SMALL else "csv"
    folder = tmp_path_factory.mktemp("foreign")
    file = folder / f"file.{suffix}"
    file.write_text(text[:at] + put + text[at + cut :], encoding="utf-8")
    try:
        imported = read_foreign(file)
        read_plant(imported.write(folder / "plant")[0])
    except InvalidInputError:
        pass
