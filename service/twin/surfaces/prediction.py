"""Predict surfaces from stored measurements.

The computation runs outside any transaction. The result is stored in the caller's transaction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import NamedTuple

import numpy as np
from sqlalchemy.orm import Session

from model.frames import sun_direction
from model.observation import TRUSTED_MAHALANOBIS, Observation, SurfacePrediction
from model.progress import Progress, silent
from service import store
from service.base.choices import Method, Selection, require_images
from service.base.errors import ConflictError
from service.store import audit, decisions
from service.store.decisions import Justification
from service.store.keys import RESERVED
from service.store.rows import lock_heliostat
from service.store.tables import DecisionRow, MeasurementRow, SurfaceRow
from service.twin.measurements import (
    HeliostatContext,
    accepted_measurement,
    choose_diverse,
    choose_measurements,
    load_heliostat_context,
    named_measurements,
    to_observations,
)
from service.twin.runtime import Operations, Runtime
from service.twin.surfaces.accuracy import photographs_of_epoch
from service.twin.surfaces.evaluation import Evaluation, evaluate_first_surface, evaluate_surface
from service.twin.surfaces.present_shape import Epoch, current_epoch, epoch_of, reject_outliers

# Candidates per requested image, because some may contradict the others.
_SPARE = 2

READING, COMPARING, STORING = "reading photographs", "comparing with the active surface", "storing"
"""Phases before and after the prediction itself, which names its phases."""

_SHARES = {READING: (0.0, 0.05), COMPARING: (0.95, 0.99), STORING: (0.99, 1.0)}


def share_of(phase: str, done: int, total: int) -> float:
    """Share [1] of a prediction that is finished, by its phase and the steps of the phase."""
    begin, end = _SHARES.get(phase, (0.05, 0.95))
    return begin + (end - begin) * done / max(total, 1)


@dataclass(frozen=True, eq=False)
class Predicted:
    """A predicted surface that is not stored yet.

    ``known`` is the stored version with the same content, if there is one. ``judgement`` compares
    it with the active surface or the ideal mirror; None without a comparison.
    """

    twin: HeliostatContext
    new: store.NewSurface
    known: SurfaceRow | None = None
    judgement: Evaluation | None = None


class MeasurementChoice(NamedTuple):
    """How many accepted measurements to choose, and since when they were taken.

    The default is the begin of the mirror's epoch. Another time begins an epoch.
    """

    images: int = 8
    since: datetime | None = None


def compute_surface(
    runtime: Runtime,
    heliostat: str,
    method: Method = "network",
    measurements: Sequence[str] | MeasurementChoice = MeasurementChoice(),
    model_version: int | None = None,
    progress: Progress = silent,
) -> Predicted:
    """Predict a heliostat's surface from named measurements, or from chosen ones.

    ``model_version`` is a version of the plant's model, by default the current one. ``progress``
    receives the progress. An exception that it raises stops the prediction.

    Raises
    ------
    NotFoundError, ConflictError
        If the heliostat, a measurement or the model is not stored, or no measurement is accepted.
    InvalidInputError
        If there are more images than the method accepts.
    """
    choice = measurements if isinstance(measurements, MeasurementChoice) else None
    require_images(method, len(measurements) if choice is None else choice.images)
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat, model_version)
        epoch = current_epoch(session, twin.row, runtime.settings)
        if choice is not None:
            begun = choice.since or _begin_of_epoch(heliostat, epoch)
            chosen = choose_measurements(session, twin.row, choice.images, begun, spare=_SPARE)
            names = [row.identifier for row in chosen]
        else:
            begun = None if epoch is None else epoch.since
            names = [str(one) for one in measurements]
        rows = named_measurements(session, twin.row, names)
        today = store.find_surface_at(session, twin.row)
    with runtime.computing(f"predict_{method}") as operations:
        if choice is not None:
            progress(READING, 0, len(rows))
            observations, _ = choose_observations(operations, twin, rows, choice.images)
            progress(READING, len(rows), len(rows))
        else:
            observations = to_observations(
                [accepted_measurement(row, twin.origin) for row in rows], twin.heliostat
            )
        surface = operations.predict(twin.heliostat, observations, twin.model, method, progress)
    progress(COMPARING, 0, 1)
    return _evaluated(runtime, twin, today, _new_surface(twin, surface, rows, begun))


def import_surface(runtime: Runtime, heliostat: str, new: store.NewSurface, actor: str) -> bool:
    """Store a surface that was imported, and return whether it is new.

    It is judged as predicted ones are, by the photographs of the mirror's present epoch.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat)
        active = store.find_surface_at(session, twin.row)
        new = replace(new, epoch_since=None if active is None else active.epoch_since)
        judges = photographs_of_epoch(session, twin.row, epoch_of(session, twin.row, new))
    evaluated = _evaluated(runtime, twin, active, new) if judges else Predicted(twin, new)
    return runtime.database.run_in_transaction(
        lambda session: keep_surface(session, evaluated, actor).is_new
    )


