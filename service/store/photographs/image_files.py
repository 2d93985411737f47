"""Image files: stored once under their SHA-256, written atomically."""

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from service.base.errors import StoreDamagedError, UnsupportedImageError
from service.base.processes import file_lock

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

        See `service.store.photographs.image_retention` for when this is allowed.
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
