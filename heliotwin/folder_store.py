"""A measurement folder as a temporary store, so that verbs compute as the service does."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import delete, select
from sqlalchemy.orm import Session, undefer

from model.camera_choice import DECLARATIONS, CameraChoice
from model.effects import Effect, effect_to_json
from model.errors import InvalidInputError, ModelError
from model.imaging import ImageKind
from model.plant import Receiver
from model.pointing.report import mount_from_json, sun_to_json
from service import store
from service.base.choices import Selection
from service.base.errors import SKIPPED
from service.base.fields import Sun
from service.base.progress import Progress, no_progress
from service.base.settings import Settings
from service.sources.documents import IMAGE_KINDS, get, read_json
from service.sources.files import read_file
from service.sources.folder import MeasuredSurface, MeasurementFolder, measured_heights, points_of
from service.store import mounts
from service.store.columns import Base
from service.store.image_files import digest, media_type
from service.store.keys import RESERVED
from service.store.tables import NO_IMAGE, HeliostatRow, ImageRow, MeasurementRow, PlantRow
from service.twin import model_versions, plant_setup
from service.twin.forecasts.heliostat_forecast import aimed_setup, trace_flux
from service.twin.measurements import HeliostatContext, load_heliostat_context
from service.twin.model_versions import ModelVersion
from service.twin.operations import Forecast
from service.twin.photographs.ingest import measure_photograph, measurement_row, position_row
from service.twin.photographs.metadata import find_sun_contradictions
from service.twin.runtime import Runtime
from service.twin.studies.cameras import KINDS, StoredMirror, find_camera
from service.twin.studies.study import StudyInputs, add_photographs

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ForecastTarget:
    """A sun and the plane or receiver that the flux falls on.

    ``at`` is the time that gave the sun, or None if its position was given. ``heliostats`` are
    names, all if empty. ``aim`` (3,) [m] and ``dni_w_m2`` are by default the receiver's and the
    model's.
    """

    sun: Sun
    receiver: Receiver
    at: datetime | None = None
    heliostats: Sequence[str] = ()
    aim: Array | None = None
    dni_w_m2: float | None = None
    resolution: tuple[int, int] = (256, 256)


@dataclass(frozen=True, eq=False)
class FolderStore:
    """The contents of a measurement folder in a temporary store.

    Attributes
    ----------
    folder : MeasurementFolder
    runtime : Runtime
        Its store has measurements and their fluxes, but not the image files.
    session : Session
        Reads the store.
    refused : dict
        Measurements whose image could not be read, with the reasons, by ``heliostat/id``. They are
        stored without an image.
    camera : CameraChoice or None
        Chosen by the images without background; None if a camera is declared, or nothing judges.
    """

    folder: MeasurementFolder
    runtime: Runtime
    session: Session
    refused: dict[str, str] = field(default_factory=dict)
    camera: CameraChoice | None = None

    @property
    def model(self) -> ModelVersion:
        """The declared model with the effects that were added to it."""
        return model_versions.get_model(self.session)

    @property
    def names(self) -> list[str]:
        """Names of the stored heliostats."""
        return [name for name in self.folder.plant.heliostats if name not in self.folder.skipped]

    def context(self, heliostat: str) -> HeliostatContext:
        """A stored heliostat on its newest mount, with the model."""
        return load_heliostat_context(self.session, heliostat)

    def measurements(self, heliostat: str) -> Sequence[MeasurementRow]:
        """Stored measurements of a heliostat by identifier, each with its first image's arrays."""
        row, owner = MeasurementRow, store.get_heliostat(self.session, heliostat)
        query = select(row).where(row.heliostat_id == owner.id, row.identifier == row.external_id)
        return self.session.scalars(query.order_by(row.id).options(undefer(row.arrays))).all()

    def photographs(self, heliostat: str) -> Selection[MeasurementRow]:
        """A heliostat's accepted photographs, and why others were refused, by identifier."""
        rows = self.measurements(heliostat)
        refused = {
            row.identifier: f"{row.reason}: {row.quality['detail']}"
            for row in rows
            if not row.accepted
        }
        for row in rows:
            if (reason := self.refused.get(f"{heliostat}/{row.identifier}")) is not None:
                refused[row.identifier] = reason
        return Selection([row for row in rows if row.accepted and row.kind != NO_IMAGE], refused)

    def trace(
        self, heliostat: str, surface: MeasuredSurface | None, wanted: ForecastTarget
    ) -> Forecast:
        """Trace the flux of a heliostat with a surface, or with the ideal one for None."""
        twin = self.context(heliostat)
        points, degree = points_of(twin.heliostat, surface)
        setup = aimed_setup(twin.heliostat, points, wanted.sun, wanted.at, wanted.receiver, degree)
        setup = setup if wanted.aim is None else replace(setup, aim=wanted.aim)
        model = twin.model if wanted.dni_w_m2 is None else twin.model.with_dni(wanted.dni_w_m2)
        return trace_flux(self.runtime, setup, model, wanted.receiver, wanted.resolution)

    def study_inputs(
        self, mirrors: Iterable[tuple[str, Array, int, Collection[str]]], skipped: dict[str, str]
    ) -> StudyInputs:
        """Photographs for a study, and what is left out in addition to ``skipped``.

        ``mirrors`` are names of heliostats, control points (F, I, J, 3) [m], degrees, and
        identifiers of the photographs that the mirrors were predicted from. With calibrated mounts,
        a photograph that is newer than them also has the pointing from its motors.
        """
        inputs = StudyInputs(skipped=skipped)
        for name, points, degree, seen in mirrors:
            rows, refused = self.photographs(name)
            skipped.update({f"{name}/{key}": reason for key, reason in refused.items()})
            add_photographs(self.session, inputs, self.context(name), rows, points, degree, seen)
        return inputs

    def clocks(self) -> dict[str, str]:
        """Contradictions between time and sun, with the likely reasons, by ``heliostat/id``."""
        row = MeasurementRow
        query = select(HeliostatRow.name, row.identifier, row.quality).join(
            HeliostatRow, HeliostatRow.id == row.heliostat_id
        )
        return {
            f"{name}/{identifier}": quality["clock"]
            for name, identifier, quality in self.session.execute(query.order_by(row.id))
            if quality["clock"]
        }


