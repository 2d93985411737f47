"""Plans: flux of the field on a receiver over a day, and the aims that keep its limit.

A plan compares the twin with ideal mirrors, and with the flux that the receiver allows.
"""

from dataclasses import dataclass
from datetime import datetime, time, timedelta
from typing import Annotated
from zoneinfo import ZoneInfo

import numpy as np
from fastapi import APIRouter, Depends, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service import store
from service.base.arrays import unpack
from service.base.errors import ConflictError, NotFoundError
from service.base.fields import FormMoment, Lines, Name, Version, plant_time_to_utc
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.templates import in_zone
from service.drawing.timelines import Threshold, TimeAxis, Timeline, Value, timeline
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import aim_plans, plans
from service.jobs.kinds.aim_plans import AimPlanIn, DayIn
from service.jobs.kinds.plans import PlanIn, PlanName, ReceiverLoad, map_name
from service.store import queue
from service.store.columns import now
from service.store.job_tables import JobRow
from service.twin.forecasts.aims import plant_time_zone
from service.twin.forecasts.watts import LossStage
from service.twin.forecasts.watts import loss_chain as chain
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    RuntimeDep,
    ZoneDep,
)
from service.web.resources.forecasts import WHENS, SunlightForm, When, sunlight_fields, time_of
from service.web.resources.jobs import delete_job
from service.web.responses.pages import go_to, go_to_job, leave_for, named_by_field, render

pages = APIRouter(include_in_schema=False)

LISTED = 20
"""Plans on a page of the list."""


_SHARED = ("name", "target", "first_at", "last_at", "step_minutes", "aim_plan")
"""Fields that form and request have alike."""


class PlanForm(SunlightForm):
    """The form. ``heliostats`` has one name a line.

    An optional aim follows the name: right and up of the middle [m]. ``aim_plan`` is the number of
    a job `aim-plans`. ``limit_map_kw_m2`` has one row of the receiver's map a line, for aims.
    """

    name: PlanName
    target: Name
    first_at: FormMoment
    last_at: FormMoment
    step_minutes: float = Field(default=60.0, ge=1, le=1440)
    heliostats: Lines = ""
    allowed_kw_m2: float | None = Field(default=None, gt=0, le=1e5)
    limit_map_kw_m2: Lines = ""
    aim_plan: Version | None = None

    def chosen(self) -> dict[str, tuple[float, float] | None]:
        """Heliostats with their aims, or None without an aim.

        Raises
        ------
        InvalidInputError
            If a line has neither a name nor a name with two numbers.
        """
        lines = [line.replace(",", " ").split() for line in self.heliostats.splitlines()]
        chosen: dict[str, tuple[float, float] | None] = {}
        for number, (name, *aim) in (
            (number, words) for number, words in enumerate(lines, 1) if words
        ):
            try:
                right, up = map(float, aim or ("nan", "nan"))
            except ValueError as error:
                raise InvalidInputError(
                    f"heliostats: line {number}: give a name, or a name and two numbers, metres"
                    " right and up"
                ) from error
            chosen[name] = (right, up) if aim else None
        return chosen

    def limit_map(self) -> list[list[float]]:
        """The limits [W/m2] over the receiver's map; none if they are not given.

        Raises
        ------
        InvalidInputError
            If a line has something that is not a number.
        """
        lines = [line.replace(",", " ").split() for line in self.limit_map_kw_m2.splitlines()]
        try:
            return [[1e3 * float(word) for word in words] for words in lines if words]
        except ValueError as error:
            raise InvalidInputError(f"limit_map_kw_m2: give numbers only; {error}") from error

    def payload(self) -> PlanIn:
        """The payload of the job."""
        chosen = self.chosen()
        with named_by_field():
            return PlanIn(
                **{name: getattr(self, name) for name in _SHARED},
                heliostats=list(chosen) or None,
                aim_offsets_m={name: aim for name, aim in chosen.items() if aim is not None},
                allowed_w_m2=None if self.allowed_kw_m2 is None else 1e3 * self.allowed_kw_m2,
                dni_w_m2=self.given_dni,
            )


