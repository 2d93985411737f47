"""`heliotwin check`: whether the store still is what it promised to keep."""

import re
from collections.abc import Sequence
from typing import Any

from sqlalchemy import func, not_, select
from sqlalchemy.orm import Session

from service.base.faults import StoreDamagedError
from service.base.progress import Progress
from service.store.database import Database
from service.store.images import ImageStore
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow

# Images that are asked for in one statement.
_CHUNK = 500

_KEPT = ImageRow.pruned_at.is_(None)

_IMAGE = re.compile(r"[0-9a-f]{2}/[0-9a-f]{62}")


def inspect_store(database: Database, images: ImageStore, step: Progress) -> dict[str, Any]:
    """Read every image that the database knows, and ask SQLite whether its file is sound.

    Returns
    -------
    dict
        ``images``: how many were read. ``pruned``: how many were given up, and are not looked for. ``bad``: for each
        that is missing or damaged its reason and the measurements (H/ID) that it belongs to. ``database``: what SQLite
        finds wrong; PostgreSQL looks after itself. ``unused`` and ``leftovers``: files that no row names and cut-off
        ones, which a fault left and which harm nothing.
    """
    with database.reading() as session:
        known = list(session.scalars(select(ImageRow.sha256).where(_KEPT).order_by(ImageRow.sha256)))
        pruned = session.scalars(select(func.count()).select_from(ImageRow).where(not_(_KEPT))).one()
        waiting = list(session.scalars(select(ImageRow.sha256).where(not_(_KEPT), ImageRow.removed_at.is_(None))))
        faults = _database_faults(session)
    # Terabytes take hours to read: no transaction waits for that.
    bad = {sha256: reason for sha256 in known if (reason := _reason(images, sha256, step)) is not None}
    bad = _still_kept(database, bad)
    owners = _owners(database, list(bad))
    listed = {sha256: {"reason": reason, "measurements": owners[sha256]} for sha256, reason in bad.items()}
    names = {*known, *waiting}
    files = [path.relative_to(images.root).as_posix() for path in images.root.rglob("*") if path.is_file()]
    stored = [name for name in files if _IMAGE.fullmatch(name)]
    return {
        "images": len(known),
        "pruned": pruned,
        "bad": listed,
        "database": faults,
        "unused": sum(name.replace("/", "") not in names for name in stored),
        "leftovers": len(files) - len(stored),
    }


def is_sound(report: dict[str, Any]) -> bool:
    """Whether nothing that was promised is gone."""
    return not report["bad"] and not report["database"]


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
    """Without images that were given up since they were listed: reading all takes hours."""
    digests, kept = list(bad), set[str]()
    with database.reading() as session:
        for start in range(0, len(digests), _CHUNK):
            some = select(ImageRow.sha256).where(_KEPT, ImageRow.sha256.in_(digests[start : start + _CHUNK]))
            kept.update(session.scalars(some))
    return {sha256: reason for sha256, reason in bad.items() if sha256 in kept}


def _owners(database: Database, images: Sequence[str]) -> dict[str, list[str]]:
    """The measurements (H/ID) that these images belong to."""
    owners: dict[str, list[str]] = {sha256: [] for sha256 in images}
    query = select(MeasurementRow.image_sha256, HeliostatRow.name, MeasurementRow.identifier).join(
        HeliostatRow, MeasurementRow.heliostat_id == HeliostatRow.id
    )
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
