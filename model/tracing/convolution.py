"""The convolution tracer: deterministic, batched, differentiable.

Notes
-----
Each sample of a mirror reflects one central ray of the sun to the target plane, with the power of
its part of the mirror. The cone about the ray (sun shape, slope errors) is the same for all samples
of a mirror, apart from their distance. So the image is a convolution, which is computed in
frequency space::

    image = F^-1 [ F(splat of the rays) * cone * patch * unsmear ]

    cone     transfer function of sun shape, slope error and jitter, scaled by the slant range
             and sheared by the beam's slope on the plane (`_cone_transfer`)
    patch    transfer function of the parallelogram of a sample, so that samples leave no grid
             (`_patch_transfer`)
    unsmear  inverse of the B-spline that spreads a ray over pixels, times the mean over a pixel
             (`_frequencies`)

A transform is periodic: light that leaves the padded window on one side would enter on the other.
So the sun's profile ends where that would begin. Light that misses the window by more is lost, as
in the field.

Approximations: the cone has the size of each mirror's or each facet's centre, and the cone is
small.

Source: analytic cone optics as in HELIOS and Lipps and Walzel, Solar Energy 21 (1978). The
formulation in frequency space, with a closed form of the transfer function's argument, is ours.
"""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple, TypeVar, cast

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from model.errors import InvalidInputError, UnreachableError
from model.images import normalized
from model.neighbours import clear
from model.sunshape import FREQUENCY_COUNT, FREQUENCY_STEP, SunShape, half_angle, transfer_table
from model.sunshape.base import SOFT_FROM
from model.surface import edge_basis, midpoint_basis, sample
from model.tracing.beam import BeamChange
from model.tracing.scene import Optics, Scene, Size, Window, by_facet, irradiance_of, optics_of

Result = TypeVar("Result")

MAX_GRID = 2**25
"""Largest number of pixels of padded windows in one batch: about 22 bytes each."""


@dataclass(frozen=True, eq=False)
class TracedFlux:
    """Traced flux.

    Attributes
    ----------
    irradiance : Tensor (B, rows, columns) [W/m2]
        Row 0 at the top.
    spot : Tensor (B, 2) [m]
        Centre of mass of the central rays, right and up of the plane's centre.
    center : Tensor (B, 2) [m]
        Centre of the window on the plane.
    power : Tensor (B,) [W]
        Reflected power, inside and outside of the window.
    """

    irradiance: Tensor
    spot: Tensor
    center: Tensor
    power: Tensor

    def normalized(self) -> Tensor:
        """Flux (B, rows, columns) with a sum of 100."""
        return normalized(self.irradiance)


@dataclass(frozen=True, eq=False)
class Rays:
    """Central rays on the target plane.

    Attributes
    ----------
    hits : Tensor (B, 2, S) [m]
        Right and up of the plane's centre.
    power : Tensor (B, S) [m2]
        Projected mirror area of each ray.
    lit : Tensor (B, 2) [m2]
        Projected mirror area before shading and blocking, and before blocking.
    direction : Tensor (B, 3)
        Mean unit direction from mirror to target, in the plane's frame.
    slant_range : Tensor (B,) [m]
    normal : Tensor (B, 3)
        Mean mirror normal in the plane's frame.
    footprint : Tensor (B, 2, 2) [m]
        Distance, right and up, of the hits of adjacent samples along the facet's x and y; mirror
        means.
    spot_per_angle : Tensor (B, 2) or None [m/rad]
        Movement of the spot, right and up, with a rotation about the mount's first axis, if that is
        known.
    beam : BeamChange or None
    """

    hits: Tensor
    power: Tensor
    lit: Tensor
    direction: Tensor
    slant_range: Tensor
    normal: Tensor
    footprint: Tensor
    spot_per_angle: Tensor | None
    beam: BeamChange | None = None

    @property
    def spot(self) -> Tensor:
        """Centre of mass (B, 2) [m]."""
        return self.spot_of(1)

    def spot_of(self, parts: int) -> Tensor:
        """Common centre of mass (B / parts, 2) [m] of mirrors that were traced in several parts."""
        moment = (self.hits * self.power[:, None]).sum(-1).view(-1, parts, 2).sum(1)
        return moment / self.power.sum(-1).view(-1, parts).sum(1, keepdim=True)


