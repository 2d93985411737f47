"""Measured flux images and their forecasts, cut alike, so that only their shapes are compared."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from model.covariates import slant_range
from model.effects import Effect, Stage, effect_to_json, effects_of_stage
from model.errors import InvalidInputError
from model.forecast import Aligned, View, align
from model.frames import SOLAR_DISC, sun_angles
from model.images import FLUX_SIZE, clipped_alike
from model.imaging.window import overlap_matrix
from model.metrics import accuracy_window
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.pointing.mounts import CalibratedMount
from model.pointing.spots import observe_angles
from model.progress import nothing_between
from model.setup import Setup
from model.study.noise import AROUND, black_lift, grain_variance, hot_pixels
from model.study.parameters import copied, copy_name
from model.study.position import USUAL_RAD, whiten

Array = NDArray[np.float64]

MIN_DISC = 10
"""Smallest number of pixels across the sun's disc with which nothing real looks like a spike."""

MIN_HOT = 1e-3
"""Share of the light below which hot and dead pixels remain."""


@dataclass(frozen=True, eq=False)
class FluxImage:
    """A measured flux image and the setup that it was taken in.

    Attributes
    ----------
    setup : Setup
        With the measured spot; ``setup.identifier`` is unique.
    image : (rows, columns)
        Over the whole target, row 0 at the top, in any unit.
    seen : bool
        Whether the mirror's surface was predicted from it: such a surface flatters its own
        photographs.
    is_estimated : bool
        Whether the mirror's surface is an estimate from photographs: what it leaves of their error
        is no effect's.
    clipped : bool (rows, columns) or None
        Saturated pixels, None if there are none.
    sheet_share : float [1]
        Share of the light that the pattern of the sheet behind the spot moves about
        (`model.imaging.Quality`).
    spot_std_rad : float [rad]
        Standard deviation per direction of its spot about the position that a correct model
        predicts. It is used if ``setup.angles`` gives the mount's angles (`model.study.position`).
    spot_shifts_rad : (2, K) [rad] or None
        Spot shifts, sidewards and upwards, by K independent deviations of the mount's calibration.
        The deviations are the same for all photographs of a heliostat.
    hot_share : float [1]
        Share of the light that hot and dead pixels had added or taken.
    """

    setup: Setup
    image: NDArray[np.floating]
    seen: bool = False
    is_estimated: bool = False
    clipped: NDArray[np.bool_] | None = None
    sheet_share: float = 0.0
    spot_std_rad: float = USUAL_RAD
    spot_shifts_rad: Array | None = None
    hot_share: float = 0.0

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or not np.isfinite(self.image).all() or not self.image.sum() > 0:
            raise InvalidInputError(
                f"photograph {self.key} must be a finite image that holds energy"
            )

    @property
    def key(self) -> str:
        """What names it in the report: ``H/ID``."""
        return self.setup.identifier

    @property
    def heliostat(self) -> str:
        """Name of the heliostat."""
        return self.setup.heliostat.name

    @property
    def taken_at(self) -> datetime | None:
        """When it was taken, with time zone, where that was recorded."""
        return self.setup.taken_at

    @property
    def elevation_deg(self) -> float:
        """Elevation [deg] of the sun."""
        return float(sun_angles(self.setup.sun)[1])

    @property
    def azimuth_deg(self) -> float:
        """Azimuth [deg] of the sun, from north over east."""
        return float(sun_angles(self.setup.sun)[0])

    @property
    def slant_range(self) -> float:
        """Distance [m] from the heliostat to its target."""
        return slant_range(self.setup)

    def sent(
        self, nominal: Heliostat, mount: CalibratedMount, motors: Array | None, day: float
    ) -> "FluxImage":
        """Add the axis angles of its motors (2,) [steps], if it is newer than the calibration of
        its mount.

        ``nominal`` has the mount of the heliostat's properties; ``day`` [d] is that of
        `model.pointing.Reading`.
        """
        spot = self.setup.spot
        if motors is None or spot is None or not mount.is_before(self.taken_at):
            return self
        observed = observe_angles(mount, nominal, motors, self.setup.sun, spot, day)
        setup = replace(self.setup, angles=observed.angles)
        return replace(
            self, setup=setup, spot_std_rad=observed.std_rad, spot_shifts_rad=observed.shared_rad
        )

    def noise_share(self, window: float) -> float:
        """The error that grain and sheet alone cause, in a cut of side ``window`` [m]."""
        images, planes = np.stack([self.image, black_lift(self.image)]), [self.setup.plane] * 2
        seen, lift = windows(
            images, planes, centers(images[:1], planes[:1]).repeat(2, axis=0), window, FLUX_SIZE
        )
        # A lift of the dark takes from the light's share of the sum.
        lifted = lift - seen * lift.sum() / seen.sum()
        grain = np.sqrt(2 / np.pi * grain_variance(seen))
        return float(np.hypot(np.hypot(lifted, grain).sum() / seen.sum(), self.sheet_share))


