"""The field: all heliostats by a metric, in REST, on a map, and as a table."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Annotated, Any, ClassVar
from urllib.parse import urlencode

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import HTMLResponse
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from service import store
from service.base.errors import NotFoundError
from service.base.fields import HeliostatOf, Name, Search, Source
from service.drawing.charts import CONDITION, ColourScale
from service.drawing.pictures import places_picture
from service.drawing.templates import in_zone
from service.store.tables import HeliostatRow
from service.twin.alarms.field_filter import (
    CONDITIONS,
    METRICS,
    HeliostatFilter,
    Metric,
    default_order,
    filter_heliostats,
)
from service.twin.alarms.field_overview import PATIENCE_S, FieldOverviewCache, HeliostatOverview
from service.twin.alarms.field_state import PERIODS, Period, field_accuracy, recent_work
from service.twin.alarms.reasons import SEVERITIES, AlarmCount
from service.twin.forecasts.aims import plant_time_zone
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    OVERVIEW_SLOT,
    READ,
    RENDER_SLOT,
    FieldCacheDep,
    RuntimeDep,
)
from service.web.resources.alarms import AlarmCountDep
from service.web.responses.lists import Page, page, sheet_answer
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to, render


class FieldQuery(HeliostatFilter):
    """Filter and order of heliostats, with paging."""

    limit: int = Field(default=100, ge=1, le=500, description="Most items on a page.")
    after: Name | None = Field(
        default=None, description="The last name of the page before, of the same question."
    )


class FieldLine(BaseModel):
    """A heliostat with its metrics. A value is null if it is unknown or not yet computed."""

    name: HeliostatOf
    position_m: tuple[float, float] = Field(description="East, north of the tower base [m].")
    accuracy: float | None = Field(
        description=(
            "Mean flux accuracy of forecasts on photographs that the surface was not made from [1]."
        )
    )
    judged_by: int | None = Field(description="How many photographs that is the mean of.")
    deviation_mm: float | None = Field(
        description="Root mean square of the heights over the ideal mirror [mm]."
    )
    uncertainty_mm: float | None = Field(
        description="Root mean square of their standard deviations [mm]."
    )
    misfit: float | None = Field(
        description="What the surface leaves unexplained of its photographs [1]."
    )
    age_days: float | None = Field(description="Of the surface [days].")
    pointing_error_mrad: float | None = Field(
        description="How far off light lands by the calibrated mount [mrad]."
    )
    sun_span_deg: float | None = Field(
        description=(
            "Largest angle between the suns of the photographs that the surface was made from"
            " [deg]."
        )
    )
    surface_version: int | None = Field(description="Version of the active surface.")
    source: Source | None = Field(description="How that was obtained.")
    trusted: bool | None = Field(
        description="Null for what is measured, or before surfaces were judged."
    )
    warnings: list[str] = Field(description="Why it is not trusted.")
    warned_since: datetime | None = Field(description="When its warnings began.")
    acknowledged_by: str | None = Field(description="Who has seen the warnings.")
    photographs: int = Field(description="How many photographs are stored.")
    refused: int = Field(description="How many of them were refused.")


def field_line(line: HeliostatOverview) -> FieldLine:
    """A heliostat as JSON."""
    surface = line.surface
    return FieldLine.model_validate(
        {
            "name": line.name,
            "position_m": (line.east_m, line.north_m),
            **{name: metric.value(line) for name, metric in METRICS.items()},
            "age_days": (
                None if surface is None or surface.age_days is None else round(surface.age_days, 1)
            ),
            "judged_by": None if line.rank is None else line.rank.photographs,
            "surface_version": None if surface is None else surface.version,
            "source": None if surface is None else surface.source,
            "trusted": None if surface is None else surface.trusted,
            "warnings": [] if surface is None else surface.warnings or [],
            "warned_since": None if surface is None else surface.warned_since,
            "acknowledged_by": None if surface is None else surface.acknowledged_by,
            "photographs": line.photographs,
            "refused": line.refused,
        }
    )


router = APIRouter(tags=["heliostats"])
pages = APIRouter(include_in_schema=False)


@router.get("/field", responses=problems(404), dependencies=[READ, OVERVIEW_SLOT])
def list_field(
    query: Annotated[FieldQuery, Query()], runtime: RuntimeDep, cache: FieldCacheDep
) -> Page[FieldLine]:
    """List heliostats with their metrics. They match the filter, in the order of one metric."""
    with runtime.database.reading() as session:
        per_unit, given = (
            METRICS[query.metric].per_unit,
            query.model_dump(exclude={"limit", "after"}),
        )
        limits = {
            name: given[name] * per_unit for name in ("low", "high") if given[name] is not None
        }
        wanted = HeliostatFilter.model_validate(given | limits)
        lines = cache.recent(
            session,
            wanted,
            lambda: filter_heliostats(cache.read(session, PATIENCE_S).lines, wanted),
        )
    begin = 0
    if query.after is not None:
        names = [line.name for line in lines]
        if query.after not in names:
            raise NotFoundError(
                f"after: heliostat {query.after} is not among these any more; begin again"
                " without it"
            )
        begin = names.index(query.after) + 1
    return page(
        [field_line(line) for line in lines[begin : begin + query.limit + 1]], query.limit, "name"
    )


# --- the map
# --------------------------------------------------------------------------------------------------

# Heliostats on a page of the table.
_LISTED = 100


class FieldView(HeliostatFilter):
    """The view of the page, which is encoded in its URL."""

    page: int = Field(default=1, ge=1, le=10**6)
    period: Period = "30"

    def link(self, **changes: Any) -> str:
        """The URL of this view with changed parameters, on the first page."""
        asked = {"page": 1, **self.model_dump(exclude_defaults=True, exclude={"page"}), **changes}
        query = {
            name: value
            for name, value in asked.items()
            if value is not None and (name, value) != ("page", 1)
        }
        return f"/?{urlencode(query)}" if query else "/"

    def sorted_by(self, column: str) -> str:
        """The URL of this view sorted by ``column``, or in reverse on repetition."""
        if column != self.column:
            return self.link(sort=column, order=None)
        opposite = "down" if self.rises else "up"
        return self.link(sort=column, order=None if opposite == default_order(column) else opposite)


@dataclass(frozen=True)
class Marks:
    """Heliostats of one colour on the map, as a path of squares.

    ``step`` is the place of the colour from fine, 0, to poor, `STEPS` - 1. It is None if the values
    are not known. ``names`` and ``texts``, the formatted values, are in the order of the path.
    """

    step: int | None
    path: str
    names: str
    texts: str


@dataclass(frozen=True)
class Drawing:
    """Map of the field from above, north up, in drawing units.

    ``side`` is the size of a square, and ``bar_m`` the length of the scale bar [m]. ``flagged`` is
    a path around untrusted heliostats. ``left_out`` is a path of those that the filter excludes.
    """

    width: float
    height: float
    side: float
    marks: list[Marks]
    flagged: str
    left_out: str
    tower: tuple[float, float]
    per_metre: float
    bar_m: float


@dataclass(frozen=True)
class FieldMap:
    """The map as a file."""

    formats: ClassVar[tuple[str, ...]] = ("npz", "png")

    lines: Sequence[HeliostatOverview]
    metric: Metric
    scale: ColourScale

    @property
    def title(self) -> str:
        """The metric with its unit."""
        return self.scale.label

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Names, positions east and north (n, 2) [m], and values, NaN if not known."""
        values = [self.metric.shown(line) for line in self.lines]
        return {
            "names": np.array([line.name for line in self.lines]),
            "places_m": (
                np.array([(line.east_m, line.north_m) for line in self.lines]).reshape(-1, 2)
            ),
            "values": np.array([np.nan if value is None else value for value in values]),
            "unit": np.array(self.metric.unit),
        }

    def drawn(self) -> bytes:
        """The map as PNG, with axes and a colour bar."""
        arrays, scale = self.arrays, self.scale
        return places_picture(
            arrays["places_m"],
            arrays["values"],
            scale.label,
            scale.colours,
            (scale.low, scale.high),
        )


