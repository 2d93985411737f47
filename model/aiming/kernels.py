"""One flux image for each mirror, and where each of its aims lights a receiver.

A mirror's image lies on the plane that touches the receiver toward it, as in
`model.tracing.superposition`. Another aim moves the image on that plane. It is then projected to
the receiver's map. So one trace of the field is enough for all aims.

Approximation: the image does not change with the aim. The mirror turns by half the angle between
two aims, some hundredths of a radian, which changes the image far less than its width.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from model.errors import InvalidInputError, ModelError, UnreachableError
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
"""Pixels along each side of a mirror's image."""

# An image reaches to this share of the sun's light, and so many standard deviations of the errors.
_CONE_SHARE, _DEVIATIONS = 0.98, 3.0

_PADDING = 0.1


@dataclass(frozen=True, eq=False)
class Kernels:
    """Images of N mirrors about their aims, and the places of a map that each can light.

    Attributes
    ----------
    names : tuple of N str
    expected : Tensor (N, SIZE, SIZE) [W/m2]
        Spread by the pointing errors, row 0 at the top.
    sharp : Tensor (N, SIZE, SIZE) [W/m2]
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
    places : Tensor (N, M, 2) [m]
        Where the light of a map's pixel passes the plane, right and up of the image's middle.
    factors : Tensor (N, M)
        Irradiance of the pixel, relative to that on the plane.
    pixels : Tensor (N, M)
        Indices into the flattened map.
    areas : Tensor (P,) [m2]
        Of the map's pixels.
    resolution : (rows, columns)
        Of the map, P = rows * columns.
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
    places: Tensor
    factors: Tensor
    pixels: Tensor
    areas: Tensor
    resolution: tuple[int, int]

    def __len__(self) -> int:
        return len(self.names)

    def flux(
        self, moved: Tensor, weights: Tensor | None = None, *, is_sharp: bool = False
    ) -> Tensor:
        """Map (P,) [W/m2] of aims ``moved`` (N, 2) [m] right and up on the touching planes.

        ``weights`` (N,) are 0 for mirrors that are not active. Differentiable.
        """
        values = self.light(moved, is_sharp=is_sharp)
        if weights is not None:
            values = values * weights[:, None]
        total: Tensor = values.new_zeros(len(self.areas)).index_add(
            0, self.pixels.flatten(), values.flatten()
        )
        return total

    def light(self, moved: Tensor, *, is_sharp: bool = False) -> Tensor:
        """Irradiance (N, M) [W/m2] of each mirror in the pixels that it can light."""
        images = self.sharp if is_sharp else self.expected
        grid = self._grid - (moved * self._scale)[:, :, None]
        seen = grid_sample(
            images[:, None],
            grid.transpose(1, 2)[:, None],
            padding_mode="zeros",
            align_corners=False,
        )
        light: Tensor = seen[:, 0, 0] * self.factors
        return light

    @property
    def _scale(self) -> Tensor:
        """What right and up [m] are relative to half of the images, which begin at the top."""
        scale = 2 / self.sides
        return torch.stack([scale, -scale], dim=-1)

    @cached_property
    def _grid(self) -> Tensor:
        """The places (N, 2, M) in halves of the images; all x of a mirror are in one row, which is
        twice as fast as pairs.
        """
        return (self.places * self._scale[:, None]).transpose(1, 2).contiguous()

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

    def subset(self, rows: Sequence[int] | Tensor) -> "Kernels":
        """Some of the mirrors."""
        index = torch.as_tensor(rows, dtype=torch.long)
        kept: dict[str, Any] = {name: getattr(self, name)[index] for name in _OF_MIRRORS}
        return replace(self, names=tuple(self.names[row] for row in index.tolist()), **kept)

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
        number = torch.full((rows * columns,), -1)
        number[kept] = torch.arange(len(kept))
        # Of each mirror the pixels that remain and that it lights, one after another.
        pixels = number[self.pixels]
        mirror, source = ((pixels >= 0) & (self.factors > 0)).nonzero(as_tuple=True)
        counts = torch.bincount(mirror, minlength=len(self))
        place = torch.arange(len(mirror)) - (counts.cumsum(0) - counts)[mirror]
        count = max(1, int(counts.max()))

        def chosen(values: Tensor) -> Tensor:
            some = values.new_zeros(len(self), count, *values.shape[2:])
            some[mirror, place] = values[mirror, source]
            return some

        kernels = replace(
            self,
            places=chosen(self.places),
            factors=chosen(self.factors),
            pixels=chosen(pixels),
            areas=areas,
        )
        return Thinned(kernels, block)


@dataclass(frozen=True, eq=False)
class Thinned:
    """Kernels on fewer pixels, and by which of them (P,) each pixel of the whole map is replaced.

    The resolution is still that of the whole map.
    """

    kernels: Kernels
    block: Tensor


_OF_PIXELS = ("places", "factors", "pixels")
_OF_MIRRORS = (
    *("expected", "sharp", "sides", "aims", "mirrors", "axes", "spread", "power"),
    *_OF_PIXELS,
)


@dataclass(frozen=True, eq=False)
class KernelTile:
    """The kernels of a tile, and why some of its mirrors have none."""

    kernels: Kernels | None
    skipped: dict[str, str]


class _Images(NamedTuple):
    """Images (B, SIZE, SIZE) [W/m2] with and without pointing errors, and their sides [m]."""

    expected: Tensor
    sharp: Tensor
    side: float


@dataclass(frozen=True, eq=False)
class KernelTracer:
    """The task of each tile; calling it with a tile traces the images of its mirrors.

    Attributes
    ----------
    field : Superposition
        What is traced; its resolution is that of the map.
    """

    field: Superposition

    def __call__(self, tile: Tile) -> KernelTile:
        """Trace the mirrors of a tile, and skip those that cannot reach the receiver."""
        found: list[Kernels] = []
        skipped: dict[str, str] = {}
        for part, made in in_parts(self._trace, tile):
            if isinstance(made, ModelError):
                skipped[part.setups[0].heliostat.name] = str(made)
            else:
                found += made
        return KernelTile(join(found) if found else None, skipped)

    def _trace(self, tile: Tile) -> list[Kernels]:
        with torch.no_grad():
            return [self._kernels(*lit) for lit in self.field.scenes(tile)]

    def _kernels(self, setups: Sequence[Setup], scene: Scene, optics: Optics) -> Kernels:
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
        images = _images(rays, torch.tensor(middles).to(scene.sun), scene, optics, max(planes.size))
        aims = planes.centers + np.einsum("bi,bij->bj", middles, planes.axes[:, :2])
        lit = _lit(receiver, self.field.resolution, mirrors, planes, aims)
        single = torch.float32
        return Kernels(
            names=tuple(setup.heliostat.name for setup in setups),
            expected=images.expected.to(single),
            sharp=images.sharp.to(single),
            sides=torch.full((len(setups),), images.side, dtype=single),
            aims=torch.tensor(aims, dtype=single),
            mirrors=torch.tensor(mirrors, dtype=single),
            axes=torch.tensor(planes.axes, dtype=single),
            spread=_spread(rays, optics).to(single),
            power=(rays.power.sum(-1) * irradiance_of(scene, optics, rays.slant_range)).to(single),
            places=torch.tensor(lit.places, dtype=single),
            factors=torch.tensor(lit.factors, dtype=single),
            pixels=torch.tensor(lit.pixels),
            areas=torch.tensor(lit.areas, dtype=single),
            resolution=self.field.resolution,
        )


def aim_in_front(receiver: Receiver, mirror: Array) -> Array:
    """The point (3,) [m] in front of a receiver's default aim, on the plane that touches it toward
    a mirror (3,) [m].

    Beams to a point inside of a receiver meet its surface elsewhere. For a mirror that sees nothing
    of the receiver it is the default aim.
    """
    try:
        plane = receiver.touching(mirror[None])
    except UnreachableError:
        return receiver.aim
    normal = plane.axes[0, 2]
    return np.asarray(receiver.aim + ((plane.centers[0] - receiver.aim) @ normal) * normal)


def _through(points: Array, mirrors: Array, origins: Array, axes: Array) -> Array:
    """Where lines from mirrors (B, 3) to points (B, 3) meet planes: right and up (B, 2) [m] of
    their origins (B, 3).
    """
    start = np.einsum("bij,bj->bi", axes, mirrors - origins)
    way = np.einsum("bij,bj->bi", axes, points - mirrors)
    if (way[:, 2] >= 0).any():
        raise InvalidInputError("an aim lies behind its mirror as seen from the receiver; move it")
    return np.asarray(start[:, :2] - (start[:, 2] / way[:, 2])[:, None] * way[:, :2])


def _images(rays: Rays, middles: Tensor, scene: Scene, optics: Optics, size: float) -> _Images:
    """Images in windows about ``middles`` (B, 2) [m] that hold nearly all light which a receiver of
    this ``size`` [m] can get.
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
    side = 2 * min(blur + mirror, size)
    window = Window(side, side, SIZE, SIZE)
    irradiance = irradiance_of(scene, optics, rays.slant_range)
    expected, sharp = (
        grid.blurred(splat(grid.x, grid.y, grid.weight, *grid.shape)).clamp(min=0)
        for grid in (
            raster(rays, middles, window, some, irradiance, (_PADDING, _PADDING))
            for some in (optics, replace(optics, pointing_error=0.0))
        )
    )
    return _Images(expected, sharp, side)


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


