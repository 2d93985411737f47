"""Studies of stored photographs and surfaces, and their stored reports."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, ValidationInfo, field_validator
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import CATALOGUE, effects_from_json
from model.errors import InvalidInputError, UnreachableError
from model.forecast import align
from model.frames import wgs84_to_enu
from model.plant_model import PlantModel
from model.pointing.report import day_of
from model.site import Site
from model.study import FluxImage, Study, StudyOptions, study_to_json
from model.study.loop import MIN_IMAGES
from model.surface import DEGREE, control_points
from service import store
from service.base.arrays import to_json_value
from service.base.errors import SKIPPED, ConflictError, NotFoundError, list_reasons
from service.base.fields import Model, Moment, Name, StudyReport, Text, Whole
from service.base.processes import return_memory
from service.base.progress import NamedSteps, Report, no_report
from service.base.validation import format_validation_error
from service.drawing.study_report import study_body
from service.store.columns import now
from service.store.tables import (
    UNLIKE_HELIOSTAT,
    HeliostatRow,
    MeasurementRow,
    StudyRow,
    SurfaceRow,
)
from service.twin import model_versions
from service.twin.measurements import (
    HeliostatContext,
    accepted_measurement,
    choose_measurements,
    heights_of,
    load_heliostat_context,
)
from service.twin.model_versions import ModelVersion
from service.twin.runtime import Runtime
from service.twin.stored_mount import mount_at
from service.twin.studies.known_neighbours import load_neighbours, with_neighbours

Surfaces = Literal["measured", "current"]


MAX_STUDY_IMAGES = 400  # bounds the memory of a study


class StudyIn(Model):
    """Find the effect that stored photographs show and the plant's current model lacks."""

    heliostats: list[Name] | None = Field(
        default=None,
        min_length=1,
        max_length=200,
        description="Names of heliostats; else some of all over the field.",
    )
    max_heliostats: Whole = Field(
        default=12,
        ge=1,
        le=200,
        description="How many heliostats to take where none is named, near ones and far ones.",
    )
    surfaces: Surfaces = Field(
        default="current",
        description=(
            "measured: only heliostats with a measured surface; current: where there is none, the"
            " newest prediction."
        ),
    )
    images: Whole = Field(
        default=12,
        ge=2,
        le=64,
        validate_default=True,
        description=(
            "Most photographs of each heliostat: the newest ones, spread over the sun's positions."
            f" {MAX_STUDY_IMAGES} of all heliostats together."
        ),
    )
    since: Moment | None = Field(
        default=None, description="Only photographs from then on (time with zone)."
    )
    until: Moment | None = Field(
        default=None, description="Only photographs before then (time with zone)."
    )
    candidates: list[Text] | None = Field(
        default=None,
        min_length=1,
        max_length=100,
        description="Names of the effects to try; all without it.",
    )

    @field_validator("candidates")
    @classmethod
    def _known(cls, names: list[str] | None) -> list[str] | None:
        if names is not None and not set(names) <= set(CATALOGUE):
            raise ValueError(f"the catalogue of effects has {', '.join(CATALOGUE)}")
        return None if names is None else list(dict.fromkeys(names))

    @field_validator("images")
    @classmethod
    def _not_too_many(cls, images: int, info: ValidationInfo) -> int:
        named = info.data.get("heliostats")
        count = info.data.get("max_heliostats", 1) if named is None else len(set(named))
        if count * images > MAX_STUDY_IMAGES:
            raise ValueError(
                f"{count * images} in all, {MAX_STUDY_IMAGES} at most; ask for"
                f" {MAX_STUDY_IMAGES // count} of each heliostat, or for fewer heliostats"
            )
        return images


