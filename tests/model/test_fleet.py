"""The light of many heliostats on one receiver."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from model import neighbours
from model.effects import Always, Effect
from model.effects.axis_tilt import AxisTilt
from model.effects.blocking import Blocking
from model.effects.camera_blur import CameraBlur
from model.effects.camera_response import CameraResponse
from model.effects.slope_error import SlopeError
from model.fleet import Superposition, aligned_field, superpose, tile_of, tiles
from model.frames import sun_direction
from model.neighbours import clear
from model.plant import Cylinder, Facet, Heliostat
from model.plant_model import JUELICH_MODEL, PlantModel
from model.setup import Setup
from model.site import JUELICH
from model.sunshape import Buie, Pillbox
from model.surface import control_points
from model.tracing import Optics, Scene, Window, trace
from model.tracing.montecarlo import trace_montecarlo
from tests.conftest import target
from tests.field_rays import onto_cylinder, onto_plane, trace_field

SUN = sun_direction(150.0, 35.0)
HALF_ANGLE = 4.65e-3
OPTICS = Optics(sun_shape=Pillbox(HALF_ANGLE))


def field(rows: int, columns: int, apart: tuple[float, float], near: float) -> list[Heliostat]:
    """Juelich mirrors in a grid, ``apart`` [m] from each other to the north and to the east, canted
    to their tower.
    """
    positions = [
        np.array(
            [(column - (columns - 1) / 2) * apart[1] + 0.4 * (row % 2), near + row * apart[0], 1.8]
        )
        for row in range(rows)
        for column in range(columns)
    ]
    return [
        Heliostat.juelich(f"H{index}", position, float(np.hypot(position[1], 40.0)))
        for index, position in enumerate(positions)
    ]


def setups(heliostats: list[Heliostat], sun=SUN, aim=None) -> list[Setup]:
    plane = target()
    return [Setup(one, control_points(one), sun, plane, aim=aim) for one in heliostats]


def test_fleet_is_the_sum_of_its_mirrors_however_it_is_tiled():
    some, plane = setups(field(3, 3, (20.0, 20.0), 60.0)), target(10.0)
    task = Superposition(
        plane, PlantModel(JUELICH, OPTICS, (SlopeError(sigma_mrad=1.0),)), (48, 64)
    )
    whole = superpose(task, tiles(some))
    assert (whole.heliostats, whole.skipped) == (9, {})
    angles = [
        setup.heliostat.mount.align(setup.heliostat.position, SUN, plane.center) for setup in some
    ]
    scene = Scene.from_setups([replace(setup, plane=plane) for setup in some], angles)
    each = trace(
        scene, Window.of(plane, 48, 64), replace(OPTICS, slope_error=1e-3), samples=16, padding=0.25
    )
    np.testing.assert_allclose(
        whole.irradiance, each.irradiance.sum(0), atol=1e-5 * whole.irradiance.max()
    )
    assert whole.power == pytest.approx(float(each.power.sum()), rel=1e-5)
    for size in (1, 2):
        again = superpose(task, tiles(some, size=size))
        np.testing.assert_allclose(
            again.irradiance, whole.irradiance, atol=1e-6 * whole.irradiance.max()
        )


def test_an_effect_of_one_heliostat_is_in_its_light_only():
    """Of a mirror that leans as well as of one that is rough; neighbours stand as they do."""
    heliostats, plane = field(1, 2, (20.0, 20.0), 60.0), target(10.0)
    effects = SlopeError(2.0, scope=Always(("H1",))), AxisTilt(3.0, scope=Always(("H1",)))
    everywhere = tuple(replace(effect, scope=Always()) for effect in effects)

    def light(names: slice, there: Sequence[Effect]) -> np.ndarray:
        task = Superposition(plane, PlantModel(JUELICH, OPTICS, tuple(there)), (48, 64))
        return superpose(task, tiles(setups(heliostats[names]))).irradiance

    whole, apart = light(slice(2), effects), light(slice(1), ()) + light(slice(1, 2), everywhere)
    np.testing.assert_allclose(
        whole, apart, atol=2e-3 * whole.max()
    )  # ripples below zero are cut off once, or twice
    assert np.abs(whole - light(slice(2), ())).max() > 0.1 * whole.max()
    standing, square, leaning = (
        aligned_field(
            [(one, (0.0, 0.0, 40.0)) for one in heliostats], SUN, JUELICH_MODEL.with_effects(there)
        )
        for there in (effects, (), everywhere)
    )
    for name, alike, other in (("H0", square, leaning), ("H1", leaning, square)):
        row = standing.rows[name]
        np.testing.assert_array_equal(standing.rectangles[row], alike.rectangles[row])
        assert np.abs(standing.rectangles[row] - other.rectangles[row]).max() > 0.01


@pytest.mark.parametrize("distance", [150.0, 600.0])
def test_the_aureole_lands_where_it_lands_and_no_more_than_that(distance):
    """Under haze a fifth of the light lies beyond the sun's disc: on the receiver, or beside it."""
    plane, hazy = target(10.0), Optics(sun_shape=Buie(0.3))
    (one,) = setups([Heliostat.juelich("far", np.array([20.0, distance, 1.8]), distance)])
    total = superpose(Superposition(plane, PlantModel(JUELICH, hazy), (32, 32)), tiles([one]))
    angles = one.heliostat.mount.align(one.heliostat.position, SUN, plane.center)
    scene = Scene.from_setups([replace(one, plane=plane)], [angles])
    window = Window.of(plane, 32, 32)
    rays, _ = trace_montecarlo(scene, window, hazy, rays=400_000)
    landed, by_rays = (
        image.sum() * np.prod(window.pixel) / total.power for image in (total.irradiance, rays)
    )
    assert landed == pytest.approx(by_rays, abs=0.004)
    assert landed < 1


