"""Rendering training images: heliostats of the field under random suns, seen by imperfect cameras."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from model.effects import Effect
from model.effects.background import Background
from model.effects.camera_response import CameraResponse
from model.effects.camera_shoulder import CameraShoulder
from model.effects.slope_error import SlopeError
from model.effects.sun_shape import SunShapeEffect
from model.effects.target_registration import TargetRegistration
from model.forecast import images_under, optics_under
from model.frames import sun_direction_at
from model.images import COARSE_SIZE, FLUX_SHAPE, FLUX_SIZE, binned, clipped_alike, normalized
from model.imaging.light import Srgb
from model.network.architecture import CONDITIONS
from model.network.inputs import DESCENT_SAMPLES, GUESS_SAMPLES, conditions, descents
from model.observation import Observation, scene_of
from model.plant import JUELICH_LATITUDE, Heliostat, TargetPlane
from model.surface import control_points
from model.tracing import Optics, Scene, Window, trace

Array = NDArray[np.float64]

TOWER_TOP = (0.0, 0.0, 55.0)
"""What heliostats are canted for [m]: the receiver of Juelich, about."""

CLEAREST_SKY, CLEAR_SKY = 1e-3, 0.02
"""Circumsolar ratios: the least that is drawn, and the model's own, which the best camera still sees."""

LAW = Srgb()
"""From light to counts, for the cameras that are drawn."""

Descents = Callable[[Callable[[Tensor], Tensor], Tensor, Tensor], Tensor]
"""A way to a step, as `model.network.inputs.descents` is one."""

TENSORS = ("control_points", "attitude", "center", "sun", "plane_center", "plane_axes")
"""What a scene holds for each mirror."""


def load_field(root: Path) -> Array:
    """Heliostat positions (N, 3) [m] in ENU from ``root/field-positions.json``."""
    field = json.loads((root / "field-positions.json").read_text(encoding="utf-8"))
    return np.array([entry["position_enu"] for entry in field.values()], dtype=np.float64)


@dataclass(frozen=True)
class Situations:
    """Where heliostats stand, what they aim at, and under which suns.

    Targets face north on a tower; their centres lie up to ``target_east`` [m] off the tower's axis at heights
    ``target_up`` [m]. Suns are drawn over the year and the day, above ``min_elevation_deg``. Canting is for a focus at
    ``focus`` times the distance to the tower's top.
    """

    target_east: float = 20.0
    target_up: tuple[float, float] = (25.0, 60.0)
    min_elevation_deg: float = 12.0
    focus: tuple[float, float] = (0.75, 1.1)

    def suns(self, count: int, rng: np.random.Generator) -> Array:
        """Unit vectors (count, 3)."""
        found = np.empty((0, 3))
        while len(found) < count:
            declination = 23.45 * np.sin(rng.uniform(0, 2 * np.pi, 4 * count))
            directions = sun_direction_at(declination, rng.uniform(-105, 105, 4 * count), JUELICH_LATITUDE)
            found = np.concatenate([found, directions[directions[:, 2] > np.sin(np.radians(self.min_elevation_deg))]])
        return found[:count]

    def heliostats(self, positions: Array, rng: np.random.Generator) -> list[Heliostat]:
        """Heliostats at positions (N, 3) [m], each canted to a random focus."""
        focal = np.linalg.norm(positions - TOWER_TOP, axis=-1) * rng.uniform(*self.focus, len(positions))
        return [Heliostat.juelich("synthetic", p, f) for p, f in zip(positions, focal, strict=True)]

    def setups(self, field: Array, count: int, images: int, rng: np.random.Generator, device: torch.device) -> "Setups":
        """``count`` heliostats at random places (N, 3) [m] of the field, each before ``images`` suns and aims."""
        heliostats = self.heliostats(field[rng.integers(len(field), size=count)], rng)
        total = count * images
        aims = np.stack(
            [
                rng.uniform(-self.target_east, self.target_east, total),
                np.zeros(total),
                rng.uniform(*self.target_up, total),
            ],
            axis=-1,
        )
        return Setups.of(heliostats, self.suns(total, rng), aims, device)


