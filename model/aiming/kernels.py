"""One flux image for each mirror, and where each of its aims lights a receiver.

A mirror's image lies on the plane that touches the receiver toward it, as in
`model.tracing.superposition`. Another aim moves the image on that plane. It is then projected to
the receiver's map. So one trace of the field is enough for all aims.

Approximation: the image does not change with the aim. The mirror turns by half the angle between
two aims, some hundredths of a radian, which changes the image far less than its width.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample, pad
from torch.utils.checkpoint import checkpoint

from model.errors import InvalidInputError, ModelError
from model.fleet import Superposition, Tile, in_parts
from model.plant import Receiver, SurfaceGrid, TouchingPlanes, inside_outline
from model.setup import Setup
from model.sunshape import half_angle
from model.tracing import Optics, Scene, Window
from model.tracing.convolution import Rays, central_rays, raster, splat
from model.tracing.scene import irradiance_of, optics_of
from model.tracing.superposition import in_sight, passages

Array = NDArray[np.float64]

SIZE = 64
"""Pixels along each side of a mirror's image in a field of up to `MANY` mirrors."""

MANY = 12_000
"""Mirrors above which images have half as many pixels along a side, for the memory."""

# An image reaches to this share of the sun's light, and so many standard deviations of the errors.
_CONE_SHARE, _DEVIATIONS = 0.98, 3.0

_PADDING = 0.1

MAX_PAIRS = 49_000_000
"""Heliostats times pixels of a plan, each of 16 bytes; two images are as large as some pairs."""

LARGE_PAIRS = 8_000_000
"""Pairs above which a machine should make one plan at a time."""

_SAVED = 2**23
"""Pairs above which intermediate values are computed again for gradients."""

_PART = 2**20
"""Pairs of mirrors and pixels that are computed at once."""


def image_size(heliostats: int) -> int:
    """Pixels along each side of a mirror's image in a field of so many heliostats."""
    return SIZE if heliostats <= MANY else SIZE // 2


