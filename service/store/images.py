"""The image files: each kept once under the SHA-256 of its bytes, written whole or not at all."""

import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from service.base.faults import StoreDamagedError, UnsupportedImageError

# The formats that `service.sources.decode` reads, by how their files begin.
_SIGNATURES = {
    b"\x89PNG\r\n\x1a\n": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"II*\x00": "image/tiff",
    b"MM\x00*": "image/tiff",
    b"BM": "image/bmp",
}

_REMEDY = "post it again, or restore it from a back-up (`heliotwin check` lists all such images)"


def media_type(data: bytes) -> str:
    """The image format by its first bytes, whatever its sender calls it.

    Raises
    ------
    UnsupportedImageError
        Where it is none of the accepted formats.
    """
    for signature, name in _SIGNATURES.items():
        if data.startswith(signature):
            return name
    raise UnsupportedImageError("image: must be a PNG, JPEG, TIFF or BMP file")


def digest(data: bytes) -> str:
    """SHA-256 of ``data`` in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def _require_same(sha256: str, found: str) -> None:
    if found != sha256:
        raise StoreDamagedError(f"image {sha256} is damaged in the store; {_REMEDY}")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class ImageStore:
    """A folder of images, ``ab/cdef...`` for the digest ``abcdef...``."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, sha256: str) -> Path:
        """Where the image of this digest lies."""
        return self.root / sha256[:2] / sha256[2:]

    def put(self, data: bytes) -> str:
        """Keep ``data`` and return its digest; on return it is on the disk, also after a power cut."""
        sha256 = digest(data)
        path = self.path(sha256)
        if not self._holds(sha256):  # also where a fault has altered it: writing it again repairs the store
            self._write(path, data)
        return sha256

    def _holds(self, sha256: str) -> bool:
        path = self.path(sha256)
        return path.is_file() and digest(path.read_bytes()) == sha256

    def _write(self, path: Path, data: bytes) -> None:
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
        for folder in (path.parent, self.root):
            _sync_folder(folder)

    def read(self, sha256: str) -> bytes:
        """The bytes of an image.

        Raises
        ------
        StoreDamagedError
            Where the file is gone or is not what was put there.
        """
        with self._opened(sha256) as file:
            data = file.read()
        _require_same(sha256, digest(data))
        return data

    def checked(self, sha256: str) -> Path:
        """Where the image lies, after all its bytes were read and found to be those that were put there.

        Raises
        ------
        StoreDamagedError
            Where the file is gone or is not what was put there.
        """
        with self._opened(sha256) as file:
            _require_same(sha256, hashlib.file_digest(file, "sha256").hexdigest())
        return self.path(sha256)

    def remove(self, sha256: str) -> None:
        """Take the image away, where it is there; `service.store.photographs` says when that may be."""
        self.path(sha256).unlink(missing_ok=True)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Nothing is removed while the block runs, by any process of this store: for who reads all that rows name."""
        with self._lock_file() as descriptor:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            yield

    @contextmanager
    def removing(self) -> Iterator[bool]:
        """Whether images may be removed while the block runs: False where somebody has them `held`."""
        with self._lock_file() as descriptor:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True

    @contextmanager
    def _lock_file(self) -> Iterator[int]:
        """Beside the folder, in which everything is an image; its lock goes with whoever took it, even if killed."""
        self.root.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.root.with_name(f"{self.root.name}.lock"), os.O_CREAT | os.O_RDWR, 0o644)
        try:
            yield descriptor
        finally:
            os.close(descriptor)

    def _opened(self, sha256: str) -> BufferedReader:
        try:
            return self.path(sha256).open("rb")
        except FileNotFoundError as error:
            raise StoreDamagedError(f"image {sha256} is missing from the store; {_REMEDY}") from error