def _text(line: HeliostatOverview, metric: Metric) -> str:
    """Text in place of a missing value."""
    is_unjudged = metric.name == "accuracy" and line.rank is not None and not line.rank.photographs
    return "not yet evaluated" if is_unjudged else "not known"


STEPS = 9
"""Colours of the map; the style sheet has them for light and for dark cards."""


@dataclass(frozen=True)
class LegendStep:
    """A colour of the map, as its place from fine to poor, and the values from which it holds."""

    step: int
    low: float


def legend(fine: float, poor: float) -> list[LegendStep]:
    """The colours of the map by rising values."""
    low, width = min(fine, poor), abs(fine - poor) / STEPS
    order = range(STEPS) if fine < poor else range(STEPS)[::-1]
    return [LegendStep(step, low + place * width) for place, step in enumerate(order)]


@dataclass(frozen=True)
class ColourEnds:
    """The values of a metric at the ends of its colours, the best first."""

    best: float
    worst: float


def colour_ends(
    lines: Sequence[HeliostatOverview], metric: Metric, limits: ColourEnds
) -> ColourEnds:
    """The values that the colours of a field span.

    They begin at its best value, at ``limits.best`` if all are worse. They end at its worst, at
    most at ``limits.worst``, and never within half the distance of the limits.
    """
    sign = 1 if limits.worst > limits.best else -1
    values = [sign * value for line in lines if (value := metric.shown(line)) is not None]
    fine, poor = sign * limits.best, sign * limits.worst
    best = min([fine, *values])
    worst = min(poor, max([best + (poor - fine) / 2, *values]))
    return ColourEnds(sign * best, sign * worst)


