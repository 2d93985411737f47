"""What it costs to write a flux map as JSON: ``python -m benchmarks.encoding``. Compare the
ratio.
"""

import json
import os

import numpy as np
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from benchmarks.record import log_row, recording
from benchmarks.speed import seconds
from service.web.responses.formats import json_answer

SIDE, REPEATS = 1024, 5
"""Pixels along each side of the map, the most that the service gives, and how often it
is written.
"""


class Nothing(BaseModel):
    """What goes with the map: nothing, so that the map's own cost shows."""


def main() -> None:
    """Print median times and sizes: number by number through Python's json, and as the service
    writes.
    """
    y, x = np.mgrid[-2 : 2 : SIDE * 1j, -2 : 2 : SIDE * 1j]
    flux = (3e4 * np.exp(-(x**2) - y**2) + np.random.default_rng(0).random((SIDE, SIDE))).astype(
        np.float32
    )
    before = JSONResponse({"flux": flux.tolist()}).body
    after = json_answer(Nothing(), flux=flux).body
    slow = seconds(lambda: JSONResponse({"flux": flux.tolist()}), REPEATS)
    fast = seconds(lambda: json_answer(Nothing(), flux=flux), REPEATS)
    same = all(
        np.array_equal(np.array(json.loads(bytes(b))["flux"], np.float32), flux)
        for b in (before, after)
    )
    print(
        f"A {SIDE} x {SIDE} float32 map as JSON, median of {REPEATS} (load of the machine:"
        f" {os.getloadavg()[0]:.1f})"
    )
    print(f"  Python's json: {slow:.3f} s, {len(before) / 1e6:.1f} MB")
    print(
        f"  orjson, as the service answers: {fast:.3f} s, {len(after) / 1e6:.1f} MB,"
        f" {slow / fast:.0f} times as fast"
    )
    print(f"  both read back as float32 bit by bit: {same}")
    table = f"A {SIDE} x {SIDE} float32 map as JSON"
    for row, taken, body in (
        ("Python's json", slow, before),
        ("orjson, as the service answers", fast, after),
    ):
        cells = {"time [s]": taken, "size [MB]": len(body) / 1e6, "speed-up": slow / taken}
        log_row(table, row, cells, n=REPEATS, of="repeats", compared_with="Python's json")


if __name__ == "__main__":
    with recording("encoding"):
        main()