def without_hot_pixels(flux_images: Sequence[FluxImage]) -> list[FluxImage]:
    """Give hot and dead pixels of each target's camera the median of their surroundings.

    The sun's disc must cover many pixels. What has little light is left.
    """
    cameras: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for row, one in enumerate(flux_images):
        plane = one.setup.plane
        pixel = max(plane.height / one.image.shape[0], plane.width / one.image.shape[1])
        if 2 * SOLAR_DISC * one.slant_range >= MIN_DISC * pixel:
            cameras.setdefault((plane.name, one.image.shape), []).append(row)
    found = list(flux_images)
    for rows in cameras.values():
        hot = hot_pixels([found[row].image for row in rows])
        if not hot.any():
            continue
        for row in rows:
            image = found[row].image.astype(np.float64)
            repaired = np.where(hot, median_filter(image, AROUND), image)
            share = float(np.abs(repaired - image).sum() / image.sum())
            if share > MIN_HOT:
                found[row] = replace(found[row], image=repaired, hot_share=share)
    return found


def noise_floor(flux_images: Sequence[FluxImage], window: float) -> float:
    """The mean error that even the truth leaves, in cuts of side ``window`` [m]."""
    return float(np.mean([p.noise_share(window) for p in flux_images]))


def spot_window(flux_images: Sequence[FluxImage]) -> float:
    """Side [m] of the window that holds nearly all of every spot's energy."""
    sizes = [(p.setup.plane.width, p.setup.plane.height) for p in flux_images]
    return accuracy_window([p.image for p in flux_images], sizes)


def centers(images: NDArray[np.floating], planes: Sequence[TargetPlane]) -> Array:
    """Centres of mass (N, 2) [m] of images (N, rows, columns), right and down of the planes'
    centres.

    Raises
    ------
    InvalidInputError
        Where an image holds no energy.
    """
    across, along = (images.sum(axis=axis, dtype=np.float64) for axis in (1, 2))
    total = across.sum(axis=1)
    if not (total > 0).all():
        raise InvalidInputError("an image without energy has no centre of mass")
    shares = [
        line @ ((np.arange(line.shape[1]) + 0.5) / line.shape[1] - 0.5) / total
        for line in (across, along)
    ]
    return np.stack(shares, axis=1) * _sizes(planes)


def windows(
    images: NDArray[np.floating],
    planes: Sequence[TargetPlane],
    centers: Array,
    window: float,
    resolution: int,
) -> Array:
    """Energy (N, resolution, resolution) of images (N, rows, columns) in squares about ``centers``
    (N, 2) [m].

    As `model.imaging.window.flux_window`, for many images at once.
    """
    down, across = (
        overlap_matrix(
            np.linspace(-0.5, 0.5, images.shape[2 - axis] + 1) * _sizes(planes)[:, axis, None],
            centers[:, axis, None] + np.linspace(-window / 2, window / 2, resolution + 1),
        )
        for axis in (1, 0)
    )
    return np.asarray(down @ images @ across.transpose(0, 2, 1))


def _sizes(planes: Sequence[TargetPlane]) -> Array:
    """Widths and heights (N, 2) [m]."""
    return np.array([(plane.width, plane.height) for plane in planes])


def cut(
    images: NDArray[np.floating], planes: Sequence[TargetPlane], window: float, resolution: int
) -> Array:
    """Windows (N, resolution, resolution) of sum one about each image's own centre of mass.

    Position and exposure are free for every image (N, rows, columns), and this takes both out.
    """
    cuts = windows(images, planes, centers(images, planes), window, resolution)
    return np.asarray(cuts / cuts.sum(axis=(1, 2), keepdims=True))


