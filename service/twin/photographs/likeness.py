"""Detect on arrival whether a photograph fits another heliostat much better.

Its motors say so, or its flux. The limits of accuracy were measured on real photographs: ``python
-m benchmarks.swaps``.
"""

import logging
from collections.abc import Mapping, Sequence

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from model.errors import ModelError
from model.metrics import flux_accuracy
from model.plant import TargetPlane
from model.pointing.reasons import OTHER_SPOT, ContradictionClassifier, pointing_error
from service import store
from service.base.arrays import unpack
from service.base.errors import ConflictError, ServiceError
from service.store import mounts
from service.store.surface_versions import current_surfaces
from service.store.tables import UNLIKE_HELIOSTAT, HeliostatRow, MeasurementRow, SurfaceRow
from service.twin.measurements import AcceptedMeasurement, Array, HeliostatContext
from service.twin.photographs.metadata import Warnings
from service.twin.photographs.readings import reading_of
from service.twin.runtime import Runtime
from service.twin.stored_mount import mount_at, mount_of, with_drive_zeros
from service.twin.surfaces.accuracy import usual_accuracy

logger = logging.getLogger("heliotwin.service")

CANDIDATES = 8
"""Number of other heliostats to compare a photograph with.

Half of them are those photographed last. The others are the nearest.
"""

MARGIN = 0.10
"""Least advantage in accuracy [1] of another heliostat's forecast."""

MIN_ACCURACY = 0.75
"""Least accuracy [1] of another heliostat's forecast.

If neither of two mirrors fits, the better one is not named.
"""

DROP = 0.05
"""Least drop [1] below the heliostat's usual accuracy to compare others' surfaces."""

DROP_OF_MOTORS = 0.025
"""The same to ask the motors, which say more: photographs of others lower the usual accuracy."""

# Newest photographs to search for the heliostats that were photographed last.
_LOOKED_THROUGH = 64


def is_suspicious(accuracy: float, usual: float | None, drop: float = DROP) -> bool:
    """Whether a photograph's accuracy [1] is by ``drop`` below its heliostat's ``usual`` one.

    ``usual`` is None if unknown. An accuracy that no other heliostat can exceed by `MARGIN` is not
    suspicious.
    """
    return accuracy < 1 - MARGIN and (usual is None or accuracy < usual - drop)


def find_like(accuracy: float, others: Mapping[str, float]) -> str | None:
    """The heliostat of ``others`` with a much higher accuracy [1]; None without any."""
    best = max(others, key=lambda name: others[name], default=None)
    if best is None or others[best] < max(MIN_ACCURACY, accuracy + MARGIN):
        return None
    return best


def unlike_warnings(
    runtime: Runtime,
    twin: HeliostatContext,
    photograph: MeasurementRow,
    measurement: AcceptedMeasurement,
    accuracy: float,
) -> Warnings:
    """The warning that a photograph fits another heliostat much better, or none.

    Parameters
    ----------
    photograph : MeasurementRow
        Before it is stored.
    shown : AcceptedMeasurement
        The same photograph as an input of the model.
    accuracy : float [1]
        Accuracy of the forecast by its heliostat's active surface.
    """
    if not is_suspicious(accuracy, None):
        return []
    name = twin.row.name
    try:
        with runtime.database.reading() as session:
            usual = usual_accuracy(session, twin.row.id)
            if not is_suspicious(accuracy, usual, DROP_OF_MOTORS):
                return []
            like = _like_by_motors(session, twin, photograph, measurement.target)
            if like is not None:
                return [_warning(f"unlike {name}, like {like}: its motors fit that one", like)]
            if not is_suspicious(accuracy, usual):
                return []
            candidates = _candidates(session, twin, photograph)
        others = _accuracies(runtime, candidates, measurement)
    except (ModelError, ServiceError) as error:
        logger.warning("a photograph of %s was not compared with others: %s", name, error)
        return []
    except Exception:  # the photograph is stored without; its sender must not get a failure for it
        logger.exception("a photograph of %s was not compared with others", name)
        return []
    like = find_like(accuracy, others)
    if like is None:
        return []
    detail = f"unlike {name}, like {like} (accuracy {accuracy:.2f} against {others[like]:.2f})"
    return [_warning(detail, like)]


def _warning(detail: str, like: str) -> dict[str, object]:
    return {"type": UNLIKE_HELIOSTAT, "detail": detail, "like": like}


