"""From a photograph to a measured flux: find, turn into light, rectify, separate, centre, crop, normalise, judge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ImageRefusedError, InvalidInputError
from model.images import FLUX_WINDOW, normalized
from model.imaging.light import Camera, Power
from model.imaging.quality import SATURATED_GRAY, Quality, ceiling, cut_off_at, judge, judge_flux, refused
from model.imaging.rectify import BRACKETS, CROP_SIZE, Layout, check_corners, find_corners, rectify
from model.imaging.separate import find_spots, separate
from model.imaging.window import center_of_mass, flux_window
from model.plant import TargetPlane

ImageKind = Literal["raw", "cropped", "flux", "flux-centered"]
Image = NDArray[np.uint8] | NDArray[np.uint16]

# Below it the counts of a photograph of 16 bits are those of a camera of 12 bits or less, not scaled.
_FULL_RANGE = 4096
_REMEDY = "scale its counts to 16 bits, or declare the camera's 'bits'"
Counts = TypeVar("Counts", np.uint8, np.float32)


@dataclass(frozen=True, eq=False)
class MeasuredFlux:
    """The flux that a photograph shows.

    A refused image (``quality.accepted`` is false) has no ``flux``, ``centered`` and ``center_of_mass``; it is kept
    with its quality record.

    Attributes
    ----------
    quality : Quality
    flux : float32 (256, 256) or None
        Over the whole target, at least 0, sum 100; row 0 at the top, column 0 at the image's left edge. None also for
        the kind ``flux-centered``, which does not say where on the target the spot lies.
    centered : float32 (64, 64) or None
        In a window about the centre of mass, sum 100.
    center_of_mass : float64 (2,) or None [m]
        Right and up of the target's centre; `TargetPlane.to_enu` turns it into ENU. None as ``flux``.
    window : float [m]
        Side of the window of ``centered``.
    crop : uint8 (256, 256) or None
        The rectified photograph, of the kinds ``raw`` and ``cropped``.
    corners : float64 (4, 2) or None [px]
        Where the target's corners lie in a ``raw`` image: upper left, upper right, lower left, lower right.
    clipped : bool (256, 256) or None
        Where on the target the camera's range cut the light off, where it did: there was at least so much.
    """

    quality: Quality
    flux: NDArray[np.float32] | None = None
    centered: NDArray[np.float32] | None = None
    center_of_mass: NDArray[np.float64] | None = None
    window: float = FLUX_WINDOW
    crop: NDArray[np.uint8] | None = None
    corners: NDArray[np.float64] | None = None
    clipped: NDArray[np.bool_] | None = None


def measure(
    image: Image,
    kind: ImageKind,
    plane: TargetPlane,
    *,
    layouts: Sequence[Layout] = (BRACKETS,),
    side: float | None = None,
    corners: ArrayLike | None = None,
    empty: Image | None = None,
    camera: Camera | None = None,
) -> MeasuredFlux:
    """The flux on a target, from any kind of image.

    Photographs (``raw``, ``cropped``) are turned into light before anything is taken off them.

    Parameters
    ----------
    image : uint8 or uint16 (rows, columns) or (rows, columns, 3) in RGB
    kind : {"raw", "cropped", "flux", "flux-centered"}
        A camera frame; the target seen straight on; that with its background removed; a square of that about the
        centre of mass.
    plane : TargetPlane
        The target on which the image shows the spot.
    layouts : sequence of Layout
        Where a raw image may show the target's marks; those to try, in order.
    side : float [m], optional
        Side of the square that a ``flux-centered`` image shows, which does not say so itself.
    corners : array_like (4, 2) [px], optional
        The target's corners in a raw image, used instead of its marks: upper left, upper right, lower left, lower
        right.
    empty : uint8 or uint16 (256, 256), optional
        A rectified image of the same target without light.
    camera : Camera, optional
        How it turns light into counts. Photographs are sRGB without one, those of 16 bits linear; images whose
        background is off already are then taken as light.

    Returns
    -------
    MeasuredFlux
        Also of an image that cannot be measured: see ``quality``.

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
    for photograph in (image,) if empty is None else (image, empty):
        _check_range(photograph, camera)
    dark = None if empty is None else _square(_light(empty, camera))
    light, crop, brightest = _light(image, camera), _gray(image, camera), _brightest(image, camera)
    if kind == "cropped":
        return _measure_crop(_square(light), _square(crop), _square(brightest), plane, dark)
    try:
        found = find_corners(crop, plane, layouts, light) if corners is None else check_corners(corners)
    except ImageRefusedError as refusal:
        return MeasuredFlux(refused(refusal.reason, refusal.detail))
    return _measure_crop(rectify(light, found), rectify(crop, found), rectify(brightest, found), plane, dark, found)


def _check(image: Image, kind: str) -> None:
    if kind not in get_args(ImageKind):
        raise InvalidInputError(f"kind must be one of {', '.join(get_args(ImageKind))}, got {kind!r}")
    shape_fits = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype not in (np.uint8, np.uint16) or not shape_fits or min(image.shape[:2]) < 16:
        raise InvalidInputError(
            f"image must be uint8 or uint16, (rows, columns) or (rows, columns, 3), at least 16 pixels wide and high; "
            f"got {image.dtype} {image.shape}"
        )