def central_rays(scene: Scene, samples: int) -> Rays:
    """Reflect the sun's centre at ``samples``**2 points of each facet, and intersect the plane.

    Raises
    ------
    UnreachableError
        If a mirror faces away from the sun or from the target.
    """
    control_points, center, sun = scene.in_plane()
    mirror = sample(control_points, samples, scene.degree)
    points, normals = mirror.points + center[..., None], mirror.area_vectors
    facing = (normals * sun[..., None]).sum(-2)
    # Reflection without square roots: the area vectors need no normalising.
    scale = 2 * facing / (normals * normals).sum(-2)
    direction = normals * scale[:, None] - sun[..., None]
    mean_normal, mean_point = normals.mean(-1), points.mean(-1)
    mean_normal = mean_normal / mean_normal.norm(dim=-1, keepdim=True)
    beam = 2 * (mean_normal * sun).sum(-1, keepdim=True) * mean_normal - sun
    if bool(((mean_normal * sun).sum(-1) <= 0).any()) or bool(
        ((-beam[:, 2] <= 1e-3) | (mean_point[:, 2] <= 0)).any()
    ):
        raise UnreachableError(
            "a mirror shows its back to the sun or to the target; check sun, target and alignment"
        )
    distance = points[:, 2] / direction[:, 2]
    hits = points[:, :2] - direction[:, :2] * distance[:, None]
    power = facing.clamp(min=0)
    if scene.facet_reflectivity is not None:
        power = power * scene.facet_reflectivity.repeat_interleave(
            power.shape[-1] // scene.facet_reflectivity.shape[-1], dim=-1
        )
    if scene.blocked_below is not None:
        power = power * _unblocked(scene, scene.blocked_below, samples)
    if scene.coverage is not None:
        power = power * _covered(scene.coverage, samples)
    power, lit = _unobstructed(scene, power, points, normals, direction)
    slant_range = mean_point[:, 2] / -beam[:, 2]
    spot_per_angle = (
        None
        if scene.jitter_axis is None
        else _spot_per_angle(scene, scene.jitter_axis, mean_normal, sun, beam, slant_range)
    )
    footprint = _footprint(hits, samples)
    change = _beam_change(scene, beam, slant_range)
    return Rays(hits, power, lit, beam, slant_range, mean_normal, footprint, spot_per_angle, change)


def _covered(coverage: Tensor, samples: int) -> Tensor:
    """Share (B, F * samples**2) of samples within their facets' outlines (B, F, n, n)."""
    whole = coverage.mean(dim=(-2, -1), keepdim=True)
    cells = adaptive_avg_pool2d(coverage, samples)
    return (cells * (whole / cells.mean(dim=(-2, -1), keepdim=True))).flatten(1)


class _Unobstructed(NamedTuple):
    """Projected areas (B, S) [m2] that see sun and target, and `Rays.lit` (B, 2) [m2]."""

    power: Tensor
    lit: Tensor


def _unobstructed(
    scene: Scene, power: Tensor, points: Tensor, normals: Tensor, direction: Tensor
) -> _Unobstructed:
    """Take the light that neighbours and the tower hide.

    ``points`` [m], ``normals`` [m2] and ``direction`` are (B, 3, S) in the plane's frame.
    """
    obstacles, shades = (scene.in_plane_frame(some) for some in (scene.obstacles, scene.shades))
    before_sun = [some for some in (obstacles, shades) if some is not None]
    everything = power.sum(-1)
    if not before_sun:
        return _Unobstructed(power, torch.stack([everything, everything], dim=-1))
    sun = torch.einsum("bij,bj->bi", scene.plane_axes, scene.sun)[..., None]
    cell = normals.norm(dim=1).mean(dim=-1).sqrt()
    sees_sun = clear(torch.cat(before_sun, dim=1), points, sun, cell)
    free = sees_sun
    if obstacles is not None:
        free = torch.minimum(sees_sun, clear(obstacles, points, direction, cell))
    if scene.obstacle_share is not None:
        share = scene.obstacle_share[:, None]
        sees_sun, free = (1 - share * (1 - some) for some in (sees_sun, free))
    lit = torch.stack([everything, (power * sees_sun).sum(-1)], dim=-1)
    return _Unobstructed(power * free, lit)


