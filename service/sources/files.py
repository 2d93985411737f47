"""Safe access to external files: only regular files of a bounded size are opened."""

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from model.errors import InvalidInputError
from service.base.names import escape_control_characters

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
