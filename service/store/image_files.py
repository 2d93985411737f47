"""Image files: stored once under their SHA-256, written atomically, deleted by age or quota.

Rows and their fluxes remain after a deletion.
"""

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from io import BufferedReader
from pathlib import Path
from typing import Literal

from sqlalchemy import ColumnElement, Select, and_, exists, not_, select, tuple_
from sqlalchemy.orm import Session, aliased

from model.times import format_time
from service.base.errors import StoreDamagedError, UnsupportedImageError
from service.base.processes import file_lock
from service.base.settings import Settings
from service.store import audit, queue, sizes
from service.store.surface_versions import valid_since
from service.store.tables import ImageRow, MeasurementRow, SurfaceRow, surface_measurements

logger = logging.getLogger("heliotwin.service")

# The formats that `service.sources.decode` reads, by their first bytes.
_SIGNATURES = {
    b"\x89PNG\r\n\x1a\n": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"II*\x00": "image/tiff",
    b"MM\x00*": "image/tiff",
    b"BM": "image/bmp",
}

_REMEDY = "post it again, or restore it from a back-up (`heliotwin check` lists all such images)"


def media_type(data: bytes) -> str:
    """The image format by its first bytes, regardless of the declared type.

    Raises
    ------
    UnsupportedImageError
        If it is not an accepted format.
    """
    for signature, name in _SIGNATURES.items():
        if data.startswith(signature):
            return name
    raise UnsupportedImageError("image: must be a PNG, JPEG, TIFF or BMP file")


def digest(data: bytes) -> str:
    """SHA-256 of ``data`` in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def _require_same(sha256: str, stored: str) -> None:
    if stored != sha256:
        raise StoreDamagedError(f"image {sha256} is damaged in the store; {_REMEDY}")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file atomically: readers find all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".new-")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)


class ImageStore:
    """A folder of images, with ``ab/cdef...`` for the digest ``abcdef...``."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, sha256: str) -> Path:
        """The path of the image with this digest."""
        return self.root / sha256[:2] / sha256[2:]

    def put(self, data: bytes) -> str:
        """Store ``data`` durably (it survives a power failure) and return its digest."""
        sha256 = digest(data)
        path = self.path(sha256)
        # A damaged file is written again, which repairs the store.
        if not self._holds(sha256):
            self._write(path, data)
        return sha256

    def _holds(self, sha256: str) -> bool:
        path = self.path(sha256)
        return path.is_file() and digest(path.read_bytes()) == sha256

    def _write(self, path: Path, data: bytes) -> None:
        _write_whole(path, data)
        for folder in (path.parent, self.root):
            _sync_folder(folder)

    def read(self, sha256: str) -> bytes:
        """The bytes of an image.

        Raises
        ------
        StoreDamagedError
            If the file is missing or damaged.
        """
        with self._opened(sha256) as file:
            data = file.read()
        _require_same(sha256, digest(data))
        return data

    def checked(self, sha256: str) -> Path:
        """The path of an image, after verification of all its bytes.

        Raises
        ------
        StoreDamagedError
            If the file is missing or damaged.
        """
        with self._opened(sha256) as file:
            _require_same(sha256, hashlib.file_digest(file, "sha256").hexdigest())
        return self.path(sha256)

    def remove(self, sha256: str) -> None:
        """Delete the image and its thumbnail if they exist.

        See `service.store.image_files` for when this is allowed.
        """
        self.path(sha256).unlink(missing_ok=True)
        self._thumbnail_path(sha256).unlink(missing_ok=True)

    def _thumbnail_path(self, sha256: str) -> Path:
        """Path outside the image folder, which holds only original images."""
        return self.root.with_name("thumbnails") / sha256[:2] / f"{sha256[2:]}.jpg"

    def thumbnail(self, sha256: str, make: Callable[[], bytes]) -> bytes:
        """The stored thumbnail; without one, that of ``make``, which is stored if possible."""
        path = self._thumbnail_path(sha256)
        try:
            return path.read_bytes()
        except FileNotFoundError:
            made = make()
        try:
            _write_whole(path, made)
        except OSError as error:  # The thumbnail is shown even if, for example, the disk is full.
            logger.warning("the thumbnail of image %s cannot be kept: %s", sha256, error)
        return made

    @contextmanager
    def held(self) -> Iterator[None]:
        """Block deletions by any process of this store while the block runs.

        For readers of all images that the rows name.
        """
        with file_lock(self._lock(), shared=True):
            yield

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """Lock for deletions: yields False if a reader uses `held`."""
        with file_lock(self._lock(), wait=False) as is_free:
            yield is_free

    def _lock(self) -> Path:
        """Path of the lock file, outside the image folder."""
        self.root.parent.mkdir(parents=True, exist_ok=True)
        return self.root.with_name(f"{self.root.name}.lock")

    def _opened(self, sha256: str) -> BufferedReader:
        try:
            return self.path(sha256).open("rb")
        except FileNotFoundError as error:
            raise StoreDamagedError(
                f"image {sha256} is missing from the store; {_REMEDY}"
            ) from error


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
