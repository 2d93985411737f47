"""Safe access to external files: regular ones of a bounded size, and ZIP files of folders.

Their senders are not trusted.
"""

import errno
import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from model.errors import InvalidInputError
from service.base.errors import TooLargeError
from service.base.validation import escape_control_characters

# The largest files of a measurement folder are deflectometry, some tens of megabytes.
_MAX_BYTES = 2**30

MAX_JSON_BYTES = 2**26
"""Largest JSON document [bytes]."""

MAX_JSON_VALUES = 2_000_000
"""Most values of one: parsed and validated, each takes up to 300 bytes. Ten years of a heliostat
have some hundred thousand.
"""

_ROOT: ContextVar[Path | None] = ContextVar("root", default=None)


@contextmanager
def confined_to(root: Path) -> Iterator[None]:
    """Refuse files outside of ``root`` in this thread while the block runs.

    Links and ``..`` may lead to such files.
    """
    token = _ROOT.set(root.resolve())
    try:
        yield
    finally:
        _ROOT.reset(token)


def require_regular(path: Path, max_bytes: int | None = None) -> Path:
    """Return ``path`` if it is or leads to a regular file of at most ``max_bytes``.

    The file is not opened.

    Raises
    ------
    InvalidInputError
        If it is missing, too large, outside of what `confined_to` allows, or not a regular file.
        Opening a pipe, for example, would block forever.
    """
    root, most = _ROOT.get(), max_bytes or _MAX_BYTES
    try:
        if root is not None and not path.resolve().is_relative_to(root):
            raise InvalidInputError(f"{path}: leads outside of the folder; copy what it links to")
        found = path.stat()
    except FileNotFoundError:
        raise InvalidInputError(f"{path}: no such file") from None
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror}") from None
    if not stat.S_ISREG(found.st_mode):
        raise InvalidInputError(f"{path}: no regular file")
    if found.st_size > most:
        raise InvalidInputError(f"{path}: {found.st_size} bytes, {most} are the most")
    return path


def read_file(path: Path, max_bytes: int | None = None) -> bytes:
    """Read a file that `require_regular` accepts; InvalidInputError if it cannot be read."""
    try:
        return require_regular(path, max_bytes).read_bytes()
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror}") from None


def file_name(path: Path) -> str:
    """A path as messages show it."""
    return escape_control_characters(str(path))


def read_text(path: Path, max_bytes: int, otherwise: str | None = None) -> str:
    """Read a text file in UTF-8, or in the encoding ``otherwise``; InvalidInputError names the line
    of a byte that is none.
    """
    data = read_file(path, max_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if otherwise is not None:
            return data.decode(otherwise)
        line = data[: error.start].count(b"\n") + 1
        raise InvalidInputError(
            f"{file_name(path)}, line {line}: has a byte that is no UTF-8; save the file as UTF-8"
        ) from None


MAX_ENTRIES = 100_000
"""Most files and folders in a ZIP file."""

_SIGNATURE = b"PK\x01\x02"  # begins each entry of the file's directory
_MAX_NAME_BYTES = 255
# What file managers add to folders.
_LITTER = {"__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"}

# `zipfile` raises OverflowError for a place that no file can have.
_UNREADABLE = (
    *(BadZipFile, zlib.error, struct.error),
    *(EOFError, RuntimeError, ValueError, OverflowError),
)
# Of a name that is both a file and a folder, and of a place before the file's begin.
_UNREADABLE_ERRNOS = {errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.EINVAL}


def unpack_archive(
    file: IO[bytes],
    folder: Path,
    max_bytes: int,
    admit: Callable[[int], object] = lambda size_bytes: None,
) -> None:
    """Unpack the regular files of a ZIP file, without the top folder of all, into an empty folder.

    ``admit`` is called with their total size before the first is written, and may raise.

    Raises
    ------
    InvalidInputError
        If it is no ZIP file, or has a file that must not be written.
    TooLargeError
        If it has more than `MAX_ENTRIES`, or more than ``max_bytes`` when unpacked.
    """
    _require_few_entries(file)
    try:
        with ZipFile(file) as archive:
            paths = {entry: _safe_path(entry) for entry in archive.infolist() if _is_wanted(entry)}
            size = sum(entry.file_size for entry in paths)
            if size > max_bytes:
                raise TooLargeError(
                    f"file: {size} bytes unpacked, {max_bytes} are the most; zip fewer heliostats"
                )
            admit(size)
            top = os.path.commonpath([str(path.parent) for path in paths.values()] or ["."])
            for entry, path in paths.items():
                entry.filename = str(path.relative_to(top))
                archive.extract(entry, folder)
    except InvalidInputError:
        raise
    except (*_UNREADABLE, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _UNREADABLE_ERRNOS:
            raise  # the disk's
        reason = str(error).replace(str(folder), "")
        raise InvalidInputError(
            f"file: no readable ZIP file ({reason}); choose a .zip file of the folder"
        ) from None


def _require_few_entries(file: IO[bytes]) -> None:
    """Count the entries before ``ZipFile`` reads all of them into memory."""
    count = sum(part.count(_SIGNATURE) for part in iter(partial(file.read, 2**20), b""))
    if count > MAX_ENTRIES:
        raise TooLargeError(f"file: more than {MAX_ENTRIES} entries; zip fewer heliostats")


def _is_wanted(entry: ZipInfo) -> bool:
    *folders, name = entry.filename.replace("\\", "/").split("/")
    return bool(name) and _LITTER.isdisjoint((*folders, name))


def _safe_path(entry: ZipInfo) -> PurePosixPath:
    """The path of a file in the folder; InvalidInputError if it must not be written."""
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    reason = ""
    if path.is_absolute() or ".." in path.parts:
        reason = "leads outside of the folder; zip the folder itself"
    elif stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG):
        reason = "is a link or a device; zip what it links to"
    elif entry.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        reason = "has an unusual compression; zip it with Deflate"
    elif len(os.fsencode(path)) > _MAX_NAME_BYTES:
        reason = f"has a path of more than {_MAX_NAME_BYTES} bytes; rename it"
    if reason:
        name = escape_control_characters(str(path)[:_MAX_NAME_BYTES])
        raise InvalidInputError(f"file: {name} {reason}")
    return path