def _unblocked(scene: Scene, line: Tensor, samples: int) -> Tensor:
    """Share (B, S) of each sample's cell above ``line`` (B,) [m] along the mirror's y.

    Cells are divided, not dropped, so that the power is a continuous function of the line.
    """
    y = scene.control_points[:, :, 1]
    value_u, _ = midpoint_basis(y.shape[-2], scene.degree, samples, y.dtype, y.device)
    edges = value_u @ y @ edge_basis(y.shape[-1], scene.degree, samples, y.dtype, y.device).T
    low, high = edges[..., :-1], edges[..., 1:]
    share: Tensor = ((high - line[:, None, None, None]) / (high - low)).clamp(0, 1)
    return share.flatten(1)


def _spot_per_angle(
    scene: Scene, axis: Tensor, normal: Tensor, sun: Tensor, beam: Tensor, slant_range: Tensor
) -> Tensor:
    """Movement (B, 2) [m/rad] of the spot as mirrors rotate about ``axis`` (B, 3).

    All but the axis are in the plane's frame. The normal moves by axis x normal, and the beam 2
    (n.s) n - s by its derivative. The spot moves by the slant range times the part of that across
    the beam, projected along the beam to the plane.
    """
    moved = torch.linalg.cross(torch.einsum("bij,bj->bi", scene.plane_axes, axis), normal)
    turned = 2 * (
        (moved * sun).sum(-1, keepdim=True) * normal + (normal * sun).sum(-1, keepdim=True) * moved
    )
    return moved_spot(turned, beam, slant_range)


def moved_spot(turned: Tensor, beam: Tensor, slant_range: Tensor) -> Tensor:
    """Movement (..., 2) [m] of light on the plane as beams (..., 3) turn by ``turned`` (..., 3)."""
    moved: Tensor = slant_range[..., None] * (
        turned[..., :2] - beam[..., :2] * turned[..., 2:] / beam[..., 2:]
    )
    return moved


def _beam_change(scene: Scene, beam: Tensor, slant_range: Tensor) -> BeamChange | None:
    """The scene's change of beams (B, 3) on its planes; None if there is none."""
    if scene.beam_turns is None or scene.beam_moments is None:
        return None
    return BeamChange(beam_moves(scene, scene.beam_turns, beam, slant_range), scene.beam_moments)


def beam_moves(scene: Scene, turns: Tensor, beam: Tensor, slant_range: Tensor) -> Tensor:
    """Movement (B, T, 2) [m/mrad] of light on the planes with ``turns`` (B, T, 3) of the beam.

    ``beam`` (B, 3) is its direction in the planes' frames, and ``slant_range`` (B,) is in metres.
    """
    turned = torch.einsum("bij,btj->bti", scene.plane_axes, turns)
    return moved_spot(turned, beam[:, None], slant_range[:, None])


def _footprint(hits: Tensor, samples: int) -> Tensor:
    """Mean steps (B, 2 along x and y, 2) [m] between the hits (B, 2, S) of adjacent samples."""
    if samples < 2:
        return hits.new_zeros(len(hits), 2, 2)
    grid = hits.view(*hits.shape[:2], -1, samples, samples)
    along_x = (grid[..., -1, :] - grid[..., 0, :]).mean(dim=(-2, -1))
    along_y = (grid[..., :, -1] - grid[..., :, 0]).mean(dim=(-2, -1))
    return torch.stack([along_x, along_y], dim=1) / (samples - 1)


class _Frequencies(NamedTuple):
    """Frequencies right (1, C/2+1) and up (R, 1) [cycles/m] of a real FFT.

    ``unsmear`` (R, C/2+1) is the inverse of the splat's smear.
    """

    right: Tensor
    up: Tensor
    unsmear: Tensor


_CACHED_PIXELS = 2**20  # frequencies of larger images would take more memory than time


