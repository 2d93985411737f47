"""Surfaces from stored measurements."""

from collections.abc import Callable, Sequence

from sqlalchemy.orm import Session

from model.observation import SurfacePrediction
from service import store
from service.store import audit
from service.store.keys import RESERVED
from service.store.surfaces import NewSurface
from service.store.tables import MeasurementRow, SurfaceRow
from service.twin import versions
from service.twin.compute import Method
from service.twin.evidence import choose_measurements, load_heliostat, named_measurements, observation_of
from service.twin.runtime import Runtime
from service.twin.versions import PlantModel


def predict_surface(
    runtime: Runtime,
    heliostat_name: str,
    method: "Method" = "network",
    measurements: Sequence[str] | None = None,
    images: int = 8,
    actor: str = RESERVED,
    also: Callable[[Session, SurfaceRow], None] | None = None,
    model_version: int | None = None,
) -> SurfaceRow:
    """Predict a heliostat's surface from stored measurements and keep it as its next version.

    It is valid from when the newest of its images was taken, where that is known, else from now. ``actor`` is who
    asked for it. ``also`` writes in the same transaction; what it raises undoes the surface too. ``model_version`` is
    the plant's model that explains the images, by default the current one.

    Raises
    ------
    NotFoundError, ConflictError
        Where the heliostat, a measurement or the model is not stored, or no measurement is accepted.
    """
    with runtime.database.reading() as session:
        row = store.get_heliostat(session, heliostat_name)
        origin = store.get_plant(session).origin
        heliostat = load_heliostat(session, row)
        if measurements is None:
            measurements = [measurement.identifier for measurement in choose_measurements(session, row, images)]
        chosen = named_measurements(session, row, measurements)
        model = versions.get_model(session, model_version)
    observations = [observation_of(measurement, origin) for measurement in chosen]
    with runtime.computing(f"predict_{method}") as operations:
        predicted = operations.predict(heliostat, observations, method, model.optics, model.effects)
    with runtime.database.writing() as session:
        row = store.get_heliostat(session, heliostat_name)
        used = [store.get_measurement(session, row, name) for name in predicted.used]
        surface, _ = store.add_surface(session, row, _new_surface(method, model, predicted, used))
        about = {"version": surface.version, "model": model.version}
        audit.record(session, actor, "surface.predicted", f"heliostat {heliostat_name}", **about)
        if also is not None:
            also(session, surface)
        return surface


def _new_surface(
    method: str, model: PlantModel, predicted: "SurfacePrediction", used: list[MeasurementRow]
) -> NewSurface:
    return NewSurface(
        source=method,
        z=predicted.z,
        z_std=predicted.z_std,
        control_points=predicted.control_points,
        valid_from=max((row.taken_at for row in used if row.taken_at is not None), default=None),
        model=predicted.weights,
        model_version=model.version,
        measurements=used,
        misfit=predicted.misfit,
    )
