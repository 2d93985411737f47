"""Timelines of a study: accuracy of held-out photographs, and parameters by day."""

from collections.abc import Mapping
from datetime import datetime, time
from zoneinfo import ZoneInfo

from service.base.fields import StudyReport
from service.drawing.timelines import TimeAxis, Timeline, Value, timeline


def study_timelines(
    report: StudyReport, taken: Mapping[str, datetime | None], zone: str
) -> list[Timeline]:
    """Charts with a known time; ``taken`` has the times of photographs by ``heliostat/id``."""
    axis = TimeAxis(zone)
    series = {"before": report.before.per_image}
    if report.effects:
        series["after"] = report.after.per_image
    charts = [
        timeline(
            "Accuracy of held-out photographs",
            "%",
            {
                name: [Value(taken.get(key), 100 * value, key) for key, value in some.items()]
                for name, some in series.items()
            },
            1,
            axis=axis,
        )
    ]
    charts += [
        timeline(
            f"{effect.name.replace('_', ' ')}, {name}",
            fitted.unit,
            {"by day": [Value(_noon(day, zone), value, day) for day, value in values.items()]},
            3,
            axis=axis,
        )
        for effect in report.effects
        for name, fitted in effect.parameters.items()
        if (values := fitted.by_day)
    ]
    return [chart for chart in charts if chart is not None and chart.values]


def _noon(day: str, zone: str) -> datetime:
    return datetime.combine(datetime.fromisoformat(day), time(12), ZoneInfo(zone))
