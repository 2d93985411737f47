"""Timelines of heliostats: forecast accuracy of photographs, and pointing errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from service.base.settings import Settings
from service.drawing.timelines import Threshold, TimeAxis, Timeline, Value, timeline
from service.store.tables import MountRow, SurfaceRow
from service.twin.surfaces.accuracy import PhotographComparison
from service.twin.surfaces.accuracy import photograph_name as photograph_of


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
    charts: Sequence[OverTime], zone: str, marks: Sequence[tuple[datetime, str]]
) -> list[Timeline]:
    """Draw what has values, all over the same times."""
    values = [one for chart in charts for some in chart.series.values() for one in some]
    moments = [one.at for one in values if one.at is not None]
    axis = TimeAxis(zone, marks, moments)
    drawn = [
        timeline(one.title, one.unit, one.series, one.digits, axis=axis, limit=one.limit)
        for one in charts
    ]
    return [chart for chart in drawn if chart is not None]
