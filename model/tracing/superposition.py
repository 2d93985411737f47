"""Light of many mirrors on one receiver, with what each of them lost on its way.

- `superpose` adds up mirrors on one plane. Spectra are added, so that one inverse transform is
  enough, and each mirror's share of the window follows from its spectrum.
- `project` adds up mirrors on any receiver. Each mirror is traced on the plane that touches the
  receiver toward it, and its image is projected from the mirror's middle to the receiver.

Approximation of `project`: all light at a place comes from the mirror's middle. Between the plane
and the receiver a mirror's width of b at a distance L moves light by b / L times the gap, some
centimetres, which is little beside the sun's image.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from model.errors import InvalidInputError
from model.neighbours import clear
from model.plant import Receiver, SurfaceGrid, TouchingPlanes
from model.sunshape import half_angle
from model.tracing.convolution import MAX_GRID, Raster, Rays, central_rays, raster, splat
from model.tracing.scene import Optics, Scene, Size, Window, irradiance_of, optics_of

# Light is traced beyond a window's edge up to this share of the sun's cone, plus a margin for
# errors [rad].
_CONE_SHARE, _ERRORS = 0.98, 3e-3

# Places times mirrors that are projected at once.
_PROJECTED = 2**20


@dataclass(frozen=True, eq=False)
class Beams:
    """Power of the beams of mirrors, and what they lost on their way.

    Attributes
    ----------
    lit : Tensor (B, 2) [m2]
        As of `Rays`.
    free : Tensor (B,) [m2]
        Projected mirror area whose light meets neither shade nor neighbour.
    power : Tensor (B,) [W]
        Reflected, less attenuation, inside and outside of any window.
    """

    lit: Tensor
    free: Tensor
    power: Tensor

    @classmethod
    def of(cls, rays: Rays, irradiance: Tensor) -> "Beams":
        """The beams of rays whose mirrors and air leave ``irradiance`` (B,) [W/m2]."""
        free = rays.power.sum(-1)
        return cls(rays.lit, free, free * irradiance)


@dataclass(frozen=True, eq=False)
class SuperposedFlux:
    """Light of several mirrors on one receiver.

    Attributes
    ----------
    irradiance : Tensor (rows, columns) [W/m2]
    beams : Beams
    intercepted : Tensor (B,) [W]
        Each mirror's power on the receiver.
    """

    irradiance: Tensor
    beams: Beams
    intercepted: Tensor


def superpose(
    scene: Scene, window: Window, optics: Optics | None = None, *, samples: int = 16
) -> SuperposedFlux:
    """Add up the flux of all mirrors of a scene, which have one target plane.

    Parameters are those of `model.tracing.trace`. Raises `UnreachableError` if a mirror faces away
    from the sun or from the target.
    """
    optics, rays = optics_of(scene, optics or Optics()), central_rays(scene, samples)
    irradiance = irradiance_of(scene, optics, rays.slant_range)
    center = rays.hits.new_zeros(scene.batch, 2)
    grid = raster(rays, center, window, optics, irradiance, _padding(rays, window, optics))
    spectra = torch.fft.rfft2(splat(grid.x, grid.y, grid.weight, *grid.shape)) * grid.transfer
    image = torch.fft.irfft2(spectra.sum(0), s=grid.shape)[grid.inner]
    area = window.pixel[0] * window.pixel[1]
    return SuperposedFlux(image, Beams.of(rays, irradiance), area * _sums(spectra, grid))


def _padding(rays: Rays, window: Window, optics: Optics) -> Size:
    """Heights and widths of the window beyond it up to which light is followed."""
    cone = half_angle(optics.sun_shape, _CONE_SHARE) + _ERRORS
    beyond = float((rays.slant_range * cone / -rays.direction[:, 2].clamp(max=-0.25)).max())
    beyond = min(beyond, max(window.width, window.height))
    return max(0.1, beyond / window.height), max(0.1, beyond / window.width)


def _sums(spectra: Tensor, grid: Raster) -> Tensor:
    """Sums (B,) over the window of the images of spectra (B, R, C / 2 + 1), by Parseval."""
    inside = torch.zeros(grid.shape, dtype=grid.x.dtype, device=grid.x.device)
    inside[grid.inner] = 1
    window = torch.fft.rfft2(inside)
    # A real image's spectrum has all columns twice but the first and the middle one.
    window[:, 1 : grid.shape[1] // 2] *= 2
    sums: Tensor = torch.view_as_real(spectra).flatten(1) @ torch.view_as_real(window).flatten()
    return sums / inside.numel()


def project(
    scene: Scene,
    receiver: Receiver,
    resolution: tuple[int, int],
    optics: Optics | None = None,
    *,
    samples: int = 16,
) -> SuperposedFlux:
    """Add up the flux of all mirrors of a scene on a receiver's map of (rows, columns).

    The scene's own planes do not matter. Raises `UnreachableError` if a mirror faces away from the
    sun or from the receiver.
    """
    grid = receiver.grid(*resolution)
    touching = receiver.touching(scene.center.double().numpy())
    scene = scene.with_(
        plane_center=torch.tensor(touching.centers).to(scene.sun),
        plane_axes=torch.tensor(touching.axes).to(scene.sun),
    )
    optics, rays = optics_of(scene, optics or Optics()), central_rays(scene, samples)
    irradiance = irradiance_of(scene, optics, rays.slant_range)
    window = _window(touching, grid)
    center = rays.hits.new_zeros(scene.batch, 2)
    on_grid = raster(rays, center, window, optics, irradiance, _padding(rays, window, optics))
    kernels = on_grid.blurred(splat(on_grid.x, on_grid.y, on_grid.weight, *on_grid.shape))
    if touching.opening is not None:
        opening = touching.opening(window.rows, window.columns)
        kernels = kernels * torch.tensor(opening).to(kernels)
    step = max(1, _PROJECTED // grid.areas.size)
    image, intercepted, beams = torch.zeros(resolution), [], Beams.of(rays, irradiance)
    areas = torch.tensor(grid.areas).to(kernels)
    for start in range(0, scene.batch, step):
        part = slice(start, start + step)
        seen = _projected(kernels[part], scene, part, window, grid)
        if touching.screens is not None:
            seen = seen * in_sight(touching.screens, scene.center[part], grid)
        reached = (seen * areas).sum(dim=(-2, -1))
        # Coarse pixels may add up to some per mille more than the beam, if all of it lands there.
        kept = (beams.power[part] / reached.clamp(min=1e-30)).clamp(max=1)
        image = image + (seen * kept[:, None, None]).sum(0)
        intercepted.append(reached * kept)
    return SuperposedFlux(image, beams, torch.cat(intercepted))


def _window(touching: TouchingPlanes, grid: SurfaceGrid) -> Window:
    """The window on a touching plane, with pixels as large as those of a receiver's map."""
    pixel = float(np.sqrt(grid.areas.mean()))
    rows, columns = (max(16, math.ceil(side / pixel)) for side in touching.size[::-1])
    if rows * columns > MAX_GRID:
        raise InvalidInputError(
            f"resolution: {grid.areas.shape[0]} x {grid.areas.shape[1]} pixels of {pixel:.3g} m"
            f" need a grid of {rows} x {columns}, {MAX_GRID} pixels are the most; ask for fewer"
        )
    return Window(*touching.size, rows, columns)


