"""Render training images: heliostats under random suns, photographed by imperfect cameras."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from model.effects import Effect, apply_optics_effects, in_light_order
from model.effects.background import Background
from model.effects.camera_response import CameraResponse
from model.effects.camera_shoulder import CameraShoulder
from model.effects.slope_error import SlopeError
from model.effects.sun_shape import SunShapeEffect
from model.effects.target_registration import TargetRegistration
from model.frames import sun_direction_at
from model.images import (
    COARSE_SIZE,
    FLUX_SHAPE,
    FLUX_SIZE,
    FLUX_WINDOW,
    binned,
    clipped_alike,
    normalized,
)
from model.imaging.light import Srgb
from model.mount import Mount
from model.network.architecture import CONDITIONS
from model.network.inputs import GUESS_SAMPLES, STEP_SAMPLES, conditions, conjugate_gradient_steps
from model.observation import Observation, observed_scene
from model.plant import Heliostat, TargetPlane
from model.setup import Setup
from model.site import JUELICH, Site
from model.surface import control_points
from model.tracing import Optics, Scene, Window, trace

Array = NDArray[np.float64]

TOWER_TOP = (0.0, 0.0, 55.0)
"""Point that heliostats are canted for [m]: approximately Juelich's receiver."""

CLEAREST_SKY, CLEAR_SKY = 1e-3, 0.02
"""Circumsolar ratios: the smallest one drawn, and the one of the model."""

RESPONSE = Srgb()
"""Response curve of the drawn cameras."""


def load_field(root: Path) -> Array:
    """Heliostat positions (N, 3) [m] in ENU from ``root/field-positions.json``."""
    field = json.loads((root / "field-positions.json").read_text(encoding="utf-8"))
    return np.array([entry["position_enu"] for entry in field.values()], dtype=np.float64)


def draw_suns(count: int, site: Site, min_elevation_deg: float, rng: np.random.Generator) -> Array:
    """Draw sun directions, unit vectors (count, 3), of the year and the day at a site."""
    found = np.empty((0, 3))
    while len(found) < count:
        declination = 23.45 * np.sin(rng.uniform(0, 2 * np.pi, 4 * count))
        directions = sun_direction_at(
            declination, rng.uniform(-105, 105, 4 * count), site.latitude_deg
        )
        found = np.concatenate(
            [found, directions[directions[:, 2] > np.sin(np.radians(min_elevation_deg))]]
        )
    return found[:count]


