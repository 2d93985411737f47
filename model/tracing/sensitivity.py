"""Derivatives of the convolution tracer's flux by the heights of the mirror, in closed form.

Notes
-----
A height tilts the mirror around it, and the light of the samples there moves on the target::

    d flux / d height = sum over samples (d flux / d hit) (d hit / d slope) (d slope / d height)

A control height tilts only the adjacent spans of the spline. So all derivatives of an image cost as
much as a few images; differences of traces would cost as many as there are heights. Heights of a
facet touch the light of that facet only, so that the cost is linear in the number of facets.

Neglected: a height also moves the origin of a ray, by a tenth of a millimetre, and changes the
projected area, by a ten-thousandth. The mount keeps the spot's centre in place.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csc_array
from torch import Tensor

from model.surface import canted, midpoint_basis
from model.tracing.convolution import Raster, Rays, central_rays, quadratic, raster
from model.tracing.scene import Optics, Scene, Window, irradiance_of, optics_of

TILT = 1e-4
"""Slope [rad] of the finite difference for the movement of light with the slope."""

# Derivatives that are blurred at once: their spectra take several times the memory of images.
_AT_ONCE = 16


@dataclass(frozen=True, eq=False)
class HeightChanges:
    """Changes of a mirror's heights as sums of shapes that all of its facets can have.

    Facet f changes by ``sum weights[k, f, l] shapes[l]``. Tracing takes each facet's shapes once,
    so that its cost grows with their number, and not with the number of heights.

    Attributes
    ----------
    shapes : Tensor (L, I, J) [m]
    weights : Tensor (K, F, L) or None
        None for each shape of each facet alone: K = F * L, one facet after the other.
    """

    shapes: Tensor
    weights: Tensor | None = None

    @classmethod
    def of(cls, directions: Tensor) -> "HeightChanges":
        """Changes by directions (K, F, I, J) [m]: each height is a shape."""
        rows, columns = directions.shape[-2:]
        each = torch.eye(rows * columns, dtype=directions.dtype).view(-1, rows, columns)
        return cls(each, directions.flatten(2))

    def combine(self, by_shape: Tensor) -> Tensor:
        """Changes (K, ...) of values whose changes by each facet's shapes are (F * L, ...).

        For many more changes than shapes this is faster than `sensitivity` with weights, which adds
        up before it blurs.
        """
        if self.weights is None:
            return by_shape
        changes = self.weights.flatten(1) @ by_shape.flatten(1)
        return changes.view(-1, *by_shape.shape[1:])


def sensitivity(
    scene: Scene,
    window: Window,
    optics: Optics,
    *,
    shapes: Tensor | None = None,
    weights: Tensor | None = None,
    samples: int = 12,
    padding: float = 0.25,
) -> Tensor:
    """Derivatives of irradiance by heights of facets (F * L, B, rows, columns) [W/m3] of a scene's
    B mirrors.

    ``shapes`` (L, I, J) are what each facet's heights change by, by default each control height
    alone. With ``weights`` (K, F, L) the derivatives are (K, B, rows, columns), by sums of those.
    Heights are along the facets' normals. Windows on the plane's centre include the rotation
    of the mount that returns the spot to its place. Other parameters are those of
    `model.tracing.trace`.

    Raises
    ------
    UnreachableError
        If a mirror faces away from the sun or from the target.
    """
    rays = central_rays(scene, samples)
    center = rays.spot if window.on_spot else torch.zeros_like(rays.spot)
    optics = optics_of(scene, optics)
    irradiance = irradiance_of(scene, optics, rays.slant_range)
    rays_on_grid = raster(rays, center, window, optics, irradiance, (padding, padding))
    moved = (
        _moved(scene, rays, samples)
        / rays_on_grid.x.new_tensor([window.pixel[0], -window.pixel[1]])[:, None, None, None]
    )
    slopes = _slopes(scene, samples)
    if shapes is not None:
        slopes = slopes @ shapes.to(slopes).flatten(1).T
    sharp = _sharp(rays_on_grid, moved, slopes, weights)
    changes = torch.cat([rays_on_grid.blurred(part) for part in torch.split(sharp, _AT_ONCE)])
    weight = (rays_on_grid.weight / rays_on_grid.weight.sum(-1, keepdim=True)).view(
        scene.batch, 1, -1, samples**2, 1
    )
    spot = torch.einsum("bafns,sfnk->bafk", moved * weight, slopes).flatten(2)
    if weights is not None:
        spot = spot @ weights.to(spot).flatten(1).T
    return changes[:-2] - torch.einsum("bak,abrc->kbrc", spot, changes[-2:])


def _moved(scene: Scene, rays: Rays, samples: int) -> Tensor:
    """Movement (B, 2, F, n**2, 2) [m] of each sample's light with the slopes along x and y."""
    facets = scene.control_points.shape[1]
    points = scene.control_points.expand(scene.batch, -1, -1, -1, -1)
    tilts = TILT * torch.eye(2, dtype=points.dtype, device=points.device)
    by_slope = [
        (
            central_rays(
                scene.with_(control_points=canted(points, tilt.expand(1, facets, 2))), samples
            ).hits
            - rays.hits
        )
        / TILT
        for tilt in tilts
    ]
    return torch.stack(by_slope, dim=-1).view(scene.batch, 2, facets, -1, 2)


