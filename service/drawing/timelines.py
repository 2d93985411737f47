"""Charts of values over time. Templates draw them as SVG, and ``plots.js`` from their data."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, ClassVar
from zoneinfo import ZoneInfo

import matplotlib.dates

from service.drawing.charts import Sheet, Tick, ticks
from service.drawing.pictures import series_picture

_dates: Any = matplotlib.dates  # matplotlib.dates has no type hints

# Largest interval between ticks, for each unit of time.
_LONGEST = {
    _dates.MONTHLY: 12,
    _dates.DAILY: 31,
    _dates.HOURLY: 24,
    _dates.MINUTELY: 60,
    _dates.SECONDLY: 60,
}
_DAY_S = 86_400.0

# ISO dates, by year, month, day, hour, minute and second. What a tick leaves out is in the title.
_TICKS = ["%Y", "%Y-%m", "%m-%d", "%H:%M", "%H:%M", "%S.%f"]
_FIRST_TICKS = ["", "%Y", "%Y-%m", "%m-%d", "%H:%M", "%H:%M"]
_LEFT_OUT = ["", "", "%Y", "%Y-%m-%d", "%Y-%m-%d", "%Y-%m-%d %H:%M"]


@dataclass(frozen=True)
class Value:
    """A number at a time, which may be unknown; hollow if it is weaker evidence than others."""

    at: datetime | None
    number: float
    name: str = ""
    is_hollow: bool = False


@dataclass(frozen=True)
class Threshold:
    """A limit of a timeline: values above it exceed it, or those below it if ``is_minimum``."""

    number: float
    is_minimum: bool = False

    def is_exceeded(self, number: float) -> bool:
        """Whether a value is on the wrong side."""
        return number < self.number if self.is_minimum else number > self.number

    def excess(self, number: float) -> float:
        """By how much a value is off the limit, as a share of it [1]."""
        return abs(number / self.number - 1)


@dataclass(frozen=True)
class TimeAxis:
    """What the timelines of a page share.

    Attributes
    ----------
    zone : str
        Time zone of the tz database.
    marks : (time, label), ...
        Vertical lines; those beyond the values are left out.
    moments : time, ...
        Times that the axis includes, in addition to those of the values.
    """

    zone: str = "UTC"
    marks: Sequence[tuple[datetime, str]] = ()
    moments: Sequence[datetime] = ()

    def text(self, at: datetime | None) -> str:
        """A time in the zone, as ISO date and minutes."""
        if at is None:
            return "time unknown"
        return f"{at.astimezone(ZoneInfo(self.zone)):%Y-%m-%d %H:%M}"


@dataclass(frozen=True)
class Dot:
    """A value of a series: its position from 0 to 1, rightwards and upwards, and its label."""

    x: float
    y: float
    label: str
    kind: str


@dataclass(frozen=True)
class TimelineRow:
    """The values of all series at one time; None if a series has none."""

    when: str
    values: Sequence[Value | None]


@dataclass(frozen=True)
class AxisRange:
    """The part of an axis that a chart shows."""

    low: float
    high: float

    def share(self, value: float) -> float:
        """Position of a value: 0 at the low end, 1 at the high end."""
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class TimeTicks:
    """Ticks of a time axis. ``left_out`` is the part of the date that their labels leave out."""

    ticks: tuple[Tick, ...]
    left_out: str


def time_ticks(span: AxisRange, zone: str) -> TimeTicks:
    """Ticks with ISO dates in a time zone; ``span`` is in seconds since 1970."""
    locator = _dates.AutoDateLocator(minticks=3, maxticks=5, tz=ZoneInfo(zone))
    # Its default steps are too short to limit the number of ticks.
    for of_time, longest in _LONGEST.items():
        locator.intervald[of_time] = [*locator.intervald[of_time], longest]
    formatter = _dates.ConciseDateFormatter(
        locator,
        tz=ZoneInfo(zone),
        formats=_TICKS,
        zero_formats=_FIRST_TICKS,
        offset_formats=_LEFT_OUT,
    )
    ends = (datetime.fromtimestamp(at, UTC) for at in (span.low, span.high))
    places = [_DAY_S * place for place in locator.tick_values(*ends)]
    inside = [place for place in places if span.low <= place <= span.high]
    names = formatter.format_ticks([place / _DAY_S for place in inside])
    drawn = (Tick(span.share(at), name) for at, name in zip(inside, names, strict=True))
    return TimeTicks(tuple(drawn), formatter.get_offset())


@dataclass(frozen=True)
class Timeline:
    """Series over time by name: the first is a solid line, the second dashed.

    Attributes
    ----------
    digits : int
        Decimal places of the values.
    values, undated : by series
        Values with a time, and values without one, which are not drawn.
    """

    formats: ClassVar[tuple[str, ...]] = ("csv", "png")

    title: str
    unit: str
    digits: int
    axis: TimeAxis
    values: Mapping[str, Sequence[Value]]
    undated: Mapping[str, Sequence[Value]]
    limit: Threshold | None = None

    @cached_property
    def span(self) -> AxisRange:
        """The shown times [s] since 1970, with a margin."""
        times = [_seconds(one) for some in self.values.values() for one in some]
        times += [at.timestamp() for at in self.axis.moments]
        margin = 0.04 * (max(times) - min(times)) or _DAY_S / 2
        return AxisRange(min(times) - margin, max(times) + margin)

    @cached_property
    def bounds(self) -> AxisRange:
        """The shown values. They begin at zero; percentages do not, and end at 100."""
        numbers = [one.number for some in self.values.values() for one in some]
        numbers += [] if self.limit is None else [self.limit.number]
        found = _value_range(numbers, from_zero=self.unit != "%")
        return AxisRange(found.low, min(found.high, 100.0)) if self.unit == "%" else found

    @cached_property
    def x_ticks(self) -> TimeTicks:
        """Ticks of the time axis."""
        return time_ticks(self.span, self.axis.zone)

    @property
    def y_ticks(self) -> Sequence[Tick]:
        """Ticks of the values."""
        return ticks(self.bounds.low, self.bounds.high, 4)

    @property
    def limit_at(self) -> Tick | None:
        """The limit's line: its position from the bottom, and its label."""
        if self.limit is None:
            return None
        label = f"{'at least' if self.limit.is_minimum else 'limit'} {self.limit.number:g}"
        return Tick(self.bounds.share(self.limit.number), f"{label} {self.unit}")

    @property
    def marks(self) -> Sequence[Tick]:
        """Vertical lines within the shown times."""
        drawn = [Tick(self.span.share(at.timestamp()), name) for at, name in self.axis.marks]
        return tuple(mark for mark in drawn if 0 <= mark.at <= 1)

    @property
    def series(self) -> dict[str, tuple[Dot, ...]]:
        """The series as dots."""
        return {name: tuple(map(self._dot, some)) for name, some in self.values.items()}

    def _dot(self, value: Value) -> Dot:
        exceeds = self.exceeds(value)
        label = f"{value.name or self.axis.text(value.at)}: {value.number:.{self.digits}f}"
        kinds = [" hollow" if value.is_hollow else "", " over" if exceeds else ""]
        return Dot(
            self.span.share(_seconds(value)),
            self.bounds.share(value.number),
            f"{label} {self.unit}{', beyond the limit' if exceeds else ''}",
            "".join(kinds),
        )

    def exceeds(self, value: Value) -> bool:
        """Whether a value exceeds the limit."""
        return self.limit is not None and self.limit.is_exceeded(value.number)

    @cached_property
    def _by_time(self) -> Sequence[Mapping[str, Value]]:
        """Values by series at each time; values of one series at the same time are apart."""
        found: dict[tuple[float, int], dict[str, Value]] = {}
        for name, some in self.values.items():
            counts: Counter[float] = Counter()
            for one in some:
                at = _seconds(one)
                found.setdefault((at, counts[at]), {})[name] = one
                counts[at] += 1
        return [found[key] for key in sorted(found)]

    @property
    def names(self) -> list[str]:
        """Names of all series."""
        return list(dict.fromkeys([*self.values, *self.undated]))

    @property
    def rows(self) -> list[TimelineRow]:
        """The values as a table: by time, then those without a time."""
        without = [{name: one} for name, some in self.undated.items() for one in some]
        return [
            TimelineRow(
                self.axis.text(next(iter(at_once.values())).at),
                [at_once.get(name) for name in self.names],
            )
            for at_once in [*self._by_time, *without]
        ]

    @property
    def data(self) -> Mapping[str, object]:
        """What ``plots.js`` draws, for JSON. Times are seconds since 1970."""
        limit = self.limit and {
            "number": self.limit.number,
            "isMinimum": self.limit.is_minimum,
            "label": self.limit_at.label if self.limit_at else "",
        }
        return {
            "unit": self.unit,
            "digits": self.digits,
            "zone": self.axis.zone,
            "span": [self.span.low, self.span.high],
            "bounds": [self.bounds.low, self.bounds.high],
            "limit": limit,
            "marks": [[at.timestamp(), label] for at, label in self.axis.marks],
            "times": [_seconds(next(iter(row.values()))) for row in self._by_time],
            "series": [
                {"name": name, **_column([row.get(name) for row in self._by_time], self.digits + 2)}
                for name in self.values
            ],
        }

    @property
    def sheet(self) -> Sheet:
        """All values by series and time; those without a time are the last of their series."""
        rows = [
            (name, one.at, one.name, one.number)
            for name in self.names
            for one in [*self.values.get(name, ()), *self.undated.get(name, ())]
        ]
        return ("series", "time", "name", f"{self.title} [{self.unit}]"), rows

    def drawn(self) -> bytes:
        """The series as PNG, over UTC time."""
        series = {
            name: ([one.at for one in v], [one.number for one in v])
            for name, v in self.values.items()
        }
        return series_picture(self.title, self.unit, series)


