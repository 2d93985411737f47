"""Storage totals that every write updates.

So no query has to count millions of files.
"""

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from service.store.rows import inserting
from service.store.tables import ImageRow, ImageTotalRow


@dataclass(frozen=True)
class ImageTotals:
    """Stored images of one verdict; ``oldest`` is when the first of them arrived."""

    images: int = 0
    size_bytes: int = 0
    oldest: datetime | None = None


@dataclass(frozen=True)
class Sizes:
    """Disk usage."""

    accepted: ImageTotals
    refused: ImageTotals
    database_bytes: int

    @property
    def image_bytes(self) -> int:
        """Size of all image files."""
        return self.accepted.size_bytes + self.refused.size_bytes


def count(session: Session, accepted: bool, images: int, size_bytes: int) -> None:
    """Add images of a verdict and their bytes to the totals; negative numbers subtract.

    Other writers wait from here to the end of the transaction, so make it one of the last
    statements.
    """
    row = ImageTotalRow
    begun = inserting(session, row).values(accepted=accepted, images=images, size_bytes=size_bytes)
    added = {
        "images": row.images + begun.excluded.images,
        "size_bytes": row.size_bytes + begun.excluded.size_bytes,
    }
    session.execute(begun.on_conflict_do_update(index_elements=[row.accepted], set_=added))


def image_bytes(session: Session) -> int:
    """The size of all stored image files."""
    return int(session.scalars(select(func.coalesce(func.sum(ImageTotalRow.size_bytes), 0))).one())


def sizes(session: Session) -> Sizes:
    """Disk usage, from a few rows."""
    return Sizes(_kept(session, True), _kept(session, False), _database_bytes(session))


def _kept(session: Session, accepted: bool) -> ImageTotals:
    row = session.get(ImageTotalRow, accepted)
    if row is None or not row.images:
        return ImageTotals()
    came = select(func.min(ImageRow.created_at)).where(
        ImageRow.pruned_at.is_(None), ImageRow.accepted == accepted
    )
    return ImageTotals(row.images, row.size_bytes, session.scalar(came))


def _database_bytes(session: Session) -> int:
    if session.get_bind().dialect.name == "postgresql":
        return int(session.scalars(select(func.pg_database_size(func.current_database()))).one())
    pages = (
        session.execute(text(f"PRAGMA {name}")).scalar_one() for name in ("page_count", "page_size")
    )
    return int(next(pages)) * int(next(pages))
