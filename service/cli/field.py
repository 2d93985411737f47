"""``heliotwin field``: the flux of all heliostats of a plant file on a receiver, watt by watt."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from model.fleet import FleetFlux, Superposition, aligned_field, superpose, tiles
from model.frames import SunAngles, sun_direction
from model.neighbours import Neighbours
from model.plant import Heliostat, Receiver, square_pixels
from model.plant_model import PlantModel
from model.setup import Setup
from model.surface import DEGREE, control_points
from service.base.progress import Progress
from service.sources.folder import read_surface
from service.sources.plant_file import PlantDescription
from service.twin.forecasts.mirror_states import (
    AS_DECLARED,
    MirrorState,
    MirrorStates,
    count_sources,
    in_state,
    with_measured,
)
from service.twin.forecasts.watts import FieldWatts, clear_sky_dni, field_watts, heliostat_watts

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


@dataclass
class Aimed:
    """Heliostats with their aims: those whose light is asked for, and those that stand around."""

    setups: list[Setup] = field(default_factory=list)
    others: list[tuple[Heliostat, Array]] = field(default_factory=list)
    without_surface: int = 0
    states: dict[str, MirrorState] = field(default_factory=dict)


def trace_field(plant: PlantDescription, request: FieldRequest, step: Progress) -> FieldFlux:
    """Trace the flux of a plant's heliostats on one receiver.

    Heliostats that the layout gives to another receiver aim there: they cast shadows only.

    Raises
    ------
    InvalidInputError
        If the plant has no such receiver, or no heliostat sends light to it.
    """
    lit = light_field(plant, request)
    total = superpose(
        lit.task,
        tiles(lit.aimed.setups, lit.neighbours),
        done=lambda flux: step(f"{flux.heliostats}"),
    )
    receiver, dni = lit.task.receiver, lit.task.model.optics.dni
    if not total.heliostats:
        reason = next(iter(total.skipped.values()), "no heliostat is active")
        raise InvalidInputError(f"no heliostat sends light to {receiver.name}: {reason}")
    return FieldFlux(total.irradiance, _report(request, receiver, dni, total, lit.aimed))


@dataclass(frozen=True, eq=False)
class LitField:
    """Heliostats that send light to a receiver, what is around them, and how it is traced."""

    task: Superposition
    aimed: Aimed
    neighbours: Neighbours


def light_field(plant: PlantDescription, request: FieldRequest, rows: int = ROWS) -> LitField:
    """Aim a plant's heliostats; errors as of `trace_field`.

    ``rows`` are those of the map if the request says nothing.
    """
    receiver = _receiver(plant, request.receiver)
    sun = sun_direction(request.azimuth_deg, request.elevation_deg)
    dni = request.dni_w_m2
    if dni is None:
        dni = clear_sky_dni(request.elevation_deg, plant.altitude)
    model = PlantModel(plant.plant.site, plant.optics).with_dni(dni)
    aimed = _aimed(plant, receiver, request, sun)
    field_around = [(one.heliostat, one.goal) for one in aimed.setups] + aimed.others
    task = Superposition(
        receiver,
        model,
        request.resolution or square_pixels(receiver, rows),
        samples=_samples(aimed.setups),
        tower=None if plant.tower is None else plant.tower.outline(sun),
    )
    return LitField(task, aimed, aligned_field(field_around, sun, model))


def _receiver(plant: PlantDescription, name: str) -> Receiver:
    if name not in plant.receivers:
        known = ", ".join(plant.receivers) or "none"
        raise InvalidInputError(f"--receiver: {name!r} is no receiver of the plant; known: {known}")
    return plant.receivers[name]


def _aimed(plant: PlantDescription, receiver: Receiver, request: FieldRequest, sun: Array) -> Aimed:
    """Heliostats with aims and surfaces."""
    found = Aimed()
    for name, heliostat in plant.plant.heliostats.items():
        own = plant.receiver_of.get(name, receiver.name)
        if request.aims is not None:
            aim = request.aims.get(name)
            if aim is None:
                continue
        elif own != receiver.name and own in plant.receivers and _is_shared(plant):
            found.others.append((heliostat, plant.receivers[own].aim_of(heliostat.position)))
            continue
        else:
            aim = receiver.aim_of(heliostat.position)
        surface = None if request.surfaces is None else read_surface(request.surfaces, heliostat)
        found.without_surface += surface is None and request.surfaces is not None
        state = found.states[name] = request.states.of(heliostat)
        heliostat = in_state(heliostat, state)
        points, degree = (control_points(heliostat), DEGREE) if surface is None else surface
        found.setups.append(
            Setup(heliostat, points, sun, receiver.middle, aim=aim, degree=degree, identifier=name)
        )
    return found


def _is_shared(plant: PlantDescription) -> bool:
    """Whether the layout gives heliostats to different receivers."""
    return len(set(plant.receiver_of.values())) > 1


def _samples(setups: Iterable[Setup]) -> int:
    """Rays along each side of a facet, for the mirror with the fewest facets."""
    facets = min((len(setup.heliostat.facets) for setup in setups), default=1)
    return max(_LEAST_RAYS, math.ceil(_RAYS / math.sqrt(facets)))


def _report(
    request: FieldRequest, receiver: Receiver, dni: float, total: FleetFlux, aimed: Aimed
) -> FieldReport:
    warnings = []
    if aimed.without_surface:
        warnings.append(
            f"{aimed.without_surface} of {len(aimed.setups)} heliostats have no surface in"
            f" {request.surfaces} and are traced as nominal mirrors"
        )
    states = {name: aimed.states[name] for name in total.losses}
    return FieldReport(
        sun={"azimuth_deg": request.azimuth_deg, "elevation_deg": request.elevation_deg},
        dni_w_m2=dni,
        receiver=receiver.name,
        field=field_watts(total, dni),
        by_heliostat=heliostat_watts(total.losses, dni),
        sources=count_sources(states.values()),
        states=with_measured(states),
        skipped=total.skipped,
        warnings=warnings,
    )
