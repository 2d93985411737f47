"""`heliotwin check`: whether the store still is what it promised to keep."""

import re
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.base.faults import StoreDamagedError
from service.base.progress import Progress
from service.store.database import Database
from service.store.images import ImageStore
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow

_IMAGE = re.compile(r"[0-9a-f]{2}/[0-9a-f]{62}")


def inspect_store(database: Database, images: ImageStore, step: Progress) -> dict[str, Any]:
    """Read every image that the database knows, and ask SQLite whether its file is sound.

    Returns
    -------
    dict
        ``images``: how many were read. ``bad``: for each that is missing or damaged its reason and the measurements
        (H/ID) that it belongs to. ``database``: what SQLite finds wrong; PostgreSQL looks after itself. ``unused`` and
        ``leftovers``: files that no row names and cut-off ones, which a fault left and which harm nothing.
    """
    with database.reading() as session:
        known = list(session.scalars(select(ImageRow.sha256).order_by(ImageRow.sha256)))
        faults = _database_faults(session)
        bad = {sha256: reason for sha256 in known if (reason := _reason(images, sha256, step)) is not None}
        listed = {sha256: {"reason": reason, "measurements": _of(session, sha256)} for sha256, reason in bad.items()}
    names = set(known)
    files = [path.relative_to(images.root).as_posix() for path in images.root.rglob("*") if path.is_file()]
    stored = [name for name in files if _IMAGE.fullmatch(name)]
    return {
        "images": len(known),
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


def _of(session: Session, sha256: str) -> list[str]:
    query = (
        select(HeliostatRow.name, MeasurementRow.identifier)
        .join(MeasurementRow, MeasurementRow.heliostat_id == HeliostatRow.id)
        .where(MeasurementRow.image_sha256 == sha256)
    )
    return [f"{name}/{identifier}" for name, identifier in session.execute(query)]


def _database_faults(session: Session) -> list[str]:
    connection = session.connection()
    if connection.dialect.name != "sqlite":
        return []
    found = [str(row[0]) for row in connection.exec_driver_sql("PRAGMA integrity_check")]
    orphans = connection.exec_driver_sql("PRAGMA foreign_key_check")
    return [fault for fault in found if fault != "ok"] + [
        f"{row[0]}: row {row[1]} refers to nothing" for row in orphans
    ]
