"""What an export keeps beside PAINT's layout, and an import brings back: how things came to be what they are.

``history/plant.json`` holds the versions of the plant's model with their studies, ``history/heliostats/H/history.json``
a heliostat's photographs as they came, with corrections, every version of its surface (arrays in ``surface-N.npz``
beside it) with what was decided of it, and its mounts. The images of excluded photographs lie there, too: in PAINT's
place whoever reads the folder would use them.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any
from zipfile import BadZipFile

import numpy as np
from pydantic import Field, ValidationError, create_model
from sqlalchemy import select
from sqlalchemy.orm import Session, undefer

from model.errors import InvalidInputError
from model.imaging import ImageKind
from service import store
from service.base.arrays import unpack
from service.base.wording import told
from service.sources.files import require_regular
from service.store import audit
from service.store.measurements import EXCLUDED, find_measurement_of_image
from service.store.records import many, read, record
from service.store.tables import (
    CorrectionRow,
    DecisionRow,
    HeliostatRow,
    MeasurementRow,
    ModelRow,
    MountRow,
    PlantRow,
    StudyRow,
    SurfaceRow,
)

FOLDER = "history"

# What is measured in an image is not told: whoever has the image measures it.
_MEASURED = ("accepted", "reason", "quality", "center_right_m", "center_up_m")
_FILE = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,160}$")]

_Correction = record(CorrectionRow)
_Photograph = record(
    MeasurementRow,
    _MEASURED,
    kind=(ImageKind, ...),
    target=(str, ...),
    image=(_FILE, ...),
    excluded=(bool, ...),
    corrections=(many(_Correction), ...),
)
_Surface = record(SurfaceRow, photographs=(list[str], ...))
_Decision = record(DecisionRow, version=(int, ...))
_Mount = record(MountRow)
_History = create_model(
    "History",
    photographs=(many(_Photograph), ...),
    surfaces=(many(_Surface), ...),
    decisions=(many(_Decision), ...),
    mounts=(many(_Mount), ...),
)
_Study = record(StudyRow, number=(Annotated[int, Field(ge=1)], ...))
_Model = record(ModelRow, study=(int | None, ...))
_Models = create_model(
    "Models", declared=(dict[str, Any] | None, ...), studies=(many(_Study), ...), models=(many(_Model), ...)
)


def _load(path: Path, kind: Any) -> Any:
    try:
        return kind.model_validate_json(require_regular(path).read_bytes())
    except ValidationError as error:
        raise InvalidInputError(f"{path}: {told(error)}; export the folder anew") from None


# --- the plant's model ------------------------------------------------------------------------------------------------


PLANT = f"{FOLDER}/plant.json"
"""Where the versions of the plant's model are; a folder that did not come of an export has none."""


def plant_history(session: Session) -> Any:
    """The declared model, all studies, and all versions of the model that came after the first."""
    studies = session.scalars(select(StudyRow).order_by(StudyRow.id)).all()
    models = session.scalars(select(ModelRow).order_by(ModelRow.number)).all()
    return _Models(
        declared=store.get_plant(session).declared,
        studies=[read(_Study, row, number=row.id) for row in studies],
        models=[read(_Model, row, study=row.study_id) for row in models],
    )


def restore_plant(session: Session, root: Path, actor: str) -> bool:
    """Bring back the versions of the plant's model; False where they are there already.

    Raises
    ------
    InvalidInputError
        Where the store has a model, studies or heliostats of its own, which name other versions.
    """
    given, plant = _load(root / PLANT, _Models), session.get_one(PlantRow, 1)
    numbers = {study.number: place for place, study in enumerate(given.studies)}
    if unknown := {model.study for model in given.models} - {None, *numbers}:
        raise InvalidInputError(f"a model is of study {min(unknown)}, which is missing; export the folder anew")
    there = plant_history(session)
    if _alike(there, given):
        return False
    if there.studies or there.models or session.scalar(select(HeliostatRow.id).limit(1)) is not None:
        raise InvalidInputError(
            "the store has versions of the plant's model of its own, which stay; use an empty store"
        )
    plant.declared = given.declared
    rows = [StudyRow(**study.model_dump(exclude={"number"})) for study in given.studies]
    for row in rows:
        session.add(row)
        session.flush()  # in their order
    for model in given.models:
        study = None if model.study is None else rows[numbers[model.study]].id
        session.add(ModelRow(**model.model_dump(exclude={"study"}), study_id=study))
    audit.record(session, actor, "plant.history_imported", f"plant {plant.name}", models=len(given.models))
    return True


def _alike(one: Any, other: Any) -> bool:
    """Whether two are the same but for the numbers of studies, which each store gives."""

    def counted(models: Any) -> Any:
        places = {study.number: place for place, study in enumerate(models.studies)}
        studies = [study.model_dump(exclude={"number"}) for study in models.studies]
        versions = [model.model_dump() | {"study": places.get(model.study)} for model in models.models]
        return models.declared, studies, versions

    return bool(counted(one) == counted(other))


# --- a heliostat ------------------------------------------------------------------------------------------------------


def heliostat_folder(name: str) -> str:
    """Where a heliostat's history is, below the root."""
    return f"{FOLDER}/heliostats/{name}"


HISTORY = "history.json"


def surface_file(version: int) -> str:
    """What holds the arrays of a version of a surface."""
    return f"surface-{version}.npz"


def image_folder(name: str, excluded: bool) -> str:
    """Where the images of photographs are, below the root."""
    return heliostat_folder(name) if excluded else f"{name}/Calibration"