def _check_range(image: Image, camera: Camera) -> None:
    """That a photograph of 16 bits tells where the camera's range ends, for it cuts light off there."""
    if image.dtype != np.uint16 or not image.any():
        return
    brightest, most = int(image.max()), camera.most(image.dtype)
    if brightest > most:
        raise InvalidInputError(
            f"image: a count of {brightest} is beyond the {camera.bits} bits of its camera; correct the camera's 'bits'"
        )
    level = cut_off_at(image if image.ndim == 2 else image.max(axis=2), most)
    if level is not None:
        raise InvalidInputError(
            f"image: pixels pile up at the count {level}, where the camera's range ends, but {most} is the largest; "
            f"{_REMEDY}"
        )
    if camera.bits is not None:
        return
    if brightest < _FULL_RANGE:
        raise InvalidInputError(
            f"image: a photograph of 16 bits with no count above {brightest} holds {brightest.bit_length()} bits; "
            f"{_REMEDY}, so that it can be told where the camera's range cut the light off"
        )
    if not isinstance(camera.law(image.dtype), Power) and brightest < 2**15:  # a power has no scale of its own
        raise InvalidInputError(
            f"image: a photograph of 16 bits with no count above {brightest} does not tell where on the camera's "
            f"declared curve it lies; {_REMEDY}"
        )


def _light(image: Image, camera: Camera) -> NDArray[np.float32]:
    """Light (rows, columns) of a photograph: 255 where all counts are at their largest, as of a linear 8-bit camera."""
    return _luma(255 * camera.light_of(image))


def _luma(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float32)


def _spot_light(image: Image, camera: Camera | None) -> NDArray[np.float32]:
    """Light (rows, columns), in any unit, of an image whose background was taken off."""
    counts = _luma(image.astype(np.float32))
    return counts if camera is None else (255 * camera.light_of_difference(counts, image.dtype)).astype(np.float32)


def _gray(image: Image, camera: Camera) -> NDArray[np.uint8]:
    """Counts (rows, columns) in 8 bits: what people see, and where marks are looked for."""
    most = camera.most(image.dtype)
    counts = image if most == 255 else (image * np.uint32(255) // np.uint32(most)).astype(np.uint8)
    return np.asarray(counts if counts.ndim == 2 else cv2.cvtColor(counts, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _brightest(image: Image, camera: Camera) -> NDArray[np.uint8]:
    """The brightest channel: the first that the camera's range cuts off."""
    return _gray(image if image.ndim == 2 else image.max(axis=2), camera)


def _square(image: NDArray[Counts]) -> NDArray[Counts]:
    if image.shape == (CROP_SIZE, CROP_SIZE):
        return image
    return np.asarray(cv2.resize(image, (CROP_SIZE, CROP_SIZE), interpolation=cv2.INTER_AREA), dtype=image.dtype)


def _measure_crop(
    light: NDArray[np.float32],
    crop: NDArray[np.uint8],
    brightest: NDArray[np.uint8],
    plane: TargetPlane,
    empty: NDArray[np.float32] | None,
    corners: NDArray[np.float64] | None = None,
) -> MeasuredFlux:
    parts = separate(light, empty)
    if not parts.flux.any():
        return MeasuredFlux(refused("no_spot"), crop=crop, corners=corners)
    center, centered, outside = _centered(parts.flux, (plane.width, plane.height))
    clipped = brightest >= ceiling(brightest)
    quality = judge(parts, crop >= ceiling(crop), clipped, outside)
    if not quality.accepted:
        return MeasuredFlux(quality, crop=crop, corners=corners)
    # The flux was smoothed: what lies beside the plateau lost light to it.
    clipped = cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & parts.main
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
    """Where the camera's range had cut off the light of an image whose background was taken off, if it did.

    Such an image is stretched; only a pile of pixels below its top tells where the camera's range ended.
    """
    if camera is None:
        return None
    gray = _square(_gray(image, replace(camera, bits=None)))
    return gray >= ceiling(gray) if ceiling(gray) < SATURATED_GRAY else None


def _measure_flux(
    image: NDArray[np.float32], plane: TargetPlane, clipped: NDArray[np.bool_] | None = None
) -> MeasuredFlux:
    size = plane.width, plane.height
    # Area weights keep the energy whatever the image's size.
    flux = flux_window(image.astype(np.float64), size, window=size, resolution=CROP_SIZE)
    if not flux.any():
        return MeasuredFlux(refused("no_spot"))
    center, centered, outside = _centered(flux, size)
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
    _, centered, outside = _centered(flux, (side, side))
    main, foreign = find_spots(flux.astype(np.float32), noise=float(flux.max()) / 255)
    quality = judge_flux(flux, main, outside, float(flux[foreign].sum() / flux.sum()))
    return MeasuredFlux(quality, centered=centered) if quality.accepted else MeasuredFlux(quality)


def _centered(
    flux: NDArray[np.floating], size: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float32], float]:
    """Centre of mass (2,) [m], the normalised window about it, and the share of the energy that it leaves out."""
    center = center_of_mass(flux, size)
    cut = flux_window(flux, size, center)
    return center, _normalised(cut), max(0.0, 1.0 - float(cut.sum() / flux.sum(dtype=np.float64)))


def _normalised(flux: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(normalized(flux.astype(np.float64)), dtype=np.float32)