def scale_for(metric: Metric, ends: ColourEnds) -> ColourScale:
    """Colours of a metric's picture, from blue (the best) to red (the worst)."""
    best, worst = ends.best, ends.worst
    label = f"{metric.label} [{metric.unit}]"
    colours = CONDITION if worst < best else f"{CONDITION}_r"
    return ColourScale(colours, min(best, worst), max(best, worst), label)


_WIDTH = 720.0
_MARGIN = 34.0


def _round_length(metres: float) -> float:
    """The largest 1, 2 or 5 times a power of ten up to ``metres``."""
    power: float = 10.0 ** math.floor(math.log10(metres))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= metres)


def _squares(places: Iterable[tuple[float, float]], side: float) -> str:
    """A path of squares centred on ``places``."""
    half, square = side / 2, f"M%.1f %.1fh{side:.1f}v{side:.1f}h-{side:.1f}z"
    return "".join([square % (x - half, y - half) for x, y in places])


def _marks(
    lines: Sequence[HeliostatOverview],
    places: dict[str, tuple[float, float]],
    metric: Metric,
    ends: ColourEnds,
    side: float,
) -> list[Marks]:
    values = [metric.shown(line) for line in lines]
    known = [(line, value) for line, value in zip(lines, values, strict=True) if value is not None]
    span = ends.worst - ends.best
    shares = (np.array([value for _, value in known]) - ends.best) / span
    steps = np.clip(shares * STEPS, 0, STEPS - 1).astype(int).tolist()
    groups: dict[int, list[tuple[HeliostatOverview, float]]] = {}
    for entry, step in zip(known, steps, strict=True):
        groups.setdefault(step, []).append(entry)
    template = (  # `%` formatting, because it is faster for 20,000 heliostats
        f"%.{metric.digits}f\N{NO-BREAK SPACE}{metric.unit.replace('%', '%%')}"
    )
    marks = [
        Marks(
            step,
            _squares([places[line.name] for line, _ in group], side),
            "|".join([line.name for line, _ in group]),
            "|".join([template % value for _, value in group]),
        )
        for step, group in sorted(groups.items())
    ]
    others = [line for line, value in zip(lines, values, strict=True) if value is None]
    if others:
        path = _squares([places[line.name] for line in others], side)
        names, texts = (
            "|".join(line.name for line in others),
            "|".join(_text(line, metric) for line in others),
        )
        marks.append(Marks(None, path, names, texts))
    return marks


def draw(
    lines: Sequence[HeliostatOverview],
    chosen: Sequence[HeliostatOverview],
    metric: Metric,
    ends: ColourEnds,
) -> Drawing:
    """Draw the map of ``lines``, with the ``chosen`` ones emphasized.

    The colours end at ``ends``. The tower, at the origin, is always on the map.
    """
    east = np.array([line.east_m for line in lines] + [0.0])
    north = np.array([line.north_m for line in lines] + [0.0])
    spans = max(float(np.ptp(east)), 1.0), max(float(np.ptp(north)), 1.0)
    per_metre = min((_WIDTH - 2 * _MARGIN) / spans[0], (_WIDTH - 2 * _MARGIN) / spans[1])
    width, height = (max(span * per_metre, 200.0) + 2 * _MARGIN for span in spans)
    x = width / 2 + (east - (east.max() + east.min()) / 2) * per_metre
    y = height / 2 - (north - (north.max() + north.min()) / 2) * per_metre
    side = min(max(0.6 * math.sqrt(width * height / max(len(lines), 1)), 2.5), 22.0)
    places = dict(
        zip([line.name for line in lines], zip(x.tolist(), y.tolist(), strict=True), strict=False)
    )
    flagged = [
        places[line.name] for line in chosen if line.surface is not None and line.surface.warnings
    ]
    names = {line.name for line in chosen} if len(chosen) < len(lines) else places.keys()
    left_out = [place for name, place in places.items() if name not in names]
    return Drawing(
        width,
        height,
        side,
        _marks(chosen, places, metric, ends, side),
        _squares(flagged, side + min(side, 6.0)),
        _squares(left_out, side),
        (float(x[-1]), float(y[-1])),
        per_metre,
        _round_length(width / 4 / per_metre),
    )