def _evaluated(
    runtime: Runtime, twin: HeliostatContext, active: SurfaceRow | None, new: store.NewSurface
) -> Predicted:
    with runtime.database.reading() as session:
        known = store.find_same_content(session, twin.row, new)
    if known is not None:
        return Predicted(twin, new, known)
    if active is None:
        return _evaluated_first(twin, new, evaluate_first_surface(runtime, twin, new))
    if _is_older(new, active):
        return Predicted(twin, new)
    return Predicted(twin, new, None, evaluate_surface(runtime, twin, active, new))


def _begin_of_epoch(heliostat: str, epoch: Epoch | None) -> datetime | None:
    """Since when photographs show the present mirror.

    Raises ConflictError if the mirror changed and too few photographs show it since.
    """
    if epoch is not None and epoch.missing:
        raise ConflictError(
            f"heliostat {heliostat}: {epoch.said}. {epoch.needs}; photograph it again, or give"
            " `since` or `measurements`"
        )
    return None if epoch is None else epoch.since


def _evaluated_first(
    twin: HeliostatContext, new: store.NewSurface, judgement: Evaluation
) -> Predicted:
    """Add a warning to a first surface that forecasts worse than the ideal mirror."""
    if judgement.became_active or new.trust is None:
        return Predicted(twin, new, None, judgement)
    before, after = judgement.grounds.before or 0.0, judgement.grounds.after or 0.0
    said = (
        f"the ideal mirror forecasts no worse: accuracy {before:.0%} on photographs, this surface"
        f" {after:.0%}"
    )
    trust = replace(new.trust, warnings=(*new.trust.warnings, said))
    return Predicted(twin, replace(new, trust=trust), None, judgement)


def _is_older(new: store.NewSurface, today: SurfaceRow) -> bool:
    """Whether a surface describes the mirror from an earlier time than the active one."""
    return (
        new.valid_from is not None
        and today.valid_from is not None
        and new.valid_from < today.valid_from
    )


def choose_observations(
    operations: Operations, twin: HeliostatContext, rows: Sequence[MeasurementRow], images: int
) -> Selection[Observation]:
    """Choose up to ``images`` observations of different suns, the newest first, no outliers."""
    arrived = sorted(rows, key=lambda row: row.id)  # the order of those of unknown time
    observations = to_observations(
        [accepted_measurement(row, twin.origin) for row in arrived], twin.heliostat
    )
    kept, rejected = reject_outliers(operations, twin.heliostat, observations, twin.model)
    return Selection(choose_diverse(kept[::-1], images), rejected)


def _new_surface(
    twin: HeliostatContext,
    surface: SurfacePrediction,
    chosen: Sequence[MeasurementRow],
    begun: datetime | None,
) -> store.NewSurface:
    """The surface as it will be stored.

    It is valid from the time of its newest image; None if no time is known. It is of the epoch that
    has ``begun`` if no image is from before.
    """
    used = [row for row in chosen if row.identifier in surface.used]
    return store.NewSurface(
        source=surface.method,
        z=surface.z,
        z_std=surface.z_std,
        control_points=surface.control_points,
        valid_from=max((row.taken_at for row in used if row.taken_at is not None), default=None),
        model=surface.weights,
        model_version=twin.model.version,
        measurements=used,
        misfit=surface.misfit,
        trust=_trust(surface, used),
        epoch_since=begun if all(_is_since(row, begun) for row in used) else None,
    )


