import dataclasses
import json

import cv2
import numpy as np
import pytest

from heliotwin.demo.camera import CameraOptions, photograph, target_corners
from model.errors import InvalidInputError
from model.imaging import Camera, MeasuredFlux, center_of_mass, measure
from model.imaging.rectify import rectify
from tests.imaging import accuracy, gaussian

SIZE = (5.4, 6.4)


def taken(flux, plane, **options):
    return photograph(flux, plane, np.random.default_rng(5), CameraOptions(**options))


def check_measured(result: MeasuredFlux):
    assert result.quality.accepted
    assert result.quality.reason is None
    for image, shape in ((result.flux, (256, 256)), (result.centered, (64, 64))):
        assert image.shape == shape
        assert image.dtype == np.float32
        assert image.min() >= 0
        assert image.sum(dtype=float) == pytest.approx(100, abs=1e-3)
    assert result.crop.shape == (256, 256)


@pytest.mark.parametrize(
    ("options", "least"),
    [
        ({}, 0.96),
        ({"gradient": (0.4, -0.4)}, 0.95),
        ({"perspective": 0.2}, 0.95),
        ({"noise": 6.0}, 0.95),
        ({"foreign_spot": (-1.9, 2.1, 0.35, 0.8)}, 0.95),
        ({"foreign_spot": (2.0, 2.4, 0.3, 1.0)}, 0.95),
    ],
    ids=["plain", "uneven light", "slanted", "noisy", "foreign spot", "brighter foreign spot"],
)
def test_a_photograph_gives_back_the_flux(plane, spot, options, least):
    result = measure(taken(spot, plane, **options), "raw", plane)
    check_measured(result)
    assert np.linalg.norm(result.center_of_mass - center_of_mass(spot, SIZE)) < 0.02
    assert accuracy(result.flux, spot) > least
    assert (result.quality.second_spot_share > 0.05) == ("foreign_spot" in options)


def test_the_window_is_centred_on_the_spot(plane, spot):
    result = measure(taken(spot, plane), "raw", plane)
    assert np.abs(center_of_mass(result.centered, (4.0, 4.0))).max() < 0.06
    assert result.quality.energy_outside_window < 0.03


def test_configured_corners_replace_the_marks(plane, spot):
    options = CameraOptions()
    frame = taken(spot, plane, gradient=(0.0, 0.0))
    corners = target_corners(plane, options)
    for corner in corners:
        cv2.circle(frame, tuple(np.round(corner).astype(int).tolist()), 110, (137, 137, 137), -1)
    assert measure(frame, "raw", plane).quality.reason == "target_not_found"
    result = measure(frame, "raw", plane, corners=corners)
    check_measured(result)
    assert np.linalg.norm(result.center_of_mass - center_of_mass(spot, SIZE)) < 0.03


@pytest.mark.parametrize(
    ("reason", "flux", "options"),
    [
        ("saturated", (0.0, 0.0, 0.6, 0.6), {"peak": 3.0}),
        ("cut", (2.6, 0.0, 0.6, 0.6), {}),
        ("cut", (0.0, 3.0, 0.6, 0.9), {}),
        ("no_spot", (0.0, 0.0, 0.6, 0.6), {"peak": 0.0}),
        ("no_spot", (0.0, 0.0, 0.6, 0.6), {"peak": 0.02}),
        ("low_signal", (0.0, 0.0, 0.6, 0.6), {"peak": 0.06}),
        ("second_spot", (0.9, -1.0, 0.45, 0.45), {"foreign_spot": (-1.2, 1.5, 0.45, 0.9)}),
    ],
)
def test_a_bad_photograph_is_refused_with_its_reason_and_kept(plane, reason, flux, options):
    result = measure(taken(gaussian(plane, *flux), plane, **options), "raw", plane)
    assert result.quality.reason == reason
    assert not result.quality.accepted
    assert result.quality.detail.count(".") == 0
    assert ";" in result.quality.detail  # a finding and its remedy
    assert result.flux is result.centered is result.center_of_mass is None
    assert result.crop.shape == (256, 256)


def test_a_quality_record_is_json(plane, spot):
    for frame in (taken(spot, plane), np.zeros((200, 200, 3), np.uint8)):
        record = dataclasses.asdict(measure(frame, "raw", plane).quality)
        assert json.loads(json.dumps(record, allow_nan=False)) == record


def test_a_crop_is_measured_like_its_frame(plane, spot):
    frame = taken(spot, plane)
    crop = rectify(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), target_corners(plane))
    result = measure(crop, "cropped", plane)
    check_measured(result)
    assert accuracy(result.flux, measure(frame, "raw", plane).flux) > 0.98


def test_separated_flux_is_only_normalised(plane, spot):
    image = np.round(255 * spot).astype(np.uint8)
    result = measure(image, "flux", plane)
    assert np.allclose(result.flux, 100.0 * image / image.sum(), atol=1e-6)
    assert result.crop is None
    assert np.allclose(result.center_of_mass, center_of_mass(image, SIZE))
    assert result.centered.sum() == pytest.approx(100, abs=1e-3)


