"""Drift: how well the current twin forecasts each photograph that comes.

An accuracy that falls over the weeks says that the mirror, or the camera, has changed. Each heliostat's newest one is
kept; Prometheus keeps their history.
"""

import logging

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from model.errors import ModelError
from service import store
from service.accuracy import compare_measurements
from service.meters import ACCURACY
from service.runtime import Runtime
from service.tables import DriftRow, MeasurementRow, SurfaceRow

logger = logging.getLogger("heliotwin.service")


def judge(runtime: Runtime, heliostat: str, measurement: MeasurementRow) -> float | None:
    """Hold an accepted photograph, loaded with its arrays, against the heliostat's current surface, and note it.

    The accuracy [1]; None where the heliostat has no surface, or it cannot be told, which the log explains: the
    photograph is stored already, and what watches over it must not refuse it.
    """
    try:
        return _judge(runtime, heliostat, measurement)
    except (ModelError, SQLAlchemyError) as error:
        logger.warning("the drift of heliostat %s cannot be told: %s", heliostat, error)
    except Exception:  # whatever it is, the photograph is stored, and its sender must be told so
        logger.exception("the drift of heliostat %s cannot be told", heliostat)
    return None


def _judge(runtime: Runtime, name: str, measurement: MeasurementRow) -> float | None:
    with runtime.database.reading() as session:
        surface = store.find_surface_at(session, store.get_heliostat(session, name))
    if surface is None:
        return None
    (compared,) = compare_measurements(runtime, name, [measurement], surface)
    ACCURACY.observe(compared.accuracy)
    with runtime.database.writing() as session:
        _note(session, measurement, surface, compared.accuracy)
    return compared.accuracy


def _note(session: Session, measurement: MeasurementRow, surface: SurfaceRow, accuracy: float) -> None:
    """Keep it as the heliostat's, unless that of a photograph that was taken later stands there."""
    new = DriftRow(
        heliostat_id=measurement.heliostat_id,
        measurement_id=measurement.id,
        surface_id=surface.id,
        taken_at=measurement.taken_at or measurement.created_at,
        accuracy=accuracy,
    )
    held = session.get(DriftRow, measurement.heliostat_id, with_for_update=True)
    if held is None and store.insert(session, new):
        return
    held = held or session.get_one(DriftRow, measurement.heliostat_id, with_for_update=True)
    if held.taken_at <= new.taken_at:
        session.merge(new)
