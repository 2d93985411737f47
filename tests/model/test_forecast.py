"""Forecasts of setups: alignment under effects, batches of unlike setups, reuse."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.effects.axis_tilt import AxisTilt
from model.effects.background import Background
from model.effects.base import Effect
from model.effects.blocking import Blocking
from model.effects.camera_blur import CameraBlur
from model.effects.camera_ghost import CameraGhost
from model.effects.camera_response import CameraResponse
from model.effects.camera_shoulder import CameraShoulder
from model.effects.facet_canting import FacetCanting
from model.effects.gravity_bending import GravityBending
from model.effects.slope_error import SlopeError
from model.effects.sun_position import SunPosition
from model.errors import UnreachableError
from model.forecast import View, align
from model.frames import sun_direction
from model.imaging import center_of_mass, flux_window
from model.metrics import flux_accuracy
from model.plant_model import JUELICH_MODEL
from model.surface import control_points
from model.tracing.convolution import central_rays
from tests.conftest import target
from tests.model.scenes import setups

GEOMETRY = [
    SunPosition(20.0),
    AxisTilt(1.0, -2.0),
    FacetCanting(x_mrad={"flat": [1.0, 2.0, -1.0, 1.0]}),
    GravityBending(5.0),
    Blocking({"flat": 0.3}),
]


@pytest.mark.parametrize("effects", [[], GEOMETRY], ids=["none", "geometry"])
def test_spots_lie_where_they_were_measured_whatever_the_effects(effects):
    given = setups()
    group = align(given, JUELICH_MODEL.with_effects(effects), dtype=torch.float64).groups[0]
    spots = central_rays(group.scene, 12).spot.numpy()
    np.testing.assert_allclose(spots, [s.plane.to_plane(s.spot) for s in given], atol=2e-5)


def test_different_setups_keep_their_order():
    """Of other targets, other splines, with and without a spot: each as if it were alone."""
    a, b, c = setups()
    wide = replace(a, plane=target(10.0, center=(0.0, 0.0, 38.0)), spot=np.array([0.2, 0.0, 38.0]))
    aimed = replace(b, spot=None, aim=b.plane.center + [0.3, 0, 0.2])
    still = replace(
        c, spot=None, angles=c.heliostat.mount.align(c.heliostat.position, c.sun, c.plane.center)
    )
    coarse = replace(c, control_points=control_points(c.heliostat, np.zeros((4, 5, 6))))
    mixed = [a, wide, b, aimed, coarse, still, c]
    view, effects = (
        View(40, 32, samples=8),
        [*GEOMETRY, SlopeError(1.0), Background(0.1, 0.05, 0.0)],
    )
    together = align(mixed, JUELICH_MODEL.with_effects(effects))
    assert len(together.groups) == 3
    images = together.images(view)
    assert images.shape == (7, 40, 32)
    for image, angles, setup in zip(images, together.angles, mixed, strict=True):
        alone = align([setup], JUELICH_MODEL.with_effects(effects))
        np.testing.assert_allclose(angles, alone.angles[0], atol=1e-6)
        expected = alone.images(view)[0]
        np.testing.assert_allclose(image, expected, atol=2e-3 * float(expected.max()))


def test_many_images_are_traced_in_parts(monkeypatch):
    """All at once, 1,600 photographs of a study would take gigabytes."""
    view, sizes = View(32, 32, samples=8), []
    aligned = align(setups(5), JUELICH_MODEL, dtype=torch.float64)
    at_once = aligned.flux(view)
    monkeypatch.setattr("model.forecast._TRACED_PIXELS", 2 * 32 * 32)

    def trace_and_count(scene, window, optics):
        sizes.append(scene.batch)
        return view.trace(scene, window, optics)

    np.testing.assert_allclose(aligned.flux(view, trace_and_count), at_once, rtol=1e-6, atol=1e-3)
    assert sizes == [2, 2, 1]


def test_an_alignment_serves_other_optics_and_cameras():
    given, view = setups(), View(32, 32, samples=8)
    model = JUELICH_MODEL.with_effects([*GEOMETRY, SlopeError(1.0)])
    aligned = align(given, model)
    flux = aligned.flux(view)
    for camera in ([CameraBlur(0.2)], [CameraResponse(1.5), Background(0.1)]):
        whole = align(given, model.with_effects(camera)).images(view)
        seen = replace(aligned, model=model.with_effects(camera)).camera_images(flux, view)
        np.testing.assert_allclose(seen, whole, rtol=1e-5, atol=1e-2)


CAMERAS = [
    [],
    [CameraGhost(0.1, 0.8, -0.5)],
    [Background(0.01, 0.004, -0.003)],
    [CameraShoulder(1.5), CameraBlur(0.1)],
]


@pytest.mark.parametrize("camera", CAMERAS, ids=["none", "ghost", "background", "shoulder"])
def test_a_flux_image_is_what_is_measured_of_the_whole_targets_image(camera):
    """One rule for centring: a ghost or a background moves the centre of mass of measurement and
    forecast alike.
    """
    given = setups()
    wide = [
        replace(
            given[0], plane=target(10.0, center=(0.0, 0.0, 38.0)), spot=np.array([0.2, 0.0, 38.0])
        ),
        *given[1:],
    ]
    aligned = align(wide, JUELICH_MODEL.with_effects(camera))
    images = aligned.images(View(256, 256, samples=24)).clamp(min=0).numpy()
    for side, pixels in ((4.0, 64), (6.0, 96)):
        rendered = aligned.flux_images(side=side, size=pixels, samples=24)
        for seen, image, setup in zip(rendered, images, wide, strict=True):
            size = setup.plane.width, setup.plane.height
            measured = flux_window(image, size, center_of_mass(image, size), side, pixels)
            assert flux_accuracy(measured, seen.numpy()) > 0.99


@pytest.mark.parametrize("edge", [0.6, 0.2, -0.1])
def test_a_spot_that_its_target_cuts_is_aligned_by_the_part_that_is_seen(edge):
    """The target ends ``edge`` [m] right of the spot's centre: mirror and forecast are as of a
    target that does not.
    """
    whole = [replace(one, spot=one.plane.center, plane=target(12.0)) for one in setups()]
    sent = align(whole, JUELICH_MODEL)
    ends = replace(
        whole[0].plane, center=whole[0].plane.to_enu((edge - 3.0, 0.0)), width=6.0, height=6.0
    )
    there = [
        replace(s, plane=ends, spot=None, angles=a) for s, a in zip(whole, sent.angles, strict=True)
    ]
    shown = align(there, JUELICH_MODEL).flux(View(256, 256)).clamp(min=0).numpy()
    spots = [ends.to_enu(center_of_mass(image, (6.0, 6.0))) for image in shown]
    seen = [replace(s, plane=ends, spot=spot) for s, spot in zip(whole, spots, strict=True)]
    aligned = align(seen, JUELICH_MODEL)
    np.testing.assert_allclose(aligned.aims, sent.aims, atol=0.03)
    for image, expected in zip(aligned.flux_images().numpy(), shown, strict=True):
        assert (
            flux_accuracy(
                flux_window(expected, (6.0, 6.0), center_of_mass(expected, (6.0, 6.0))), image
            )
            > 0.98
        )


def test_a_spot_beside_its_target_brings_all_light_there():
    (beside,) = setups(1)
    beside = replace(beside, spot=beside.plane.to_enu((beside.plane.width, 0.0)))
    (group,) = align([beside], JUELICH_MODEL).groups
    np.testing.assert_allclose(
        central_rays(group.scene, 12).spot[0], [beside.plane.width, 0.0], atol=1e-3
    )


def test_the_order_of_the_list_is_of_no_account():
    given, view = setups(1), View(32, 32, samples=8)
    effects = [CameraResponse(1.5), Background(0.1), SlopeError(1.0), GravityBending(3.0)]
    a, b = (
        align(given, JUELICH_MODEL.with_effects(e)).images(view) for e in (effects, effects[::-1])
    )
    np.testing.assert_array_equal(a, b)


def test_a_start_nearby_ends_at_the_same_alignment():
    given = setups()
    before = align(given, JUELICH_MODEL.with_effects([GravityBending(3.0)]))
    warm, cold = (
        align(given, JUELICH_MODEL.with_effects([GravityBending(3.5)]), start=start)
        for start in (before, None)
    )
    np.testing.assert_allclose(warm.angles, cold.angles, atol=1e-6)


def test_windows_about_the_spot_or_of_the_whole_target():
    given = setups()
    about = align(given, JUELICH_MODEL).flux(View(64, 64, window=4.0)).clamp(min=0).numpy()
    columns = np.arange(64) * 4 / 64 - 2 + 2 / 64
    centers = (about.sum(axis=1) * columns).sum(axis=1) / about.sum(axis=(1, 2))
    np.testing.assert_allclose(centers, 0, atol=0.02)
    whole = align(given, JUELICH_MODEL).flux(View(64, 64)).clamp(min=0).numpy()
    columns = np.arange(64) * 8 / 64 - 4 + 4 / 64
    centers = (whole.sum(axis=1) * columns).sum(axis=1) / whole.sum(axis=(1, 2))
    np.testing.assert_allclose(centers, [s.plane.to_plane(s.spot)[0] for s in given], atol=0.05)


def test_an_effect_of_no_catalogue_is_applied():
    """A new effect is a new class; nothing else changes."""

    class Vignette(Effect):
        name, stage = "vignette", "image"

        def on_image(self, images, window):
            return 0.5 * images

    given, view = setups(1), View(16, 16, samples=4)
    plain, dimmed = (
        align(given, JUELICH_MODEL.with_effects(effects)).images(view)
        for effects in ((), [Vignette()])
    )
    np.testing.assert_allclose(dimmed, 0.5 * plain)


def test_a_clock_that_puts_the_sun_behind_the_mirror_is_refused():
    low = replace(setups(1)[0], sun=sun_direction(100.0, 3.0))
    with pytest.raises(UnreachableError):
        align([replace(low, plane=replace(low.plane, normal=-low.plane.normal))], JUELICH_MODEL)
