"""Arrays to compressed npz bytes and back, and values as JSON knows them."""

import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def pack(arrays: Mapping[str, NDArray[np.generic]]) -> bytes:
    """Named arrays as compressed npz, the same bytes for the same arrays."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # numpy's stub takes the names for flags
    return buffer.getvalue()


def unpack(data: bytes) -> dict[str, NDArray[np.float32]]:
    """The arrays of an npz; objects are refused."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def pair(first: float | None, second: float | None) -> tuple[float, float] | None:
    """Both numbers, or None where one is missing."""
    return None if first is None or second is None else (first, second)


def plain(value: Any) -> Any:
    """``value`` as JSON knows it; figures that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value
