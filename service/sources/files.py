"""Files of other people's folders: a regular one of a bearable size, or none is opened."""

import stat
from pathlib import Path

from model.errors import InvalidInputError

# The largest file of a measurement folder is deflectometry, some tens of megabytes.
_MOST_BYTES = 2**30


def require_regular(path: Path, name: str | None = None) -> Path:
    """``path``, where it is a regular file, or leads to one, that can be read into memory; nothing is opened for it.

    Raises
    ------
    InvalidInputError
        Where it is missing, too large, or anything else: who opens a pipe waits without end. ``name`` stands for the
        path in what it says.
    """
    shown = str(path) if name is None else name
    try:
        found = path.stat()
    except FileNotFoundError:
        raise InvalidInputError(f"{shown}: no such file") from None
    if not stat.S_ISREG(found.st_mode):
        raise InvalidInputError(f"{shown}: no regular file")
    if found.st_size > _MOST_BYTES:
        raise InvalidInputError(f"{shown}: {found.st_size} bytes, {_MOST_BYTES} are the most")
    return path
