"""A field with known faults for the demonstration: some hundred heliostats over six weeks.

Photographs are forecasts of the true mirrors by convolution, on a sheet of 192 x 168 pixels. They
are much cheaper than those of `heliotwin.demo.photographs`, and serve to show the pages only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from heliotwin.demo.photographs import DEVIATION, write_photograph, write_plant_file
from heliotwin.folder import write_surface
from model.ephemeris import sun_positions
from model.forecast import View, align
from model.frames import sun_direction
from model.imaging.light import Srgb
from model.mount import Mount
from model.plant import Heliostat, Plant, TargetPlane
from model.plant_model import PlantModel
from model.prior import SurfacePrior, prior_of
from model.setup import Setup
from model.sunshape import Buie
from model.surface import control_points
from model.times import format_time
from service.base.progress import Progress, no_progress
from service.sources.plant_file import read_plant
from service.sources.plant_formats.imported import PLANT
from service.sources.plant_template import staggered_layout

Array = NDArray[np.float64]

ROWS = 10
"""Rows of heliostats: about 200 heliostats, the first 36 m from the tower."""

DAYS, ARCHIVED_DAYS = 42, 24
"""Days before now when photographs begin, and when they begin to arrive one by one."""

_OFTEN, _SELDOM = 24, 3  # photographs of a heliostat with a fault, and of any other
_SIZE = (168, 192)  # [px] of a photograph of the target
_PIXELS = (56, 64)  # of its forecast
_BATCH = 128  # photographs that are traced at once
_DAYLIGHT, _EXPOSURE = 0.2, 1.6e-4  # brightness of the sheet, and of 1 W/m2 on it
_MOUNT_RAD, _AIM_RAD = 1.0e-3, 1e-4  # zeros of drives, and scatter of each photograph


@dataclass(frozen=True)
class Fault:
    """A fault of the field.

    Attributes
    ----------
    kind : str
    heliostats : tuple of str
        Empty for all.
    days : (2,) [d]
        Before now when it begins and ends.
    size : float
        Share of light that is lost, angle [mrad] or time [h].
    alarm : str or None
        The reason of the alarm that it raises, if any.
    refusal : str or None
        The reason why its photographs are refused, if they are.
    """

    kind: str
    heliostats: tuple[str, ...]
    days: tuple[float, float]
    size: float
    alarm: str | None = None
    refusal: str | None = None

    def acts(self, name: str, days: float) -> bool:
        """Whether it acts on a photograph of a heliostat, some days before now."""
        is_of = not self.heliostats or name in self.heliostats
        return is_of and self.days[1] <= days < self.days[0]


FAULTS = (
    Fault("soiled", ("R03-05",), (11, 0), 0.45, "dimmed"),
    Fault("drives stepped", ("R04-09",), (9, 0), 9.0, "moved"),
    Fault("facet canted", ("R04-12",), (11, 0), 6.0, "fell"),
    Fault("hazy", (), (20, 14), 0.35),
    Fault("clock", ("R02-03", "R02-08", "R04-03", "R03-13"), (4, 0), 1.0, "sun_contradicts_time"),
    Fault("time unknown", ("R03-11",), (99, 0), 0.0, "times_unknown"),
    Fault("not photographed", ("R02-06",), (34, 0), 0.0, "no_photograph"),
    Fault("off target", ("R01-03",), (14, 0), 1.0, refusal="no_spot"),
    Fault("foreign light", ("R01-07",), (14, 0), 1.0, refusal="second_spot"),
)
"""All faults of the field; a test finds each."""


def faulty_heliostats() -> set[str]:
    """Names of the heliostats whose faults raise alarms."""
    return {name for fault in FAULTS if fault.alarm for name in fault.heliostats}


@dataclass(frozen=True, eq=False)
class PlannedPhotograph:
    """A photograph to take.

    Attributes
    ----------
    mirror : Heliostat
    z : (F, 8, 8) [m]
        Heights of the true mirror.
    zeros : (2,) [rad]
        Errors of its drives' zeros.
    taken_at : datetime
    faults : dict
        Sizes by kind.
    number : int
    sun : (2,) [deg]
        Azimuth and elevation.
    """

    mirror: Heliostat
    z: Array
    zeros: Array
    taken_at: datetime
    faults: dict[str, float]
    number: int
    sun: Array


def write_layout(root: Path, rows: int = ROWS) -> Plant:
    """Write ``plant.yaml`` and its layout of so many rows of heliostats; return the plant."""
    radii = [36.0 + 9 * row for row in range(rows)]
    layout = staggered_layout("four-facets", radii, 7.5, 0, 60)
    return read_plant(write_plant_file(root, "field", layout)).plant


def plan_photographs(plant: Plant, now: datetime, seed: int = 7) -> list[PlannedPhotograph]:
    """Choose times of all heliostats' photographs, in their order, with the faults of each."""
    rng = np.random.default_rng(seed)
    often = faulty_heliostats()
    photographs: list[PlannedPhotograph] = []
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    for name, mirror in plant.heliostats.items():
        prior, count = prior_of(mirror), _OFTEN if name in often else _SELDOM
        z, zeros = _true_mirror(prior, rng), rng.normal(0, _MOUNT_RAD, 2)
        ago = np.ceil(DAYS * (np.arange(count, 0, -1) - rng.uniform(0, 1, count)) / count)
        hours = rng.permutation(np.linspace(9, 15.5, count)) + rng.uniform(-0.2, 0.2, count)
        for days, hour in zip(ago.tolist(), hours.tolist(), strict=True):
            taken_at = midnight + timedelta(days=-days, seconds=round(hour * 3600))
            faults = {fault.kind: fault.size for fault in FAULTS if fault.acts(name, days)}
            if "not photographed" not in faults:
                photographs.append(
                    PlannedPhotograph(mirror, z, zeros, taken_at, faults, 0, np.zeros(2))
                )
    photographs.sort(key=lambda one: one.taken_at)
    angles = sun_positions([one.taken_at for one in photographs], plant.origin)
    return [
        replace(one, number=1001 + place, sun=angle)
        for place, (one, angle) in enumerate(zip(photographs, angles, strict=True))
    ]


