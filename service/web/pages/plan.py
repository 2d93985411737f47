"""Plans: a day of the field's light on a receiver, by the twin and by ideal mirrors, against what it stands."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse
from pydantic import Field, ValidationError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service import store
from service.base.arrays import unpack
from service.base.faults import NotFoundError
from service.base.fields import FormMoment, Model, Name, Version
from service.drawing import charts
from service.drawing.charts import HeatMap, Timeline, Value
from service.drawing.templates import in_zone
from service.jobs.asking import ask_for, forget_for
from service.jobs.kinds.plans import PlanIn
from service.store import queue
from service.store.columns import now
from service.store.job_tables import JobRow
from service.web.answers.pages import go_to, leave_for, render
from service.web.door.dependencies import DRAWS, OPERATE, READ, IdentityDep, RuntimeDep

router = APIRouter(include_in_schema=False)

LISTED = 20
"""Plans on a page of the list."""


class PlanForm(Model):
    """The form; ``heliostats`` are names, one a line, each with or without an aim: right and up of the middle [m]."""

    name: str = Field(min_length=1, max_length=80)
    target: Name
    begin: FormMoment
    end: FormMoment
    step_minutes: float = Field(default=60.0, ge=1, le=1440)
    heliostats: str = Field(default="", max_length=800_000)
    allowed_kw_m2: float | None = Field(default=None, gt=0, le=1e5)
    dni_w_m2: float = Field(default=1000.0, gt=0, le=2000)

    def chosen(self) -> dict[str, tuple[float, float] | None]:
        """Heliostats with their aims; InvalidInputError names the line that says neither."""
        lines = [line.replace(",", " ").split() for line in self.heliostats.splitlines()]
        chosen: dict[str, tuple[float, float] | None] = {}
        for number, (name, *aim) in ((number, words) for number, words in enumerate(lines, 1) if words):
            try:
                right, up = map(float, aim or ("nan", "nan"))
            except ValueError as error:
                raise InvalidInputError(
                    f"heliostats: line {number}: give a name, or a name and two numbers, metres right and up"
                ) from error
            chosen[name] = (right, up) if aim else None
        return chosen

    def payload(self) -> PlanIn:
        """What the job takes."""
        chosen = self.chosen()
        try:
            return PlanIn(
                name=self.name,
                target=self.target,
                begin=self.begin,
                end=self.end,
                step_minutes=self.step_minutes,
                heliostats=list(chosen) or None,
                aim_offsets={name: aim for name, aim in chosen.items() if aim is not None},
                allowed_w_m2=None if self.allowed_kw_m2 is None else 1e3 * self.allowed_kw_m2,
                dni_w_m2=self.dni_w_m2,
            )
        except ValidationError as error:
            raise RequestValidationError(error.errors()) from error


def _likely(targets: list[str]) -> dict[str, Any]:
    """What stands in the form at first: a day from morning to evening."""
    morning = now().replace(hour=6, minute=0, second=0, microsecond=0)
    return {
        "name": "",
        "target": targets[0] if targets else None,
        "begin": morning,
        "end": morning + timedelta(hours=12),
        "step_minutes": 60.0,
        "heliostats": "",
        "allowed_kw_m2": None,
        "dni_w_m2": 1000.0,
    }


def _filled(asked: PlanIn) -> dict[str, Any]:
    """What the form held."""
    aims = {name: f"{name} {right:g} {up:g}" for name, (right, up) in asked.aim_offsets.items()}
    lines = [aims.get(name, name) for name in asked.heliostats or ()]
    given = {name: getattr(asked, name) for name in ("name", "target", "begin", "end", "step_minutes", "dni_w_m2")}
    allowed = None if asked.allowed_w_m2 is None else asked.allowed_w_m2 / 1e3
    return {**given, "heliostats": "\n".join(lines), "allowed_kw_m2": allowed}


# --- what came of it --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """A time of a plan: the sun, and what the light does to the receiver, by the twin and by ideal mirrors."""

    at: datetime
    sun: dict[str, float]
    twin: dict[str, Any]
    ideal: dict[str, Any]


@dataclass(frozen=True)
class Day:
    """A plan that is done; energies [Wh] are None of a single time, ``exceeded`` is how many times too much came."""

    steps: list[Step]
    chosen: int
    timelines: list[Timeline]
    maps: dict[str, HeatMap]
    energy_wh: dict[str, float | None]
    exceeded: int


def _series(steps: list[Step], figure: str, scale: float) -> dict[str, list[Value]]:
    return {
        name: [Value(step.at, scale * of[figure]) for step in steps if (of := getattr(step, kind))[figure] is not None]
        for name, kind in (("twin", "twin"), ("ideal mirrors", "ideal"))
    }


def _energy(steps: list[Step], kind: str) -> float | None:
    """By straight lines from time to time [Wh]."""
    hours = [(step.at - steps[0].at).total_seconds() / 3600 for step in steps]
    return float(np.trapezoid([getattr(step, kind)["power_w"] for step in steps], hours)) if len(steps) > 1 else None


def _maps(row: JobRow, asked: PlanIn, chosen: int) -> dict[str, HeatMap]:
    """Twin and ideal mirrors on one scale, with what is exceeded outlined, and the most that comes all day."""
    assert row.result is not None
    assert row.arrays is not None
    plane, arrays = row.result["plane"], unpack(row.arrays)
    size = plane["width"], plane["height"]
    twin, ideal, most = arrays["twin"][chosen], arrays["ideal"][chosen], arrays["flux"]
    top, allowed = float(max(twin.max(), ideal.max(), most.max())), asked.allowed_w_m2 or np.inf
    titles = {"by the twin": twin, "by ideal mirrors": ideal, "the most of all times, by the twin": most}
    return {
        title: charts.outlined(charts.flux_map(f"Flux {title}", flux, size, "W/m²", top), flux > allowed)
        for title, flux in titles.items()
    }


def _day(row: JobRow, asked: PlanIn, at: int | None) -> Day:
    assert row.result is not None
    steps = [
        Step(datetime.fromisoformat(step["at"]), step["sun"], step["twin"], step["ideal"])
        for step in row.result["steps"]
    ]
    hottest = max(range(len(steps)), key=lambda index: steps[index].twin["peak_w_m2"])
    chosen = hottest if at is None else min(at, len(steps) - 1)
    limit = None if asked.allowed_w_m2 is None else asked.allowed_w_m2 / 1e3
    drawn = (
        charts.timeline("Power on the receiver", "kW", _series(steps, "power_w", 1e-3), 1),
        charts.timeline("Largest flux", "kW/m²", _series(steps, "peak_w_m2", 1e-3), 1, limit=limit),
        charts.timeline("Intercept factor", "%", _series(steps, "intercept", 100.0), 1, from_zero=False),
    )
    return Day(
        steps,
        chosen,
        [chart for chart in drawn if chart is not None],
        _maps(row, asked, chosen),
        {kind: _energy(steps, kind) for kind in ("twin", "ideal")},
        sum(bool(step.twin["exceeded_m2"]) for step in steps),
    )


# --- pages ------------------------------------------------------------------------------------------------------------


def _choices(session: Session, after: int | None) -> dict[str, Any]:
    receivers, plans = [row.name for row in store.list_receivers(session)], store.list_plans(session, LISTED + 1, after)
    return {
        "targets": [*receivers, *(row.name for row in store.list_targets(session))],
        "plans": plans[:LISTED],
        "after": after,
        "older": plans[LISTED - 1].job if len(plans) > LISTED else None,
    }


After = Annotated[Version | None, Query(description="The last plan of the page before.")]
Number = Annotated[Version, Path(description="Id of the plan's job.")]


@router.get("/plans", dependencies=[READ])
def get_plans_page(request: Request, runtime: RuntimeDep, after: After = None) -> HTMLResponse:
    """The form, and the plans that were made."""
    with runtime.database.reading() as session:
        choices = _choices(session, after)
    zone = in_zone(runtime.settings.time_zone)
    return render(request, "plan.html", **choices, filled=_likely(choices["targets"]), job=None, day=None, in_zone=zone)


@router.get("/plans/{number}", dependencies=[READ, DRAWS])
def get_plan_page(
    number: Number,
    request: Request,
    runtime: RuntimeDep,
    after: After = None,
    at: Annotated[int | None, Query(ge=0, le=1000, description="Which time's maps.")] = None,
) -> HTMLResponse:
    """A plan, followed until it is done, with the form as it was asked for."""
    with runtime.database.reading() as session:
        row, choices = queue.get_job(session, number, arrays=True), _choices(session, after)
    if row.kind != "plans":
        raise NotFoundError(f"job {number} is no plan")
    asked = PlanIn.model_validate(row.payload)
    return render(
        request,
        "plan.html",
        **choices,
        filled=_filled(asked),
        job=row,
        is_live=row.state not in queue.ENDED,
        asked=asked,
        day=None if row.result is None else _day(row, asked, at),
        in_zone=in_zone(runtime.settings.time_zone),
    )


@router.post("/plans/{number}/delete", dependencies=[OPERATE])
def post_deletion_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Delete a plan, and go back to the others."""
    forget_for(runtime, number, identity.name)
    return go_to("/plans")


@router.post("/plans", dependencies=[OPERATE])
def post_plan_form(
    request: Request, form: Annotated[PlanForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Ask for a plan, and go to its page; what is wrong is told beside the form, which keeps what was typed."""
    payload = form.payload()
    with runtime.database.reading() as session:
        chosen = payload.heliostats or []
        known = store.get_heliostats(session, chosen)
    if unknown := [name for name in chosen if name not in known]:
        raise InvalidInputError(f"heliostats: there is no {unknown[0]} here; the field's page has the names")
    row = ask_for(runtime, "plans", payload.model_dump(mode="json"), identity.name)
    return leave_for(request, f"/plans/{row.id}")
