"""Adoption of studies: what became of them, what to know before, and what it would change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from statistics import fmean
from typing import Literal

from sqlalchemy.orm import Session

from model.surface import control_points
from service import store
from service.base.errors import SKIPPED, NotFoundError
from service.base.fields import Sun
from service.store.results import StudyFindings
from service.store.tables import ModelRow, StudyRow
from service.twin import model_versions
from service.twin.adoption_rules import OpenQuestion, names_of, open_questions, why_refused
from service.twin.forecasts.heliostat_forecast import aimed_setup, trace_flux
from service.twin.measurements import heights_of, load_heliostat_context
from service.twin.operations import Forecast
from service.twin.runtime import Runtime

AdoptionState = Literal["active", "replaced", "withdrawn", "candidate", "nothing_to_adopt"]


@dataclass(frozen=True)
class StudyState:
    """A study's findings, and the newest version adopted from it.

    ``state`` is "replaced" if a later version is current. ``warnings`` are the conflicts that
    adoption by force ignores. ``current`` is the number of the current version. ``refusal`` says
    why it cannot be adopted, None if it can. ``adopts`` names what adoption adds.
    """

    findings: StudyFindings
    version: ModelRow | None
    state: AdoptionState
    questions: list[OpenQuestion]
    warnings: list[str]
    current: int
    refusal: str | None
    adopts: list[str]

    @property
    def is_adoptable(self) -> bool:
        """Whether it can be adopted, and is not."""
        return self.refusal is None and self.state in ("candidate", "withdrawn")

    @property
    def adopted(self) -> int | None:
        """Number of the version that was adopted from it, unless it is withdrawn."""
        return None if self.version is None or self.version.withdrawn_at else self.version.number


def study_states(session: Session, rows: Sequence[StudyRow]) -> dict[int, StudyState]:
    """The states of studies, by id."""
    numbers = [row.id for row in rows]
    findings, current = (
        store.study_findings(session, numbers),
        model_versions.current_number(session),
    )
    versions = model_versions.newest_of(session, numbers)
    return {row.id: _state(row, findings[row.id], versions.get(row.id), current) for row in rows}


def _state(
    row: StudyRow, findings: StudyFindings, version: ModelRow | None, current: int
) -> StudyState:
    refusal = why_refused(findings)
    state: AdoptionState = "candidate" if refusal is None else "nothing_to_adopt"
    if version is not None:
        is_active = version.number == current
        state = "withdrawn" if version.withdrawn_at else "active" if is_active else "replaced"
    warnings = []
    if row.model != current:
        warnings.append(
            f"it was made with version {row.model} of the model, and would replace version"
            f" {current}, which is current"
        )
    questions, adopts = open_questions(findings), names_of(findings)
    return StudyState(findings, version, state, questions, warnings, current, refusal, adopts)


MAX_HELIOSTATS = 12
"""Most heliostats whose forecasts are computed."""

EACH_S = 0.2
"""Stated duration of a heliostat's two forecasts [s]."""

_RESOLUTION = (128, 128)


@dataclass(frozen=True, eq=False)
class ForecastChange:
    """Forecasts of a heliostat by the current model, and by the model after the adoption.

    Sun and target are those of the heliostat's newest photograph, taken at ``taken_at``.
    """

    heliostat: str
    target: str
    taken_at: datetime | None
    before: Forecast
    after: Forecast

    @property
    def peak(self) -> float:
        """Change of the peak, relative to the peak before."""
        return self.after.peak / self.before.peak - 1

    @property
    def power(self) -> float:
        """Change of the power, relative to the power before."""
        return self.after.power / self.before.power - 1

    @property
    def largest(self) -> float:
        """Largest change of irradiance at a place, relative to the peak before."""
        return float(abs(self.after.flux - self.before.flux).max() / self.before.peak)

    @property
    def largest_in_camera(self) -> float:
        """The same of the image that the camera would show."""
        views = self.after.camera_view, self.before.camera_view
        return float(abs(views[0] - views[1]).max() / views[1].max())


@dataclass(frozen=True)
class AccuracyChange:
    """Changes of accuracy [1] on held-out photographs: mean, largest drop, largest gain, counts.

    ``worst`` and ``best`` name the photographs with the largest drop and gain.
    """

    mean: float
    worst: tuple[str, float]
    best: tuple[str, float]
    n_better: int
    n_worse: int

    @classmethod
    def of(cls, before: Mapping[str, float], after: Mapping[str, float]) -> "AccuracyChange | None":
        """The change between accuracies by photograph; None without photographs in both."""
        changes = {name: after[name] - before[name] for name in before if name in after}
        if not changes:
            return None
        order = sorted(changes, key=changes.__getitem__)
        return cls(
            fmean(changes.values()),
            (order[0], changes[order[0]]),
            (order[-1], changes[order[-1]]),
            sum(change > 0 for change in changes.values()),
            sum(change < 0 for change in changes.values()),
        )


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes by heliostat. ``skipped`` has the reasons of those that cannot be forecast."""

    of: list[ForecastChange] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def mean_peak(self) -> float:
        """Mean relative change of the peaks."""
        return fmean(change.peak for change in self.of)

    @property
    def largest_peak(self) -> float:
        """Largest relative change of a peak, up or down."""
        return max((change.peak for change in self.of), key=abs)


def heliostats_to_forecast(studied: Sequence[str]) -> Sequence[str]:
    """Those of the studied heliostats whose forecasts show the change, spread over all."""
    step = -(-len(studied) // MAX_HELIOSTATS)
    return studied[:: max(step, 1)]


def forecast_changes(runtime: Runtime, number: int) -> Changes:
    """Forecast a study's heliostats by the current model, and by the one after its adoption."""
    changes = Changes()
    with runtime.database.reading() as session:
        study = store.get_study(session, number)
    for name in heliostats_to_forecast(study.heliostats):
        try:
            changes.of.append(_change(runtime, study, name))
        except SKIPPED as error:
            changes.skipped[name] = str(error)
    return changes


def _change(runtime: Runtime, study: StudyRow, name: str) -> ForecastChange:
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, name)
        after = model_versions.model_if_adopted(session, study)
        newest = store.recent_measurements(session, twin.row, 1)
        if not newest:
            raise NotFoundError(f"heliostat {name} has no photograph any more")
        row, surface = newest[0], store.find_surface_at(session, twin.row)
        plane = store.target_plane(row.target)
        points = control_points(twin.heliostat, heights_of(surface))
        sun = Sun(azimuth_deg=row.sun_azimuth_deg, elevation_deg=row.sun_elevation_deg)
    setup = aimed_setup(twin.heliostat, points, sun, row.taken_at, plane)
    before, then = (
        trace_flux(runtime, setup, model, plane, _RESOLUTION) for model in (twin.model, after)
    )
    return ForecastChange(name, plane.name, row.taken_at, before, then)
