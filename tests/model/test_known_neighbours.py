"""Neighbours that the layout gives, in simulated photographs of a dense field under low suns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.effects import Effect
from model.effects.axis_tilt import AxisTilt
from model.effects.known_neighbours import KnownNeighbours
from model.fleet import aligned_field
from model.forecast import View, align
from model.frames import sun_direction
from model.heliostat_type import Canting
from model.mount import Mount
from model.setup import Setup
from model.study import FluxImage, StudyOptions, study
from model.surface import control_points
from model.tracing.montecarlo import trace_montecarlo
from tests.model.test_effects_of_other_plants import MODEL, TARGET, large

PHOTOGRAPHED = {"M1": (-30.0, -120.0, 0.0), "M2": (25.0, -150.0, 0.0)}
SPACING = 13.5, 10.0
SUNS = [(70.0, 12.0), (-65.0, 15.0), (40.0, 20.0), (-30.0, 14.0), (10.0, 35.0), (85.0, 22.0)]
RECEIVER = np.array([0.0, 0.0, 80.0])
KIND = replace(large("second", 0.9), canting=Canting("flat"))


def setups() -> list[Setup]:
    """28 flat facets on azimuth-elevation mounts, eight neighbours around each mirror."""
    rng, made = np.random.default_rng(3), []
    steps = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]
    for name, place in PHOTOGRAPHED.items():
        one = KIND.heliostat(name, place, TARGET.center)
        points = control_points(one, rng.normal(0, 1e-4, (28, 8, 8)))
        others = [
            KIND.heliostat(
                f"{name}-{n}", np.add(place, [x * SPACING[0], y * SPACING[1], 0]), RECEIVER
            )
            for n, (x, y) in enumerate(steps)
        ]
        for number, angles in enumerate(SUNS):
            sun = sun_direction(*angles)
            aimed = [(one, TARGET.center), *((other, RECEIVER) for other in others)]
            field = aligned_field(aimed, sun, MODEL)
            made.append(
                Setup(
                    one,
                    points,
                    sun,
                    TARGET,
                    TARGET.to_enu(rng.uniform(-0.5, 0.5, 2)),
                    identifier=f"{name}/{number}",
                    neighbours=field.obstacles([name])[0],
                )
            )
    return made


def photographs(*effects: Effect) -> list[FluxImage]:
    some, rng = setups(), np.random.default_rng(1)
    images = align(some, MODEL.with_effects(effects)).images(View(96, 96, samples=6)).numpy()
    noise = 0.0005 * images.max(axis=(1, 2), keepdims=True) * rng.standard_normal(images.shape)
    return [FluxImage(setup, image) for setup, image in zip(some, images + noise, strict=True)]


OPTIONS = StudyOptions(
    candidates=("known_neighbours", "blocking", "slope_error"),
    most=1,
    fit_view=View(24, 24, samples=4, padding=0.125),
    view=View(48, 48, samples=6),
)


@pytest.mark.full
def test_known_neighbours_are_found_before_their_rivals():
    found = study(photographs(KnownNeighbours(1.0)), MODEL, OPTIONS)
    assert [one.name for one in found.found] == ["known_neighbours"]
    assert found.effects[0].share == pytest.approx(1.0, abs=0.1)


@pytest.mark.full
def test_no_false_alarm_if_neighbours_were_stowed():
    assert study(photographs(), MODEL, OPTIONS).found == []


@pytest.mark.full
def test_without_a_layout_they_are_no_candidate():
    alone = [replace(p, setup=replace(p.setup, neighbours=None)) for p in photographs()]
    found = study(alone, MODEL, replace(OPTIONS, candidates=("known_neighbours", "slope_error")))
    assert [candidate.name for candidate in found.candidates] == ["slope_error"]


def test_both_tracers_take_the_same_share():
    view = View(24, 24, samples=16)
    aligned = align(setups()[:2], MODEL.with_effects([KnownNeighbours(0.6)]), dtype=torch.float64)
    plain = align(setups()[:2], MODEL, dtype=torch.float64).flux(view).sum(dim=(1, 2))

    def montecarlo(scene, window, optics):
        return torch.as_tensor(trace_montecarlo(scene, window, optics, rays=100_000)[0])

    smooth, thrown = (aligned.flux(view, tracer).sum(dim=(1, 2)) for tracer in (None, montecarlo))
    assert float((smooth / plain).min()) < 0.97
    np.testing.assert_allclose(thrown / plain, smooth / plain, atol=0.01)


# --- the tilt about east
# --------------------------------------------------------------------------------------------------


def test_studies_fit_the_tilts_that_a_mount_shows():
    juelich, turning = Mount.juelich(), Mount.azimuth_elevation()
    assert AxisTilt.unseen([juelich, juelich.tilted(np.eye(3))]) == {"east_deg"}
    assert AxisTilt.unseen([turning]) == {"up_deg"}
    assert AxisTilt.unseen([turning, juelich]) == frozenset()
