"""What becomes of each watt of a field, on receivers of every kind.

Metamorphic tests: a change of the plant whose effect is known without any tracer.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.errors import InvalidInputError
from model.fleet import (
    FleetFlux,
    Losses,
    Superposition,
    aligned_field,
    field_losses,
    superpose,
    tiles,
)
from model.frames import sun_direction
from model.heliostat_type import (
    MOUNT_KINDS,
    Canting,
    FacetDesign,
    HeliostatType,
    MountDesign,
    circle_outline,
    facet_grid,
)
from model.plant import Cylinder, Heliostat, MirrorOptics, Receiver, TargetPlane, Tower
from model.plant_model import PlantModel
from model.receivers import Cavity, Panels
from model.setup import Setup
from model.site import JUELICH
from model.sunshape import Buie, Pillbox
from model.surface import control_points, nominal_heights
from model.tracing import Optics, Scene, Window, trace
from model.tracing.montecarlo import trace_montecarlo

NORTH, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
OPTICS = Optics(Pillbox(4.65e-3), attenuation=(0.0068, 0.1046, -0.017, 0.0028), dni=900.0)
MIRROR = MirrorOptics(0.93, 1.2e-3, 0.6e-3)
BOARD = TargetPlane("board", np.array([0.0, 0.0, 60.0]), NORTH, UP, 9.0, 8.0, 0.9)
CYLINDER = Cylinder("main", np.array([0.0, 4.0, 60.0]), NORTH, UP, 4.0, 9.0, 360.0, 0.94)


def _panel(east: float, north: float, normal: tuple[float, float]) -> TargetPlane:
    center = np.array([east, north, 60.0])
    return TargetPlane("panel", center, np.array([*normal, 0.0]), UP, 5.0, 9.0)


PANELS = Panels("panels", (_panel(2.33, 0.0, (0.4, 1.0)), _panel(-2.33, 0.0, (-0.4, 1.0))), 0.9)
CAVITY = Cavity(
    "cavity",
    (_panel(2.46, -3.0, (-0.2, 1.0)), _panel(-2.46, -3.0, (0.2, 1.0))),
    0.95,
    aperture=np.array([[4.0, 0, 56.0], [-4.0, 0, 56.0], [-3.0, 0, 64.0], [3.0, 0, 64.0]]),
)
RECEIVERS = (BOARD, CYLINDER, PANELS, CAVITY)


def mirror_type(**changes: object) -> HeliostatType:
    plain = HeliostatType(
        "plain",
        facet_grid(2, 3, 1.8, 1.6, 0.05),
        MountDesign("azimuth_elevation", 3.0, 0.15),
        canting=Canting("on_axis"),
        optics=MIRROR,
    )
    return replace(plain, **changes)  # type: ignore[arg-type]


FEET = [(x, y, 0.0) for y in (60.0, 66.0, 110.0) for x in (-40.0, -6.0, 0.0, 6.0, 55.0)]


def flux_of(
    receiver: Receiver,
    kind: HeliostatType | None = None,
    feet: list[tuple[float, float, float]] = FEET,
    sun: tuple[float, float] = (150.0, 25.0),
    tower: Tower | None = None,
    optics: Optics = OPTICS,
    resolution: tuple[int, int] = (48, 96),
    samples: int = 10,
) -> FleetFlux:
    kind, direction = kind or mirror_type(), sun_direction(*sun)
    heliostats = [kind.heliostat(f"H{n}", foot, receiver.center) for n, foot in enumerate(feet)]
    model = PlantModel(JUELICH, optics)
    around = aligned_field(
        [(one, receiver.aim_of(one.position)) for one in heliostats], direction, model
    )
    task = Superposition(
        receiver, model, resolution, samples, None if tower is None else tower.outline(direction)
    )
    return superpose(task, tiles(setups(heliostats, receiver, direction), around))


def setups(heliostats: list[Heliostat], receiver: Receiver, sun: np.ndarray) -> list[Setup]:
    return [
        Setup(one, control_points(one), sun, receiver.middle, aim=receiver.aim_of(one.position))
        for one in heliostats
    ]


def factors(losses: Losses) -> list[float]:
    return [losses.cosine, losses.shading, losses.blocking, losses.attenuation, losses.intercept]


@pytest.mark.parametrize("receiver", RECEIVERS, ids=lambda one: one.name)
def test_energy_closes_on_every_receiver(receiver: Receiver):
    found = flux_of(receiver)
    whole = field_losses(found.losses.values())
    areas = receiver.grid(48, 96).areas
    on_map = float((found.irradiance * areas).sum())
    intercepted = whole.area * OPTICS.dni * whole.intercepted
    assert len(found.losses) == len(FEET)
    assert on_map == pytest.approx(intercepted, rel=1e-3)
    assert areas.sum() == pytest.approx(receiver.width * receiver.height, rel=1e-9)
    by_heliostat = sum(one.area * OPTICS.dni * one.intercepted for one in found.losses.values())
    assert by_heliostat == pytest.approx(intercepted, rel=1e-9)
    assert found.power * whole.intercept == pytest.approx(intercepted, rel=1e-6)
    for one in found.losses.values():
        assert all(0 < factor <= 1 + 1e-6 for factor in factors(one))
    assert 0.5 < whole.intercept <= 1
    assert whole.reflectance == pytest.approx(MIRROR.reflectance)


def height_of(found: FleetFlux, receiver: Receiver) -> float:
    """Height [m] of the light's centre over the receiver's middle."""
    rows = found.irradiance.sum(axis=1)
    up = (0.5 - (np.arange(len(rows)) + 0.5) / len(rows)) * receiver.height
    return float(rows @ up / rows.sum())


@pytest.mark.parametrize("foot", [(0.0, 60.0, 0.0), (-30.0, 40.0, 0.0), (90.0, -20.0, 0.0)])
def test_spots_are_at_mid_height_of_a_cylinder(foot: tuple[float, float, float]):
    """Beams to the axis meet the surface below, by the radius times the beam's slope."""
    tall = replace(CYLINDER, height=24.0)
    kind = mirror_type(facets=facet_grid(1, 1, 0.6, 0.6, 0.0), mount=MountDesign(pivot_height=3.0))
    height = height_of(flux_of(tall, kind, [foot], resolution=(96, 96)), tall)
    assert height == pytest.approx(0.0, abs=0.25)
    below = tall.radius * (tall.center[2] - 3.0) / np.hypot(*foot[:2])
    assert below > 2.0  # what an aim at the axis would make of it