class _Lit(NamedTuple):
    """What of a map each mirror can light: as of `Kernels`."""

    places: Array
    factors: Array
    pixels: NDArray[np.int64]
    areas: Array


def _lit(
    receiver: Receiver,
    resolution: tuple[int, int],
    mirrors: Array,
    planes: TouchingPlanes,
    aims: Array,
) -> _Lit:
    """Pixels that mirrors (B, 3) can light through planes, relative to ``aims`` (B, 3) [m]."""
    grid = receiver.grid(*resolution)
    passed = passages(
        *(torch.tensor(a) for a in (mirrors, aims, planes.axes, grid.points, grid.normals))
    )
    places = torch.stack([passed.right, passed.up], dim=-1).flatten(1, 2).numpy()
    factors = passed.gain.flatten(1).numpy()
    factors = factors * _open(planes, places, aims, mirrors, grid)
    count = max(1, int((factors > 0).sum(axis=1).max()))
    # The pixels that a mirror lights, before those that it does not.
    chosen = np.argsort(factors <= 0, axis=1, kind="stable")[:, :count]
    return _Lit(
        np.take_along_axis(places, chosen[..., None], axis=1),
        np.take_along_axis(factors, chosen, axis=1),
        chosen,
        grid.areas.reshape(-1),
    )


