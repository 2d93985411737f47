"""Targets without marks: by their edges, and by a camera that is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from heliotwin.demo.camera import CameraOptions, photograph, target_corners
from model.errors import ImageRefusedError, InvalidInputError
from model.imaging import Camera, measure
from model.imaging.edges import find_sheet
from model.imaging.light import Srgb
from model.locating import (
    CameraCorners,
    CameraHomography,
    CameraPose,
    ImageSize,
    SheetEdges,
    corner_places,
    corners_by_camera,
    homography_through,
    locator_from_json,
    locator_to_json,
    project,
)
from model.plant import TargetPlane
from tests.imaging import accuracy

PLAIN = CameraOptions(border=0.0, marks=False, daylight=0.45, peak=0.5)
"""A white sheet without marks, brighter than the sky."""

EYE = np.array([6.0, 110.0, -3.0])


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def light(image):
    return (255 * Camera().light_of(gray(image))).astype(np.float32)


def sheet_of(frame, plane):
    return find_sheet(gray(frame), plane, light(frame))


def cluttered(frame, corners):
    """The frame's target before a tower, a ground and a bright pipe, with a mast before an edge."""
    rows, columns = frame.shape[:2]
    sky, x = frame[-100:, -100:].mean(axis=(0, 1)), int(corners[:, 0].mean())
    behind = np.full(frame.shape, np.round(sky), np.uint8)
    for first, last, colour in (
        ((x - columns // 5, 0), (x + columns // 5, rows), (95, 90, 88)),
        ((0, rows * 9 // 10), (columns, rows), (70, 80, 60)),
        ((30, 200), (60, rows - 10), (235, 235, 235)),
    ):
        cv2.rectangle(behind, first, last, colour, -1)
    ring, fine = corners[[0, 1, 3, 2]], np.zeros((8 * rows, 8 * columns), np.uint8)
    cv2.fillConvexPoly(fine, np.round(8 * (ring + 0.5) - 0.5).astype(np.int32), 255)
    cover = cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA) / 255.0
    inner = cv2.erode(cover, np.ones((15, 15))) > 0.99
    sheet = np.where(inner[..., None], frame, np.median(frame[inner], axis=0))
    share = cv2.GaussianBlur(cover, (0, 0), 0.8)[..., None]
    law = Srgb()
    mixed = share * law.light(sheet / 255) + (1 - share) * law.light(behind / 255)
    made = np.round(255 * law.counts(mixed)).astype(np.uint8)
    top = np.round(corners[:2].mean(axis=0)).astype(int)
    cv2.rectangle(made, tuple(top - [9, 60]), tuple(top + [9, 40]), (60, 60, 60), -1)
    return made


@pytest.mark.parametrize(
    "options",
    [
        PLAIN,
        replace(PLAIN, size=(1728, 3072)),
        replace(PLAIN, size=(540, 720)),
        replace(PLAIN, perspective=0.2),
        replace(PLAIN, noise=8.0),
        replace(PLAIN, blur_px=2.5),
        replace(PLAIN, fill=0.3),
        replace(PLAIN, grid_step=0.0, gradient=(0.15, -0.1)),
        replace(PLAIN, foreign_spot=(-2.2, 2.7, 0.5, 1.0)),
    ],
    ids=[
        "plain",
        "large",
        "small",
        "slanted",
        "noisy",
        "blurred",
        "far",
        "uneven",
        "spot on a corner",
    ],
)
def test_edges_give_the_corners_within_half_a_pixel(plane, spot, options):
    frame = photograph(spot, plane, np.random.default_rng(2), options)
    assert np.abs(sheet_of(frame, plane) - target_corners(plane, options)).max() < 0.5


def test_edges_are_found_before_other_things(plane, spot):
    corners = target_corners(plane, PLAIN)
    frame = cluttered(photograph(spot, plane, np.random.default_rng(2), PLAIN), corners)
    assert np.abs(sheet_of(frame, plane) - corners).max() < 0.5


def test_flux_of_a_target_without_marks_is_that_of_one_with_marks(plane, spot):
    bare = measure(
        photograph(spot, plane, np.random.default_rng(2), PLAIN),
        "raw",
        replace(plane, locator=SheetEdges()),
    )
    marked = photograph(
        spot, plane, np.random.default_rng(2), CameraOptions(daylight=0.45, peak=0.5)
    )
    known = measure(marked, "raw", plane)
    assert bare.quality.accepted
    assert accuracy(bare.flux, spot) > accuracy(known.flux, spot) - 0.005
    np.testing.assert_allclose(bare.center_of_mass, known.center_of_mass, atol=0.01)


# --- refusals
# --------------------------------------------------------------------------------------------------


def refusal(frame, plane):
    with pytest.raises(ImageRefusedError) as refused:
        sheet_of(frame, plane)
    assert refused.value.reason == "target_not_found"
    assert "declare marks or the target's camera" in refused.value.detail
    return refused.value.detail


def test_nothing_white_is_refused(plane):
    noise = np.random.default_rng(0).normal(120, 20, (600, 800, 3)).clip(0, 255).astype(np.uint8)
    for frame in (noise, np.full((600, 800, 3), 128, np.uint8), np.zeros((40, 40, 3), np.uint8)):
        assert "no white rectangle with clear edges" in refusal(frame, plane)


def test_two_targets_of_one_shape_are_refused_as_ambiguous(plane, spot):
    frame = photograph(spot, plane, np.random.default_rng(2), replace(PLAIN, fill=0.4))
    assert "2 white rectangles" in refusal(np.hstack([frame, frame]), plane)


def test_another_shape_is_refused_with_both_ratios(plane, spot):
    frame = photograph(spot, plane, np.random.default_rng(2), PLAIN)
    wide = TargetPlane("wide", np.zeros(3), plane.normal, plane.up, 12.0, 5.0)
    assert "0.84 times as wide as high, and the target 2.40 times" in refusal(frame, wide)


def test_a_sheet_no_brighter_than_the_sky_is_refused(plane, spot):
    frame = photograph(spot, plane, np.random.default_rng(2), replace(PLAIN, daylight=0.3))
    refusal(frame, plane)


def test_a_target_that_leaves_the_photograph_is_refused(plane, spot):
    frame = photograph(spot, plane, np.random.default_rng(2), PLAIN)
    assert "all inside of the photograph" in refusal(frame[:, 600:], plane)


def test_a_spot_is_no_target(plane, spot):
    """A bright round spot on a sheet that fills the photograph."""
    frame = photograph(spot, plane, np.random.default_rng(2), PLAIN)
    left, top = target_corners(plane, PLAIN).max(axis=0) * 0.5
    refusal(frame[int(top) - 150 : int(top) + 350, int(left) : int(left) + 400], plane)


# --- cameras that are known
# --------------------------------------------------------------------------------------------------


def photographed(plane, spot, camera, size=ImageSize(600, 500)):
    """What a camera shows of a target: each pixel by the place on the target that it sees."""
    fine = photograph(spot, plane, np.random.default_rng(2), replace(PLAIN, size=(900, 800)))
    source = homography_through(
        corner_places(plane), target_corners(plane, replace(PLAIN, size=(900, 800)))
    )
    right, up = plane.width * 0.8, plane.height * 0.8
    x, y = np.meshgrid(np.linspace(-right, right, 120), np.linspace(-up, up, 120))
    places = np.stack([x.ravel(), y.ravel()], axis=-1)
    seen = camera.to_pixels(plane, places, size)
    columns, rows = np.meshgrid(np.arange(size.columns), np.arange(size.rows))
    of_pixel = LinearNDInterpolator(seen, places)(columns.ravel(), rows.ravel())
    to = project(source, np.nan_to_num(of_pixel, nan=1e4)).astype(np.float32)
    x, y = to.T.reshape(2, size.rows, size.columns)
    return cv2.remap(fine, x, y, cv2.INTER_LINEAR, borderValue=(90, 95, 100))


POSE = CameraPose.looking_at(EYE, [0.2, 0.0, 0.1], focal_length_px=7_000.0)
BENT = replace(POSE, distortion=(40.0, 0.0, 0.1, -0.1, 0.0))


@pytest.mark.parametrize("camera", [POSE, BENT], ids=["straight", "bent"])
def test_a_pose_leads_to_the_same_flux(plane, spot, camera):
    frame = photographed(plane, spot, camera)
    measured = measure(frame, "raw", replace(plane, locator=camera))
    assert measured.quality.accepted
    assert accuracy(measured.flux, spot) > 0.95


def test_a_bent_image_needs_its_lens(plane, spot):
    frames = [photographed(plane, spot, camera) for camera in (POSE, BENT)]
    straight, bent, wrong = (
        measure(frames[which], "raw", replace(plane, locator=camera)).crop.astype(float)
        for which, camera in ((0, POSE), (1, BENT), (1, POSE))
    )
    assert np.abs(bent - straight).mean() < 0.6 * np.abs(wrong - straight).mean()


def test_a_pose_is_projected_as_opencv_does(plane):
    size = ImageSize(3000, 2000)
    camera = replace(BENT, distortion=(0.3, -0.2, 0.01, 0.02, 0.1), focal_length_px=500.0)
    places = corner_places(plane)
    matrix = np.array([[500, 0, 1499.5], [0, 500, 999.5], [0, 0, 1.0]])
    turned, _ = cv2.Rodrigues(camera.rotation)
    points, shift = plane.to_enu(places), -camera.rotation @ camera.position
    expected, _ = cv2.projectPoints(points, turned, shift, matrix, np.array(camera.distortion))
    np.testing.assert_allclose(camera.to_pixels(plane, places, size), expected[:, 0], atol=1e-6)


def test_the_three_forms_of_a_camera_agree(plane):
    size = ImageSize(1200, 1000)
    corners = corners_by_camera(POSE, plane, size)
    others = (
        CameraCorners(corners),
        CameraHomography(homography_through(corners, corner_places(plane))),
        replace(
            POSE,
            focal_length_px=None,
            field_of_view_deg=float(np.degrees(2 * np.arctan(600 / 7_000))),
        ),
    )
    for camera in others:
        np.testing.assert_allclose(corners_by_camera(camera, plane, size), corners, atol=1e-6)


@pytest.mark.parametrize(
    "camera", [POSE, BENT, replace(BENT, look_at=None, image_size=ImageSize(1200, 1000))]
)
def test_a_camera_comes_back_from_json(plane, camera):
    again = locator_from_json(locator_to_json(camera))
    assert locator_to_json(again) == locator_to_json(camera)
    size = ImageSize(1200, 1000)
    np.testing.assert_allclose(
        corners_by_camera(again, plane, size), corners_by_camera(camera, plane, size), atol=1e-9
    )


def test_a_photograph_of_another_size_is_refused(plane, spot):
    corners = corners_by_camera(POSE, plane, ImageSize(1200, 1000))
    sized = replace(plane, locator=CameraCorners(corners, ImageSize(2400, 2000)))
    measured = measure(np.full((1000, 1200), 90, np.uint8), "raw", sized)
    assert measured.quality.reason == "target_not_found"
    assert "declared for photographs of 2400 x 2000 pixels" in measured.quality.detail
    beyond = replace(plane, locator=CameraCorners(corners))
    measured = measure(np.full((400, 400), 90, np.uint8), "raw", beyond)
    assert "outside of a photograph of 400 x 400 pixels" in measured.quality.detail


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ({"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "camera: shows tower mirrored"),
        ({"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "homography: must be invertible"),
        ({"corners_px": [[0, 0], [9, 0], [9, 9], [0, 9]]}, "corners_px: must be a convex"),
        (
            {"pose": {"position_m": [0, -9, 0], "look_at_m": [0, 0, 0], "focal_length_px": 900}},
            "position_m: the camera is behind the target",
        ),
        (
            {"pose": {"position_m": [0, 90, 0], "look_at_m": [0, 99, 0], "focal_length_px": 900}},
            "rotation: the target is behind the camera",
        ),
        (
            {"pose": {"position_m": [0, 90, 0], "look_at_m": [0, 90, 5], "focal_length_px": 900}},
            "look_at_m: is straight above",
        ),
        (
            {"pose": {"position_m": [0, 90, 0], "rotation": np.ones((3, 3)), "focal_length_px": 9}},
            "rotation: its rows must be orthogonal",
        ),
    ],
)
def test_a_camera_that_cannot_be_is_named(plane, camera, said):
    with pytest.raises(InvalidInputError, match=said):
        plane.located_by({"marks": "none", "camera": camera})