def test_default_aims_face_mirrors():
    feet = np.array(FEET) + [0.0, -90.0, 0.0]
    aims = CYLINDER.aim_of(feet)
    outward = (aims - CYLINDER.axis) / CYLINDER.radius
    np.testing.assert_allclose(np.linalg.norm(outward, axis=-1), 1)
    level = (feet - CYLINDER.axis) * [1, 1, 0]
    np.testing.assert_allclose(outward, level / np.linalg.norm(level, axis=-1)[:, None], atol=1e-9)
    np.testing.assert_array_equal(BOARD.aim_of(feet), np.tile(BOARD.center, (len(feet), 1)))


@pytest.mark.parametrize(
    ("opening", "azimuth"),
    [(180.0, 0.0), (60.0, 0.0), (60.0, 60.0), (180.0, 90.0), (120.0, -80.0), (270.0, 0.0)],
)
def test_on_a_part_of_a_cylinder_mirrors_aim_at_the_middle_of_what_they_see(
    opening: float, azimuth: float
):
    part = replace(CYLINDER, opening_deg=opening)
    out = sun_direction(azimuth, 0.0)
    edges = min(opening / 2, azimuth + 90.0), max(-opening / 2, azimuth - 90.0)
    across = [np.cross(out, sun_direction(edge, 0.0))[2] for edge in edges]
    aim = part.aim_of(part.axis + 100 * out) - part.axis
    assert np.linalg.norm(aim) == pytest.approx(part.radius)
    assert np.cross(out, aim)[2] / part.radius == pytest.approx(np.mean(across), abs=1e-9)


