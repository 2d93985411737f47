"""A plan of aims on the page of its job: maps, aims, steps, and the aims as CSV."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from numpy.typing import NDArray
from pydantic import ValidationError

from model.errors import InvalidInputError
from service.base.arrays import unpack
from service.base.errors import NotFoundError
from service.base.fields import Lines, Version
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.jobs.enqueuing import enqueue
from service.jobs.kind import result_of
from service.jobs.kinds.aim_plans import KIND, MAX_STEPS, AimPlanIn, step_name
from service.sources.plant_tables import AIM_COLUMNS, DRIVE_COLUMNS
from service.store.job_tables import JobRow
from service.store.jobs import queue
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.runtime.runtime import Runtime
from service.web.auth.dependencies import OPERATE, READ, IdentityDep, KindsDep, RuntimeDep
from service.web.pages.plan import PlanForm
from service.web.responses.csv_tables import sheet_answer
from service.web.responses.pages import leave_for

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the job.")]

StepNumber = Annotated[
    int, Query(ge=0, lt=MAX_STEPS, description="Which step of a day, from 0; the first without it.")
]


@dataclass(frozen=True)
class AimView:
    """What the page shows of one step: its figures, its maps, and all steps of a day.

    ``maps`` are on one scale: the limit with the aims, a single aim, and the plan. ``plan`` has the
    fields of the form that plans the day with these aims; None if the plan has no times.
    """

    figures: Mapping[str, Any]
    chosen: int
    steps: list[Mapping[str, Any]]
    maps: dict[str, HeatMap]
    plan: Mapping[str, object] | None


def aim_view(runtime: Runtime, row: JobRow, step: int) -> AimView | None:
    """A finished plan of aims; None for other jobs."""
    result = row.result
    if row.kind != "aim-plans" or result is None or row.arrays is None:
        return None
    steps = [_timed(one) for one in result.get("steps", [result])]
    chosen = min(step, len(steps) - 1)
    with runtime.database.reading() as session:
        packed = queue.checkpoint_arrays(session, row.id, step_name(chosen))
    # Plans of older versions kept no steps.
    arrays = unpack(row.arrays if packed is None else packed)
    size = result["plane"]["width"], result["plane"]["height"]
    listed = steps if "steps" in result else []
    return AimView(
        {**result, **steps[chosen]}, chosen, listed, _maps(arrays, size), _plan_fields(row, steps)
    )


def _plan_fields(row: JobRow, steps: list[Mapping[str, Any]]) -> Mapping[str, object] | None:
    """Fields of `PlanForm` for the day of a plan of aims."""
    given = row.payload
    if given.get("target") is None or any(step["at"] is None for step in steps):
        return None
    limit, dni = given["limit_w_m2"], given["dni_w_m2"]
    fields = {
        "name": f"Aims of job {row.id}",
        "target": given["target"],
        "first_at": f"{steps[0]['at']:%Y-%m-%dT%H:%M}",
        "last_at": f"{steps[-1]['at']:%Y-%m-%dT%H:%M}",
        "step_minutes": (given.get("day") or {}).get("step_minutes", 60),
        "heliostats": "\n".join(given.get("heliostats") or ()),
        "aim_plan": row.id,
    }
    fields |= {"sunlight": "clear_sky"} if dni == "clear_sky" else {"dni_w_m2": dni}
    return fields if isinstance(limit, list) else fields | {"allowed_kw_m2": limit / 1e3}


class AimForm(PlanForm):
    """The form of a plan, with another button.

    ``limit_map_kw_m2`` has one row of the map a line [kW/m2], and replaces ``allowed_kw_m2``.
    """

    limit_map_kw_m2: Lines = ""

    def limit(self) -> float | list[list[float]]:
        """The limit [W/m2], as a number or a map.

        Raises
        ------
        InvalidInputError
            If there is none, or a line has something that is not a number.
        """
        lines = [line.replace(",", " ").split() for line in self.limit_map_kw_m2.splitlines()]
        try:
            rows = [[1e3 * float(word) for word in words] for words in lines if words]
        except ValueError as error:
            raise InvalidInputError(f"limit_map_kw_m2: give numbers only; {error}") from error
        if rows:
            return rows
        if self.allowed_kw_m2 is None:
            raise InvalidInputError(
                "allowed_kw_m2: give the flux that the receiver can take; aims are found within it"
            )
        return 1e3 * self.allowed_kw_m2

    def aim_payload(self, zone: str) -> AimPlanIn:
        """The payload of the job, with the day in the plant's time zone."""
        first, last = (at.astimezone(ZoneInfo(zone)) for at in (self.first_at, self.last_at))
        if first.date() != last.date():
            raise InvalidInputError(
                f"last_at: {last:%Y-%m-%d %H:%M} at the plant is not on the day of first_at,"
                f" {first:%Y-%m-%d}; aims are found for one day"
            )
        day = {"date": first.date(), "first": first.time(), "last": last.time()}
        try:
            return AimPlanIn.model_validate(
                {
                    "target": self.target,
                    "day": day | {"step_minutes": self.step_minutes},
                    "heliostats": list(self.chosen()) or None,
                    "limit_w_m2": self.limit(),
                    "dni_w_m2": "clear_sky" if self.sunlight == "clear_sky" else self.dni_w_m2,
                }
            )
        except ValidationError as error:
            raise RequestValidationError(error.errors()) from error