def test_a_centred_flux_has_no_place_on_the_target(plane):
    wide = dataclasses.replace(plane, width=6.1, height=6.1)
    image = np.round(255 * gaussian(wide, 0, 0, 0.8, 0.5, 0.3, size=64)).astype(np.uint8)
    result = measure(image, "flux-centered", plane, side=6.1)
    assert result.flux is None
    assert result.center_of_mass is None
    expected = gaussian(
        dataclasses.replace(plane, width=4.0, height=4.0), 0, 0, 0.8, 0.5, 0.3, size=64
    )
    assert accuracy(result.centered, expected) > 0.98


@pytest.mark.parametrize("kind", ["raw", "cropped", "flux", "flux-centered"])
def test_black_images_are_refused_and_not_raised(plane, kind):
    quality = measure(np.zeros((256, 256), np.uint8), kind, plane, side=6.1).quality
    assert quality.reason == ("target_not_found" if kind == "raw" else "no_spot")


@pytest.mark.parametrize(
    ("image", "kind"),
    [
        (np.zeros((256, 256), np.float32), "cropped"),
        (np.zeros((256, 256, 4), np.uint8), "cropped"),
        (np.zeros((5, 256), np.uint8), "cropped"),
        (np.zeros((256, 256), np.uint8), "sketch"),
        (np.zeros((256, 256), np.uint8), "flux-centered"),  # without its side
    ],
)
def test_malformed_arguments_raise(plane, image, kind):
    with pytest.raises(InvalidInputError):
        measure(image, kind, plane)


def test_a_photograph_whose_counts_do_not_fill_their_bits_is_one_clear_error(plane, spot):
    """The counts of a 12-bit camera were stored unscaled, so the end of its range is not known."""
    crop = np.round(4095 * (0.25 + 0.7 * spot)).astype(np.uint16)
    with pytest.raises(InvalidInputError, match="holds 12 bits; scale its counts to 16 bits"):
        measure(crop, "cropped", plane)
    assert measure(16 * crop, "cropped", plane).quality.accepted
    assert measure(np.round(4095 * spot).astype(np.uint16), "flux", plane).quality.accepted


def clipped_crop(plane, bits: int, largest: int | None = None, colour: bool = False):
    """A crop of a linear camera of some bits whose range cuts the spot off, unscaled."""
    light = 0.26 + 1.2 * gaussian(plane, 0.0, 0.0, 0.6, 0.5)
    counts = np.round((2**bits - 1) * light).clip(max=largest or 2**bits - 1).astype(np.uint16)
    return np.repeat(counts[..., None], 3, axis=2) if colour else counts


@pytest.mark.parametrize(
    ("bits", "largest"),
    [(10, None), (12, None), (14, None), (15, None), (14, 15871)],
    ids=lambda value: str(value),
)
@pytest.mark.parametrize("colour", [False, True])
def test_light_that_a_camera_of_fewer_bits_cut_off_is_never_taken_for_whole(
    plane, bits, largest, colour
):
    """Unscaled counts end below the file's 65535; 15871 is where a black level that was taken off
    leaves 14 bits.
    """
    crop = clipped_crop(plane, bits, largest, colour)
    with pytest.raises(
        InvalidInputError,
        match=rf"pile up at the count {crop.max()}.*or declare the camera's 'bits'",
    ):
        measure(crop, "cropped", plane)
    whole = measure(clipped_crop(plane, 16, colour=colour), "cropped", plane)
    from_bits = measure(crop, "cropped", plane, camera=Camera(bits=bits))
    assert whole.quality.saturated_share > 0.3
    assert from_bits.quality.saturated_share == pytest.approx(
        whole.quality.saturated_share, abs=0.03
    )
    assert accuracy(from_bits.flux, whole.flux) > 0.98
    assert from_bits.clipped.mean() == pytest.approx(whole.clipped.mean(), rel=0.1)


def test_a_stamp_of_full_range_does_not_hide_where_the_camera_was_cut_off(plane):
    crop = clipped_crop(plane, 14)
    crop[:12, :40] = 65535
    with pytest.raises(InvalidInputError, match="pile up at the count 16383"):
        measure(crop, "cropped", plane)


def test_bits_that_a_photograph_contradicts_are_one_clear_error(plane, spot):
    light = 0.25 + 0.7 * spot
    with pytest.raises(InvalidInputError, match="beyond the 12 bits of its camera"):
        measure(np.round(16383 * light).astype(np.uint16), "cropped", plane, camera=Camera(bits=12))
    with pytest.raises(InvalidInputError, match="pile up at the count 4095"):
        measure(clipped_crop(plane, 12), "cropped", plane, camera=Camera(bits=14))


def test_photographs_that_are_not_cut_off_are_not_taken_for_such(plane, spot):
    """Of 14 bits unscaled, of 8 and 12 bits scaled to 16, with noise and without: none has a pile
    at its top.
    """
    rng = np.random.default_rng(2)
    light = 0.25 + 0.6 * spot
    for largest, scale in ((16383, 1), (65535, 1), (255, 257), (255, 256), (4095, 16)):
        for noise in (0.0, 0.004):
            counts = np.round(largest * (light + noise * rng.standard_normal(light.shape)))
            assert (
                accuracy(measure((scale * counts).astype(np.uint16), "cropped", plane).flux, spot)
                > 0.95
            )
