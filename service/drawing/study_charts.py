"""Charts of a study's page, as plain numbers and small pictures; its template makes SVG.

Charts of a discrepancy have the correction's signed amount over the covariates it scales with.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.covariates import RECORDED_TIME, covariates_of
from model.study import FluxImage, Study
from model.study.judging import rank_correlation
from service.drawing.charts import (
    ColourScale,
    HeatMap,
    Tick,
    difference_scale,
    flux_scale,
    heat_map,
    ticks,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Image:
    """A held-out image: accuracy before and after, and both positions on the chart, from 0 to 1."""

    photograph: FluxImage
    before: float
    after: float
    at_before: float
    at_after: float


@dataclass(frozen=True)
class Chart:
    """Accuracy of all held-out images by heliostat.

    ``noise`` is the position of the accuracy that noise alone would give.
    """

    groups: dict[str, list[Image]]
    ticks: Sequence[Tick]
    noise: float

    @property
    def images(self) -> list[Image]:
        """All images."""
        return [image for group in self.groups.values() for image in group]


def accuracy_chart(study: Study) -> Chart:
    """Accuracy of every held-out image before and after, by heliostat and sun elevation."""
    before, after = study.accuracy_before, study.accuracy_after
    low = float(np.floor(min(before.min(), after.min()) * 20) / 20)

    def place(accuracy: float) -> float:
        return (accuracy - low) / (1 - low)

    groups: dict[str, list[Image]] = {}
    found = zip(study.images, before.tolist(), after.tolist(), strict=True)
    for photograph, one, other in sorted(found, key=lambda f: (f[0].heliostat, f[0].elevation_deg)):
        image = Image(photograph, one, other, place(one), place(other))
        groups.setdefault(photograph.heliostat, []).append(image)
    return Chart(groups, ticks(100 * low, 100.0), place(1 - study.noise_floor))


@dataclass(frozen=True)
class Row:
    """One image as square maps, by their content."""

    rank: str
    image: Image
    squares: dict[str, HeatMap]


@dataclass(frozen=True)
class Pictures:
    """Rows of square maps with the side ``window`` [m], and their two common scales.

    ``beyond`` is the largest difference if it lies beyond its scale, otherwise None.
    """

    rows: list[Row]
    window: float
    flux: ColourScale
    residual: ColourScale
    beyond: float | None


def pictures(study: Study, images: Sequence[Image], bound: float) -> Pictures:
    """The worst, the median and the best image of the declared model.

    Fluxes are relative to each image's measured peak. If the study found an effect, the forecasts
    with it are included. ``bound`` is the end of the scale of the differences.
    """
    order = sorted(images, key=lambda image: image.before)
    chosen = {"Worst": order[0], "Median": order[len(order) // 2], "Best": order[-1]}
    fluxes = [_fluxes(study, image.photograph) for image in chosen.values()]
    top = max(float(flux.max()) for flux in fluxes)
    largest = max(float(np.abs(flux[0] - flux[1 : 2 + bool(study.found)]).max()) for flux in fluxes)
    shares, differences = (
        flux_scale(top, "of the measured peak"),
        difference_scale(bound, "of the measured peak"),
    )

    def row(rank: str, image: Image, flux: Array) -> Row:
        measured, before, after = flux
        shown = {"measured": (measured, shares), "forecast before": (before, shares)}
        if study.found:
            shown["forecast after"] = (after, shares)
        shown["difference before"] = (before - measured, differences)
        if study.found:
            shown["difference after"] = (after - measured, differences)
        name = image.photograph.key
        squares = {
            what: heat_map(f"{name}, {what}", v, (study.window,) * 2, s)
            for what, (v, s) in shown.items()
        }
        return Row(rank, image, squares)

    rows = [
        row(rank, image, flux) for (rank, image), flux in zip(chosen.items(), fluxes, strict=True)
    ]
    return Pictures(rows, study.window, shares, differences, largest if largest > bound else None)


def _fluxes(study: Study, photograph: FluxImage) -> Array:
    """Measured, before and after (3, 64, 64) of one image, relative to its measured peak."""
    place = list(study.images).index(photograph)
    flux = np.stack([study.measured[place], study.before[place], study.after[place]])
    return np.asarray(flux / flux[0].max())


DRAWN = ("sun elevation", "slant range", "solar time", "recorded time")
"""Covariates that the error is plotted against, if they are known."""


@dataclass(frozen=True)
class ErrorPair:
    """An image's error before and after: positions from 0 to 1, rightwards and upwards."""

    key: str
    x: float
    before: float
    after: float


@dataclass(frozen=True)
class Scatter:
    """Error of all held-out images against one quantity, with the rank correlations."""

    label: str
    dots: list[ErrorPair]
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]
    correlation_before: float
    correlation_after: float


def scatters(study: Study) -> list[Scatter]:
    """Error of all held-out images against each of `DRAWN`."""
    known = covariates_of([p.setup for p in study.images], study.site)
    return [
        _scatter(study, "recorded time [days since the first]", values - values.min())
        if c is RECORDED_TIME
        else _scatter(study, f"{c.name} [{c.unit}]", values)
        for c, values in known.items()
        if c.name in DRAWN
    ]


def _scatter(study: Study, label: str, x: Array) -> Scatter:
    before, after = 1 - study.accuracy_before, 1 - study.accuracy_after
    margin = 0.06 * float(np.ptp(x)) or 1.0
    low, high = float(x.min()) - margin, float(x.max()) + margin
    top = 1.08 * float(max(before.max(), after.max()))
    dots = [
        ErrorPair(p.key, (float(at) - low) / (high - low), float(one) / top, float(other) / top)
        for p, at, one, other in zip(study.images, x, before, after, strict=True)
    ]
    correlations = rank_correlation(before, x), rank_correlation(after, x)
    return Scatter(label, dots, ticks(low, high), ticks(0.0, 100 * top), *correlations)


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