def _frequencies(
    rows: int, columns: int, pixel: Size, dtype: torch.dtype, device: torch.device
) -> _Frequencies:
    """Return the frequencies of `_compute_frequencies`, cached if the image is small."""
    is_small = rows * columns <= _CACHED_PIXELS
    compute = _cached_frequencies if is_small else _compute_frequencies
    return compute(rows, columns, pixel, dtype, device)


def _compute_frequencies(
    rows: int, columns: int, pixel: Size, dtype: torch.dtype, device: torch.device
) -> _Frequencies:
    """Compute the frequencies of an image.

    A quadratic B-spline multiplies by sinc^3 along each axis, the mean over a pixel by sinc; two
    sincs remain to be divided out.
    """
    right = torch.fft.rfftfreq(columns, dtype=dtype, device=device)[None, :]
    # Rows run downwards, the plane's second axis up.
    up = -torch.fft.fftfreq(rows, dtype=dtype, device=device)[:, None]
    unsmear = 1 / (torch.sinc(right) * torch.sinc(up)) ** 2
    return _Frequencies(right / pixel[0], up / pixel[1], unsmear)


_cached_frequencies = lru_cache(maxsize=16)(_compute_frequencies)


def _patch_transfer(rays: Rays, right: Tensor, up: Tensor) -> Tensor:
    """Transfer function (B, R, C/2+1) of the patch of light of each ray.

    The patches of a flat mirror tile its image without gaps and overlaps, so that samples leave no
    grid.
    """
    step_x, step_y = rays.footprint[:, 0, :, None, None], rays.footprint[:, 1, :, None, None]
    return torch.sinc(step_x[:, 0] * right + step_x[:, 1] * up) * torch.sinc(
        step_y[:, 0] * right + step_y[:, 1] * up
    )


def _interpolate(table: Tensor, frequency: Tensor) -> Tensor:
    """Interpolate a transfer table (K,) or (B, K) linearly at frequencies (B, ...) [cycles/rad]."""
    position = (frequency / FREQUENCY_STEP).clamp(max=FREQUENCY_COUNT - 1.001)
    index = position.detach().long()
    fraction = position - index
    if table.ndim == 1:
        low, high = table[index], table[index + 1]
    else:
        flat = index.flatten(1)
        low = table.gather(1, flat).view_as(position)
        high = table.gather(1, flat + 1).view_as(position)
    return torch.lerp(low, high, fraction)


def _cone_transfer(rays: Rays, optics: Optics, right: Tensor, up: Tensor, table: Tensor) -> Tensor:
    """Transfer function (B, R, C/2+1) of the reflected cone and of the mount's jitter, on the
    target plane.

    A ray tilted by a small angle e (a vector across the beam d) hits the plane, whose normal is z,
    shifted by R (e - d e_z / d_z). So the frequency f on the plane corresponds to the angular
    frequency g = R (f - z (d.f) / d_z) across the beam. The length of g is the argument of the sun
    shape's transfer function. Its components in the plane of incidence and across it are those of
    the slope error, which rotates the ray by twice the error in that plane, and by
    2 cos(incidence) times the error across it.
    """
    d, n = rays.direction, rays.normal
    slope = -d[:, :2] / d[:, 2:]
    across_beam = _square(slope) + d.new_tensor([1.0, 0.0, 1.0])
    # The tiny term keeps the root's gradient finite at frequency zero.
    # A sum of squares, unlike the form below, loses no digits that refinement needs.
    dx, dy, dz = d[:, :, None, None].unbind(1)
    beyond = -(dx * right + dy * up) / dz
    squared = rays.slant_range[:, None, None] ** 2 * (right**2 + up**2 + beyond**2 + 1e-24)
    if rays.beam is not None:
        squared = (squared + rays.beam.sun_stretch(right, up)).clamp(min=1e-24)
    transfer = _interpolate(table, torch.sqrt(squared))
    variance = torch.zeros_like(across_beam)
    if _is_given(optics.slope_error):
        cosine = (n * d).sum(-1, keepdim=True)
        across = torch.linalg.cross(n, d)
        across = across / across.norm(dim=-1, keepdim=True).clamp(min=1e-12)
        perpendicular = _square(across[:, :2] + across[:, 2:] * slope)
        of_normals = 4 * (across_beam - perpendicular * (1 - cosine**2))
        variance = variance + _variance(optics.slope_error, rays) * of_normals
    if _is_given(optics.pointing_error):
        variance = variance + _variance(optics.pointing_error, rays) * across_beam
    variance = variance * rays.slant_range[:, None] ** 2
    if _is_given(optics.tracking_jitter):
        if rays.spot_per_angle is None:
            raise InvalidInputError("tracking jitter needs a scene with 'jitter_axis'")
        moved = _square(rays.spot_per_angle)
        variance = variance + _variance(optics.tracking_jitter, rays) * moved
    if any(map(_is_given, (optics.slope_error, optics.pointing_error, optics.tracking_jitter))):
        transfer = transfer * torch.exp(_evaluate(-2 * math.pi**2 * variance, right, up))
    return transfer