def in_pixels(images: Array, rows: int, columns: int) -> Array:
    """Energy of images (N, R, C) in the pixels (rows, columns) of a camera, if it is coarser."""
    if images.shape[1] <= rows and images.shape[2] <= columns:
        return images
    down, across = (
        overlap_matrix(np.linspace(0, 1, size + 1), np.linspace(0, 1, min(size, count) + 1))
        for size, count in zip(images.shape[1:], (rows, columns), strict=True)
    )
    return np.asarray(down @ images @ across.T)


class AlignedFlux(NamedTuple):
    """Aligned setups and their flux (N, rows, columns) [W/m2]."""

    aligned: Aligned
    flux: torch.Tensor


class Saturated(NamedTuple):
    """Linear intensity of photographs and the saturated share of each pixel, (n, rows, columns)."""

    light: Array
    shares: Array


class SharedShifts(NamedTuple):
    """Rows (n,) of a heliostat's photographs, and their spot shifts (n, 2, K) by shared deviations.

    The shifts are in standard deviations of the spots.
    """

    rows: NDArray[np.intp]
    shifts: Array


def shared_shifts(flux_images: Sequence[FluxImage]) -> list[SharedShifts]:
    """List the spot shifts of each heliostat whose mount's calibration has shared deviations."""
    is_known = [p.setup.angles is not None and p.spot_shifts_rad is not None for p in flux_images]
    names = np.where(is_known, [p.heliostat for p in flux_images], "")
    found = []
    for name in sorted(set(names.tolist()) - {""}):
        rows = np.flatnonzero(names == name)
        some = [flux_images[row] for row in rows.tolist()]
        std = np.array([p.spot_std_rad for p in some])[:, None, None]
        found.append(SharedShifts(rows, np.array([p.spot_shifts_rad for p in some]) / std))
    return found


def saturated_pixels(flux_images: Sequence[FluxImage], rows: int, columns: int) -> Saturated:
    """Intensity and saturated shares of saturated photographs of one size, in (rows, columns)."""
    light, clipped = (
        np.concatenate(
            [in_pixels(np.asarray(image, np.float64)[None], rows, columns) for image in of]
        )
        for of in ([p.image for p in flux_images], [p.clipped for p in flux_images])
    )
    return Saturated(light, clipped / (flux_images[0].image.size / (rows * columns)))


