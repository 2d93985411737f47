"""Inputs of the network in addition to the flux.

The geometry (`conditions`): how slopes and positions on the mirror map to the target. A step of the
surface that explains the difference between the measured and the traced images
(`conjugate_gradient_steps`).
"""

from collections.abc import Callable

import torch
from torch import Tensor

from model.images import FLUX_WINDOW, binned
from model.nuisances import nuisances
from model.surface import sample
from model.tracing.scene import Scene

GUESS_SAMPLES = 16
"""Samples along each side of a facet for the flux of the current surface."""

MIRRORED_CONDITIONS = (1, -1, -1, 1) * 2 + (1,) * 4
"""Signs of `conditions` in the mirrored world, with left and right exchanged."""

STEP_SAMPLES = 12
"""Samples along each side of a facet for differentiated images of `model.images.COARSE_SIZE`."""

CONJUGATE_GRADIENT_ITERATIONS = 4
"""Number of conjugate gradient iterations."""

PIXEL_NOISE, DARK = 0.03, 0.1
"""Assumed standard deviation of a pixel [of the peak], and the flux [of the peak] above which it
grows with the root of the flux.
"""

STEP_HEIGHT = 3e-5
"""Change of the surface [m, root mean square] for finite differences of its images."""


def conjugate_gradient_steps(
    trace: Callable[[Tensor], Tensor], flux: Tensor, basis: Tensor, side: float = FLUX_WINDOW
) -> Tensor:
    """Step towards the maximum a posteriori surface, as one share per image: heights (B, M, F, 8,
    8) [m].

    The images are linearised in the surface, and a few conjugate gradient iterations are made.
    Nuisance parameters of the camera (`model.nuisances`) are marginalised. The shares add up to the
    step. The first iteration determines them; later iterations are divided equally.

    Parameters
    ----------
    trace : callable
        Differentiable; images (B, M, R, R), sum 100, of the surface changed by heights (B, M, F, 8,
        8) [m], which are separate for each image.
    flux : Tensor (B, M, n R, n R)
        The measured images, sum 100.
    basis : Tensor (K, F, 8, 8) [m]
        Principal directions of the prior, each scaled by its standard deviation.
    side : float [m]
        Width of the images.
    """
    directions = basis.flatten(1)
    with torch.enable_grad():
        changes = torch.zeros(
            *flux.shape[:2], *basis.shape[1:], device=flux.device, requires_grad=True
        )
        traced = trace(changes)
    guessed, measured = traced.detach(), binned(flux, traced.shape[-1])
    peak = measured.amax(dim=(2, 3), keepdim=True)
    unit = PIXEL_NOISE * peak * torch.sqrt((guessed / peak).clamp(min=0) + DARK)
    free = (nuisances(guessed, side) / unit[:, :, None]).flatten(3)
    # A single bright pixel makes directions so long that single precision loses the unit matrix.
    long = free.double()
    gram = torch.linalg.cholesky(long @ long.mT + torch.eye(free.shape[2], device=flux.device))

    def marginalised(residual: Tensor) -> Tensor:
        """Remove the nuisance parameters from residuals (B, M, R, R) in units of their errors."""
        flat = residual.flatten(2)[..., None]
        along = torch.cholesky_solve((free @ flat).double(), gram).to(flat.dtype)
        return residual - (free.mT @ along).view_as(residual)

    def gradient_of(residual: Tensor) -> Tensor:
        """Gradient (B, M, K) by the prior's coefficients of residuals (B, M, R, R)."""
        (gradient,) = torch.autograd.grad(traced, changes, residual / unit, retain_graph=True)
        return gradient.flatten(2) @ directions.T

    @torch.no_grad()
    def response(coefficients: Tensor) -> Tensor:
        """Change of the images (B, M, R, R), in units of their errors, by coefficients (B, K)."""
        heights = (coefficients @ directions).view(-1, 1, *basis.shape[1:])
        step = STEP_HEIGHT / heights.square().mean(dim=(1, 2, 3, 4)).sqrt().clamp(min=1e-12)
        moved = trace((step[:, None, None, None, None] * heights).expand_as(changes)) - guessed
        return moved / unit / step[:, None, None, None]

    shares = gradient_of(marginalised((measured - guessed) / unit))
    left = shares.sum(dim=1)
    direction, found, size = left, torch.zeros_like(left), left.square().sum(dim=1, keepdim=True)
    for step in range(CONJUGATE_GRADIENT_ITERATIONS):
        curved = direction + gradient_of(marginalised(response(direction))).sum(dim=1)
        curvature, by_prior = (
            (direction * other).sum(dim=1, keepdim=True) for other in (curved, direction)
        )
        # A curvature below the prior's means that the linear model fails, for instance with clipped
        # light: no step.
        length = torch.where(curvature >= by_prior, size / curvature.clamp(min=1e-20), 0.0)
        if step == 0:
            shares = shares * length[..., None]
        found, left = found + length * direction, left - length * curved
        before, size = size, left.square().sum(dim=1, keepdim=True)
        direction = left + size / before.clamp(min=1e-20) * direction
    shares = shares + ((found - shares.sum(dim=1)) / shares.shape[1])[:, None]
    return torch.einsum("bmk,kfij->bmfij", shares, basis)


def _project(vectors: Tensor, direction: Tensor) -> Tensor:
    """Shift (..., 2) on the plane of rays along ``direction`` (..., 3), moved by ``vectors``."""
    return vectors[..., :2] - direction[..., :2] * (vectors[..., 2] / direction[..., 2])[..., None]


def conditions(scene: Scene, side: float = FLUX_WINDOW) -> Tensor:
    """Conditions (B, 12) of images of ``side`` [m] taken with a scene of ideal surfaces.

    A larger image is described as the equal one of `FLUX_WINDOW` by a smaller and nearer mirror.
    The numbers have about unit scale: displacement of light on the target by a slope along the
    mirror's x and y, per slant range and without the factor two of reflection (4); displacement by
    a position on the mirror (4); logarithm of the slant range over 100 m; cosine of incidence;
    ideal canting across x and y [5 mrad].
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
    places = torch.einsum("bij,bjf->bif", axes[:, :2], mirror.points)
    canting = _canting(mirror.area_vectors, axes, places)
    return torch.cat([*slopes, *shifts, distance[:, None], cosine, canting / 5e-3], dim=1)


def _canting(area_vectors: Tensor, axes: Tensor, places: Tensor) -> Tensor:
    """Slope (B, 2) between facets on either side of the mirror's middle, across x and y.

    ``places`` (B, 2, F) [m] are the facets' along x and y; all mirrors have their facets on the
    same sides. Zero for mirrors whose facets are all on one line.
    """
    normals = torch.einsum("bij,bjf->bif", axes, area_vectors)
    slope = -normals[:, :2] / normals[:, 2:]
    middle = places.mean(dim=-1, keepdim=True)
    away = 0.05 * (places - middle).abs().amax(dim=(1, 2))[0]
    sides = (places - middle)[0]
    across = [
        slope[:, axis, sides[axis] > away].mean(-1) - slope[:, axis, sides[axis] < -away].mean(-1)
        if bool((sides[axis].abs() > away).any())
        else torch.zeros_like(slope[:, axis, 0])
        for axis in range(2)
    ]
    return torch.stack(across, dim=-1) / 2
