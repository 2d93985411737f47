from datetime import UTC, datetime

import numpy as np
import pytest

from heliotwin.demo.camera import CameraOptions, photograph
from model.errors import InvalidInputError
from model.images import clipped_alike
from model.imaging import Camera, center_of_mass, measure
from model.imaging.light import LINEAR, Measured, Power, Srgb, camera_at, cameras_from_json
from model.imaging.quality import SATURATED_GRAY, ceiling
from model.metrics import flux_accuracy
from tests.imaging import accuracy, gaussian

CURVES = [Srgb(), LINEAR, Power(2.2), Measured((0.0, 0.4, 1.0), (0.0, 0.2, 1.0))]
SIZE = (5.4, 6.4)


@pytest.mark.parametrize("curve", CURVES, ids=repr)
def test_a_transfer_function_rises_from_black_to_white_and_back(curve):
    shares = np.linspace(0, 1, 257)
    light = curve.light(shares)
    assert (np.diff(light) > 0).all()
    np.testing.assert_allclose([light[0], light[-1]], [0, 1], atol=1e-12)
    np.testing.assert_allclose(curve.counts(light), shares, atol=2e-4)
    assert curve.counts(3.0) == pytest.approx(1)


def test_srgb_is_that_of_the_standard():
    """IEC 61966-2-1: half of the counts is 21.4 % of the light, 18 % of the light 46.1 % of the
    counts.
    """
    np.testing.assert_allclose(Srgb().light([0.02, 0.5]), [0.02 / 12.92, 0.21404], atol=1e-5)
    np.testing.assert_allclose(Srgb().counts([0.001, 0.18]), [0.01292, 0.46136], atol=1e-5)


def test_a_photograph_of_a_lit_sheet_is_turned_into_light_before_the_sheet_is_taken_off(
    plane, spot
):
    """Taken as counts the same spot is fat and flat: that is what once looked like a camera's
    shoulder.
    """
    frame = photograph(
        spot, plane, np.random.default_rng(1), CameraOptions(daylight=0.25, peak=0.7)
    )
    right, wrong = (
        measure(frame, "raw", plane, camera=Camera(curve)) for curve in (Srgb(), LINEAR)
    )
    assert accuracy(right.flux, spot) > 0.95
    assert accuracy(wrong.flux, spot) < 0.90
    assert np.array_equal(measure(frame, "raw", plane).flux, right.flux)


def test_differences_of_counts_are_turned_into_light_by_the_ambient_they_were_taken_from(
    plane, spot
):
    """counts(spot + ambient) - counts(ambient), stretched to 255, as PAINT's ``flux`` is."""
    ambient = float(Srgb().counts(0.25))
    counts = Srgb().counts(0.25 + 0.75 * spot) - ambient
    image = np.round(255 * counts / counts.max()).astype(np.uint8)
    camera = Camera(Srgb(), ambient)
    assert accuracy(measure(image, "flux", plane, camera=camera).flux, spot) > 0.98
    assert accuracy(measure(image, "flux", plane).flux, spot) < 0.90


def test_the_counts_of_a_difference_s_brightest_place_part_ambient_from_exposure(plane, spot):
    """A dim spot's difference is stretched like a bright one's; taken for that it is turned into
    too fat a light.
    """
    day, peak = 0.25, 0.2
    ambient, brightest = (float(Srgb().counts(light)) for light in (day, day + peak))
    counts = Srgb().counts(day + peak * spot) - ambient
    for largest, depth in ((255, np.uint8), (65535, np.uint16)):
        image = np.round(largest * counts / counts.max()).astype(depth)
        declared_flux, full = (
            measure(image, "flux", plane, camera=Camera(Srgb(), ambient, peak_counts=top))
            for top in (brightest, 1.0)
        )
        assert accuracy(declared_flux.flux, spot) > 0.985 > 0.96 > accuracy(full.flux, spot)


def test_sixteen_bits_are_light_already(plane, spot):
    crop = np.round(65535 * (0.25 + 0.7 * spot)).astype(np.uint16)
    assert accuracy(measure(crop, "cropped", plane).flux, spot) > 0.97
    (plain,) = cameras_from_json([{"ambient": 0.4}])
    assert accuracy(measure(crop, "cropped", plane, camera=plain).flux, spot) > 0.97