@dataclass(eq=False)
class StudyInputs:
    """Inputs of a study from the store.

    ``skipped`` are the heliostats and photographs that were left out, with the reasons.
    """

    photographs: list["FluxImage"] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def heliostats(self) -> list[str]:
        """Names of the heliostats that the photographs show."""
        return sorted({photograph.heliostat for photograph in self.photographs})

    @property
    def span(self) -> tuple[datetime | None, datetime | None]:
        """Times of the first and the last photograph; None if unknown."""
        known = [p.taken_at for p in self.photographs if p.taken_at is not None]
        return min(known, default=None), max(known, default=None)

    def without_untraceable(self, site: Site) -> "StudyInputs":
        """The same without photographs that no attitude of their heliostat explains.

        One of them would stop the study.
        """
        traceable, skipped = [], dict(self.skipped)
        for photograph in self.photographs:
            try:
                align([photograph.setup], PlantModel(site))
            except UnreachableError as error:
                skipped[photograph.key] = str(error)
            else:
                traceable.append(photograph)
        return replace(self, photographs=traceable, skipped=skipped)


def load_study_inputs(session: Session, request: StudyIn) -> StudyInputs:
    """Load the photographs of a request, and the surfaces of their mirrors.

    Raises
    ------
    NotFoundError
        If a named heliostat is not stored.
    """
    material = StudyInputs()
    for row in _chosen_heliostats(session, request):
        try:
            _load_heliostat_inputs(session, row, request, material)
        except SKIPPED as error:
            material.skipped[row.name] = str(error)
    return material


@dataclass(frozen=True)
class StudyExtent:
    """Numbers of photographs by heliostat that a study would use, and what it would leave out."""

    photographs: dict[str, int]
    skipped: dict[str, str]

    @property
    def n_photographs(self) -> int:
        """Number of all photographs."""
        return sum(self.photographs.values())


def extent_of(session: Session, request: StudyIn) -> StudyExtent:
    """Count what a request would study, without loading photographs.

    Raises
    ------
    NotFoundError
        If a named heliostat is not stored.
    """
    photographs, skipped = dict[str, int](), dict[str, str]()
    for row in _chosen_heliostats(session, request):
        try:
            _surface(session, row, request.surfaces)
            photographs[row.name] = len(_chosen_measurements(session, row, request, skipped))
        except SKIPPED as error:
            skipped[row.name] = str(error)
    return StudyExtent(photographs, skipped)


def _chosen_measurements(
    session: Session, row: HeliostatRow, request: StudyIn, skipped: dict[str, str]
) -> list[MeasurementRow]:
    """Photographs of a heliostat, without those that are ``skipped`` as another's."""
    found = choose_measurements(session, row, request.images, request.since, request.until)
    unlike = {
        one.identifier: str(warning["detail"])
        for one in found
        if (warning := one.warning(UNLIKE_HELIOSTAT)) is not None
    }
    skipped |= {f"{row.name}/{name}": detail for name, detail in unlike.items()}
    return [one for one in found if one.identifier not in unlike]


def _chosen_heliostats(session: Session, request: StudyIn) -> Sequence[HeliostatRow]:
    """The named heliostats, else a selection with photographs and a surface.

    The selection is spread evenly over the distance from the tower.
    """
    if request.heliostats is not None:
        return [store.get_heliostat(session, name) for name in dict.fromkeys(request.heliostats)]
    is_photograph = MeasurementRow.accepted & MeasurementRow.image_sha256.is_not(None)
    photographed = select(MeasurementRow.heliostat_id).where(is_photograph)
    shaped = select(SurfaceRow.heliostat_id)
    if request.surfaces == "measured":
        shaped = shaped.where(SurfaceRow.source == "measured")
    query = select(HeliostatRow).where(
        HeliostatRow.id.in_(photographed), HeliostatRow.id.in_(shaped)
    )
    rows = list(session.scalars(query))
    rows.sort(key=lambda row: (np.hypot(row.east_m, row.north_m), row.name))
    places = (
        np.linspace(0, len(rows) - 1, min(len(rows), request.max_heliostats)).round().astype(int)
    )
    return [rows[place] for place in places]


