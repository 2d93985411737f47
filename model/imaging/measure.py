"""Measure the flux of a photograph.

The steps are: find the target, convert counts to light, rectify, separate, center, crop, normalise
and check the quality.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeVar, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ImageRefusedError, InvalidInputError
from model.images import FLUX_WINDOW, normalized
from model.imaging.finding import Frame, TargetImage, find_target
from model.imaging.light import Camera, Power
from model.imaging.quality import (
    SATURATED_GRAY,
    Quality,
    ceiling,
    cut_off_at,
    judge,
    judge_flux,
    refused,
)
from model.imaging.rectify import BRACKETS, CROP_SIZE, Layout, check_corners
from model.imaging.separate import find_spots, separate
from model.imaging.strips import convert_by_strips
from model.imaging.window import center_of_mass, flux_window
from model.plant import TargetPlane

ImageKind = Literal["raw", "cropped", "flux", "flux-centered"]
Image = NDArray[np.uint8] | NDArray[np.uint16]

# Photographs of 16 bits with smaller counts are from a camera of 12 bits or less, without scaling.
_FULL_RANGE = 4096
_REMEDY = "scale its counts to 16 bits, or declare the camera's 'bits'"
Counts = TypeVar("Counts", np.uint8, np.float32)


@dataclass(frozen=True, eq=False)
class MeasuredFlux:
    """The measured flux of a photograph.

    A rejected image (``quality.accepted`` is false) has no ``flux``, ``centered`` and
    ``center_of_mass``; only its quality record is kept.

    Attributes
    ----------
    quality : Quality
    flux : float32 (256, 256) or None
        Over the whole target, at least 0, sum 100; row 0 at the top, column 0 at the image's left
        edge. Also None for the kind ``flux-centered``, which does not show the spot's position on
        the target.
    centered : float32 (64, 64) or None
        Flux in a window centered on the centroid, sum 100.
    center_of_mass : float64 (2,) or None [m]
        Right and up of the target's centre; `TargetPlane.to_enu` converts it to ENU. None like
        ``flux``.
    window : float [m]
        Side of the window of ``centered``.
    crop : uint8 (256, 256) or None
        The rectified photograph, for the kinds ``raw`` and ``cropped``.
    corners : float64 (4, 2) or None [px]
        The target's corners in a ``raw`` image: upper left, upper right, lower left, lower right.
    clipped : bool (256, 256) or None
        Saturated pixels on the target, if any: the real light is at least as much.
    square : float32 (64, 64) or None
        All of an image of the kind ``flux-centered``, sum 100.
    """

    quality: Quality
    flux: NDArray[np.float32] | None = None
    centered: NDArray[np.float32] | None = None
    center_of_mass: NDArray[np.float64] | None = None
    window: float = FLUX_WINDOW
    crop: NDArray[np.uint8] | None = None
    corners: NDArray[np.float64] | None = None
    clipped: NDArray[np.bool_] | None = None
    square: NDArray[np.float32] | None = None


def measure(
    image: Image,
    kind: ImageKind,
    plane: TargetPlane,
    *,
    layouts: Sequence[Layout] = (BRACKETS,),
    side: float | None = None,
    corners: ArrayLike | None = None,
    camera: Camera | None = None,
) -> MeasuredFlux:
    """Measure the flux on a target, from any kind of image.

    Photographs (``raw``, ``cropped``) are converted to light before anything is subtracted.

    Parameters
    ----------
    image : uint8 or uint16 (rows, columns) or (rows, columns, 3) in RGB
    kind : {"raw", "cropped", "flux", "flux-centered"}
        A camera frame; the rectified target; the rectified target without background; or a square
        of that, centered on the centroid.
    plane : TargetPlane
        The target on which the image shows the spot. Its locator finds it in a raw image.
    layouts : sequence of Layout
        Possible layouts of the target's marks in a raw image, in the order to try, if the target
        declares no locator.
    side : float [m], optional
        Side of the square of a ``flux-centered`` image, which does not contain it.
    corners : array_like (4, 2) [px], optional
        The target's corners in a raw image, used instead of its locator: upper left, upper right,
        lower left, lower right.
    camera : Camera, optional
        Conversion of light to counts. Without it, photographs are sRGB, or linear for 16 bits, and
        images without background are taken as light.

    Returns
    -------
    MeasuredFlux
        Also for an image that cannot be measured: see ``quality``.

    Raises
    ------
    InvalidInputError
        If an argument is malformed.
    """
    _check(image, kind)
    if kind == "flux-centered":
        if side is None or not side > 0:
            raise InvalidInputError(f"side of a centred flux must be positive metres, got {side}")
        return _measure_centered(_spot_light(image, camera), side)
    if kind == "flux":
        return _measure_flux(_spot_light(image, camera), plane, _plateau(image, camera))
    camera = camera or Camera()
    _check_range(image, camera)
    light, crop, brightest = _light(image, camera), _gray(image, camera), _brightest(image, camera)
    if kind == "cropped":
        return _measure_crop(_square(light), _square(crop), _square(brightest), plane)
    try:
        found = (
            find_target(Frame(crop, light), plane, layouts)
            if corners is None
            else TargetImage(check_corners(corners))
        )
    except ImageRefusedError as refusal:
        return MeasuredFlux(refused(refusal.reason, refusal.detail))
    return _measure_crop(
        found.rectified(light),
        found.rectified(crop),
        found.rectified(brightest),
        plane,
        found.corners,
    )


def _check(image: Image, kind: str) -> None:
    if kind not in get_args(ImageKind):
        raise InvalidInputError(
            f"kind must be one of {', '.join(get_args(ImageKind))}, got {kind!r}"
        )
    shape_fits = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype not in (np.uint8, np.uint16) or not shape_fits or min(image.shape[:2]) < 16:
        raise InvalidInputError(
            "image must be uint8 or uint16, (rows, columns) or (rows, columns, 3), at least 16"
            f" pixels wide and high; got {image.dtype} {image.shape}"
        )


def _check_range(image: Image, camera: Camera) -> None:
    """Check that the end of the camera's range is known for a photograph of 16 bits."""
    if image.dtype != np.uint16 or not image.any():
        return
    brightest, most = int(image.max()), camera.most(image.dtype)
    if brightest > most:
        raise InvalidInputError(
            f"image: a count of {brightest} is beyond the {camera.bits} bits of its camera; correct"
            " the camera's 'bits'"
        )
    level = cut_off_at(_largest_channel(image), most)
    if level is not None:
        raise InvalidInputError(
            f"image: pixels pile up at the count {level}, where the camera's range ends, but {most}"
            f" is the largest; {_REMEDY}"
        )
    if camera.bits is not None:
        return
    if brightest < _FULL_RANGE:
        raise InvalidInputError(
            f"image: a photograph of 16 bits with no count above {brightest} holds"
            f" {brightest.bit_length()} bits; {_REMEDY}, so that saturated pixels can"
            " be found"
        )
    if (
        not isinstance(camera.law(image.dtype), Power) and brightest < 2**15
    ):  # a power curve is independent of scale
        raise InvalidInputError(
            f"image: a photograph of 16 bits with no count above {brightest} has no known place on"
            f" the camera's declared curve; {_REMEDY}"
        )


