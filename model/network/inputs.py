"""What the network is told about each image besides the flux: how mirror slopes and places map onto the target."""

import torch
from torch import Tensor

from model.surface import sample
from model.tracing.scene import Scene

GUESS_SAMPLES = 16
"""Points along each side of a facet with which the flux of a guessed surface is traced for the network."""


def _project(vectors: Tensor, direction: Tensor) -> Tensor:
    """Shift (..., 2) on the plane of rays along ``direction`` (..., 3) that are displaced by ``vectors`` (..., 3)."""
    return vectors[..., :2] - direction[..., :2] * (vectors[..., 2] / direction[..., 2])[..., None]


def conditions(scene: Scene) -> Tensor:
    """Conditions (B, 12) of images taken with a scene of ideal surfaces.

    All have about unit scale: how a slope along the mirror's x and y moves light on the target, per slant range and
    with the factor two of reflection taken out (4 numbers); how a place on the mirror moves it (4); the logarithm of
    the slant range over 100 m; the cosine of incidence; the ideal canting across x and y [5 mrad].
    """
    control_points, sun = scene.in_plane()
    axes = (scene.plane_axes @ scene.attitude).transpose(1, 2)
    mirror = sample(control_points, 1, scene.degree)
    center = mirror.points.mean(-1)
    normal = axes[:, 2]
    cosine = (normal * sun).sum(-1, keepdim=True)
    beam = 2 * cosine * normal - sun
    slant = center[:, 2] / -beam[:, 2]
    shifts, slopes = [], []
    for axis in (axes[:, 0], axes[:, 1]):
        turned = -(axis * sun).sum(-1, keepdim=True) * normal - cosine * axis
        slopes.append(_project(turned, beam))
        shifts.append(_project(axis, beam))
    return torch.cat(
        [*slopes, *shifts, torch.log(slant / 100)[:, None], cosine, _canting(mirror.area_vectors, axes) / 5e-3], dim=1
    )


def _canting(area_vectors: Tensor, axes: Tensor) -> Tensor:
    """Slope (B, 2) between the facets on either side, across the mirror's x and y; (B, 3, F) in PAINT's facet order."""
    normals = torch.einsum("bij,bjf->bif", axes, area_vectors)
    slope = -normals[:, :2] / normals[:, 2:]
    right_left = slope[:, 0, [1, 3]].mean(-1) - slope[:, 0, [0, 2]].mean(-1)
    upper_lower = slope[:, 1, [0, 1]].mean(-1) - slope[:, 1, [2, 3]].mean(-1)
    return torch.stack([right_left, upper_lower], dim=-1) / 2
