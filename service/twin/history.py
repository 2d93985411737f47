"""History files of an export, in addition to PAINT's layout, and their import.

``history/plant.json`` has the versions of the plant's model and their studies.
``history/heliostats/H/history.json`` has the history of a heliostat:

- photographs as they came, with corrections,
- all versions of its surface with decisions, and with arrays in ``surface-N.npz``,
- its mounts,
- its accuracy on its newest photograph, on arrival.

Images of excluded photographs are also there, because other readers would use them in PAINT's
place.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, create_model
from sqlalchemy import select
from sqlalchemy.orm import Session, undefer

from model.effects import effects_from_json
from model.errors import InvalidInputError
from model.imaging import ImageKind
from model.pointing.report import mount_from_json
from service import store
from service.base.arrays import unpack_untrusted
from service.base.fields import (
    CheckedMountReport,
    Name,
    Source,
    StudyReport,
    Sun,
    Text,
    Verdict,
    Wgs84,
    from_row,
)
from service.base.validation import format_validation_error
from service.sources.documents import parse_declared, read_json
from service.sources.files import read_file
from service.store import audit
from service.store.measurements import EXCLUDED, find_measurement_of_image, find_position
from service.store.rows import many, record
from service.store.tables import (
    UNLIKE_HELIOSTAT,
    AliasRow,
    CorrectionRow,
    DecisionRow,
    DriftRow,
    HeliostatRow,
    MeasurementRow,
    ModelRow,
    MountRow,
    PlantRow,
    StudyRow,
    SurfaceRow,
    TargetRow,
)
from service.twin.photographs.ingest import position_row
from service.twin.photographs.metadata import photograph_with_target

FOLDER = "history"

# Values that the import measures again from the image, so the export omits them. Of the warnings it
# has that of the arrival.
_MEASURED = ("accepted", "reason", "quality", "warnings", "center_right_m", "center_up_m")
_FILE = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,160}$")]
_Object = dict[str, object]
_Correction = record(CorrectionRow)
_Motor = Annotated[float, Field(ge=-1e9, le=1e9)]
_Pixel = tuple[Annotated[float, Field(ge=-1e5, le=1e5)], Annotated[float, Field(ge=-1e5, le=1e5)]]
_Corners = dict[Literal["corners"], tuple[_Pixel, _Pixel, _Pixel, _Pixel]]
_Unlike = create_model("Unlike", detail=(Text, ...), like=(Name, ...))
_Photograph = record(
    MeasurementRow,
    (*_MEASURED, "sun_azimuth_deg", "sun_elevation_deg", "forecast_key"),
    kind=(ImageKind | Literal["none"], ...),
    target=(str, ...),
    image=(_FILE | None, ...),
    sun=(Sun, ...),
    motor_axis_1=(_Motor | None, None),
    motor_axis_2=(_Motor | None, None),
    focal_spot_wgs84=(Wgs84 | None, None),
    helios_spot_wgs84=(Wgs84 | None, None),
    corners_px=(Annotated[_Corners, Field(min_length=1)] | None, None),
    excluded=(bool, ...),
    unlike=(_Unlike | None, ...),
    corrections=(many(_Correction), ...),
    aliases=(list[str], []),
)
_Surface = record(SurfaceRow, source=(Source, ...), photographs=(list[str], ...))
_Decision = record(DecisionRow, version=(int, ...))
_Mount = record(MountRow)
_Drift = record(DriftRow, photograph=(str, ...), version=(int, ...))
_History = create_model(
    "History",
    photographs=(many(_Photograph), ...),
    surfaces=(many(_Surface), ...),
    decisions=(many(_Decision), ...),
    mounts=(many(_Mount), ...),
    drift=(_Drift | None, ...),
)
_Study = record(StudyRow, verdict=(Verdict, ...), number=(Annotated[int, Field(ge=1)], ...))
_Model = record(ModelRow, study=(int | None, ...))
_Models = create_model(
    "Models",
    declared=(_Object | None, ...),
    corners=(dict[str, dict[str, Wgs84]], ...),
    studies=(many(_Study), ...),
    models=(many(_Model), ...),
)


def _load(path: Path, kind: Any) -> Any:
    try:
        document = kind.model_validate(read_json(path))
    except ValidationError as error:
        raise InvalidInputError(
            f"{path}: {format_validation_error(error)}; export the folder again"
        ) from None
    return document


def _check_models(models: Any, path: Path) -> None:
    """Raise InvalidInputError if a version of the model or a study is not usable."""
    parse_declared(models.declared or {}, f"{path}: declared")
    for study in models.studies:
        where = f"{path}: study {study.number}"
        _check_report(study.report, StudyReport, where)
        _check_effects(study.report["effects"], where)
    for model in models.models:
        where = f"{path}: version {model.number}"
        _check_effects(model.effects, where)
        parse_declared(model.declared or {}, where)


def _check_heliostat(document: Any, path: Path) -> None:
    """Raise InvalidInputError if a heliostat's corrections or mounts are not usable."""
    for photograph in document.photographs:
        if any(
            correction.before.keys() != correction.after.keys()
            for correction in photograph.corrections
        ):
            raise InvalidInputError(
                f"{path}: corrections of {photograph.identifier} must name the same before and"
                " after; export it again"
            )
    for mount in document.mounts:
        where = f"{path}: mount {mount.version}"
        _check_report(mount.document, CheckedMountReport, where)
        _check_effects(mount.document.get("sun", []), where)
        mount_from_json(mount.document, where)


