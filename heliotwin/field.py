"""``heliotwin field``: the flux of all heliostats of a plant file on a receiver, watt by watt."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from model.fleet import FleetFlux, Superposition, aligned_field, superpose, tiles
from model.frames import SunAngles
from model.neighbours import Neighbours
from model.plant import Heliostat, Receiver, square_pixels
from model.setup import Setup
from service.base.fields import Sun
from service.base.progress import Progress
from service.sources.folder import points_of, read_surface
from service.sources.plant_file import PlantDescription
from service.twin.forecasts.field_forecast import Fleet, HeliostatGroup
from service.twin.forecasts.mirror_states import (
    AS_DECLARED,
    MirrorState,
    MirrorStates,
    with_measured,
)
from service.twin.forecasts.watts import FieldWatts, field_watts, heliostat_watts
from service.twin.model_versions import DECLARED, ModelVersion

Array = NDArray[np.float64]

ROWS = 64
"""Rows of a map if none are asked for; columns follow from the receiver's shape."""

_RAYS = 24
"""Rays along each side of a mirror, at least; each facet has `_LEAST_RAYS` or more."""

_LEAST_RAYS = 4

Resolution = tuple[int, int]
"""Rows and columns."""


@dataclass(frozen=True, eq=False)
class FieldRequest:
    """What is asked of a field.

    Attributes
    ----------
    receiver : str
    azimuth_deg, elevation_deg : float [deg]
        Of the sun, azimuth from north over east.
    dni_w_m2 : float or None
        None for that of a clear sky.
    aims : dict or None
        Aim points (3,) [m] by heliostat, None for one that is not active; None for default aims.
    surfaces : Path or None
        Folder of surfaces; None for the nominal mirrors.
    resolution : (rows, columns), or None
    states : MirrorStates
        Measured states of mirrors; the others are as declared.
    """

    receiver: str
    azimuth_deg: float
    elevation_deg: float
    dni_w_m2: float | None = None
    aims: dict[str, Array | None] | None = None
    surfaces: Path | None = None
    resolution: Resolution | None = None
    states: MirrorStates = AS_DECLARED


class FieldReport(TypedDict):
    """``field.json``; DESIGN.md, section 8."""

    sun: dict[str, float]
    dni_w_m2: float
    receiver: str
    field: FieldWatts
    by_heliostat: dict[str, dict[str, float]]
    sources: dict[str, dict[str, int]]
    states: dict[str, MirrorState]
    skipped: dict[str, str]
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class FieldFlux:
    """The map (rows, columns) [W/m2] of incident light, unrolled, and the report."""

    flux: Array
    report: FieldReport


def sun_of(
    plant: PlantDescription, sun: tuple[float, float] | None, at: datetime | None
) -> SunAngles[float]:
    """Azimuth from north and elevation [deg] of the sun, given or at a time.

    Raises
    ------
    InvalidInputError
        If none or both are given, or the sun is below the horizon.
    """
    if (sun is None) == (at is None):
        raise InvalidInputError("--sun, --at: give one of them, a position or a time")
    azimuth, elevation = sun or (0.0, 0.0)
    if at is not None:
        azimuth, elevation = sun_angles_at(at, plant.plant.origin)
    if not (math.isfinite(azimuth) and 0 < elevation <= 90):
        given = "--sun: elevation" if at is None else "--at: the sun's elevation"
        raise InvalidInputError(f"{given} must lie in (0, 90] degrees, got {elevation:g}")
    return SunAngles(float(azimuth) % 360, float(elevation))


def trace_field(plant: PlantDescription, request: FieldRequest, step: Progress) -> FieldFlux:
    """Trace the flux of a plant's heliostats on one receiver.

    Heliostats that the layout gives to another receiver aim there: they cast shadows only.

    Raises
    ------
    InvalidInputError
        If the plant has no such receiver, or no heliostat sends light to it.
    """
    lit = light_field(plant, request)
    group = lit.group
    total = superpose(
        lit.task, tiles(lit.setups, lit.neighbours), done=lambda flux: step(f"{flux.heliostats}")
    )
    if not total.heliostats:
        raise no_light(group, total.skipped, "no heliostat is active")
    return FieldFlux(total.irradiance, _report(request, total, group))


