"""How much the store holds: totals that every write keeps up, so that nobody has to walk millions of files for them."""

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from service.store.rows import inserting
from service.store.tables import ImageRow, ImageTotalRow


@dataclass(frozen=True)
class Kept:
    """The images of one verdict whose files are kept; ``oldest`` is when the first of them came."""

    images: int = 0
    size_bytes: int = 0
    oldest: datetime | None = None


@dataclass(frozen=True)
class Sizes:
    """What lies on the disk."""

    accepted: Kept
    refused: Kept
    database_bytes: int

    @property
    def image_bytes(self) -> int:
        """Of all image files together."""
        return self.accepted.size_bytes + self.refused.size_bytes


def count(session: Session, accepted: bool, images: int, size_bytes: int) -> None:
    """So many images of a verdict, and bytes, came; negative numbers went.

    Writers wait for each other from here to the end of their transactions: let it be their last statement or so.
    """
    row = ImageTotalRow
    begun = inserting(session, row).values(accepted=accepted, images=images, size_bytes=size_bytes)
    added = {"images": row.images + begun.excluded.images, "size_bytes": row.size_bytes + begun.excluded.size_bytes}
    session.execute(begun.on_conflict_do_update(index_elements=[row.accepted], set_=added))


def image_bytes(session: Session) -> int:
    """The size of all image files that are kept."""
    return int(session.scalars(select(func.coalesce(func.sum(ImageTotalRow.size_bytes), 0))).one())


def sizes(session: Session) -> Sizes:
    """What lies on the disk, by a few rows."""
    return Sizes(_kept(session, True), _kept(session, False), _database_bytes(session))


def _kept(session: Session, accepted: bool) -> Kept:
    row = session.get(ImageTotalRow, accepted)
    if row is None or not row.images:
        return Kept()
    came = select(func.min(ImageRow.created_at)).where(ImageRow.pruned_at.is_(None), ImageRow.accepted == accepted)
    return Kept(row.images, row.size_bytes, session.scalar(came))


def _database_bytes(session: Session) -> int:
    if session.get_bind().dialect.name == "postgresql":
        return int(session.scalars(select(func.pg_database_size(func.current_database()))).one())
    pages = (session.execute(text(f"PRAGMA {name}")).scalar_one() for name in ("page_count", "page_size"))
    return int(next(pages)) * int(next(pages))