@dataclass(frozen=True)
class SceneSampler:
    """Draws positions, aim points and suns of heliostats.

    Targets face north on a tower. Their centres are up to ``target_east`` [m] off the tower's axis
    at heights ``target_up`` [m]. Suns are drawn over the year and the day, above
    ``min_elevation_deg``. Canting is for a focus at ``focus`` times the distance to the tower's
    top.
    """

    target_east: float = 20.0
    target_up: tuple[float, float] = (25.0, 60.0)
    min_elevation_deg: float = 12.0
    focus: tuple[float, float] = (0.75, 1.1)

    def suns(self, count: int, rng: np.random.Generator) -> Array:
        """Draw sun directions, unit vectors (count, 3)."""
        return draw_suns(count, JUELICH, self.min_elevation_deg, rng)

    def heliostats(self, positions: Array, rng: np.random.Generator) -> list[Heliostat]:
        """Heliostats at positions (N, 3) [m], each canted to a random focus."""
        focal = np.linalg.norm(positions - TOWER_TOP, axis=-1) * rng.uniform(
            *self.focus, len(positions)
        )
        return [Heliostat.juelich("synthetic", p, f) for p, f in zip(positions, focal, strict=True)]

    def setups(
        self, field: Array, count: int, images: int, rng: np.random.Generator, device: torch.device
    ) -> "Setups":
        """Draw heliostats from the field (N, 3) [m], each with ``images`` suns and aim points."""
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
    """The geometry of photographs of heliostats, for any surfaces.

    Attributes
    ----------
    ideal : Scene
        The B * images mirrors with ideal surfaces; the images of one heliostat are consecutive.
    lift : Tensor (B, F, 3)
        Derivative of each facet's control points by its heights: the normal.
    images : int
    side : float [m]
        Width of the images.
    optics : Optics
    """

    ideal: Scene
    lift: Tensor
    images: int
    side: float = FLUX_WINDOW
    optics: Optics = field(default_factory=Optics)

    @classmethod
    def placed(cls, setups: Sequence[Setup], images: int, side: float, optics: Optics) -> "Setups":
        """Geometry of B * images `Setup` that aim at their targets' centres, on the CPU.

        The images of one heliostat are consecutive, and all have the same facets.
        """
        mount = Mount.stack([setup.heliostat.mount for setup in setups])
        positions = np.array([setup.heliostat.position for setup in setups])
        suns, aims = (
            np.array(points)
            for points in ([s.sun for s in setups], [s.plane.center for s in setups])
        )
        ideal = Scene.from_setups(setups, mount.align(positions, suns, aims))
        normals = np.array([setup.heliostat.facet_normals for setup in setups[::images]])
        return cls(ideal, torch.as_tensor(normals, dtype=torch.float32), images, side, optics)

    @classmethod
    def of(
        cls, heliostats: Sequence[Heliostat], suns: Array, aims: Array, device: torch.device
    ) -> "Setups":
        """Setups of heliostats with one kind of mount, on targets that face north.

        ``suns`` and ``aims`` are (B * images, 3).
        """
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
        """The scene of surfaces ``z`` (B, F, 8, 8) [m].

        Each sun may have a different surface: (B, images, F, 8, 8).
        """
        if z.ndim == 4:
            z = z[:, None].expand(-1, self.images, -1, -1, -1)
        deformed = torch.einsum("bmfij,bfk->bmfkij", z, self.lift).flatten(0, 1)
        return self.ideal.with_(control_points=self.ideal.control_points + deformed)

    def trace(self, z: Tensor, samples: int = GUESS_SAMPLES, size: int = FLUX_SIZE) -> Tensor:
        """Flux (B, images, size, size), sum 100, of surfaces as in `scene`, without a camera."""
        window = Window(self.side, self.side, size, size, on_spot=True)
        flux = trace(self.scene(z), window, self.optics, samples=samples, padding=0.25).irradiance
        return normalized(flux.clamp(min=0)).view(-1, self.images, size, size)

    def conditions(self) -> Tensor:
        """Return the geometry of each image (B, images, 12) for the network."""
        return conditions(self.ideal, self.side).view(-1, self.images, CONDITIONS)

    def __getitem__(self, rows: slice) -> "Setups":
        """Select some heliostats."""
        start, stop, _ = rows.indices(len(self.lift))
        ideal = self.ideal.subset(range(start * self.images, stop * self.images))
        return replace(self, ideal=ideal, lift=self.lift[rows])


@dataclass(frozen=True, eq=False)
class Renderings:
    """Images of B heliostats, with equal numbers.

    Attributes
    ----------
    setups : Setups
    flux : Tensor (B, images, 64, 64)
        Sum 100.
    clipped : Tensor (B, images, 64, 64) [1]
        Saturated share of each pixel.
    """

    setups: Setups
    flux: Tensor
    clipped: Tensor

    def trace(self, z: Tensor, samples: int = GUESS_SAMPLES, size: int = FLUX_SIZE) -> Tensor:
        """Trace images (B, images, size, size), sum 100, of surfaces ``z`` (`Setups.scene`)."""
        clipped = binned(self.clipped, size) * (size / FLUX_SIZE) ** 2
        return normalized(
            clipped_alike(self.setups.trace(z, samples, size), binned(self.flux, size), clipped)
        )

    def conjugate_gradient_steps(self, z: Tensor, basis: Tensor) -> Tensor:
        """Return steps (B, images, F, 8, 8) [m] from surfaces ``z`` towards the measured images.

        ``z`` is (B, F, 8, 8) [m].
        """

        def traced(dz: Tensor) -> Tensor:
            return self.trace(z[:, None] + dz, STEP_SAMPLES, COARSE_SIZE)

        return conjugate_gradient_steps(traced, self.flux, basis, self.setups.side)

    def __getitem__(self, rows: slice) -> "Renderings":
        """Select some heliostats."""
        return Renderings(self.setups[rows], self.flux[rows], self.clipped[rows])


