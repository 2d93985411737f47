"""Photographs and their forecasts, cut alike, so that only their shapes are compared."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from model.effects import JUELICH_LATITUDE, Effect, effect_to_json
from model.errors import InvalidInputError
from model.forecast import Aligned, Shot, View, align
from model.imaging.window import center_of_mass, flux_window
from model.metrics import compare_on_target
from model.plant import TargetPlane
from model.tracing import Optics

Array = NDArray[np.float64]

WINDOWS = (4.0, 6.0, 8.0, 12.0)
"""Sides [m] of the comparison's window: the paper's, unless more than `SPILL` of the energy lies outside."""

SPILL = 0.02

RESOLUTION = 64
"""Pixels a side of the window in which accuracy is counted (DESIGN.md, section 7)."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """A measured flux image and the shot it was taken of.

    Attributes
    ----------
    shot : Shot
        With the measured spot; ``shot.identifier`` is unique.
    image : (rows, columns)
        Over the whole target, row 0 at the top, in any unit.
    """

    shot: Shot
    image: NDArray[np.floating]

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or not np.isfinite(self.image).all() or not self.image.sum() > 0:
            raise InvalidInputError(f"photograph {self.key} must be a finite image that holds energy")

    @property
    def key(self) -> str:
        """What names it in the report: ``H/ID``."""
        return self.shot.identifier

    @property
    def heliostat(self) -> str:
        """Name of the heliostat."""
        return self.shot.heliostat.name

    @property
    def elevation_deg(self) -> float:
        """Elevation [deg] of the sun."""
        return float(np.degrees(np.arcsin(self.shot.sun[2])))

    @property
    def azimuth_deg(self) -> float:
        """Azimuth [deg] of the sun from south, positive to the east."""
        return float(np.degrees(np.arctan2(self.shot.sun[0], -self.shot.sun[1])))

    @property
    def slant_range(self) -> float:
        """Distance [m] from the heliostat to its target."""
        return float(np.linalg.norm(self.shot.heliostat.position - self.shot.plane.center))

    def noise_share(self, window: float) -> float:
        """The error (one minus accuracy) that this image's noise alone makes, by the grain of its own cut.

        In the cut, because pixels of a camera that was resampled share their noise.
        """
        (image,) = cut([self.image], [self.shot.plane], window, RESOLUTION)
        return float(np.sqrt(2 / np.pi) * np.sqrt(noise_variance(image)).sum())


def noise_variance(image: Array, bins: int = 12) -> Array:
    """Variance of each pixel's noise (rows, columns), a line in its intensity: read noise, rounding and counting.

    A mask that no plane and no slope answers leaves the grain (Immerkaer 1996, doi:10.1006/cviu.1996.0060).
    """
    lines = image[:-2] - 2 * image[1:-1] + image[2:]
    grain = ((lines[:, :-2] - 2 * lines[:, 1:-1] + lines[:, 2:]) / 6) ** 2
    inner = image[1:-1, 1:-1]
    parts = np.array_split(np.argsort(inner, axis=None), bins)
    levels = np.array([inner.ravel()[part].mean() for part in parts])
    variances = np.array([grain.ravel()[part].mean() for part in parts])
    slope, offset = np.polyfit(levels, variances, 1)
    return np.asarray(np.clip(offset + slope * image, variances.min(), variances.max()))


def spot_window(photographs: Sequence[Photograph]) -> float:
    """Side [m] of the window that holds nearly all of every spot's energy."""
    for window in WINDOWS:
        outside = [
            compare_on_target(p.image, p.image, (p.shot.plane.width, p.shot.plane.height), window).measured_outside
            for p in photographs
        ]
        if np.median(outside) <= SPILL:
            return window
    return WINDOWS[-1]


def cut(images: Sequence[NDArray[np.floating]], planes: Sequence[TargetPlane], window: float, resolution: int) -> Array:
    """Windows (N, resolution, resolution) of sum one about each image's own centre of mass.

    Position and exposure are free for every image, and this takes both out.
    """
    cuts = np.empty((len(images), resolution, resolution))
    for index, (image, plane) in enumerate(zip(images, planes, strict=True)):
        size = (plane.width, plane.height)
        cuts[index] = flux_window(image, size, center_of_mass(image, size), window, resolution)
    return np.asarray(cuts / cuts.sum(axis=(1, 2), keepdims=True))


class Forecaster:
    """Forecasts of photographs under any effects, cut as the photographs are; remembers what it has just aligned."""

    def __init__(
        self,
        photographs: Sequence[Photograph],
        optics: Optics,
        declared: Sequence[Effect],
        window: float,
        view: View,
        latitude_deg: float = JUELICH_LATITUDE,
    ) -> None:
        self.photographs, self.optics, self.declared = photographs, optics, list(declared)
        self.window, self.view, self.latitude_deg = window, view, latitude_deg
        self.shots = [p.shot for p in photographs]
        self.planes = [shot.plane for shot in self.shots]
        self._aligned: dict[str, Aligned] = {}
        self._flux: dict[str, torch.Tensor] = {}
        self._start: Aligned | None = None

    def measured(self, resolution: int = RESOLUTION) -> Array:
        """The photographs' cuts (N, resolution, resolution)."""
        return cut([p.image for p in self.photographs], self.planes, self.window, resolution)

    def cuts(self, effects: Sequence[Effect], resolution: int = RESOLUTION) -> Array:
        """The forecasts' cuts (N, resolution, resolution) under the declared effects and these.

        Raises
        ------
        UnreachableError
            Where effects on sun or mount leave a spot that no attitude reaches.
        """
        model = [*self.declared, *effects]
        aligned, flux = self._traced(model)
        with torch.no_grad():
            images = aligned.photographs(flux, model, self.view).double().numpy()
        return cut(list(images.clip(min=0)), self.planes, self.window, resolution)

    def _traced(self, model: Sequence[Effect]) -> tuple[Aligned, torch.Tensor]:
        """Aligned shots and their flux; both are kept while only later stages change."""
        geometry = _name(model, ("geometry",))
        if geometry not in self._aligned:
            fresh = align(self.shots, model, latitude_deg=self.latitude_deg, start=self._start)
            self._start = self._start or fresh
            self._aligned = {geometry: fresh}
            self._flux = {}
        light = _name(model, ("geometry", "optics"))
        if light not in self._flux:
            with torch.no_grad():
                self._flux = {light: self._aligned[geometry].flux(self.optics, model, self.view)}
        return self._aligned[geometry], self._flux[light]


def _name(effects: Sequence[Effect], stages: tuple[str, ...]) -> str:
    return json.dumps([effect_to_json(effect) for effect in effects if effect.stage in stages])
