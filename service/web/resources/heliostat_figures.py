"""What pages of heliostats draw: comparisons, versions, the 3D view, and timelines."""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from model.errors import ModelError
from model.plant import inside_outline
from service.base.arrays import unpack
from service.base.errors import ServiceError
from service.base.settings import Settings
from service.drawing import charts
from service.drawing.charts import ColourScale, HeatMap, History, PlanePicture
from service.drawing.facets import FacetPlaces
from service.drawing.pictures import comparison_picture, mirror_heights
from service.drawing.timelines import Threshold, TimeAxis, Timeline, Value, timeline
from service.store.tables import MeasurementRow, MountRow, SurfaceRow
from service.twin.alarms.field_overview import FieldTotals, field_totals
from service.twin.photographs.stored_photograph import compare_one
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import PhotographComparison
from service.twin.surfaces.accuracy import photograph_name as photograph_of

# Points along each side of a facet in the 3D view.
_SPACE_SAMPLES = 14
# The least, and the most on all facets together, which a browser can turn.
_LEAST_SPACE, _MOST_SPACE = 4, 8000
_OF_PEAK = "of the measured peak"
# Size of the window of measured fluxes [m].
_WINDOW = (4.0, 4.0)


@dataclass(frozen=True)
class Revision:
    """A line of the surface history."""

    row: SurfaceRow
    figures: FieldTotals
    change_mm: float | None


