"""Kinds of generic terms: how light and images change by what no effect of the catalogue describes.

A kind says where something acts, and has a few components. Each changes images in proportion to its
coefficient if that is small. Large coefficients are applied exactly: mirrors are traced again,
blurs multiply the spectrum, and images are resampled.

Notes
-----
With the coefficients c_k of a photograph, its image f, places x on the target and frequencies q::

    transfer   F^-1 [ F(f) exp(sum c_k h_k(q)) ]     blur; third moments by imaginary h
    warp       f(x - sum c_k u_k(x))
    scale      f exp(sum c_k p_k(x, f))
    add        f + peak(f) sum c_k p_k(x)
    sun        trace with a sun that is 1 + c_k times as large along both directions
    heights    trace of the mirror with heights sum c_k z_k
    light      trace of the mirror with its light times 1 + sum c_k p_k
    places     trace of the mirror with facets moved by sum c_k x_k
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from torch import Tensor

from model.images import COARSE_SIZE, binned
from model.mount import Mount
from model.setup import Setup
from model.tracing import Scene
from model.tracing.beam import MAX_SHARPENING, TAILS_MRAD, axis_moments, sun_moments
from model.tracing.scene import COVERAGE_CELLS

Array = NDArray[np.float64]
Place = Literal["mirror", "angle", "camera", "target", "geometry", "added_light"]
Owner = Literal["all", "heliostat", "camera", "target"]
Operator = Literal["transfer", "warp", "scale", "add", "sun", "heights", "light", "places"]

MAX_FACETS = 6
"""Largest number of facets that have separate components."""

FINE = range(1, 21)
"""Numbers of half periods of stripes over a target's width."""

_STEP = 1e-4
"""Angle [rad] of the finite difference for the movement of beams with a mount's axis."""

_MIN_REACH = 0.01
"""Distance [m] from the middle below which facets are in one row or column, which has no gaps."""

ORDERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3), (4, 0), (0, 4))
"""Powers of x and y of height changes; tilts, curvatures, and finer modes."""

LIGHT_ORDERS = ((0, 0), *ORDERS)
"""Powers of x and y of changes of a facet's light, which span -1 to 1 over the facet."""


class Component(NamedTuple):
    """A component of a generic term, and the unit of its coefficient."""

    name: str
    unit: str


def _components(unit: str, names: str) -> tuple[Component, ...]:
    return tuple(Component(name, unit) for name in names.split(", "))