def _light(image: Image, camera: Camera) -> NDArray[np.float32]:
    """Light (rows, columns) of a photograph, from 0 to 255 as in a linear 8-bit camera."""
    return convert_by_strips(image, lambda strip: _luma(255 * camera.light_of(strip)))


def _luma(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return (
        image
        if image.ndim == 2
        else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float32)
    )


def _spot_light(image: Image, camera: Camera | None) -> NDArray[np.float32]:
    """Light (rows, columns), in any unit, of an image whose background was subtracted."""
    counts = convert_by_strips(image, lambda strip: _luma(strip.astype(np.float32)))
    if camera is None:
        return counts
    peak = float(counts.max(initial=0))
    return convert_by_strips(
        counts,
        lambda strip: (255 * camera.light_of_difference(strip, image.dtype, peak)).astype(
            np.float32
        ),
    )


def _gray(image: Image, camera: Camera) -> NDArray[np.uint8]:
    """Counts (rows, columns) in 8 bits, for people and for the search of marks."""
    most = camera.most(image.dtype)

    def gray(strip: Image) -> NDArray[np.uint8]:
        counts = (
            strip if most == 255 else (strip * np.uint32(255) // np.uint32(most)).astype(np.uint8)
        )
        return np.asarray(
            counts if counts.ndim == 2 else cv2.cvtColor(counts, cv2.COLOR_RGB2GRAY), dtype=np.uint8
        )

    return convert_by_strips(image, gray)


def _brightest(image: Image, camera: Camera) -> NDArray[np.uint8]:
    """The brightest channel, which saturates first."""
    return _gray(_largest_channel(image), camera)


def _largest_channel(image: Image) -> Image:
    return image if image.ndim == 2 else convert_by_strips(image, lambda strip: strip.max(axis=2))


def _square(image: NDArray[Counts]) -> NDArray[Counts]:
    if image.shape == (CROP_SIZE, CROP_SIZE):
        return image
    return np.asarray(
        cv2.resize(image, (CROP_SIZE, CROP_SIZE), interpolation=cv2.INTER_AREA), dtype=image.dtype
    )


def _measure_crop(
    light: NDArray[np.float32],
    crop: NDArray[np.uint8],
    brightest: NDArray[np.uint8],
    plane: TargetPlane,
    corners: NDArray[np.float64] | None = None,
) -> MeasuredFlux:
    parts = separate(light)
    if not parts.flux.any():
        return MeasuredFlux(refused("no_spot"), crop=crop, corners=corners)
    center, centered, outside = _center(parts.flux, (plane.width, plane.height))
    clipped = brightest >= ceiling(brightest)
    quality = judge(parts, crop >= ceiling(crop), clipped, outside)
    if not quality.accepted:
        return MeasuredFlux(quality, crop=crop, corners=corners)
    # The flux was smoothed, so pixels next to the plateau lost light to it.
    clipped = (
        cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & parts.main
    )
    return MeasuredFlux(
        quality,
        _normalised(parts.flux),
        centered,
        center,
        crop=crop,
        corners=corners,
        clipped=clipped if clipped.any() else None,
    )


def _plateau(image: Image, camera: Camera | None) -> NDArray[np.bool_] | None:
    """Saturated pixels of an image whose background was subtracted, or None.

    Such an image is stretched, so only an accumulation of pixels below its maximum shows the end of
    the camera's range.
    """
    if camera is None:
        return None
    gray = _square(_gray(image, replace(camera, bits=None)))
    return gray >= ceiling(gray) if ceiling(gray) < SATURATED_GRAY else None


def _measure_flux(
    image: NDArray[np.float32], plane: TargetPlane, clipped: NDArray[np.bool_] | None = None
) -> MeasuredFlux:
    size = plane.width, plane.height
    # Area weights keep the energy for any image size.
    flux = flux_window(image, size, window=size, resolution=CROP_SIZE)
    if not flux.any():
        return MeasuredFlux(refused("no_spot"))
    center, centered, outside = _center(flux, size)
    main, foreign = find_spots(flux.astype(np.float32), noise=float(flux.max()) / 255)
    second = float(flux[foreign].sum() / flux.sum())
    quality = judge_flux(flux, main, outside, second)
    if not quality.accepted:
        return MeasuredFlux(quality)
    return MeasuredFlux(quality, _normalised(flux), centered, center, clipped=clipped)


def _measure_centered(image: NDArray[np.float32], side: float) -> MeasuredFlux:
    flux = image.astype(np.float64)
    if not flux.any():
        return MeasuredFlux(refused("no_spot"))
    _, centered, outside = _center(flux, (side, side))
    main, foreign = find_spots(flux.astype(np.float32), noise=float(flux.max()) / 255)
    quality = judge_flux(flux, main, outside, float(flux[foreign].sum() / flux.sum()))
    if not quality.accepted:
        return MeasuredFlux(quality)
    square = _normalised(flux_window(flux, (side, side), window=side))
    return MeasuredFlux(quality, centered=centered, square=square)


class _Centered(NamedTuple):
    """Centroid (2,) [m], the normalised window around it, and the share of energy outside."""

    center: NDArray[np.float64]
    flux: NDArray[np.float32]
    outside: float


def _center(flux: NDArray[np.floating], size: tuple[float, float]) -> _Centered:
    center = center_of_mass(flux, size)
    cut = flux_window(flux, size, center)
    outside = max(0.0, 1.0 - float(cut.sum() / flux.sum(dtype=np.float64)))
    return _Centered(center, _normalised(cut), outside)


def _normalised(flux: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(normalized(flux.astype(np.float64)), dtype=np.float32)
