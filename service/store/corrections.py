"""Corrections of photographs: what was changed, and what had been made from them."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.store.measurements import images_of_shot
from service.store.tables import CorrectionRow, DriftRow, ForecastRow, MeasurementRow, SurfaceRow, surface_measurements


@dataclass(frozen=True)
class MadeFrom:
    """Versions of surfaces that were made from a photograph, and how many forecasts were made with those."""

    surfaces: tuple[int, ...]
    forecasts: int


def made_from(session: Session, measurement: MeasurementRow) -> MadeFrom:
    """What was made from a photograph, from whichever of its images."""
    links, images = surface_measurements.c, images_of_shot(session, measurement).values()
    of = select(links.surface_id).where(links.measurement_id.in_([image.id for image in images]))
    versions = session.scalars(select(SurfaceRow.version).where(SurfaceRow.id.in_(of)).order_by(SurfaceRow.version))
    forecasts = select(func.count()).select_from(ForecastRow).where(ForecastRow.surface_id.in_(of))
    return MadeFrom(tuple(versions), session.scalars(forecasts).one())


def list_corrections(session: Session, measurement: MeasurementRow) -> Sequence[CorrectionRow]:
    """What was corrected of a photograph, the first correction first."""
    query = select(CorrectionRow).where(CorrectionRow.measurement_id == measurement.id)
    return session.scalars(query.order_by(CorrectionRow.id)).all()


def forget_drift(session: Session, measurement: MeasurementRow) -> None:
    """What a photograph said of the twin when it came, it said wrongly."""
    measurement.forecast_accuracy = None
    session.execute(delete(DriftRow).where(DriftRow.measurement_id == measurement.id))