def _column(values: Sequence[Value | None], digits: int) -> Mapping[str, object]:
    return {
        "values": [one and round(one.number, digits) for one in values],
        "labels": [one.name if one else "" for one in values],
        "hollow": [bool(one and one.is_hollow) for one in values],
    }


def _value_range(numbers: Sequence[float], from_zero: bool) -> AxisRange:
    # A change below half a percent of the value must not look large.
    padding = max(0.1 * (max(numbers) - min(numbers)), 0.005 * abs(max(numbers)))
    low = 0.0 if from_zero else min(numbers) - padding
    return AxisRange(low, max(max(numbers) + 0.1 * (max(numbers) - low), low + 1e-9))


def _seconds(value: Value) -> float:
    assert value.at is not None  # values without a time are undated
    return value.at.timestamp()


def timeline(
    title: str,
    unit: str,
    series: Mapping[str, Sequence[Value]],
    digits: int,
    *,
    axis: TimeAxis = TimeAxis(),
    limit: Threshold | None = None,
) -> Timeline | None:
    """Values over time, in order; None without any value."""
    dated = {
        name: sorted((one for one in some if one.at is not None), key=_seconds)
        for name, some in series.items()
    }
    undated = {name: [one for one in some if one.at is None] for name, some in series.items()}
    values = {name: some for name, some in dated.items() if some}
    unknown = {name: some for name, some in undated.items() if some}
    if not values and not unknown:
        return None
    return Timeline(title, unit, digits, axis, values, unknown, limit)