@dataclass(frozen=True, eq=False)
class SpotImages:
    """Images (n, R, C) of spots, and where they lie on their targets.

    Attributes
    ----------
    images : (n, R, C)
    size : (float, float) [m]
        Width and height of the images.
    places : (n, 2) [m]
        Centres of the images, right and up of the target's centre.
    half : (n, 1, 1) [m]
        Half the target's width.
    slant_range : (n,) [m]
    window : float [m]
        Side of the photographs' cuts that the coefficients were fitted to.
    moves : (n, 4, 2) [m/mrad] or None
        How far light moves, right and up, with the turns of `model.tracing.beam`.
    """

    images: Array
    size: tuple[float, float]
    places: Array
    half: Array
    slant_range: Array
    window: float
    moves: Array | None = None

    @cached_property
    def offsets(self) -> Array:
        """Places (2, R, C) [m] in an image, right and up of its centre."""
        right, down = (
            ((np.arange(count) + 0.5) / count - 0.5) * side
            for count, side in zip(self.images.shape[:0:-1], self.size, strict=True)
        )
        return np.array(np.meshgrid(right, -down))

    @cached_property
    def on_target(self) -> Array:
        """Places (2, n, R, C) on the target, right and up, in halves of its width."""
        places = self.offsets[:, None] + self.places.T[:, :, None, None]
        return np.asarray(places / self.half)

    @cached_property
    def waves(self) -> Array:
        """Frequencies (2, 2 R, C + 1) [rad/m], right and up, of the mirrored images."""
        rows, columns = self.images.shape[1:]
        right = np.fft.rfftfreq(2 * columns, self.size[0] / columns)
        up = np.fft.fftfreq(2 * rows, self.size[1] / rows)
        return 2 * np.pi * np.array(np.meshgrid(right, -up))

    def phase(self, turn: int) -> Array:
        """Phases (n, 2 R, C + 1) [1/mrad] by a turn of the beam."""
        assert self.moves is not None
        return np.asarray(np.einsum("nd,dij->nij", self.moves[:, turn], self.waves))

    @property
    def peaks(self) -> Array:
        """Largest values (n, 1, 1)."""
        return np.asarray(self.images.max(axis=(1, 2), keepdims=True).clip(min=1e-300))

    @cached_property
    def slopes(self) -> Array:
        """Slopes (2, n, R, C) [1/m] of the images, right and up."""
        return np.array([self.filtered(1j * wave) for wave in self.waves])

    def filtered(self, transfer: NDArray[Any]) -> Array:
        """Images times a transfer function (n, 2 R, C + 1), or (2 R, C + 1) for all."""
        return _image_of(self._spectrum * transfer)

    @cached_property
    def _spectrum(self) -> NDArray[np.complex128]:
        return _mirrored_spectrum(self.images)

    def settle(self, images: Array) -> Array:
        """Centre images (n, R, C) on their centres of mass, and scale them to sum one."""
        images = images.clip(min=0)
        images = images / images.sum(axis=(1, 2), keepdims=True)
        phase = np.einsum("nd,dij->nij", self._moments(images), self.waves)
        moved = _image_of(_mirrored_spectrum(images) * np.exp(1j * phase))
        moved = moved.clip(min=0)
        return np.asarray(moved / moved.sum(axis=(1, 2), keepdims=True))

    def settled_change(self, change: Array) -> Array:
        """First order of `settle` for a small ``change`` (n, R, R) of images of sum one.

        Binned to (n, `COARSE_SIZE`, `COARSE_SIZE`).
        """
        total, moments = change.sum(axis=(1, 2)), self._moments(change)
        amounts = (-total, *(moments - total[:, None] * self._moments(self.images)).T)
        settled = binned(change, COARSE_SIZE)
        for amount, part in zip(amounts, self._coarse_parts, strict=True):
            settled += amount[:, None, None] * part
        return settled

    @cached_property
    def _coarse_parts(self) -> list[Array]:
        """Images and their slopes, right and up, binned to `COARSE_SIZE`."""
        return [binned(part, COARSE_SIZE) for part in (self.images, *self.slopes)]

    def _moments(self, images: Array) -> Array:
        """First moments (n, 2) [m] of images (n, R, C), right and up."""
        return np.asarray(images.reshape(len(images), -1) @ self.offsets.reshape(2, -1).T)


def _mirrored_spectrum(images: Array) -> NDArray[np.complex128]:
    """Spectrum (n, 2 R, C + 1) of images (n, R, C) that are mirrored at their edges."""
    tall = np.concatenate([images, images[:, ::-1]], axis=1)
    return np.fft.rfft2(np.concatenate([tall, tall[:, :, ::-1]], axis=2))


