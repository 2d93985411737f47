"""A dense field and its mirrors."""

from typing import cast

import numpy as np
from fastapi import FastAPI
from fastapi.testclient import TestClient

from heliotwin.demo.plant import ORIGIN, TARGET, properties
from model.plant import Heliostat, Plant
from model.surface import control_points
from service import store
from service.store.database import Database
from service.store.surface_versions import NewSurface
from service.twin.runtime import Runtime


def heights(rng: np.random.Generator) -> np.ndarray:
    """A mirror's surface (4, 8, 8) [m]: a few waves of half a millimetre on each facet."""
    x = np.linspace(0, np.pi, 8)
    waves = [
        np.outer(np.cos(i * x), np.cos(j * x)) for i in range(3) for j in range(3) if i + j > 1
    ]
    z = np.tensordot(rng.normal(0, 2e-4, (4, len(waves))), np.array(waves), axes=1)
    return np.asarray(z - z.mean(axis=(1, 2), keepdims=True))


SUN = {"azimuth_deg": 200.0, "elevation_deg": 20.0}


FLEET = {"target": TARGET.name, "sun": SUN, "resolution": 32}


FIELD = {
    f"B{row}{column}": (column * 4.2 - 4.2, 60 + row * 3.6, 1.8)
    for row in range(3)
    for column in range(3)
}


def fill(database: Database) -> None:
    """A dense field of nine; all but the last have a surface."""
    rng, plant = np.random.default_rng(3), Plant("demo", ORIGIN)
    with database.writing() as session:
        store.put_plant(session, "demo", ORIGIN)
        store.put_target(session, TARGET)
        for name, position in FIELD.items():
            mirror = Heliostat.juelich(name, position, 70.0)
            row, _ = store.put_heliostat(
                session, name, properties(mirror, plant), np.array(position)
            )
            if name != "B22":
                for _ in range(2):  # the second is the current one
                    z = heights(rng)
                    store.add_surface(
                        session, row, NewSurface("measured", z, 0 * z, control_points(mirror, z))
                    )


def runtime_of(client: TestClient) -> Runtime:
    return cast(Runtime, cast(FastAPI, client.app).state.runtime)
