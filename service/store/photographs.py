"""Which image files are given up, and how they go; rows, and the fluxes in them, stay.

A file goes in two steps. `give_up` marks rows, in the transaction that notes it in the audit trail. `remove` takes the
files of marked rows, under the rows' locks, which whoever posts the same photograph takes too
(`service.store.measurements`), and only while no back-up copies (`ImageStore.removing`). So a file is there as long as
any committed row, or the snapshot of a running back-up, says that it is; a fault between the steps leaves a mark that
the next `remove` finds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

from sqlalchemy import ColumnElement, Select, and_, exists, not_, select, tuple_
from sqlalchemy.orm import Session, aliased

from service.base.settings import Settings
from service.store import audit, queue, sizes
from service.store.images import ImageStore
from service.store.tables import ImageRow, MeasurementRow, SurfaceRow, surface_measurements

Reason = Literal["age", "quota"]


def _made_from(condition: ColumnElement[bool]) -> ColumnElement[bool]:
    """Whether a surface for which ``condition`` holds was made from the image."""
    links = surface_measurements.c
    found = select(SurfaceRow.id).join(surface_measurements, links.surface_id == SurfaceRow.id)
    found = found.join(MeasurementRow, MeasurementRow.id == links.measurement_id)
    return exists(found.where(MeasurementRow.image_sha256 == ImageRow.sha256, condition))


def _is_todays() -> ColumnElement[bool]:
    """Whether no other version of the surface is current in its place; see `find_surface_at`."""
    other = aliased(SurfaceRow)
    is_newer = tuple_(other.valid_from, other.version) > tuple_(SurfaceRow.valid_from, SurfaceRow.version)
    newer = select(other.id).where(other.heliostat_id == SurfaceRow.heliostat_id, is_newer, not_(other.set_aside))
    return and_(not_(SurfaceRow.set_aside), not_(exists(newer)))


_REFUSED = not_(ImageRow.accepted)
_FREE = and_(ImageRow.accepted, not_(_made_from(_is_todays())))
_UNUSED = and_(ImageRow.accepted, not_(_made_from(SurfaceRow.id.is_not(None))))


@dataclass(frozen=True)
class Rule:
    """Images that may go, oldest first: those that came before some time, or all until the quota holds."""

    name: str
    reason: Reason
    accepted: bool
    condition: ColumnElement[bool]
    before: datetime | None = None


def rules(session: Session, settings: Settings) -> list[Rule]:
    """What the settings say, in the order in which it is done; never what today's surfaces were made from.

    For the quota refused images go first, then accepted ones that no surface was made from, then those of former
    surfaces.
    """
    at, found = queue.clock(session), list[Rule]()
    for name, condition, days in (
        ("refused", _REFUSED, settings.refused_image_retention_days),
        ("accepted", _FREE, settings.image_retention_days),
    ):
        if days:
            found.append(Rule(name, "age", name == "accepted", condition, at - timedelta(days=days)))
    if settings.image_quota_gb:
        stages = (("refused", _REFUSED), ("unused", _UNUSED), ("of former surfaces", _FREE))
        found += [Rule(name, "quota", name != "refused", condition) for name, condition in stages]
    return found


def _candidates(rule: Rule) -> Select[ImageRow]:
    query = select(ImageRow).where(ImageRow.pruned_at.is_(None), rule.condition)
    return query if rule.before is None else query.where(ImageRow.created_at < rule.before)


def excess_bytes(session: Session, settings: Settings, coming: int = 0) -> int:
    """What the image files take beyond the quota, with ``coming`` bytes more; 0 where it holds, or there is none."""
    if not settings.image_quota_gb:
        return 0
    return max(0, sizes.image_bytes(session) + coming - int(settings.image_quota_gb * 1e9))


def has_some(session: Session, found: Sequence[Rule]) -> bool:
    """Whether any of these rules finds an image."""
    return any(
        session.scalar(_candidates(rule).with_only_columns(ImageRow.sha256).limit(1)) is not None for rule in found
    )


@dataclass(frozen=True)
class GivenUp:
    """A batch of images that were marked; ``last`` is where the next one begins."""

    images: int
    size_bytes: int
    last: tuple[datetime, str]


def give_up(
    session: Session,
    settings: Settings,
    rule: Rule,
    actor: str,
    after: tuple[datetime, str] | None = None,
    most: int = 500,
) -> GivenUp | None:
    """Mark up to ``most`` images that a rule finds, those that came ``after``, and note that; None where none is left.

    Those that somebody else writes to at this moment are left for the next time.
    """
    excess = excess_bytes(session, settings)
    if rule.reason == "quota" and not excess:
        return None
    query = _candidates(rule).order_by(ImageRow.created_at, ImageRow.sha256).limit(most)
    if after is not None:  # what was passed over is not looked at again: thousands may be evidence of today
        query = query.where(tuple_(ImageRow.created_at, ImageRow.sha256) > after)
    rows, size = list[ImageRow](), 0
    for row in session.scalars(query.with_for_update(skip_locked=True)):
        if rule.reason == "quota" and size >= excess:
            break
        rows.append(row)
        size += row.size_bytes
    if not rows:
        return None
    at = queue.clock(session)
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
        oldest=first.isoformat(),
        newest=last.isoformat(),
    )
    session.flush()
    sizes.count(session, rule.accepted, -len(rows), -size)
    return GivenUp(len(rows), size, (last, rows[-1].sha256))


_MARKED = and_(ImageRow.pruned_at.is_not(None), ImageRow.removed_at.is_(None))


def has_marked(session: Session) -> bool:
    """Whether a marked image's file is still to be removed."""
    return session.scalar(select(ImageRow.sha256).where(_MARKED).limit(1)) is not None


def remove(session: Session, images: ImageStore, most: int = 500) -> int:
    """Remove the files of up to ``most`` marked images, and say of how many.

    To be called under `ImageStore.removing`. Where the transaction fails the marks stay, and this is done again.
    """
    rows = session.scalars(select(ImageRow).where(_MARKED).limit(most).with_for_update(skip_locked=True)).all()
    at = queue.clock(session)
    for row in rows:
        images.remove(row.sha256)
        row.removed_at = at
    return len(rows)
