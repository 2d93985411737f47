"""How flux answers to the mirror's heights: the convolution tracer's derivative, in closed form.

A height bends the mirror about itself, and the light of the samples there moves on the target by the slope times what
slopes do there. A control height bends only the spans of the spline beside it: all derivatives of an image together
cost as much as a few images, where tracing a mirror for each would cost as many as there are heights.

Left out is what a height changes besides: the place where a ray starts, by a tenth of a millimetre, and the area that
a sample shows the sun, by a ten-thousandth. The mount keeps the spot's centre where it is.
"""

import numpy as np
import torch
from scipy.sparse import csc_array
from torch import Tensor

from model.surface import canted, midpoint_basis
from model.tracing.convolution import Raster, Rays, central_rays, quadratic, raster
from model.tracing.scene import Optics, Scene, Window

TILT = 1e-4
"""Slope [rad] over which the movement of light with slope is taken."""


def sensitivity(scene: Scene, window: Window, optics: Optics, *, samples: int = 12, padding: float = 0.25) -> Tensor:
    """Change of irradiance per control height (F * I * J, B, rows, columns) [W/m3] of a scene's B mirrors.

    Heights stand along the facets' normals. Windows on the plane's centre show what a mount makes of a change that
    turns the spot back to where it was. Other parameters as of `model.tracing.trace`.

    Raises
    ------
    UnreachableError
        Where a mirror shows its back to the sun or to the target.
    """
    rays = central_rays(scene, samples)
    center = rays.spot if window.on_spot else torch.zeros_like(rays.spot)
    seen = raster(rays, center, window, optics, optics.irradiance(rays.slant_range), (padding, padding))
    moved = _moved(scene, rays, samples) / seen.x.new_tensor([window.pixel[0], -window.pixel[1]])[:, None, None, None]
    slopes = _slopes(scene, samples)
    changes = seen.blurred(_sharp(seen, moved, slopes))
    weight = (seen.weight / seen.weight.sum(-1, keepdim=True)).view(scene.batch, 1, -1, samples**2, 1)
    spot = torch.einsum("bafns,sfnk->bafk", moved * weight, slopes).flatten(2)
    return changes[:-2] - torch.einsum("bak,abrc->kbrc", spot, changes[-2:])


def _moved(scene: Scene, rays: Rays, samples: int) -> Tensor:
    """Movement (B, 2, F, n**2, 2) [m] on the plane of each sample's light with its slopes along x and y."""
    facets = scene.control_points.shape[1]
    points = scene.control_points.expand(scene.batch, -1, -1, -1, -1)
    tilts = TILT * torch.eye(2, dtype=points.dtype, device=points.device)
    by_slope = [
        (central_rays(scene.with_(control_points=canted(points, tilt.expand(1, facets, 2))), samples).hits - rays.hits)
        / TILT
        for tilt in tilts
    ]
    return torch.stack(by_slope, dim=-1).view(scene.batch, 2, facets, -1, 2)


def _slopes(scene: Scene, samples: int) -> Tensor:
    """Slopes along x and y (2, F, n**2, I * J) [1/m] that control heights make at a facet's samples."""
    points = scene.control_points[0]
    value_u, slope_u = midpoint_basis(points.shape[-2], scene.degree, samples, points.dtype, points.device)
    value_v, slope_v = midpoint_basis(points.shape[-1], scene.degree, samples, points.dtype, points.device)
    wide = (points[:, :, -1, 0] - points[:, :, 0, 0]).norm(dim=-1)
    high = (points[:, :, 0, -1] - points[:, :, 0, 0]).norm(dim=-1)
    along_x = torch.einsum("ui,vj->uvij", slope_u, value_v).reshape(samples**2, -1)
    along_y = torch.einsum("ui,vj->uvij", value_u, slope_v).reshape(samples**2, -1)
    return torch.stack([along_x / wide[:, None, None], along_y / high[:, None, None]])


def _sharp(seen: Raster, moved: Tensor, slopes: Tensor) -> Tensor:
    """Change (F * K + 2, B, R, C) of sharp images with heights, and as all light moves by a pixel.

    Heights make ``slopes`` (2, F, N, K) [1/m], and slopes move light (B, 2, F, N, 2) [px]. The last two changes are
    those along columns and along rows. What slopes do to pixels is sparse: nine of them for a sample of each mirror.
    """
    batch, _, facets, samples, _ = moved.shape
    index, along = _footprints(seen)
    along = (along * seen.weight[:, None]).view(2, batch, 9, facets, samples)
    pixels, count = batch * seen.shape[0] * seen.shape[1], slopes.shape[-1]
    images = seen.x.new_zeros(facets * count + 2, pixels)
    images[-2:].index_add_(1, index.flatten(), along.flatten(1))
    by_slope = torch.einsum("abpfn,bafns->sfnbp", along, moved).flatten(3)
    places = index.view(batch, 9, facets, samples).permute(2, 3, 0, 1).flatten(2)
    first = np.arange(0, 2 * places[0].numel() + 1, places.shape[-1])
    for facet, place in enumerate(places):
        entries = by_slope[:, facet].flatten().numpy(), place.expand(2, -1, -1).flatten().numpy(), first
        change = csc_array(entries, shape=(pixels, 2 * samples)) @ slopes[:, facet].flatten(0, 1).numpy()
        images[facet * count : (facet + 1) * count] = torch.from_numpy(change).T
    return images.view(-1, batch, *seen.shape)


def _footprints(seen: Raster) -> tuple[Tensor, Tensor]:
    """Pixels (B, 9, S) that a ray's light is spread over, of all mirrors' in a row, and its change (2, B, 9, S) [1/px].

    The change as the ray moves along columns and along rows; of rays outside it is zero.
    """
    rows, columns = seen.shape
    column, row = seen.x.round(), seen.y.round()
    inside = (column >= 1) & (column < columns - 1) & (row >= 1) & (row < rows - 1)
    (across, across_slope), (down, down_slope) = (
        (torch.stack(quadratic(offset)), torch.stack([offset - 0.5, -2 * offset, offset + 0.5]))
        for offset in (seen.x - column, seen.y - row)
    )
    steps = torch.arange(3, device=row.device)
    first = torch.arange(len(row), device=row.device)[:, None] * rows + row.clamp(1, rows - 2).long() - 1
    index = (first + steps[:, None, None])[:, None] * columns + column.clamp(1, columns - 2).long() - 1
    index = index + steps[:, None, None]
    along = torch.stack([down[:, None] * across_slope, down_slope[:, None] * across]) * inside
    return index.flatten(0, 1).movedim(0, 1), along.flatten(1, 2).movedim(1, 2)