def _slopes(scene: Scene, samples: int) -> Tensor:
    """Slopes along x and y (2, F, n**2, I * J) [1/m] at a facet's samples, per control height."""
    points = scene.control_points[0]
    (rows, columns), kind = points.shape[-2:], (points.dtype, points.device)
    value_u, slope_u = midpoint_basis(rows, scene.degree, samples, *kind)
    value_v, slope_v = midpoint_basis(columns, scene.degree, samples, *kind)
    wide = (points[:, :, -1, 0] - points[:, :, 0, 0]).norm(dim=-1)
    high = (points[:, :, 0, -1] - points[:, :, 0, 0]).norm(dim=-1)
    along_x = torch.einsum("ui,vj->uvij", slope_u, value_v).reshape(samples**2, -1)
    along_y = torch.einsum("ui,vj->uvij", value_u, slope_v).reshape(samples**2, -1)
    return torch.stack([along_x / wide[:, None, None], along_y / high[:, None, None]])


def _sharp(rays_on_grid: Raster, moved: Tensor, slopes: Tensor, weights: Tensor | None) -> Tensor:
    """Derivatives (F * L + 2, B, R, C) of sharp images by heights, and by a shift of all light.

    Heights change slopes by ``slopes`` (2, F, N, L) [1/m], and slopes move light by ``moved``
    (B, 2, F, N, 2) [px]. With ``weights`` (K, F, L) they are (K + 2, B, R, C), by sums of heights.
    The last two derivatives are by shifts along columns and along rows [1/px]. The matrix from
    slopes to pixels is sparse: nine pixels for each sample.
    """
    batch, _, facets, samples, _ = moved.shape
    index, along = _footprints(rays_on_grid)
    along = (along * rays_on_grid.weight[:, None]).view(2, batch, 9, facets, samples)
    pixels, count = batch * rays_on_grid.shape[0] * rays_on_grid.shape[1], slopes.shape[-1]
    n_changes = facets * count if weights is None else len(weights)
    images = rays_on_grid.x.new_zeros(n_changes + 2, pixels)
    images[-2:].index_add_(1, index.flatten(), along.flatten(1))
    by_slope = torch.einsum("abpfn,bafns->sfnbp", along, moved).flatten(3)
    places = index.view(batch, 9, facets, samples).permute(2, 3, 0, 1).flatten(2)
    first = np.arange(0, 2 * places[0].numel() + 1, places.shape[-1])
    for facet, place in enumerate(places):
        entries = (
            by_slope[:, facet].flatten().numpy(),
            place.expand(2, -1, -1).flatten().numpy(),
            first,
        )
        change = (
            csc_array(entries, shape=(pixels, 2 * samples)) @ slopes[:, facet].flatten(0, 1).numpy()
        )
        if weights is None:
            images[facet * count : (facet + 1) * count] = torch.from_numpy(change).T
        else:
            images[:-2] += weights[:, facet].to(images) @ torch.from_numpy(change).T
    return images.view(-1, batch, *rays_on_grid.shape)


class _Footprints(NamedTuple):
    """Pixels (B, 9, S) of each ray, and the derivatives (2, B, 9, S) [1/px] of its shares in them.

    Pixels are indices in the flattened images of all mirrors. Derivatives are those along columns
    and along rows; they are zero for rays outside.
    """

    pixels: Tensor
    slopes: Tensor


def _footprints(rays_on_grid: Raster) -> _Footprints:
    rows, columns = rays_on_grid.shape
    column, row = rays_on_grid.x.round(), rays_on_grid.y.round()
    inside = (column >= 1) & (column < columns - 1) & (row >= 1) & (row < rows - 1)
    (across, across_slope), (down, down_slope) = (
        (torch.stack(quadratic(offset)), torch.stack([offset - 0.5, -2 * offset, offset + 0.5]))
        for offset in (rays_on_grid.x - column, rays_on_grid.y - row)
    )
    steps = torch.arange(3, device=row.device)
    first = (
        torch.arange(len(row), device=row.device)[:, None] * rows
        + row.clamp(1, rows - 2).long()
        - 1
    )
    index = (
        (first + steps[:, None, None])[:, None] * columns + column.clamp(1, columns - 2).long() - 1
    )
    index = index + steps[:, None, None]
    along = torch.stack([down[:, None] * across_slope, down_slope[:, None] * across]) * inside
    pixels = index.flatten(0, 1).movedim(0, 1)
    return _Footprints(pixels, along.flatten(1, 2).movedim(1, 2))
