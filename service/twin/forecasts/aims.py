"""What a plan of aim points is worth, and drive positions that put spots on its aims.

Figures have the names of ``REPORT.json`` of ``heliotwin aim``. Drive positions are those of the
calibrated mounts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy.orm import Session
from torch import Tensor

from model.aiming.bound import bound_power
from model.aiming.k_factor import k_factor_aims
from model.aiming.kernels import Kernels
from model.aiming.plan import AimPlan, Draws, single_aim
from model.errors import ModelError
from model.plant import Cylinder, Receiver
from model.plant_model import PlantModel
from model.pointing import CalibratedMount
from model.receivers import Cavity, Panels
from service import store
from service.base.errors import ConflictError
from service.sources.documents import read_heliostat
from service.sources.schema import STORED
from service.store import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin.stored_mount import StoredMount, mount_of

Array = NDArray[np.float64]

ROWS = 32
"""Rows of a map if none are asked for: its pixels are smaller than any image of a mirror."""


def begin_at(kernels: Kernels, limit: Tensor, aims: Mapping[str, ArrayLike | None]) -> AimPlan:
    """A plan that begins with aims (3,) [m] by heliostat, None for one that is not active.

    Heliostats without an aim begin where their images were traced.
    """
    plan = single_aim(kernels, limit)
    points, active = plan.points, plan.is_active
    for row, name in enumerate(kernels.names):
        if name in aims:
            aim = aims[name]
            active[row] = aim is not None
            points[row] = points[row] if aim is None else aim
    return replace(plan, moved=kernels.moved(points), is_active=active)


class Baseline(TypedDict):
    """What another way of aiming reaches under the same limit and draws."""

    name: str
    power_w: float
    peak_p95_w_m2: float


class AimFigures(TypedDict):
    """Power [W] and flux [W/m2] of a plan; DESIGN.md, section 8."""

    power_w: float
    single_aim_power_w: float
    peak_w_m2: float
    peak_p95_w_m2: float
    limit_w_m2: float
    largest_share_of_limit: float
    bound_w: float
    baseline: Baseline
    inactive: list[str]


def aim_figures(
    plan: AimPlan, drawn: Draws, receiver: Receiver, single_aim_power_w: float
) -> AimFigures:
    """Judge a plan by its draws of the pointing errors, by its bound and by k-factors."""
    other = k_factor_aims(plan.kernels, plan.limit, receiver)
    names = plan.kernels.names
    return AimFigures(
        power_w=plan.power,
        single_aim_power_w=single_aim_power_w,
        peak_w_m2=float(plan.flux.max()),
        peak_p95_w_m2=drawn.peak,
        limit_w_m2=float(plan.limit.max()),
        largest_share_of_limit=drawn.ratio,
        bound_w=bound_power(plan),
        baseline=Baseline(name="k-factor", power_w=other.power, peak_p95_w_m2=other.draws().peak),
        inactive=sorted(
            name for name, is_on in zip(names, plan.is_active.tolist(), strict=True) if not is_on
        ),
    )


class Excess(TypedDict):
    """Where a map exceeds its limit: pixels, area [m2] and the worst excess [1] over the limit."""

    places: int
    area_m2: float
    worst: float


def excess_of(flux: NDArray[Any], limit: NDArray[Any], receiver: Receiver) -> Excess:
    """Where a map (rows, columns) [W/m2] exceeds its limit; ``worst`` is 0 if nowhere."""
    places = int((flux > limit).sum())
    pixel_m2 = receiver.width * receiver.height / flux.size
    worst = max(0.0, float((flux / limit).max()) - 1)
    return {"places": places, "area_m2": places * pixel_m2, "worst": worst}


def places_on(receiver: Receiver, points: Array) -> Array:
    """Map coordinates (N, 2) [m] of points (N, 3) [m], right and up of the map's middle."""
    if isinstance(receiver, Cylinder):
        outwards = points - receiver.axis
        angle = np.arctan2(outwards @ receiver.right, outwards @ receiver.normal)
        return np.stack([angle * receiver.radius, outwards @ receiver.up], axis=-1)
    if isinstance(receiver, Panels | Cavity):
        begins = np.cumsum([0.0, *(panel.width for panel in receiver.panels)]) - receiver.width / 2
        flat = np.stack([panel.to_plane(points) for panel in receiver.panels])
        sizes = np.array([[panel.width, panel.height] for panel in receiver.panels]) / 2
        inside = np.clip(flat, -sizes[:, None], sizes[:, None])
        near = zip(receiver.panels, inside, strict=True)
        away = [np.linalg.norm(panel.to_enu(place) - points, axis=-1) for panel, place in near]
        nearest = np.argmin(away, axis=0)
        place = inside[nearest, np.arange(len(points))]
        beside = np.stack([begins[nearest] + sizes[nearest, 0], np.zeros(len(points))], axis=-1)
        return np.asarray(place + beside)
    return receiver.middle.to_plane(points)


class DriveAim(TypedDict):
    """Motor positions of both axes [steps], or axis angles [deg] of ideal drives, or why neither.

    ``reason`` is None if one of them is known.
    """

    motor_position: list[float] | None
    axis_angles_deg: list[float] | None
    reason: str | None


def no_drive(reason: str) -> DriveAim:
    """Unknown positions, with the reason."""
    return {"motor_position": None, "axis_angles_deg": None, "reason": reason}


@dataclass(frozen=True, eq=False)
class AimDrives:
    """Mounts of heliostats by name, or the reasons why they are not known."""

    mounts: Mapping[str, StoredMount | str]

    @classmethod
    def read(cls, session: Session, names: Sequence[str], model: PlantModel) -> "AimDrives":
        """Read the newest mounts of stored heliostats."""
        calibrated = {row.name: mount for row, mount in mounts.current_mounts(session, names)}
        rows = store.get_heliostats(session, names)
        return cls({name: _mount(row, calibrated.get(name), model) for name, row in rows.items()})

    def of(self, name: str, sun: Array, aim: Array, moment: datetime | None) -> DriveAim:
        """Positions of a heliostat that reflect a recorded sun (3,) to ``aim`` (3,) [m]."""
        mount = self.mounts[name]
        if isinstance(mount, str):
            return no_drive(mount)
        try:
            if mount.heliostat.mount.actuators is None:
                angles = np.degrees(mount.axis_angles(sun, aim, moment)).round(4).tolist()
                return {"motor_position": None, "axis_angles_deg": angles, "reason": None}
            steps = mount.motors(sun, aim, moment).round(2).tolist()
        except ModelError as error:
            return no_drive(str(error))
        return {"motor_position": steps, "axis_angles_deg": None, "reason": None}


def _mount(row: HeliostatRow, mount: MountRow | None, model: PlantModel) -> StoredMount | str:
    try:
        heliostat = read_heliostat(row.name, row.properties, np.array(model.site.origin), STORED)
        if heliostat.mount.actuators is None:
            return StoredMount(heliostat, CalibratedMount.uncalibrated(), None, model)
        if mount is None:
            return "its mount was never calibrated; POST /v1/jobs/calibrations"
        return StoredMount(heliostat, mount_of(row, mount, model.effects), mount.version, model)
    except (ModelError, ConflictError) as error:
        return str(error)