def _is_given(error: float | Tensor) -> bool:
    return isinstance(error, Tensor) or error > 0


def _variance(error: float | Tensor, rays: Rays) -> Tensor:
    """Variance (B or 1, 1) [rad2] of an error."""
    return torch.as_tensor(error).to(rays.direction).reshape(-1, 1) ** 2


def _square(vector: Tensor) -> Tensor:
    """The quadratic form (B, 3) of frequencies that is the square of (v.f), of vectors v (B, 2)."""
    x, y = vector.unbind(-1)
    return torch.stack([x * x, 2 * x * y, y * y], dim=-1)


def _evaluate(form: Tensor, right: Tensor, up: Tensor) -> Tensor:
    """Values (B, R, C) of quadratic forms (B, 3) at frequencies right (1, C) and up (R, 1)."""
    xx, xy, yy = form[:, :, None, None].unbind(1)
    return (xx * right**2 + yy * up**2) + (xy * right) * up


def splat(x: Tensor, y: Tensor, weight: Tensor, rows: int, columns: int) -> Tensor:
    """Spread weights (B, S) over pixels (B, rows, columns) at coordinates x, y (B, S).

    Each becomes a quadratic B-spline, three pixels wide. The regular grid of rays would interfere
    visibly with the pixels under a narrower one, and its slope is continuous for gradients. Weights
    outside of the image are lost.
    """
    column, row = x.detach().round(), y.detach().round()
    inside = (column >= 1) & (column < columns - 1) & (row >= 1) & (row < rows - 1)
    across, down = quadratic(x - column), quadratic(y - row)
    batch = torch.arange(x.shape[0], device=x.device)[:, None] * (rows * columns)
    corner = (
        batch
        + (row.clamp(1, rows - 2).long() - 1) * columns
        + column.clamp(1, columns - 2).long()
        - 1
    )
    corner = corner.flatten()
    weight = weight * inside
    image = torch.zeros(x.shape[0] * rows * columns, dtype=x.dtype, device=x.device)
    for step_down, share_down in enumerate(down):
        line = weight * share_down
        for step_across, share_across in enumerate(across):
            image = image.index_add(
                0, corner + (step_down * columns + step_across), (line * share_across).flatten()
            )
    return image.view(x.shape[0], rows, columns)


def quadratic(offset: Tensor) -> list[Tensor]:
    """Shares of three pixels: before, at and after the one nearest to a point, at ``offset``."""
    return [0.5 * (0.5 - offset) ** 2, 0.75 - offset**2, 0.5 * (0.5 + offset) ** 2]


_CONE_SHARE = 0.99  # of the sun's light; windows are padded by its extent
_ENDS_PER_OCTAVE = 4  # mirrors whose light ends at about the same angle share a table
_MARGIN = 2 ** (1 / _ENDS_PER_OCTAVE) / SOFT_FROM  # the next step, and the soft end there


def _reach(rays: Rays, optics: Optics) -> float:
    """Distance [m] on the plane from a ray's hit within which nearly all of its light lands."""
    errors = [
        float(torch.as_tensor(sigma).detach().max())
        for sigma in (optics.slope_error, optics.tracking_jitter, optics.pointing_error)
    ]
    sun = _MARGIN * _cached(half_angle, optics.sun_shape, _CONE_SHARE)
    if rays.beam is not None:
        sun *= 1 + max(0.0, float(rays.beam.moments[:, -2:].max()))
    angle = sun + 6 * math.hypot(*errors)
    return float(angle * _per_angle(rays).max())