def _likely(targets: list[str], zone: str) -> PlanForm:
    """Defaults of the form: a day from morning to evening at the plant."""
    today = now().astimezone(ZoneInfo(zone)).replace(tzinfo=None)
    morning = plant_time_to_utc(today.replace(hour=6, minute=0, second=0, microsecond=0), zone)
    return PlanForm.model_construct(
        name="",
        target=next(iter(targets), ""),
        first_at=morning,
        last_at=morning + timedelta(hours=12),
    )


def _filled(asked: PlanIn) -> PlanForm:
    """The form from which a plan was requested."""
    aims = {name: f"{name} {right:g} {up:g}" for name, (right, up) in asked.aim_offsets_m.items()}
    lines = [aims.get(name, name) for name in asked.heliostats or ()]
    given = {name: getattr(asked, name) for name in _SHARED}
    given |= sunlight_fields(asked.dni_w_m2)
    allowed = None if asked.allowed_w_m2 is None else asked.allowed_w_m2 / 1e3
    return PlanForm.model_construct(**given, heliostats="\n".join(lines), allowed_kw_m2=allowed)


# --- aims
# --------------------------------------------------------------------------------------------------


_SHARED_WITH_AIMS = ("heliostats", "target", "plane", "receiver", "dni_w_m2")
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
    names = (*_SHARED_WITH_AIMS, "neighbours", "measured_states", "model_version")
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
        **{name: getattr(asked, name) for name in _SHARED_WITH_AIMS},
        name=f"aims of job {number}",
        first_at=datetime.fromisoformat(times[0]),
        last_at=datetime.fromisoformat(times[-1]),
        step_minutes=60.0 if asked.day is None else asked.day.step_minutes,
        allowed_w_m2=None if isinstance(limit, list) else limit,
        aim_plan=number,
    )


# --- results
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlanStep:
    """A time of a plan: the sun, and the load on the receiver by the twin and by ideal mirrors."""

    at: datetime
    sun: dict[str, float]
    dni_w_m2: float | None
    twin: ReceiverLoad
    ideal: ReceiverLoad

    @property
    def chains(self) -> list[tuple[LossStage, LossStage]]:
        """Losses of the twin and of ideal mirrors, stage by stage; none without any light."""
        twin, ideal = self.twin["field"], self.ideal["field"]
        return [] if not twin or not ideal else [*zip(chain(twin), chain(ideal), strict=True)]


@dataclass(frozen=True)
class Day:
    """Results of a finished plan.

    ``energy_wh`` [Wh] is None if the plan has a single time. ``allowed_w_m2`` is the limit, if any.
    """

    steps: list[PlanStep]
    chosen: int
    timelines: list[Timeline]
    maps: dict[str, HeatMap]
    energy_wh: dict[str, float | None]
    allowed_w_m2: float | None

    def excess(self, step: PlanStep) -> float:
        """By how much the twin's flux exceeds the limit at a time, as a share of it [1], or 0."""
        allowed = self.allowed_w_m2
        return 0.0 if allowed is None else max(0.0, step.twin["peak_w_m2"] / allowed - 1)

    @property
    def exceeded(self) -> list[PlanStep]:
        """The times at which the flux exceeds the limit."""
        return [step for step in self.steps if self.excess(step) > 0]

    @property
    def worst(self) -> PlanStep:
        """The time of the largest flux."""
        return max(self.steps, key=lambda step: step.twin["peak_w_m2"])


def _series(steps: list[PlanStep], figure: str, scale: float) -> dict[str, list[Value]]:
    return {
        name: [
            Value(step.at, scale * of[figure])
            for step in steps
            if (of := getattr(step, kind))[figure] is not None
        ]
        for name, kind in (("twin", "twin"), ("ideal mirrors", "ideal"))
    }