@router.post("/aims", dependencies=[OPERATE])
def post_aim_form(
    request: Request, form: Annotated[AimForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue a plan of aims, and go to its page. Errors are shown next to the form."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
    row = enqueue(runtime, KIND, form.aim_payload(zone), identity.name)
    return leave_for(request, f"/jobs/{row.id}")


def _timed(step: Mapping[str, Any]) -> Mapping[str, Any]:
    """A step with its time as such; None for a sun without one."""
    at = step.get("at")
    return {**step, "at": None if at is None else datetime.fromisoformat(at)}


def _maps(arrays: dict[str, NDArray[Any]], size: tuple[float, float]) -> dict[str, HeatMap]:
    limit = arrays["limit"]
    fluxes = {"single": arrays["single_aim_flux"], "plan": arrays["flux"]}
    # The flux sets the scale: a limit that is nowhere reached must not make it dark.
    top = max(float(limit.min()), *(float(flux.max()) for flux in fluxes.values())) / 1e3
    titles = {"single": "Flux if all aim at one point", "plan": "Flux by the plan"}
    maps = {"limit": charts.limit_map("Limit of flux, and the aims", limit / 1e3, size, top)}
    if "places" in arrays:
        maps["limit"] = charts.dotted(maps["limit"], arrays["places"][arrays["active"]])
    for name, flux in fluxes.items():
        drawn = charts.limit_map(titles[name], flux / 1e3, size, top)
        maps[name] = charts.marked(drawn, flux > limit)
    return maps


@router.get("/jobs/{number}/aims.csv", dependencies=[READ])
def get_job_aims_table(
    number: Number, runtime: RuntimeDep, kinds: KindsDep, step: StepNumber = 0
) -> Response:
    """The aims of a plan's step, as ``heliotwin field --aims`` reads them, and its drives."""
    with runtime.database.reading() as session:
        result = result_of(kinds, session, queue.get_job(session, number)) or {}
    steps = result.get("steps", [result])
    if step >= len(steps) or "aim_points_m" not in steps[step]:
        raise NotFoundError(f"the result of job {number} has no aims of a step {step}")
    found = steps[step]
    inactive, drives = set(found["inactive"]), found.get("drives", {})
    rows = (
        [name, *point, int(name not in inactive), *_drive_cells(drives.get(name, {}))]
        for name, point in found["aim_points_m"].items()
    )
    suffix = f"-step-{step}" if "steps" in result else ""
    return sheet_answer(f"job-{number}-aims{suffix}", (*AIM_COLUMNS, *DRIVE_COLUMNS), rows)


def _drive_cells(drive: Mapping[str, Any]) -> list[Any]:
    motors, angles = drive.get("motor_position"), drive.get("axis_angles_deg")
    return [*(motors or (None, None)), *(angles or (None, None)), drive.get("reason")]
