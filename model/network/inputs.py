"""What the network is told about each image besides the flux.

How slopes and places of the mirror map onto the target (`conditions`), and how a guessed surface would have to change
for the image to come out as measured (`descents`).
"""

from collections.abc import Callable

import torch
from torch import Tensor

from model.images import FLUX_WINDOW, binned
from model.nuisances import nuisances
from model.surface import sample
from model.tracing.scene import Scene

GUESS_SAMPLES = 16
"""Points along each side of a facet with which the flux of a guessed surface is traced for the network."""

MIRRORED_CONDITIONS = (1, -1, -1, 1) * 2 + (1,) * 4
"""Signs by which `conditions` change where the world is mirrored, left and right exchanged."""

DESCENT_SAMPLES = 12
"""Points along each side of a facet for images, of `model.images.COARSE_SIZE`, that are differentiated."""

DESCENT_STEPS = 4
"""Steps of conjugate gradients that a descent takes."""

DESCENT_NOISE, DARK = 0.03, 0.1
"""Standard deviation of a pixel [of the peak] that a descent counts with, and the flux [of the peak] from which on it
grows with the flux's root."""

STEP_HEIGHT = 3e-5
"""Height [m, root mean square] by which a surface is changed to take a difference of its images."""


def descents(trace: Callable[[Tensor], Tensor], flux: Tensor, basis: Tensor, side: float = FLUX_WINDOW) -> Tensor:
    """A step towards the surface that threw the images, in each image's share: heights (B, M, 4, 8, 8) [m].

    Some steps of conjugate gradients to the most probable surface by a prior, images taken as linear in it. What a
    camera may have done (`model.nuisances`) is marginalised, so that it moves no height. The shares add up to the step;
    they are those of the steepest descent, and what the later steps add is dealt out to all images alike.

    Parameters
    ----------
    trace : callable
        Images (B, M, R, R), sum 100, of the guess changed by heights (B, M, 4, 8, 8) [m], for each image apart;
        differentiable.
    flux : Tensor (B, M, n R, n R)
        The measured images, sum 100.
    basis : Tensor (K, 4, 8, 8) [m]
        Directions of the prior, each as long as its standard deviation.
    side : float [m]
        Of what the images show.
    """
    directions = basis.flatten(1)
    with torch.enable_grad():
        changes = torch.zeros(*flux.shape[:2], *basis.shape[1:], device=flux.device, requires_grad=True)
        traced = trace(changes)
    guessed, measured = traced.detach(), binned(flux, traced.shape[-1])
    peak = measured.amax(dim=(2, 3), keepdim=True)
    unit = DESCENT_NOISE * peak * torch.sqrt((guessed / peak).clamp(min=0) + DARK)
    free = (nuisances(guessed, side) / unit[:, :, None]).flatten(3)
    # A guess of one bright pixel has directions so long that single digits lose the unit matrix beside them.
    long = free.double()
    gram = torch.linalg.cholesky(long @ long.mT + torch.eye(free.shape[2], device=flux.device))

    def weighed(residual: Tensor) -> Tensor:
        """Residuals (B, M, R, R) in units of their errors, without what a camera may have done."""
        flat = residual.flatten(2)[..., None]
        along = torch.cholesky_solve((free @ flat).double(), gram).to(flat.dtype)
        return residual - (free.mT @ along).view_as(residual)

    def uphill(residual: Tensor) -> Tensor:
        """What residuals (B, M, R, R) ask of the prior's coefficients (B, M, K)."""
        (gradient,) = torch.autograd.grad(traced, changes, residual / unit, retain_graph=True)
        return gradient.flatten(2) @ directions.T

    @torch.no_grad()
    def response(coefficients: Tensor) -> Tensor:
        """Change of the images (B, M, R, R), in units of their errors, per coefficients (B, K)."""
        heights = (coefficients @ directions).view(-1, 1, *basis.shape[1:])
        step = STEP_HEIGHT / heights.square().mean(dim=(1, 2, 3, 4)).sqrt().clamp(min=1e-12)
        moved = trace((step[:, None, None, None, None] * heights).expand_as(changes)) - guessed
        return moved / unit / step[:, None, None, None]

    shares = uphill(weighed((measured - guessed) / unit))
    left = shares.sum(dim=1)
    direction, found, size = left, torch.zeros_like(left), left.square().sum(dim=1, keepdim=True)
    for step in range(DESCENT_STEPS):
        curved = direction + uphill(weighed(response(direction))).sum(dim=1)
        curvature, by_prior = ((direction * other).sum(dim=1, keepdim=True) for other in (curved, direction))
        # Less than the prior's own is none: where light is clipped, images do not do what was differentiated.
        length = torch.where(curvature >= by_prior, size / curvature.clamp(min=1e-20), 0.0)
        if step == 0:
            shares = shares * length[..., None]
        found, left = found + length * direction, left - length * curved
        before, size = size, left.square().sum(dim=1, keepdim=True)
        direction = left + size / before.clamp(min=1e-20) * direction
    shares = shares + ((found - shares.sum(dim=1)) / shares.shape[1])[:, None]
    return torch.einsum("bmk,kfij->bmfij", shares, basis)


def _project(vectors: Tensor, direction: Tensor) -> Tensor:
    """Shift (..., 2) on the plane of rays along ``direction`` (..., 3) that are displaced by ``vectors`` (..., 3)."""
    return vectors[..., :2] - direction[..., :2] * (vectors[..., 2] / direction[..., 2])[..., None]


def conditions(scene: Scene, side: float = FLUX_WINDOW) -> Tensor:
    """Conditions (B, 12) of images of ``side`` [m] taken with a scene of ideal surfaces.

    Larger images are told as those of `FLUX_WINDOW` that look the same: of a smaller mirror, and nearer. All have about
    unit scale: how a slope along the mirror's x and y moves light on the target, per slant range and with the factor
    two of reflection taken out (4 numbers); how a place on the mirror moves it (4); the logarithm of the slant range
    over 100 m; the cosine of incidence; the ideal canting across x and y [5 mrad].
    """
    control_points, center, sun = scene.in_plane()
    axes = (scene.plane_axes @ scene.attitude).transpose(1, 2)
    mirror = sample(control_points, 1, scene.degree)
    center = center + mirror.points.mean(-1)
    normal = axes[:, 2]
    cosine = (normal * sun).sum(-1, keepdim=True)
    beam = 2 * cosine * normal - sun
    scale = FLUX_WINDOW / side
    distance = torch.log(center[:, 2] / -beam[:, 2] * scale / 100)
    shifts, slopes = [], []
    for axis in (axes[:, 0], axes[:, 1]):
        turned = -(axis * sun).sum(-1, keepdim=True) * normal - cosine * axis
        slopes.append(_project(turned, beam))
        shifts.append(_project(axis, beam) * scale)
    return torch.cat([*slopes, *shifts, distance[:, None], cosine, _canting(mirror.area_vectors, axes) / 5e-3], dim=1)


def _canting(area_vectors: Tensor, axes: Tensor) -> Tensor:
    """Slope (B, 2) between the facets on either side, across the mirror's x and y; (B, 3, F) in PAINT's facet order."""
    normals = torch.einsum("bij,bjf->bif", axes, area_vectors)
    slope = -normals[:, :2] / normals[:, 2:]
    right_left = slope[:, 0, [1, 3]].mean(-1) - slope[:, 0, [0, 2]].mean(-1)
    upper_lower = slope[:, 1, [0, 1]].mean(-1) - slope[:, 1, [2, 3]].mean(-1)
    return torch.stack([right_left, upper_lower], dim=-1) / 2