@contextmanager
def open_folder(
    folder: MeasurementFolder,
    kinds: Sequence[ImageKind] | None = IMAGE_KINDS,
    effects: Sequence[Effect] = (),
    mounts_file: Path | None = None,
    progress: Progress = no_progress,
    with_camera: bool = True,
) -> Iterator[FolderStore]:
    """Import a folder into a temporary store, which is deleted at the end.

    Of each measurement the first image of ``kinds`` is measured; None leaves out all measurements.
    ``effects`` are added to the declared ones. ``mounts_file`` is a file of `heliotwin calibrate`.
    If no camera is declared, images without background choose it (`model.camera_choice`), except
    without ``with_camera``.

    Raises
    ------
    InvalidInputError
        If the file of mounts is invalid.
    """
    known = (
        {} if mounts_file is None else read_mounts(mounts_file, [*folder.model.effects, *effects])
    )
    with TemporaryDirectory(prefix="heliotwin-") as directory:
        # Without validation: the environment configures the service's store, not this one.
        settings = Settings.model_construct(
            data_dir=Path(directory), networks_dir=folder.root / "networks", max_image_bytes=2**30
        )
        with closing(Runtime.from_settings(settings)) as runtime:
            Base.metadata.create_all(runtime.database.engine)
            _store_plant(runtime, folder, effects, known)
            refused: dict[str, str] = {}
            for name in folder.plant.heliostats if kinds is not None else ():
                if name not in folder.skipped:
                    refused |= _store_measurements(runtime, folder, name, kinds or (), progress)
            camera = None
            if with_camera and kinds and "cameras" not in folder.declared():
                with runtime.database.reading() as session:
                    mirrors = _mirrors(FolderStore(folder, runtime, session, refused))
                    model = model_versions.get_model(session)
                camera = find_camera(runtime, model, mirrors.values())
                if camera is not None and camera.answer == "srgb":
                    _declare_counts(runtime, mirrors)
                    for name in mirrors:
                        refused |= _store_measurements(runtime, folder, name, kinds, no_progress)
            with runtime.database.reading() as session:
                yield FolderStore(folder, runtime, session, refused, camera)


def _mirrors(opened: FolderStore) -> dict[str, StoredMirror]:
    """Heliostats with images without background, by name, with their measured surfaces."""
    mirrors = {}
    for name in opened.names:
        rows = [row for row in opened.photographs(name)[0] if row.kind in KINDS]
        if rows:
            twin, surface = opened.context(name), None
            with suppress(ModelError):  # the verb names it if it needs the surface
                surface = opened.folder.measured_surface(name)
            z = None if surface is None else measured_heights(twin.heliostat, surface)
            mirrors[name] = StoredMirror(twin, rows, z)
    return mirrors


