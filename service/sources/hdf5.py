"""Safe access to HDF5 files of others: datasets of bounded size, and none in other files."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from service.base.names import escape_control_characters
from service.sources.files import file_name, require_regular

Array = NDArray[np.float64]

_MAX_TEXT_BYTES = 4096
_MAX_MEMBERS = 100_000


@contextmanager
def open_hdf5(file: Path) -> Iterator["Hdf5Group"]:
    """Open an HDF5 file for reading.

    Raises
    ------
    InvalidInputError
        If it is none, or damaged.
    """
    try:
        with h5py.File(require_regular(file), "r") as data:
            yield Hdf5Group(data, file_name(file))
    except InvalidInputError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise InvalidInputError(f"{file_name(file)}: no readable HDF5 file ({error})") from None


@dataclass(frozen=True, eq=False)
class Hdf5Group:
    """A group of an HDF5 file; messages name the ``file`` and the path inside of it.

    Links, also those to other files, are rejected before they are followed.
    """

    members: h5py.Group
    file: str

    @property
    def place(self) -> str:
        """The file, and the path inside of it."""
        path = escape_control_characters(str(self.members.name).lstrip("/"))[:200]
        return f"{self.file}, {path}" if path else self.file

    def __contains__(self, name: str) -> bool:
        return name in self.members

    @property
    def names(self) -> list[str]:
        """Names of its members in order."""
        if len(self.members) > _MAX_MEMBERS:
            raise self.refuse(f"has {len(self.members)} members; at most {_MAX_MEMBERS} are read")
        return sorted(self.members.keys())

    def refuse(self, problem: str) -> InvalidInputError:
        """The error of something that is not understood."""
        return InvalidInputError(f"{self.place}: {problem}")

    def group(self, path: str) -> "Hdf5Group":
        """The group of a path ``a/b/c``."""
        found = self
        for name in path.split("/"):
            member = found._member(name)
            if not isinstance(member, h5py.Group):
                raise found.refuse(f"'{name}' must be a group")
            found = Hdf5Group(member, self.file)
        return found

    def groups(self) -> dict[str, "Hdf5Group"]:
        """All members, which must be groups, by name."""
        return {name: self.group(name) for name in self.names}

    def numbers(
        self, name: str, shape: Sequence[int | None], most: int, unit: str = "values"
    ) -> Array:
        """Numbers of a dataset; None in ``shape`` is any length.

        At most ``most`` values are read; ``unit`` is what the message calls a row of them.
        """
        found = self._dataset(name)
        fits = found.shape is not None and len(found.shape) == len(shape)
        fits = fits and all(n in (None, m) for n, m in zip(shape, found.shape, strict=True))
        if found.dtype.kind not in "fiu" or not fits:
            asked = ", ".join("n" if n is None else str(n) for n in shape)
            asked = f"shape ({asked}{',' * (len(shape) == 1)})" if shape else "no dimension"
            raise self.refuse(
                f"'{name}' must be numbers of {asked}, got {found.dtype} {found.shape}"
            )
        declared = max(math.prod(found.shape), math.prod(found.chunks or (0,)))
        if declared > most or found.dtype.itemsize > 8:
            row = math.prod(n for n in shape if n is not None)
            raise self.refuse(
                f"'{name}' declares the shape {found.shape}; at most {most // row} {unit} are read"
            )
        return np.asarray(found[()], dtype=np.float64)

    def number(self, name: str) -> float:
        """The finite number of a dataset without a dimension."""
        value = float(self.numbers(name, (), 1))
        if not math.isfinite(value):
            raise self.refuse(f"'{name}' must be finite, got {value}")
        return value

    def dimensions(self, name: str) -> int:
        """Number of a dataset's dimensions."""
        return len(self._dataset(name).shape or ())

    def truth(self, name: str) -> bool:
        """The truth value of a dataset."""
        found = self._dataset(name)
        if found.shape != () or found.dtype.kind != "b":
            raise self.refuse(f"'{name}' must be true or false, got {found.dtype} {found.shape}")
        return bool(found[()])

    def text(self, name: str) -> str:
        """The text of a dataset."""
        found = self._dataset(name)
        if found.shape != () or found.dtype.kind not in "OS" or found.dtype.itemsize > 4096:
            raise self.refuse(f"'{name}' must be text, got {found.dtype} {found.shape}")
        value = found[()]
        if not isinstance(value, bytes) or len(value) > _MAX_TEXT_BYTES:
            raise self.refuse(f"'{name}' must be a short text")
        return value.decode("utf-8", "replace")

    def _dataset(self, name: str) -> h5py.Dataset:
        found = self._member(name)
        if not isinstance(found, h5py.Dataset):
            raise self.refuse(f"'{name}' must be a dataset")
        if found.external or found.is_virtual:
            raise self.refuse(
                f"the numbers of '{name}' are in another file; copy them into this one"
            )
        return found

    def _member(self, name: str) -> object:
        """A member; raises InvalidInputError if it is missing, or a link."""
        link = self.members.get(name, getlink=True)
        if link is None:
            raise self.refuse(f"'{name}' is missing")
        if not isinstance(link, h5py.HardLink):
            raise self.refuse(f"'{name}' is a link; copy what it links to into this file")
        return self.members[name]