def _like_by_motors(
    session: Session, twin: HeliostatContext, photograph: MeasurementRow, plane: TargetPlane
) -> str | None:
    """The heliostat that directs its light to the spot with these motors, where this one does not.

    None without motors and a calibrated mount, or if another reason explains the spot as well.
    """
    own = mount_at(session, twin.row)
    if own is None:
        return None
    targets = {row.name: store.target_plane(row) for row in store.list_targets(session)}
    try:
        reading = reading_of(own.heliostat, photograph, own.model, plane, targets.values())
        if pointing_error(own.heliostat, own.mount, [reading])[0] < OTHER_SPOT:
            return None
    except ModelError:  # nothing says where its light should be
        return None
    heliostats, calibrated = {}, {}
    for row, mount in mounts.current_mounts(session):
        try:
            heliostats[row.name] = with_drive_zeros(row, own.model.site.origin)
            calibrated[row.name] = mount_of(row, mount, own.model.effects)
        except ConflictError:  # to be calibrated again
            continue
    classifier = ContradictionClassifier(heliostats, calibrated, targets, own.model.site)
    return classifier.classify(twin.row.name, reading).other


def _candidates(
    session: Session, twin: HeliostatContext, photograph: MeasurementRow
) -> list[tuple[HeliostatContext, Array]]:
    """Up to `CANDIDATES` other heliostats, and heights (4, 8, 8) [m] of their active surfaces."""
    last = _last_photographed(session, twin.row, photograph)
    nearest = _nearest(session, twin.row)
    numbers = list(dict.fromkeys([*last[: CANDIDATES // 2], *nearest]))[:CANDIDATES]
    surfaces = current_surfaces(session, numbers)
    rows = session.scalars(select(HeliostatRow).where(HeliostatRow.id.in_(surfaces))).all()
    mounted = {
        row.id: mount for row, mount in mounts.current_mounts(session, [row.name for row in rows])
    }
    return [
        (
            HeliostatContext.of(row, mounted.get(row.id), twin.model),
            unpack(surfaces[row.id])["z"].astype(float),
        )
        for row in rows
    ]


def _has_surface(heliostat: InstrumentedAttribute[int]) -> ColumnElement[bool]:
    return (
        select(SurfaceRow.id)
        .where(SurfaceRow.heliostat_id == heliostat, ~SurfaceRow.is_candidate)
        .exists()
    )


def _last_photographed(
    session: Session, heliostat: HeliostatRow, photograph: MeasurementRow
) -> list[int]:
    """Ids of other heliostats with active surfaces, those photographed last first.

    Only accepted photographs up to the time of this one count.
    """
    row = MeasurementRow
    query = select(row.heliostat_id).where(row.accepted, row.heliostat_id != heliostat.id)
    if photograph.taken_at is None:
        query = query.order_by(row.id.desc())
    else:
        query = query.where(row.taken_at <= photograph.taken_at).order_by(
            row.taken_at.desc(), row.id.desc()
        )
    newest = list(dict.fromkeys(session.scalars(query.limit(_LOOKED_THROUGH))))
    made = select(HeliostatRow.id).where(HeliostatRow.id.in_(newest), _has_surface(HeliostatRow.id))
    with_surface = set(session.scalars(made))
    return [number for number in newest if number in with_surface]


def _nearest(session: Session, heliostat: HeliostatRow) -> Sequence[int]:
    """Ids of the nearest heliostats with active surfaces."""
    row = HeliostatRow
    east, north = row.east_m - heliostat.east_m, row.north_m - heliostat.north_m
    query = select(row.id).where(row.id != heliostat.id, _has_surface(row.id))
    return session.scalars(query.order_by(east * east + north * north).limit(CANDIDATES)).all()


def _accuracies(
    runtime: Runtime,
    candidates: Sequence[tuple[HeliostatContext, Array]],
    measurement: AcceptedMeasurement,
) -> dict[str, float]:
    """Accuracy [1] of each candidate's forecast, by name.

    Candidates that cannot reach the target are left out.
    """
    observation, found = measurement.observation(), dict[str, float]()
    if not candidates:
        return found
    with runtime.computing("compare") as operations:
        for twin, z in candidates:
            try:
                (forecast,) = operations.render(twin.heliostat, [observation], z, twin.model)
            except ModelError as error:
                logger.info("heliostat %s is not compared: %s", twin.row.name, error)
                continue
            found[twin.row.name] = float(flux_accuracy(measurement.centered, forecast))
    return found