def _energy(steps: list[PlanStep], kind: str) -> float | None:
    """Energy by the trapezoidal rule [Wh], None for a single time."""
    hours = [(step.at - steps[0].at).total_seconds() / 3600 for step in steps]
    return (
        float(np.trapezoid([getattr(step, kind)["power_w"] for step in steps], hours))
        if len(steps) > 1
        else None
    )


def _allowed_w_m2(row: JobRow) -> float | None:
    allowed: float | None = row.payload.get("allowed_w_m2")
    return allowed


def _maps(row: JobRow, of_time: bytes) -> dict[str, HeatMap]:
    """Flux maps of the twin, of ideal mirrors, and of the maximum over all times.

    They share one scale, and areas above the limit are outlined. ``of_time`` holds the packed maps
    of the chosen time.
    """
    assert row.result is not None
    assert row.arrays is not None
    plane, arrays = row.result["plane"], unpack(of_time)
    size = plane["width"], plane["height"]
    twin, ideal, most = arrays["twin"], arrays["ideal"], unpack(row.arrays)["flux"]
    top, allowed = float(max(twin.max(), ideal.max(), most.max())), _allowed_w_m2(row) or np.inf
    titles = {
        "by the twin": twin,
        "by ideal mirrors": ideal,
        "the most of all times, by the twin": most,
    }
    return {
        title: charts.outlined(
            charts.irradiance_map(f"Flux {title}", flux, size, top), flux > allowed
        )
        for title, flux in titles.items()
    }


def _day(session: Session, row: JobRow, at: int | None, zone: str) -> Day:
    """A finished plan with the maps of one time. Other maps are not loaded."""
    assert row.result is not None
    steps = [
        PlanStep(
            datetime.fromisoformat(step["at"]),
            step["sun"],
            step.get("dni_w_m2"),
            step["twin"],
            step["ideal"],
        )
        for step in row.result["steps"]
    ]
    hottest = max(range(len(steps)), key=lambda index: steps[index].twin["peak_w_m2"])
    chosen = hottest if at is None else min(at, len(steps) - 1)
    of_time = queue.checkpoint_arrays(session, row.id, map_name(chosen))
    assert of_time is not None
    allowed = _allowed_w_m2(row)
    limit, axis = None if allowed is None else Threshold(allowed / 1e3), TimeAxis(zone)
    drawn = (
        timeline("Power on the receiver", "kW", _series(steps, "power_w", 1e-3), 1, axis=axis),
        timeline(
            "Largest flux", "kW/m²", _series(steps, "peak_w_m2", 1e-3), 1, axis=axis, limit=limit
        ),
        timeline("Intercept factor", "%", _series(steps, "intercept", 100.0), 1, axis=axis),
    )
    return Day(
        steps,
        chosen,
        [chart for chart in drawn if chart is not None],
        _maps(row, of_time),
        {kind: _energy(steps, kind) for kind in ("twin", "ideal")},
        allowed,
    )


# --- pages
# --------------------------------------------------------------------------------------------------


def _context(
    runtime: Runtime,
    session: Session,
    zone: str,
    after: int | None,
    asked: PlanIn | None,
    when: When | None = None,
) -> dict[str, object]:
    """The form, filled with a request or with defaults, and the list of plans."""
    receivers = [row.name for row in store.list_receivers(session)]
    targets = [*receivers, *(row.name for row in store.list_targets(session))]
    filled = _likely(targets, zone) if asked is None else _filled(asked)
    if when is not None:
        at = time_of(when, zone, store.find_plant(session))
        filled = filled.model_copy(update={"first_at": at, "last_at": at})
    plans = store.list_plans(session, LISTED + 1, after)
    return {
        "filled": filled,
        "in_zone": in_zone(zone),
        "zone": zone,
        "whens": WHENS,
        "plan_days": runtime.settings.plan_retention_days,
        "targets": targets,
        "plans": plans[:LISTED],
        "after": after,
        "older": plans[LISTED - 1].job if len(plans) > LISTED else None,
        "job": None,
        "day": None,
    }


After = Annotated[Version | None, Query(description="The last plan of the page before.")]
Number = Annotated[Version, Path(description="Id of the plan's job.")]


