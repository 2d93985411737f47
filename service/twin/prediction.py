"""Surfaces from stored measurements: computed outside any transaction, kept in the caller's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy.orm import Session

from model.frames import sun_direction
from model.observation import TRUSTED_MAHALANOBIS, Observation, SurfacePrediction
from service import store
from service.base.choices import Method, require_images
from service.store import audit, decisions
from service.store.decisions import Grounds
from service.store.keys import RESERVED
from service.store.tables import DecisionRow, MeasurementRow, SurfaceRow
from service.twin.consensus import agreeing
from service.twin.evidence import (
    Twin,
    as_observations,
    choose,
    choose_measurements,
    evidence_of,
    load_twin,
    named_measurements,
)
from service.twin.judging import Judgement, judge_surface
from service.twin.runtime import Operations, Runtime

# Candidates for each image that is wanted: some may contradict the others.
_SPARE = 2


@dataclass(frozen=True, eq=False)
class Predicted:
    """A surface that is not kept yet.

    ``known`` is the version that it is again, where nothing is new; ``judgement`` says how it compares with today's,
    where it would take its place.
    """

    twin: Twin
    new: store.NewSurface
    known: SurfaceRow | None = None
    judgement: Judgement | None = None


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
    InvalidInputError
        Where the method takes fewer images.
    """
    require_images(method, images if measurements is None else len(measurements))
    with runtime.database.reading() as session:
        twin = load_twin(session, heliostat, model_version)
        names = measurements
        if names is None:
            names = [row.identifier for row in choose_measurements(session, twin.row, images, spare=_SPARE)]
        rows = named_measurements(session, twin.row, names)
        today = store.find_surface_at(session, twin.row)
    with runtime.computing(f"predict_{method}") as operations:
        if measurements is None:
            observations = _chosen(operations, twin, rows, images)
        else:
            observations = as_observations([evidence_of(row, twin.origin) for row in rows])
        surface = operations.predict(
            twin.heliostat,
            observations,
            method,
            twin.model.optics,
            twin.model.effects,
            latitude_deg=twin.origin[0],
        )
    new = _new_surface(twin, method, surface, rows)
    with runtime.database.reading() as session:
        known = store.find_alike(session, twin.row, new)
    if known is not None or today is None or (new.valid_from is not None and new.valid_from < today.valid_from):
        return Predicted(twin, new, known)
    return Predicted(twin, new, None, judge_surface(runtime, twin, today, new))


def _chosen(operations: Operations, twin: Twin, rows: Sequence[MeasurementRow], images: int) -> list[Observation]:
    """Up to ``images`` of what the candidates show, without those that contradict the others."""
    in_time = sorted(rows, key=lambda row: row.taken_at or row.created_at)
    observations = as_observations([evidence_of(row, twin.origin) for row in in_time])
    model = twin.model.optics, twin.model.effects
    kept, _ = agreeing(operations, twin.heliostat, observations, *model, latitude_deg=twin.origin[0])
    return choose(kept[::-1], images)


def _new_surface(
    twin: Twin, method: Method, surface: SurfacePrediction, chosen: Sequence[MeasurementRow]
) -> store.NewSurface:
    """As it will be kept: valid from when the newest of its images was taken, else from when it is kept."""
    used = [row for row in chosen if row.identifier in surface.used]
    return store.NewSurface(
        source=method,
        z=surface.z,
        z_std=surface.z_std,
        control_points=surface.control_points,
        valid_from=max((row.taken_at for row in used if row.taken_at is not None), default=None),
        model=surface.weights,
        model_version=twin.model.version,
        measurements=used,
        misfit=surface.misfit,
        trust=_trust(surface, used),
    )


def _trust(surface: SurfacePrediction, used: Sequence[MeasurementRow]) -> store.Trust:
    """What a prediction says of itself, in words."""
    misfits = dict(zip(surface.used, surface.misfits, strict=True))
    doubts = [f"photograph {name} is not explained: {misfits[name]:.0%} of it is missed" for name in surface.suspicious]
    if surface.mahalanobis > TRUSTED_MAHALANOBIS:
        doubts.append(
            f"the mirror is unlike those known: {surface.mahalanobis:.1f} standard deviations from them, "
            f"{TRUSTED_MAHALANOBIS} are usual at most"
        )
    doubts += surface.doubts
    if not surface.trusted and not doubts:
        doubts.append("the prediction does not trust itself")
    suns = np.array([sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg) for row in used])
    span = float(np.degrees(np.arccos(np.clip(suns @ suns.T, -1, 1)).max()))
    return store.Trust(tuple(doubts), surface.suspicious, float(surface.mahalanobis), span)


@dataclass(frozen=True, eq=False)
class Kept:
    """A predicted surface in the store: its row, whether it is new there, and what was decided on it, if anything."""

    row: SurfaceRow
    is_new: bool = True
    decision: DecisionRow | None = None


def keep_surface(session: Session, predicted: Predicted, actor: str) -> Kept:
    """Keep a predicted surface as its heliostat's next version, unless it is there already.

    ``actor`` is who asked for it. It becomes today's only where it is judged no worse than the one that is.
    """
    heliostat, new = predicted.twin.row, predicted.new
    if predicted.known is not None:
        return Kept(store.get_surface(session, heliostat, predicted.known.version), is_new=False)
    today = store.find_surface_at(session, heliostat)
    last = store.newest_prediction(session, heliostat)
    used = store.get_measurements(session, heliostat, [row.identifier for row in new.measurements])
    row, _ = store.add_surface(session, heliostat, replace(new, measurements=used))
    about = {"version": row.version, "model": new.model_version}
    audit.record(session, actor, "surface.predicted", f"heliostat {heliostat.name}", **about)
    _carry_doubts(row, last)
    judgement = predicted.judgement
    if judgement is None or today is None:
        return Kept(row)
    row.set_aside = True
    session.flush()
    if today.version != judgement.against:
        reason = f"version {today.version} became today's while this one was compared with version {judgement.against}"
        return Kept(row, decision=decisions.keep_aside(session, heliostat, row, actor, Grounds(reason)))
    decide = decisions.take if judgement.taken else decisions.keep_aside
    return Kept(row, decision=decide(session, heliostat, row, actor, judgement.grounds))


def _carry_doubts(row: SurfaceRow, last: SurfaceRow | None) -> None:
    """Doubts go on since the version before had any; who has seen the same ones need not see them again."""
    if row.doubted_since is None or last is None or last.doubted_since is None:
        return
    row.doubted_since = last.doubted_since
    if row.suspicious == last.suspicious:
        row.seen_at, row.seen_by = last.seen_at, last.seen_by


def predict_surface(
    runtime: Runtime,
    heliostat: str,
    method: Method = "network",
    measurements: Sequence[str] | None = None,
    images: int = 8,
    actor: str = RESERVED,
    model_version: int | None = None,
) -> Kept:
    """`compute_surface`, then `keep_surface` in a transaction of its own."""
    predicted = compute_surface(runtime, heliostat, method, measurements, images, model_version)
    with runtime.database.writing() as session:
        return keep_surface(session, predicted, actor)
