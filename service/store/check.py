"""`heliotwin check`: an integrity check of the store."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

from sqlalchemy import func, not_, select
from sqlalchemy.orm import Session

from service.base.errors import StoreDamagedError
from service.base.progress import Progress
from service.store.database import Database
from service.store.image_files import ImageStore
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow

# Images per database query.
_CHUNK = 500

_KEPT = ImageRow.pruned_at.is_(None)

_IMAGE = re.compile(r"[0-9a-f]{2}/[0-9a-f]{62}")


class BadImage(TypedDict):
    """Why an image is bad, and its measurements (H/ID)."""

    reason: str
    measurements: list[str]


@dataclass(frozen=True)
class StoreReport:
    """Condition of a store: numbers of images, and damage.

    ``images`` were read, ``pruned`` ones are deleted. ``database`` lists errors that SQLite finds.
    ``unused`` files without a row and partial ones (``leftovers``) are harmless rests of failures.
    """

    images: int
    pruned: int
    bad: dict[str, BadImage]
    database: list[str]
    unused: int
    leftovers: int

    @property
    def is_sound(self) -> bool:
        """Whether there is no damage."""
        return not self.bad and not self.database


def inspect_store(database: Database, images: ImageStore, step: Progress) -> StoreReport:
    """Read every image in the database, and check the integrity of SQLite's file."""
    with database.reading() as session:
        known = list(
            session.scalars(select(ImageRow.sha256).where(_KEPT).order_by(ImageRow.sha256))
        )
        pruned = session.scalars(
            select(func.count()).select_from(ImageRow).where(not_(_KEPT))
        ).one()
        waiting = list(
            session.scalars(
                select(ImageRow.sha256).where(not_(_KEPT), ImageRow.removed_at.is_(None))
            )
        )
        faults = _database_faults(session)
    # Terabytes take hours to read, so no transaction is open meanwhile.
    bad = {
        sha256: reason for sha256 in known if (reason := _reason(images, sha256, step)) is not None
    }
    bad = _still_kept(database, bad)
    owners = _owners(database, list(bad))
    listed: dict[str, BadImage] = {
        sha256: {"reason": reason, "measurements": owners[sha256]} for sha256, reason in bad.items()
    }
    names = {*known, *waiting}
    files = [
        path.relative_to(images.root).as_posix()
        for path in images.root.rglob("*")
        if path.is_file()
    ]
    stored = [name for name in files if _IMAGE.fullmatch(name)]
    return StoreReport(
        images=len(known),
        pruned=pruned,
        bad=listed,
        database=faults,
        unused=sum(name.replace("/", "") not in names for name in stored),
        leftovers=len(files) - len(stored),
    )


def _reason(images: ImageStore, sha256: str, step: Progress) -> str | None:
    step(sha256[:12])
    try:
        images.read(sha256)
    except StoreDamagedError:
        return "damaged" if images.path(sha256).is_file() else "missing"
    except OSError as error:
        return f"unreadable: {error.strerror}"
    return None


def _still_kept(database: Database, bad: dict[str, str]) -> dict[str, str]:
    """Remove images that were deleted since they were listed, because reading all takes hours."""
    digests, kept = list(bad), set[str]()
    with database.reading() as session:
        for start in range(0, len(digests), _CHUNK):
            some = select(ImageRow.sha256).where(
                _KEPT, ImageRow.sha256.in_(digests[start : start + _CHUNK])
            )
            kept.update(session.scalars(some))
    return {sha256: reason for sha256, reason in bad.items() if sha256 in kept}


def _owners(database: Database, images: Sequence[str]) -> dict[str, list[str]]:
    """The measurements (H/ID) of these images."""
    owners: dict[str, list[str]] = {sha256: [] for sha256 in images}
    query = select(ImageRow.sha256, HeliostatRow.name, MeasurementRow.identifier)
    query = query.join(MeasurementRow, MeasurementRow.image_sha256 == ImageRow.sha256)
    query = query.join(HeliostatRow, MeasurementRow.heliostat_id == HeliostatRow.id)
    with database.reading() as session:
        for start in range(0, len(images), _CHUNK):
            some = query.where(MeasurementRow.image_sha256.in_(images[start : start + _CHUNK]))
            for sha256, name, identifier in session.execute(some.order_by(MeasurementRow.id)):
                owners[sha256].append(f"{name}/{identifier}")
    return owners


def _database_faults(session: Session) -> list[str]:
    connection = session.connection()
    if connection.dialect.name != "sqlite":
        return []
    found = [str(row[0]) for row in connection.exec_driver_sql("PRAGMA integrity_check")]
    orphans = connection.exec_driver_sql("PRAGMA foreign_key_check")
    return [fault for fault in found if fault != "ok"] + [
        f"{row[0]}: row {row[1]} refers to nothing" for row in orphans
    ]
