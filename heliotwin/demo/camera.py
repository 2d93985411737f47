"""A synthetic camera: photographs of a calibration target with a known flux.

The demonstration and the tests of `model.imaging` use it. The target's sheet is drawn on a fine
raster with its grid, marks and daylight, and the flux is added. The camera image then has
perspective, blur, noise, a limited range and a time stamp.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.imaging.light import Srgb
from model.plant import TargetPlane

_SHEET_HEIGHT = 1024  # [px] of the raster of the sheet
_ARM = 0.74  # [m] length of a bracket's arm, as on the Juelich tower
_STROKE = 0.16  # [m] width of the arm
_SURROUNDINGS = np.array([0.30, 0.36, 0.42])  # sky behind the tower, relative to full range
_SUNLIGHT = np.array([1.0, 0.93, 0.82])  # the spot is warmer than the daylight
_DARK = 0.12  # reflectance of marks, relative to the sheet


@dataclass(frozen=True)
class CameraOptions:
    """How the target is photographed.

    Attributes
    ----------
    size : (rows, columns) [px]
    daylight : float [1]
        Brightness of the sheet without flux, relative to the camera's range.
    peak : float [1]
        Brightness that the flux adds at its peak, relative to the camera's range. If the sum with
        daylight is above 1, the image saturates.
    gradient : (2,) [1]
        Relative change of daylight from the left to the right edge, and from the bottom to the top.
    perspective : float [1]
        Relative shortening of the target's far side; the target also leans a little to one side.
    fill : float [1]
        The target's share of the frame's height or width, whichever is the limit.
    grid_step : float [m]
        Distance between the sheet's seams; 0 for none.
    blur_px : float [px]
        Standard deviation of the lens blur.
    noise : float [gray]
        Standard deviation of the sensor noise.
    time_stamp : str
        Text in the upper left corner; empty for none.
    border : float [1]
        White sheet beyond the target's edges, relative to its sides.
    marks : bool
        Whether L brackets are at its corners.
    foreign_spot : (right [m], up [m], radius [m], peak [1]) or None
        Gaussian spot of another heliostat: its centre, its standard deviation, and its peak
        relative to ``peak``.
    """

    size: tuple[int, int] = (1080, 1440)
    daylight: float = 0.25
    peak: float = 0.6
    gradient: tuple[float, float] = (0.08, 0.12)
    perspective: float = 0.06
    fill: float = 0.75
    grid_step: float = 1.1
    blur_px: float = 0.8
    noise: float = 1.5
    time_stamp: str = "2024-06-21 10:00:00 UTC"
    border: float = 0.09
    marks: bool = True
    foreign_spot: tuple[float, float, float, float] | None = None


def target_corners(plane: TargetPlane, options: CameraOptions | None = None) -> NDArray[np.float64]:
    """Pixel positions of the target's corners (4, 2) [px] in the photograph.

    Order: upper left, upper right, lower left, lower right.
    """
    options = options or CameraOptions()
    rows, columns = options.size
    scale = options.fill * min(rows / plane.height, columns / plane.width)
    half_width, half_height = scale * plane.width / 2, scale * plane.height / 2
    lean, far = 0.3 * options.perspective * half_height, options.perspective
    middle = np.array([columns / 2, rows / 2]) + np.array([0.02, 0.03]) * np.array(
        [columns, rows]
    ) * (1 - options.fill)
    corners = np.array(
        [
            [-half_width - lean, -half_height],
            [half_width * (1 - far) - lean, -half_height * (1 - far)],
            [-half_width + lean, half_height],
            [half_width * (1 - far / 2) + lean, half_height * (1 - far / 3)],
        ]
    )
    return np.asarray(corners + middle)


def photograph(
    flux: NDArray[np.floating],
    plane: TargetPlane,
    rng: np.random.Generator,
    options: CameraOptions | None = None,
) -> NDArray[np.uint8]:
    """Photograph of the target with a flux on it.

    Parameters
    ----------
    flux : (rows, columns)
        Over the whole target, row 0 at the top, in any unit.
    plane : TargetPlane
    rng : numpy Generator
        Draws the sensor noise.
    options : CameraOptions, optional

    Returns
    -------
    ndarray uint8 (rows, columns, 3)
        RGB, sRGB encoded.

    Raises
    ------
    InvalidInputError
        If ``flux`` is not a finite, non-negative image.
    """
    options = options or CameraOptions()
    if flux.ndim != 2 or not np.isfinite(flux).all() or flux.min() < 0:
        raise InvalidInputError("flux must be a finite, non-negative image (rows, columns)")
    light = _sheet(plane, options)[..., None] * _light(flux, plane, options)
    frame = _seen(light, plane, options)
    counts = 255 * Srgb().counts(cv2.GaussianBlur(frame, (0, 0), options.blur_px))
    frame = counts + rng.normal(0, options.noise, frame.shape)
    image = np.clip(np.round(frame), 0, 255).astype(np.uint8)
    return _stamped(image, options.time_stamp)


def _raster(plane: TargetPlane, border: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates on the sheet: right (1, columns) and up (rows, 1) [m] from the
    target's centre.
    """
    height, width = (1 + 2 * border) * plane.height, (1 + 2 * border) * plane.width
    columns = round(_SHEET_HEIGHT * width / height)
    right = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    up = (0.5 - (np.arange(_SHEET_HEIGHT) + 0.5) / _SHEET_HEIGHT) * height
    return right[None, :], up[:, None]