@dataclass(frozen=True, eq=False)
class Setups:
    """Photographs to be taken of heliostats, whatever their surfaces.

    Attributes
    ----------
    ideal : Scene
        The B * images mirrors with ideal surfaces; the images of one heliostat follow one another.
    lift : Tensor (B, 4, 3)
        What a unit of height adds to the control points of each facet: its normal.
    images : int
    """

    ideal: Scene
    lift: Tensor
    images: int

    @classmethod
    def of(cls, heliostats: Sequence[Heliostat], suns: Array, aims: Array, device: torch.device) -> "Setups":
        """Setups of heliostats of one mount with suns and aims (B * images, 3) on targets that face north."""
        images, mount = len(suns) // len(heliostats), heliostats[0].mount
        points = np.array([control_points(h) for h in heliostats])
        normals = np.array([h.facet_normals for h in heliostats])
        places = np.array([h.position for h in heliostats]).repeat(images, axis=0)
        attitude = mount.attitude(mount.align(places, suns, aims))
        axes = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

        def tensor(values: Array) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32, device=device)

        ideal = Scene(
            control_points=tensor(points.repeat(images, axis=0)).movedim(-1, -3).contiguous(),
            attitude=tensor(attitude),
            center=tensor(mount.mirror_center(places, attitude)),
            sun=tensor(suns),
            plane_center=tensor(aims),
            plane_axes=tensor(axes).expand(len(suns), 3, 3),
        )
        return cls(ideal, tensor(normals), images)

    def scene(self, z: Tensor) -> Scene:
        """The scene of surfaces ``z`` (B, 4, 8, 8) [m], or of other ones before each sun (B, images, 4, 8, 8)."""
        if z.ndim == 4:
            z = z[:, None].expand(-1, self.images, -1, -1, -1)
        deformed = torch.einsum("bmfij,bfk->bmfkij", z, self.lift).flatten(0, 1)
        return self.ideal.with_(control_points=self.ideal.control_points + deformed)

    def trace(self, z: Tensor, samples: int = GUESS_SAMPLES, size: int = FLUX_SIZE) -> Tensor:
        """Flux (B, images, size, size), sum 100, of surfaces as `scene` takes them, as no camera sees it."""
        window = Window(rows=size, columns=size, on_spot=True)
        flux = trace(self.scene(z), window, samples=samples, padding=0.25).irradiance
        return normalized(flux.clamp(min=0)).view(-1, self.images, size, size)

    def conditions(self) -> Tensor:
        """What the network is told of each image (B, images, 12)."""
        return conditions(self.ideal).view(-1, self.images, CONDITIONS)

    def __getitem__(self, rows: slice) -> "Setups":
        """The setups of some of the heliostats."""
        start, stop, _ = rows.indices(len(self.lift))
        setups = slice(start * self.images, stop * self.images)
        parts = {name: getattr(self.ideal, name)[setups] for name in TENSORS}
        return Setups(self.ideal.with_(**parts), self.lift[rows], self.images)


@dataclass(frozen=True, eq=False)
class Photographs:
    """Images of B heliostats, as many of each.

    Attributes
    ----------
    setups : Setups
    flux : Tensor (B, images, 64, 64)
        Sum 100.
    clipped : Tensor (B, images, 64, 64) [1]
        Share of each pixel that the camera's range cut off.
    """

    setups: Setups
    flux: Tensor
    clipped: Tensor

    def trace(self, z: Tensor, samples: int = GUESS_SAMPLES, size: int = FLUX_SIZE) -> Tensor:
        """What surfaces ``z`` as `Setups.scene` takes them would show (B, images, size, size), sum 100."""
        clipped = binned(self.clipped, size) * (size / FLUX_SIZE) ** 2
        return normalized(clipped_alike(self.setups.trace(z, samples, size), binned(self.flux, size), clipped))

    def descents(self, z: Tensor, basis: Tensor, way: Descents = descents) -> Tensor:
        """`model.network.inputs.descents` (B, images, 4, 8, 8) [m] from surfaces ``z`` (B, 4, 8, 8) [m]."""
        return way(lambda dz: self.trace(z[:, None] + dz, DESCENT_SAMPLES, COARSE_SIZE), self.flux, basis)

    def __getitem__(self, rows: slice) -> "Photographs":
        """Those of some of the heliostats."""
        return Photographs(self.setups[rows], self.flux[rows], self.clipped[rows])