class Forecaster:
    """Forecasts photographs under any effects, cut as the photographs are; caches the last flux."""

    def __init__(
        self,
        flux_images: Sequence[FluxImage],
        model: PlantModel,
        window: float,
        view: View,
        between: Callable[[], None] = nothing_between,
    ) -> None:
        self.flux_images, self.model, self.window, self.view = flux_images, model, window, view
        self.between = between
        self.setups = [p.setup for p in flux_images]
        self.planes = [setup.plane for setup in self.setups]
        self.spot_std_rad = np.array([p.spot_std_rad for p in flux_images])
        self.cameras = np.array([p.image.shape for p in flux_images])
        self._aligned: dict[str, Aligned] = {}
        self._flux: dict[str, torch.Tensor] = {}
        self._start: Aligned | None = None
        self._copies: dict[int, Forecaster] = {}
        self._measured: dict[int, Array] = {}
        self._saturated: dict[tuple[tuple[int, ...], int, int], Saturated] = {}
        self._different = len(self.flux_images)

    def copies(self, count: int) -> "Forecaster":
        """The same of photographs that are there ``count`` times, of heliostats that are copies of
        the first.

        What belongs to a heliostat may differ between copies; tracing them at once is several times
        faster than one by one.
        """
        if count not in self._copies:
            heliostats = {id(s.heliostat): s.heliostat for s in self.setups}
            flux_images = []
            for number in range(count):
                renamed = {
                    k: replace(h, name=copy_name(h.name, number)) for k, h in heliostats.items()
                }
                setups = [replace(s, heliostat=renamed[id(s.heliostat)]) for s in self.setups]
                flux_images += [
                    replace(p, setup=s) for s, p in zip(setups, self.flux_images, strict=True)
                ]
            model = replace(
                self.model, effects=tuple(copied(effect, count) for effect in self.model.effects)
            )
            self._copies[count] = Forecaster(
                flux_images, model, self.window, self.view, self.between
            )
            self._copies[count]._saturated = self._saturated
            self._copies[count]._different = self._different
        return self._copies[count]

    def forget(self) -> None:
        """Drop what only saves time if the next forecast resembles the last one."""
        self._aligned, self._flux, self._start, self._copies = {}, {}, None, {}

    def measured(self, resolution: int = FLUX_SIZE) -> Array:
        """The photographs' cuts (N, resolution, resolution)."""
        if resolution not in self._measured:
            cuts = [
                cut(p.image[None], [p.setup.plane], self.window, resolution)
                for p in self.flux_images
            ]
            self._measured[resolution] = np.concatenate(cuts)
        return self._measured[resolution]

    def cuts(self, effects: Sequence[Effect], resolution: int = FLUX_SIZE) -> Array:
        """The forecasts' cuts (N, resolution, resolution) under the declared effects and these.

        Raises
        ------
        UnreachableError
            Where effects on sun or mount leave a spot that no attitude reaches.
        InvalidInputError
            Where they leave no light.
        """
        aligned, flux = self._trace(self.model.with_effects(effects))
        with torch.no_grad():
            images = aligned.camera_images(flux, self.view).double().numpy().clip(min=0)
        cuts = np.empty((len(images), resolution, resolution))
        for camera in np.unique(self.cameras, axis=0):
            rows = np.flatnonzero((self.cameras == camera).all(axis=1))
            planes = [self.planes[row] for row in rows]
            cuts[rows] = cut(
                self._saturate(rows, in_pixels(images[rows], *camera)),
                planes,
                self.window,
                resolution,
            )
        return cuts

    def aligned(self, effects: Sequence[Effect]) -> Aligned:
        """The aligned setups under the declared effects and these. Raises as `cuts`."""
        return self._trace(self.model.with_effects(effects)).aligned

    def displaced(self, effects: Sequence[Effect]) -> Array:
        """How far spots lie (N, 2) [rad] from where motors sent them; NaN where that is unknown."""
        return self.aligned(effects).displacements

    def position_residuals(self, effects: Sequence[Effect]) -> Array:
        """The same (N, 2) in independent standard deviations (`model.study.position`)."""
        off = self.displaced(effects) / self.spot_std_rad[:, None]
        for rows, shifts in self._shared_shifts:
            off[rows] = whiten(off[rows], shifts)
        return np.asarray(off)

    @cached_property
    def _shared_shifts(self) -> list[SharedShifts]:
        return shared_shifts(self.flux_images)

    def _saturate(self, rows: NDArray[np.intp], forecasts: Array) -> Array:
        """Saturate forecasts (n, R, C) where the photographs ``rows`` (n,) are saturated."""
        places = [
            place
            for place, row in enumerate(rows.tolist())
            if self.flux_images[row].clipped is not None
        ]
        if not places:
            return forecasts
        # Copies of a photograph have the same saturated pixels.
        once = tuple(row for row in rows[places].tolist() if row < self._different)
        key = (once, forecasts.shape[1], forecasts.shape[2])
        if key not in self._saturated:
            self._saturated[key] = saturated_pixels(
                [self.flux_images[row] for row in once], *key[1:]
            )
        times = len(places) // len(once), 1, 1
        light, shares = (np.tile(values, times) for values in self._saturated[key])
        seen = forecasts.copy()
        seen[places] = clipped_alike(forecasts[places], light, shares)
        return seen

    def _trace(self, model: PlantModel) -> AlignedFlux:
        """Align and trace; both results are cached while only later stages change."""
        self.between()
        geometry = _name(model.effects, ("geometry",))
        if geometry not in self._aligned:
            # Fits take small steps, so the last alignment is a good start. Differences of their
            # forecasts need double precision.
            self._start = align(self.setups, model, dtype=torch.float64, start=self._start)
            self._aligned = {geometry: self._start}
            self._flux = {}
        aligned = replace(self._aligned[geometry], model=model)
        light = _name(model.effects, ("geometry", "optics"))
        if light not in self._flux:
            with torch.no_grad():
                self._flux = {light: aligned.flux(self.view)}
        return AlignedFlux(aligned, self._flux[light])


def _name(effects: Sequence[Effect], stages: tuple[Stage, ...]) -> str:
    return json.dumps([effect_to_json(effect) for effect in effects_of_stage(effects, *stages)])