def _sheet(plane: TargetPlane, options: CameraOptions) -> NDArray[np.float64]:
    """Reflectance of the sheet (rows, columns), relative to plain white."""
    right, up = _raster(plane, options.border)
    sheet = np.ones((up.shape[0], right.shape[1]))
    if options.grid_step > 0:
        pixel = float(right[0, 1] - right[0, 0])
        for axis in (right, up):
            on_seam = (
                np.abs((axis + options.grid_step / 2) % options.grid_step - options.grid_step / 2)
                < 1.2 * pixel
            )
            sheet *= np.where(on_seam, 0.88, 1.0)
    if not options.marks:
        return sheet
    arm = min(_ARM, 0.2 * plane.width, 0.2 * plane.height)
    stroke = arm * _STROKE / _ARM
    # Inward distances from the two edges of the nearest corner.
    x, y = plane.width / 2 - np.abs(right), plane.height / 2 - np.abs(up)
    mark = (x >= 0) & (y >= 0) & (x < arm) & (y < arm) & ((x < stroke) | (y < stroke))
    return np.asarray(np.where(mark, _DARK, sheet))


def _light(
    flux: NDArray[np.floating], plane: TargetPlane, options: CameraOptions
) -> NDArray[np.float64]:
    """Daylight and flux on the sheet (rows, columns, 3), relative to the camera's range."""
    right, up = _raster(plane, options.border)
    slope = options.gradient[0] * right / plane.width + options.gradient[1] * up / plane.height
    scaled = np.asarray(flux, dtype=np.float64) / max(float(flux.max()), 1e-300)
    spot = _resampled(scaled, right / plane.width, up / plane.height)
    if options.foreign_spot is not None:
        x, y, radius, peak = options.foreign_spot
        spot = spot + peak * np.exp(-0.5 * ((right - x) ** 2 + (up - y) ** 2) / radius**2)
    return np.asarray(
        options.daylight * (1 + slope)[..., None] + options.peak * spot[..., None] * _SUNLIGHT
    )


def _resampled(
    image: NDArray[np.float64], right: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Resample an image of the whole target at positions in target sides; 0 outside."""
    rows, columns = image.shape
    x, y = np.broadcast_arrays((right + 0.5) * columns - 0.5, (0.5 - up) * rows - 0.5)
    seen = cv2.remap(
        image.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR
    )
    return np.asarray(seen, dtype=np.float64)


def _seen(
    light: NDArray[np.float64], plane: TargetPlane, options: CameraOptions
) -> NDArray[np.float64]:
    """The lit sheet (rows, columns, 3) in the camera's perspective, in front of the sky."""
    rows, columns = light.shape[:2]
    whole = 1 + 2 * options.border
    low, high = options.border / whole, (1 + options.border) / whole
    x, y = np.array([low, high]) * columns - 0.5, np.array([low, high]) * rows - 0.5
    source = np.array([[x[0], y[0]], [x[1], y[0]], [x[0], y[1]], [x[1], y[1]]], dtype=np.float32)
    transform = cv2.getPerspectiveTransform(
        source, target_corners(plane, options).astype(np.float32)
    )
    size = options.size[1], options.size[0]
    frame = cv2.warpPerspective(light, transform, size, flags=cv2.INTER_AREA)
    cover = cv2.warpPerspective(np.ones((rows, columns)), transform, size)[..., None]
    return np.asarray(frame + (1 - cover) * _SURROUNDINGS, dtype=np.float64)


def _stamped(image: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """The frame with a time stamp: white text on a black bar in the upper left corner."""
    if text:
        scale = image.shape[0] / 1400
        thickness = max(1, round(2 * scale))
        (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
        cv2.rectangle(image, (0, 0), (width + base, height + 2 * base), (0, 0, 0), -1)
        cv2.putText(
            image,
            text,
            (base // 2, height + base // 2),
            cv2.FONT_HERSHEY_SIMPLEX,
            scale,
            (255, 255, 255),
            thickness,
        )
    return image
