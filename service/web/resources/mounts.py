"""Calibrated mounts: versions, motors for an aim, the calibration plan, and pointing errors."""

from datetime import datetime
from operator import attrgetter
from typing import Annotated, Self

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field, model_validator

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.pointing.report import day_of
from model.pointing.spots import spot_covariance
from service import store
from service.base.errors import NotFoundError
from service.base.fields import (
    AnySun,
    FormMoment,
    From,
    HeliostatOf,
    Model,
    Moment,
    MountReport,
    Name,
    Position,
    Sun,
    SunAt,
    SunPosition,
    TargetOf,
    UpTo,
    Version,
    plant_time_to_utc,
)
from service.store import mounts
from service.store.tables import MountRow
from service.twin.alarms.field_overview import (
    PATIENCE_S,
    HeliostatOverview,
    read_summaries,
    with_pointing,
)
from service.twin.calibration import CalibrationSlot, best_slot, make_plan, mount_out
from service.twin.forecasts.requests import position_of
from service.twin.stored_mount import load_mount
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    READ,
    FieldCacheDep,
    Limit,
    NamePath,
    RuntimeDep,
    ZoneDep,
    require_json,
)
from service.web.responses.lists import Page, page
from service.web.responses.openapi import problems
from service.web.responses.pages import render

router = APIRouter(tags=["mounts"])
pages = APIRouter(include_in_schema=False)

Motors = tuple[float, float]


class MountOut(MountReport):
    """A version of a calibrated mount."""

    heliostat: HeliostatOf
    version: int = Field(description="Version of the mount, from 1.")
    created_at: datetime = Field(description="When it was last calibrated in the same state.")
    valid_from: datetime | None = Field(
        description=(
            "Since when its newest state holds: a step of its drives, or the first measurement;"
            " null: none of its measurements has a time."
        )
    )


def _out(heliostat: str, row: MountRow) -> MountOut:
    about = {"heliostat": heliostat, "version": row.version, "created_at": row.created_at}
    return MountOut.model_validate(mount_out(row) | about)


@router.get("/heliostats/{name}/mounts", responses=problems(404), dependencies=[READ])
def list_mounts(
    name: NamePath,
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[
        Version | None, Query(description="The last version of the page before.")
    ] = None,
) -> Page[MountOut]:
    """List the calibrations of a mount, oldest version first."""
    with runtime.database.reading() as session:
        rows = mounts.list_mounts(session, store.get_heliostat(session, name), limit + 1, after)
    return page([_out(name, row) for row in rows], limit, "version")


@router.get("/heliostats/{name}/mounts/current", responses=problems(404), dependencies=[READ])
def get_current_mount(
    name: NamePath,
    runtime: RuntimeDep,
    at: Annotated[
        Moment | None, Query(description="The mount that was valid then (time with zone).")
    ] = None,
) -> MountOut:
    """Get the mount that is valid now, or at a time."""
    with runtime.database.reading() as session:
        return _out(name, mounts.get_mount_at(session, store.get_heliostat(session, name), at))


class AimIn(Model):
    """An aim point and a sun position."""

    sun: AnySun
    aim_point_m: Position | None = Field(
        default=None, description="Where the light shall go [m]; either this or `target`."
    )
    target: Name | None = Field(
        default=None, description="A stored target or receiver whose middle is meant."
    )

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.aim_point_m is None) == (self.target is None):
            raise ValueError("give either aim_point_m or target")
        return self


class MotorsOut(BaseModel):
    """Motor positions for an aim."""

    heliostat: HeliostatOf
    motor_position: Motors = Field(description="Of both axes [steps], within their travel.")
    aim_point_m: tuple[float, float, float] = Field(
        description="East, north, up of the tower base [m]."
    )
    sun: SunPosition
    std_mrad: float = Field(
        description="Of the light about the aim, as seen from the mirror, one direction [mrad]."
    )
    std_m: float = Field(description="The same at the aim point, across the light's way [m].")
    mount_version: int | None = Field(
        description="null: never calibrated, by the heliostat's properties."
    )