def _check_report(document: Any, kind: type[BaseModel], where: str) -> None:
    try:
        kind.model_validate(document)
    except ValidationError as error:
        raise InvalidInputError(
            f"{where}: {format_validation_error(error)}; export the folder again"
        ) from None


def _check_effects(data: Any, where: str) -> None:
    try:
        effects_from_json(data)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None


# --- the plant's model
# ------------------------------------------------------------------------------------------------


PLANT = f"{FOLDER}/plant.json"
"""File with the versions of the plant's model; only exports have it."""


def plant_history(session: Session) -> Any:
    """The declared model, studies, later model versions, and targets' corners as they came."""
    studies = session.scalars(select(StudyRow).order_by(StudyRow.id)).all()
    models = session.scalars(select(ModelRow).order_by(ModelRow.number)).all()
    targets = store.list_targets(session)
    return _Models(
        declared=store.get_plant(session).declared,
        corners={target.name: target.corners for target in targets if target.corners},
        studies=[from_row(_Study, row, number=row.id) for row in studies],
        models=[from_row(_Model, row, study=row.study_id) for row in models],
    )


def restore_plant(session: Session, root: Path, actor: str) -> bool:
    """Restore the versions of the plant's model; return False if they are stored already.

    Raises
    ------
    InvalidInputError
        If the store has other versions or studies, or heliostats, which may refer to other
        versions.
    """
    given, plant = _load(root / PLANT, _Models), session.get_one(PlantRow, 1)
    _check_models(given, root / PLANT)
    numbers = {study.number: place for place, study in enumerate(given.studies)}
    if unknown := {model.study for model in given.models} - {None, *numbers}:
        raise InvalidInputError(
            f"a model is of study {min(unknown)}, which is missing; export the folder again"
        )
    there = plant_history(session)
    if _is_same(there, given):
        return False
    if (
        there.studies
        or there.models
        or session.scalar(select(HeliostatRow.id).limit(1)) is not None
    ):
        raise InvalidInputError(
            "the store has other versions of the plant's model, which stay; use an empty store"
        )
    plant.declared = given.declared
    for target in store.list_targets(session):
        target.corners = given.corners.get(target.name)
    rows = [StudyRow(**study.model_dump(exclude={"number"})) for study in given.studies]
    for row in rows:
        session.add(row)
        session.flush()  # keep their order
    for model in given.models:
        study = None if model.study is None else rows[numbers[model.study]].id
        session.add(ModelRow(**model.model_dump(exclude={"study"}), study_id=study))
    audit.record(
        session, actor, "plant.history_imported", f"plant {plant.name}", models=len(given.models)
    )
    return True


def _is_same(first: Any, second: Any) -> bool:
    """Whether two histories are equal except for study numbers, which each store assigns."""

    def counted(models: Any) -> Any:
        places = {study.number: place for place, study in enumerate(models.studies)}
        studies = [study.model_dump(exclude={"number"}) for study in models.studies]
        versions = [
            model.model_dump() | {"study": places.get(model.study)} for model in models.models
        ]
        return models.declared, models.corners, studies, versions

    return bool(counted(first) == counted(second))


# --- a heliostat
# --------------------------------------------------------------------------------------------------


def heliostat_folder(name: str) -> str:
    """Folder of a heliostat's history, below the root."""
    return f"{FOLDER}/heliostats/{name}"


HISTORY = "history.json"


def surface_file(version: int) -> str:
    """File with the arrays of a surface version."""
    return f"surface-{version}.npz"


