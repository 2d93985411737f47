"""Public routes without and with their rate limit: ``python -m benchmarks.public [--seconds
5]``.

A client without a key asks the real service for each public route on eight connections, each as
soon as it has its answer: first with no limit, then with the default limit and an empty burst.
Prints the requests per second that were served, and the ratio of the second to the first, which
must be below one. `/livez` and `/readyz` have no limit; their ratio is that of requests which are
refused, for an answer of 429 costs about as much. The client runs on the same machine as the
service.
"""

import argparse
import asyncio
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.record import log_row, recording
from service.base.settings import Settings
from tests.faults.harness import Process, Store

CONNECTIONS = 8
FORM = b"Content-Type: application/x-www-form-urlencoded\r\n"
WRONG_KEY = b"Authorization: Bearer htw_" + b"0" * 12 + b"_" + b"A" * 43 + b"\r\n"
ROUTES = {
    "GET /livez": b"",
    "GET /readyz": b"",
    "GET /login": b"",
    "GET /openapi.json": b"",
    "GET /docs": b"",
    "GET /docs/swagger-ui-bundle.js": b"",
    "GET /static/app.css": b"",
    "POST /session": FORM,
    "GET /v1/heliostats": WRONG_KEY,
}
HEALTH = ("GET /livez", "GET /readyz")


def request(route: str, headers: bytes) -> bytes:
    """One HTTP/1.1 request; a form holds a wrong key."""
    body = b"key=" + b"A" * 60 if route.startswith("POST") else b""
    length = b"Content-Length: %d\r\n" % len(body)
    return f"{route} HTTP/1.1\r\nHost: 127.0.0.1\r\n".encode() + headers + length + b"\r\n" + body


async def _answer(reader: asyncio.StreamReader) -> int:
    """Read one answer; return its status."""
    head = (await reader.readuntil(b"\r\n\r\n")).lower()
    _, _, length = head.partition(b"content-length:")
    await reader.readexactly(int(length.split(b"\r\n", 1)[0]))
    return int(head.split(b" ", 2)[1])


async def _ask(port: int, data: bytes, until_s: float, counts: Counter[int]) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    while time.monotonic() < until_s:
        writer.write(data)
        counts[await _answer(reader)] += 1
    writer.close()
    await writer.wait_closed()


async def rates(port: int, data: bytes, seconds: float) -> dict[int, float]:
    """Answers per second by status."""
    counts: Counter[int] = Counter()
    began = time.monotonic()
    await asyncio.gather(*(_ask(port, data, began + seconds, counts) for _ in range(CONNECTIONS)))
    return {status: number / (time.monotonic() - began) for status, number in counts.items()}


def measure(folder: Path, seconds: float, **environment: Any) -> dict[str, dict[int, float]]:
    """Answers per second by route and status, of a new service."""
    with Process(Store(folder, None), module="service", **environment) as service:
        found = {}
        for route, headers in ROUTES.items():
            data = request(route, headers)
            asyncio.run(
                rates(service.port, data, 1.0)
            )  # what is made once is made; a burst is over
            found[route] = asyncio.run(rates(service.port, data, seconds))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    rate = Settings.model_fields["public_requests_per_s"].default
    with tempfile.TemporaryDirectory() as folder:
        free = measure(Path(folder) / "free", options.seconds)
        few = {"HELIOTWIN_PUBLIC_REQUESTS_PER_S": str(rate), "HELIOTWIN_PUBLIC_REQUESTS_BURST": "1"}
        limited = measure(Path(folder) / "limited", options.seconds, **few)
    print(f"{'route':32} {'served/s':>9} {'allowed/s':>9} {'refused/s':>9} {'ratio':>6}")
    for route, answers in free.items():
        served, refused = sum(answers.values()), limited[route].get(429, 0.0)
        allowed = sum(limited[route].values()) - refused
        shown = "-" if route in HEALTH else f"{allowed / served:.2f}"
        print(f"{route:32} {served:9.0f} {allowed:9.1f} {refused:9.0f} {shown:>6}", flush=True)
        limit = (
            {} if route in HEALTH else {"allowed by the limit, share [%]": 100 * allowed / served}
        )
        cells = {"served without a limit, a second": served, "allowed, a second": allowed}
        log_row("Requests of one address without a key", f"`{route}`", cells | limit)


if __name__ == "__main__":
    with recording("public"):
        main()
