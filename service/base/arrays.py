"""Conversion of arrays to compressed npz bytes and back, and of values to JSON."""

import io
import math
import zlib
from collections.abc import Mapping
from typing import Any
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError


def pack(arrays: Mapping[str, NDArray[np.generic]]) -> bytes:
    """Compress named arrays to npz. Equal arrays give equal bytes."""
    buffer = io.BytesIO()
    # As `numpy.savez_compressed`, at the fastest level: noise in images leaves little to compress.
    with ZipFile(buffer, "w", ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return buffer.getvalue()


def unpack(data: bytes) -> dict[str, NDArray[np.float32]]:
    """The arrays of an npz file. Pickled objects are rejected."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def unpack_untrusted(data: bytes, max_bytes: int, where: str) -> dict[str, NDArray[Any]]:
    """Read the arrays of an npz file from an untrusted source.

    The declared types and sizes are checked before anything is decompressed.

    Raises
    ------
    InvalidInputError
        If the data are not an npz file of numbers, or if its arrays have more than ``max_bytes``.
        The message names ``where``.
    """
    try:
        with ZipFile(io.BytesIO(data)) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            if sum(sizes.values()) > max_bytes:
                raise InvalidInputError(
                    f"{where}: declares {sum(sizes.values())} bytes of arrays; at most {max_bytes}"
                    " are read"
                )
            for name, size in sizes.items():
                _require_declared(archive, name, size, where)
        return unpack(data)
    except InvalidInputError:
        raise
    except (BadZipFile, zlib.error, RuntimeError, OSError, ValueError, EOFError) as error:
        raise InvalidInputError(f"{where}: not an npz file of numbers ({error})") from None


def _require_declared(archive: ZipFile, name: str, size: int, where: str) -> None:
    """Raise `InvalidInputError` unless a member's header declares numbers of at most ``size``
    bytes.
    """
    with archive.open(name) as member:
        version = np.lib.format.read_magic(member)
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(member)
    if dtype.kind not in "fiu":
        raise InvalidInputError(
            f"{where}: {name} must hold real numbers, got the type {dtype}; save floats"
        )
    if math.prod(shape) * dtype.itemsize > size:
        raise InvalidInputError(
            f"{where}: {name} declares the shape {shape}, but has {size} bytes only; save it again"
        )


def pair_or_none(first: float | None, second: float | None) -> tuple[float, float] | None:
    """A pair of both numbers, or None if one is missing."""
    return None if first is None or second is None else (first, second)


def to_json_value(value: Any) -> Any:
    """Convert ``value`` to JSON types. Non-finite numbers become null."""
    if isinstance(value, dict):
        return {str(key): to_json_value(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [to_json_value(entry) for entry in value]
    if isinstance(value, np.generic):
        return to_json_value(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value