def require_few_pairs(heliostats: int, resolution: tuple[int, int]) -> None:
    """Refuse a map of (rows, columns) that has too many pixels for so many heliostats.

    Raises
    ------
    InvalidInputError
        If there are more than `MAX_PAIRS`; the message names the field and the remedy.
    """
    rows, columns = resolution
    most = max(MAX_PAIRS // max(heliostats, 1) - image_size(heliostats) ** 2 // 2, 0)
    if rows * columns > most:
        raise InvalidInputError(
            f"resolution: {rows} x {columns} pixels for each of {heliostats} heliostats are more"
            f" than the {most} that a plan of aims has of so many; give fewer rows and columns,"
            " and trace the field with the aims for a finer map"
        )


@dataclass(frozen=True, eq=False)
class MirrorImages:
    """Images of N mirrors about their aims.

    Attributes
    ----------
    names : tuple of N str
    expected : Tensor (N, S, S) [W/m2]
        Spread by the pointing errors, row 0 at the top.
    sharp : Tensor (N, S, S) [W/m2]
        Without pointing errors.
    sides : Tensor (N,) [m]
        Of the images.
    aims : Tensor (N, 3) [m]
        Middles of the images in ENU, where the beams' middles meet the touching planes.
    mirrors : Tensor (N, 3) [m]
        Middles of the mirrors in ENU.
    axes : Tensor (N, 3, 3)
        Right, up and normal of these planes as rows.
    spread : Tensor (N, 2, 2) [m]
        Cholesky factors of the covariances of the pointing errors on the planes, right and up.
    power : Tensor (N,) [W]
        Of the beams.
    """

    names: tuple[str, ...]
    expected: Tensor
    sharp: Tensor
    sides: Tensor
    aims: Tensor
    mirrors: Tensor
    axes: Tensor
    spread: Tensor
    power: Tensor

    def __len__(self) -> int:
        return len(self.names)

    @property
    def size(self) -> int:
        """Pixels S along each side of the images."""
        return self.expected.shape[-1]

    @classmethod
    def join(cls, parts: Iterable["MirrorImages"], most: int) -> "MirrorImages | None":
        """The images of several tiles, copied one after another; None without any.

        ``most`` is the largest number of mirrors that they can have together.
        """
        names, whole = list[str](), dict[str, Tensor]()
        for part in parts:
            rows = slice(len(names), len(names) + len(part))
            for name in _OF_MIRRORS:
                of_part = getattr(part, name)
                whole.setdefault(name, of_part.new_empty(most, *of_part.shape[1:]))[rows] = of_part
            names += part.names
        kept = {name: tensor[: len(names)] for name, tensor in whole.items()}
        return cls(tuple(names), **kept) if names else None

    def on_map(self, receiver: Receiver, resolution: tuple[int, int]) -> "Kernels":
        """Find the pixels of a receiver's map of (rows, columns) that each mirror can light."""
        grid = receiver.grid(*resolution)
        most = max(1, *(int(part.n_lit().max()) for part in _passed(self, receiver, grid)))
        is_whole = most == grid.areas.size
        parts = (part.lit(most) for part in _passed(self, receiver, grid))
        lit = _filled(parts, len(self), most, is_whole)
        areas = torch.tensor(grid.areas.reshape(-1), dtype=torch.float32)
        images = {field.name: getattr(self, field.name) for field in fields(self)}
        return Kernels(
            **images, **lit._asdict(), areas=areas, resolution=resolution, is_whole=is_whole
        )


_OF_MIRRORS = tuple(field.name for field in fields(MirrorImages) if field.name != "names")


@dataclass(frozen=True, eq=False)
class Kernels(MirrorImages):
    """Images of N mirrors about their aims, and the places of a map that each can light.

    Attributes
    ----------
    places : Tensor (N, 2, M)
        Where the light of a map's pixel passes the plane, right and down of the image's middle, in
        halves of the image's side. All x of a mirror are in one row, which is twice as fast as
        pairs.
    factors : Tensor (N, M)
        Irradiance of the pixel, relative to that on the plane.
    pixels : Tensor (N, M) of int32
        Indices into the flattened map.
    areas : Tensor (P,) [m2]
        Of the map's pixels.
    resolution : (rows, columns)
        Of the map, P = rows * columns.
    is_whole : bool
        Whether a mirror lights all pixels. Then all have all of them, in the map's order.
    """

    places: Tensor
    factors: Tensor
    pixels: Tensor
    areas: Tensor
    resolution: tuple[int, int]
    is_whole: bool

    def flux(
        self, moved: Tensor, weights: Tensor | None = None, *, is_sharp: bool = False
    ) -> Tensor:
        """Map (P,) [W/m2] of aims ``moved`` (N, 2) [m] right and up on the touching planes.

        ``weights`` (N,) are 0 for mirrors that are not active. Differentiable.
        """
        total = moved.new_zeros(len(self.areas))
        is_saved = self.pixels.numel() <= _SAVED or not moved.requires_grad
        for part, rows in self.parts():
            light = partial(part.light, is_sharp=is_sharp)
            if is_saved:
                values = light(moved[rows])
            else:
                values = checkpoint(light, moved[rows], use_reentrant=False)
            if weights is not None:
                values = values * weights[rows, None]
            if self.is_whole:
                total = total + values.sum(dim=0)
            else:
                total = total.index_add(0, part.pixels.flatten(), values.flatten())
        return total

    def light(self, moved: Tensor, *, is_sharp: bool = False) -> Tensor:
        """Irradiance (N, M) [W/m2] of each mirror in the pixels that it can light."""
        images = self.sharp if is_sharp else self.expected
        scale = 2 / self.sides[:, None]
        shift = moved * torch.cat([scale, -scale], dim=1)
        seen = grid_sample(
            images[:, None],
            (self.places - shift[:, :, None]).transpose(1, 2)[:, None],
            padding_mode="zeros",
            align_corners=False,
        )
        light: Tensor = seen[:, 0, 0] * self.factors
        return light

    def parts(self, most: int = _PART) -> "Iterator[tuple[Kernels, slice]]":
        """At ``most`` so many mirrors at a time, fewer if each lights many pixels, as views."""
        step = max(1, min(most, _PART // self.pixels.shape[1]))
        for start in range(0, len(self), step):
            rows = slice(start, min(start + step, len(self)))
            names = "names", *_OF_MIRRORS, *_Lit._fields
            some: dict[str, Any] = {name: getattr(self, name)[rows] for name in names}
            yield replace(self, **some), rows

    def points(self, moved: Tensor) -> Array:
        """Aim points (N, 3) [m] in ENU of ``moved`` (N, 2) [m]."""
        return np.asarray(
            (self.aims + torch.einsum("ni,nij->nj", moved, self.axes[:, :2])).double().numpy()
        )

    def moved(self, points: Array) -> Tensor:
        """Right and up (N, 2) [m] of aim points (N, 3) [m] in ENU.

        It is where the mirrors' middle rays to these points meet the planes.
        """
        mirrors, aims, axes = (a.double().numpy() for a in (self.mirrors, self.aims, self.axes))
        return torch.tensor(_through(points, mirrors, aims, axes)).to(self.aims)

    def on_pixels(self, kept: Tensor) -> "Kernels":
        """The same images on pixels ``kept`` (K,) of the map, whose resolution stays."""
        areas = self.areas[kept]
        if self.is_whole:
            places, factors = self.places[:, :, kept], self.factors[:, kept]
            pixels = self.pixels[:, : len(kept)]
            return replace(self, places=places, factors=factors, pixels=pixels, areas=areas)
        number = torch.full((len(self.areas),), -1, dtype=torch.int32)
        number[kept] = torch.arange(len(kept), dtype=torch.int32)
        most = max(1, *(int(part._is_lit(number).sum(dim=1).max()) for part, _ in self.parts()))
        parts = (part._numbered(number, most) for part, _ in self.parts())
        lit = _filled(parts, len(self), most)
        return replace(self, **lit._asdict(), areas=areas)

    def _is_lit(self, number: Tensor) -> Tensor:
        """Whether mirrors light their pixels (N, M), and these have a new number."""
        return (number[self.pixels] >= 0) & (self.factors > 0)

    def _numbered(self, number: Tensor, count: int) -> "_Lit":
        """Of each mirror the lit pixels that have a new number, one after another."""
        mirror, source = self._is_lit(number).nonzero(as_tuple=True)
        counts = torch.bincount(mirror, minlength=len(self))
        place = torch.arange(len(mirror)) - (counts.cumsum(0) - counts)[mirror]

        def chosen(values: Tensor) -> Tensor:
            some = values.new_zeros(*values.shape[:-1], count)
            some[mirror, ..., place] = values[mirror, ..., source]
            return some

        return _Lit(chosen(self.places), chosen(self.factors), chosen(number[self.pixels]))

    def thinned(self) -> "Thinned":
        """The same images with one pixel of each two by two, in turn each of the four."""
        rows, columns = self.resolution
        row, column = torch.arange(rows)[:, None], torch.arange(columns)[None]
        down, right = row // 2, column // 2
        kept_row = (2 * down + (down + right) % 2).clamp(max=rows - 1)
        kept_column = (2 * right + down % 2).clamp(max=columns - 1)
        kept, block = torch.unique(kept_row * columns + kept_column, return_inverse=True)
        block = block.flatten()
        areas = torch.zeros(len(kept)).index_add(0, block, self.areas)
        return Thinned(replace(self.on_pixels(kept), areas=areas), block)


@dataclass(frozen=True, eq=False)
class Thinned:
    """Kernels on fewer pixels, and by which of them (P,) each pixel of the whole map is replaced.

    The resolution is still that of the whole map.
    """

    kernels: Kernels
    block: Tensor


class _Lit(NamedTuple):
    """What of a map mirrors can light, as of `Kernels`."""

    places: Tensor
    factors: Tensor
    pixels: Tensor


@dataclass(frozen=True, eq=False)
class ImageTile:
    """The images of a tile, and why some of its mirrors have none."""

    images: list[MirrorImages]
    skipped: dict[str, str]


class _Images(NamedTuple):
    """Images (B, S, S) [W/m2] with and without pointing errors, and their sides [m]."""

    expected: Tensor
    sharp: Tensor
    side: float


@dataclass(frozen=True, eq=False)
class ImageTracer:
    """The task of each tile; calling it with a tile traces the images of its mirrors.

    Attributes
    ----------
    field : Superposition
        What is traced; its resolution does not matter.
    mirrors : int
        Of the whole field, by which `image_size` goes.
    """

    field: Superposition
    mirrors: int

    def __call__(self, tile: Tile) -> ImageTile:
        """Trace the mirrors of a tile, and skip those that cannot reach the receiver."""
        found: list[MirrorImages] = []
        skipped: dict[str, str] = {}
        for part, made in in_parts(self._trace, tile):
            if isinstance(made, ModelError):
                skipped[part.setups[0].heliostat.name] = str(made)
            else:
                found += made
        return ImageTile(found, skipped)

    def _trace(self, tile: Tile) -> list[MirrorImages]:
        with torch.no_grad():
            return [self._images(*lit) for lit in self.field.scenes(tile)]

    def _images(self, setups: Sequence[Setup], scene: Scene, optics: Optics) -> MirrorImages:
        self.field.between()
        receiver = self.field.receiver
        mirrors = scene.center.double().numpy()
        planes = receiver.touching(mirrors)
        goals = np.array([setup.goal for setup in setups])
        middles = _through(goals, mirrors, planes.centers, planes.axes)
        scene = scene.with_(
            plane_center=torch.tensor(planes.centers).to(scene.sun),
            plane_axes=torch.tensor(planes.axes).to(scene.sun),
        )
        optics = optics_of(scene, optics)
        rays = central_rays(scene, self.field.samples)
        places, size = torch.tensor(middles).to(scene.sun), image_size(self.mirrors)
        images = _images(rays, places, scene, optics, max(planes.size), size)
        aims = planes.centers + np.einsum("bi,bij->bj", middles, planes.axes[:, :2])
        single = torch.float32
        return MirrorImages(
            names=tuple(setup.heliostat.name for setup in setups),
            expected=images.expected.to(single),
            sharp=images.sharp.to(single),
            sides=torch.full((len(setups),), images.side, dtype=single),
            aims=torch.tensor(aims, dtype=single),
            mirrors=torch.tensor(mirrors, dtype=single),
            axes=torch.tensor(planes.axes, dtype=single),
            spread=_spread(rays, optics).to(single),
            power=(rays.power.sum(-1) * irradiance_of(scene, optics, rays.slant_range)).to(single),
        )


def _through(points: Array, mirrors: Array, origins: Array, axes: Array) -> Array:
    """Where lines from mirrors (B, 3) to points (B, 3) meet planes: right and up (B, 2) [m] of
    their origins (B, 3).
    """
    start = np.einsum("bij,bj->bi", axes, mirrors - origins)
    way = np.einsum("bij,bj->bi", axes, points - mirrors)
    if (way[:, 2] >= 0).any():
        raise InvalidInputError("an aim lies behind its mirror as seen from the receiver; move it")
    return np.asarray(start[:, :2] - (start[:, 2] / way[:, 2])[:, None] * way[:, :2])


def _images(
    rays: Rays, middles: Tensor, scene: Scene, optics: Optics, width: float, size: int
) -> _Images:
    """Images of ``size`` pixels a side, in windows about ``middles`` (B, 2) [m] that hold nearly
    all light which a receiver of this ``width`` [m] can get.
    """
    errors = math.hypot(
        2 * float(torch.as_tensor(optics.slope_error).max()),
        float(torch.as_tensor(optics.pointing_error).max()),
        float(torch.as_tensor(optics.tracking_jitter).max()),
    )
    cone = half_angle(optics.sun_shape, _CONE_SHARE) + _DEVIATIONS * errors
    blur = float((rays.slant_range * cone / -rays.direction[:, 2].clamp(max=-0.25)).max())
    mirror = float((rays.hits - middles[:, :, None]).abs().max())
    # Light further from an aim than the receiver's size is lost, wherever the aim is on it.
    side = 2 * min(blur + mirror, width)
    window = Window(side, side, size, size)
    irradiance = irradiance_of(scene, optics, rays.slant_range)
    expected, sharp = (
        grid.blurred(splat(grid.x, grid.y, grid.weight, *grid.shape)).clamp(min=0)
        for grid in (
            raster(rays, middles, window, some, irradiance, (_PADDING, _PADDING))
            for some in (optics, replace(optics, pointing_error=0.0))
        )
    )
    if size < SIZE:
        expected, sharp = _sharpened(expected), _sharpened(sharp)
    return _Images(expected, sharp, side)


def _sharpened(images: Tensor) -> Tensor:
    """Images (B, S, S) less the blur of the interpolation between their pixels.

    Its variance is a sixth of a pixel's square.
    """
    wide = pad(images, (1, 1, 1, 1))
    rows, columns = wide[:, :, 1:-1], wide[:, 1:-1]
    around = rows[:, 2:] + rows[:, :-2] + columns[..., 2:] + columns[..., :-2]
    return (images - (around - 4 * images) / 12).clamp(min=0)


def _spread(rays: Rays, optics: Optics) -> Tensor:
    """Cholesky factors (B, 2, 2) [m] of the pointing errors' covariances on the planes.

    A beam of direction d that turns by a small angle about any axis moves by the slant range times
    ``I + d_xy d_xy^T / d_z^2`` in variance.
    """
    across = rays.direction[:, :2] / rays.direction[:, 2:]
    variance = torch.eye(2).to(across) + across[:, :, None] * across[:, None, :]
    sigma = torch.as_tensor(optics.pointing_error).to(across) * rays.slant_range
    factor: Tensor = torch.linalg.cholesky(variance) * sigma[:, None, None]
    return factor


class _Passed(NamedTuple):
    """Where light of a few mirrors to all pixels passes their planes.

    Attributes
    ----------
    places : float32 (B, 2, P)
        Right and down of the images' middles, in halves of their sides.
    factors : float32 (B, P)
        As of `Kernels`.
    """

    places: NDArray[np.float32]
    factors: NDArray[np.float32]

    def n_lit(self) -> NDArray[np.int64]:
        """Number of pixels (B,) that each mirror lights."""
        return np.asarray((self.factors > 0).sum(axis=1))

    def lit(self, count: int) -> _Lit:
        """Those pixels, before others that a mirror does not light, ``count`` of each mirror.

        All pixels stay in their order.
        """
        if count == self.factors.shape[1]:
            pixels = np.arange(count)
            return _Lit(*(torch.tensor(one) for one in (self.places, self.factors, pixels)))
        chosen = np.argsort(self.factors <= 0, axis=1, kind="stable")[:, :count]
        places = np.take_along_axis(self.places, chosen[:, None], axis=2)
        factors = np.take_along_axis(self.factors, chosen, axis=1)
        return _Lit(*(torch.tensor(one) for one in (places, factors, chosen)))


def _passed(images: MirrorImages, receiver: Receiver, grid: SurfaceGrid) -> Iterator[_Passed]:
    """Follow light from a few mirrors at a time to all pixels."""
    most = _PART // 8
    step, n_rows = max(1, most // grid.areas.size), max(1, most // grid.areas.shape[1])
    bands = [
        SurfaceGrid(*(of_map[start : start + n_rows] for of_map in grid))
        for start in range(0, len(grid.areas), n_rows)
    ]
    for start in range(0, len(images), step):
        rows = slice(start, start + step)
        axes, mirrors, aims, sides = (
            getattr(images, name)[rows].double().numpy()
            for name in ("axes", "mirrors", "aims", "sides")
        )
        planes = replace(receiver.touching(mirrors), axes=axes)
        parts = [_passed_to(band, mirrors, aims, planes) for band in bands]
        places, factors = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
        places *= 2 / sides[:, None, None] * [[1], [-1]]
        yield _Passed(places, factors)


def _passed_to(band: SurfaceGrid, mirrors: Array, aims: Array, planes: TouchingPlanes) -> _Passed:
    """Follow light from mirrors (B, 3) to part of the pixels; places are in metres."""
    given = (mirrors, aims, planes.axes, band.points, band.normals)
    passed = passages(*(torch.tensor(one) for one in given))
    places = torch.stack([passed.right, passed.up], dim=1).flatten(2).numpy()
    factors = passed.gain.flatten(1).numpy() * _open(planes, places, aims, mirrors, band)
    return _Passed(places.astype(np.float32), factors.astype(np.float32))


def _filled(parts: Iterable[_Lit], mirrors: int, count: int, is_whole: bool = False) -> _Lit:
    """Join the pixels of a few mirrors at a time, ``count`` of each mirror, in single precision.

    If it ``is_whole``, one row of pixels serves all mirrors.
    """
    places, factors = torch.zeros(mirrors, 2, count), torch.zeros(mirrors, count)
    pixels = torch.arange(count, dtype=torch.int32).repeat(1 if is_whole else mirrors, 1)
    start = 0
    for part in parts:
        rows = slice(start, start + len(part.factors))
        places[rows], factors[rows] = part.places, part.factors
        if not is_whole:
            pixels[rows] = part.pixels
        start = rows.stop
    return _Lit(places, factors, pixels.expand(mirrors, -1))


def _open(
    planes: TouchingPlanes, places: Array, aims: Array, mirrors: Array, grid: SurfaceGrid
) -> Array:
    """Share (B, P) of light that passes an aperture and no screen hides."""
    share = np.ones((len(places), places.shape[-1]))
    if planes.outline is not None:
        origin = np.einsum("bij,bj->bi", planes.axes, aims - planes.centers)[:, :2, None]
        x, y = np.moveaxis(places + origin, 1, 0)
        share *= inside_outline(x, y, planes.outline)
    if planes.screens is not None:
        seen = in_sight(planes.screens, torch.tensor(mirrors), grid)
        share *= seen.double().numpy().reshape(share.shape)
    return share
