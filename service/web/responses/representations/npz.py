"""The arrays as a NumPy archive."""

from service.base.arrays import pack
from service.web.responses.representation import Maps, Representation

NPZ = "application/x-npz"
NPZ_VENDOR = "application/vnd.numpy.npz"


def _write(maps: Maps) -> bytes:
    return pack(maps.arrays) if maps.packed is None else maps.packed


REPRESENTATION = Representation((NPZ, NPZ_VENDOR), "npz", _write)
