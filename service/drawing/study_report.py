"""A study as one self-contained HTML page, without scripts or requests."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from model.effects import CATALOGUE, Parameter
from model.study import Study, conclude
from model.study.advice import photographs_to_distinguish
from model.study.outcome import Found
from model.study.report import error_covariates, residual_map
from service.drawing.charts import Array, HeatMap, difference_map
from service.drawing.study_charts import accuracy_chart, amount_charts, pictures, scatters
from service.drawing.templates import ASSETS, TEMPLATES

VERDICTS = {"effect": "Effect found", "none": "Nothing missing", "unexplained": "Not explained"}

FEW = 8
"""Largest number of skipped items that are listed at once."""


@dataclass(frozen=True)
class FittedValue:
    """A fitted number with its 95 % interval; ``telling`` if that excludes the neutral value."""

    value: float
    low: float
    high: float
    telling: bool


@dataclass(frozen=True)
class Fitted:
    """A parameter for all images, one day or one heliostat: one value, or one per facet."""

    name: str
    unit: str
    owner: str
    values: list[FittedValue]


@dataclass(frozen=True)
class Finding:
    """An effect that the study found, with its parameters.

    ``lookalikes`` are similar effects, each with the photographs that would distinguish them.
    """

    found: Found
    about: str
    parameters: list[Fitted]
    lookalikes: dict[str, str]

    @classmethod
    def of(cls, found: Found) -> "Finding":
        """The finding of an effect."""
        kind = CATALOGUE[found.name]
        of = ", ".join(found.scope.get("heliostats") or ["all images"])
        parameters = [
            row
            for p in kind.parameters()
            if p.name in found.parameters
            for row in _rows(p, found.parameters[p.name], of)
        ]
        return cls(
            found,
            kind.about,
            parameters,
            {name: photographs_to_distinguish(found.name, name) for name in found.lookalikes},
        )


def _rows(parameter: Parameter, fitted: Mapping[str, Any], of: str) -> list[Fitted]:
    """One row for each owner of a parameter's values.

    ``of`` names the owner of a shared value: the effect's scope.
    """
    value, ci95 = fitted["value"], fitted["ci95"]
    if "by_day" in fitted:
        value, ci95 = (
            {"other days": usual} | by_day
            for usual, by_day in ((value, fitted["by_day"]), (ci95, fitted["ci95_by_day"]))
        )
    elif parameter.shared:
        value, ci95 = {of: value}, {of: ci95}
    if parameter.owner != "facet":
        value, ci95 = ({owner: [one] for owner, one in given.items()} for given in (value, ci95))
    values = {
        owner: [
            _value(parameter, one, interval)
            for one, interval in zip(ones, ci95[owner], strict=True)
        ]
        for owner, ones in value.items()
    }
    return [Fitted(parameter.name, parameter.unit, owner, ones) for owner, ones in values.items()]


def _value(parameter: Parameter, value: float, ci95: tuple[float, float]) -> FittedValue:
    low, high = ci95
    return FittedValue(value, low, high, not low <= parameter.neutral <= high)


def study_page(
    study: Study, title: str, ends: Mapping[str, float], skipped: Mapping[str, str] | None = None
) -> str:
    """The report of a study as one self-contained HTML page; parameters as of `study_body`."""
    return report_page(
        study_body(study, title, ends, skipped), f"{title}: {VERDICTS[study.verdict]}"
    )


def report_page(body: str, title: str, crumbs: str = "heliotwin study") -> str:
    """A page around the ``body`` of a report; markup in ``crumbs`` is kept if it is `Markup`."""
    # The style is a trusted file, so it is not escaped: CSS needs `>`.
    style = Markup(ASSETS.joinpath("app.css").read_text(encoding="utf-8"))
    return TEMPLATES.get_template("report.html").render(
        style=style, body=Markup(body), title=title, crumbs=crumbs
    )


def study_body(
    study: Study, title: str, ends: Mapping[str, float], skipped: Mapping[str, str] | None = None
) -> str:
    """The content of a study's report as HTML.

    Parameters
    ----------
    title : str
        What was studied: a folder, a plant.
    ends : mapping
        Ends of the scales of ``flux_difference`` and ``mean_difference`` [of the measured peak].
    skipped : mapping
        What was left out, with the reasons.
    """
    chart, sides = accuracy_chart(study), (study.window, study.window)
    mean = "Mean of forecast minus photograph"
    left = difference_map(mean, residual_map(study), sides, "of peak", ends["mean_difference"])
    found = study.discrepancy
    discrepancy = None if found is None else found.to_json()
    return TEMPLATES.get_template("study.html").render(
        study=study,
        conclusion=conclude(study),
        title=title,
        verdict=VERDICTS[study.verdict],
        findings=[Finding.of(found) for found in study.found],
        discrepancy=discrepancy,
        amounts=[] if discrepancy is None else amount_charts(discrepancy["coefficients"]),
        correction_map=None if found is None else _correction_map(found.change, sides),
        chart=chart,
        pictures=pictures(study, chart.images, ends["flux_difference"]),
        scatters=scatters(study),
        residual_map=left,
        covariates=error_covariates(study),
        chance=1.96 / max(len(study.images) - 1, 1) ** 0.5,
        skipped=skipped or {},
        few=FEW,
    )


def _correction_map(change: Array, sides: tuple[float, float]) -> HeatMap:
    """The mean change of forecasts (64, 64) by a correction [of the measured peak]."""
    bound = float(np.abs(change).max()) or 1.0
    return difference_map("Mean change by the correction", change, sides, "of peak", bound)