def image_folder(name: str, excluded: bool) -> str:
    """Folder of the images of photographs, below the root."""
    return heliostat_folder(name) if excluded else f"{name}/Calibration"


def heliostat_history(session: Session, row: HeliostatRow, images: Mapping[str, str]) -> Any:
    """The history of a heliostat, with all data that cannot be computed again.

    ``images`` are the image files by identifier. Photographs without a file are left out, except
    for measurements that came without an image.
    """
    corrections: dict[int, list[CorrectionRow]] = {}
    made = select(CorrectionRow).join(MeasurementRow).where(MeasurementRow.heliostat_id == row.id)
    for correction in session.scalars(made.order_by(CorrectionRow.id)):
        corrections.setdefault(correction.measurement_id, []).append(correction)
    of_heliostat = [
        row
        for row in store.list_measurements(session, row, None)
        if row.identifier in images or row.image_sha256 is None
    ]
    aliases: dict[int, list[str]] = {}
    for alias in session.scalars(
        select(AliasRow).where(AliasRow.heliostat_id == row.id).order_by(AliasRow.identifier)
    ):
        aliases.setdefault(alias.measurement_id, []).append(alias.identifier)
    decided = select(DecisionRow).where(DecisionRow.heliostat_id == row.id).order_by(DecisionRow.id)
    mounts = (
        select(MountRow).where(MountRow.heliostat_id == row.id).options(undefer(MountRow.document))
    )
    return _History(
        photographs=[
            from_row(
                _Photograph,
                one,
                sun=one.sun,
                target=one.target.name,
                image=images.get(one.identifier),
                excluded=one.reason == EXCLUDED,
                unlike=_unlike(one),
                corrections=[
                    from_row(_Correction, correction) for correction in corrections.get(one.id, ())
                ],
                aliases=aliases.get(one.id, []),
            )
            for one in of_heliostat
        ],
        surfaces=[
            from_row(
                _Surface,
                one,
                photographs=[m.identifier for m in one.measurements if m.identifier in images],
            )
            for one in store.list_surfaces(session, row, None)
        ],
        decisions=[
            from_row(_Decision, one, version=one.surface.version)
            for one in session.scalars(decided)
        ],
        mounts=[
            from_row(_Mount, one) for one in session.scalars(mounts.order_by(MountRow.version))
        ],
        drift=_drift(session, row, {one.id: one.identifier for one in of_heliostat}),
    )


def _unlike(row: MeasurementRow) -> _Object | None:
    found = row.warning(UNLIKE_HELIOSTAT)
    return None if found is None else {name: found[name] for name in ("detail", "like")}


def _drift(session: Session, row: HeliostatRow, names: Mapping[int, str]) -> Any:
    """The accuracy on the newest photograph, if that is one of ``names``."""
    drift = session.get(DriftRow, row.id)
    if drift is None or drift.measurement_id not in names:
        return None
    version = session.get_one(SurfaceRow, drift.surface_id).version
    return from_row(_Drift, drift, photograph=names[drift.measurement_id], version=version)


def load_heliostat(root: Path, name: str) -> Any:
    """Load a heliostat's history; None if the folder is not an export.

    Raises InvalidInputError if the history is not usable.
    """
    path = root / heliostat_folder(name) / HISTORY
    if not path.exists():
        return None
    given = _load(path, _History)
    _check_heliostat(given, path)
    return given


def image_path(root: Path, name: str, photograph: Any) -> Path | None:
    """Path of a photograph's image; None for a measurement without one."""
    file: str | None = photograph.image
    return None if file is None else root / image_folder(name, photograph.excluded) / file