@dataclass(frozen=True)
class Camera:
    """What separates photographs from traced flux: effects of the catalogue, and noise.

    Photographs are taken in ``worlds`` of differing haze, roughness and camera, at random. Every other value is the
    limit or scale of a random draw: circumsolar ratio and slope error [mrad] act on the light, gamma and compression
    are what the camera's law leaves, ``warp`` [of the window] acts on registration and centring; ``background`` [of the
    peak] is daylight that was not taken off, ``noise`` [of the range] is the counts'. Good worlds are common and bad
    ones rare: each has a uniform random number to the power of ``ease`` of all these limits.

    Counts are those of sRGB in 8 bits, of a sheet that daylight lights up to ``ambient`` of the range; the peak reaches
    a share ``exposure`` of the light that fits above it. What exceeds the range is cut off.
    """

    circumsolar_ratio: float = 0.15
    slope_error_mrad: float = 0.8
    gamma: float = 1.25
    compression: float = 1.5
    warp: float = 0.015
    background: float = 0.02
    noise: float = 0.02
    ease: float = 2.0
    worlds: int = 8
    ambient: tuple[float, float] = (0.44, 0.66)
    exposure: tuple[float, float] = (0.5, 1.2)

    def photograph(self, scene: Scene, device: torch.device, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Flux images (B, 64, 64), sum 100, 4 m about the spot's centre, and which share of each pixel is cut off."""
        images = torch.empty(2, scene.batch, FLUX_SIZE, FLUX_SIZE, device=device)
        for rows in np.array_split(rng.permutation(scene.batch), min(self.worlds, scene.batch)):
            share = rng.uniform() ** self.ease
            seen = self._seen(scene.subset(rows.tolist()), self.effects(share, rng))
            images[:, rows] = self._developed(seen, share, rng)
        return normalized(images[0]), images[1]

    def effects(self, share: float, rng: np.random.Generator) -> list[Effect]:
        """Those of one world, drawn up to a ``share`` of the limits."""

        def near_zero(limit: float) -> float:
            return float(rng.uniform(-limit, limit) * share)

        clearest = min(CLEAR_SKY, self.circumsolar_ratio)
        haziest = clearest + share * (self.circumsolar_ratio - clearest)
        scale_x, scale_y, shear, turn = (near_zero(self.warp) for _ in range(4))
        return [
            SunShapeEffect(float(np.exp(rng.uniform(np.log(CLEAREST_SKY), np.log(haziest))))),
            SlopeError(rng.uniform(0, share * self.slope_error_mrad)),
            Background(*(near_zero(self.background) for _ in range(3))),
            CameraResponse(float(self.gamma ** near_zero(1.0))),
            CameraShoulder(rng.uniform(0, share * self.compression)),
            TargetRegistration(1 + scale_x, 1 + scale_y, shear, float(np.degrees(turn))),
        ]

    @staticmethod
    def _seen(scene: Scene, effects: Sequence[Effect]) -> Tensor:
        """Images (B, 64, 64) of a scene as effects on light and camera make them."""
        window = Window(on_spot=True)
        flux = trace(scene, window, optics_under(effects, Optics()), samples=16, padding=0.25).irradiance
        return images_under(effects, flux.clamp(min=0), window)

    def _developed(self, images: Tensor, share: float, rng: np.random.Generator) -> Tensor:
        """Light (B, R, C) as the camera's counts tell it, and which of it was cut off: (2, B, R, C)."""
        count, device = len(images), images.device

        def draw(low: float, high: float, *shape: int) -> Tensor:
            return torch.as_tensor(rng.uniform(low, high, (count, *shape)), dtype=images.dtype, device=device)

        off_centre = share * draw(-self.warp, self.warp, 2, 1)
        shift = torch.cat([torch.eye(2, device=device).expand(count, 2, 2), off_centre], dim=2)
        grid = functional.affine_grid(shift, [count, 1, *images.shape[1:]], align_corners=False)
        image = functional.grid_sample(images[:, None], grid, align_corners=False)[:, 0]
        image = image / image.amax(dim=(1, 2), keepdim=True).clamp(min=1e-9)
        daylight = torch.as_tensor(LAW.light(rng.uniform(*self.ambient, (count, 1, 1)))).to(image)
        light = daylight + (1 - daylight) * draw(*self.exposure, 1, 1) * image
        seed = torch.Generator(device=device).manual_seed(int(rng.integers(2**31)))
        noise = share * draw(0, self.noise, 1, 1) * torch.randn(image.shape, generator=seed, device=device)
        counts = (torch.as_tensor(LAW.counts(light.cpu().numpy())).to(image) + noise).clamp(0, 1) * 255
        levels = torch.as_tensor(LAW.light(np.arange(256) / 255)).to(image)
        counts = counts.round().long()
        return torch.stack([(levels[counts] - daylight).clamp(min=0), (counts == 255).to(image)])


@dataclass(frozen=True)
class CleanCamera:
    """A camera that adds noise of standard deviation ``noise`` [of the peak] and rounds to 8 bits, nothing else."""

    noise: float = 0.01

    def photograph(self, scene: Scene, device: torch.device, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Flux images (B, 64, 64), sum 100, 4 m about the spot's centre, nothing of which is cut off."""
        flux = trace(scene, Window(on_spot=True), samples=48).irradiance
        noise = torch.as_tensor(rng.normal(0, self.noise, flux.shape), dtype=flux.dtype, device=device)
        image = flux / flux.amax(dim=(1, 2), keepdim=True) + noise
        return normalized(torch.round(image.clamp(0, 1) * 255)), torch.zeros_like(flux)


def places(suns: Array, planes: Sequence[TargetPlane]) -> list[Observation]:
    """Observations to be: suns (N, 3) and N target planes, at whose centres the spots lie; nothing is seen yet."""
    blank = np.ones(FLUX_SHAPE, np.float32)
    return [Observation(blank, s, p, p.center, str(i)) for i, (s, p) in enumerate(zip(suns, planes, strict=True))]


def observe(
    heliostat: Heliostat,
    z: Array,
    setups: Sequence[Observation],
    camera: Camera | CleanCamera,
    rng: np.random.Generator,
) -> list[Observation]:
    """What a camera sees of a heliostat with heights ``z`` (4, 8, 8) [m] at `places`."""
    with torch.no_grad():
        images, cut = camera.photograph(scene_of(heliostat, setups, [z]), torch.device("cpu"), rng)
    return [
        replace(setup, flux=image, clipped=clipped)
        for setup, image, clipped in zip(setups, images.numpy(), cut.numpy(), strict=True)
    ]


def render(
    z: Array, images: int, field: Array, situations: Situations, camera: Camera | None, device: torch.device, seed: int
) -> Photographs:
    """Photographs of surfaces ``z`` (B, 4, 8, 8) [m] in random situations.

    Without a camera the flux is traced for the default sun and nothing else.
    """
    rng = np.random.default_rng(seed)
    setups = situations.setups(field, len(z), images, rng, device)
    surfaces = torch.as_tensor(z, dtype=torch.float32, device=device)
    if camera is None:
        flux = setups.trace(surfaces, samples=24)
        return Photographs(setups, flux, torch.zeros_like(flux))
    seen = camera.photograph(setups.scene(surfaces), device, rng)
    return Photographs(setups, *(values.view(len(z), images, *values.shape[1:]) for values in seen))