def _per_angle(rays: Rays) -> Tensor:
    """Largest shift (B,) [m/rad] on the plane per angle, which is in the plane of incidence."""
    return (rays.slant_range / -rays.direction[:, 2]).detach()


def _sun_tables(sun: SunShape, rays: Rays, free: float) -> Tensor:
    """Transfer function (K,) or (B, K) of the sun's light within ``free`` [m] of a ray."""
    dtype, device = rays.hits.dtype, rays.hits.device
    steps = (torch.log2(free / _per_angle(rays)) * _ENDS_PER_OCTAVE).floor()
    # One step above the sun's edge all of the light is inside.
    whole = math.ceil(math.log2(sun.edges[-1]) * _ENDS_PER_OCTAVE) + 1
    different, which = torch.unique(steps.clamp(max=whole), return_inverse=True)
    if float(different[0]) == whole:
        return _cached(transfer_table, sun, dtype, device)
    ends = tuple((2 ** (different / _ENDS_PER_OCTAVE)).tolist())
    tables = _cached(transfer_table, sun, dtype, device, ends)
    return tables[0] if len(ends) == 1 else tables[which]


def _cached(work: Callable[..., Result], sun: SunShape, *given: Hashable) -> Result:
    """Call ``work`` with a sun; results of suns of plain numbers are cached."""
    if any(isinstance(value, Tensor) for value in vars(sun).values()):
        return work(sun, *given)
    return cast(Result, _cached_call(work, sun, *given))


@lru_cache(maxsize=128)
def _cached_call(work: Callable[..., object], sun: Any, *given: Hashable) -> object:
    return work(sun, *given)


def _padded_size(size: int, padding: float, reach: float) -> int:
    """Padded size: even, with small prime factors, and ``padding`` of the window on each side.

    Both sides together are at least ``reach`` [px], or the window's size if that is smaller: no
    light from farther away returns to the window.
    """
    least = math.ceil((size + max(2 * padding * size, min(reach, size))) / 2)
    return 2 * int(next_fast_len(least, real=True))


def trace(
    scene: Scene,
    window: Window,
    optics: Optics | None = None,
    *,
    samples: int = 32,
    padding: float = 0.5,
    cones: Literal["mirror", "facet"] = "mirror",
) -> TracedFlux:
    """Trace the flux of every mirror of a scene.

    Parameters
    ----------
    scene : Scene
    window : Window
    optics : Optics, optional
        By default Buie's sun with a circumsolar ratio of 0.02, 1000 W/m2 and a perfect mirror.
    samples : int
        Rays along each side of each facet.
    padding : float
        Distance beyond the window, in windows, up to which rays are followed; more if the sun's
        cone is larger.
    cones : {"mirror", "facet"}
        Whether the reflected cone is that of each mirror's or of each facet's centre. The latter
        costs four times as much. It matters for mirrors near the tower, whose facets differ in
        distance.

    Raises
    ------
    UnreachableError
        If a mirror faces away from the sun or from the target.
    """
    if samples < 1:
        raise InvalidInputError("samples must be at least one")
    optics = optics or Optics()
    traced = scene if cones == "mirror" else by_facet(scene)
    rays = central_rays(traced, samples)
    parts = len(rays.power) // scene.batch
    spot = rays.spot_of(parts)
    center = spot if window.on_spot else torch.zeros_like(spot)
    optics = replace(
        optics,
        slope_error=_of_parts(optics.slope_error, parts),
        tracking_jitter=_of_parts(optics.tracking_jitter, parts),
        pointing_error=_of_parts(optics.pointing_error, parts),
    )
    optics = optics_of(traced, optics)
    irradiance = irradiance_of(traced, optics, rays.slant_range)
    image = _image(
        rays,
        center.repeat_interleave(parts, dim=0),
        window,
        optics,
        irradiance,
        (padding, padding),
        parts,
    )
    power = (rays.power.sum(-1) * irradiance).view(-1, parts).sum(1)
    return TracedFlux(irradiance=image, spot=spot, center=center, power=power)


