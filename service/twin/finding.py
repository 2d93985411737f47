"""Finding heliostats in a field: the figures that they are judged by, conditions on them, and their order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from service.base.fields import filled
from service.twin.accuracy import RECENT
from service.twin.field import Line
from service.twin.pointing_errors import NEWEST


@dataclass(frozen=True)
class Metric:
    """A figure of a heliostat; ``is_better_high`` where a low one deserves a look, else a high one does."""

    name: str
    label: str
    unit: str
    digits: int
    about: str
    value: Callable[[Line], float | None]
    is_better_high: bool = False


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


def _sun_span(line: Line) -> float | None:
    return None if line.surface is None else line.surface.sun_span_deg


def _pointing(line: Line) -> float | None:
    return None if line.pointing is None else line.pointing.error_mrad


MetricName = Literal["deviation", "uncertainty", "misfit", "age", "accuracy", "pointing", "sun_span"]

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
            is_better_high=True,
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
        Metric(
            "sun_span",
            "Span of suns",
            "°",
            0,
            "How far apart the suns of the photographs stood that the surface was made from: the largest angle. Beyond "
            "it forecasts are less sure.",
            _sun_span,
            is_better_high=True,
        ),
    )
}


def _is_doubted(line: Line) -> bool:
    return line.surface is not None and bool(line.surface.doubts)


def _is_unjudged(line: Line) -> bool:
    return line.surface is not None and (line.rank is None or line.rank.accuracy is None)


Condition = Literal["doubted", "unseen", "trusted", "surface", "no_surface", "unjudged", "refused", "no_photographs"]

CONDITIONS: dict[str, tuple[str, Callable[[Line], bool]]] = {
    "doubted": ("surface not trusted", _is_doubted),
    "unseen": (
        "not trusted, seen by nobody",
        lambda line: line.surface is not None and bool(line.surface.doubts) and line.surface.seen_by is None,
    ),
    "trusted": ("surface trusted", lambda line: line.surface is not None and line.surface.trusted is True),
    "surface": ("with a surface", lambda line: line.surface is not None),
    "no_surface": ("without a surface", lambda line: line.surface is None),
    "unjudged": ("accuracy not yet judged", _is_unjudged),
    "refused": ("with refused photographs", lambda line: line.refused > 0),
    "no_photographs": ("without photographs", lambda line: line.photographs == 0),
}
"""What heliostats can be chosen by, each with what it is called."""

Column = Literal[
    "name",
    "accuracy",
    "deviation",
    "uncertainty",
    "misfit",
    "age",
    "pointing",
    "sun_span",
    "surface",
    "trusted",
    "photographs",
    "refused",
]
Order = Literal["up", "down"]


def _trust(line: Line) -> float | None:
    return None if line.surface is None or line.surface.trusted is None else float(line.surface.trusted)


_OTHERS: dict[str, Callable[[Line], float | None]] = {
    "surface": lambda line: None if line.surface is None else line.surface.version,
    "trusted": _trust,
    "photographs": lambda line: line.photographs,
    "refused": lambda line: line.refused,
}


def usual_order(column: str) -> Order:
    """The order that begins with what deserves a look; names rise."""
    rises = column in ("name", "trusted") or (column in METRICS and METRICS[column].is_better_high)
    return "up" if rises else "down"


class Wanted(BaseModel):
    """Which heliostats are looked for, and in which order; what a form leaves empty is not asked."""

    model_config = ConfigDict(frozen=True)

    search: str = Field(default="", max_length=32, description="A part of the name, in capitals or not.")
    show: Condition | None = Field(default=None, description="Only those of which this is true; all without it.")
    metric: MetricName = Field(default="accuracy", description="The figure that `low` and `high` are of.")
    low: FiniteFloat | None = Field(default=None, description="The least that the figure may be, in its unit.")
    high: FiniteFloat | None = Field(
        default=None, description="The most that it may be; where it is not known it is not between them."
    )
    sort: Column | None = Field(default=None, description="What they are sorted by; without it the figure.")
    order: Order | None = Field(default=None, description="Without it, what deserves a look comes first.")

    _filled = model_validator(mode="before")(filled)

    @property
    def column(self) -> str:
        """The column that they are sorted by."""
        return self.sort or self.metric

    @property
    def rises(self) -> bool:
        """Whether the smallest comes first."""
        return (self.order or usual_order(self.column)) == "up"

    @property
    def is_narrow(self) -> bool:
        """Whether anything is left out."""
        return bool(self.search or self.show) or self.low is not None or self.high is not None

    def fits(self, line: Line) -> bool:
        """Whether a heliostat is one of them."""
        if self.search.lower() not in line.name.lower():
            return False
        if self.show is not None and not CONDITIONS[self.show][1](line):
            return False
        if self.low is None and self.high is None:
            return True
        value = METRICS[self.metric].value(line)
        if value is None:
            return False
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)


def find(lines: Sequence[Line], wanted: Wanted) -> list[Line]:
    """Those of ``lines``, which are in the order of their names, in the order that is wanted.

    Those whose figure is not known come last; equal ones by name.
    """
    found = [line for line in lines if wanted.fits(line)] if wanted.is_narrow else list(lines)
    if wanted.column == "name":
        return found if wanted.rises else found[::-1]
    value_of = METRICS[wanted.column].value if wanted.column in METRICS else _OTHERS[wanted.column]
    values = [value_of(line) for line in found]
    sign = 1.0 if wanted.rises else -1.0
    known = sorted((sign * value, i) for i, value in enumerate(values) if value is not None)
    return [found[i] for _, i in known] + [line for line, value in zip(found, values, strict=True) if value is None]