@dataclass(frozen=True)
class ComparisonFigure:
    """A comparison and its three maps."""

    formats: ClassVar[tuple[str, ...]] = ("npz", "png")

    comparison: PhotographComparison
    measured: HeatMap
    forecast: HeatMap
    difference: HeatMap

    @property
    def title(self) -> str:
        """Title of the figure."""
        return f"Light and forecast of {self.comparison.measurement.identifier}"

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The three maps, as shares of the measured peak."""
        return {name: getattr(self, name).values for name in ("measured", "forecast", "difference")}

    def drawn(self) -> bytes:
        """The three maps side by side, as PNG."""
        title = f"{self.comparison.measurement.identifier}: accuracy {self.comparison.accuracy:.1%}"
        bounds = self.measured.scale.high, self.difference.scale.high
        return comparison_picture(
            self.measured.values, self.forecast.values, self.measured.width, title, bounds
        )


def _rms_mm(heights: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(heights**2)) * 1e3)


def versions(rows: Sequence[SurfaceRow]) -> list[Revision]:
    """Surfaces, newest first, each with its change from the next older one [mm RMS]."""
    heights = [unpack(row.arrays)["z"] for row in rows]
    changes = [
        _rms_mm(new - old) if new.shape == old.shape else None
        for new, old in itertools.pairwise(heights)
    ]
    return [
        Revision(row, field_totals(row.arrays), change)
        for row, change in zip(rows, [*changes, None], strict=False)
    ]


def histories(listed: Sequence[Revision]) -> list[History]:
    """Charts of the deviation of each version, and of its change from the one before."""
    oldest_first = list(reversed(listed))
    deviation = [(f"version {v.row.version}", v.figures.deviation_mm) for v in oldest_first]
    changes = [
        (f"version {v.row.version}", v.change_mm) for v in oldest_first if v.change_mm is not None
    ]
    drawn = [charts.history("Deviation from ideal by version", "mm", deviation, 3)]
    return (
        [*drawn, charts.history("Change from the version before", "mm", changes, 3)]
        if changes
        else drawn
    )


def space_view(z: NDArray[Any], places: FacetPlaces, bound: float) -> str:
    """JSON for `surface3d.js`.

    It holds the place of each facet [m] and its heights on a regular grid [mm], with null beside
    its outline. The colours end at ``bound`` [mm], as on the map.
    """
    samples = max(_LEAST_SPACE, min(_SPACE_SAMPLES, math.isqrt(_MOST_SPACE // len(z))))
    heights, low = mirror_heights(z, samples), places.box[0]
    side = np.linspace(-1, 1, samples)
    u, v = np.meshgrid(side, side, indexing="ij")
    facets = []
    for facet, outline in enumerate(places.outlines):
        # A sample on the edge is inside.
        inside = inside_outline(0.999 * u, 0.999 * v, outline)
        known = [
            [round(height, 4) if kept else None for height, kept in zip(*row, strict=True)]
            for row in zip(heights[facet].tolist(), inside.tolist(), strict=True)
        ]
        vectors = np.round([places.centers[facet], *places.halves[facet]], 5).tolist()
        facets.append(dict(zip(("center", "x", "y"), vectors, strict=True)) | {"heights": known})
    size = np.round(places.box[1] - low, 5).tolist()
    middle = np.round(places.box.mean(axis=0), 5).tolist()
    colours = ColourScale("RdBu_r", 0, 1, "").names(np.linspace(0, 1, 33).tolist())
    return json.dumps(
        {"size": size, "middle": middle, "bound": bound, "facets": facets, "colours": colours}
    )


@dataclass(frozen=True)
class ComparisonFigures:
    """All comparisons and their two common scales.

    ``beyond`` is the largest difference if it exceeds the scale, else None.
    """

    figures: list[ComparisonFigure]
    flux: ColourScale
    difference: ColourScale
    beyond: float | None


def comparison_figures(
    comparisons: Sequence[PhotographComparison], bound: float
) -> ComparisonFigures:
    """Maps in shares of each photograph's measured peak, as in study reports.

    ``bound`` is the end of the scale of differences [1].
    """
    pairs = [(c.measured / c.measured.max(), c.forecast / c.measured.max()) for c in comparisons]
    top = max((float(image.max()) for pair in pairs for image in pair), default=1.0)
    largest = max(
        (float(np.abs(forecast - measured).max()) for measured, forecast in pairs), default=0.0
    )
    flux, difference = charts.flux_scale(top, _OF_PEAK), charts.difference_scale(bound, _OF_PEAK)
    figures = []
    for comparison, (measured, forecast) in zip(comparisons, pairs, strict=True):
        shown = (
            ("measured", measured, flux),
            ("forecast", forecast, flux),
            ("forecast minus measured", forecast - measured, difference),
        )
        name = comparison.measurement.identifier
        maps = [
            charts.heat_map(f"{what} flux of {name}", image, _WINDOW, scale)
            for what, image, scale in shown
        ]
        figures.append(ComparisonFigure(comparison, *maps))
    return ComparisonFigures(figures, flux, difference, largest if largest > bound else None)


def forecast_figures(
    runtime: Runtime, heliostat: str, measured: MeasurementRow | None
) -> dict[str, object]:
    """The forecast of a measured photograph next to its flux, or why there is none."""
    compared, trouble = [], None
    if measured is not None:
        try:
            compared = [compare_one(runtime, heliostat, measured.identifier)]
        except (ModelError, ServiceError) as error:
            trouble = str(error)
    bound = runtime.settings.figure_scales["flux_difference"]
    return {
        "comparisons": comparison_figures(compared, bound),
        "trouble": trouble,
        "plane_picture": PlanePicture,
    }


# --- over time
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OverTime:
    """What a timeline shows: series by name, with their number of decimal places."""

    title: str
    unit: str
    series: Mapping[str, Sequence[Value]]
    digits: int
    limit: Threshold | None = None


def accuracy_values(comparisons: Sequence[PhotographComparison]) -> list[Value]:
    """Accuracies of the forecasts [%] at the times of the photographs."""
    return [
        Value(row.taken_at, 100 * one.accuracy, photograph_of(row), one.was_used)
        for one in comparisons
        if (row := one.measurement)
    ]


def pointing_values(mount: MountRow | None) -> list[Value]:
    """Pointing errors by a mount [mrad], one for each photograph that it was calibrated from."""
    if mount is None:
        return []
    history = mount.document["history"]
    off_mrad = 1e3 * np.linalg.norm(np.array(history["residuals"]).reshape(-1, 2), axis=-1)
    foreign = set(history["foreign"])
    return [
        Value(None if at is None else datetime.fromisoformat(at), float(off))
        for index, (at, off) in enumerate(zip(history["at"], off_mrad, strict=True))
        if index not in foreign
    ]


def version_marks(surfaces: Sequence[SurfaceRow], prefix: str) -> list[tuple[datetime, str]]:
    """Vertical lines where surfaces begin to be valid; those that do not know it have none."""
    return [
        (row.valid_from, f"{prefix}{row.version}") for row in surfaces if row.valid_from is not None
    ]


def accuracy_over_time(series: Mapping[str, Sequence[Value]], settings: Settings) -> OverTime:
    """Accuracies of forecasts, with the limit of alarms."""
    title = "Forecast accuracy of photographs; hollow: the surface was made from it"
    return OverTime(title, "%", series, 1, Threshold(100 * settings.alarm_accuracy, True))


def pointing_over_time(series: Mapping[str, Sequence[Value]], settings: Settings) -> OverTime:
    """Pointing errors, with the limit of alarms."""
    return OverTime(
        "Pointing error of photographs that the mount was calibrated from",
        "mrad",
        series,
        2,
        Threshold(settings.alarm_pointing_mrad),
    )


def draw_on_one_axis(
    shown: Sequence[OverTime], zone: str, marks: Sequence[tuple[datetime, str]]
) -> list[Timeline]:
    """Draw what has values, all over the same times."""
    values = [one for chart in shown for some in chart.series.values() for one in some]
    moments = [one.at for one in values if one.at is not None]
    axis = TimeAxis(zone, marks, moments)
    drawn = [
        timeline(one.title, one.unit, one.series, one.digits, axis=axis, limit=one.limit)
        for one in shown
    ]
    return [chart for chart in drawn if chart is not None]
