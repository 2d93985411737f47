"""Calibrated mounts: their versions, motor positions for an aim, and the plan of the next photographs."""

from datetime import datetime
from typing import Annotated, Any, Self

import numpy as np
from fastapi import APIRouter, Body, Depends, Query
from pydantic import BaseModel, Field, model_validator

from model.frames import sun_direction
from model.pointing.report import day_of
from service import store
from service.base.fields import Model, Moment, Name, Position, Sun, Version
from service.store import mounts
from service.store.tables import MountRow
from service.twin.mounted import load_mount
from service.twin.pointing import Slot, make_plan, mount_out, sun_at
from service.web.answers.openapi import problems
from service.web.answers.paging import Page, page
from service.web.door.dependencies import COMPUTES, READ, Limit, NamePath, RuntimeDep, require_json

router = APIRouter(tags=["mounts"])

Motors = tuple[float, float]


class MountOut(BaseModel):
    """A version of a calibrated mount."""

    heliostat: str
    version: int
    created_at: datetime = Field(description="When it was calibrated; anew, where it is still in the same state.")
    valid_from: datetime = Field(description="Since when its newest state holds: a step of its drives, or the first.")
    sun: list[dict[str, Any]] = Field(
        default=[], description="Effects of the plant's model that moved the sun when it was calibrated."
    )
    measurements: int
    residual_mrad: dict[str, float | None] = Field(description="Between forecast and measured spots [mrad].")
    parameters: dict[str, dict[str, Any]] = Field(
        description="By name: value, std, prior_std, unit, and whether the measurements determine it."
    )
    steps: list[dict[str, Any]] = Field(description="Steps of the drives' zeros, each between two measurements.")
    drift: dict[str, Any] = Field(description="How far the zeros went slowly from the first measurement to the newest.")
    outliers: dict[str, dict[str, Any]] = Field(description="Measurements that contradict all others, and why.")


def _out(heliostat: str, row: MountRow) -> MountOut:
    about = {"heliostat": heliostat, "version": row.version, "created_at": row.created_at}
    return MountOut.model_validate(mount_out(row) | about)


@router.get("/heliostats/{name}/mounts", responses=problems(404), dependencies=[READ])
def list_mounts(
    name: NamePath,
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last version of the page before.")] = None,
) -> Page[MountOut]:
    """The calibrations of a mount, oldest version first."""
    with runtime.database.reading() as session:
        rows = mounts.list_mounts(session, store.get_heliostat(session, name), limit + 1, after)
    return page([_out(name, row) for row in rows], limit, "version")


@router.get("/heliostats/{name}/mounts/current", responses=problems(404), dependencies=[READ])
def get_current_mount(
    name: NamePath,
    runtime: RuntimeDep,
    at: Annotated[Moment | None, Query(description="The mount that was valid then (time with zone).")] = None,
) -> MountOut:
    """The mount that is valid now, or at a time."""
    with runtime.database.reading() as session:
        return _out(name, mounts.get_mount_at(session, store.get_heliostat(session, name), at))


class AimIn(Model):
    """Where the light shall go, and under which sun."""

    sun: Sun | None = Field(default=None, description="Where the sun stands; either this or `time`.")
    time: Moment | None = Field(default=None, description="When (time with zone); either this or `sun`.")
    aim_point: Position | None = Field(
        default=None, description="Where the light shall go [m]; either this or `target`."
    )
    target: Name | None = Field(default=None, description="A stored target or receiver whose middle is meant.")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.sun is None) == (self.time is None):
            raise ValueError("give either sun or time")
        if (self.aim_point is None) == (self.target is None):
            raise ValueError("give either aim_point or target")
        return self