def test_heliostat_that_cannot_send_light_there_is_skipped_by_name():
    heliostats = field(2, 3, (20.0, 20.0), 60.0)
    heliostats[4] = Heliostat.juelich("behind", np.array([0.0, -60.0, 1.8]), 70.0)
    total = superpose(
        Superposition(target(), PlantModel(JUELICH, OPTICS), (16, 16)),
        tiles(setups(heliostats), standing_of(heliostats)),
    )
    assert total.heliostats == 5
    assert list(total.skipped) == ["behind"]
    assert "back" in total.skipped["behind"]


def test_camera_does_not_change_flux_on_a_receiver():
    some = setups(field(1, 2, (20.0, 20.0), 60.0))
    light = superpose(Superposition(target(), PlantModel(JUELICH, OPTICS), (32, 32)), tiles(some))
    camera = (CameraResponse(gamma=0.5), CameraBlur(sigma_m=0.4))
    seen = superpose(
        Superposition(target(), PlantModel(JUELICH, OPTICS, tuple(camera)), (32, 32)), tiles(some)
    )
    np.testing.assert_array_equal(seen.irradiance, light.irradiance)


# --- neighbours
# --------------------------------------------------------------------------------------------------


def standing_of(heliostats, sun=SUN, aim=(0.0, 0.0, 40.0)):
    return aligned_field([(one, aim) for one in heliostats], sun, JUELICH_MODEL)


