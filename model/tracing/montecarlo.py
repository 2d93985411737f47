"""The Monte Carlo tracer: the slow and simple reference.

Each ray has a random place on a random facet, a random direction from the sun's disc and aureole, a
random slope error, and a random tracking jitter. Reflection and intersection with the plane are
exact. It shares the scene with the convolution tracer but none of its method, so that each can be
tested against the other.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import InvalidInputError
from model.mount import rotation
from model.sunshape import Pillbox, random_angles
from model.surface import basis
from model.tracing.scene import Optics, Scene, Window, optics_of

Array = NDArray[np.float64]

CHUNK = 500_000
"""Rays traced at once; limits the memory to some hundred megabytes."""


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _across(axis: Array) -> Array:
    """Two unit vectors (2, ..., 3) that complete ``axis`` (..., 3) to an orthonormal frame."""
    helper = np.where(np.abs(axis[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    first = _unit(np.cross(axis, helper))
    return np.stack([first, np.cross(axis, first)])


class _FacetPoints(NamedTuple):
    """Points [m] of a facet, their area vectors [m2], each (n, 3), and parameters (n, 2)."""

    points: Array
    areas: Array
    parameters: Array


def _facet_points(
    control_points: Array, degree: int, count: int, rng: np.random.Generator
) -> _FacetPoints:
    """Random points of one facet (I, J, 3), uniform in the parameters."""
    u, v = rng.random((2, count))
    value_u, slope_u = basis(control_points.shape[0], degree, u)
    value_v, slope_v = basis(control_points.shape[1], degree, v)

    def product(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("nj,njc->nc", b, np.tensordot(a, control_points, axes=1)))

    areas = np.cross(product(slope_u, value_v), product(value_u, slope_v))
    return _FacetPoints(product(value_u, value_v), areas, np.stack([u, v], axis=-1))


def _sun_rays(sun: Array, optics: Optics, count: int, rng: np.random.Generator) -> Array:
    """Unit vectors (n, 3) towards random points of the sun."""
    angle, turn = random_angles(optics.sun_shape, count, rng), rng.uniform(0, 2 * np.pi, count)
    first, second = _across(sun)
    side = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    return np.asarray(np.cos(angle)[:, None] * sun + np.sin(angle)[:, None] * side)


def _sigma(value: float | Tensor, scene: Scene, index: int) -> float:
    """The standard deviation of one mirror of a scene."""
    return float(torch.as_tensor(value).detach().expand(scene.batch)[index])


def _rays(
    scene: Scene, index: int, optics: Optics, count: int, rng: np.random.Generator
) -> Iterator[tuple[Array, Array]]:
    """Hits (n, 2) [m] on the plane and projected areas (n,) [m2] of rays, facet by facet."""
    points, centers, suns = scene.in_plane()
    facets = (points[index].double() + centers[index].double()[:, None, None]).numpy()
    sun = _unit(suns[index].double().numpy())
    slope_error, jitter, pointing_error = (
        _sigma(value, scene, index)
        for value in (optics.slope_error, optics.tracking_jitter, optics.pointing_error)
    )
    obstacles, shades = (
        np.zeros((0, 3, 3)) if some is None else some[index].double().numpy()
        for some in map(scene.in_plane_frame, (scene.obstacles, scene.shades))
    )
    taken = 1.0 if scene.obstacle_share is None else float(scene.obstacle_share[index])
    shares = rng.multinomial(count, np.full(len(facets), 1 / len(facets)))
    for facet, share in enumerate(shares):
        place, area, spots = _facet_points(
            np.moveaxis(facets[facet], 0, -1), scene.degree, share, rng
        )
        visible = _visible_share(scene, index, facet, place, spots)
        if jitter > 0:
            angle = rng.normal(0, jitter, share)
            place, area = _rotate_about_jitter_axis(scene, index, place, area, angle)
        normal = _unit(area)
        toward_sun = _sun_rays(sun, optics, share, rng)
        # The light that a patch collects counts its own area, not that of the tilted micro-facets
        # on it.
        weight = (area * toward_sun).sum(axis=-1).clip(min=0) * visible * len(facets) / count
        if slope_error > 0:
            first, second = _across(normal)
            tilt = rng.normal(0, slope_error, (2, share, 1))
            normal = _unit(normal + tilt[0] * first + tilt[1] * second)
        out = 2 * (normal * toward_sun).sum(axis=-1, keepdims=True) * normal - toward_sun
        free = _is_free(obstacles, place, toward_sun) & _is_free(obstacles, place, out)
        weight = weight * (1 - taken * ~free)
        weight = weight * _is_free(shades, place, toward_sun)
        if pointing_error > 0:
            first, second = _across(out)
            tilt = rng.normal(0, pointing_error, (2, share, 1))
            out = _unit(out + tilt[0] * first + tilt[1] * second)
        distance = -place[:, 2] / out[:, 2]
        hits = place[:, :2] + distance[:, None] * out[:, :2]
        ahead = (distance > 0) & (out[:, 2] < 0)
        yield hits[ahead], weight[ahead]


class _PlaneFrame(NamedTuple):
    """A mirror's centre (3,) [m] in the frame of its plane, and the rotation (3, 3) from ENU."""

    center: Array
    rotation: Array


