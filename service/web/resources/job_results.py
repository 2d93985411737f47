"""What pages of jobs and studies draw of their results, and the tables of a job's as CSV."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, time
from typing import Annotated, Any
from zoneinfo import ZoneInfo

from fastapi import Query
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.pointing.report import clock_in_words
from service.base.arrays import unpack
from service.base.fields import StudyReport
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.templates import in_words
from service.drawing.timelines import Threshold, TimeAxis, Timeline, Value, timeline
from service.jobs.kinds.aim_plans import MAX_STEPS, step_name
from service.store import queue
from service.store.job_tables import JobRow
from service.store.mounts import mounts_of_versions
from service.twin.calibration import UndatedCount

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


def aim_view(session: Session, row: JobRow, step: int) -> AimView | None:
    """A finished plan of aims; None for other jobs."""
    result = row.result
    if row.kind != "aim-plans" or result is None or row.arrays is None:
        return None
    steps = [_timed(one) for one in result.get("steps", [result])]
    chosen = min(step, len(steps) - 1)
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


def aim_rows(step: Mapping[str, Any]) -> Iterator[list[Any]]:
    """The aims of a step as rows of CSV, with their drives."""
    inactive, drives = set(step["inactive"]), step.get("drives", {})
    for name, point in step["aim_points_m"].items():
        yield [name, *point, int(name not in inactive), *_drive_cells(drives.get(name, {}))]


def _drive_cells(drive: Mapping[str, Any]) -> list[Any]:
    motors, angles = drive.get("motor_position"), drive.get("axis_angles_deg")
    return [*(motors or (None, None)), *(angles or (None, None)), drive.get("reason")]


MOST = 100
"""Most mounts, steps and photographs on a page."""

OFFSETS = {
    "first_zero": "First drive's zero [mrad]",
    "second_zero": "Second drive's zero [mrad]",
    "foundation_up": "Foundation about up [mrad]",
    "foundation_north": "About north [mrad]",
}
"""Headings of the shown parameters of a mount."""


@dataclass(frozen=True)
class CalibrationView:
    """The result of a calibration.

    ``mounts`` has documents by heliostat. ``outliers`` are
    (heliostat, photograph, detail), and ``skipped`` (heliostat, photograph or "") by reason.
    """

    versions: Mapping[str, int]
    mounts: Mapping[str, Mapping[str, Any]]
    steps: list[tuple[str, Mapping[str, object]]]
    outliers: list[tuple[str, str, str]]
    skipped: Mapping[str, list[tuple[str, str]]]
    clock: str | None
    undated: str | None

    @property
    def longest(self) -> int:
        """Length of the longest list."""
        lists = self.versions, self.steps, self.outliers, *self.skipped.values()
        return max(map(len, lists))


def _step(step: Mapping[str, Any]) -> Mapping[str, object]:
    ends = {end: datetime.fromisoformat(step[end]) for end in ("from", "to")}
    return {"detail": "", "std_mrad": None} | dict(step) | ends


def calibration_view(
    session: Session, job: JobRow, result: Mapping[str, Any], begin: int
) -> CalibrationView | None:
    """The view of a finished calibration, with mounts from the index ``begin``; None for other
    jobs.
    """
    if job.kind != "calibrations" or "mounts" not in result:
        return None
    versions: Mapping[str, int] = result["mounts"]
    names = sorted(versions)[begin : begin + MOST]
    made = mounts_of_versions(session, {name: versions[name] for name in names})
    skipped = dict[str, list[tuple[str, str]]]()
    for key, reason in sorted(result.get("skipped", {}).items()):
        name, _, photograph = key.partition("/")
        skipped.setdefault(reason, []).append((name, photograph))
    undated = result.get("undated")
    return CalibrationView(
        versions,
        {name: made[name].document for name in names if name in made},
        [
            (name, _step(step))
            for name, steps in sorted(result.get("steps", {}).items())
            for step in reversed(steps)
        ],
        [
            (*key.split("/", 1), found["detail"])
            for key, found in sorted(result.get("outliers", {}).items())
        ],
        skipped,
        clock_in_words(result["clock"]) if result.get("clock") else None,
        UndatedCount(**undated).in_words() if undated else None,
    )


def flux_map(row: JobRow) -> HeatMap | None:
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


def is_plain(value: Any) -> bool:
    """Whether a value of a result is shown as it is."""
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
    if isinstance(value, list | dict) and len(value) > MOST:
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


def payload_in_words(payload: Mapping[str, object]) -> dict[str, str]:
    """Fields of a payload in words and with units. Long lists are reduced to their length."""
    return dict(
        _entry(name, value) for name, value in payload.items() if value not in (None, {}, [])
    )


def study_timelines(
    report: StudyReport, taken: Mapping[str, datetime | None], zone: str
) -> list[Timeline]:
    """Charts with a known time; ``taken`` has the times of photographs by ``heliostat/id``."""
    axis = TimeAxis(zone)
    series = {"before": report.before.per_image}
    if report.effects:
        series["after"] = report.after.per_image
    charts = [
        timeline(
            "Accuracy of held-out photographs",
            "%",
            {
                name: [Value(taken.get(key), 100 * value, key) for key, value in some.items()]
                for name, some in series.items()
            },
            1,
            axis=axis,
        )
    ]
    charts += [
        timeline(
            f"{effect.name.replace('_', ' ')}, {name}",
            fitted.unit,
            {"by day": [Value(_noon(day, zone), value, day) for day, value in values.items()]},
            3,
            axis=axis,
        )
        for effect in report.effects
        for name, fitted in effect.parameters.items()
        if (values := fitted.by_day)
    ]
    return [chart for chart in charts if chart is not None and chart.values]


def _noon(day: str, zone: str) -> datetime:
    return datetime.combine(datetime.fromisoformat(day), time(12), ZoneInfo(zone))