@pytest.mark.parametrize("receiver", RECEIVERS, ids=lambda one: one.name)
def test_cleanliness_takes_its_share_of_the_light(receiver: Receiver):
    clean, soiled = (
        flux_of(receiver),
        flux_of(receiver, mirror_type(optics=replace(MIRROR, cleanliness=0.6))),
    )
    np.testing.assert_allclose(soiled.irradiance, 0.6 * clean.irradiance, rtol=1e-4, atol=1.0)
    for before, after in zip(clean.losses.values(), soiled.losses.values(), strict=True):
        assert (before.cleanliness, after.reflectance) == (1, before.reflectance)
        assert after.cleanliness == pytest.approx(0.6)
        assert after.efficiency == pytest.approx(0.6 * before.efficiency, rel=1e-4)


def test_cosine_and_attenuation_are_those_of_geometry():
    found = flux_of(BOARD, mirror_type(canting=Canting("flat")), [(20.0, 300.0, 0.0)])
    middle, sun = np.array([20.0, 300.0, 3.0]), sun_direction(150.0, 25.0)
    outgoing = (BOARD.center - middle) / np.linalg.norm(BOARD.center - middle)
    cosine = np.sqrt((1 + sun @ outgoing) / 2)
    kilometres = np.linalg.norm(BOARD.center - middle) / 1000
    lost = np.polynomial.polynomial.polyval(kilometres, OPTICS.attenuation)
    assert found.losses["H0"].cosine == pytest.approx(cosine, abs=1e-4)
    assert found.losses["H0"].attenuation == pytest.approx(1 - lost, abs=1e-4)
    assert found.losses["H0"].shading == found.losses["H0"].blocking == 1


# --- metamorphic
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("receiver", RECEIVERS, ids=lambda one: one.name)
def test_east_and_west_exchanged(receiver: Receiver):
    here = flux_of(receiver, sun=(150.0, 25.0))
    there = flux_of(receiver, feet=[(-x, y, z) for x, y, z in FEET], sun=(210.0, 25.0))
    np.testing.assert_allclose(
        here.irradiance, there.irradiance[:, ::-1], atol=2e-3 * here.irradiance.max()
    )
    for name, one in here.losses.items():
        np.testing.assert_allclose(factors(one), factors(there.losses[name]), atol=2e-4)


def _turned(receiver: Receiver, turn: np.ndarray) -> Receiver:
    if isinstance(receiver, Panels | Cavity):
        panels = tuple(_turned(panel, turn) for panel in receiver.panels)
        moved = replace(receiver, panels=panels)  # type: ignore[arg-type]
        return (
            replace(moved, aperture=receiver.aperture @ turn.T)
            if isinstance(receiver, Cavity) and isinstance(moved, Cavity)
            else moved
        )
    return replace(  # type: ignore[type-var]
        receiver, center=turn @ receiver.center, normal=turn @ receiver.normal
    )


@pytest.mark.parametrize("receiver", RECEIVERS, ids=lambda one: one.name)
def test_plant_and_sun_turned_together(receiver: Receiver):
    """By 180 degrees: a plant of the other hemisphere."""
    turn = np.diag([-1.0, -1.0, 1.0])
    here = flux_of(receiver)
    feet = [(-x, -y, z) for x, y, z in FEET]
    there = flux_of(_turned(receiver, turn), feet=feet, sun=(330.0, 25.0))
    np.testing.assert_allclose(here.irradiance, there.irradiance, atol=2e-3 * here.irradiance.max())
    for name, one in here.losses.items():
        np.testing.assert_allclose(factors(one), factors(there.losses[name]), atol=2e-4)


def test_one_facet_as_four_that_touch():
    whole = mirror_type(facets=facet_grid(1, 1, 4.0, 3.0, 0.0), canting=Canting("flat"))
    parts = mirror_type(facets=facet_grid(2, 2, 2.0, 1.5, 0.0), canting=Canting("flat"))
    one = flux_of(BOARD, whole, samples=20)
    four = flux_of(BOARD, parts, samples=10)
    np.testing.assert_allclose(one.irradiance, four.irradiance, atol=2e-3 * one.irradiance.max())
    for name, losses in one.losses.items():
        np.testing.assert_allclose(factors(losses), factors(four.losses[name]), atol=3e-4)