@pytest.mark.parametrize("curve", CURVES, ids=repr)
def test_a_declared_curve_is_that_of_sixteen_bits_too(plane, spot, curve):
    light = 0.25 + 0.7 * spot
    crop = np.round(65535 * curve.counts(light)).astype(np.uint16)
    assert accuracy(measure(crop, "cropped", plane, camera=Camera(curve)).flux, spot) > 0.97
    counts = curve.counts(0.25 + 0.75 * spot) - curve.counts(0.25)
    flux, camera = (
        np.round(65535 * counts / counts.max()).astype(np.uint16),
        Camera(curve, float(curve.counts(0.25))),
    )
    assert accuracy(measure(flux, "flux", plane, camera=camera).flux, spot) > 0.98


def test_where_unscaled_counts_lie_on_a_declared_curve_is_asked(plane, spot):
    """A power function is scale-free; any other curve differs between 14 bits and 16."""
    crop = np.round(16383 * Srgb().counts(0.25 + 0.7 * spot)).astype(np.uint16)
    with pytest.raises(InvalidInputError, match=r"declared curve.*declare the camera's 'bits'"):
        measure(crop, "cropped", plane, camera=Camera(Srgb()))
    assert (
        accuracy(measure(crop, "cropped", plane, camera=Camera(Srgb(), bits=14)).flux, spot) > 0.97
    )
    assert measure(crop, "cropped", plane, camera=Camera(Power(2.2))).quality.accepted


def test_light_beyond_the_cameras_range_is_known_to_be_at_least_so_much(plane):
    spot = gaussian(plane, 0.0, 0.0, 0.6, 0.5)
    frame = photograph(
        spot,
        plane,
        np.random.default_rng(1),
        CameraOptions(daylight=0.3, peak=1.2, gradient=(0, 0)),
    )
    taken = measure(frame, "raw", plane)
    assert taken.quality.accepted
    assert taken.quality.saturated_share > 0.3
    assert taken.clipped.any()
    seen = clipped_alike(spot, taken.flux.astype(float), taken.clipped.astype(float))
    assert accuracy(taken.flux, spot) < 0.90 < 0.95 < accuracy(taken.flux, seen)
    flat = clipped_alike(np.ones_like(spot), taken.flux.astype(float), taken.clipped.astype(float))
    assert accuracy(taken.flux, flat) < 0.5


def test_nothing_is_cut_off_where_nothing_was_clipped(plane, spot):
    taken = measure(photograph(spot, plane, np.random.default_rng(1)), "raw", plane)
    assert taken.clipped is None
    alike = clipped_alike(spot, 7 * spot, np.zeros_like(spot))
    np.testing.assert_allclose(alike, 7 * spot)
    assert flux_accuracy(spot, alike) == pytest.approx(1)
    assert np.abs(taken.center_of_mass - center_of_mass(spot, SIZE)).max() < 0.02


def test_the_camera_of_the_time_and_the_target_counts():
    old, new = Camera(), Camera(LINEAR, since=datetime(2024, 3, 1, tzinfo=UTC))
    other = Camera(Power(2.0), targets=("upper",))
    cameras = (new, old, other)
    assert camera_at(cameras, "lower", datetime(2024, 2, 1, tzinfo=UTC)) is old
    assert camera_at(cameras, "lower", datetime(2024, 3, 2, tzinfo=UTC)) is new
    assert camera_at(cameras, "lower", None) is new
    assert camera_at((new, other), "upper", datetime(2024, 2, 1, tzinfo=UTC)) is other
    assert camera_at((), "lower", None) is None