def _surface(session: Session, heliostat: HeliostatRow, surfaces: Surfaces) -> SurfaceRow:
    measured = store.find_measured_surface(session, heliostat)
    if measured is not None:
        return measured
    if surfaces == "measured":
        raise NotFoundError(f"heliostat {heliostat.name} has no measured surface")
    return store.get_surface_at(session, heliostat)


def _load_heliostat_inputs(
    session: Session, row: HeliostatRow, request: StudyIn, material: StudyInputs
) -> None:
    twin = load_heliostat_context(session, row.name)
    surface = _surface(session, row, request.surfaces)
    points = control_points(twin.heliostat, heights_of(surface))
    seen = {m.identifier for m in surface.measurements}
    chosen = _chosen_measurements(session, row, request, material.skipped)
    names = [found.identifier for found in chosen]
    rows = store.get_measurements(session, row, names, arrays=True)
    add_photographs(session, material, twin, rows, points, seen=seen)


def add_photographs(
    session: Session,
    material: StudyInputs,
    twin: HeliostatContext,
    rows: Sequence[MeasurementRow],
    points: NDArray[np.float64],
    degree: int = DEGREE,
    seen: Collection[str] = (),
) -> None:
    """Add photographs of a heliostat whose mirror has the control ``points`` (F, I, J, 3) [m].

    ``rows`` are accepted photographs, loaded with their arrays. ``seen`` are identifiers of those
    that the mirror was estimated from, if it was. A photograph that is newer than the calibration
    of its mount also has the pointing from its motors. Mirrors near the heliostat may hide parts of
    it.
    """
    stored, neighbours = mount_at(session, twin.row), load_neighbours(session, twin)
    for row in rows:
        try:
            _require_on_target(twin, row)
            evidence = accepted_measurement(row, twin.origin)
            photograph = evidence.photograph(
                twin.heliostat, points, degree, row.identifier in seen, bool(seen)
            )
            if stored is not None:
                motors, day = evidence.motor_position, day_of(evidence.taken_at)
                photograph = photograph.sent(stored.heliostat, stored.mount, motors, day)
            photograph = with_neighbours(photograph, neighbours, twin.model)
        except SKIPPED as error:
            material.skipped[f"{twin.row.name}/{row.identifier}"] = str(error)
            continue
        material.photographs.append(photograph)


def _require_on_target(twin: HeliostatContext, row: MeasurementRow) -> None:
    """Reject a photograph whose given spot lies off its target.

    It probably shows another target or another heliostat.
    """
    if row.focal_spot_wgs84 is None:
        return
    if not store.target_plane(row.target).contains(wgs84_to_enu(row.focal_spot_wgs84, twin.origin)):
        raise InvalidInputError(
            f"{twin.row.name}/{row.identifier}: 'focal_spot' lies off its target {row.target.name}"
        )


@dataclass(frozen=True, eq=False)
class StoredStudy:
    """A study with its inputs."""

    request: StudyIn
    model: ModelVersion
    material: StudyInputs
    study: "Study"


def study_store(runtime: Runtime, request: StudyIn, report: Report = no_report) -> StoredStudy:
    """Find effects that stored photographs require beyond the plant's current model.

    ``report`` receives the progress and the current fit. An exception that it raises stops the
    study.

    Raises
    ------
    NotFoundError
        If a named heliostat is not stored.
    ConflictError
        If too few photographs with a surface are stored. The message says what was left out.
    """
    with runtime.database.reading() as session:
        model = model_versions.get_model(session)
        material = load_study_inputs(session, request)
    options = StudyOptions()
    if request.candidates is not None:
        options = replace(options, candidates=tuple(request.candidates))
    # Scopes are searched after the effects, of which one may be chosen again; halves and terms
    # outside the catalogue at the end.
    most = (len(options.candidates) + 1) * (options.most + 1) + 2
    steps = NamedSteps(most, report, "fits, at most")
    options = replace(options, between=steps.alive)

    def step(name: str) -> None:
        """Report a step, and let others use the model and its memory in between."""
        return_memory()
        runtime.compute_slots.pause(runtime.check)
        steps(name)

    with runtime.computing("study") as operations:
        material = material.without_untraceable(model.site)
        _require_enough(material)
        study = operations.study(material.photographs, model, options, step)
    return StoredStudy(request, model, material, study)


