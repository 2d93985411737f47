"""A plan of aims on the page of its job: maps, aims, steps, and the aims as CSV."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from numpy.typing import NDArray

from service.base.arrays import unpack
from service.base.errors import NotFoundError
from service.base.fields import Version
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.timelines import Threshold, TimeAxis, Timeline, Value, timeline
from service.jobs.kind import result_of
from service.jobs.kinds.aim_plans import MAX_STEPS, step_name
from service.sources.plant_tables import AIM_COLUMNS, DRIVE_COLUMNS
from service.store.job_tables import JobRow
from service.store.jobs import queue
from service.twin.runtime.runtime import Runtime
from service.web.auth.dependencies import READ, KindsDep, RuntimeDep
from service.web.responses.csv_tables import sheet_answer

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the job.")]

StepNumber = Annotated[
    int, Query(ge=0, lt=MAX_STEPS, description="Which step of a day, from 0; the first without it.")
]


# Excess of a plan that its draws cannot distinguish from none [1].
_TOLERANCE = 0.005


@dataclass(frozen=True)
class AimView:
    """What the page shows of one step: its figures, its maps, and all steps of a day.

    ``maps`` are on one scale: the aims, a single aim, and the plan. ``timelines`` are those of a
    day.
    """

    figures: Mapping[str, Any]
    chosen: int
    steps: list[Mapping[str, Any]]
    maps: dict[str, HeatMap]
    timelines: list[Timeline]

    @property
    def exceeded(self) -> list[Mapping[str, Any]]:
        """The steps whose flux exceeds the limit."""
        return [step for step in self.steps or [self.figures] if excess(step)]


def excess(step: Mapping[str, Any]) -> float:
    """By how much a step exceeds its limit in 95 % of draws, as a share of it [1], or 0."""
    share: float = step["largest_share_of_limit"] - 1
    return share if share > _TOLERANCE else 0.0


def aim_view(runtime: Runtime, row: JobRow, step: int) -> AimView | None:
    """A finished plan of aims; None for other jobs."""
    result = row.result
    if row.kind != "aim-plans" or result is None or row.arrays is None:
        return None
    steps = [_timed(one) for one in result.get("steps", [result])]
    chosen = min(step, len(steps) - 1)
    with runtime.database.reading() as session:
        packed = queue.checkpoint_arrays(session, row.id, step_name(chosen))
    assert packed is not None
    arrays = unpack(packed)
    size = result["plane"]["width"], result["plane"]["height"]
    listed = steps if "steps" in result else []
    lines = _timelines(listed, result.get("time_zone") or "UTC", row.payload["limit_w_m2"])
    return AimView({**result, **steps[chosen]}, chosen, listed, _maps(arrays, size), lines)


def _timelines(steps: list[Mapping[str, Any]], zone: str, limit_w_m2: Any) -> list[Timeline]:
    """Power and flux over a day; the limit is a line if it is the same everywhere."""
    limit = Threshold(limit_w_m2 / 1e3) if isinstance(limit_w_m2, int | float) else None
    axis = TimeAxis(zone)

    def series(names: Mapping[str, str]) -> dict[str, list[Value]]:
        return {
            name: [Value(step["at"], step[key] / 1e3) for step in steps]
            for name, key in names.items()
        }

    power = {"plan": "power_w", "most that any aims can give": "bound_w"}
    peak = {"peak in 95 % of cases": "peak_p95_w_m2", "expected peak": "peak_w_m2"}
    drawn = (
        timeline("Power on the receiver", "kW", series(power), 1, axis=axis),
        timeline("Largest flux", "kW/m²", series(peak), 1, axis=axis, limit=limit),
    )
    return [chart for chart in drawn if chart is not None]


def _timed(step: Mapping[str, Any]) -> Mapping[str, Any]:
    """A step with its time as such; None for a sun without one."""
    at = step.get("at")
    return {**step, "at": None if at is None else datetime.fromisoformat(at)}


def _maps(arrays: dict[str, NDArray[Any]], size: tuple[float, float]) -> dict[str, HeatMap]:
    limit = arrays["limit"]
    fluxes = {"single": arrays["single_aim_flux"], "plan": arrays["flux"]}
    # The flux sets the scale: a limit that is nowhere reached must not make it dark.
    top = max(float(limit.min()), *(float(flux.max()) for flux in fluxes.values()))
    titles = {"single": "Flux if all aim at one point", "plan": "Flux by the plan"}
    maps = {
        name: charts.outlined(charts.irradiance_map(titles[name], flux, size, top), flux > limit)
        for name, flux in fluxes.items()
    }
    is_even = bool(limit.min() == limit.max())  # its map would be one colour
    title = f"Aims as dots over the {'flux of the plan' if is_even else 'limit'}"
    maps["aims"] = charts.irradiance_map(title, fluxes["plan"] if is_even else limit, size, top)
    if "places" in arrays:
        maps["aims"] = charts.dotted(maps["aims"], arrays["places"][arrays["active"]])
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