def test_cameras_are_declared():
    table = {"counts": [0, 0.5, 1], "light": [0, 0.2, 1]}
    given = [
        {},
        {"transfer": "linear", "ambient": 0.4},
        {"transfer": {"gamma": 2}, "since": "2024-03-01T00:00:00Z"},
    ]
    plain, linear, power, measured = cameras_from_json(
        [*given, {"transfer": table, "targets": ["upper"]}]
    )
    assert plain == Camera()
    (deep,) = cameras_from_json([{"transfer": "srgb", "bits": 12, "peak_counts": 0.9}])
    assert (deep.transfer, deep.bits, deep.peak_counts) == (Srgb(), 12, 0.9)
    assert (linear.transfer, linear.ambient) == (LINEAR, 0.4)
    assert (power.transfer, power.since) == (Power(2.0), datetime(2024, 3, 1, tzinfo=UTC))
    assert (measured.transfer, measured.targets) == (Measured((0, 0.5, 1), (0, 0.2, 1)), ("upper",))


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (
            {"transfer": {"counts": [0, 0.6, 0.5, 1], "light": [0, 0.1, 0.2, 1]}},
            "'counts' must rise",
        ),
        (
            {"transfer": {"counts": [0, 0.5, 1], "light": [0, 0.5, 0.5]}},
            "'light' must be at least two",
        ),
        ({"transfer": {"counts": [0, 0.5, 1], "light": [0, 1]}}, "of one length"),
        ({"transfer": {"gamma": 9}}, "gamma must lie in"),
        ({"transfer": {"gamma": "two"}}, "must hold numbers"),
        ({"transfer": {"gamma": [2.0, 2.2]}}, "'gamma' is one number"),
        ({"transfer": {"counts": 0.5, "light": 0.5}}, "are lists"),
        ({"transfer": "log"}, "'transfer' must be"),
        ({"ambient": 1.0}, "'ambient' must lie in"),
        ({"ambient": True}, "'ambient' must be a number"),
        ({"ambient": 0.6, "peak_counts": 0.5}, "'peak_counts' must lie above its ambient"),
        ({"peak_counts": "most"}, "'peak_counts' must be a number"),
        ({"bits": 8}, "'bits' must lie in 9 to 16"),
        ({"bits": 12.5}, "'bits' must be a whole number"),
        ({"since": "yesterday"}, "with its zone"),
        ({"since": "2024-03-01T00:00:00"}, "with its zone"),
        ({"targets": "upper"}, "list of names"),
        ({"lens": 3}, "must be an object with"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(camera, says):
    with pytest.raises(InvalidInputError, match=says):
        cameras_from_json([camera])


def test_a_plateau_below_the_largest_count_is_the_cameras_range_too(plane):
    """A frame that was scaled after it was taken: real ones pile up at 245 to 253."""
    spot = gaussian(plane, 0.0, 0.0, 0.6, 0.5)
    light = np.minimum(0.26 + 1.2 * spot, 1)
    crop, scaled = (
        np.round(largest * Srgb().counts(light)).astype(np.uint8) for largest in (255, 247)
    )
    assert (ceiling(crop), ceiling(scaled)) == (SATURATED_GRAY, 245)
    whole, taken = measure(crop, "cropped", plane), measure(scaled, "cropped", plane)
    assert taken.quality.saturated_share == pytest.approx(whole.quality.saturated_share, abs=0.05)
    assert taken.clipped.mean() == pytest.approx(whole.clipped.mean(), rel=0.1)


def test_a_bright_peak_without_a_plateau_is_no_ceiling(plane):
    peak = Srgb().counts(0.26 + 0.7 * gaussian(plane, 0.0, 0.0, 0.6, 0.5))
    assert ceiling(np.round(248 / peak.max() * peak).astype(np.uint8)) == SATURATED_GRAY


def test_a_difference_of_counts_tells_by_its_plateau_where_the_camera_was_cut_off(plane):
    spot = gaussian(plane, 0.0, 0.0, 0.6, 0.5)
    ambient = float(Srgb().counts(0.25))
    counts = np.round(
        246 * (Srgb().counts(np.minimum(0.25 + 1.2 * spot, 1)) - ambient) / (1 - ambient)
    )
    counts[0, 0] = 255  # a single pixel to which the image was stretched
    taken = measure(counts.astype(np.uint8), "flux", plane, camera=Camera(Srgb(), ambient))
    assert taken.clipped.any()
    seen = clipped_alike(spot, taken.flux.astype(float), taken.clipped.astype(float))
    assert accuracy(taken.flux, spot) < 0.95 < accuracy(taken.flux, seen)
    assert measure(counts.astype(np.uint8), "flux", plane).clipped is None
