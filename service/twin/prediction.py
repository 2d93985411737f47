"""Surfaces from stored measurements: computed outside any transaction, kept in the caller's."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from model.observation import Observation, SurfacePrediction
from service import store
from service.base.choices import Method
from service.store import NewSurface, audit
from service.store.keys import RESERVED
from service.store.tables import MeasurementRow, SurfaceRow
from service.twin.consensus import agreeing
from service.twin.evidence import Twin, choose, choose_measurements, evidence_of, load_twin, named_measurements
from service.twin.runtime import Operations, Runtime

# Candidates for each image that is wanted: some may contradict the others.
_SPARE = 2


@dataclass(frozen=True, eq=False)
class Predicted:
    """A surface that is not kept yet."""

    twin: Twin
    method: Method
    surface: SurfacePrediction


def compute_surface(
    runtime: Runtime,
    heliostat: str,
    method: Method = "network",
    measurements: Sequence[str] | None = None,
    images: int = 8,
    model_version: int | None = None,
) -> Predicted:
    """A heliostat's surface from named measurements, else from up to ``images`` chosen ones.

    ``model_version`` is the plant's model that explains the images, by default the current one.

    Raises
    ------
    NotFoundError, ConflictError
        Where the heliostat, a measurement or the model is not stored, or no measurement is accepted.
    """
    with runtime.database.reading() as session:
        twin = load_twin(session, heliostat, model_version)
        names = measurements
        if names is None:
            names = [row.identifier for row in choose_measurements(session, twin.row, images, spare=_SPARE)]
        rows = named_measurements(session, twin.row, names)
    with runtime.computing(f"predict_{method}") as operations:
        if measurements is None:
            observations = _chosen(operations, twin, rows, images)
        else:
            observations = [evidence_of(row, twin.origin).observation() for row in rows]
        surface = operations.predict(
            twin.heliostat,
            observations,
            method,
            twin.model.optics,
            twin.model.effects,
            latitude_deg=twin.origin[0],
        )
    return Predicted(twin, method, surface)


def _chosen(operations: Operations, twin: Twin, rows: Sequence[MeasurementRow], images: int) -> list[Observation]:
    """Up to ``images`` of what the candidates show, without those that contradict the others."""
    in_time = sorted(rows, key=lambda row: row.taken_at or row.created_at)
    observations = [evidence_of(row, twin.origin).observation() for row in in_time]
    model = twin.model.optics, twin.model.effects
    kept, _ = agreeing(operations, twin.heliostat, observations, *model, latitude_deg=twin.origin[0])
    return choose(kept[::-1], images)


def keep_surface(session: Session, predicted: Predicted, actor: str) -> SurfaceRow:
    """Keep a predicted surface as its heliostat's next version; ``actor`` is who asked for it.

    It is valid from when the newest of its images was taken, where that is known, else from now.
    """
    heliostat, surface = predicted.twin.row, predicted.surface
    used = store.get_measurements(session, heliostat, surface.used)
    new = NewSurface(
        source=predicted.method,
        z=surface.z,
        z_std=surface.z_std,
        control_points=surface.control_points,
        valid_from=max((row.taken_at for row in used if row.taken_at is not None), default=None),
        model=surface.weights,
        model_version=predicted.twin.model.version,
        measurements=used,
        misfit=surface.misfit,
    )
    row, _ = store.add_surface(session, heliostat, new)
    about = {"version": row.version, "model": new.model_version}
    audit.record(session, actor, "surface.predicted", f"heliostat {heliostat.name}", **about)
    return row


def predict_surface(
    runtime: Runtime,
    heliostat: str,
    method: Method = "network",
    measurements: Sequence[str] | None = None,
    images: int = 8,
    actor: str = RESERVED,
    model_version: int | None = None,
) -> SurfaceRow:
    """`compute_surface`, then `keep_surface` in a transaction of its own."""
    predicted = compute_surface(runtime, heliostat, method, measurements, images, model_version)
    with runtime.database.writing() as session:
        return keep_surface(session, predicted, actor)