def _image_of(spectrum: NDArray[np.complex128]) -> Array:
    """Images (n, R, C) of the spectrum (n, 2 R, C + 1) of mirrored ones."""
    rows, columns = spectrum.shape[1], 2 * (spectrum.shape[2] - 1)
    images = np.fft.irfft2(spectrum, s=(rows, columns))
    return np.asarray(images[:, : rows // 2, : columns // 2])


Basis = Callable[[SpotImages], list[NDArray[Any]]]


@dataclass(frozen=True)
class GenericKind:
    """A kind of generic term.

    Attributes
    ----------
    name, lives_in : str
        The latter as in the report.
    operator : str
        How its components change cuts; see the module's notes.
    components : tuple of K Component
    basis : callable or None
        Functions h, u or p of the notes, (n, ...) for each component; None for what is traced.
    weights : (K, F, L) or None
        Share of each of `ORDERS`, of `LIGHT_ORDERS`, or of x and y, in each facet's change.
    is_smooth : bool
        Whether it may scale with covariates.
    """

    name: str
    lives_in: Place
    operator: Operator
    components: tuple[Component, ...]
    basis: Basis | None = None
    weights: Array | None = None
    is_smooth: bool = True

    @property
    def owners(self) -> Sequence[Owner]:
        """What may have one coefficient: everything, or each heliostat or target."""
        if self.lives_in == "mirror":
            return ("all", "heliostat")
        return ("all",) if self.lives_in == "angle" else ("camera", "target")


def _sun_moments(spots: SpotImages) -> list[NDArray[Any]]:
    return sun_moments(spots.phase(0), spots.phase(1))


def _axis_blur(spots: SpotImages) -> list[Array]:
    return axis_moments(spots.phase(2), spots.phase(3))


def _metre_blur(spots: SpotImages) -> list[Array]:
    right, up = spots.waves
    along_path = (spots.slant_range / 100)[:, None, None] * (right**2 + up**2)
    each = [-right * right / 2, -right * up, -up * up / 2]
    return [*(np.broadcast_to(one, along_path.shape) for one in each), -along_path / 2]


def _uneven_blur(spots: SpotImages) -> list[Array]:
    """Laplacians weighted over the target, in shares of the peak."""
    even = spots.filtered(-(spots.waves**2).sum(axis=0) / 2)
    right, up = spots.on_target
    return [even / spots.peaks * place for place in (1, right, up, right**2 + up**2)]


def _warps(spots: SpotImages) -> list[Array]:
    x, y = spots.on_target * spots.half
    right, up = spots.on_target
    square, none = right**2 + up**2, np.zeros_like(x)
    fields = [(x, none), (none, y), (y, x), (-y, x)]
    fields += [(x * share, y * share) for share in (square, right, up)]
    return [np.array(field).swapaxes(0, 1) for field in fields]


def _responses(spots: SpotImages) -> list[Array]:
    level = (spots.images / spots.peaks).clip(min=1e-4)
    return [np.log(level), level, level**2]


def _shading(spots: SpotImages) -> list[Array]:
    right, up = spots.on_target
    return [right, up, right**2, right * up, up**2]


def _waves(place: Array, counts: range) -> list[Array]:
    """Waves of so many half periods over the target's width."""
    return [np.cos(i * np.pi / 2 * (place + 1)) for i in counts]


def _pattern(spots: SpotImages) -> list[Array]:
    right, up = (_waves(place, range(8)) for place in spots.on_target)
    return [right[i] * up[j] for i in range(8) for j in range(8) if i + j > 0]


def _stripes(spots: SpotImages) -> list[Array]:
    """Waves along each axis of the target, finer than those of patterns."""
    return [wave for place in spots.on_target for wave in _waves(place, FINE)]


def _waver(spots: SpotImages) -> list[Array]:
    """Movements of rows, which a camera reads one after the other."""
    waves = _waves(spots.on_target[1], FINE)
    return [np.stack([wave, np.zeros_like(wave)], axis=1) for wave in waves]


def _added(spots: SpotImages) -> list[Array]:
    right, up = spots.on_target
    waves = (spots.waves**2).sum(axis=0) * (spots.window / 6) ** 2
    halo = spots.filtered(np.exp(-waves / 2))
    return [np.ones_like(right), right, up, right**2 + up**2, halo / spots.peaks]


_MOMENTS = (
    *_components("mrad2", "width sidewards, width oblique, width upwards"),
    *_components("mrad3", "skew sss, skew ssu, skew suu, skew uuu"),
    *_components("1", ", ".join(f"light scattered by {width:g} mrad" for width in TAILS_MRAD)),
)
_AXES = _components("mrad2", "about the first axis, about the second axis")
_BLURS = _components("m2", "right, oblique, up, along a path of 100 m")
_UNEVEN = _components("m2", "even, to the right, upwards, to the rim")
_CURVE = _components("1", "exponent, slope, curvature")
_WARPS = _components(
    "1", "scale right, scale up, shear, rotation, barrel, keystone right, keystone up"
)
_SHADES = _components("1", "right, up, right2, right up, up2")
_WAVES = _components("1", ", ".join(f"wave {i} {j}" for i in range(8) for j in range(8) if i + j))
_STRIPES = _components("1", ", ".join(f"wave {i} {way}" for way in ("right", "up") for i in FINE))
_WAVER = _components("m", ", ".join(f"wave {i} up" for i in FINE))
_SPREAD = _components("m", "apart along x, apart along y")
_LIGHTS = _components("1", "even, to the right, upwards, to the rim, halo")

IMAGE_KINDS = (
    GenericKind("sun_moments", "angle", "transfer", _MOMENTS, _sun_moments),
    GenericKind("axis_blur", "angle", "transfer", _AXES, _axis_blur),
    GenericKind("blur", "camera", "transfer", _BLURS, _metre_blur),
    GenericKind("uneven_blur", "camera", "add", _UNEVEN, _uneven_blur),
    GenericKind("response", "camera", "scale", _CURVE, _responses),
    GenericKind("geometry", "geometry", "warp", _WARPS, _warps),
    GenericKind("waver", "geometry", "warp", _WAVER, _waver, is_smooth=False),
    GenericKind("shading", "target", "scale", _SHADES, _shading),
    GenericKind("pattern", "target", "scale", _WAVES, _pattern, is_smooth=False),
    GenericKind("stripes", "target", "scale", _STRIPES, _stripes, is_smooth=False),
    GenericKind("added_light", "added_light", "add", _LIGHTS, _added),
)

SUN_SIZE = GenericKind("sun_size", "angle", "sun", _components("1", "sidewards, upwards"))

BEAM_KINDS = (*(kind for kind in IMAGE_KINDS if kind.lives_in == "angle"), SUN_SIZE)
"""Those of angles, in the order of `BeamChange.moments`."""

N_MOMENTS = sum(len(kind.components) for kind in BEAM_KINDS if kind is not SUN_SIZE)


def mirror_kinds(facets: Array) -> list[GenericKind]:
    """Kinds of mirrors with facets centred at (F, 2) [m]: of the whole mirror, of all facets alike,
    of single facets of mirrors that have few, and of the gaps between them.
    """
    heights = np.array([[_share(order, part, facets) for part in ORDERS] for order in ORDERS])
    whole = heights.transpose(0, 2, 1)[2:]
    each = np.repeat(np.eye(len(ORDERS))[2:, None], len(facets), axis=1)
    kinds = []
    for name, weights in (("mirror", whole), ("each facet", each)):
        for fine, count in ((False, 3), (True, len(ORDERS) - 2)):
            kinds.append(
                _heights(f"{name}{', fine' * fine}", ORDERS[2 : 2 + count], weights[:count])
            )
    reach = np.abs(facets).max(axis=0).clip(min=_MIN_REACH)
    spread = np.eye(2)[:, None] * (facets / reach)
    places = GenericKind("places", "mirror", "places", _SPREAD, weights=spread)
    names = tuple(Component(f"light along {'x' * i}{'y' * j}", "1") for i, j in ORDERS)
    even = np.repeat(np.eye(len(LIGHT_ORDERS))[1:, None], len(facets), axis=1)
    alike = GenericKind("each facet's light", "mirror", "light", names, weights=even)
    if len(facets) > MAX_FACETS:
        return [*kinds, alike, places]
    for fine, count in ((False, 5), (True, 9)):
        weights = _of_each(len(facets), count, len(ORDERS))
        kinds.append(_heights(f"facets{', fine' * fine}", ORDERS[:count], weights))
    names = tuple(
        Component(f"light{way} of facet {facet + 1}", "1")
        for facet in range(len(facets))
        for way in ("", " along x", " along y")
    )
    light = _of_each(len(facets), 3, len(LIGHT_ORDERS))
    return [*kinds, GenericKind("light", "mirror", "light", names, weights=light), alike, places]


def _of_each(facets: int, count: int, orders: int) -> Array:
    """Weights (facets * count, facets, orders) of the first ``count`` orders of each facet."""
    single = np.einsum("fg,kl->fkgl", np.eye(facets), np.eye(count, orders))
    return np.asarray(single.reshape(-1, facets, orders))


def _share(order: tuple[int, int], part: tuple[int, int], facets: Array) -> Array:
    """Share (F,) of x**a y**b / (a! b!) about facets' centres in the same of the whole mirror."""
    left = np.subtract(order, part)
    if (left < 0).any():
        return np.zeros(len(facets))
    return np.asarray(np.prod(facets**left, axis=1) / (factorial(left[0]) * factorial(left[1])))


def _heights(name: str, orders: Sequence[tuple[int, int]], weights: Array) -> GenericKind:
    units = {1: "mrad", 2: "mrad/m", 3: "mrad/m2", 4: "mrad/m3"}
    several = len(weights) // len(orders)
    components = tuple(
        Component(
            f"{'x' * i}{'y' * j}" + (f" of facet {facet + 1}" if several > 1 else ""), units[i + j]
        )
        for facet in range(several)
        for i, j in orders
    )
    return GenericKind(name, "mirror", "heights", components, weights=weights)


def changed_images(kind: GenericKind, spots: SpotImages, coefficients: Array) -> Array:
    """Images (n, R, C) with coefficients (n, K) of a kind that acts on images."""
    assert kind.basis is not None
    total = sum(
        c.reshape(-1, *[1] * (part.ndim - 1)) * part
        for c, part in zip(coefficients.T, kind.basis(spots), strict=True)
    )
    if kind.operator == "transfer":
        exponent = np.minimum(np.real(total), MAX_SHARPENING) + 1j * np.imag(total)
        return spots.filtered(np.exp(exponent))
    if kind.operator == "scale":
        return np.asarray(spots.images * np.exp(np.clip(total, -3, 3)))
    if kind.operator == "add":
        return np.asarray(spots.images + spots.peaks * total)
    rows, columns = spots.images.shape[1:]
    index = np.indices((rows, columns)).astype(float)
    pixels = np.array([-rows / spots.size[1], columns / spots.size[0]])[:, None, None]
    return np.array(
        [
            map_coordinates(image, index - move[::-1] * pixels, order=3, mode="mirror")
            for image, move in zip(spots.images, total, strict=True)
        ]
    )


def height_shapes(scene: Scene) -> Tensor:
    """Height changes (L, I, J) [m] of a facet by `ORDERS`, for a mrad, a mrad/m or a mrad/m2."""
    x, y = scene.control_points[0, 0, :2].double()
    x, y = x - x.mean(), y - y.mean()
    return torch.stack([1e-3 * x**i * y**j / (factorial(i) * factorial(j)) for i, j in ORDERS])


def light_shapes(count: int) -> Tensor:
    """Changes (L, count, count) of a facet's light, along x and y, by `LIGHT_ORDERS`."""
    line = (torch.arange(count, dtype=torch.float64) + 0.5) / count * 2 - 1
    x, y = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x**i * y**j for i, j in LIGHT_ORDERS])


