"""A storm of 200 alarms: a field is imported, and a camera's computer sends photographs by a clock
that is an hour ahead.
"""

from datetime import timedelta
from pathlib import Path
from typing import Any, cast

from fastapi import FastAPI
from fastapi.testclient import TestClient

from heliotwin.demo.field import write_layout
from model.ephemeris import sun_positions
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.store.columns import now
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import QUIET, FakeOperations, client_of, png, poster

CLOCK, UNDATED = 187, 12
"""Heliostats whose photographs come by the wrong clock, and without times. One job waits."""


def storm_app(folder: Path, **changes: Any) -> FastAPI:
    """A service whose queue counts as stuck at once."""
    settings = Settings(data_dir=folder / "data", **QUIET | changes, alarm_queue_s=1e-3)
    return create_app(settings, FakeOperations())


def make_storm(app: FastAPI, folder: Path) -> None:
    """Import 200 heliostats, and send a photograph of each."""
    with client_of(app) as client:
        plant = write_layout(folder / "plant")
        runtime = cast(Runtime, app.state.runtime)
        import_folder(runtime, read_folder(folder / "plant", [], whole_field=True))
        names = list(plant.heliostats)
        assert len(names) >= CLOCK + UNDATED
        moment = (now() - timedelta(days=1)).replace(hour=11, minute=0, second=0, microsecond=0)
        azimuth, elevation = sun_positions([moment], plant.origin)[0].tolist()
        common = {
            "target": "calibration",
            "sun": {"azimuth_deg": azimuth, "elevation_deg": elevation},
        }
        for number, name in enumerate(names[: CLOCK + UNDATED]):
            ahead = (moment + timedelta(hours=1)).isoformat()
            taken_at = ahead if number < CLOCK else None
            send(client, name, number, taken_at=taken_at, **common)
        assert client.post("/v1/jobs/predictions", json={}).status_code == 202


def send(client: TestClient, name: str, number: int, **about: Any) -> None:
    """Post a photograph of a heliostat."""
    answer = poster(client)(png(number + 1), name, id=str(number), **about)
    assert answer.status_code == 201, answer.text
