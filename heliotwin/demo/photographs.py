"""Photographs of a plant's mirrors, as its calibration camera would take them.

The Monte Carlo tracer traces the true surfaces. It shares no code with the prediction and the
forecast. A synthetic camera photographs the flux in perspective, with daylight, background and
noise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from heliotwin.demo.camera import CameraOptions, photograph
from heliotwin.folder import write_json
from model.frames import sun_direction_at
from model.plant import Heliostat, TargetPlane
from model.setup import Setup
from model.surface import control_points
from model.tracing import Optics, Window
from model.tracing.alignment import align_to_spots
from model.tracing.montecarlo import trace_montecarlo
from service.sources.plant_formats.imported import LAYOUT, PLANT

Array = NDArray[np.float64]

IMAGES, RAYS, PIXELS = 8, 400_000, 112
"""Photographs per heliostat, rays per photograph, and pixels along each side of the flux image."""

UNMARKED = CameraOptions(marks=False, border=0.0, daylight=0.5, peak=0.45)
"""A white target without marks, which is brighter than what is around it."""

DEVIATION = 0.8
"""Standard deviation of the true surfaces' coefficients, relative to the prior's."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs of one mirror.

    Attributes
    ----------
    suns : (N, 3)
        Unit vectors towards the sun in ENU.
    motors : (N, 2) [steps] or None
        None for a mount without drives.
    frames : list of N (rows, columns, 3)
        RGB, sRGB encoded.
    """

    suns: Array
    motors: Array | None
    frames: list[NDArray[np.uint8]]


@dataclass(frozen=True, eq=False)
class TargetCamera:
    """What is photographed, and how.

    Attributes
    ----------
    target : TargetPlane
    latitude : float [deg]
    optics : Optics
    rays : int
        Of each photograph.
    marks : bool
        Whether the target has brackets at its corners.
    """

    target: TargetPlane
    latitude: float
    optics: Optics
    rays: int = RAYS
    marks: bool = True

    def suns(self, count: int, rng: np.random.Generator) -> Array:
        """Sun directions (count, 3), unit vectors: hours of the day through the summer."""
        hour_angle = np.linspace(-55, 55, count) + rng.uniform(-5, 5, count)
        declination = np.copysign(np.linspace(0, 22, count), self.latitude)
        return sun_direction_at(rng.permutation(declination), hour_angle, self.latitude)

    def skip(self, count: int, rng: np.random.Generator) -> None:
        """Draw from the generator what `photograph` draws, to photograph another mirror at the same
        time.
        """
        self.suns(count, rng)
        rng.uniform(-0.6, 0.6, (count, 2))
        rng.integers(2**31)
        options = self._options
        for _ in range(count):
            rng.normal(0, options.noise, (*options.size, 3))

    @property
    def _options(self) -> CameraOptions:
        return CameraOptions() if self.marks else UNMARKED

    def photograph(
        self, mirror: Heliostat, z: Array, count: int, rng: np.random.Generator
    ) -> Photographs:
        """Photograph a mirror with heights ``z`` (F, 8, 8) [m].

        The spots lie at random positions near the target's centre.
        """
        directions = self.suns(count, rng)
        spots = self.target.to_enu(rng.uniform(-0.6, 0.6, (count, 2)))
        points = control_points(mirror, z)
        setups = [
            Setup(mirror, points, sun, self.target, spot)
            for sun, spot in zip(directions, spots, strict=True)
        ]
        aligned = align_to_spots(setups)
        traced, _ = trace_montecarlo(
            aligned.scene.to(torch.float32),
            Window.of(self.target, PIXELS, PIXELS),
            self.optics,
            rays=self.rays,
            seed=int(rng.integers(2**31)),
        )
        frames = [
            photograph(
                flux,
                self.target,
                rng,
                replace(self._options, time_stamp=f"demo {mirror.name} image {index + 1}"),
            )
            for index, flux in enumerate(traced)
        ]
        has_drives = mirror.mount.actuators is not None
        motors = mirror.mount.motors_from_angles(aligned.angles) if has_drives else None
        return Photographs(directions, motors, frames)


def write_photograph(
    heliostat: Path, identifier: str, about: Mapping[str, object], **images: NDArray[np.uint8]
) -> None:
    """Write images by their kind, gray or RGB, and their properties into a heliostat's folder."""
    stem = heliostat / "Calibration" / identifier
    write_json(stem.with_name(f"{identifier}-calibration-properties.json"), about)
    for kind, image in images.items():
        pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        cv2.imwrite(f"{stem}-{kind}.png", pixels)


def write_plant_file(folder: Path, name: str, layout: str) -> Path:
    """Write the plant ``name`` of the demonstration and its layout; return its file's path."""
    folder.mkdir(parents=True, exist_ok=True)
    plant = files("heliotwin.demo").joinpath(f"{name}.yaml").read_text(encoding="utf-8")
    (folder / LAYOUT).write_text(layout, encoding="utf-8")
    (folder / PLANT).write_text(plant, encoding="utf-8")
    return folder / PLANT
