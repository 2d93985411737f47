"""Corrections of photographs, and the results that depend on them."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from service.store.columns import now
from service.store.photographs.measurements import images_of_photograph
from service.store.tables import (
    CorrectionRow,
    DriftRow,
    ForecastRow,
    HeliostatRow,
    MeasurementRow,
    SurfaceRow,
    surface_measurements,
)


@dataclass(frozen=True)
class MadeFrom:
    """Surface versions from a photograph, and the number of forecasts with these surfaces."""

    surfaces: tuple[int, ...]
    forecasts: int


def made_from(session: Session, measurement: MeasurementRow) -> MadeFrom:
    """Find the results that depend on a photograph, from any of its images."""
    links, images = surface_measurements.c, images_of_photograph(session, measurement).values()
    of = select(links.surface_id).where(links.measurement_id.in_([image.id for image in images]))
    versions = session.scalars(
        select(SurfaceRow.version).where(SurfaceRow.id.in_(of)).order_by(SurfaceRow.version)
    )
    forecasts = select(func.count()).select_from(ForecastRow).where(ForecastRow.surface_id.in_(of))
    return MadeFrom(tuple(versions), session.scalars(forecasts).one())


def list_corrections(
    session: Session, measurement: MeasurementRow, after: int = 0
) -> Sequence[CorrectionRow]:
    """The corrections of a photograph after number ``after``, oldest first."""
    query = select(CorrectionRow).where(
        CorrectionRow.measurement_id == measurement.id, CorrectionRow.id > after
    )
    return session.scalars(query.order_by(CorrectionRow.id)).all()


def newest_correction(session: Session, measurement: MeasurementRow | None = None) -> int:
    """Number of the newest correction of a photograph, or of all: the version of what is shown.

    Read it before what is shown.
    """
    query = select(func.max(CorrectionRow.id))
    if measurement is not None:
        images = images_of_photograph(session, measurement).values()
        query = query.where(CorrectionRow.measurement_id.in_([image.id for image in images]))
    return session.scalar(query) or 0


def delete_drift(session: Session, measurements: Sequence[MeasurementRow]) -> None:
    """Delete the accuracies on arrival of photographs, because their metadata were wrong."""
    for measurement in measurements:
        measurement.forecast_accuracy = None
    numbers = [measurement.id for measurement in measurements]
    session.execute(delete(DriftRow).where(DriftRow.measurement_id.in_(numbers)))


def note_change(session: Session, heliostat: int) -> None:
    """Record that photographs of a heliostat (a row id) changed, so that results are recomputed."""
    row = HeliostatRow
    # ``updated_at`` remains, because it decides whether the calibrated mount applies.
    values = {"photographs_changed_at": now(), "updated_at": row.updated_at}
    session.execute(update(row).where(row.id == heliostat).values(values))
