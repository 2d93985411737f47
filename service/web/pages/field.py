"""The field: every heliostat on a map, coloured by what its twin is worth, and the same as a table."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.base.settings import Settings
from service.drawing.charts import Scale
from service.drawing.templates import figure
from service.store.job_tables import JobRow
from service.store.tables import PlantRow, TargetRow
from service.twin.accuracy import RECENT
from service.twin.field import Line
from service.twin.pointing_errors import NEWEST
from service.web.answers.pages import render
from service.web.door.dependencies import DRAWS, READ, FieldBookDep, RuntimeDep

router = APIRouter(include_in_schema=False, dependencies=[READ])

# Heliostats in the table, unless somebody asks for the whole of it.
_LISTED = 100


@dataclass(frozen=True)
class Metric:
    """What the map can be coloured by; dark is always the end that deserves a look."""

    name: str
    label: str
    unit: str
    digits: int
    about: str
    value: Callable[[Line], float | None]


def _deviation(line: Line) -> float | None:
    return None if line.figures is None else line.figures.deviation_mm


def _uncertainty(line: Line) -> float | None:
    return None if line.figures is None else line.figures.uncertainty_mm


def _misfit(line: Line) -> float | None:
    return None if line.surface is None or line.surface.misfit is None else line.surface.misfit * 100


def _age(line: Line) -> float | None:
    return None if line.surface is None else line.surface.age_days


def _accuracy(line: Line) -> float | None:
    return None if line.rank is None or line.rank.accuracy is None else line.rank.accuracy * 100


def _pointing(line: Line) -> float | None:
    return None if line.pointing is None else line.pointing.error_mrad


MetricName = Literal["deviation", "uncertainty", "misfit", "age", "accuracy", "pointing"]

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "accuracy",
            "Forecast accuracy",
            "%",
            1,
            f"Mean agreement of forecast and measured flux, with today's surface, on the {RECENT} newest photographs "
            "that it was not made from; not yet judged where there are none.",
            _accuracy,
        ),
        Metric(
            "deviation",
            "Deviation from ideal",
            "mm",
            3,
            "How far the mirror is from its ideal shape: root mean square of the heights.",
            _deviation,
        ),
        Metric(
            "uncertainty",
            "Surface uncertainty",
            "mm",
            3,
            "How well the surface is known: root mean square of the heights' standard deviations.",
            _uncertainty,
        ),
        Metric(
            "misfit",
            "Surface misfit",
            "%",
            1,
            "What the surface leaves unexplained of the photographs that it was made from.",
            _misfit,
        ),
        Metric("age", "Age of the surface", "days", 0, "Since the surface describes the mirror.", _age),
        Metric(
            "pointing",
            "Pointing error",
            "mrad",
            2,
            f"How far off light lands by the calibrated mount: median of the {NEWEST} newest photographs, none from "
            "before it last moved.",
            _pointing,
        ),
    )
}


@dataclass(frozen=True)
class Dot:
    """A heliostat on the drawn map, in the drawing's units; without a colour where its value is not known.

    ``told`` is its value in words.
    """

    line: Line
    x: float
    y: float
    told: str
    colour: str | None


@dataclass(frozen=True)
class Drawing:
    """The field from above, north up: size, dots with their radius, the tower, and a bar for its length."""

    width: float
    height: float
    radius: float
    dots: list[Dot]
    tower: tuple[float, float]
    bar_m: float
    bar: float
    has_names: bool


def _told(line: Line, metric: Metric) -> str:
    if metric.name == "accuracy" and line.rank is not None and not line.rank.photographs:
        return "not yet judged"
    value = metric.value(line)
    return "not known" if value is None else figure(value, metric.digits, metric.unit)


def scale_for(metric: Metric, settings: Settings) -> Scale:
    """The colours of a figure, from what is fine, light, to what is poor, dark: the same whatever the field."""
    fine, poor = settings.map_scales[metric.name]
    label = f"{metric.label} [{metric.unit}]"
    return Scale("viridis" if poor < fine else "viridis_r", min(fine, poor), max(fine, poor), label)


_WIDTH = 720.0
_MARGIN = 34.0


def _round_length(metres: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not longer."""
    power: float = 10.0 ** math.floor(math.log10(metres))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= metres)


