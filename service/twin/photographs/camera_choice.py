"""The camera of a plant's images without background, by what its stored images show."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.camera_choice import CameraChoice, PhotographedMirror, choose_camera
from model.plant_model import PlantModel
from service import store
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow
from service.twin.heliostats.measurements import (
    Array,
    HeliostatContext,
    accepted_measurement,
    choose_diverse,
    heights_of,
    load_heliostat_context,
    to_observations,
)
from service.twin.plant.model_versions import declares_camera
from service.twin.runtime import Runtime

KINDS = ("flux", "flux-centered")
"""Kinds of image whose background was subtracted: photographs are sRGB without a declaration."""

# Most images of a mirror and most mirrors that judge: more change little, and take long.
_IMAGES, _MIRRORS = 8, 12

# Newest photographs of a stored heliostat among which different suns are chosen.
_NEWEST = 4 * _IMAGES


class StoredMirror(NamedTuple):
    """A heliostat, its accepted images of `KINDS`, and measured heights (F, 8, 8) [m] or None."""

    twin: HeliostatContext
    rows: Sequence[MeasurementRow]
    z: Array | None


def find_camera(
    runtime: Runtime, model: PlantModel, mirrors: Iterable[StoredMirror]
) -> CameraChoice | None:
    """Choose the camera of images that were measured as linear light; None if nothing judges them.

    Mirrors with a measured surface come first, then those with the most images. Of others only
    those with a network are predicted.
    """
    with runtime.computing("choose_camera") as operations:
        known = [
            one
            for one in mirrors
            if one.z is not None or operations.has_network(one.twin.heliostat)
        ]
        known.sort(key=lambda one: (one.z is None, -len(one.rows), one.twin.row.name))
        return choose_camera(list(map(_photographed, known[:_MIRRORS])), model, operations.predict)


def read_camera_choice(session: Session) -> dict[str, object] | None:
    """The newest result of the job `camera-choices`; None if cameras are declared."""
    query = select(JobRow.result).where(JobRow.kind == "camera-choices", JobRow.state == "done")
    newest = session.scalar(query.order_by(JobRow.id.desc()).limit(1))
    return None if declares_camera(session) else newest


def _photographed(mirror: StoredMirror) -> PhotographedMirror:
    twin = mirror.twin
    evidence = [accepted_measurement(row, twin.origin) for row in mirror.rows]
    chosen = choose_diverse(to_observations(evidence, twin.heliostat), _IMAGES)
    return PhotographedMirror(twin.heliostat, chosen, mirror.z)


_IS_JUDGED = (MeasurementRow.accepted, MeasurementRow.kind.in_(KINDS))


def count_images(session: Session) -> int:
    """Number of accepted images of `KINDS` in a store."""
    return session.scalars(select(func.count(MeasurementRow.id)).where(*_IS_JUDGED)).one()


def read_mirrors(session: Session) -> list[StoredMirror]:
    """Stored heliostats with the most images of `KINDS`, those with a measured surface first."""
    row, measured = MeasurementRow, func.max(SurfaceRow.version)
    is_measured = (SurfaceRow.heliostat_id == HeliostatRow.id) & (SurfaceRow.source == "measured")
    query = (
        select(HeliostatRow, measured)
        .join(row, row.heliostat_id == HeliostatRow.id)
        .outerjoin(SurfaceRow, is_measured)
        .where(*_IS_JUDGED)
        .group_by(HeliostatRow.id)
        .order_by(measured.is_(None), func.count(row.id.distinct()).desc(), HeliostatRow.name)
    )
    mirrors = []
    for heliostat, version in session.execute(query.limit(_MIRRORS)).all():
        recent = store.recent_measurements(session, heliostat, _NEWEST)
        names = [one.identifier for one in recent if one.kind in KINDS]
        rows = store.get_measurements(session, heliostat, names, arrays=True)
        surface = None if version is None else store.get_surface(session, heliostat, version)
        twin = load_heliostat_context(session, heliostat.name)
        mirrors += [StoredMirror(twin, rows, heights_of(surface))] if rows else []
    return mirrors
