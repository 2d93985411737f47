"""From a plan that exceeds its limit to aims under the limit, and from these to another plan."""

from datetime import datetime, time
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Response
from sqlalchemy.orm import Session

from service.base.errors import ConflictError, NotFoundError
from service.jobs.kinds import aim_plans
from service.jobs.kinds.aim_plans import AimPlanIn, DayIn
from service.jobs.kinds.plans import PlanIn
from service.store.jobs import queue
from service.twin.forecasts.aim_sources import plant_time_zone
from service.web.auth.dependencies import OPERATE, IdentityDep, RuntimeDep
from service.web.resources.jobs import Number
from service.web.responses.pages import go_to_job

router = APIRouter(include_in_schema=False)

_SHARED = ("heliostats", "target", "plane", "receiver", "dni_w_m2")
"""Fields that a plan has from aims, and aims from a plan."""


def aims_for(
    asked: PlanIn, zone: str, limit_w_m2: list[list[float]] | None = None
) -> AimPlanIn | None:
    """The aims that would keep the limit of a plan, on its first day; None without a limit.

    ``limit_w_m2`` is a map of it, instead of the plan's number.
    """
    limit = limit_w_m2 or asked.allowed_w_m2
    if limit is None:
        return None
    first, last = (at.astimezone(ZoneInfo(zone)) for at in (asked.first_at, asked.last_at))
    day = DayIn(
        date=first.date(),
        first=first.time().replace(second=0, microsecond=0),
        last=last.time() if last.date() == first.date() else time(23, 59),
        step_minutes=asked.step_minutes,
    )
    names = (*_SHARED, "neighbours", "measured_states", "model_version")
    same = {name: getattr(asked, name) for name in names}
    return AimPlanIn(**same, day=day, limit_w_m2=limit)


def plan_with(session: Session, number: int) -> PlanIn:
    """A plan of the times of a finished aim plan, with its aims.

    Raises
    ------
    ConflictError
        If the job has no aims for known times.
    """
    row = queue.get_job(session, number)
    result = row.result or {}
    times = [step["at"] for step in result.get("steps", [result]) if step.get("at")]
    if row.kind != aim_plans.KIND.name or not times:
        raise ConflictError(f"aims: job {number} has no aims for known times; choose an aim plan")
    asked = AimPlanIn.model_validate(row.payload)
    limit = asked.limit_w_m2
    return PlanIn(
        **{name: getattr(asked, name) for name in _SHARED},
        name=f"aims of job {number}",
        first_at=datetime.fromisoformat(times[0]),
        last_at=datetime.fromisoformat(times[-1]),
        step_minutes=60.0 if asked.day is None else asked.day.step_minutes,
        allowed_w_m2=None if isinstance(limit, list) else limit,
        aim_plan=number,
    )


@router.post("/plans/{number}/aims", dependencies=[OPERATE])
def post_aims_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Enqueue aims under the limit of a plan, and go to the page of the job."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number)
        if row.kind != "plans":
            raise NotFoundError(f"job {number} is no plan")
        zone = plant_time_zone(session, runtime.settings.time_zone)
        payload = aims_for(PlanIn.model_validate(row.payload), zone)
    if payload is None:
        raise ConflictError(f"plan {number} has no limit; plan it again with an allowed flux")
    return go_to_job(runtime, aim_plans.KIND, payload, identity)
