"""Find heliostats in a field: metrics, conditions and sort order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from service.base.fields import Search, drop_empty_fields
from service.twin.alarms.field_overview import HeliostatOverview
from service.twin.pointing_errors import NEWEST
from service.twin.surfaces.accuracy import RECENT


@dataclass(frozen=True)
class Metric:
    """A metric of a heliostat.

    ``name`` ends with the unit of its value. A share is shown in percent. If ``is_better_high``,
    low values are bad, else high values are.
    """

    name: str
    label: str
    unit: str
    digits: int
    about: str
    value: Callable[[HeliostatOverview], float | None]
    is_better_high: bool = False

    @property
    def per_unit(self) -> float:
        """Factor from the value to the unit that is shown."""
        return 100.0 if self.unit == "%" else 1.0

    def shown(self, line: HeliostatOverview) -> float | None:
        """The value of a heliostat in the unit that is shown."""
        value = self.value(line)
        return None if value is None else value * self.per_unit


MetricName = Literal[
    "deviation_mm",
    "uncertainty_mm",
    "misfit",
    "age_days",
    "accuracy",
    "pointing_error_mrad",
    "sun_span_deg",
]

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "accuracy",
            "Forecast accuracy",
            "%",
            1,
            f"Mean agreement of forecast and measured flux, with the active surface, on the"
            f" {RECENT} newest photographs that it was not made from; not yet evaluated if there"
            " are none.",
            lambda line: None if line.rank is None else line.rank.accuracy,
            is_better_high=True,
        ),
        Metric(
            "deviation_mm",
            "Deviation from ideal",
            "mm",
            3,
            "How far the mirror is from its ideal shape: root mean square of the heights.",
            lambda line: None if line.figures is None else line.figures.deviation_mm,
        ),
        Metric(
            "uncertainty_mm",
            "Surface uncertainty",
            "mm",
            3,
            "How well the surface is known: root mean square of the heights' standard deviations.",
            lambda line: None if line.figures is None else line.figures.uncertainty_mm,
        ),
        Metric(
            "misfit",
            "Unexplained flux",
            "%",
            1,
            "What the surface leaves unexplained of the photographs that it was made from.",
            lambda line: None if line.surface is None else line.surface.misfit,
        ),
        Metric(
            "age_days",
            "Age of the surface",
            "days",
            0,
            "Since the surface describes the mirror.",
            lambda line: None if line.surface is None else line.surface.age_days,
        ),
        Metric(
            "pointing_error_mrad",
            "Pointing error",
            "mrad",
            2,
            f"How far off light lands by the calibrated mount: median of the {NEWEST} newest"
            " photographs, none from before it last moved. Those of the calibration are forecast by"
            " others.",
            lambda line: None if line.pointing is None else line.pointing.error_mrad,
        ),
        Metric(
            "sun_span_deg",
            "Span of suns",
            "°",
            0,
            "Largest angle between the suns of the photographs that the surface was made from."
            " Beyond it forecasts are less certain.",
            lambda line: None if line.surface is None else line.surface.sun_span_deg,
            is_better_high=True,
        ),
    )
}


def _is_flagged(line: HeliostatOverview) -> bool:
    return line.surface is not None and bool(line.surface.warnings)


def _has_no_accuracy(line: HeliostatOverview) -> bool:
    return line.surface is not None and (line.rank is None or line.rank.accuracy is None)


Condition = Literal[
    "flagged",
    "unacknowledged",
    "trusted",
    "surface",
    "no_surface",
    "unjudged",
    "refused",
    "no_photographs",
]

CONDITIONS: dict[str, tuple[str, Callable[[HeliostatOverview], bool]]] = {
    "flagged": ("surface not trusted", _is_flagged),
    "unacknowledged": (
        "not trusted, not acknowledged",
        lambda line: (
            line.surface is not None
            and bool(line.surface.warnings)
            and line.surface.acknowledged_by is None
        ),
    ),
    "trusted": (
        "surface trusted",
        lambda line: line.surface is not None and line.surface.trusted is True,
    ),
    "surface": ("with a surface", lambda line: line.surface is not None),
    "no_surface": ("without a surface", lambda line: line.surface is None),
    "unjudged": ("accuracy not yet evaluated", _has_no_accuracy),
    "refused": ("with refused photographs", lambda line: line.refused > 0),
    "no_photographs": ("without photographs", lambda line: line.photographs == 0),
}
"""Conditions to choose heliostats by, each with its label."""

Column = Literal[MetricName, "name", "surface_version", "trusted", "photographs", "refused"]
Order = Literal["up", "down"]


def _trust(line: HeliostatOverview) -> float | None:
    return (
        None
        if line.surface is None or line.surface.trusted is None
        else float(line.surface.trusted)
    )


_OTHERS: dict[str, Callable[[HeliostatOverview], float | None]] = {
    "surface_version": lambda line: None if line.surface is None else line.surface.version,
    "trusted": _trust,
    "photographs": lambda line: line.photographs,
    "refused": lambda line: line.refused,
}


def default_order(column: str) -> Order:
    """The order that begins with the worst heliostats; names ascend."""
    rises = column in ("name", "trusted") or (column in METRICS and METRICS[column].is_better_high)
    return "up" if rises else "down"


class HeliostatFilter(BaseModel):
    """Conditions on heliostats and their sort order; empty fields of a form are ignored.

    ``low`` and ``high`` are in the unit that the metric is shown in.
    """

    model_config = ConfigDict(frozen=True)

    search: Search = Field(default="", description="A part of the name, in capitals or not.")
    show: Condition | None = Field(
        default=None, description="Only those of which this is true; all without it."
    )
    metric: MetricName = Field(
        default="accuracy", description="The figure that `low` and `high` are of."
    )
    low: FiniteFloat | None = Field(
        default=None, description="The least that the figure may be, in its unit."
    )
    high: FiniteFloat | None = Field(
        default=None,
        description="The most that it may be; where it is not known it is not between them.",
    )
    sort: Column | None = Field(
        default=None, description="What they are sorted by; without it the figure."
    )
    order: Order | None = Field(
        default=None, description="Without it, what deserves a look comes first."
    )

    _filled = model_validator(mode="before")(drop_empty_fields)

    @property
    def column(self) -> str:
        """The column to sort by."""
        return self.sort or self.metric

    @property
    def rises(self) -> bool:
        """Whether the smallest value comes first."""
        return (self.order or default_order(self.column)) == "up"

    @property
    def is_narrow(self) -> bool:
        """Whether any condition is set."""
        return bool(self.search or self.show) or self.low is not None or self.high is not None

    def fits(self, line: HeliostatOverview) -> bool:
        """Whether a heliostat meets all conditions."""
        if self.search.lower() not in line.name.lower():
            return False
        if self.show is not None and not CONDITIONS[self.show][1](line):
            return False
        if self.low is None and self.high is None:
            return True
        value = METRICS[self.metric].shown(line)
        if value is None:
            return False
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)


def filter_heliostats(
    lines: Sequence[HeliostatOverview], wanted: HeliostatFilter
) -> list[HeliostatOverview]:
    """Filter and sort heliostats.

    ``lines`` are sorted by name. Heliostats with an unknown value come last. Equal values are
    sorted by name.
    """
    found = [line for line in lines if wanted.fits(line)] if wanted.is_narrow else list(lines)
    if wanted.column == "name":
        return found if wanted.rises else found[::-1]
    value_of = METRICS[wanted.column].value if wanted.column in METRICS else _OTHERS[wanted.column]
    values = [value_of(line) for line in found]
    sign = 1.0 if wanted.rises else -1.0
    known = sorted((sign * value, i) for i, value in enumerate(values) if value is not None)
    return [found[i] for _, i in known] + [
        line for line, value in zip(found, values, strict=True) if value is None
    ]
