"""From a photograph to a measured flux: find, rectify, separate, centre, crop, normalise, judge."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ImageRefusedError, InvalidInputError
from model.images import FLUX_WINDOW, normalized
from model.imaging.quality import SATURATED_GRAY, Quality, judge, judge_flux, refused
from model.imaging.rectify import BRACKETS, CROP_SIZE, Layout, check_corners, find_corners, rectify
from model.imaging.separate import find_spots, separate
from model.imaging.window import center_of_mass, flux_window
from model.plant import TargetPlane

ImageKind = Literal["raw", "cropped", "flux", "flux-centered"]


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
    """

    quality: Quality
    flux: NDArray[np.float32] | None = None
    centered: NDArray[np.float32] | None = None
    center_of_mass: NDArray[np.float64] | None = None
    window: float = FLUX_WINDOW
    crop: NDArray[np.uint8] | None = None
    corners: NDArray[np.float64] | None = None


def measure(
    image: NDArray[np.uint8],
    kind: ImageKind,
    plane: TargetPlane,
    *,
    layouts: Sequence[Layout] = (BRACKETS,),
    side: float | None = None,
    corners: ArrayLike | None = None,
    empty: NDArray[np.uint8] | None = None,
) -> MeasuredFlux:
    """The flux on a target, from any kind of image.

    Parameters
    ----------
    image : uint8 (rows, columns) or (rows, columns, 3) in RGB
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
    empty : uint8 (256, 256), optional
        A rectified image of the same target without light.

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
        return _measure_centered(_gray(image), side)
    if kind == "flux":
        return _measure_flux(_gray(image), plane)
    if kind == "cropped":
        return _measure_crop(_square(_gray(image)), _square(_brightest(image)), plane, empty)
    try:
        found = find_corners(_gray(image), plane, layouts) if corners is None else check_corners(corners)
    except ImageRefusedError as refusal:
        return MeasuredFlux(refused(refusal.reason, refusal.detail))
    return _measure_crop(rectify(_gray(image), found), rectify(_brightest(image), found), plane, empty, found)


def _check(image: NDArray[np.uint8], kind: str) -> None:
    if kind not in get_args(ImageKind):
        raise InvalidInputError(f"kind must be one of {', '.join(get_args(ImageKind))}, got {kind!r}")
    shape_fits = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not shape_fits or min(image.shape[:2]) < 16:
        raise InvalidInputError(
            f"image must be uint8, (rows, columns) or (rows, columns, 3), at least 16 pixels wide and high; "
            f"got {image.dtype} {image.shape}"
        )


def _gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _brightest(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The brightest channel: the first that the camera's range cuts off."""
    return image if image.ndim == 2 else np.asarray(image.max(axis=2), dtype=np.uint8)


def _square(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if image.shape == (CROP_SIZE, CROP_SIZE):
        return image
    return np.asarray(cv2.resize(image, (CROP_SIZE, CROP_SIZE), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _measure_crop(
    crop: NDArray[np.uint8],
    brightest: NDArray[np.uint8],
    plane: TargetPlane,
    empty: NDArray[np.uint8] | None,
    corners: NDArray[np.float64] | None = None,
) -> MeasuredFlux:
    parts = separate(crop, None if empty is None else _square(_gray(empty)))
    if not parts.flux.any():
        return MeasuredFlux(refused("no_spot"), crop=crop, corners=corners)
    center, centered, outside = _centered(parts.flux, (plane.width, plane.height))
    quality = judge(parts, crop >= SATURATED_GRAY, brightest >= SATURATED_GRAY, outside)
    if not quality.accepted:
        return MeasuredFlux(quality, crop=crop, corners=corners)
    return MeasuredFlux(quality, _normalised(parts.flux), centered, center, crop=crop, corners=corners)


def _measure_flux(image: NDArray[np.uint8], plane: TargetPlane) -> MeasuredFlux:
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
    return MeasuredFlux(quality, _normalised(flux), centered, center)


def _measure_centered(image: NDArray[np.uint8], side: float) -> MeasuredFlux:
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