def deformed(scene: Scene, kinds: Sequence[GenericKind], amounts: Tensor) -> Scene:
    """The scene with mirrors, or a sun, that have amounts (n, K) of a kind.

    ``kinds`` are that of each mirror, or one for all: their weights depend on the facets' places.
    """
    if kinds[0].operator == "sun":
        return with_moments(scene, torch.nn.functional.pad(amounts, (N_MOMENTS, 0)))
    weights = torch.as_tensor(np.stack([np.asarray(kind.weights) for kind in kinds]))
    shares = torch.einsum("nk,nkfl->nfl", amounts, weights.expand(len(amounts), -1, -1, -1))
    if kinds[0].operator == "light":
        return _lit(scene, shares)
    points = scene.control_points.expand(scene.batch, -1, -1, -1, -1).double()
    changes = torch.zeros_like(points)
    if kinds[0].operator == "places":
        changes[:, :, :2] = shares[..., None, None]
    else:
        changes[:, :, 2] = torch.einsum("nfl,lij->nfij", shares, height_shapes(scene))
    return scene.with_(control_points=(points + changes).to(scene.control_points))


def _lit(scene: Scene, shares: Tensor) -> Scene:
    """The scene with shares (n, F, L) of light by `LIGHT_ORDERS`, and as much light in sum."""
    along = light_shapes(COVERAGE_CELLS).to(shares)
    light = (1 + torch.einsum("nfl,lij->nfij", shares, along)).clamp(min=0)
    light = (light / light.mean(dim=(1, 2, 3), keepdim=True)).to(scene.sun)
    before = scene.coverage
    return scene.with_(coverage=light if before is None else before * light)