class CameraImages(NamedTuple):
    """Flux images (B, 64, 64) of sum 100 and the saturated share of each pixel.

    The images are centered on the spot.
    """

    flux: Tensor
    clipped: Tensor


@dataclass(frozen=True)
class RealCamera:
    """The differences between photographs and traced flux: effects of the catalogue, and noise.

    A batch is photographed under ``n_conditions`` different conditions of haze, roughness and
    camera. Every other value is the limit or scale of a random draw. Circumsolar ratio and slope
    error [mrad] act on the light. Gamma and compression are errors of the assumed response curve.
    ``warp`` [of the window] acts on registration and centring. ``background`` [of the peak] is
    daylight that was not subtracted, ``noise`` [of the range] is that of the counts. Good
    conditions are common and bad ones rare: the limits are scaled by a uniform random number to the
    power of ``ease``.

    Counts are sRGB in 8 bits. Daylight lights the sheet up to ``ambient`` of the range; the peak
    reaches a share ``exposure`` of the remaining range. Light beyond the range saturates.
    """

    circumsolar_ratio: float = 0.15
    slope_error_mrad: float = 0.8
    gamma: float = 1.25
    compression: float = 1.5
    warp: float = 0.015
    background: float = 0.02
    noise: float = 0.02
    ease: float = 2.0
    n_conditions: int = 8
    ambient: tuple[float, float] = (0.44, 0.66)
    exposure: tuple[float, float] = (0.5, 1.2)

    def photograph(
        self,
        scene: Scene,
        device: torch.device,
        rng: np.random.Generator,
        side: float = FLUX_WINDOW,
    ) -> CameraImages:
        """Photograph a scene under several conditions, in squares of ``side`` [m]."""
        images = torch.empty(2, scene.batch, FLUX_SIZE, FLUX_SIZE, device=device)
        for rows in np.array_split(
            rng.permutation(scene.batch), min(self.n_conditions, scene.batch)
        ):
            share = rng.uniform() ** self.ease
            seen = self._seen(scene.subset(rows.tolist()), self.effects(share, rng), side)
            images[:, rows] = self._developed(seen, share, rng)
        return CameraImages(normalized(images[0]), images[1])

    def effects(self, share: float, rng: np.random.Generator) -> list[Effect]:
        """Draw the effects of one condition, up to a ``share`` of the limits."""

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
    def _seen(scene: Scene, effects: Sequence[Effect], side: float) -> Tensor:
        """Trace the images (B, 64, 64) of a scene with effects on light and camera."""
        window = Window(side, side, on_spot=True)
        flux = trace(
            scene, window, apply_optics_effects(effects, Optics()), samples=16, padding=0.25
        ).irradiance
        flux = flux.clamp(min=0)
        for effect in in_light_order(effects):
            flux = effect.on_image(flux, window)
        return flux

    def _developed(self, images: Tensor, share: float, rng: np.random.Generator) -> Tensor:
        """Convert to counts and back; return linear intensity and saturated pixels (2, B, R, C)."""
        count, device = len(images), images.device

        def draw(low: float, high: float, *shape: int) -> Tensor:
            return torch.as_tensor(
                rng.uniform(low, high, (count, *shape)), dtype=images.dtype, device=device
            )

        off_centre = share * draw(-self.warp, self.warp, 2, 1)
        shift = torch.cat([torch.eye(2, device=device).expand(count, 2, 2), off_centre], dim=2)
        grid = functional.affine_grid(shift, [count, 1, *images.shape[1:]], align_corners=False)
        image = functional.grid_sample(images[:, None], grid, align_corners=False)[:, 0]
        image = image / image.amax(dim=(1, 2), keepdim=True).clamp(min=1e-9)
        daylight = torch.as_tensor(RESPONSE.light(rng.uniform(*self.ambient, (count, 1, 1)))).to(
            image
        )
        light = daylight + (1 - daylight) * draw(*self.exposure, 1, 1) * image
        seed = torch.Generator(device=device).manual_seed(int(rng.integers(2**31)))
        noise = (
            share
            * draw(0, self.noise, 1, 1)
            * torch.randn(image.shape, generator=seed, device=device)
        )
        counts = (torch.as_tensor(RESPONSE.counts(light.cpu().numpy())).to(image) + noise).clamp(
            0, 1
        ) * 255
        levels = torch.as_tensor(RESPONSE.light(np.arange(256) / 255)).to(image)
        counts = counts.round().long()
        return torch.stack([(levels[counts] - daylight).clamp(min=0), (counts == 255).to(image)])


