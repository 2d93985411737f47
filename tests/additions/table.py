"""Tables of numbers, one array after another."""

import io

import numpy as np

from service.web.responses.representations import Maps, Representation


def write(maps: Maps) -> bytes:
    buffer = io.StringIO()
    for name, array in maps.arrays.items():
        np.savetxt(
            buffer, array.reshape(len(array), -1), delimiter=",", header=f"{maps.title}: {name}"
        )
    return buffer.getvalue().encode()


REPRESENTATIONS = (Representation(("text/csv",), "csv", write),)