def _require_enough(material: StudyInputs) -> None:
    count = len(material.photographs)
    if count < MIN_IMAGES:
        reasons = list_reasons(material.skipped, 5)
        raise ConflictError(
            f"a study takes at least {MIN_IMAGES} photographs with surfaces, the store has {count}"
            + (f" ({reasons})" if reasons else "")
        )


def study_row(
    studied: StoredStudy,
    title: str,
    options: dict[str, object],
    actor: str,
    scales: Mapping[str, float],
) -> StudyRow:
    """The row of a study, with the content of its report page.

    ``options`` are the requested options as JSON. ``scales`` are the upper ends of the maps' colour
    scales (`Settings.figure_scales`).
    """
    material, report = studied.material, to_json_value(study_to_json(studied.study))
    first_taken_at, last_taken_at = material.span
    return StudyRow(
        created_by=actor,
        options=options,
        heliostats=material.heliostats,
        first_taken_at=first_taken_at,
        last_taken_at=last_taken_at,
        model=studied.model.number,
        model_version=studied.model.version,
        verdict=report["verdict"],
        conclusion=report["conclusion"],
        report=report,
        skipped=material.skipped,
        html=study_body(studied.study, title, scales, material.skipped),
    )


def model_of_report(session: Session, document: Any, name: str) -> ModelVersion:
    """Find the model version that a folder's report was made with.

    The default is the current version.

    Raises
    ------
    ConflictError
        If no version has the effects that the report assumes.
    """
    known = document.get("model") if isinstance(document, dict) else None
    if known is None:
        return model_versions.get_model(session)
    effects = effects_from_json(known)
    found = model_versions.find_model(session, effects)
    if found is None:
        names = ", ".join(effect.name for effect in effects) or "none"
        raise ConflictError(
            f"{name} was made with other effects ({names}) than any version of the store's model"
            " has: declare those in 'twin.json' and import the folder, or study what is stored"
        )
    return found


def parse_report(document: Any, name: str) -> StudyReport:
    """Parse a report of `heliotwin study`, read from the file ``name``.

    Raises
    ------
    InvalidInputError
        If it is not such a report.
    """
    try:
        report = StudyReport.model_validate(document)
    except ValidationError as error:
        raise InvalidInputError(f"{name}: {format_validation_error(error, 'report')}") from None
    effects_from_json(document["effects"])
    return report


def row_of_report(document: Any, name: str, model: ModelVersion, actor: str) -> StudyRow:
    """The study row of a report that was read from the file ``name``.

    ``model`` is the version it was made with. Raises what `parse_report` raises.
    """
    report = parse_report(document, name)
    return StudyRow(
        created_at=now(),
        created_by=actor,
        options={"report": name},
        heliostats=sorted({key.partition("/")[0] for key in report.before.per_image}),
        model=model.number,
        model_version=model.version,
        verdict=report.verdict,
        conclusion=report.conclusion,
        report=to_json_value(document),
        skipped=report.skipped,
    )


def date_report(session: Session, row: StudyRow) -> None:
    """Set the times of a report's first and last photograph, of those that the store has."""
    at = MeasurementRow.taken_at
    identifiers = {key.partition("/")[2] for key in row.report["before"]["per_image"]}
    query = select(func.min(at), func.max(at)).join(HeliostatRow)
    query = query.where(HeliostatRow.name.in_(row.heliostats))
    query = query.where(MeasurementRow.identifier.in_(identifiers))
    row.first_taken_at, row.last_taken_at = session.execute(query).one()
