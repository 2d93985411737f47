"""Pages of jobs: what runs, what has ended, and buttons that cancel jobs."""

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from model.fleet import LOSSES
from service.base.arrays import unpack
from service.base.errors import NotFoundError
from service.base.fields import Version
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.templates import in_words, in_zone
from service.jobs.enqueuing import cancel_for
from service.jobs.kind import Kinds, result_of
from service.store.job_tables import JobRow
from service.store.jobs import queue
from service.store.sizes import sizes
from service.twin.forecasts.mirror_states import STATE_COLUMNS, state_rows
from service.twin.forecasts.watts import loss_chain
from service.twin.runtime.runtime import Runtime
from service.web.auth.dependencies import (
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    KindsDep,
    RuntimeDep,
)
from service.web.pages.aim_plan import StepNumber, aim_view, excess
from service.web.pages.calibration_result import MOST, OFFSETS, calibration_view
from service.web.responses.csv_tables import sheet_answer
from service.web.responses.pages import go_to, render

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the job.")]

_PAGE = 50

# Most items of a list on a page of a job, such as its heliostats.
_SHOWN = MOST


@router.get("/jobs", dependencies=[READ])
def get_jobs_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Jobs, newest first."""
    with runtime.database.reading() as session:
        rows = queue.list_jobs(session, _PAGE + 1, after)
        held = sizes(session)
    is_live = any(row.state not in queue.ENDED for row in rows)
    more = rows[_PAGE - 1].id if len(rows) > _PAGE else None
    settings = runtime.settings
    return render(
        request,
        "jobs.html",
        jobs=rows[:_PAGE],
        more=more,
        after=after,
        is_live=is_live,
        ended=queue.ENDED,
        held=held,
        kept=(
            ("accepted", held.accepted, settings.image_retention_days),
            ("refused", held.refused, settings.refused_image_retention_days),
        ),
        quota_bytes=settings.image_quota_gb * 1e9,
    )


def _flux(row: JobRow) -> HeatMap | None:
    """The flux map of a job, if it has one; plans of aims have separate maps."""
    if (
        row.kind == "aim-plans"
        or row.arrays is None
        or row.result is None
        or "plane" not in row.result
    ):
        return None
    plane = row.result["plane"]
    flux = unpack(row.arrays)["flux"]
    title = f"Flux of {row.result['heliostats']} heliostats together"
    return charts.irradiance_map(title, flux, (plane["width"], plane["height"]))


def _plain(value: Any) -> bool:
    return isinstance(value, str | int | float | bool)


# Labels of fields whose names are not clear, and units by the endings of names.
_LABELS = {
    "dni_w_m2": "direct normal irradiance",
    "neighbours": "mirrors shade and block each other",
    "measured_states": "mirrors as measured: dimmed, and with their pointing errors",
    "model_version": "version of the model",
    "aim_point_m": "aim point, east, north, up [m]",
    "aim_points_m": "aim points, east, north, up [m]",
    "aim_offsets_m": "aims, right and up of the middle [m]",
    "images": "photographs of each heliostat",
}
_UNITS = {
    "dni_w_m2": "\N{NO-BREAK SPACE}W/m²",
    "_w_m2": "\N{NO-BREAK SPACE}kW/m²",
    "_deg": "°",
    "_minutes": "\N{NO-BREAK SPACE}min",
}


def _entry(name: str, value: Any) -> tuple[str, str]:
    """Label and formatted value of a payload field."""
    ending = next((ending for ending in _UNITS if name.endswith(ending)), "")
    label = _LABELS.get(name, name.removesuffix(ending).replace("_", " "))
    if isinstance(value, list | dict) and len(value) > _SHOWN:
        return label, f"{len(value)} entries"
    if name == "resolution":
        return label, f"{' × '.join(map(str, value))} pixels"
    if isinstance(value, dict):
        return label, ", ".join(" ".join(_entry(inner, of)) for inner, of in value.items())
    if isinstance(value, list):
        return label, ", ".join(_entry("", one)[1] for one in value)
    if name in ("at", "first_at", "last_at"):
        return label, f"{datetime.fromisoformat(value):%Y-%m-%d %H:%M UTC}"
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and ending == "_w_m2":
        value /= 1e3
    return label, f"{value:.10g}{_UNITS.get(ending, '')}" if is_number else in_words(value)


def _asked(payload: Mapping[str, object]) -> dict[str, str]:
    """Fields of a payload in words and with units. Long lists are reduced to their length."""
    return dict(
        _entry(name, value) for name, value in payload.items() if value not in (None, {}, [])
    )


_FACTORS = ("name", *LOSSES, "optical_efficiency", "intercepted_w")

By = Annotated[
    Literal[_FACTORS],  # type: ignore[valid-type]
    Query(description="What the heliostats of a field forecast are sorted by."),
]


def _result_with(runtime: Runtime, kinds: Kinds, number: int, part: str) -> Mapping[str, Any]:
    """The result of a job that has this part; NotFoundError if it has not."""
    with runtime.database.reading() as session:
        result = result_of(kinds, session, queue.get_job(session, number)) or {}
    if part not in result:
        raise NotFoundError(f"the result of job {number} has no {part}")
    return result


@router.get("/jobs/{number}/heliostats.csv", dependencies=[READ])
def get_job_heliostats_table(number: Number, runtime: RuntimeDep, kinds: KindsDep) -> Response:
    """What becomes of the light of each heliostat of a field forecast."""
    lines = _result_with(runtime, kinds, number, "by_heliostat")["by_heliostat"].items()
    columns = _FACTORS[1:]
    rows = ([name, *(one[column] for column in columns)] for name, one in lines)
    return sheet_answer(f"job-{number}-heliostats", ("heliostat", *columns), rows)


@router.get("/jobs/{number}/states.csv", dependencies=[READ])
def get_job_states_table(number: Number, runtime: RuntimeDep, kinds: KindsDep) -> Response:
    """Measured states of mirrors of a field forecast, for ``heliotwin field --states``."""
    rows = state_rows(_result_with(runtime, kinds, number, "states")["states"])
    return sheet_answer(f"job-{number}-states", STATE_COLUMNS, rows)


def _mirrors(result: Mapping[str, Any], by: str) -> list[tuple[str, dict[str, float]]]:
    """The heliostats of a field forecast, sorted by a factor or their name."""
    lines = list(result.get("by_heliostat", {}).items())
    lines.sort(key=(lambda line: line[0]) if by == "name" else (lambda line: line[1][by]))
    return lines


@router.get("/jobs/{number}", dependencies=[READ, RENDER_SLOT])
def get_job_page(
    number: Number,
    request: Request,
    runtime: RuntimeDep,
    kinds: KindsDep,
    by: By = "name",
    step: StepNumber = 0,
    page: Annotated[int, Query(ge=1, le=10**6)] = 1,
) -> HTMLResponse:
    """A job, which the page follows until it ends.

    The heliostats of a field forecast are sorted ``by`` their name or a factor, the least first.
    Of a plan of aims the maps of one ``step`` are shown, and of long lists one ``page``.
    While it runs, each update reads only what changes, but neither the payload nor the result.
    """
    with runtime.database.reading() as session:
        row = queue.get_summary(session, number)
        begin = (page - 1) * _SHOWN
        is_live, asked, flux, aims = row.state not in queue.ENDED, None, None, None
        result: Mapping[str, Any] = {}
        calibration = None
        if not is_live or "hx-request" not in request.headers:
            session.expunge(row)
            row = queue.get_job(session, number, arrays=True)
            asked, result, flux = (
                _asked(row.payload),
                result_of(kinds, session, row) or {},
                _flux(row),
            )
            aims = aim_view(runtime, row, step)
            calibration = calibration_view(session, row, result, begin)
    mirrors, skipped = _mirrors(result, by), {} if calibration else result.get("skipped", {})
    lists = mirrors, skipped, *(result.get(name, ()) for name in ("surfaces", "unchanged"))
    longest = calibration.longest if calibration else max(map(len, lists))
    return render(
        request,
        "job.html",
        job=row,
        is_live=is_live,
        asked=asked,
        flux=flux,
        has_changed=any(result.values()),
        chain=loss_chain(result["field"]) if result.get("field") else [],
        mirrors=mirrors[begin : begin + _SHOWN],
        n_measured=len(result.get("states", ())),
        n_mirrors=len(mirrors),
        factors=_FACTORS,
        by=by,
        light=result if row.kind == "forecasts" and "peak_w_m2" in result else None,
        aims=aims,
        calibration=calibration,
        offsets=OFFSETS,
        excess=excess,
        in_zone=in_zone(result.get("time_zone") or runtime.settings.time_zone),
        target=row.payload.get("target") if asked else None,
        facts={name: value for name, value in result.items() if _plain(value)},
        counts=result.get("counts", {}),
        surfaces=result.get("surfaces", {}),
        unchanged=result.get("unchanged", {}),
        judged=result.get("judged", {}),
        skipped=skipped,
        warnings=result.get("warnings", []),
        shown=_SHOWN,
        begin=begin,
        page=page,
        last=math.ceil(longest / _SHOWN),
        link=lambda page: f"/jobs/{number}?by={by}&step={step}&page={page}#result-title",
    )


@router.post("/jobs/{number}/cancel", dependencies=[OPERATE])
def post_cancel_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Cancel a job, and go to its page."""
    cancel_for(runtime, number, identity.name)
    return go_to(f"/jobs/{number}")