def _true_mirror(prior: SurfacePrior, rng: np.random.Generator) -> Array:
    return prior.surface(rng.normal(0, DEVIATION, len(prior.basis)))


def write_measured_surfaces(
    root: Path, photographs: Sequence[PlannedPhotograph], seed: int = 8
) -> None:
    """Write the mirrors of photographs as deflectometry measures them, to some hundredths of a mm.

    Every second heliostat has one, without those with an alarm.
    """
    rng = np.random.default_rng(seed)
    mirrors = {one.mirror.name: one for one in photographs}
    for name in sorted(set(mirrors) - faulty_heliostats())[1::2]:
        z = mirrors[name].z + rng.normal(0, 5e-5, mirrors[name].z.shape)
        write_surface(root, name, control_points=control_points(mirrors[name].mirror, z))


def write_photographs(
    root: Path,
    plant: Plant,
    photographs: Sequence[PlannedPhotograph],
    progress: Progress = no_progress,
) -> None:
    """Write photographs with their properties into a measurement folder."""
    described = read_plant(root / PLANT)
    clear = PlantModel(plant.site, described.optics)
    hazy = PlantModel(plant.site, replace(described.optics, sun_shape=Buie(0.25)))
    (target,) = plant.targets.values()
    for model, is_hazy in ((clear, False), (hazy, True)):
        some = [one for one in photographs if ("hazy" in one.faults) == is_hazy]
        for start in range(0, len(some), _BATCH):
            batch = some[start : start + _BATCH]
            for one, image, motors in _photographed(batch, target, model):
                progress(one.mirror.name)
                _write(root, one, target, image, motors)


def _photographed(
    photographs: Sequence[PlannedPhotograph], target: TargetPlane, model: PlantModel
) -> Iterator[tuple[PlannedPhotograph, NDArray[np.uint8], Array]]:
    """Photographs (rows, columns) of the target and motor positions (2,) [steps]."""
    rngs = [np.random.default_rng(one.number) for one in photographs]
    suns = np.array([sun_direction(*one.sun) for one in photographs])
    aims = [target.to_enu(rng.uniform(-0.5, 0.5, 2)) for rng in rngs]
    mount = Mount.stack([one.mirror.mount for one in photographs])
    angles = mount.align([one.mirror.position for one in photographs], suns, aims)
    # The mirrors are not where their motors say: by the zeros of their drives.
    true = [
        angle + one.zeros + rng.normal(0, _AIM_RAD, 2) + _step(one)
        for angle, one, rng in zip(angles, photographs, rngs, strict=True)
    ]
    setups = [
        Setup(one.mirror, control_points(one.mirror, _canted(one)), sun, target, angles=angle)
        for one, sun, angle in zip(photographs, suns, true, strict=True)
    ]
    with torch.no_grad():
        irradiance = align(setups, model).images(View(*_PIXELS, samples=12)).clamp(min=0).numpy()
    for one, rng, angle, light in zip(photographs, rngs, angles, irradiance, strict=True):
        for kind in ("soiled", "hazy", "off target"):
            light *= 1 - one.faults.get(kind, 0.0)
        light += one.faults.get("foreign light", 0.0) * np.roll(light, (-15, 24), (0, 1))
        yield one, _draw(light, rng), one.mirror.mount.motors_from_angles(angle)


def _step(one: PlannedPhotograph) -> float:
    """The step of each drive [rad]; the light turns twice as far."""
    return 1e-3 * one.faults.get("drives stepped", 0.0) / 8**0.5


def _canted(one: PlannedPhotograph) -> Array:
    """Heights (F, 8, 8) [m] of the true mirror, with the first facet canted if it has the fault."""
    z = one.z.copy()
    z[0] += 1e-3 * one.faults.get("facet canted", 0.0) * np.linspace(-0.8, 0.8, 8)[:, None]
    return z


def _draw(light: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The target (rows, columns) with light [W/m2] and daylight on it, sRGB encoded."""
    rows, columns = _SIZE
    spot = cv2.resize(light, (columns, rows), interpolation=cv2.INTER_CUBIC).clip(min=0)
    x, y = np.arange(columns)[None, :], np.arange(rows)[:, None]
    seams = np.where((x % 32 == 16) | (y % 28 == 14), 0.9, 1.0)
    daylight = _DAYLIGHT * (1.05 - 0.1 * y / rows)
    counts = 255 * Srgb().counts(seams * (daylight + _EXPOSURE * spot))
    return np.clip(np.round(counts + rng.normal(0, 1.0, _SIZE)), 0, 255).astype(np.uint8)


def _write(
    root: Path, one: PlannedPhotograph, target: TargetPlane, image: NDArray[np.uint8], motors: Array
) -> None:
    azimuth, elevation = one.sun.tolist()
    about: dict[str, object] = {
        "target_name": target.name,
        "sun_azimuth_deg": azimuth,
        "sun_elevation_deg": elevation,
        "motor_position": np.round(motors).tolist(),
    }
    if "time unknown" not in one.faults:
        recorded = one.taken_at - timedelta(hours=one.faults.get("clock", 0.0))
        about["time"] = format_time(recorded)
    write_photograph(root / one.mirror.name, str(one.number), about, cropped=image)
