"""Deletion of wrongly sent photographs and everything that only they need."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.store import audit
from service.store.photographs import image_retention
from service.store.photographs.correction_log import delete_drift, made_from, note_change
from service.store.photographs.measurements import get_measurement, images_of_photograph
from service.store.plant.geometry import get_heliostat
from service.store.rows import lock_heliostat
from service.store.tables import (
    AliasRow,
    CorrectionRow,
    MeasurementRow,
    SurfaceRow,
    surface_measurements,
)


@dataclass(frozen=True)
class Deleted:
    """Identifiers of deleted images, and the surfaces and number of forecasts based on them."""

    images: tuple[str, ...]
    surfaces: tuple[int, ...]
    forecasts: int


def delete_photograph(
    session: Session,
    heliostat: str,
    identifier: str,
    reason: str,
    actor: str,
    only_this: bool = False,
) -> Deleted:
    """Delete the photograph of an image in all its kinds, or ``only_this`` image.

    Surfaces from it remain and name it as deleted. Its image files are marked for
    `service.store.photographs.image_retention.remove_marked`.

    Raises
    ------
    NotFoundError
        If the heliostat or measurement is not stored.
    """
    owner = get_heliostat(session, heliostat)
    lock_heliostat(session, owner)
    row = get_measurement(session, owner, identifier)
    derived = made_from(session, row)
    every = [row] if only_this else images_of_photograph(session, row).values()
    rows = sorted(every, key=lambda image: image.id)  # in the order in which they came
    _name_in_surfaces(session, rows)
    delete_drift(session, rows)
    numbers = [image.id for image in rows]
    session.execute(delete(CorrectionRow).where(CorrectionRow.measurement_id.in_(numbers)))
    session.execute(delete(AliasRow).where(AliasRow.measurement_id.in_(numbers)))
    subject = f"heliostat {heliostat} {row.identifier}"
    audit.record(
        session,
        actor,
        "measurement.deleted",
        subject,
        reason=reason,
        images=[_about(image) for image in rows],
    )
    note_change(session, owner.id)
    for image in rows:
        session.delete(image)
    session.flush()
    for sha256 in sorted({image.image_sha256 for image in rows if image.image_sha256 is not None}):
        image_retention.mark_unused(session, sha256)
    return Deleted(tuple(image.identifier for image in rows), derived.surfaces, derived.forecasts)


def _name_in_surfaces(session: Session, rows: Sequence[MeasurementRow]) -> None:
    """Replace the references of surfaces to these images by the names of deleted photographs."""
    links, identifiers = surface_measurements.c, {row.identifier for row in rows}
    names = {row.external_id or row.identifier for row in rows}
    of = links.measurement_id.in_([row.id for row in rows])
    made = select(SurfaceRow).where(SurfaceRow.id.in_(select(links.surface_id).where(of)))
    for surface in session.scalars(made):
        surface.deleted = sorted({*(surface.deleted or ()), *names})
        surface.suspicious = surface.suspicious and [
            name for name in surface.suspicious if name not in identifiers
        ]
    session.flush()
    session.execute(delete(surface_measurements).where(of))


def _about(row: MeasurementRow) -> dict[str, object]:
    """Description of an image in the audit trail."""
    return {
        "id": row.identifier,
        "external_id": row.external_id,
        "kind": row.kind,
        "sha256": row.image_sha256,
    }