@dataclass(frozen=True)
class CleanCamera:
    """A camera that only adds noise and rounds to 8 bits.

    ``noise`` is the standard deviation [of the peak].
    """

    noise: float = 0.01

    def photograph(
        self, scene: Scene, device: torch.device, rng: np.random.Generator
    ) -> CameraImages:
        """Photograph a scene without saturation."""
        flux = trace(scene, Window(on_spot=True), samples=48).irradiance
        noise = torch.as_tensor(
            rng.normal(0, self.noise, flux.shape), dtype=flux.dtype, device=device
        )
        image = flux / flux.amax(dim=(1, 2), keepdim=True) + noise
        counts = torch.round(image.clamp(0, 1) * 255)
        return CameraImages(normalized(counts), torch.zeros_like(flux))


def places(suns: Array, planes: Sequence[TargetPlane]) -> list[Observation]:
    """Make observations without images, with the spots at the targets' centres.

    ``suns`` is (N, 3); there are N target planes.
    """
    blank = np.ones(FLUX_SHAPE, np.float32)
    return [
        Observation(blank, s, p, p.center, str(i))
        for i, (s, p) in enumerate(zip(suns, planes, strict=True))
    ]


def observe(
    heliostat: Heliostat,
    z: Array,
    setups: Sequence[Observation],
    camera: RealCamera | CleanCamera,
    rng: np.random.Generator,
) -> list[Observation]:
    """Photograph a heliostat with heights ``z`` (4, 8, 8) [m] at `places`."""
    with torch.no_grad():
        images, cut = camera.photograph(
            observed_scene(heliostat, setups, z), torch.device("cpu"), rng
        )
    return [
        replace(setup, flux=image, clipped=clipped)
        for setup, image, clipped in zip(setups, images.numpy(), cut.numpy(), strict=True)
    ]


def render(
    z: Array,
    images: int,
    field: Array,
    scenes: SceneSampler,
    camera: RealCamera | None,
    device: torch.device,
    seed: int,
) -> Renderings:
    """Photographs of surfaces ``z`` (B, 4, 8, 8) [m] in random scenes.

    Without a camera, the flux is traced for the default sun without further effects.
    """
    rng = np.random.default_rng(seed)
    return take(scenes.setups(field, len(z), images, rng, device), z, camera, rng)


def take(
    setups: Setups, z: Array, camera: RealCamera | None, rng: np.random.Generator
) -> Renderings:
    """Photographs of surfaces ``z`` (B, F, 8, 8) [m] with given geometry; see `render`."""
    device = setups.lift.device
    surfaces = torch.as_tensor(z, dtype=torch.float32, device=device)
    if camera is None:
        flux = setups.trace(surfaces, samples=24)
        return Renderings(setups, flux, torch.zeros_like(flux))
    seen = camera.photograph(setups.scene(surfaces), device, rng, setups.side)
    shape = (len(z), setups.images, FLUX_SIZE, FLUX_SIZE)
    return Renderings(setups, *(values.view(shape) for values in seen))