def heliostat_history(session: Session, row: HeliostatRow, images: Mapping[str, str]) -> Any:
    """All of a heliostat but what can be made again; ``images`` are the files of its photographs by their identifiers.

    Photographs without one are left out.
    """
    corrections: dict[int, list[CorrectionRow]] = {}
    made = select(CorrectionRow).join(MeasurementRow).where(MeasurementRow.heliostat_id == row.id)
    for correction in session.scalars(made.order_by(CorrectionRow.id)):
        corrections.setdefault(correction.measurement_id, []).append(correction)
    of_heliostat = [row for row in store.list_measurements(session, row, None) if row.identifier in images]
    decided = select(DecisionRow).where(DecisionRow.heliostat_id == row.id).order_by(DecisionRow.id)
    mounts = select(MountRow).where(MountRow.heliostat_id == row.id).options(undefer(MountRow.document))
    return _History(
        photographs=[
            read(
                _Photograph,
                one,
                target=one.target.name,
                image=images[one.identifier],
                excluded=one.reason == EXCLUDED,
                corrections=[read(_Correction, correction) for correction in corrections.get(one.id, ())],
            )
            for one in of_heliostat
        ],
        surfaces=[
            read(_Surface, one, photographs=[m.identifier for m in one.measurements if m.identifier in images])
            for one in store.list_surfaces(session, row, None)
        ],
        decisions=[read(_Decision, one, version=one.surface.version) for one in session.scalars(decided)],
        mounts=[read(_Mount, one) for one in session.scalars(mounts.order_by(MountRow.version))],
    )


def load_heliostat(root: Path, name: str) -> Any:
    """A heliostat's history; None in a folder that did not come of an export. InvalidInputError names what is wrong."""
    path = root / heliostat_folder(name) / HISTORY
    return _load(path, _History) if path.exists() else None


def image_path(root: Path, name: str, photograph: Any) -> Path:
    """Where a photograph's image is."""
    file: str = photograph.image
    return root / image_folder(name, photograph.excluded) / file


def restore_heliostat(session: Session, row: HeliostatRow, given: Any, root: Path, actor: str) -> bool:
    """Bring back all but the images, which are there; False where nothing is missing.

    Raises
    ------
    InvalidInputError
        Where the store has surfaces, decisions or mounts of its own, or other photographs; or where arrays are missing.
    """
    files = {document.identifier: document.image for document in given.photographs}
    there = heliostat_history(session, row, files)
    if there == given:
        return False
    if there.surfaces or there.decisions or there.mounts:
        raise InvalidInputError("the store has surfaces or mounts of its own, which stay; use an empty store")
    photographs = _restore_photographs(session, row, given.photographs)
    versions: dict[int, SurfaceRow] = {}
    for one in given.surfaces:
        versions[one.version] = SurfaceRow(
            **one.model_dump(exclude={"photographs"}),
            heliostat_id=row.id,
            arrays=_read_arrays(root / heliostat_folder(row.name) / surface_file(one.version)),
            measurements=[photographs[name] for name in one.photographs if name in photographs],
        )
        session.add(versions[one.version])
    session.flush()
    for one in given.decisions:
        if one.version not in versions:
            raise InvalidInputError(f"a decision is of version {one.version}, which is missing; export the folder anew")
        surface = versions[one.version].id
        session.add(DecisionRow(**one.model_dump(exclude={"version"}), heliostat_id=row.id, surface_id=surface))
    session.add_all(MountRow(**one.model_dump(), heliostat_id=row.id) for one in given.mounts)
    about = {"surfaces": len(given.surfaces), "photographs": len(photographs)}
    audit.record(session, actor, "heliostat.history_imported", f"heliostat {row.name}", **about)
    return True


_ARRAYS = {"z": (4, 8, 8), "z_std": (4, 8, 8), "control_points": (4, 8, 8, 3)}


def _read_arrays(path: Path) -> bytes:
    """The arrays of a surface as they are stored; InvalidInputError where they are none."""
    data = require_regular(path).read_bytes()
    try:
        shapes = {name: array.shape for name, array in unpack(data).items() if np.isfinite(array).all()}
    except (BadZipFile, ValueError, TypeError) as error:
        raise InvalidInputError(f"{path}: no npz of numbers ({error}); export the folder anew") from None
    if shapes != _ARRAYS:
        raise InvalidInputError(f"{path}: must hold finite {_ARRAYS}, got {shapes}; export the folder anew")
    return data


def _restore_photographs(session: Session, row: HeliostatRow, given: list[Any]) -> dict[str, MeasurementRow]:
    """Photographs that were just measured, under the names that they had, with their corrections."""
    found = [(one, find_measurement_of_image(session, row, one.image_sha256, one.kind)) for one in given]
    known = [(document, measurement) for document, measurement in found if measurement is not None]
    for _, measurement in known:
        measurement.identifier = f"-{measurement.id}"  # none that another one shall have
    session.flush()
    for document, measurement in known:
        for name in ("identifier", "external_id", "created_at", "corrected_at", "forecast_accuracy"):
            setattr(measurement, name, getattr(document, name))
        if document.excluded:
            measurement.accepted, measurement.reason = False, EXCLUDED
    corrections = [(made, measurement.id) for document, measurement in known for made in document.corrections]
    for made, number in sorted(corrections, key=lambda correction: correction[0].made_at):
        session.add(CorrectionRow(**made.model_dump(), measurement_id=number))
    session.flush()
    return {document.identifier: measurement for document, measurement in known}