def draw(lines: Sequence[Line], metric: Metric, scale: Scale) -> Drawing:
    """The map of ``lines``; the tower stands at the origin and is always on it."""
    east = np.array([line.east_m for line in lines] + [0.0])
    north = np.array([line.north_m for line in lines] + [0.0])
    spans = max(float(np.ptp(east)), 1.0), max(float(np.ptp(north)), 1.0)
    per_metre = min((_WIDTH - 2 * _MARGIN) / spans[0], (_WIDTH - 2 * _MARGIN) / spans[1])
    width, height = (max(span * per_metre, 200.0) + 2 * _MARGIN for span in spans)
    x = width / 2 + (east - (east.max() + east.min()) / 2) * per_metre
    y = height / 2 - (north - (north.max() + north.min()) / 2) * per_metre
    values = [metric.value(line) for line in lines]
    colours = scale.names([math.nan if value is None else value for value in values])
    dots = [
        Dot(line, float(x[i]), float(y[i]), _told(line, metric), None if value is None else colour)
        for i, (line, value, colour) in enumerate(zip(lines, values, colours, strict=True))
    ]
    bar_m = _round_length(width / 4 / per_metre)
    radius = min(max(0.35 * math.sqrt(width * height / max(len(lines), 1)), 3.0), 12.0)
    tower = float(x[-1]), float(y[-1])
    return Drawing(width, height, radius, dots, tower, bar_m, bar_m * per_metre, len(lines) <= 60)


def _worst_first(lines: Sequence[Line], metric: Metric) -> list[Line]:
    """Those without a value last, each group by name."""
    sign = 1.0 if metric.name == "accuracy" else -1.0
    valued = [(sign * value, line.name, line) for line in lines if (value := metric.value(line)) is not None]
    return [line for *_, line in sorted(valued)] + [line for line in lines if metric.value(line) is None]


def _totals(session: Session) -> dict[str, Any]:
    plant = session.get(PlantRow, 1)
    running = select(func.count()).select_from(JobRow).where(JobRow.state.in_(("queued", "running")))
    return {
        "plant": None if plant is None else plant.name,
        "targets": session.scalars(select(func.count()).select_from(TargetRow)).one(),
        "live_jobs": session.scalars(running).one(),
    }


@router.get("/", dependencies=[DRAWS])
def get_field(
    request: Request,
    runtime: RuntimeDep,
    book: FieldBookDep,
    metric: Annotated[MetricName, Query()] = "accuracy",
    whole: Annotated[bool, Query()] = False,
) -> HTMLResponse:
    """The field map and its table, or the ``whole`` table of a large field."""
    chosen = METRICS[metric]
    with runtime.database.reading() as session:
        lines, pending = book.read(session)
        totals = _totals(session)
    values = [value for line in lines if (value := chosen.value(line)) is not None]
    # A large field takes its time and its page is long: it is asked for again the less often the more is left.
    again_ms = min(max(1500, 30 * pending), 15_000)
    scale = scale_for(chosen, runtime.settings)
    return render(
        request,
        "field.html",
        **totals,
        lines=lines,
        listed=_worst_first(lines, chosen)[: None if whole else _LISTED],
        whole=whole,
        metrics=METRICS,
        metric=chosen,
        values=values,
        scale=scale,
        fine=runtime.settings.map_scales[metric][0],
        poor=runtime.settings.map_scales[metric][1],
        drawing=draw(lines, chosen, scale) if lines else None,
        pending=pending,
        again_ms=again_ms,
    )
