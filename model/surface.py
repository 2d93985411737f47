"""Mirror surfaces as tensor-product B-splines (NURBS whose weights are all one).

A facet is a grid of control points with clamped uniform knots of any degree. heliotwin's surfaces
have their control points at the Greville abscissae, where x and y are linear in the parameters.
They store heights only: the deviation from the ideally canted, flat facet. Points and normals
always come with their area element |du x dv|, since on other grids (evenly spaced control points)
the parameters do not cover the mirror evenly.

Source: Piegl and Tiller, *The NURBS Book*, algorithms A2.2, A2.3 and section 9.2.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.errors import InvalidInputError
from model.plant import Heliostat

FACETS, ROWS, COLUMNS, DEGREE = 4, 8, 8, 3
"""heliotwin's grid: facets of the measured type, control points along x and y, spline's degree."""

Array = NDArray[np.float64]
Values = TypeVar("Values", Array, Tensor)


def knots(count: int, degree: int) -> Array:
    """Clamped uniform knots (count + degree + 1,) on [0, 1] for ``count`` control points."""
    if not 1 <= degree < count:
        raise InvalidInputError(
            f"a spline of degree {degree} needs more than {degree} control points, got {count}"
        )
    inner = np.linspace(0, 1, count - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)])


def greville(count: int, degree: int = DEGREE) -> Array:
    """Greville abscissae (count,) on [0, 1]: parameters at which control points give x(u) = u."""
    t = knots(count, degree)
    return np.array([t[i + 1 : i + 1 + degree].mean() for i in range(count)])


class Basis(NamedTuple, Generic[Values]):
    """Basis functions and their first derivatives, each (n, count)."""

    values: Values
    slopes: Values


def basis(count: int, degree: int, parameters: ArrayLike) -> Basis[Array]:
    """Evaluate the basis at ``parameters`` (n,) in [0, 1] by the Cox-de Boor recursion.

    The derivatives are computed from the functions of one degree less.
    """
    u, t = np.asarray(parameters, dtype=np.float64), knots(count, degree)
    span = np.clip(np.searchsorted(t, u, side="right") - 1, degree, count - 1)
    values = np.zeros((len(t) - 1, len(u)))  # transposed: each function is contiguous
    values[span, np.arange(len(u))] = 1.0
    lower = values
    for p in range(1, degree + 1):
        lower, values = values, np.zeros_like(values)
        for i in range(len(t) - 1 - p):
            if t[i + p] > t[i]:
                values[i] += (u - t[i]) / (t[i + p] - t[i]) * lower[i]
            if t[i + p + 1] > t[i + 1]:
                values[i] += (t[i + p + 1] - u) / (t[i + p + 1] - t[i + 1]) * lower[i + 1]
    slopes = np.zeros((count, len(u)))
    for i in range(count):
        if t[i + degree] > t[i]:
            slopes[i] += degree / (t[i + degree] - t[i]) * lower[i]
        if t[i + degree + 1] > t[i + 1]:
            slopes[i] -= degree / (t[i + degree + 1] - t[i + 1]) * lower[i + 1]
    return Basis(np.ascontiguousarray(values[:count].T), np.ascontiguousarray(slopes.T))


@lru_cache(maxsize=64)
def midpoint_basis(
    count: int, degree: int, samples: int, dtype: torch.dtype, device: torch.device
) -> Basis[Tensor]:
    """Evaluate the basis at the midpoints of ``samples`` equal parameter intervals."""
    found = basis(count, degree, (np.arange(samples) + 0.5) / samples)
    return Basis(*(torch.as_tensor(array, dtype=dtype, device=device) for array in found))


@lru_cache(maxsize=64)
def edge_basis(
    count: int, degree: int, samples: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Basis (samples + 1, count) at the ends of ``samples`` equal parameter intervals."""
    values = basis(count, degree, np.linspace(0, 1, samples + 1)).values
    return torch.as_tensor(values, dtype=dtype, device=device)


