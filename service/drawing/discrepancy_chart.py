"""Charts of a discrepancy: the correction's signed amount over the covariates it scales with."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.drawing.charts import Tick, ticks

MAX_CHARTS, MAX_LINES = 4, 6
"""Largest numbers of charts, and of owners in each: those of the largest amounts."""


@dataclass(frozen=True)
class AmountLine:
    """The amount for one owner, None for all: heights from 0 to 1 at both ends of the chart."""

    of: str | None
    left: float
    right: float


@dataclass(frozen=True)
class AmountChart:
    """The amount of one component over the covariate's range in the photographs.

    ``zero`` is the height of the axis, from 0 to 1.
    """

    title: str
    label: str
    lines: list[AmountLine]
    zero: float
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]


def amount_charts(coefficients: Iterable[Mapping[str, Any]]) -> list[AmountChart]:
    """Charts of the components with coefficients that surely scale; the largest first.

    ``coefficients`` are those of a report.
    """
    constants, slopes = dict[tuple[str, ...], float](), dict[tuple[str, ...], list[Any]]()
    for c in coefficients:
        is_sure = c["ci95"][0] > 0 or c["ci95"][1] < 0
        if c["per"] is None:
            constants[c["kind"], c["name"], str(c["of"])] = c["value"]
        elif is_sure and c["per"].get("limits"):
            key = c["kind"], c["name"], c["per"]["covariate"]
            slopes.setdefault(key, []).append(c)
    found = [(_reach(some), _chart(some, constants)) for some in slopes.values()]
    return [chart for _, chart in sorted(found, key=lambda one: -one[0])][:MAX_CHARTS]


def _reach(slopes: Sequence[Mapping[str, Any]]) -> float:
    """Strength of the most certain slope, in widths of its interval."""
    return max(float(abs(np.mean(c["ci95"])) / np.ptp(c["ci95"])) for c in slopes)


def _chart(
    slopes: Sequence[Mapping[str, Any]], constants: Mapping[tuple[str, ...], float]
) -> AmountChart:
    first, per = slopes[0], slopes[0]["per"]
    largest = sorted(slopes, key=lambda c: -abs(c["value"]))[:MAX_LINES]
    ends = [
        [
            constants.get((c["kind"], c["name"], str(c["of"])), 0.0)
            + c["value"] * (limit - per["center"])
            for limit in per["limits"]
        ]
        for c in largest
    ]
    low, high = min(0.0, *map(min, ends)), max(0.0, *map(max, ends))
    span = (high - low) or 1.0
    low, high = low - 0.06 * span, high + 0.06 * span
    lines = [
        AmountLine(c["of"], *((end - low) / (high - low) for end in pair))
        for c, pair in zip(largest, ends, strict=True)
    ]
    unit = "" if first["unit"] == "1" else f" [{first['unit']}]"
    return AmountChart(
        title=f"{first['kind']}: {first['name']}{unit}".replace("_", " "),
        label=f"{per['covariate']} [{per['unit']}]".replace("_", " "),
        lines=lines,
        zero=-low / (high - low),
        x_ticks=ticks(*per["limits"]),
        y_ticks=ticks(low, high),
    )