@router.post(
    "/heliostats/{name}/motors",
    responses=problems(404, 409, 413, 415),
    dependencies=[READ, Depends(require_json)],
)
def post_motors(name: NamePath, runtime: RuntimeDep, request: AimIn) -> MotorsOut:
    """Compute the motor positions that aim at a point.

    They follow the calibrated mount that is valid at the time in `sun`, or the newest one.
    """
    with runtime.database.reading() as session:
        at = request.sun.at if isinstance(request.sun, SunAt) else None
        stored, sun = load_mount(session, name, at), position_of(session, request.sun)
        if request.aim_point_m is not None:
            aim = np.array(request.aim_point_m)
        else:
            assert request.target is not None
            aim = store.get_target_or_receiver(session, request.target).center
    recorded, day = sun_direction(sun.azimuth_deg, sun.elevation_deg), day_of(at)
    motors, true_sun = stored.motors(recorded, aim, at), stored.sun(recorded, at)
    cov = spot_covariance(
        stored.mount, stored.heliostat, motors[None], true_sun[None], aim[None], np.array([day])
    )[0]
    std = float(np.sqrt(np.trace(cov) / 2))
    return MotorsOut(
        heliostat=name,
        motor_position=(float(motors[0]), float(motors[1])),
        aim_point_m=(float(aim[0]), float(aim[1]), float(aim[2])),
        sun=sun,
        std_mrad=1e3 * std,
        std_m=std * float(np.linalg.norm(aim - stored.heliostat.position)),
        mount_version=stored.version,
    )


class PlannedOut(BaseModel):
    """A photograph to take."""

    at: datetime = Field(description="When to take it.")
    heliostat: HeliostatOf
    target: TargetOf
    motor_position: Motors = Field(
        description="What sends the light to the target's centre then [steps]."
    )
    sun: SunPosition
    information_bits: float = Field(
        description="Expected information of the photograph about the mount [bit]."
    )
    std_mrad: float = Field(
        description="How unsure the spot's place is by what is known now [mrad]."
    )
    reason: str = Field(
        description="Why this heliostat; empty where a photograph of one was requested."
    )


def planned_out(slot: CalibrationSlot) -> PlannedOut:
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
        reason=slot.reason,
    )


@router.get("/calibration-plan", responses=problems(409), dependencies=[READ, COMPUTE_SLOT])
def get_plan(
    runtime: RuntimeDep,
    at: Annotated[
        Moment | None, Query(description="When it begins (time with zone); now without it.")
    ] = None,
    minutes: Annotated[float, Query(gt=0, le=720, description="How long it lasts [min].")] = 60.0,
    photographs: Annotated[int, Query(ge=1, le=60, description="How many there is time for.")] = 12,
) -> Page[PlannedOut]:
    """Plan the photographs to take next.

    Each is of the heliostat for which it is most informative. This is usually a mount that was
    never measured, that was measured long ago, or under few sun positions. Heliostats without
    linear actuators in their properties are left out, because their motor positions cannot be
    computed.
    """
    slots = make_plan(runtime, at, minutes, photographs)
    return Page(items=[planned_out(slot) for slot in slots], next=None)


class MovedOut(BaseModel):
    """A move of a heliostat between two photographs."""

    since: From
    until: UpTo
    when: str = Field(
        description=(
            "The same in words. If the photographs have no times, it names them, and `since` and"
            " `until` are when they arrived."
        ),
        examples=["between 2024-08-12 09:10 UTC and 2024-08-14 10:05 UTC"],
    )
    size_mrad: float = Field(
        description=("Step of its drives; if not calibrated, the pointing error [mrad].")
    )
    is_calibrated: bool = Field(
        description="Whether its mount was calibrated since, and knows the step."
    )


class DriftedOut(BaseModel):
    """Slow drift of the drives."""

    since: From
    until: UpTo
    size_mrad: float = Field(description="How far the zeros of its drives went together [mrad].")


