import cv2
import numpy as np
import pytest

from heliotwin.demo.camera import CameraOptions, photograph, target_corners
from model.errors import ImageRefusedError, InvalidInputError
from model.imaging import Camera
from model.imaging.marks import find_marks
from model.imaging.rectify import check_corners, find_corners, rectify
from model.plant import TargetPlane
from service.sources.photograph import mark_layouts

ARM, STROKE = 0.74, 0.16  # [m]


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def light(image):
    return (255 * Camera().light_of(gray(image))).astype(np.float32)


@pytest.mark.parametrize(
    "options",
    [
        CameraOptions(),
        CameraOptions(size=(1728, 3072)),
        CameraOptions(size=(540, 720)),
        CameraOptions(perspective=0.2),
        CameraOptions(gradient=(0.5, -0.5)),
        CameraOptions(daylight=0.2, peak=0.7),
        CameraOptions(noise=8.0),
        CameraOptions(blur_px=2.5),
        CameraOptions(fill=0.4),
        CameraOptions(foreign_spot=(-2.2, 2.7, 0.5, 1.0)),
    ],
    ids=[
        "plain",
        "large",
        "small",
        "slanted",
        "uneven",
        "dim",
        "noisy",
        "blurred",
        "far",
        "spot on a mark",
    ],
)
def test_corners_are_found_within_a_pixel(plane, spot, options):
    frame = photograph(spot, plane, np.random.default_rng(2), options)
    found = find_corners(gray(frame), plane, light=light(frame))
    assert np.abs(found - target_corners(plane, options)).max() < 1.0


def two_targets():
    """A frame of two stacked targets with L and T marks, and the corners of the upper and the lower
    one [px].
    """
    width, height, scale = 8.6, 7.2, 60.0
    sheet = np.full((int(scale * (2 * height + 2)), int(scale * (width + 2))), 150, np.uint8)
    sheet[::80] = 135
    arm, stroke = ARM * scale, STROKE * scale

    def bar(x, y, dx, dy):
        """A dark rectangle from a point in metres, by pixels."""
        xs, ys = (
            sorted((scale * (x + 1), scale * (x + 1) + dx)),
            sorted((scale * (y + 1), scale * (y + 1) + dy)),
        )
        sheet[round(ys[0]) : round(ys[1]), round(xs[0]) : round(xs[1])] = 25

    for x, inward in ((0, 1), (width, -1)):
        for y, down in ((0, 1), (2 * height, -1)):
            bar(x, y, inward * arm, down * stroke)
            bar(x, y, inward * stroke, down * arm)
        bar(x, height - arm / scale / 2, inward * stroke, arm)
        bar(x, height - stroke / scale / 2, inward * arm, stroke)
    corners = (
        scale * (np.array([[x, y] for y in (0, height, 2 * height) for x in (0, width)]) + 1) - 0.5
    )
    tilt = np.array([[0.98, 0.03, 60], [-0.04, 1.0, 90], [1e-5, 2e-5, 1]])
    frame = cv2.warpPerspective(
        sheet, tilt, (820, 1100), borderValue=(90.0,), flags=cv2.INTER_LINEAR
    )
    seen = cv2.perspectiveTransform(corners[None], tilt)[0]
    return cv2.GaussianBlur(frame, (0, 0), 0.8), seen[:4], seen[2:]


@pytest.mark.parametrize("which", ["upper", "lower"])
def test_targets_that_share_an_edge_are_distinguished_by_name(which):
    frame, upper, lower = two_targets()
    plane = TargetPlane(
        f"solar_tower_{which}", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.6, 7.2
    )
    found = find_corners(frame, plane, mark_layouts(plane.name))
    assert np.abs(found - (upper if which == "upper" else lower)).max() < 1.0


@pytest.mark.parametrize("corner", [0, 2, 3])
def test_a_hidden_mark_is_replaced_by_those_of_the_other_target(corner):
    frame, upper, _ = two_targets()
    x, y = np.round(upper[corner]).astype(int)
    frame[max(y - 60, 0) : y + 60, max(x - 60, 0) : x + 60] = 150
    plane = TargetPlane("t", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.6, 7.2)
    assert np.abs(find_corners(frame, plane, mark_layouts("solar_tower_upper")) - upper).max() < 3.0


@pytest.mark.parametrize("corner", range(4))
def test_a_hidden_mark_of_a_lone_target_is_put_where_its_neighbours_point(plane, spot, corner):
    frame = photograph(spot, plane, np.random.default_rng(2))
    truth = target_corners(plane)
    x, y = np.round(truth[corner]).astype(int)
    cv2.circle(frame, (int(x), int(y)), 110, (125, 125, 125), -1)
    assert np.abs(find_corners(gray(frame), plane) - truth).max() < 5.0


def test_marks_are_named_by_kind_and_attitude():
    frame, _, _ = two_targets()
    best = {(mark.kind, mark.quarter) for mark in find_marks(frame)[:6]}
    assert best == {("L", 0), ("L", 1), ("L", 2), ("L", 3), ("T", 1), ("T", 3)}


def test_a_target_without_marks_is_refused_with_the_remedy(plane):
    noise = np.random.default_rng(0).normal(120, 20, (600, 800)).clip(0, 255).astype(np.uint8)
    for frame in (noise, np.full((600, 800), 128, np.uint8), np.zeros((40, 40), np.uint8)):
        with pytest.raises(ImageRefusedError, match="give the four corners") as caught:
            find_corners(frame, plane)
        assert caught.value.reason == "target_not_found"


def test_a_target_of_another_shape_is_not_taken(spot, plane):
    frame = photograph(spot, plane, np.random.default_rng(2))
    wide = TargetPlane("wide", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 12.0, 5.0)
    with pytest.raises(ImageRefusedError):
        find_corners(gray(frame), wide)


def test_rectifying_puts_the_corners_into_the_corners(plane, spot):
    options = CameraOptions(
        noise=0.0, grid_step=0.0, gradient=(0.0, 0.0), daylight=0.3, peak=0.5, blur_px=0.3
    )
    crop = rectify(
        light(photograph(spot, plane, np.random.default_rng(0), options)),
        target_corners(plane, options),
    )
    assert crop.shape == (256, 256)
    inner = crop[40:-40, 40:-40].astype(float)
    expected = 255 * (0.3 + 0.5 * spot[40:-40, 40:-40] * 0.94)
    assert np.abs(inner - expected).mean() < 1.5
    assert crop[:5, :5].max() < 40 < crop[10:30, 60:190].min()


@pytest.mark.parametrize(
    "corners",
    [
        np.zeros((4, 2)),
        [[0, 0], [1, 0], [0, 1]],
        [[0, 0], [9, 0], [9, 9], [0, 9]],  # around, instead of row by row
        [[0, 0], [9, 0], [0, np.nan], [9, 9]],
    ],
)
def test_malformed_corners_are_refused(corners):
    with pytest.raises(InvalidInputError, match="upper left, upper right, lower left, lower right"):
        check_corners(corners)
