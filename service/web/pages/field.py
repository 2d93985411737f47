"""The field: every heliostat on a map, coloured by what its twin is worth, and the same as a table."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar
from urllib.parse import urlencode

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from numpy.typing import NDArray
from pydantic import Field
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.base.settings import Settings
from service.drawing.charts import Scale
from service.drawing.pictures import places_picture
from service.store.job_tables import JobRow
from service.store.tables import PlantRow, TargetRow
from service.twin.field import Line
from service.twin.finding import CONDITIONS, METRICS, Metric, Wanted, find, usual_order
from service.web.answers.pages import render
from service.web.door.dependencies import DRAWS, READ, FieldBookDep, RuntimeDep

router = APIRouter(include_in_schema=False, dependencies=[READ])

# Heliostats on a page of the table.
_LISTED = 100


class FieldView(Wanted):
    """What the page shows; each view has an address of its own."""

    page: int = Field(default=1, ge=1, le=10**6)

    def link(self, **changes: Any) -> str:
        """The address of this view with some of it changed; another question begins at its first page."""
        asked = {"page": 1, **self.model_dump(exclude_defaults=True, exclude={"page"}), **changes}
        told = {name: value for name, value in asked.items() if value is not None and (name, value) != ("page", 1)}
        return f"/?{urlencode(told)}" if told else "/"

    def sorted_by(self, column: str) -> str:
        """The address of the view in the order of ``column``, or, where it is in that order, in the opposite one."""
        if column != self.column:
            return self.link(sort=column, order=None)
        opposite = "down" if self.rises else "up"
        return self.link(sort=column, order=None if opposite == usual_order(column) else opposite)


@dataclass(frozen=True)
class Marks:
    """Heliostats of one colour on the drawn map, None where the value is not known: a path of squares.

    ``names`` and ``told``, their values in words, are in the path's order.
    """

    colour: str | None
    path: str
    names: str
    told: str


@dataclass(frozen=True)
class Drawing:
    """The field from above, north up, in the drawing's units: size, side of a square, the tower, a bar for its length.

    ``doubted`` are paths around untrusted ones, ``left_out`` those that are not looked for.
    """

    width: float
    height: float
    side: float
    marks: list[Marks]
    doubted: str
    left_out: str
    tower: tuple[float, float]
    per_metre: float
    bar_m: float


@dataclass(frozen=True)
class FieldMap:
    """What the map shows, as a file."""

    formats: ClassVar[tuple[str, ...]] = ("npz", "png")

    lines: Sequence[Line]
    metric: Metric
    scale: Scale

    @property
    def title(self) -> str:
        """The figure with its unit."""
        return self.scale.label

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Names, places east and north (n, 2) [m], and the figure, NaN where it is not known."""
        values = [self.metric.value(line) for line in self.lines]
        return {
            "names": np.array([line.name for line in self.lines]),
            "places_m": np.array([(line.east_m, line.north_m) for line in self.lines]).reshape(-1, 2),
            "values": np.array([np.nan if value is None else value for value in values]),
            "unit": np.array(self.metric.unit),
        }

    def drawn(self) -> bytes:
        """As PNG, with axes and a colour bar."""
        arrays, scale = self.arrays, self.scale
        return places_picture(arrays["places_m"], arrays["values"], scale.label, scale.colours, (scale.low, scale.high))


def _told(line: Line, metric: Metric) -> str:
    """What is said where there is no value."""
    is_unjudged = metric.name == "accuracy" and line.rank is not None and not line.rank.photographs
    return "not yet judged" if is_unjudged else "not known"


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


def _squares(places: Iterable[tuple[float, float]], side: float) -> str:
    """A path of squares about ``places``."""
    half, square = side / 2, f"M%.1f %.1fh{side:.1f}v{side:.1f}h-{side:.1f}z"
    return "".join([square % (x - half, y - half) for x, y in places])


def _marks(
    lines: Sequence[Line], places: dict[str, tuple[float, float]], metric: Metric, scale: Scale, side: float
) -> list[Marks]:
    values = [metric.value(line) for line in lines]
    known = [(line, value) for line, value in zip(lines, values, strict=True) if value is not None]
    groups: dict[str, list[tuple[Line, float]]] = {}
    for entry, colour in zip(known, scale.names([value for _, value in known]), strict=True):
        groups.setdefault(colour, []).append(entry)
    told = f"%.{metric.digits}f\N{NO-BREAK SPACE}{metric.unit.replace('%', '%%')}"  # twenty thousand are quicker so
    marks = [
        Marks(
            colour,
            _squares([places[line.name] for line, _ in group], side),
            "|".join([line.name for line, _ in group]),
            "|".join([told % value for _, value in group]),
        )
        for colour, group in groups.items()
    ]
    others = [line for line, value in zip(lines, values, strict=True) if value is None]
    if others:
        path = _squares([places[line.name] for line in others], side)
        names, told = "|".join(line.name for line in others), "|".join(_told(line, metric) for line in others)
        marks.append(Marks(None, path, names, told))
    return marks