def with_moments(scene: Scene, added: Tensor) -> Scene:
    """The scene with ``added`` (B, 13) to the moments of its beams, whose turns it has."""
    added, before = added.to(scene.sun), scene.beam_moments
    return scene.with_(beam_moments=added if before is None else before + added)


def beam_turns(setups: Sequence[Setup], scene: Scene) -> Tensor:
    """Changes (n, 4, 3) [1/mrad] of beams in ENU by the turns of `model.tracing.beam`."""
    sun, normal = (t.double().numpy() for t in (scene.sun, scene.attitude[:, :, 2]))
    cosine = (normal * sun).sum(axis=1, keepdims=True)
    sidewards = np.cross([0.0, 0.0, 1.0], sun)
    sidewards /= np.linalg.norm(sidewards, axis=1, keepdims=True)
    ways = sidewards, np.cross(sun, sidewards)
    turns = [2 * (normal * way).sum(axis=1, keepdims=True) * normal - way for way in ways]
    mount = Mount.stack([setup.heliostat.mount for setup in setups])
    angles = mount.angles_from_normal(normal)
    for step in _STEP * np.eye(2):
        tilt = (mount.attitude(angles + step)[:, :, 2] - normal) / _STEP
        turns.append(2 * ((tilt * sun).sum(axis=1, keepdims=True) * normal + cosine * tilt))
    return torch.as_tensor(1e-3 * np.stack(turns, axis=1)).to(scene.sun)