def test_a_round_spot_is_the_same_on_every_mount():
    """A round mirror's spot does not show how the mount rolls it."""
    disc = (FacetDesign(np.zeros(3), 3.0, 3.0, circle_outline()),)
    found = [
        flux_of(
            BOARD,
            mirror_type(facets=disc, mount=MountDesign(kind, 3.0, 0.0), focus="slant_range"),
            [(12.0, 120.0, 0.0), (-60.0, 80.0, 0.0)],
            samples=32,
        )
        for kind in MOUNT_KINDS
    ]
    for other in found[1:]:
        apart = np.abs(other.irradiance - found[0].irradiance).sum()
        assert apart < 0.01 * found[0].irradiance.sum()


def test_mounts_roll_a_long_spot_differently():
    long = mirror_type(facets=facet_grid(1, 1, 6.0, 1.0, 0.0), canting=Canting("flat"))
    one, other = (
        flux_of(BOARD, replace(long, mount=MountDesign(kind)), [(60.0, 60.0, 0.0)])
        for kind in ("azimuth_elevation", "target_aligned")
    )
    apart = np.abs(other.irradiance - one.irradiance).sum()
    assert apart > 0.1 * one.irradiance.sum()


# --- facets
# --------------------------------------------------------------------------------------------------


def _scene(kind: HeliostatType, foot: tuple[float, float, float] = (15.0, 90.0, 0.0)) -> Scene:
    heliostat = kind.heliostat("H", foot, BOARD.center)
    sun = sun_direction(170.0, 40.0)
    angles = heliostat.mount.align(heliostat.position, sun, BOARD.center)
    setup = Setup(heliostat, control_points(heliostat), sun, BOARD)
    return Scene.from_setups([setup], [angles], torch.float64)


TYPES = {
    "focused": mirror_type(focus="slant_range"),
    "round": mirror_type(
        facets=(FacetDesign(np.zeros(3), 3.0, 3.0, circle_outline()),), focus=80.0
    ),
    "polygon": mirror_type(
        facets=(
            FacetDesign(np.zeros(3), 3.0, 2.0, ((-1.0, -1.0), (1.0, -1.0), (0.0, 1.0))),
            FacetDesign(np.array([3.1, 0.0, 0.0]), 3.0, 2.0),
        )
    ),
    "off axis": mirror_type(canting=Canting("off_axis", sun_deg=(170.0, 40.0))),
}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, id=name, marks=[] if name == "polygon" else [pytest.mark.full])
        for name, kind in TYPES.items()
    ],
)
def test_facets_of_any_outline_and_focus_against_monte_carlo(kind: HeliostatType):
    scene, window = _scene(kind), Window.of(BOARD, 36, 40)
    found = trace(scene, window, OPTICS, samples=24)
    expected = trace_montecarlo(scene, window, OPTICS, rays=1_500_000, seed=3).irradiance[0]
    image = found.irradiance[0].numpy()
    assert np.abs(image - expected).sum() < 0.025 * expected.sum()
    assert image.sum() == pytest.approx(expected.sum(), rel=5e-3)


def test_areas_are_those_of_the_outlines():
    disc = mirror_type(facets=(FacetDesign(np.zeros(3), 3.0, 2.0, circle_outline()),))
    assert disc.heliostat("H", (0, 90.0, 0), BOARD.center).area == pytest.approx(np.pi * 1.5)
    heliostat = TYPES["polygon"].heliostat("H", (0, 90.0, 0), BOARD.center)
    assert heliostat.area == pytest.approx(3.0 + 6.0)
    lit = _scene(replace(TYPES["polygon"], canting=Canting("flat")))
    power = trace(lit, Window.of(BOARD), Optics(), samples=16).power
    cosine = float(lit.attitude[0, :, 2] @ lit.sun[0])
    assert float(power[0]) == pytest.approx(930 * 9.0 * cosine, rel=1e-3)


def test_a_focused_facet_is_its_paraboloid():
    heliostat = mirror_type(focus=120.0).heliostat("H", (0, 90.0, 0), BOARD.center)
    points = control_points(heliostat)[0] - control_points(replace_focus(heliostat))[0]
    assert np.allclose(points[..., 2].mean(), 0, atol=1e-12)
    heights = nominal_heights(heliostat)[0]
    # At a corner the spline ends in its control point.
    edge, middle = heights[0, 0], (0.9**2 + 0.8**2) / (4 * 120)
    lowest = heights[3:5, 3:5].max()
    assert edge - lowest == pytest.approx(middle, rel=0.15)