def _declare_counts(runtime: Runtime, mirrors: Mapping[str, StoredMirror]) -> None:
    """Declare differences of sRGB counts, and delete the measurements of ``mirrors``."""
    owners = [mirror.twin.row.id for mirror in mirrors.values()]
    with runtime.database.writing() as session:
        plant = session.get_one(PlantRow, 1)
        plant.declared = (plant.declared or {}) | DECLARATIONS["srgb"]
        session.execute(delete(MeasurementRow).where(MeasurementRow.heliostat_id.in_(owners)))


def read_mounts(path: Path, effects: Sequence[Effect]) -> dict[str, Any]:
    """Read the mounts of a file of `heliotwin calibrate`: their documents by heliostat.

    ``effects`` are those of the model that the mounts will be used with.

    Raises
    ------
    InvalidInputError
        If the file is invalid, or its mounts were calibrated with other sun effects than the
        model's.
    """
    documents = get(read_json(path), str(path), "heliostats")
    if not isinstance(documents, dict):
        raise InvalidInputError(f"{path}: 'heliostats' must be a JSON object")
    for name, document in documents.items():
        mount_from_json(document, f"{path}, {name}")
    if any(document.get("sun", []) != sun_to_json(effects) for document in documents.values()):
        raise InvalidInputError(
            f"{path}: its mounts were calibrated under another sun than this model has; declare"
            " what moves the sun in twin.json, and calibrate again"
        )
    return documents


def _store_plant(
    runtime: Runtime, folder: MeasurementFolder, effects: Sequence[Effect], known: dict[str, Any]
) -> None:
    """Store the plant, its model, its heliostats and their calibrated mounts."""
    plant, declared = folder.plant, folder.declared()
    every = [effect_to_json(effect) for effect in (*folder.model.effects, *effects)]
    declared = declared | ({"effects": every} if every else {})
    by = plant_setup.Authorship(RESERVED)
    with runtime.database.writing() as session:
        plant_setup.set_plant(session, by, plant, declared, facts=folder.facts)
        for name in plant.heliostats:
            try:
                row, _ = plant_setup.set_heliostat(session, by, name, folder.properties[name])
            except SKIPPED as error:
                folder.skipped[name] = str(error)
                continue
            if name in known:  # without a beginning, it is valid also before now
                mounts.add_mount(session, row, known[name] | {"valid_from": None})


def _store_measurements(
    runtime: Runtime,
    folder: MeasurementFolder,
    name: str,
    kinds: Sequence[ImageKind],
    progress: Progress,
) -> dict[str, str]:
    """Store a heliostat's measurements in one transaction, each with one image at most.

    Return the measurements whose image could not be read, with the reasons.
    """
    measurements = folder.measurements(name, with_images=False)
    photographs = [
        one.photograph(next((kind for kind in kinds if kind in one.images), None))
        for one in measurements
    ]
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, name)
        targets = {row.name: row for row in store.list_targets(session)}
    suns = find_sun_contradictions(photographs, twin.origin)
    images: dict[str, ImageRow] = {}
    rows, refused = [], {}
    for measurement, photograph, sun in zip(measurements, photographs, suns, strict=True):
        progress(measurement.key)
        target = targets[measurement.target]
        row = position_row(measurement, target.id, sun)
        if photograph.kind is not None:
            file = measurement.images[photograph.kind]
            try:
                data, plane = read_file(file), store.target_plane(target)
                image = ImageRow(
                    sha256=digest(data), media_type=media_type(data), size_bytes=len(data)
                )
                if image.sha256 in images:
                    raise InvalidInputError("it is the image of another measurement")
                pixels, measured = measure_photograph(
                    runtime, photograph, data, plane, twin.model.cameras
                )
            except SKIPPED as error:
                said = str(error)
                refused[measurement.key] = said if str(file) in said else f"{file}: {said}"
            else:
                row = measurement_row(photograph, measured, target.id, sun)
                row.image_sha256 = image.sha256
                image.height_px, image.width_px = pixels.shape[:2]
                images[image.sha256] = image
        row.heliostat_id, row.identifier = twin.row.id, measurement.external_id
        rows.append(row)
    with runtime.database.writing() as session:
        # Another heliostat may have the same image.
        session.add_all(one for one in images.values() if not session.get(ImageRow, one.sha256))
        session.flush()
        session.add_all(rows)
    return refused
