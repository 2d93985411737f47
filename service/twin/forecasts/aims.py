"""Plans of aim points: what they are worth, the drives' positions for them, and their sources.

Figures have the names of ``REPORT.json`` of ``heliotwin aim``. Drive positions put the spots on the
aims by the calibrated mounts. Sources are what a plan was computed from, of which something may
have changed since.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, NotRequired, TypedDict
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import func, select
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
from service.store import mounts, queue
from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MountRow, PlantRow
from service.twin import model_versions
from service.twin.forecasts.mirror_states import MirrorStates
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


KIND = "aim-plans"

SOURCES = "sources"
"""Step of a plan's job with its `Sources`."""


def plant_time_zone(session: Session, default: str | None) -> str:
    """The time zone of the plant's file; without one the ``default`` of the settings, or UTC."""
    plant = session.get(PlantRow, 1)
    return (None if plant is None else plant.time_zone) or default or "UTC"


class Sources(TypedDict):
    """Model version, and by heliostat the versions of surface and mount, and its properties' time.

    Versions are None for heliostats without a surface, or never calibrated. ``states`` are measured
    cleanliness [1] and pointing error [mrad], None if not measured.
    """

    model: int
    heliostats: dict[str, list[int | str | None]]
    states: NotRequired[dict[str, list[float | None]]]


def sources_of(session: Session, names: Sequence[str], model: int | None = None) -> Sources:
    """The current sources of heliostats; ``model`` is the version that was asked for, if any."""
    surfaces = store.active_versions(session)
    newest = select(MountRow.heliostat_id, func.max(MountRow.version))
    mounts = {row[0]: row[1] for row in session.execute(newest.group_by(MountRow.heliostat_id))}
    row, wanted = HeliostatRow, set(names)
    found = session.execute(select(row.id, row.name, row.updated_at)).all()
    return {
        "model": model or model_versions.current_number(session),
        "heliostats": {
            name: [surfaces.get(number), mounts.get(number), updated.isoformat()]
            for number, name, updated in found
            if name in wanted
        },
    }


@dataclass(frozen=True)
class OutdatedPlan:
    """A plan of the current day, of which something changed since it was made.

    ``changes`` names the heliostats of each kind of change; ``models`` are the plan's version of
    the model and the current one if they differ.
    """

    job: int
    target: str | None
    made_at: datetime
    changes: Mapping[str, Sequence[str]]
    models: tuple[int, int] | None

    @property
    def heliostats(self) -> list[str]:
        """All heliostats of which something changed."""
        return sorted({name for names in self.changes.values() for name in names})


def has_other_state(
    states: MirrorStates, name: str, clean: float | None, mrad: float | None
) -> bool:
    """Whether a mirror surely has another cleanliness than assumed, or points surely worse."""
    dimmed, error = states.cleanliness.get(name), states.pointing_mrad.get(name)
    if dimmed is None or dimmed.ci95 is None or clean is None:
        is_other = (dimmed is None) != (clean is None)
    else:
        is_other = not dimmed.ci95[0] <= clean <= dimmed.ci95[1]
    is_worse = bool(error and error.ci95 and mrad is not None and mrad < error.ci95[0])
    return is_worse or is_other


_PARTS = ("surface", "mount", "properties")


def outdated_plans(
    session: Session, default_zone: str | None, measure: Callable[[], MirrorStates]
) -> list[OutdatedPlan]:
    """The newest plan of the current day for each target, if something changed since.

    ``measure`` measures the present states of mirrors.
    """
    today = now().astimezone(ZoneInfo(plant_time_zone(session, default_zone))).date().isoformat()
    query = (
        select(JobRow.id, JobRow.payload["target"].as_string(), JobRow.finished_at)
        .where(JobRow.kind == KIND, JobRow.state == "done")
        .where(JobRow.result["date"].as_string() == today)
        .order_by(JobRow.id)
    )
    newest = {target: (job, target, at) for job, target, at in session.execute(query)}
    found = (_outdated(session, measure, *one) for one in newest.values())
    return [one for one in found if one is not None]


def _outdated(
    session: Session,
    measure: Callable[[], MirrorStates],
    job: int,
    target: str | None,
    made_at: datetime,
) -> OutdatedPlan | None:
    before = queue.load_checkpoint(session, job, SOURCES)
    if before is None:
        return None
    current = sources_of(session, list(before["heliostats"]))
    changes: dict[str, list[str]] = {part: [] for part in _PARTS}
    for name, old in before["heliostats"].items():
        new = current["heliostats"].get(name)
        for part, was, is_now in zip(_PARTS, old, new or [None] * len(_PARTS), strict=True):
            if was != is_now:
                changes[part].append(name)
    if assumed := before.get("states"):
        states = measure()
        changes["measured state"] = [
            name for name, values in assumed.items() if has_other_state(states, name, *values)
        ]
    changes = {part: sorted(names) for part, names in changes.items() if names}
    models = before["model"], current["model"]
    is_other = models[0] != models[1]
    if not changes and not is_other:
        return None
    return OutdatedPlan(job, target, made_at, changes, models if is_other else None)