@dataclass(frozen=True, eq=False)
class FacetSamples:
    """Points of a surface with their areas; component first, as the tracers need them.

    Attributes
    ----------
    points : (..., 3, S) [m]
    area_vectors : (..., 3, S) [m2]
        Normals whose length is the sample's share of the mirror's area.
    """

    points: Tensor
    area_vectors: Tensor


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product along the third dimension from the end of (..., 3, S, T)."""
    ax, ay, az = a.unbind(-3)
    bx, by, bz = b.unbind(-3)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=-3)


def sample(control_points: Tensor, samples: int, degree: int = DEGREE) -> FacetSamples:
    """Evaluate every facet on a grid of parameter midpoints.

    Parameters
    ----------
    control_points : Tensor (..., F, 3, I, J) [m]
        In any Cartesian frame, which is also that of the samples.
    samples : int
        Along each parameter of each facet; S = F * samples**2.
    """
    (rows, columns), kind = control_points.shape[-2:], (control_points.dtype, control_points.device)
    value_u, slope_u = midpoint_basis(rows, degree, samples, *kind)
    value_v, slope_v = midpoint_basis(columns, degree, samples, *kind)
    along_v, along_v_slope = control_points @ value_v.T, control_points @ slope_v.T
    points = value_u @ along_v
    area_vectors = _cross(slope_u @ along_v, value_u @ along_v_slope) / samples**2
    return FacetSamples(_facets_last(points), _facets_last(area_vectors))


def _facets_last(values: Tensor) -> Tensor:
    """(..., F, 3, n, n) to (..., 3, F * n * n)."""
    return values.transpose(-4, -3).flatten(-3)


def canted(control_points: Tensor, tilt: Tensor) -> Tensor:
    """Rotate each facet of control points (B, F, 3, I, J) [m] about its centre; differentiable in
    both.

    ``tilt`` (B, F, 2) [rad] is added to the facet's slope along the mirror's x and y. Canting
    errors are milliradians: the first-order rotation errs by a millionth of the facet's size.
    """
    centre = control_points.mean(dim=(-2, -1), keepdim=True)
    x, y, z = (control_points - centre).unbind(2)
    along_x, along_y = tilt[..., 0, None, None], tilt[..., 1, None, None]
    turned = torch.stack([x - along_x * z, y - along_y * z, z + along_x * x + along_y * y], dim=2)
    return centre + turned


class FacetGrid(NamedTuple):
    """Points [m] and unit normals, each (..., n, m, 3), of facets on a grid of parameters."""

    points: Array
    normals: Array


def evaluate(
    control_points: ArrayLike, u: ArrayLike, v: ArrayLike, degree: int = DEGREE
) -> FacetGrid:
    """Evaluate facets on the grid ``u`` (n,) by ``v`` (m,).

    ``control_points`` is (..., I, J, 3) [m], the layout of files and reports.
    """
    points = np.asarray(control_points, dtype=np.float64)
    value_u, slope_u = basis(points.shape[-3], degree, u)
    value_v, slope_v = basis(points.shape[-2], degree, v)

    def product(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("ni,...ijc,mj->...nmc", a, points, b, optimize=True))

    normals = np.cross(product(slope_u, value_v), product(value_u, slope_v))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return FacetGrid(product(value_u, value_v), normals)


def squares(count: int, degree: int = DEGREE) -> Array:
    """Heights (count,) of the spline u**2 on [0, 1]: the blossom of the square at its knots."""
    t = knots(count, degree)
    inner = np.array([t[i + 1 : i + 1 + degree] for i in range(count)])
    pairs = inner.sum(axis=1) ** 2 - (inner**2).sum(axis=1)
    return np.asarray(pairs / (degree * (degree - 1)))


def nominal_heights(heliostat: Heliostat, shape: tuple[int, int] = (ROWS, COLUMNS)) -> Array:
    """Heights (F, *shape) [m] of the ideal facets over their planes, with zero facet means.

    A focused facet is the paraboloid z = (x**2 + y**2) / 4f, which splines are exactly.
    """
    half_sizes = heliostat.facet_frames.half_sizes
    curved = np.array([f.focal_length or np.inf for f in heliostat.facets])[:, None]
    # (2 u - 1)**2 = 4 u**2 - 4 u + 1 is the square of the place in half sizes.
    along_x, along_y = (4 * squares(n) - 4 * greville(n) + 1 for n in shape)
    x = half_sizes[:, :1] ** 2 / (4 * curved) * along_x
    y = half_sizes[:, 1:] ** 2 / (4 * curved) * along_y
    heights = x[:, :, None] + y[:, None, :]
    return np.asarray(heights - heights.mean(axis=(1, 2), keepdims=True))


def heights_or_ideal(heliostat: Heliostat, z: ArrayLike | None) -> Array:
    """Heights ``z`` (F, I, J) [m]; zeros, the ideal surface, for None."""
    if z is None:
        return np.zeros((len(heliostat.facets), ROWS, COLUMNS))
    return np.asarray(z, dtype=np.float64)


def control_points(heliostat: Heliostat, z: ArrayLike | None = None) -> Array:
    """Control points (F, I, J, 3) [m] in mirror coordinates of heights ``z`` (F, I, J) [m] over the
    ideal facets.

    None gives the ideal surface: flat or focused facets in their ideal poses.
    """
    centers, axes, half_sizes = heliostat.facet_frames
    heights = heights_or_ideal(heliostat, z)
    if heights.ndim != 3 or len(heights) != len(heliostat.facets) or not np.isfinite(heights).all():
        raise InvalidInputError(
            f"z must be finite heights (facets, i, j) for {len(heliostat.facets)} facets"
        )
    x = (2 * greville(heights.shape[1]) - 1)[None, :, None] * half_sizes[:, 0, None, None]
    y = (2 * greville(heights.shape[2]) - 1)[None, None, :] * half_sizes[:, 1, None, None]
    if any(facet.focal_length for facet in heliostat.facets):
        heights = heights + nominal_heights(heliostat, heights.shape[1:])
    local = np.stack(np.broadcast_arrays(x, y, heights), axis=-1)
    return np.asarray(centers[:, None, None, :] + np.einsum("fijc,fcd->fijd", local, axes))


def heights(
    heliostat: Heliostat,
    points: ArrayLike,
    degree: int = DEGREE,
    parameters_are_positions: bool = False,
    samples: int = 64,
    shape: tuple[int, int] = (ROWS, COLUMNS),
) -> Array:
    """Fit heights z (F, *shape) [m] with zero facet means to control points (F, I, J, 3) [m] in
    mirror coordinates.

    The slopes of the given surface, in the frame of each ideal facet, are fitted by least squares:
    deflectometry measures normals, which determine heights up to the facet's mean. Facets some
    millimetres off their ideal place keep their own centre.

    A normal is at the spline's point. With ``parameters_are_positions`` it is at the position that
    its parameters are of the facet's width and height: so ARTIST fits deflectometry.
    """
    _, axes, half_sizes = heliostat.facet_frames
    count = len(np.asarray(points))
    if count != len(axes):
        raise InvalidInputError(
            f"a surface of {count} facets for {heliostat.name}, which has {len(axes)}"
        )
    grid = (np.arange(samples) + 0.5) / samples
    places, normals = (
        np.einsum("fnmd,fcd->fnmc", vectors, axes).reshape(len(axes), -1, 3)
        for vectors in evaluate(points, grid, grid, degree)
    )
    uv = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    on_facet = np.broadcast_to(uv, (len(axes), *uv.shape))
    if not parameters_are_positions:
        corners = np.einsum("fnmd,fcd->fnmc", np.asarray(points)[:, [0, -1]][:, :, [0, -1]], axes)
        middles = corners[..., :2].mean(axis=(1, 2))[:, None]
        on_facet = (places[..., :2] - middles) / (2 * half_sizes[:, None]) + 0.5
    fitted = np.array(
        [
            fit_heights(own[inside, 0], own[inside, 1], normal[inside], size, shape)
            for own, inside, normal, size in zip(
                on_facet, _in_unit_square(on_facet), normals, half_sizes, strict=True
            )
        ]
    )
    if any(facet.focal_length for facet in heliostat.facets):
        fitted = fitted - nominal_heights(heliostat, shape)
    return fitted


def _in_unit_square(places: Array) -> Array:
    """Whether places (..., 2) are within [0, 1]."""
    return np.asarray(((places >= 0) & (places <= 1)).all(axis=-1))


def fit_heights(
    u: Array, v: Array, normals: Array, half_size: Array, shape: tuple[int, int] = (ROWS, COLUMNS)
) -> Array:
    """Fit heights (*shape) [m] with zero mean to the measured normals of one facet.

    Parameters
    ----------
    u, v : (n,)
        Places on the facet as spline parameters in [0, 1].
    normals : (n, 3)
        In the frame of the ideal facet, of any length.
    half_size : (2,) [m]
        Half the facet's width and height.
    """
    slopes = -normals[:, :2] / normals[:, 2:]
    gram, right = np.zeros((math.prod(shape), math.prod(shape))), np.zeros(math.prod(shape))
    for first in range(0, len(u), _FIT_BLOCK):
        block = slice(first, first + _FIT_BLOCK)
        value_u, slope_u = basis(shape[0], DEGREE, u[block])
        value_v, slope_v = basis(shape[1], DEGREE, v[block])
        pairs = ((slope_u, value_v), (value_u, slope_v))
        for (along_u, along_v), size, slope in zip(pairs, half_size, slopes[block].T, strict=True):
            design = np.einsum("ni,nj->nij", along_u, along_v).reshape(len(slope), -1) / (2 * size)
            gram += design.T @ design
            right += design.T @ slope
    # Slopes do not determine the constant mode; the pseudo-inverse sets it to zero.
    solution = np.linalg.pinv(gram, rcond=1e-12, hermitian=True) @ right
    return np.asarray((solution - solution.mean()).reshape(shape))


_FIT_BLOCK = 65_536
"""Normals that are fitted at once: their basis functions need some 100 MB."""


@lru_cache(maxsize=4)
def halving(count: int, degree: int = DEGREE) -> Array:
    """Matrix (2 * count - degree, count) from a spline's heights to those with halved spans."""
    places = (np.arange(16 * count) + 0.5) / (16 * count)
    fine, coarse = (basis(n, degree, places).values for n in (2 * count - degree, count))
    return np.asarray(np.linalg.lstsq(fine, coarse, rcond=None)[0])