def test_half_a_mirror_behind_another():
    """Seen along the ray, the upper edge of the obstacle lies at half height."""
    x = torch.linspace(-0.975, 0.975, 40)
    points = torch.stack(
        [a.flatten() for a in torch.meshgrid(x, x, indexing="ij")] + [torch.zeros(1600)]
    )[None]
    obstacle = torch.tensor([[[[0.0, -1.0, 5.0], [3.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]])
    ahead = torch.tensor([[[0.0], [0.0], [1.0]]])
    share = clear(obstacle, points, ahead, torch.tensor([0.05]))
    assert float(share.mean()) == pytest.approx(0.5, abs=1e-6)
    assert float(clear(obstacle, points, -ahead, torch.tensor([0.05])).mean()) == 1.0
    shifted = obstacle + torch.tensor([[[[0.0, 0.33, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]]])
    assert float(clear(shifted, points, ahead, torch.tensor([0.05])).mean()) == pytest.approx(
        0.5 - 0.165, abs=1e-5
    )


def test_many_obstacles_hide_as_much_in_the_memory_of_few(monkeypatch):
    """20,000 obstacles of one mirror took 2 GB when all were intersected at once."""
    generator = torch.Generator().manual_seed(1)
    scale = torch.tensor([5.0, 0.2, 0.2])[:, None]  # centres, and half sides
    obstacles = scale * torch.randn(2, 300, 3, 3, generator=generator)
    points, rays = torch.randn(2, 2, 3, 64, generator=generator)
    monkeypatch.setattr(neighbours, "_INTERSECTED", 2**40)
    at_once = clear(obstacles, points, rays, torch.full((2,), 0.1))
    sizes, once = [], neighbours._clear
    monkeypatch.setattr(neighbours, "_INTERSECTED", 2**10)
    monkeypatch.setattr(
        neighbours, "_clear", lambda some, *rest: sizes.append(some.shape[1]) or once(some, *rest)
    )
    assert torch.equal(clear(obstacles, points, rays, torch.full((2,), 0.1)), at_once)
    assert max(sizes) * 2 * 64 <= 2**10
    assert 0 < float(at_once.mean()) < 1


def test_neighbours_that_are_left_out_hide_nothing():
    """The few obstacles that are looked at hide as much as all mirrors of the field do."""
    heliostats = field(5, 5, (3.8, 4.6), 55.0)
    standing = standing_of(heliostats, sun_direction(130.0, 14.0))
    names = [one.name for one in heliostats]
    few = standing.obstacles(names)
    assert few.shape[1] < 16
    for name, some in zip(names, few, strict=True):
        rectangle = standing.rectangles[standing.rows[name]]
        others = np.delete(standing.rectangles, standing.rows[name], axis=0)
        grid = np.linspace(-0.95, 0.95, 12)
        points = torch.tensor(
            rectangle[0] + [x * rectangle[1] + y * rectangle[2] for x in grid for y in grid]
        ).T[None]
        for way in (standing.sun, np.array([0.0, 0.0, 40.0]) - rectangle[0]):
            ray, cell = torch.tensor(way)[None, :, None], torch.tensor([0.2], dtype=torch.float64)
            expected = clear(torch.tensor(others)[None], points, ray, cell)
            torch.testing.assert_close(clear(torch.tensor(some)[None], points, ray, cell), expected)


@pytest.mark.full
def test_blocking_and_shading_of_a_dense_field_against_monte_carlo():
    sun, plane = sun_direction(145.0, 15.0), target(9.0, (0.0, 0.0, 30.0))
    heliostats = field(5, 5, (3.8, 4.4), 55.0)
    expected, powers = trace_field(
        heliostats,
        sun,
        plane.center,
        onto_plane(plane),
        (9.0, 9.0),
        (18, 18),
        half_angle=HALF_ANGLE,
        rays=40_000,
        seed=1,
    )
    some = setups(heliostats, sun, plane.center)
    standing = standing_of(heliostats, sun, plane.center)
    task = Superposition(plane, PlantModel(JUELICH, OPTICS), (18, 18))
    shaded, free = superpose(task, tiles(some, standing)), superpose(task, tiles(some))
    assert powers.sum() < 0.8 * free.power  # the field is dense
    assert shaded.power == pytest.approx(powers.sum(), rel=3e-3)
    for setup, power in zip(some, powers, strict=True):
        assert task(tile_of([setup], standing)).power == pytest.approx(
            power, abs=0.01 * free.power / 25
        )
    assert np.abs(shaded.irradiance - expected).sum() < 0.02 * expected.sum()
    assert np.abs(free.irradiance - expected).sum() > 0.2 * expected.sum()


def test_both_tracers_cast_the_same_shadows():
    sun, plane = sun_direction(145.0, 15.0), target(9.0, (0.0, 0.0, 30.0))
    heliostats = field(3, 3, (3.8, 4.4), 55.0)
    one = heliostats[8]
    angles = one.mount.align(one.position, sun, plane.center)
    scene = Scene.from_setups([Setup(one, control_points(one), sun, plane)], [angles])
    obstacles = standing_of(heliostats, sun, plane.center).obstacles([one.name])
    scene = scene.with_(obstacles=torch.as_tensor(obstacles, dtype=torch.float32))
    window = Window.of(plane, 18, 18)
    expected, _ = trace_montecarlo(scene, window, OPTICS, rays=200_000)
    found = trace(scene, window, OPTICS).irradiance[0].numpy()
    assert found.sum() == pytest.approx(expected.sum(), rel=0.01)
    assert np.abs(found - expected[0]).sum() < 0.05 * expected.sum()


def test_neighbours_replace_the_effect_that_approximates_them():
    heliostats = field(1, 1, (4.0, 4.0), 60.0)
    effects = (Blocking(lower_fraction={"H0": 0.5}),)
    task = Superposition(target(), PlantModel(JUELICH, OPTICS, tuple(effects)), (16, 16))
    alone = superpose(task, tiles(setups(heliostats), standing_of(heliostats))).power
    assert superpose(task, tiles(setups(heliostats))).power == pytest.approx(alone / 2, rel=1e-3)


@pytest.mark.parametrize(
    "slender",
    [
        replace(target(), width=1000.0, height=0.01),
        Cylinder("r", [0, 2.0, 40], [0, 1, 0], [0, 0, 1], 2.0, 4.0, 1e-9),
    ],
    ids=["plane", "cylinder"],
)
def test_a_surface_that_needs_too_fine_a_grid_is_refused_before_it_takes_memory(slender):
    """Its pixels are narrow, and light is followed as far beyond it as the cone of the
    sun reaches.
    """
    task = Superposition(slender, PlantModel(JUELICH, OPTICS), (1024, 1024))
    total = superpose(task, tiles(setups(field(1, 1, (4.0, 4.0), 60.0), aim=slender.center)))
    assert total.skipped["H0"].startswith("resolution: 1024 x ")


# --- cylinders
# --------------------------------------------------------------------------------------------------


def test_cylinder_takes_in_all_that_is_thrown_at_it():
    cylinder = Cylinder("r", [0, 3.0, 40], [0, 1, 0], [0, 0, 1], 3.0, 24.0)
    heliostats = field(2, 4, (30.0, 30.0), 90.0)
    aim = np.array([0.0, 0.0, 40.0])
    total = superpose(
        Superposition(cylinder, PlantModel(JUELICH, OPTICS), (96, 180)),
        tiles(setups(heliostats, aim=aim)),
    )
    pixel = cylinder.width * cylinder.height / (96 * 180)
    assert total.irradiance.sum() * pixel == pytest.approx(total.power, rel=3e-3)
    assert (
        total.irradiance[:, :30].max() < 0.01 * total.irradiance.max()
    )  # its back, away from the field


def test_cylinder_in_parallel_light_has_the_cosine_of_its_angle():
    """One large, flat facet far away before a small sun: its light is parallel and even across the
    receiver.
    """
    flat = Facet(np.zeros(3), np.array([10.0, 0, 0]), np.array([0, 8.0, 0]))
    far = replace(
        Heliostat.juelich("far", np.array([0.0, 1200.0, 40.0])),
        facets=(flat,),
        width=20.0,
        height=16.0,
    )
    cylinder = Cylinder("r", [0, 2.0, 40], [0, 1, 0], [0, 0, 1], 2.0, 2.0, 120.0)
    task = Superposition(
        cylinder, PlantModel(JUELICH, Optics(sun_shape=Pillbox(3e-4))), (8, 60), samples=96
    )
    found = superpose(
        task, tiles(setups([far], sun_direction(0.0, 60.0), np.array([0.0, 0.0, 40.0])))
    )
    angle = np.radians((np.arange(60) + 0.5) / 60 * 120 - 60)
    np.testing.assert_allclose(found.irradiance / np.cos(angle), 1000.0, rtol=0.01)


def test_mirror_behind_the_lit_part_of_a_cylinder_is_skipped():
    cylinder = Cylinder("r", [0, 2.0, 40], [0, 1, 0], [0, 0, 1], 2.0, 4.0, 60.0)
    heliostats = [
        *field(1, 2, (20.0, 20.0), 60.0),
        Heliostat.juelich("south", np.array([0.0, -80.0, 1.8]), 90.0),
    ]
    total = superpose(
        Superposition(cylinder, PlantModel(JUELICH, OPTICS), (16, 16)),
        tiles(setups(heliostats, aim=cylinder.center)),
    )
    assert (total.heliostats, list(total.skipped)) == (2, ["south"])
    assert "behind the lit part" in total.skipped["south"]


@pytest.mark.parametrize("opening", [60.0, 360.0])
def test_cylinder_against_monte_carlo(opening: float):
    tilt = np.radians(20.0)
    cylinder = Cylinder(
        "r",
        [0.0, 2.5, 40.0],
        [0.0, np.cos(tilt), -np.sin(tilt)],
        [0.0, 0.0, 1.0],
        2.5,
        6.0,
        opening,
    )
    heliostats = field(2, 5, (25.0, 28.0), 60.0)
    aim, bins = cylinder.center, (12, 24)
    expected, powers = trace_field(
        heliostats,
        SUN,
        aim,
        onto_cylinder(cylinder),
        (cylinder.width, cylinder.height),
        bins,
        half_angle=HALF_ANGLE,
        rays=60_000,
        seed=2,
        shadows=False,
    )
    found = superpose(
        Superposition(cylinder, PlantModel(JUELICH, OPTICS), (48, 96)),
        tiles(setups(heliostats, aim=aim)),
    )
    coarse = found.irradiance.reshape(12, 4, 24, 4).mean(axis=(1, 3))
    assert found.power == pytest.approx(powers.sum(), rel=3e-3)
    assert coarse.sum() == pytest.approx(expected.sum(), rel=5e-3)
    assert np.abs(coarse - expected).sum() < 0.02 * expected.sum()