def _open(
    planes: TouchingPlanes, places: Array, aims: Array, mirrors: Array, grid: SurfaceGrid
) -> Array:
    """Share (B, P) of light that passes an aperture and no screen hides."""
    share = np.ones(places.shape[:2])
    if planes.outline is not None:
        origin = np.einsum("bij,bj->bi", planes.axes, aims - planes.centers)[:, None, :2]
        x, y = np.moveaxis(places + origin, -1, 0)
        share *= inside_outline(x, y, planes.outline)
    if planes.screens is not None:
        seen = in_sight(planes.screens, torch.tensor(mirrors), grid)
        share *= seen.double().numpy().reshape(share.shape)
    return share


def join(parts: Iterable[Kernels]) -> Kernels:
    """The kernels of several tiles on one map."""
    some = list(parts)
    count = max(one.pixels.shape[1] for one in some)

    def joined(name: str) -> Tensor:
        tensors = [getattr(one, name) for one in some]
        if name in _OF_PIXELS:
            tensors = [_filled(tensor, count) for tensor in tensors]
        return torch.cat(tensors)

    every: dict[str, Any] = {name: joined(name) for name in _OF_MIRRORS}
    return replace(some[0], names=tuple(n for one in some for n in one.names), **every)


def _filled(tensor: Tensor, count: int) -> Tensor:
    """A tensor (N, m, ...) with zeros up to (N, count, ...)."""
    missing = tensor.new_zeros(len(tensor), count - tensor.shape[1], *tensor.shape[2:])
    return torch.cat([tensor, missing], dim=1)