class PointingOut(BaseModel):
    """What the newest photographs say about a calibrated mount."""

    heliostat: HeliostatOf
    mount_version: int = Field(description="Version of the mount.")
    calibrated_at: datetime = Field(description="When the mount was calibrated.")
    error_mrad: float | None = Field(
        description=(
            "Median angle at the mirror between forecast and measured spots, of the newest"
            " photographs since the heliostat last moved [mrad]. Photographs of the calibration are"
            " forecast by those of other days. null for fewer than 3."
        )
    )
    interval_mrad: tuple[float, float] | None = Field(
        description="Interval of 90 % of such angles [mrad]; null if unknown."
    )
    error_m: float | None = Field(
        description="The same at the nearest receiver's centre [m]; null without a receiver."
    )
    photographs: int = Field(description="How many that is the median of.")
    since_calibration: int = Field(
        description="How many photographs were taken since the newest calibrated one."
    )
    trend_mrad: float | None = Field(
        description=(
            "Of those, the median of the newest third over that of the third before; null below 9"
            " [mrad]."
        )
    )
    moved: MovedOut | None = Field(description="The last time that it moved.")
    drifted: DriftedOut | None = Field(description="Slow drift of its drives, where it is sure.")


class HeliostatPointingOut(PointingOut):
    """The pointing of one heliostat, with the most informative next photograph."""

    most_informative: PlannedOut | None = Field(
        description=(
            "The photograph that is expected to be most informative about its mount, of one each"
            " quarter of an hour of the coming day with a sun of at least 10 degrees. null if it"
            " reaches no target."
        )
    )


def _about(line: HeliostatOverview) -> dict[str, object]:
    own = {} if line.pointing is None else vars(line.pointing)
    return own | {"heliostat": line.name, "error_m": line.pointing_m}


def _pointing_out(line: HeliostatOverview) -> PointingOut:
    return PointingOut.model_validate(_about(line), from_attributes=True)


class PointingPage(Page[PointingOut]):
    """A part of the list of pointing errors."""

    pending: int = Field(
        description="Heliostats whose pointing error is still being computed; request them again."
    )


@router.get("/pointing", responses=problems(), dependencies=[READ])
def list_pointing(
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    limit: Limit = 100,
    after: Annotated[
        Name | None, Query(description="The last heliostat of the page before.")
    ] = None,
) -> PointingPage:
    """List the pointing errors of calibrated heliostats, by name."""
    with runtime.database.reading() as session:
        field = cache.read(session, PATIENCE_S)
    known = [
        line
        for line in field.lines
        if line.pointing is not None and (after is None or line.name > after)
    ]
    known.sort(
        key=attrgetter("name")
    )  # as `after` is compared, whatever the collation of the database
    part = page([_pointing_out(line) for line in known[: limit + 1]], limit, "heliostat")
    return PointingPage(items=part.items, next=part.next, pending=field.pending)


@router.get("/heliostats/{name}/pointing", responses=problems(404), dependencies=[READ])
def get_pointing(name: NamePath, runtime: RuntimeDep) -> HeliostatPointingOut:
    """Get the pointing error of a heliostat, from its newest photographs.

    The response includes the trend, the last move, and the most informative next photograph.
    """
    with runtime.database.reading() as session:
        (line,) = read_summaries(session, store.get_heliostat(session, name).id)
    line = with_pointing(runtime, line)
    if line.pointing is None:
        raise NotFoundError(
            f"heliostat {name} has no mount that fits it; POST to /v1/jobs/calibrations first"
        )
    slot = best_slot(runtime, name)
    about = _about(line) | {"most_informative": None if slot is None else planned_out(slot)}
    return HeliostatPointingOut.model_validate(about, from_attributes=True)


# --- the page
# --------------------------------------------------------------------------------------------------


@pages.get("/calibration-plan", dependencies=[READ, COMPUTE_SLOT])
def get_plan_page(
    request: Request,
    runtime: RuntimeDep,
    zone: ZoneDep,
    at: Annotated[FormMoment | None, Query()] = None,
    minutes: Annotated[float, Query(gt=0, le=720)] = 60.0,
    photographs: Annotated[int, Query(ge=1, le=60)] = 12,
) -> HTMLResponse:
    """The next photographs, from now or from another time. The page says so at night."""
    if at is not None:
        at = plant_time_to_utc(at, zone)
    try:
        slots, trouble = make_plan(runtime, at, minutes, photographs), None
    except InvalidInputError as error:
        slots, trouble = ([], str(error).removeprefix("at: "))  # the form has another label
    return render(
        request,
        "calibration_plan.html",
        slots=slots,
        trouble=trouble,
        at=at,
        minutes=minutes,
        photographs=photographs,
    )