class MotorsOut(BaseModel):
    """Motor positions for an aim."""

    heliostat: str
    motor_position: Motors = Field(description="Of both axes [steps], within their travel.")
    aim_point: tuple[float, float, float] = Field(description="East, north, up of the tower base [m].")
    sun: Sun
    std_mrad: float = Field(description="Of the light about the aim, as seen from the mirror, one direction [mrad].")
    std_m: float = Field(description="The same at the aim point, across the light's way [m].")
    mount_version: int | None = Field(description="null: never calibrated, by the heliostat's properties.")


@router.post(
    "/heliostats/{name}/motors", responses=problems(404, 409, 413, 415), dependencies=[READ, Depends(require_json)]
)
def post_motors(
    name: NamePath,
    runtime: RuntimeDep,
    request: Annotated[
        AimIn, Body(examples=[{"target": "multi_focus_tower", "sun": {"azimuth_deg": -20.0, "elevation_deg": 45.0}}])
    ],
) -> MotorsOut:
    """The motor positions that send the sun's light to a point, by the calibrated mount of `time`, or the newest."""
    with runtime.database.reading() as session:
        stored = load_mount(session, name, request.time)
        if request.aim_point is not None:
            aim = np.array(request.aim_point)
        else:
            assert request.target is not None
            aim = store.get_target_or_receiver(session, request.target).center
    if request.sun is not None:
        angles = request.sun.azimuth_deg, request.sun.elevation_deg
    else:
        assert request.time is not None
        angles = sun_at(request.time, stored.origin)
    recorded, day = sun_direction(*angles), day_of(request.time)
    motors, sun = stored.motors(recorded, aim, request.time), stored.sun(recorded, request.time)
    cov = stored.mount.covariance_at(stored.heliostat, motors[None], sun[None], aim[None], np.array([day]))[0]
    std = float(np.sqrt(np.trace(cov) / 2))
    return MotorsOut(
        heliostat=name,
        motor_position=(float(motors[0]), float(motors[1])),
        aim_point=(float(aim[0]), float(aim[1]), float(aim[2])),
        sun=Sun(azimuth_deg=angles[0], elevation_deg=angles[1]),
        std_mrad=1e3 * std,
        std_m=std * float(np.linalg.norm(aim - stored.heliostat.position)),
        mount_version=stored.version,
    )


class PlannedOut(BaseModel):
    """A photograph to take."""

    at: datetime
    heliostat: str
    target: str
    motor_position: Motors = Field(description="What sends the light to the target's centre then [steps].")
    sun: Sun
    information_bits: float = Field(description="How much the photograph is expected to tell of the mount [bit].")
    std_mrad: float = Field(description="How unsure the spot's place is by what is known now [mrad].")


def planned_out(slot: Slot) -> PlannedOut:
    """A photograph to take, as JSON."""
    proposal = slot.proposal
    return PlannedOut(
        at=slot.moment,
        heliostat=proposal.heliostat,
        target=proposal.target,
        motor_position=(float(proposal.motors[0]), float(proposal.motors[1])),
        sun=Sun(azimuth_deg=slot.azimuth_deg, elevation_deg=slot.elevation_deg),
        information_bits=proposal.information_bits,
        std_mrad=proposal.std_mrad,
    )


class PlanOut(BaseModel):
    """The next photographs, in order of time."""

    items: list[PlannedOut]


@router.get("/calibration-plan", responses=problems(409), dependencies=[READ, COMPUTES])
def get_plan(
    runtime: RuntimeDep,
    at: Annotated[Moment | None, Query(description="When it begins (time with zone); now without it.")] = None,
    minutes: Annotated[float, Query(gt=0, le=720, description="How long it lasts [min].")] = 60.0,
    photographs: Annotated[int, Query(ge=1, le=60, description="How many there is time for.")] = 12,
) -> PlanOut:
    """Which photographs to take next: each of the heliostat that it is expected to tell most of.

    A mount that was never measured, long ago, or under few suns tells most. Heliostats without linear actuators in
    their properties are left out: nobody knows where motors point them.
    """
    slots = make_plan(runtime, at, minutes, photographs)
    return PlanOut(items=[planned_out(slot) for slot in slots])