def _projected(
    kernels: Tensor, scene: Scene, part: slice, window: Window, grid: SurfaceGrid
) -> Tensor:
    """Irradiance (b, rows, columns) [W/m2] on the receiver of mirrors' images (b, r, c)."""
    points, normals = (torch.tensor(a).to(kernels) for a in (grid.points, grid.normals))
    passed = passages(
        scene.center[part], scene.plane_center[part], scene.plane_axes[part], points, normals
    )
    x, y = passed.right * (2 / window.width), passed.up * (-2 / window.height)
    places = torch.stack([x, y], dim=-1)
    light = grid_sample(kernels[:, None], places, padding_mode="border", align_corners=False)[:, 0]
    return light * passed.gain


class Passages(NamedTuple):
    """Where light from mirrors to places passes the mirrors' planes, each (b, rows, columns).

    Attributes
    ----------
    right, up : Tensor [m]
        Of the planes' origins.
    gain : Tensor
        Irradiance at a place, relative to that on the plane; 0 where the place faces away.
    """

    right: Tensor
    up: Tensor
    gain: Tensor


def passages(
    mirrors: Tensor, origins: Tensor, axes: Tensor, points: Tensor, normals: Tensor
) -> Passages:
    """Follow light from the middles of mirrors (b, 3) [m] to places (rows, columns, 3) [m].

    A place P of normal N is lit through the point q = c + t (P - c) of the mirror's plane, whose
    normal is n, from the mirror's middle c, so that E_P = E_q t**2 (P - c).N / (P - c).n. Planes
    have origins (b, 3) [m] and axes (b, 3, 3).
    """
    source = torch.einsum("bij,bj->bi", axes, mirrors - origins)
    turned = torch.einsum("bij,rcj->ircb", axes, points).permute(0, 3, 1, 2)
    origin = torch.einsum("bij,bj->ib", axes, origins)[..., None, None]
    ahead = [turned[i] - origin[i] - source[:, i, None, None] for i in range(3)]
    scale = -source[:, 2, None, None] / ahead[2].clamp(max=-1e-6)
    right, up = (source[:, i, None, None] + scale * ahead[i] for i in (0, 1))
    toward = torch.einsum("rcj,rcj->rc", points, normals) - torch.einsum(
        "bj,rcj->brc", mirrors, normals
    )
    return Passages(right, up, scale**2 * toward.clamp(max=0) / ahead[2].clamp(max=-1e-6))


def in_sight(screens: NDArray[np.float64], mirrors: Tensor, grid: SurfaceGrid) -> Tensor:
    """Share (b, rows, columns) of places that no screen (K, 3, 3) hides from mirrors (b, 3)."""
    count = len(mirrors)
    points = torch.tensor(grid.points).to(mirrors).flatten(0, 1).T.expand(count, -1, -1)
    ways = mirrors[:, :, None] - points
    ways = ways / ways.norm(dim=1, keepdim=True)
    # A place does not hide itself.
    points = points + _OFF * ways
    rectangles = torch.tensor(screens).to(mirrors).expand(count, -1, -1, -1)
    free = clear(rectangles, points, ways, mirrors.new_full((count,), _OFF))
    return free.view(count, *grid.areas.shape)


_OFF = 0.01
"""Distance [m] before a receiver from which screens are looked for, and width of their edges."""