def draw(lines: Sequence[Line], chosen: Sequence[Line], metric: Metric, scale: Scale) -> Drawing:
    """The map of ``lines``, of which the ``chosen`` ones stand out; the tower, at the origin, is always on it."""
    east = np.array([line.east_m for line in lines] + [0.0])
    north = np.array([line.north_m for line in lines] + [0.0])
    spans = max(float(np.ptp(east)), 1.0), max(float(np.ptp(north)), 1.0)
    per_metre = min((_WIDTH - 2 * _MARGIN) / spans[0], (_WIDTH - 2 * _MARGIN) / spans[1])
    width, height = (max(span * per_metre, 200.0) + 2 * _MARGIN for span in spans)
    x = width / 2 + (east - (east.max() + east.min()) / 2) * per_metre
    y = height / 2 - (north - (north.max() + north.min()) / 2) * per_metre
    side = min(max(0.6 * math.sqrt(width * height / max(len(lines), 1)), 2.5), 22.0)
    places = dict(zip([line.name for line in lines], zip(x.tolist(), y.tolist(), strict=True), strict=False))
    doubted = [places[line.name] for line in chosen if line.surface is not None and line.surface.doubts]
    names = {line.name for line in chosen} if len(chosen) < len(lines) else places.keys()
    left_out = [place for name, place in places.items() if name not in names]
    return Drawing(
        width,
        height,
        side,
        _marks(chosen, places, metric, scale, side),
        _squares(doubted, side + min(side, 6.0)),
        _squares(left_out, side),
        (float(x[-1]), float(y[-1])),
        per_metre,
        _round_length(width / 4 / per_metre),
    )


def _totals(session: Session) -> dict[str, Any]:
    plant = session.get(PlantRow, 1)
    running = select(func.count()).select_from(JobRow).where(JobRow.state.in_(("queued", "running")))
    return {
        "plant": None if plant is None else plant.name,
        "targets": session.scalars(select(func.count()).select_from(TargetRow)).one(),
        "live_jobs": session.scalars(running).one(),
    }


def _counts(lines: Sequence[Line]) -> dict[str, int]:
    """Of all heliostats, for the tiles."""
    surfaces = [line.surface for line in lines if line.surface is not None]
    doubted = [surface for surface in surfaces if surface.doubts]
    return {
        "surfaces": len(surfaces),
        "photographs": sum(line.photographs for line in lines),
        "refused": sum(line.refused for line in lines),
        "doubted": len(doubted),
        "unseen": sum(not surface.seen_by for surface in doubted),
        "judged": sum(line.rank is not None and line.rank.photographs > 0 for line in lines),
    }


@router.get("/", dependencies=[DRAWS])
def get_field(
    request: Request, runtime: RuntimeDep, book: FieldBookDep, view: Annotated[FieldView, Query()]
) -> HTMLResponse:
    """The field map, on which what is looked for stands out, and its table, page by page."""
    with runtime.database.reading() as session:
        now, totals = book.read(session), _totals(session)
    lines, chosen = now.lines, METRICS[view.metric]
    found = find(lines, view)
    last = max(math.ceil(len(found) / _LISTED), 1)
    begin = (min(view.page, last) - 1) * _LISTED
    scale = scale_for(chosen, runtime.settings)
    return render(
        request,
        "field.html",
        **totals,
        lines=lines,
        counts=_counts(lines),
        found=len(found),
        listed=found[begin : begin + _LISTED],
        begin=begin,
        page=min(view.page, last),
        last=last,
        view=view,
        conditions=CONDITIONS,
        metrics=METRICS,
        metric=chosen,
        scale=scale,
        fine=runtime.settings.map_scales[view.metric][0],
        poor=runtime.settings.map_scales[view.metric][1],
        field_map=FieldMap(found, chosen, scale),
        drawing=draw(lines, found, chosen, scale) if lines else None,
        pending=now.pending,
        is_behind=now.is_behind,
        # A large field takes its time and its page is long: it is asked for again the less often the more is left.
        again_ms=min(max(1500, 30 * now.pending), 15_000) if now.pending or now.is_behind else None,
    )