def no_light(
    group: HeliostatGroup, skipped: Mapping[str, str], otherwise: str
) -> InvalidInputError:
    """The error that no heliostat lights the receiver, with the first reason."""
    reason = next(iter(skipped.values()), otherwise)
    return InvalidInputError(f"no heliostat sends light to {group.receiver.name}: {reason}")


@dataclass(frozen=True, eq=False)
class LitField:
    """Heliostats that send light to a receiver, what is around them, and how it is traced."""

    group: HeliostatGroup
    task: Superposition
    setups: list[Setup]
    neighbours: Neighbours


def light_field(plant: PlantDescription, request: FieldRequest, rows: int = ROWS) -> LitField:
    """Aim a plant's heliostats; errors as of `trace_field`.

    ``rows`` are those of the map if the request says nothing.
    """
    group, mirrors = _group(plant, request), plant.plant.heliostats
    setups = [_setup(group, mirrors[name], request.surfaces) for name in group.names]
    task = group.task(
        request.resolution or square_pixels(group.receiver, rows), samples=_samples(setups)
    )
    seen = [(one.heliostat, one.goal) for one in setups]
    seen += [(mirrors[name], group.aim_of(mirrors[name])) for name in group.around]
    return LitField(group, task, setups, aligned_field(seen, group.sun, group.model))


def _group(plant: PlantDescription, request: FieldRequest) -> HeliostatGroup:
    """The heliostats that light the request's receiver, with their aims and those around them."""
    receiver = _receiver(plant, request.receiver)
    model = ModelVersion(plant.plant.site, plant.optics, number=DECLARED, version="declared")
    names, around = list(plant.plant.heliostats), {}
    if request.aims is not None:
        names = [name for name in names if request.aims.get(name) is not None]
    elif len(set(plant.receiver_of.values())) > 1:  # the layout has heliostats of each
        around = {
            name: plant.receivers[own]
            for name, own in plant.receiver_of.items()
            if own != receiver.name and own in plant.receivers
        }
    fleet = Fleet(
        names=[name for name in names if name not in around],
        receiver=receiver,
        model=model,
        sunlight="clear_sky" if request.dni_w_m2 is None else request.dni_w_m2,
        aim=None,
        aims={name: aim for name, aim in (request.aims or {}).items() if aim is not None},
        tower=plant.tower,
        states=request.states,
        around=around,
    )
    sun = Sun(azimuth_deg=request.azimuth_deg, elevation_deg=request.elevation_deg)
    return fleet.under(sun, ideal=False)  # nominal mirrors have states, too


def _receiver(plant: PlantDescription, name: str) -> Receiver:
    if name not in plant.receivers:
        known = ", ".join(plant.receivers) or "none"
        raise InvalidInputError(f"--receiver: {name!r} is no receiver of the plant; known: {known}")
    return plant.receivers[name]


def _setup(group: HeliostatGroup, mirror: Heliostat, surfaces: Path | None) -> Setup:
    """A heliostat with its surface in a folder; without one it is nominal."""
    surface = None if surfaces is None else read_surface(surfaces, mirror)
    if surface is None:
        group.without_surface.add(mirror.name)
    return group.setup(group.in_state(mirror), *points_of(mirror, surface))


def _samples(setups: Iterable[Setup]) -> int:
    """Rays along each side of a facet, for the mirror with the fewest facets."""
    facets = min((len(setup.heliostat.facets) for setup in setups), default=1)
    return max(_LEAST_RAYS, math.ceil(_RAYS / math.sqrt(facets)))


def _report(request: FieldRequest, total: FleetFlux, group: HeliostatGroup) -> FieldReport:
    warnings, dni = [], group.model.optics.dni
    if group.without_surface and request.surfaces is not None:
        warnings.append(
            f"{len(group.without_surface)} of {len(group.names)} heliostats have no surface in"
            f" {request.surfaces} and are traced as nominal mirrors"
        )
    return FieldReport(
        sun={"azimuth_deg": request.azimuth_deg, "elevation_deg": request.elevation_deg},
        dni_w_m2=dni,
        receiver=request.receiver,
        field=field_watts(total, dni),
        by_heliostat=heliostat_watts(total.losses, dni),
        sources=group.sources(total.skipped),
        states=with_measured({name: group.traced_states[name] for name in total.losses}),
        skipped=total.skipped,
        warnings=warnings,
    )