def _is_since(row: MeasurementRow, begun: datetime | None) -> bool:
    return begun is not None and row.taken_at is not None and row.taken_at >= begun


def _trust(surface: SurfacePrediction, used: Sequence[MeasurementRow]) -> store.Trust:
    """Trust in a prediction: warnings in words, and its figures."""
    misfits = dict(zip(surface.used, surface.misfits, strict=True))
    warnings = [
        f"photograph {name} is not explained: {misfits[name]:.0%} of it is missed"
        for name in surface.suspicious
    ]
    if surface.mahalanobis_distance > TRUSTED_MAHALANOBIS:
        warnings.append(
            f"the mirror is unlike those known: {surface.mahalanobis_distance:.2f} standard"
            f" deviations from their mean, and they are within {TRUSTED_MAHALANOBIS:.2f}"
        )
    warnings += surface.warnings
    if not surface.trusted and not warnings:
        warnings.append("the prediction does not trust itself")
    suns = np.array([sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg) for row in used])
    span = float(np.degrees(np.arccos(np.clip(suns @ suns.T, -1, 1)).max()))
    return store.Trust(
        tuple(warnings), surface.suspicious, float(surface.mahalanobis_distance), span
    )


@dataclass(frozen=True, eq=False)
class StoredSurface:
    """A predicted surface in the store: its row, whether it is new, and its decision."""

    row: SurfaceRow
    is_new: bool = True
    decision: DecisionRow | None = None


def keep_surface(session: Session, predicted: Predicted, actor: str) -> StoredSurface:
    """Store a new surface as the heliostat's next version, unless it exists.

    ``actor`` is who requested it. The surface stays a candidate if the evaluation rejects it, or if
    another surface became active meanwhile.
    """
    heliostat, new = predicted.twin.row, predicted.new
    lock_heliostat(session, heliostat)
    if predicted.known is not None:
        return StoredSurface(
            store.get_surface(session, heliostat, predicted.known.version), is_new=False
        )
    today = store.find_surface_at(session, heliostat)
    last = store.newest_prediction(session, heliostat)
    used = store.get_measurements(session, heliostat, [row.identifier for row in new.measurements])
    is_import = new.source == "measured"
    row, is_new = store.add_surface(
        session, heliostat, replace(new, measurements=used), once=is_import
    )
    if not is_new:
        return StoredSurface(row, is_new=False)
    about = {"version": row.version, "model": new.model_version}
    action = "surface.imported" if is_import else "surface.predicted"
    audit.record(session, actor, action, f"heliostat {heliostat.name}", **about)
    _carry_acknowledgement(row, last)
    judgement = predicted.judgement
    if judgement is None:
        return StoredSurface(row)
    active = None if today is None else today.version
    if active is None and judgement.became_active:
        return StoredSurface(row)  # it replaced nothing, so there is no decision to record or undo
    row.is_candidate = True
    session.flush()
    became_active, grounds = judgement.became_active, judgement.grounds
    if active != judgement.against:
        other = "the ideal mirror" if judgement.against is None else f"version {judgement.against}"
        reason = f"version {active} became active while this one was compared with {other}"
        became_active, grounds = False, Justification(reason)
    decision = decisions.apply_decision(session, heliostat, row, became_active, actor, grounds)
    return StoredSurface(row, decision=decision)


def _carry_acknowledgement(row: SurfaceRow, last: SurfaceRow | None) -> None:
    """Keep the start time of warnings, and acknowledgements of the same suspicious photographs."""
    if row.warned_since is None or last is None or last.warned_since is None:
        return
    row.warned_since = last.warned_since
    if row.suspicious == last.suspicious:
        row.acknowledged_at, row.acknowledged_by = last.acknowledged_at, last.acknowledged_by


def predict_surface(
    runtime: Runtime,
    heliostat: str,
    method: Method = "network",
    measurements: Sequence[str] | None = None,
    images: int = 8,
    actor: str = RESERVED,
    model_version: int | None = None,
) -> StoredSurface:
    """Run `compute_surface`, then `keep_surface` in a separate transaction."""
    chosen = MeasurementChoice(images) if measurements is None else measurements
    predicted = compute_surface(runtime, heliostat, method, chosen, model_version)
    with runtime.database.writing() as session:
        return keep_surface(session, predicted, actor)
