"""Studies of what is stored: photographs and surfaces out of the store, a report into it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.effects import effects_from_json
from model.errors import InvalidInputError, UnreachableError
from model.forecast import align
from model.pointing.report import day_of
from model.study import FluxImage, Study, StudyOptions
from model.study.loop import LEAST_IMAGES
from model.surface import control_points
from service import store
from service.base.arrays import plain
from service.base.faults import SKIPPED, ConflictError, NotFoundError
from service.base.fields import StudyReport
from service.base.progress import Report, Steps
from service.base.wording import told
from service.drawing.study_report import study_page
from service.store.tables import HeliostatRow, MeasurementRow, StudyRow, SurfaceRow
from service.twin import versions
from service.twin.evidence import choose_measurements, evidence_of, heights_of, load_twin
from service.twin.mounted import holding_mount
from service.twin.runtime import Runtime
from service.twin.versions import PlantModel

Surfaces = Literal["measured", "current"]


@dataclass(frozen=True)
class StudyRequest:
    """What to study.

    ``heliostats``: by name; without it ``most_heliostats``, spread over the field. ``surfaces``: "measured", or
    "current": the measured one where there is one, else the newest prediction. ``images`` of each heliostat at the
    most, taken from ``since`` until before ``until``. ``candidates``: effects of the catalogue; all without it.
    """

    heliostats: Sequence[str] | None = None
    surfaces: Surfaces = "current"
    images: int = 12
    most_heliostats: int = 12
    since: datetime | None = None
    until: datetime | None = None
    candidates: Sequence[str] | None = None


@dataclass(eq=False)
class Material:
    """What the store gives a study: photographs, what was left out, and when photographs were taken, by their keys."""

    photographs: list["FluxImage"] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def heliostats(self) -> list[str]:
        """Those that photographs show."""
        return sorted({photograph.heliostat for photograph in self.photographs})

    @property
    def span(self) -> tuple[datetime | None, datetime | None]:
        """The first and the last moment that is known."""
        known = [p.taken_at for p in self.photographs if p.taken_at is not None]
        return min(known, default=None), max(known, default=None)

    def without_untraceable(self, latitude_deg: float) -> "Material":
        """The same without photographs that no attitude of their heliostat can have made: one would end the study."""
        kept, skipped = [], dict(self.skipped)
        for photograph in self.photographs:
            try:
                align([photograph.setup], latitude_deg=latitude_deg)
            except UnreachableError as error:
                skipped[photograph.key] = str(error)
            else:
                kept.append(photograph)
        return replace(self, photographs=kept, skipped=skipped)


def gather(session: Session, request: StudyRequest) -> Material:
    """The photographs that a request names, with the surfaces of their mirrors.

    Raises
    ------
    NotFoundError
        Where a heliostat that is named is not stored.
    """
    material = Material()
    for row in _chosen_heliostats(session, request):
        try:
            _gather_heliostat(session, row, request, material)
        except SKIPPED as error:
            material.skipped[row.name] = str(error)
    return material


def _chosen_heliostats(session: Session, request: StudyRequest) -> Sequence[HeliostatRow]:
    """Those that are named; else of those with photographs and a surface, evenly over the distance from the tower."""
    if request.heliostats is not None:
        return [store.get_heliostat(session, name) for name in dict.fromkeys(request.heliostats)]
    photographed = select(MeasurementRow.heliostat_id).where(MeasurementRow.accepted)
    shaped = select(SurfaceRow.heliostat_id)
    if request.surfaces == "measured":
        shaped = shaped.where(SurfaceRow.source == "measured")
    query = select(HeliostatRow).where(HeliostatRow.id.in_(photographed), HeliostatRow.id.in_(shaped))
    rows = list(session.scalars(query))
    rows.sort(key=lambda row: (np.hypot(row.east_m, row.north_m), row.name))
    places = np.linspace(0, len(rows) - 1, min(len(rows), request.most_heliostats)).round().astype(int)
    return [rows[place] for place in places]


def _surface(session: Session, heliostat: HeliostatRow, surfaces: Surfaces) -> SurfaceRow:
    measured = store.find_measured_surface(session, heliostat)
    if measured is not None:
        return measured
    if surfaces == "measured":
        raise NotFoundError(f"heliostat {heliostat.name} has no measured surface")
    return store.get_surface_at(session, heliostat)


def _gather_heliostat(session: Session, row: HeliostatRow, request: StudyRequest, material: Material) -> None:
    twin, surface = load_twin(session, row.name), _surface(session, row, request.surfaces)
    points, seen = control_points(twin.heliostat, heights_of(surface)), {m.identifier for m in surface.measurements}
    stored = holding_mount(session, row)
    chosen = choose_measurements(session, row, request.images, request.since, request.until)
    for measurement in store.get_measurements(session, row, [found.identifier for found in chosen], arrays=True):
        try:
            evidence = evidence_of(measurement, twin.origin)
            photograph = evidence.photograph(twin.heliostat, points, seen=measurement.identifier in seen)
            if stored is not None:
                motors, day = evidence.motor_position, day_of(evidence.taken_at)
                photograph = photograph.sent(stored.heliostat, stored.mount, motors, day)
        except SKIPPED as error:
            material.skipped[f"{row.name}/{measurement.identifier}"] = str(error)
            continue
        material.photographs.append(photograph)


@dataclass(frozen=True, eq=False)
class Studied:
    """A study with what it was made of."""

    request: StudyRequest
    model: PlantModel
    material: Material
    study: "Study"


def study_store(runtime: Runtime, request: StudyRequest, report: Report = lambda share, message: None) -> Studied:
    """Which effects the stored photographs demand beyond the plant's current model.

    ``report`` is told how far it is and what is being fitted; what it raises ends the study.

    Raises
    ------
    NotFoundError
        Where a heliostat that is named is not stored.
    ConflictError
        Where too few photographs with a surface are stored; it says what was left out.
    """
    with runtime.database.reading() as session:
        model, latitude_deg = versions.get_model(session), store.get_plant(session).latitude_deg
        material = gather(session, request)
    options = StudyOptions()
    if request.candidates is not None:
        options = replace(options, candidates=tuple(request.candidates))
    steps = Steps((len(options.candidates) + 1) * options.most, report)  # scopes are sought after the effects

    def step(name: str) -> None:
        """Tell it, and let others at the model before it is done: a study is long."""
        runtime.gate.pause()
        steps(name)

    with runtime.computing("study") as operations:
        material = material.without_untraceable(latitude_deg)
        _require_enough(material)
        study = operations.study(
            material.photographs, model.optics, model.effects, options, step, latitude_deg=latitude_deg
        )
    return Studied(request, model, material, study)


def _require_enough(material: Material) -> None:
    count = len(material.photographs)
    if count < LEAST_IMAGES:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(material.skipped.items())[:5])
        raise ConflictError(
            f"a study takes at least {LEAST_IMAGES} photographs with surfaces, the store has {count}"
            + (f" ({reasons})" if reasons else "")
        )


def study_row(
    studied: Studied, title: str, options: dict[str, Any], actor: str, scales: Mapping[str, float]
) -> StudyRow:
    """The study as it is kept, with its page; ``options`` are those that were asked for, as JSON.

    ``scales`` say where the colours of the page's maps end (`Settings.figure_scales`).
    """
    material, report = studied.material, plain(studied.study.to_json())
    taken_from, taken_to = material.span
    return StudyRow(
        created_by=actor,
        options=options,
        heliostats=material.heliostats,
        taken_from=taken_from,
        taken_to=taken_to,
        model=studied.model.number,
        model_version=studied.model.version,
        verdict=report["verdict"],
        conclusion=report["conclusion"],
        report=report,
        skipped=material.skipped,
        html=study_page(studied.study, title, scales, material.skipped),
    )


def model_of_report(session: Session, document: Any, name: str) -> PlantModel:
    """The version of the store's model that a folder's report was made with; the current one where it does not say.

    Raises
    ------
    ConflictError
        Where no version has the effects that the report took for known.
    """
    known = document.get("model") if isinstance(document, dict) else None
    if known is None:
        return versions.get_model(session)
    effects = effects_from_json(known)
    found = versions.find_model(session, effects)
    if found is None:
        names = ", ".join(effect.name for effect in effects) or "none"
        raise ConflictError(
            f"{name} was made with other effects ({names}) than any version of the store's model has: "
            "declare those in 'twin.json' and import the folder, or study what is stored"
        )
    return found


def row_of_report(document: Any, name: str, model: PlantModel, actor: str) -> StudyRow:
    """A report of `heliotwin study`, read from the file ``name``, as a study that was made with ``model``.

    Raises
    ------
    InvalidInputError
        Where it is no such report.
    """
    try:
        report = StudyReport.model_validate(document)
    except ValidationError as error:
        raise InvalidInputError(f"{name}: {told(error, 'report')}") from None
    effects_from_json(report.effects)
    return StudyRow(
        created_by=actor,
        options={"report": name},
        heliostats=sorted({key.partition("/")[0] for key in report.before.per_image}),
        model=model.number,
        model_version=model.version,
        verdict=report.verdict,
        conclusion=report.conclusion,
        report=plain(document),
        skipped=report.skipped,
    )