def restore_heliostat(
    session: Session, row: HeliostatRow, given: Any, root: Path, actor: str, n_facets: int
) -> bool:
    """Restore a heliostat's history; return False if nothing is missing.

    The images must be stored already. Its surfaces have ``n_facets``.

    Raises
    ------
    InvalidInputError
        If the store has surfaces, decisions or mounts, or if arrays or the version of a decision
        are missing.
    """
    files = {
        document.identifier: document.image
        for document in given.photographs
        if document.image is not None
    }
    there = heliostat_history(session, row, files)
    if there == given:
        return False
    if there.surfaces or there.decisions or there.mounts:
        raise InvalidInputError(
            "the store has other surfaces or mounts, which stay; use an empty store"
        )
    photographs = _restore_photographs(session, row, given.photographs)
    versions: dict[int, SurfaceRow] = {}
    for one in given.surfaces:
        versions[one.version] = SurfaceRow(
            **one.model_dump(exclude={"photographs"}),
            heliostat_id=row.id,
            arrays=_read_arrays(
                root / heliostat_folder(row.name) / surface_file(one.version), n_facets
            ),
            measurements=[photographs[name] for name in one.photographs if name in photographs],
        )
        session.add(versions[one.version])
    session.flush()
    for one in given.decisions:
        if one.version not in versions:
            raise InvalidInputError(
                f"a decision is of version {one.version}, which is missing; export the folder again"
            )
        surface = versions[one.version].id
        session.add(
            DecisionRow(
                **one.model_dump(exclude={"version"}), heliostat_id=row.id, surface_id=surface
            )
        )
    if given.drift is not None and given.drift.photograph in photographs:
        session.add(_restored_drift(given.drift, row, photographs, versions))
    session.add_all(MountRow(**one.model_dump(), heliostat_id=row.id) for one in given.mounts)
    about = {"surfaces": len(given.surfaces), "photographs": len(photographs)}
    audit.record(session, actor, "heliostat.history_imported", f"heliostat {row.name}", **about)
    return True


def _restored_drift(
    given: Any,
    row: HeliostatRow,
    photographs: Mapping[str, MeasurementRow],
    versions: Mapping[int, SurfaceRow],
) -> DriftRow:
    if given.version not in versions:
        raise InvalidInputError(
            f"drift is of version {given.version}, which is missing; export the folder again"
        )
    return DriftRow(
        **given.model_dump(exclude={"photograph", "version"}),
        heliostat_id=row.id,
        measurement_id=photographs[given.photograph].id,
        surface_id=versions[given.version].id,
    )


# Limit of a surface's arrays [bytes]: 20 kB for each facet, in double precision.
_MAX_ARRAY_BYTES = 2**24


def _read_arrays(path: Path, n_facets: int) -> bytes:
    """Read the packed arrays of a surface; InvalidInputError if they are not valid."""
    data = read_file(path, _MAX_ARRAY_BYTES)
    arrays = unpack_untrusted(data, _MAX_ARRAY_BYTES, str(path))
    shapes = {name: array.shape for name, array in arrays.items() if np.isfinite(array).all()}
    heights = (n_facets, 8, 8)
    expected = {"z": heights, "z_std": heights, "control_points": (*heights, 3)}
    if shapes != expected:
        raise InvalidInputError(
            f"{path}: must hold finite {expected}, got {shapes}; export the folder again"
        )
    return data


def _find(session: Session, row: HeliostatRow, given: Any) -> MeasurementRow | None:
    """The measurement that was just stored for a history record, or None."""
    if given.image_sha256 is None:
        target_id = session.scalar(select(TargetRow.id).where(TargetRow.name == given.target))
        if target_id is None:
            return None
        sent = position_row(photograph_with_target(given, given.target), target_id, None)
        sent.identifier = given.identifier
        return find_position(session, row, sent)
    return find_measurement_of_image(session, row, given.image_sha256, given.kind)


def _restore_photographs(
    session: Session, row: HeliostatRow, given: list[Any]
) -> dict[str, MeasurementRow]:
    """Restore previous names and corrections of newly measured photographs."""
    found = [(one, _find(session, row, one)) for one in given]
    known = [(document, measurement) for document, measurement in found if measurement is not None]
    for _, measurement in known:
        measurement.identifier = f"-{measurement.id}"  # frees identifiers for the others
    session.flush()
    for document, measurement in known:
        for name in (
            "identifier",
            "external_id",
            "created_at",
            "sent_by",
            "corrected_at",
            "forecast_accuracy",
        ):
            setattr(measurement, name, getattr(document, name))
        if document.excluded:
            measurement.accepted, measurement.reason = False, EXCLUDED
        if document.unlike is not None and _unlike(measurement) is None:
            unlike = {"type": UNLIKE_HELIOSTAT, **document.unlike.model_dump()}
            measurement.warnings = [*(measurement.warnings or ()), unlike]
        for alias in document.aliases:
            if store.find_measurement(session, row, alias) is None:
                session.add(
                    AliasRow(heliostat_id=row.id, identifier=alias, measurement_id=measurement.id)
                )
    corrections = [
        (made, measurement.id) for document, measurement in known for made in document.corrections
    ]
    for made, number in sorted(corrections, key=lambda correction: correction[0].created_at):
        session.add(CorrectionRow(**made.model_dump(), measurement_id=number))
    session.flush()
    return {document.identifier: measurement for document, measurement in known}