def halved(z: ArrayLike) -> Array:
    """Heights (..., 8, 8) [m] on the grid (..., 13, 13) with halved spans."""
    return np.asarray(halving(ROWS) @ np.asarray(z, dtype=np.float64) @ halving(COLUMNS).T)


def mirrored(z: Array, order: Sequence[int] = (1, 0, 3, 2)) -> Array:
    """Mirrors (..., F, 8, 8) with left and right exchanged; ``order`` are the facets' new places.

    By default mirrors have four facets.
    """
    return np.asarray(z[..., list(order), ::-1, :])


class SurfaceParts(NamedTuple):
    """Canting and waviness (..., 8, 8) [m], which add up to the heights."""

    canting: Array
    waviness: Array


def split_canting(z: ArrayLike) -> SurfaceParts:
    """Split heights ``z`` (..., 8, 8) [m] into canting and waviness.

    Canting is the plane a x + b y of each facet that fits its heights best; on the Greville grid it
    is a rigid tilt.
    """
    surface: Any = np.asarray(z, dtype=np.float64)
    x, y = 2 * greville(surface.shape[-2]) - 1, 2 * greville(surface.shape[-1]) - 1
    design = np.stack(
        [a.ravel() for a in np.meshgrid(x, y, indexing="ij")] + [np.ones(x.size * y.size)], axis=-1
    )
    plane = design @ np.linalg.lstsq(design, surface.reshape(-1, x.size * y.size).T, rcond=None)[0]
    canting = plane.T.reshape(surface.shape)
    return SurfaceParts(canting, surface - canting)


def canting_rises(z: ArrayLike) -> Array:
    """Rise (..., F, 2) [m] over facets by canting, of heights (..., F, I, J) [m]."""
    canting = split_canting(z).canting
    across, up = canting[..., -1, 0] - canting[..., 0, 0], canting[..., 0, -1] - canting[..., 0, 0]
    return np.stack([across, up], axis=-1)