def _counts(lines: Sequence[HeliostatOverview]) -> dict[str, int]:
    """Totals of all heliostats, for the tiles."""
    surfaces = [line.surface for line in lines if line.surface is not None]
    flagged = [surface for surface in surfaces if surface.warnings]
    return {
        "surfaces": len(surfaces),
        "flagged": len(flagged),
        "unacknowledged": sum(not surface.acknowledged_by for surface in flagged),
    }


def find_heliostats(runtime: Runtime, name: str) -> Sequence[HeliostatRow]:
    """The heliostat of this name, else up to two whose names contain it."""
    with runtime.database.reading() as session:
        found = store.list_heliostats(session, 2, search=name)
        exact = [row for row in store.list_heliostats(session, 1, prefix=name) if name]
    return [row for row in exact if row.name.lower() == name.lower()] or found


def field_figures(
    runtime: Runtime, cache: FieldOverviewCache, count: AlarmCount, view: FieldView
) -> dict[str, object]:
    """What the page of the field draws: its state, the map, and a page of the table."""
    with runtime.database.reading() as session:
        now, plant = cache.read(session), store.find_plant(session)
        alarms = count.read(session)
        work = cache.recent(
            session, ("work", view.period), partial(recent_work, session, view.period)
        )
        zone = plant_time_zone(session, runtime.settings.time_zone)
    lines, chosen = now.lines, METRICS[view.metric]
    limit, limits = runtime.settings.alarm_accuracy, runtime.settings.map_scales[view.metric]
    ends = colour_ends(lines, chosen, ColourEnds(*limits))
    found = filter_heliostats(lines, view)
    last = max(math.ceil(len(found) / _LISTED), 1)
    begin = (min(view.page, last) - 1) * _LISTED
    scale = scale_for(chosen, ends)
    return {
        "plant": None if plant is None else plant.name,
        "in_zone": in_zone(zone),
        "alarms": alarms,
        "severities": SEVERITIES,
        "accuracy": field_accuracy(lines, limit),
        "limit": limit,
        "work": work,
        "periods": PERIODS,
        "lines": lines,
        "counts": _counts(lines),
        "found": len(found),
        "listed": found[begin : begin + _LISTED],
        "begin": begin,
        "page": min(view.page, last),
        "last": last,
        "view": view,
        "conditions": CONDITIONS,
        "metrics": METRICS,
        "metric": chosen,
        "scale": scale,
        "fine": limits[0],
        "poor": limits[1],
        "ends": ends,
        "steps": legend(ends.best, ends.worst),
        "field_map": FieldMap(found, chosen, scale),
        "drawing": draw(lines, found, chosen, ends) if lines else None,
        "pending": now.pending,
        "is_behind": now.is_behind,
        # The computation for a large field takes time, and its page is long. Reload less often the
        # more heliostats are pending.
        "again_ms": min(max(1500, 30 * now.pending), 15_000)
        if now.pending or now.is_behind
        else None,
    }


# --- pages
# --------------------------------------------------------------------------------------------------


@pages.get("/find", dependencies=[READ])
def get_found_heliostat(runtime: RuntimeDep, find: Annotated[Search, Query()] = "") -> Response:
    """Go to the heliostat of this name, or to the list of those whose names contain it."""
    name = find.strip()
    found = find_heliostats(runtime, name)
    if len(found) == 1:
        return go_to(f"/heliostats/{found[0].name}")
    return go_to(FieldView().link(search=name or None))


@pages.get("/", dependencies=[READ, RENDER_SLOT])
def get_field(
    request: Request,
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    count: AlarmCountDep,
    view: Annotated[FieldView, Query()],
) -> HTMLResponse:
    """The state of the field, its map with the filtered heliostats emphasized, and their table."""
    return render(request, "field.html", **field_figures(runtime, cache, count, view))


_COLUMNS = [name for name in FieldLine.model_fields if name not in ("position_m", "warnings")]


def _filtered(
    filters: Annotated[HeliostatFilter, Query()], runtime: RuntimeDep, cache: FieldCacheDep
) -> list[FieldLine]:
    with runtime.database.reading() as session:
        lines = filter_heliostats(cache.read(session, PATIENCE_S).lines, filters)
    return [field_line(line) for line in lines]


@pages.get("/field.csv", dependencies=[READ, RENDER_SLOT])
def get_field_table(lines: Annotated[list[FieldLine], Depends(_filtered)]) -> Response:
    """All heliostats of the filter, in its order."""
    rows = (
        [*line.position_m, *(getattr(line, name) for name in _COLUMNS), "; ".join(line.warnings)]
        for line in lines
    )
    return sheet_answer("field", ["east_m", "north_m", *_COLUMNS, "warnings"], rows)
