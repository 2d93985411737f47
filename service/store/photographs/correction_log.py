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


def list_corrections(session: Session, measurement: MeasurementRow) -> Sequence[CorrectionRow]:
    """The corrections of a photograph, oldest first."""
    query = select(CorrectionRow).where(CorrectionRow.measurement_id == measurement.id)
    return session.scalars(query.order_by(CorrectionRow.id)).all()


def delete_drift(session: Session, measurement: MeasurementRow) -> None:
    """Delete the photograph's accuracy on arrival, because its metadata were wrong."""
    measurement.forecast_accuracy = None
    session.execute(delete(DriftRow).where(DriftRow.measurement_id == measurement.id))


def note_change(session: Session, heliostat: int) -> None:
    """Record that photographs of a heliostat (a row id) changed, so that results are recomputed."""
    row = HeliostatRow
    # ``updated_at`` remains, because it decides whether the calibrated mount applies.
    values = {"photographs_changed_at": now(), "updated_at": row.updated_at}
    session.execute(update(row).where(row.id == heliostat).values(values))
