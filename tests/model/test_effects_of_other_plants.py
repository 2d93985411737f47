"""Effects on a plant that is not Juelich's: azimuth-elevation mounts, 28 facets, south of the
equator, each effect in simulated photographs found before its rivals.
"""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import torch

from model.effects import CATALOGUE, Effect, effect_from_json
from model.effects.axis_tilt import AxisTilt
from model.effects.gravity_bending import GravityBending
from model.effects.tracking_jitter import TrackingJitter
from model.forecast import View, align
from model.frames import sun_direction
from model.heliostat_type import Canting, HeliostatType, MountDesign, facet_grid
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.site import Site
from model.study import FluxImage, Study, StudyOptions, study
from model.sunshape import Gaussian
from model.surface import control_points
from model.tracing import Optics, Window, trace
from model.tracing.convolution import central_rays
from model.tracing.montecarlo import trace_montecarlo
from model.tracing.scene import Scene

SITE = Site(-23.0, -68.0, 2400.0)
TARGET = TargetPlane(
    "panel",
    np.array([0.0, -6.0, 60.0]),
    np.array([0.0, -1.0, 0]),
    np.array([0.0, 0, 1]),
    24.0,
    20.0,
)
MODEL = PlantModel(SITE, Optics())
PLACES = {"B01": (-60.0, -120.0, 0.0), "B02": (20.0, -180.0, 0.0), "B03": (110.0, -240.0, 0.0)}
FIRST = datetime(2024, 3, 1, 15, tzinfo=UTC)


def large(jitter_axis="first", reference_sine=0.5, canting="on_axis") -> HeliostatType:
    """28 facets of 1.8 x 1.35 m."""
    mount = MountDesign(pivot_height=6.0, mirror_offset=0.2, jitter_axis=jitter_axis)
    facets = facet_grid(4, 7, 1.8, 1.35, 0.02)
    return HeliostatType(
        "large", facets, mount, canting=Canting(canting), reference_sine=reference_sine
    )


def setups(kind: HeliostatType, count: int = 6) -> list[Setup]:
    """Setups of three heliostats south of the tower, the sun in the north."""
    rng, made = np.random.default_rng(8), []
    for name, place in PLACES.items():
        heliostat = kind.heliostat(name, place, TARGET.center)
        points = control_points(heliostat, rng.normal(0, 1e-4, (28, 8, 8)))
        for number in range(count):
            azimuth, elevation = rng.uniform(-65, 65), rng.uniform(25, 80)
            sun, taken_at = sun_direction(azimuth, elevation), FIRST + timedelta(hours=25 * number)
            spot = TARGET.to_enu(rng.uniform(-0.5, 0.5, 2))
            made.append(
                Setup(
                    heliostat,
                    points,
                    sun,
                    TARGET,
                    spot,
                    identifier=f"{name}/{number}",
                    taken_at=taken_at,
                )
            )
    return made


def photographs(effects: Sequence[Effect], kind: HeliostatType) -> list[FluxImage]:
    """What a camera shows of them, with some noise."""
    made, rng = setups(kind), np.random.default_rng(1)
    images = align(made, MODEL.with_effects(effects)).images(View(128, 128, samples=6)).numpy()
    noise = 0.0005 * images.max(axis=(1, 2), keepdims=True) * rng.standard_normal(images.shape)
    return [FluxImage(setup, image) for setup, image in zip(made, images + noise, strict=True)]


def by_heliostat(*values) -> dict[str, object]:
    return dict(zip(PLACES, values, strict=True))


def facets(seed: int, low: float, high: float) -> list[float]:
    return np.random.default_rng(seed).uniform(low, high, 28).round(3).tolist()


PARAMETERS = {
    "sun_position": {"minutes": 40.0},
    "axis_tilt": {"north_deg": 2.5, "up_deg": 0.0},
    "facet_canting": {"x_mrad": {n: facets(i, -2, 2) for i, n in enumerate(PLACES)}},
    "gravity_bending": {"amplitude_mm": 7.0},
    "soiling": {"reflectivity_ratio": {n: facets(i, 0, 1) for i, n in enumerate(PLACES)}},
    "blocking": {"lower_fraction": by_heliostat(0.4, 0.35, 0.5)},
    "sun_shape": {"circumsolar_ratio": 0.25},
    "slope_error": {"sigma_mrad": 1.5},
    "tracking_jitter": {"sigma_mrad": 2.0},
    "background": {"level": 0.05},
    "camera_blur": {"sigma_m": 0.4},
    "camera_ghost": {"share": 0.2, "right_m": 1.5, "up_m": 0.5},
    "camera_response": {"gamma": 0.7},
    "camera_shoulder": {"compression": 1.5},
    "target_registration": {"scale_x": 1.1},
}
"""A strong effect of each kind that changes shapes."""

SHAPED = [
    name
    for name, kind in CATALOGUE.items()
    if not (kind.only_moves or kind.needs_neighbours)  # see test_known_neighbours.py
]


def made(name: str) -> Effect:
    return effect_from_json({"name": name, "parameters": PARAMETERS[name]})


def test_every_effect_that_changes_shapes_is_tried():
    assert set(PARAMETERS) == set(SHAPED)


