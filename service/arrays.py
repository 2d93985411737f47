"""Arrays to compressed npz bytes and back."""

import io
from collections.abc import Mapping

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