def replace_focus(heliostat: Heliostat) -> Heliostat:
    return replace(
        heliostat, facets=tuple(replace(facet, focal_length=None) for facet in heliostat.facets)
    )


def test_off_axis_canting_has_one_spot_at_its_sun():
    """At the design sun all facets send their middle's light to the aim."""
    spread = {}
    for name in ("off axis", "plain"):
        scene = _scene(TYPES.get(name, mirror_type(canting=Canting("flat"))))
        point_sun = replace(OPTICS, sun_shape=Pillbox(1e-6))
        flux = trace(scene, Window.of(BOARD, 80, 90), point_sun, samples=16).irradiance[0]
        spread[name] = float((flux > 0.05 * flux.max()).sum())
    assert spread["off axis"] < 0.5 * spread["plain"]


# --- shadows, errors
# --------------------------------------------------------------------------------------------------


def test_the_tower_shades_what_is_behind_it():
    tower = Tower(3.0, 70.0)
    sun, feet = (180.0, 40.0), [(0.0, 50.0, 0.0), (30.0, 50.0, 0.0), (0.0, 120.0, 0.0)]
    found = flux_of(BOARD, feet=feet, sun=sun, tower=tower)
    # The shadow is 83 m long and 6 m wide.
    assert found.losses["H0"].shading < 0.05
    assert found.losses["H1"].shading == pytest.approx(1)
    assert found.losses["H2"].shading == pytest.approx(1)


def test_pointing_errors_spread_light_as_slope_errors_of_half_their_size_do():
    """Near normal incidence, where a mirror doubles the angle of its normal along both axes."""
    feet = [(0.0, 200.0, 0.0)]
    sun = (0.0, float(np.degrees(np.arctan2(57.0, -200.0))) % 180)
    images = [
        flux_of(BOARD, mirror_type(optics=optics), feet, (180.0, 180 - sun[1])).irradiance
        for optics in (MirrorOptics(1.0, 1.5e-3, 0.0), MirrorOptics(1.0, 0.0, 3e-3))
    ]
    assert np.abs(images[0] - images[1]).sum() < 0.01 * images[0].sum()


def test_the_share_of_the_window_is_that_of_the_image():
    """`superpose` takes each mirror's share from its spectrum, not from its image."""
    found = flux_of(BOARD, feet=FEET[:4], optics=replace(OPTICS, sun_shape=Buie(0.1)))
    alone = [
        flux_of(BOARD, feet=[foot], optics=replace(OPTICS, sun_shape=Buie(0.1)))
        for foot in FEET[:4]
    ]
    area = BOARD.width * BOARD.height / (48 * 96)
    for flux in alone:
        one = flux.losses["H0"]
        assert flux.irradiance.sum() * area == pytest.approx(
            one.area * OPTICS.dni * one.intercepted, rel=1e-3
        )
    assert len(found.losses) == 4


def test_a_panel_behind_another_gets_no_light():
    """All light that falls on both falls on the one in front, from where most mirrors stand."""
    front, back = _panel(0.0, 0.0, (0.0, 1.0)), _panel(0.0, -0.5, (0.0, 1.0))
    alone, both = (flux_of(Panels("one", some)) for some in ((front,), (front, back)))
    areas = [field_losses(found.losses.values()).intercepted for found in (alone, both)]
    assert areas[0] <= areas[1] < 1.05 * areas[0]
    hidden = both.irradiance[:, 48:]
    assert hidden[:, 10:38].max() < 1e-3 * both.irradiance.max()


def test_mistakes_in_types_and_receivers_are_named():
    with pytest.raises(InvalidInputError, match="mount kind 'hexapod' is none of"):
        MountDesign("hexapod")
    with pytest.raises(InvalidInputError, match="has no facets"):
        HeliostatType("empty", ())
    with pytest.raises(InvalidInputError, match="needs each facet's normal"):
        mirror_type(canting=Canting("individual"))
    with pytest.raises(InvalidInputError, match="one height"):
        Panels("two", (BOARD, replace(BOARD, height=3.0)))
    with pytest.raises(InvalidInputError, match="plane polygon"):
        replace(CAVITY, aperture=np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0.0]]))
    with pytest.raises(InvalidInputError, match="columns for 2 panels"):
        PANELS.grid(4, 1)