def _of_parts(value: float | Tensor, parts: int) -> float | Tensor:
    """A value of all mirrors unchanged, or values (B,), each repeated for the mirror's parts."""
    return (
        value.repeat_interleave(parts) if isinstance(value, Tensor) and value.numel() > 1 else value
    )


@dataclass(frozen=True, eq=False)
class Raster:
    """Rays in padded windows, and what blurs them.

    Attributes
    ----------
    x, y : Tensor (B, S) [px]
        Column and row.
    weight : Tensor (B, S) [W/m2]
        Irradiance of a pixel that holds the whole ray.
    transfer : Tensor (B, R, C / 2 + 1)
        Of cone, patch and mount, with the splat's smear undone.
    shape : tuple of int
        Rows R and columns C with padding.
    inner : tuple of slice
        The window in them.
    """

    x: Tensor
    y: Tensor
    weight: Tensor
    transfer: Tensor
    shape: tuple[int, int]
    inner: tuple[slice, slice]

    def blurred(self, images: Tensor, parts: int = 1) -> Tensor:
        """Blur sharp images (..., B, R, C), add up ``parts`` mirrors each, and crop them."""
        spectrum = (torch.fft.rfft2(images) * self.transfer).unflatten(-3, (-1, parts)).sum(-3)
        whole: Tensor = torch.fft.irfft2(spectrum, s=self.shape)
        return whole[..., self.inner[0], self.inner[1]]


def raster(
    rays: Rays,
    center: Tensor,
    window: Window,
    optics: Optics,
    irradiance: Tensor,
    padding: tuple[float, float],
) -> Raster:
    """Place rays (B) in windows about ``center`` (B, 2) [m]; padding is (vertical, horizontal)."""
    pixel_x, pixel_y = window.pixel
    reach = _reach(rays, optics)
    rows = _padded_size(window.rows, padding[0], reach / pixel_y)
    columns = _padded_size(window.columns, padding[1], reach / pixel_x)
    if len(rays.hits) * rows * columns > MAX_GRID:
        raise InvalidInputError(
            f"resolution: {window.rows} x {window.columns} pixels of {pixel_x:.3g} m x"
            f" {pixel_y:.3g} m need a grid of {rows} x {columns}, {MAX_GRID} pixels are the most;"
            " ask for fewer"
        )
    free = min((rows - window.rows) * pixel_y, (columns - window.columns) * pixel_x)
    table = _sun_tables(optics.sun_shape, rays, free)
    first_row, first_column = (rows - window.rows) // 2, (columns - window.columns) // 2
    x = (rays.hits[:, 0] - center[:, :1] + window.width / 2) / pixel_x + first_column - 0.5
    y = (window.height / 2 - rays.hits[:, 1] + center[:, 1:]) / pixel_y + first_row - 0.5
    right, up, unsmear = _frequencies(rows, columns, window.pixel, x.dtype, x.device)
    transfer = (
        _cone_transfer(rays, optics, right, up, table) * _patch_transfer(rays, right, up) * unsmear
    )
    if rays.beam is not None:
        transfer = transfer * rays.beam.transfer(right, up)
    inner = (
        slice(first_row, first_row + window.rows),
        slice(first_column, first_column + window.columns),
    )
    return Raster(
        x,
        y,
        rays.power * (irradiance / (pixel_x * pixel_y))[:, None],
        transfer,
        (rows, columns),
        inner,
    )


def _image(
    rays: Rays,
    center: Tensor,
    window: Window,
    optics: Optics,
    irradiance: Tensor,
    padding: tuple[float, float],
    parts: int,
) -> Tensor:
    """Irradiance (B / parts, rows, columns) [W/m2] of rays (B) in windows about ``center``."""
    rays_on_grid = raster(rays, center, window, optics, irradiance, padding)
    return rays_on_grid.blurred(
        splat(rays_on_grid.x, rays_on_grid.y, rays_on_grid.weight, *rays_on_grid.shape), parts
    )
