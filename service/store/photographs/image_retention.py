"""Deletion of image files by age or quota. Rows and their fluxes remain.

Deletion has two steps. `mark_for_deletion` marks rows and writes the audit trail in one
transaction. `remove_marked` deletes the files of marked rows. It locks the rows, which an upload of
the same photograph locks too (`service.store.photographs.measurements`). It runs only while no
back-up copies images (`ImageStore.removing`). So a file exists as long as a committed row, or the
snapshot of a running back-up, refers to it. After a failure between the steps, the mark remains for
the next `remove_marked`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

from sqlalchemy import ColumnElement, Select, and_, exists, not_, select, tuple_
from sqlalchemy.orm import Session, aliased

from model.times import format_time
from service.base.settings import Settings
from service.store import audit, sizes
from service.store.jobs import queue
from service.store.photographs.image_files import ImageStore
from service.store.surfaces.surface_versions import valid_since
from service.store.tables import ImageRow, MeasurementRow, SurfaceRow, surface_measurements

Reason = Literal["age", "quota"]


def _made_from(condition: ColumnElement[bool]) -> ColumnElement[bool]:
    """Condition that a surface that fulfils ``condition`` uses the image."""
    links = surface_measurements.c
    found = select(SurfaceRow.id).join(surface_measurements, links.surface_id == SurfaceRow.id)
    found = found.join(MeasurementRow, MeasurementRow.id == links.measurement_id)
    return exists(found.where(MeasurementRow.image_sha256 == ImageRow.sha256, condition))


def _is_of_active_surface() -> ColumnElement[bool]:
    """Condition that a surface version is the active one; see `find_surface_at`."""
    other = aliased(SurfaceRow)
    is_newer = tuple_(valid_since(other), other.version) > tuple_(valid_since(), SurfaceRow.version)
    newer = select(other.id).where(
        other.heliostat_id == SurfaceRow.heliostat_id, is_newer, not_(other.is_candidate)
    )
    return and_(not_(SurfaceRow.is_candidate), not_(exists(newer)))


_REFUSED = not_(ImageRow.accepted)
_FREE = and_(ImageRow.accepted, not_(_made_from(_is_of_active_surface())))
_UNUSED = and_(ImageRow.accepted, not_(_made_from(SurfaceRow.id.is_not(None))))


@dataclass(frozen=True)
class RetentionRule:
    """A group of images to delete, oldest first: those received ``before`` a time, or up to the
    quota.
    """

    name: str
    reason: Reason
    accepted: bool
    condition: ColumnElement[bool]
    before: datetime | None = None


def retention_rules(session: Session, settings: Settings) -> list[RetentionRule]:
    """The rules of the settings in order of execution. Images of active surfaces always remain.

    For the quota, refused images go first, then accepted ones without a surface, then those of
    former surfaces.
    """
    at, found = queue.database_time(session), list[RetentionRule]()
    for name, condition, days in (
        ("refused", _REFUSED, settings.refused_image_retention_days),
        ("accepted", _FREE, settings.image_retention_days),
    ):
        if days:
            found.append(
                RetentionRule(name, "age", name == "accepted", condition, at - timedelta(days=days))
            )
    if settings.image_quota_gb:
        stages = (("refused", _REFUSED), ("unused", _UNUSED), ("of former surfaces", _FREE))
        found += [
            RetentionRule(name, "quota", name != "refused", condition) for name, condition in stages
        ]
    return found


def _candidates(rule: RetentionRule) -> Select[ImageRow]:
    query = select(ImageRow).where(ImageRow.pruned_at.is_(None), rule.condition)
    return query if rule.before is None else query.where(ImageRow.created_at < rule.before)


def excess_bytes(session: Session, settings: Settings, coming: int = 0) -> int:
    """Size of the image files beyond the quota, with ``coming`` additional bytes; 0 without an
    excess.
    """
    if not settings.image_quota_gb:
        return 0
    return max(0, sizes.image_bytes(session) + coming - int(settings.image_quota_gb * 1e9))


def has_candidates(session: Session, found: Sequence[RetentionRule]) -> bool:
    """Whether any of these rules matches an image."""
    return any(
        session.scalar(_candidates(rule).with_only_columns(ImageRow.sha256).limit(1)) is not None
        for rule in found
    )


def mark_unused(session: Session, sha256: str) -> None:
    """Mark an image for `remove_marked` after its last measurement was deleted.

    It remains if another measurement uses it.
    """
    row = session.get_one(ImageRow, sha256, with_for_update=True)
    used = session.scalar(
        select(MeasurementRow.id).where(MeasurementRow.image_sha256 == sha256).limit(1)
    )
    if used is not None or row.pruned_at is not None:
        return
    row.pruned_at, row.pruned_for = queue.database_time(session), "deleted"
    session.flush()
    sizes.count(session, row.accepted, -1, -row.size_bytes)


@dataclass(frozen=True)
class MarkedImages:
    """A batch of marked images; the next batch begins after ``last``."""

    images: int
    size_bytes: int
    last: tuple[datetime, str]


def mark_for_deletion(
    session: Session,
    settings: Settings,
    rule: RetentionRule,
    actor: str,
    after: tuple[datetime, str] | None = None,
    most: int = 500,
) -> MarkedImages | None:
    """Mark up to ``most`` images of a rule after ``after``, and audit this; None if none remain.

    Images that another transaction has locked wait for the next run.
    """
    excess = excess_bytes(session, settings)
    if rule.reason == "quota" and not excess:
        return None
    query = _candidates(rule).order_by(ImageRow.created_at, ImageRow.sha256).limit(most)
    # Skipped images are not read again, because thousands may belong to active surfaces.
    if after is not None:
        query = query.where(tuple_(ImageRow.created_at, ImageRow.sha256) > after)
    rows, size = list[ImageRow](), 0
    for row in session.scalars(query.with_for_update(skip_locked=True)):
        if rule.reason == "quota" and size >= excess:
            break
        rows.append(row)
        size += row.size_bytes
    if not rows:
        return None
    at = queue.database_time(session)
    for row in rows:
        row.pruned_at, row.pruned_for = at, rule.reason
    first, last = rows[0].created_at, rows[-1].created_at
    audit.record(
        session,
        actor,
        "images.pruned",
        f"{len(rows)} images",
        which=rule.name,
        reason=rule.reason,
        size_bytes=size,
        oldest=format_time(first),
        newest=format_time(last),
    )
    session.flush()
    sizes.count(session, rule.accepted, -len(rows), -size)
    return MarkedImages(len(rows), size, (last, rows[-1].sha256))


_MARKED = and_(ImageRow.pruned_at.is_not(None), ImageRow.removed_at.is_(None))


def has_marked(session: Session) -> bool:
    """Whether files of marked images remain to be deleted."""
    return session.scalar(select(ImageRow.sha256).where(_MARKED).limit(1)) is not None


def remove_marked(session: Session, images: ImageStore, most: int = 500) -> int:
    """Delete the files of up to ``most`` marked images, and return their number.

    Call it under `ImageStore.removing`. If the transaction fails, the marks remain for a retry.
    """
    rows = session.scalars(
        select(ImageRow).where(_MARKED).limit(most).with_for_update(skip_locked=True)
    ).all()
    at = queue.database_time(session)
    for row in rows:
        images.remove(row.sha256)
        row.removed_at = at
    return len(rows)
