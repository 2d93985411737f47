"""Scenarios of ARTIST: what is written is read as it was, and what cannot be said is named."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.plant import Heliostat
from model.surface import basis, control_points, heights, nominal_heights
from service.sources.folder import measured_heights, read_surface
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.artist import read_artist
from service.sources.plant_formats.artist_export import write_artist
from service.sources.plant_formats.artist_heliostats import ON_ITS_SIDE, first_tilt
from service.sources.plant_formats.formats import read_foreign
from tests.service.command import ends, heliotwin
from tests.service.sources.plant_files import PLANT, THREE_MOUNTS, write_plant, write_three_mounts

SUN = sun_direction(215.0, 35.0)


def exported(folder: Path) -> tuple[PlantDescription, Path]:
    """The plant of three mounts, and its scenario."""
    plant = read_plant(write_three_mounts(folder))
    scenario = folder / "scenario.h5"
    write_artist(plant, scenario, None)
    return plant, scenario


def mirror_in_the_field(heliostat: Heliostat, aim: np.ndarray) -> np.ndarray:
    """Control points (F, I, J, 3) [m] in ENU of a mirror that reflects the sun to ``aim``."""
    mount = heliostat.mount
    attitude = mount.attitude(mount.align(heliostat.position, SUN, aim))
    middle = mount.mirror_center(heliostat.position, attitude)
    return middle + control_points(heliostat) @ attitude.T


def test_a_plant_returns_from_artist_as_it_was(tmp_path: Path):
    before, scenario = exported(tmp_path)
    imported = read_foreign(scenario)
    assert imported.surfaces == {}
    after = read_plant(imported.write(tmp_path / "again")[0])
    aim = before.plant.targets["cal"].center
    assert list(after.plant.heliostats) == list(before.plant.heliostats)
    for name, one in before.plant.heliostats.items():
        pair = [mirror_in_the_field(h, aim) for h in (one, after.plant.heliostats[name])]
        np.testing.assert_allclose(pair[1], pair[0], atol=2e-6)
    assert len(after.types) == 3
    np.testing.assert_allclose(after.plant.site.origin, before.plant.site.origin)
    target, receiver = after.plant.targets["cal"], after.receivers["main"]
    np.testing.assert_allclose(target.center, before.plant.targets["cal"].center)
    assert (target.width, target.height) == (14, 14)
    np.testing.assert_allclose(receiver.center, before.receivers["main"].center, atol=1e-6)
    assert receiver.shape == pytest.approx({"radius": 4, "opening_deg": 180})
    assert after.optics.sun_shape.sigma == pytest.approx(2.35e-3)


def test_motor_positions_return(tmp_path: Path):
    before, scenario = exported(tmp_path)
    after = read_plant(read_artist(scenario).write(tmp_path / "again")[0])
    pair = [plant.plant.heliostats["C1"].mount for plant in (before, after)]
    steps = np.array([30_000.0, 41_000.0])
    attitudes = [mount.attitude(mount.angles_from_motors(steps)) for mount in pair]
    np.testing.assert_allclose(attitudes[1], attitudes[0], atol=1e-6)


def test_poses_are_those_of_artist_kinematics(tmp_path: Path):
    """ARTIST's chain of joints, solved for a normal, gives our mirror's attitude."""
    plant, scenario = exported(tmp_path)
    aim = plant.plant.targets["cal"].center
    lying = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    with h5py.File(scenario) as data:
        for name, one in plant.plant.heliostats.items():
            body = data[f"heliostats/{name}/kinematics/deviations"]
            tilt = first_tilt(body["first_joint_tilt_n"][()], body["first_joint_tilt_u"][()])
            mount = one.mount
            attitude = mount.attitude(mount.align(one.position, SUN, aim))
            normal = tilt.T @ attitude[:, 2]
            second = np.arcsin(normal[0])
            first = np.arctan2(-normal[2], -normal[1])
            c, s = np.cos(first), np.sin(first)
            east = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
            c, s = np.cos(second), np.sin(second)
            up = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            turn = tilt @ east @ up
            facets = data[f"heliostats/{name}/surface/facets"]
            points = np.array([facet["control_points"][()] for facet in facets.values()])
            if not points[..., 2].any():
                points = (
                    points + np.array([f["position"][:3] for f in facets.values()])[:, None, None]
                )
            joint = np.array([body[f"first_joint_translation_{a}"][()] for a in "enu"])
            offset = np.array([body[f"concentrator_translation_{a}"][()] for a in "enu"])
            theirs = one.position + tilt @ joint + turn @ offset + points @ (turn @ lying).T
            np.testing.assert_allclose(theirs, mirror_in_the_field(one, aim), atol=1e-9)


def test_measured_surfaces_go_both_ways(tmp_path: Path):
    path = write_three_mounts(tmp_path)
    plant = read_plant(path)
    rng = np.random.default_rng(1)
    for name in ("A1", "B2"):
        heliostat = plant.plant.heliostats[name]
        folder = tmp_path / name / "Deflectometry"
        folder.mkdir(parents=True)
        z = rng.normal(0, 3e-4, (len(heliostat.facets), 10, 9))
        points = control_points(heliostat, z)
        np.savez(folder / f"{name}-nurbs-surface.npz", control_points=points)
    scenario, again = tmp_path / "scenario.h5", tmp_path / "again"
    arguments = ("plant", "export", path, "--format", "artist", "--surfaces", tmp_path)
    done = heliotwin(*arguments, "--out", scenario)
    assert done.returncode == 0, done.stderr
    assert heliotwin("plant", "import", scenario, "--out", again).returncode == 0
    after = read_plant(again / "plant.yaml")
    for name, one in after.plant.heliostats.items():
        found = read_surface(again, one)
        assert (found is not None) == (name in ("A1", "B2"))
        if found is not None:
            given = read_surface(tmp_path, plant.plant.heliostats[name])
            assert given is not None
            np.testing.assert_allclose(found[0], given[0], atol=1e-9)


def test_notes_name_what_a_scenario_cannot_say(tmp_path: Path):
    grid = "{rows: 4, columns: 7, width_m: 1.8, height_m: 1.35, gap_m: 0.02}"
    text = PLANT.replace("{file: facets.csv}", grid).replace(
        "pillbox, half_angle", "gaussian, sigma"
    )
    path = write_plant(tmp_path, text, layout="name,type,east_m,north_m,up_m\nA1,large,0,200,0\n")
    notes = "\n".join(write_artist(read_plant(path), tmp_path / "scenario.h5", None))
    for said in (
        "heliostat_types.large.reflectance 0.95",
        "heliostat_types.large.slope_error_mrad 1",
        "heliostat_types.large.pointing_error_mrad 0.5",
        "receivers.main.absorptance 0.94",
        "tower",
        "atmosphere",
    ):
        assert said in notes


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "{shape: gaussian, sigma_mrad: 2.35}",
            "{shape: pillbox}",
            "sun: ARTIST's sun is a normal",
        ),
        ("kind: pitch_roll", "kind: target_aligned", "heliostat B1: ARTIST has no mount of kind"),
        ("normal: [0, 1, 0]", "normal: [1, 1, 0]", "receivers.cal: ARTIST's planes are upright"),
        (
            "rows: 2, columns: 3, width_m: 1.8, height_m: 1.35, gap_m: 0.02}\n    canting: flat",
            "rows: 1, columns: 3, width_m: 1.8, height_m: 1.35}\n    canting: flat",
            "different numbers of facets (C1 3, B2 6)",
        ),
    ],
)
def test_export_is_refused(tmp_path: Path, old: str, new: str, said: str):
    path = write_three_mounts(tmp_path)
    assert old in THREE_MOUNTS
    path.write_text(THREE_MOUNTS.replace(old, new, 1))
    with pytest.raises(InvalidInputError) as refused:
        write_artist(read_plant(path), tmp_path / "scenario.h5", None)
    assert said in str(refused.value)
    assert not (tmp_path / "scenario.h5").exists()


def test_options_of_other_formats_are_refused(tmp_path: Path):
    path = write_three_mounts(tmp_path)
    out = ("--out", tmp_path / "out.h5")
    export = ("plant", "export", path, "--format")
    ends(heliotwin(*export, "artist", "--sun", 180, 60, *out), 2, "--sun: a scenario of ARTIST")
    ends(
        heliotwin(*export, "solarpilot", "--surfaces", tmp_path, *out), 2, "--surfaces: solarpilot"
    )


def put(path: str, value: object) -> Callable[[h5py.File], None]:
    """A change of one dataset."""

    def change(file: h5py.File) -> None:
        if path in file:
            del file[path]
        file[path] = value

    return change


def drop(path: str) -> Callable[[h5py.File], None]:
    """A change that deletes."""

    def change(file: h5py.File) -> None:
        del file[path]

    return change


def second_sun(file: h5py.File) -> None:
    file.copy("lightsources/sun_1", "lightsources/sun_2")


def turned_facet(file: h5py.File) -> None:
    sides = file["heliostats/B1/surface/facets/facet_1/canting"]
    sides[...] = [[0.8, 0.1, 0, 0], [-0.1, 0.8, 0, 0]]


B1 = "heliostats/B1"
JOINTS = f"{B1}/kinematics/deviations"
PLANE, CYLINDER = "target_areas_planar/cal", "target_areas_cylindrical/main"


@pytest.mark.full
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (second_sun, "lightsources: has 2 light sources"),
        (put("lightsources/sun_1/distribution_parameters/covariance", -1.0), "'covariance' must"),
        (put("lightsources/sun_1/distribution_parameters/mean", 0.1), "'mean' must be 0"),
        (put(f"{B1}/kinematics/type", "hexapod"), f"{B1}/kinematics: 'type' 'hexapod' is not read"),
        (put(f"{B1}/actuator/actuator_1/type", "linear"), "two ideal or two linear ones"),
        (put(f"{B1}/kinematics/deviations/third_joint", 1.0), "'third_joint' is not known"),
        (put(f"{B1}/position", np.zeros(3)), f"{B1}: 'position' must be numbers of shape (4,)"),
        (put(f"{B1}/position", np.full(4, np.nan)), f"{B1}: 'position' must be finite"),
        (drop(f"{B1}/surface/facets/facet_3/canting"), "facet_3: 'canting' is missing"),
        (turned_facet, f"{B1}/surface: 'canting' has a facet that is turned"),
        (drop("prototypes"), "is no scenario of ARTIST"),
        (drop("target_areas_cylindrical/main/cylinder_radius"), "'cylinder_radius' is missing"),
    ],
)
def test_each_mistake_of_a_scenario_is_named(
    tmp_path: Path, change: Callable[[h5py.File], None], said: str
):
    _, scenario = exported(tmp_path)
    with h5py.File(scenario, "r+") as file:
        change(file)
    with pytest.raises(InvalidInputError) as refused:
        read_artist(scenario)
    assert str(refused.value).startswith(str(scenario))
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (put(f"{JOINTS}/second_joint_tilt_e", 2e-3), "second_joint_tilt_e is left out, 2 mrad"),
        (put(f"{JOINTS}/concentrator_translation_u", -0.4), "is left out, 0.4 m"),
        (put(f"{PLANE}/normal_vector", [0.0, 1, 1, 0]), "cal is left out. It does not face"),
        (put(f"{CYLINDER}/cylinder_axis", [0, 0.4, 0.9, 0]), "main is left out. It is inclined"),
        (put(f"{CYLINDER}/cylinder_opening_angle", 60.0), "opens by more than 2 pi"),
    ],
)
def test_what_a_plant_cannot_say_is_noted(
    tmp_path: Path, change: Callable[[h5py.File], None], said: str
):
    _, scenario = exported(tmp_path)
    with h5py.File(scenario, "r+") as file:
        change(file)
    notes = "\n".join(read_artist(scenario).notes)
    assert said in notes


def test_a_sofast_file_is_no_plant(tmp_path: Path):
    file = tmp_path / "measured.h5"
    with h5py.File(file, "w") as data:
        data.create_group("DataSofastCalculation")
    ends(
        heliotwin("plant", "import", file, "--out", tmp_path / "out"),
        2,
        "put it into H/Deflectometry beside plant.yaml",
    )


FOCAL_M = 100.0


def even_splines(heliostat: Heliostat, focal_length_m: float, count: int = 40) -> np.ndarray:
    """Evenly spaced control points (F, count, count, 3) [m] whose splines are paraboloids."""
    u = (np.arange(4 * count) + 0.5) / (4 * count)
    fit = np.linalg.pinv(basis(count, 3, u).values)
    centers, axes, half_sizes = heliostat.facet_frames
    found = []
    for center, frame, half in zip(centers, axes, half_sizes, strict=True):
        x, y = (size * np.linspace(-1, 1, count) for size in half)
        place_x, place_y = (basis(count, 3, u).values @ along for along in (x, y))
        z = (place_x[:, None] ** 2 + place_y**2) / (4 * focal_length_m)
        grid = np.stack(np.broadcast_arrays(x[:, None], y, fit @ z @ fit.T), axis=-1)
        found.append(center + grid @ frame)
    return np.array(found)


def written_spline(folder: Path, **more: np.ndarray) -> tuple[Heliostat, np.ndarray]:
    """Heights (F, 8, 8) [m] that are read of even splines, of a heliostat of flat facets."""
    heliostat = read_plant(write_three_mounts(folder)).plant.heliostats["B1"]
    heliostat = replace(
        heliostat, facets=tuple(replace(one, focal_length=None) for one in heliostat.facets)
    )
    place = folder / "B1" / "Deflectometry"
    place.mkdir(parents=True)
    points = even_splines(heliostat, FOCAL_M)
    np.savez(place / "B1-nurbs-surface.npz", control_points=points, **more)
    surface = read_surface(folder, heliostat)
    assert surface is not None
    return heliostat, measured_heights(heliostat, surface)


def focused_heights(heliostat: Heliostat) -> np.ndarray:
    facets = tuple(replace(one, focal_length=FOCAL_M) for one in heliostat.facets)
    return nominal_heights(replace(heliostat, facets=facets))


def test_a_spline_is_its_geometry(tmp_path: Path):
    heliostat, z = written_spline(tmp_path)
    np.testing.assert_allclose(z, focused_heights(heliostat), atol=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("declared", [{"normals": np.zeros(3)}, {"parameters_are_positions": 1}])
def test_of_a_fit_of_deflectometry_parameters_are_positions(tmp_path: Path, declared: dict):
    """Its normals belong to places at the parameters, which traced light and heights then share."""
    heliostat, z = written_spline(tmp_path, **declared)
    expected = heights(heliostat, even_splines(heliostat, FOCAL_M), 3, True)
    np.testing.assert_allclose(z, expected, atol=5e-7)
    assert np.abs(z - focused_heights(heliostat)).max() > 5e-6


def test_a_declaration_decides(tmp_path: Path):
    heliostat, z = written_spline(tmp_path, normals=np.zeros(3), parameters_are_positions=0)
    np.testing.assert_allclose(z, focused_heights(heliostat), atol=1e-6)


@pytest.mark.parametrize("as_positions", [False, True])
def test_focused_facets_of_even_control_points_return(tmp_path: Path, as_positions: bool):
    """Read as its geometry a focused mirror is a design; else it is a measured one."""
    plant, scenario = exported(tmp_path)
    for name, one in plant.plant.heliostats.items():
        points = even_splines(one, FOCAL_M) @ (ON_ITS_SIDE.T if name[0] == "A" else np.eye(3))
        with h5py.File(scenario, "r+") as file:
            for number, facet in enumerate(file[f"heliostats/{name}/surface/facets"].values()):
                del facet["control_points"]
                facet["control_points"] = points[number]
    imported = read_artist(scenario, as_positions)
    assert bool(imported.surfaces) == as_positions
    if as_positions:
        assert any("fits of deflectometry, a parameter" in note for note in imported.notes)
        assert all(one.parameters_are_positions for one in imported.surfaces.values())
    else:
        for kind in imported.parts["heliostat_types"].values():
            shape = kind["facet_shape"]
            assert shape == "slant_range" or shape["focal_length_m"] == pytest.approx(100, rel=1e-3)


def test_areas_that_no_plant_has_are_named_by_the_group_that_is_there(tmp_path: Path):
    _, scenario = exported(tmp_path)
    with h5py.File(scenario, "r+") as file:
        file.move("target_areas_planar", "target_areas")
        del file["target_areas_cylindrical"]
        for area in file["target_areas"].values():
            area["geometry"] = "convex_cylinder"
        for group in (*file["heliostats"].values(), file["prototypes"]):
            group.move("kinematics", "kinematic")
    with pytest.raises(InvalidInputError, match=r"in target_areas: .* cal is left out"):
        read_artist(scenario)
