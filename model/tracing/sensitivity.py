"""How flux answers to the mirror's heights: the convolution tracer's derivative, in closed form.

A height bends the mirror about itself, and the light of the samples there moves on the target by the slope times what
slopes do there. A control height bends only the spans of the spline beside it: all derivatives of an image together
cost as much as a few images, where tracing a mirror for each would cost as many as there are heights.

Left out is what a height changes besides: the place where a ray starts, by a tenth of a millimetre, and the area that
a sample shows the sun, by a ten-thousandth. The mount keeps the spot's centre where it is.
"""

import torch
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
    pushed = _moved(scene, rays, samples) / seen.x.new_tensor([window.pixel[0], -window.pixel[1]])[:, None, None, None]
    changes = seen.blurred(_sharp(seen, pushed))
    weight = seen.weight.view(scene.batch, 1, *pushed.shape[2:4], 1)
    spot = (pushed * weight).sum(-2).flatten(2) / seen.weight.sum(-1)[:, None, None]
    return changes[:-2] - torch.einsum("bak,abrc->kbrc", spot, changes[-2:])


def _moved(scene: Scene, rays: Rays, samples: int) -> Tensor:
    """Movement (B, 2, F, n**2, I * J) [m/m] on the plane of each sample's light with its facet's control heights."""
    facets = scene.control_points.shape[1]
    points = scene.control_points.expand(scene.batch, -1, -1, -1, -1)
    tilts = TILT * torch.eye(2, dtype=points.dtype, device=points.device)
    by_slope = [
        (central_rays(scene.with_(control_points=canted(points, tilt.expand(1, facets, 2))), samples).hits - rays.hits)
        / TILT
        for tilt in tilts
    ]
    moved = torch.zeros(())
    for by, slopes in zip(by_slope, _slopes(points, scene.degree, samples), strict=True):
        moved = moved + by.view(*by.shape[:2], facets, -1, 1) * slopes
    return moved


def _slopes(points: Tensor, degree: int, samples: int) -> tuple[Tensor, Tensor]:
    """Slope along x and y, each (1, 1, F, n**2, I * J) [1/m], that control heights make at a facet's samples."""
    value_u, slope_u = midpoint_basis(points.shape[-2], degree, samples, points.dtype, points.device)
    value_v, slope_v = midpoint_basis(points.shape[-1], degree, samples, points.dtype, points.device)
    wide = (points[0, :, :, -1, 0] - points[0, :, :, 0, 0]).norm(dim=-1)
    high = (points[0, :, :, 0, -1] - points[0, :, :, 0, 0]).norm(dim=-1)
    shape = (1, 1, 1, samples**2, -1)
    along_x = torch.einsum("ui,vj->uvij", slope_u, value_v).reshape(shape) / wide[:, None, None]
    along_y = torch.einsum("ui,vj->uvij", value_u, slope_v).reshape(shape) / high[:, None, None]
    return along_x, along_y


def _sharp(seen: Raster, pushed: Tensor) -> Tensor:
    """Change (F * K + 2, B, R, C) of sharp images with heights that push light (B, 2, F, N, K) [px], and by a pixel.

    The last two are those of a push of all light along columns and along rows.
    """
    batch, _, facets, samples, count = pushed.shape
    index, along = _footprints(seen)
    along = (along * seen.weight[:, None]).view(2, batch, 9, facets, samples)
    index = index.view(batch, 9, facets, samples)
    images = seen.x.new_zeros(facets * count + 2, batch * seen.shape[0] * seen.shape[1])
    for facet, place in enumerate(index.unbind(2)):
        slope = along[:, :, :, facet]
        changes = sum(by[..., None] * push[:, None, facet] for by, push in zip(slope, pushed.unbind(1), strict=True))
        image = images.new_zeros(images.shape[1], count).index_add_(0, place.flatten(), changes.flatten(0, 2))
        images[facet * count : (facet + 1) * count] = image.T
        images[-2:].index_add_(1, place.flatten(), slope.flatten(1))
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