@pytest.mark.parametrize("name", SHAPED)
def test_each_effect_changes_the_images_of_any_type(name):
    some, view = setups(large(), 1), View(48, 48, samples=6)
    plain, changed = (
        align(some, MODEL.with_effects(effects)).images(view).numpy()
        for effects in ([], [made(name)])
    )
    moved = np.abs(
        plain / plain.sum(axis=(1, 2), keepdims=True)
        - changed / changed.sum(axis=(1, 2), keepdims=True)
    ).sum(axis=(1, 2))
    assert np.isfinite(changed).all()
    assert moved.max() > 0.004


def study_of(effect: Effect, candidates: tuple[str, ...] | None = None) -> Study:
    options = StudyOptions(
        candidates=candidates or tuple(RIVALS),
        most=1,
        fit_view=View(24, 24, samples=4, padding=0.125),
        view=View(48, 48, samples=6),
    )
    # On a canted mirror all facets' images are alike, and round: part of them says nothing.
    canting = "flat" if effect.name in ("axis_tilt", "blocking") else "on_axis"
    kind = large("second", 0.9, canting)
    return study(photographs([effect], kind), MODEL, options)


RIVALS = {
    "sun_position": "minutes",
    "axis_tilt": "north_deg",
    "gravity_bending": "amplitude_mm",
    "blocking": "lower_fraction",
    "sun_shape": "circumsolar_ratio",
    "slope_error": "sigma_mrad",
    "tracking_jitter": "sigma_mrad",
    "camera_blur": "sigma_m",
    "camera_response": "gamma",
    "target_registration": "scale_x",
}
"""Candidates of the studies, each with the parameter that is compared."""


@pytest.mark.full
@pytest.mark.parametrize("name", RIVALS)
def test_an_effect_is_found_before_its_rivals(name):
    found = study_of(made(name))
    assert [one.name for one in found.found] == [name]
    value, truth = getattr(found.effects[0], RIVALS[name]), PARAMETERS[name][RIVALS[name]]
    if isinstance(truth, dict):
        value, truth = [float(value[name]) for name in truth], list(truth.values())
    assert value == pytest.approx(truth, rel=0.15)


@pytest.mark.full
def test_a_tilt_about_east_is_found():
    """A vertical axis may lean to either side."""
    found = study_of(AxisTilt(east_deg=2.8), ("axis_tilt", "target_registration"))
    assert [one.name for one in found.found] == ["axis_tilt"]
    assert found.effects[0].east_deg == pytest.approx(2.8, rel=0.15)
    assert abs(found.effects[0].north_deg) < 0.4


# --- properties of a type
# --------------------------------------------------------------------------------------------------


def test_gravity_counts_from_the_attitude_at_which_the_type_was_canted():
    """At that attitude the mirror has its known shape, at any other it sags."""
    (plain,) = setups(large(), 1)[:1]
    sine = float(align([plain], MODEL).groups[0].scene.attitude[0, 2, 2])
    points = []
    for reference in (sine, 0.5):
        heliostat = replace(plain.heliostat, reference_sine=reference)
        aligned = align(
            [replace(plain, heliostat=heliostat)],
            MODEL.with_effects([GravityBending(8.0)]),
            dtype=torch.float64,
        )
        points.append(aligned.groups[0].scene.control_points[0, :, 2].numpy())
    known = align([plain], MODEL, dtype=torch.float64).groups[0].scene.control_points[0, :, 2]
    np.testing.assert_allclose(points[0], known.numpy(), atol=1e-6)
    # x and y of the mirror's corner are its edges
    assert np.abs(points[1] - points[0]).max() == pytest.approx(
        8e-3 * abs(sine - 0.5) * 1.4, rel=0.02
    )


@pytest.mark.parametrize("axis", ["first", "second"])
def test_jitter_is_about_the_axis_that_the_type_declares(axis):
    """It moves the spot as a turn about that axis does, and both tracers show it alike."""
    (one,) = setups(large(axis), 1)[:1]
    angles, step = align([one], MODEL).angles[0], 1e-5
    turn = np.eye(2)[0 if axis == "first" else 1] * step
    scenes = [Scene.from_setups([one], [angles + s * turn], torch.float64) for s in (-1, 0, 1)]
    before, still, after = (central_rays(scene, 4) for scene in scenes)
    moved = ((after.spot - before.spot) / (2 * step))[0].numpy()
    np.testing.assert_allclose(
        still.spot_per_angle[0], moved, atol=0.01 * float(np.linalg.norm(moved))
    )
    window, rays = Window(30.0, 30.0, 48, 48), 200_000
    jitter = TrackingJitter(3.0).on_optics(Optics(sun_shape=Gaussian(3e-3)))
    smooth = trace(scenes[1], window, jitter, samples=8).irradiance[0].clamp(min=0).numpy()
    thrown = trace_montecarlo(scenes[1], window, jitter, rays=rays)[0][0]
    noise = np.sqrt(4 / np.pi) * np.sqrt(smooth / smooth.sum() / rays).sum()
    assert np.abs(thrown - smooth).sum() / smooth.sum() < 1.3 * noise


def test_a_mirror_of_the_default_type_is_juelichs():
    heliostat = Heliostat.juelich("one", (0.0, 80.0, 1.8), 90.0)
    assert heliostat.reference_sine == 0.5
    assert heliostat.mount.jitter_axis == "first"
