"""Plans that have ended."""

from typing import Any

from fastapi import FastAPI
from fastapi.testclient import TestClient

from tests.service.web.pages import work

DAY = {
    "name": "June",
    "target": "lower",
    "first_at": "2026-06-21T02:00:00Z",
    "last_at": "2026-06-21T10:00:00Z",
}

DRUM = {
    "center": [0, 0, 55.2],
    "normal": [0, 1, 0],
    "radius": 4.1,
    "height": 5.2,
    "opening_deg": 60,
}


def planned(app: FastAPI, client: TestClient, **changes: Any) -> dict[str, Any]:
    """The job of a plan, when it has ended."""
    path = client.post("/v1/jobs/plans", json=DAY | {"step_minutes": 120} | changes).headers[
        "Location"
    ]
    work(app)
    job: dict[str, Any] = client.get(path).json()
    return job