def _plane_frame(scene: Scene, index: int) -> _PlaneFrame:
    turn = scene.plane_axes[index].double().numpy()
    center = (scene.center[index] - scene.plane_center[index]).double().numpy()
    return _PlaneFrame(turn @ center, turn)


def _visible_share(scene: Scene, index: int, facet: int, place: Array, parameters: Array) -> Array:
    """Share (n,) of the light at mirror points (n, 3) in the plane's frame that is not lost."""
    share = np.ones(len(place))
    if scene.coverage is not None:
        cells = scene.coverage[index, facet].double().numpy()
        u, v = np.minimum(parameters * len(cells), len(cells) - 1).astype(int).T
        share *= cells[u, v]
    if scene.facet_reflectivity is not None:
        share *= float(scene.facet_reflectivity[index, facet])
    if scene.blocked_below is not None:
        center, turn = _plane_frame(scene, index)
        upwards = turn @ scene.attitude[index, :, 1].double().numpy()
        share *= (place - center) @ upwards >= float(scene.blocked_below[index])
    return share


def _is_free(obstacles: Array, place: Array, direction: Array) -> NDArray[np.bool_]:
    """Which rays (n,) from ``place`` (n, 3) along ``direction`` hit no rectangle (K, 3, 3)."""
    free = np.ones(len(place), dtype=bool)
    for center, right, up in obstacles:
        normal = np.cross(right, up)
        distance = (center - place) @ normal / (direction @ normal)
        meets = place + distance[:, None] * direction - center
        inside = (np.abs(meets @ right) < right @ right) & (np.abs(meets @ up) < up @ up)
        free &= ~(inside & (distance > 0))
    return free


class _Turned(NamedTuple):
    """Points [m] and their area vectors [m2], each (n, 3)."""

    points: Array
    areas: Array


def _rotate_about_jitter_axis(
    scene: Scene, index: int, place: Array, area: Array, angle: Array
) -> _Turned:
    """Rotate a mirror's points and area vectors about its jitter axis by angles (n,) [rad]."""
    if scene.jitter_axis is None:
        raise InvalidInputError("tracking jitter needs a scene with 'jitter_axis'")
    center, turn = _plane_frame(scene, index)
    jitter = rotation(turn @ scene.jitter_axis[index].double().numpy(), angle)
    points = center + np.einsum("nij,nj->ni", jitter, place - center)
    return _Turned(points, np.einsum("nij,nj->ni", jitter, area))


class MonteCarloFlux(NamedTuple):
    """Irradiance (B, rows, columns) [W/m2], row 0 at the top, and spots (B, 2) [m].

    A spot is the centre of mass under a point sun, right and up of the plane's centre.
    """

    irradiance: Array
    spot: Array


def trace_montecarlo(
    scene: Scene,
    window: Window,
    optics: Optics | None = None,
    *,
    rays: int = 1_000_000,
    seed: int = 0,
) -> MonteCarloFlux:
    """Trace every mirror of a scene with ``rays`` random rays, at least one."""
    if rays < 1:
        raise InvalidInputError("rays must be at least one")
    if scene.beam_moments is not None:
        raise InvalidInputError("this tracer cannot correct beams; use that by convolution")
    optics = optics_of(scene, optics or Optics())
    rng = np.random.default_rng(seed)
    images, spots = [], []
    for index in range(scene.batch):
        spot = _spot(scene, index, optics, np.random.default_rng((seed, index)))
        image = np.zeros((window.rows, window.columns))
        center = spot if window.on_spot else np.zeros(2)
        for start in range(0, rays, CHUNK):
            for hits, weight in _rays(scene, index, optics, min(CHUNK, rays - start), rng):
                image += _histogram(hits - center, weight, window) * min(CHUNK, rays - start) / rays
        images.append(image * _irradiance(scene, index, optics) / np.prod(window.pixel))
        spots.append(spot)
    return MonteCarloFlux(np.array(images), np.array(spots))


def _spot(scene: Scene, index: int, optics: Optics, rng: np.random.Generator) -> Array:
    """Centre of mass (2,) [m] of the light from the sun's centre, as in the convolution tracer."""
    point_sun = replace(
        optics, sun_shape=Pillbox(1e-6), slope_error=0.0, tracking_jitter=0.0, pointing_error=0.0
    )
    total, moment = 0.0, np.zeros(2)
    for hits, weight in _rays(scene, index, point_sun, 200_000, rng):
        total += weight.sum()
        moment += weight @ hits
    return moment / total


def _histogram(hits: Array, weight: Array, window: Window) -> Array:
    """Sum weights (n,) over the window's pixels (rows, columns)."""
    pixel_x, pixel_y = window.pixel
    column = np.floor((hits[:, 0] + window.width / 2) / pixel_x)
    row = np.floor((window.height / 2 - hits[:, 1]) / pixel_y)
    inside = (column >= 0) & (column < window.columns) & (row >= 0) & (row < window.rows)
    cell = (row[inside] * window.columns + column[inside]).astype(np.int64)
    image = np.bincount(cell, weight[inside], window.rows * window.columns).astype(np.float64)
    return image.reshape(window.rows, window.columns)


def _irradiance(scene: Scene, index: int, optics: Optics) -> float:
    distance = (scene.center[index] - scene.plane_center[index]).double().norm()
    own = 1.0 if scene.reflectance is None else float(scene.reflectance[index])
    return own * float(optics.irradiance(torch.as_tensor(distance)))