def _list_context(
    runtime: RuntimeDep,
    after: After = None,
    aims: Annotated[Version | None, Query(description="Job of an aim plan to fill in.")] = None,
    when: Annotated[When | None, Query(description="A time to fill in.")] = None,
) -> dict[str, object]:
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        asked = None if aims is None else plan_with(session, aims)
        return _context(runtime, session, zone, after, asked, when)


@pages.get("/plans", dependencies=[READ])
def get_plans_page(
    request: Request, listed: Annotated[dict[str, object], Depends(_list_context)]
) -> HTMLResponse:
    """The form, and the list of plans."""
    return render(request, "plan.html", **listed)


def plan_figures(
    runtime: Runtime, number: int, after: int | None, at: int | None
) -> dict[str, object]:
    """What the page of a plan draws, with its request in the form."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number, arrays=True)
        zone = plant_time_zone(session, runtime.settings.time_zone)
        asked = _requested(row)
        context = _context(runtime, session, zone, after, asked)
        day = None if row.result is None else _day(session, row, at, zone)
    aims = None if day is None else aims_for(asked, zone)
    return context | {
        "job": row,
        "day": day,
        "is_live": row.state not in queue.ENDED,
        "aims_s": None if aims is None else aim_plans.expected_plan_s(aims, runtime),
    }


def _requested(job: JobRow) -> PlanIn:
    """The request of a plan; NotFoundError if it is another job."""
    if job.kind != "plans":
        raise NotFoundError(f"job {job.id} is no plan")
    return PlanIn.model_validate(job.payload)


@pages.get("/plans/{number}", dependencies=[READ, RENDER_SLOT])
def get_plan_page(
    number: Number,
    request: Request,
    runtime: RuntimeDep,
    after: After = None,
    at: Annotated[int | None, Query(ge=0, le=1000, description="Which time's maps.")] = None,
) -> HTMLResponse:
    """A plan, followed until it is done, with its request in the form."""
    return render(request, "plan.html", **plan_figures(runtime, number, after, at))


@pages.post("/plans/{number}/delete", dependencies=[OPERATE])
def post_deletion_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Delete a plan, and return to the list."""
    delete_job(number, runtime, identity)
    return go_to("/plans")


@pages.post("/plans", dependencies=[OPERATE])
def post_plan_form(
    request: Request,
    form: Annotated[PlanForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
    zone: ZoneDep,
) -> Response:
    """Enqueue a plan, and go to its page.

    Errors are shown next to the form, which keeps its values.
    """
    row = enqueue(runtime, plans.KIND, form.in_utc(zone).payload(), identity.name).row
    return leave_for(request, f"/plans/{row.id}")


@pages.post("/aims", dependencies=[OPERATE])
def post_aims_form(
    request: Request,
    form: Annotated[PlanForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
    zone: ZoneDep,
) -> Response:
    """Enqueue aims for the times of the form, and go to the page of the job."""
    with named_by_field():
        payload = aims_for(form.in_utc(zone).payload(), zone, form.limit_map())
    if payload is None:
        raise InvalidInputError("allowed_kw_m2: give the flux that the receiver can take")
    row = enqueue(runtime, aim_plans.KIND, payload, identity.name).row
    return leave_for(request, f"/jobs/{row.id}")


def _plan(number: Number, runtime: RuntimeDep) -> PlanIn:
    with runtime.database.reading() as session:
        return _requested(queue.get_job(session, number))


@pages.post("/plans/{number}/aims", dependencies=[OPERATE])
def post_plan_aims_form(
    number: Number,
    plan: Annotated[PlanIn, Depends(_plan)],
    runtime: RuntimeDep,
    identity: IdentityDep,
    zone: ZoneDep,
) -> Response:
    """Enqueue aims under the limit of a plan, and go to the page of the job."""
    payload = aims_for(plan, zone)
    if payload is None:
        raise ConflictError(f"plan {number} has no limit; plan it again with an allowed flux")
    return go_to_job(runtime, aim_plans.KIND, payload, identity)
