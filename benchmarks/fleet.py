"""A field's light on one receiver: ``python -m benchmarks.fleet``. The machine is shared:
compare CPU times.

``--part N`` heliostats at most, of 200,000, are traced; what all of them take is projected from
those.
"""

import argparse
import resource
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import Estimate, log_row, recording
from heliotwin.demo.plant import ORIGIN, properties
from model.fleet import Superposition, aligned_field, superpose, tiles
from model.frames import sun_direction
from model.plant import Cylinder, Heliostat, Plant, Receiver, TargetPlane
from model.plant_model import JUELICH_MODEL, PlantModel
from model.prior import default_prior
from model.setup import Setup
from model.site import JUELICH
from model.sunshape import Pillbox
from model.surface import control_points
from model.tracing import Optics
from service import store
from service.base.settings import Settings
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import KINDS, field_forecasts
from service.jobs.worker import Worker
from service.store import queue
from service.store.surface_versions import NewSurface
from service.twin.engines import Threads
from service.twin.runtime import Runtime
from tests.field_rays import Land, onto_cylinder, onto_plane, trace_field

AREA = 33.0
"""Ground of each heliostat [m2]: a quarter of it is mirror."""

SUN = (-30.0, 35.0)
"""Azimuth and elevation [deg]."""


class Field:
    """``count`` heliostats to the north of a tower, from ``near`` [m] on, evenly dense by the
    golden angle.
    """

    def __init__(self, count: int, near: float) -> None:
        turns = np.arange(4 * count)
        radius, angle = (
            np.sqrt(near**2 + turns * AREA / np.pi),
            (turns * np.pi * (3 - np.sqrt(5))) % (2 * np.pi) - np.pi,
        )
        north = np.flatnonzero(np.abs(angle) < np.pi / 3)[:count]
        self.radius, self.angle = radius[north], angle[north]

    def every(self, step: int = 1) -> Iterator[Heliostat]:
        """Each ``step``-th of them."""
        for index in range(0, len(self.radius), step):
            radius, angle = self.radius[index], self.angle[index]
            position = np.array([radius * np.sin(angle), radius * np.cos(angle), 1.8])
            yield Heliostat.juelich(f"H{index}", position, max(50.0, float(radius)))


def plane(height: float, side: float) -> TargetPlane:
    """A square that faces the field, [m]."""
    return TargetPlane(
        "plane",
        np.array([0.0, 0, height]),
        np.array([0.0, 1, 0]),
        np.array([0.0, 0, 1]),
        side,
        side,
    )


@dataclass
class Meter:
    """Wall and processor seconds of a block."""

    wall: float = 0.0
    cpu: float = 0.0

    def __enter__(self) -> "Meter":
        self.wall, self.cpu = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall, self.cpu = time.perf_counter() - self.wall, time.process_time() - self.cpu

    def __str__(self) -> str:
        return f"{self.cpu:.2f} s of CPU, {self.wall:.2f} s by the clock"


def peak_mib() -> float:
    """Most memory that the process ever held [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def setups(field: Field, aim: TargetPlane, every: int = 1) -> Iterator[Setup]:
    """Each ``every``-th heliostat of a field, with an individual mirror."""
    rng, prior, sun = np.random.default_rng(0), default_prior(), sun_direction(*SUN)
    for heliostat in field.every(every):
        z = prior.surface(rng.normal(size=len(prior.basis)))
        yield Setup(heliostat, control_points(heliostat, z), sun, aim)


def against_monte_carlo() -> None:
    """A dense field under a low sun, on a plane and on a cylinder, against a Monte Carlo of its
    own.
    """
    sun, square, half_angle = sun_direction(145.0, 15.0), plane(30.0, 9.0), 4.65e-3
    drum = Cylinder("drum", square.center + [0, 3, 0], square.normal, square.up, 3.0, 8.0)
    heliostats = [
        Heliostat.juelich(
            f"{row}-{column}", np.array([4.4 * column - 8.8, 55 + 3.8 * row, 1.8]), 70.0
        )
        for row in range(5)
        for column in range(5)
    ]
    lands: list[tuple[str, Receiver, Land]] = [
        ("plane", square, onto_plane(square)),
        ("cylinder", drum, onto_cylinder(drum)),
    ]
    for name, receiver, land in lands:
        aim, size = np.asarray(receiver.center), (receiver.width, receiver.height)
        traced = {
            shadows: trace_field(
                heliostats,
                sun,
                aim,
                land,
                size,
                (18, 18),
                half_angle=half_angle,
                rays=40_000,
                seed=1,
                shadows=shadows,
            )
            for shadows in (True, False)
        }
        expected, powers = traced[True]
        task = Superposition(receiver, PlantModel(JUELICH, Optics(Pillbox(half_angle))), (72, 72))
        some = [Setup(one, control_points(one), sun, square, aim=aim) for one in heliostats]
        neighbours = aligned_field([(one, aim) for one in heliostats], sun, JUELICH_MODEL)
        found = superpose(task, tiles(some, neighbours))
        coarse = found.irradiance.reshape(18, 4, 18, 4).mean(axis=(1, 3))
        print(
            f"  25 dense heliostats, {name}: neighbours leave"
            f" {powers.sum() / traced[False][1].sum():.3f} of the light (forecast over Monte Carlo"
            f" {found.power / powers.sum():.4f}); land {coarse.sum() / expected.sum():.4f}, L1 of"
            f" the maps {np.abs(coarse - expected).sum() / expected.sum():.4f}"
        )
        log_row(
            "Blocking and shading of a dense field",
            name,
            {
                "light that neighbours leave": powers.sum() / traced[False][1].sum(),
                "forecast over reference, thrown": found.power / powers.sum(),
                "landed": coarse.sum() / expected.sum(),
                "L1 of the maps": np.abs(coarse - expected).sum() / expected.sum(),
            },
            n=len(heliostats),
            of="heliostats",
            compared_with="a Monte Carlo tracer that shares no code",
        )


def log_meter(row: str, meter: Meter, n: int) -> None:
    """Record the time of a field forecast."""
    goal = "<= 10" if row == "plane, 256 x 256, neighbours shade and block" else None
    cells = {"processor [s]": meter.cpu, "wall, two threads [s]": Estimate(meter.wall, goal=goal)}
    log_row("Flux of a field", row, cells, n=n, of="heliostats")


def field_of_2000() -> None:
    """Planes, a cylinder, with neighbours and without."""
    field, square = Field(2000, 60.0), plane(50.0, 10.0)
    drum = Cylinder("drum", square.center + [0, 3, 0], square.normal, square.up, 3.0, 8.0, 180.0)
    some = list(setups(field, square))
    cases: list[tuple[str, Receiver, int, bool]] = [
        ("plane, 256 x 256, no neighbours", square, 256, False),
        ("plane, 256 x 256, neighbours shade and block", square, 256, True),
        ("plane, 128 x 128, neighbours shade and block", square, 128, True),
        ("half a cylinder, 128 x 128, neighbours", drum, 128, True),
    ]
    for name, receiver, side, has_neighbours in cases:
        with Meter() as meter:
            neighbours = None
            if has_neighbours:
                neighbours = aligned_field(
                    [(setup.heliostat, square.center) for setup in some], some[0].sun, JUELICH_MODEL
                )
            total = superpose(
                Superposition(receiver, JUELICH_MODEL, (side, side)),
                tiles(some, neighbours),
                Threads(2),
            )
        landed = total.irradiance.mean() * receiver.width * receiver.height
        print(
            f"  2,000 heliostats, {name}: {meter}; {total.power / 1e6:.2f} MW thrown,"
            f" {landed / 1e6:.2f} MW land"
        )
        log_meter(name, meter, 2000)


def stored_field() -> None:
    """The same from a store, as a job of the service."""
    field, square, rng, prior = (
        Field(2000, 60.0),
        plane(50.0, 10.0),
        np.random.default_rng(0),
        default_prior(),
    )
    place = Plant("bench", np.array(ORIGIN))
    with tempfile.TemporaryDirectory() as folder:
        runtime = Runtime.from_settings(Settings(data_dir=Path(folder)))
        runtime.database.upgrade()
        with runtime.database.writing() as session:
            store.put_plant(session, "bench", ORIGIN)
            store.put_target(session, square)
            for one in field.every():
                row, _ = store.put_heliostat(
                    session, one.name, properties(one, place), one.position
                )
                z = prior.surface(rng.normal(size=len(prior.basis)))
                store.add_surface(
                    session, row, NewSurface("measured", z, 0 * z, control_points(one, z))
                )
        sun = {"azimuth_deg": SUN[0] % 360, "elevation_deg": SUN[1]}
        payload = field_forecasts.FleetForecastIn.model_validate({"target": "plane", "sun": sun})
        job, _ = enqueue(runtime, field_forecasts.KIND, payload, "bench")
        with Meter() as meter:
            Worker(runtime, KINDS, "bench", threading.Event()).work()
        with runtime.database.reading() as session:
            result = queue.get_job(session, job.id).result or {}
        print(
            f"  the same as a job of the service, SQLite: {meter}; {result['heliostats']}"
            " heliostats"
        )
        log_meter("plane, as a job of the service", meter, result["heliostats"])
        runtime.close()


def field_of_200000(part: int) -> None:
    """All neighbours, and parts of the mirrors, evenly over the field."""
    field, square = Field(200_000, 100.0), plane(200.0, 25.0)
    print(f"  200,000 heliostats: memory before {peak_mib():.0f} MiB")
    with Meter() as meter:
        neighbours = aligned_field(
            ((one, square.center) for one in field.every()), sun_direction(*SUN), JUELICH_MODEL
        )
    print(f"  where all 200,000 mirrors stand: {meter}; memory {peak_mib():.0f} MiB")
    table = "A field of 200,000 heliostats, of which a part is traced"
    cells = {"processor [s]": meter.cpu, "memory [MiB]": peak_mib()}
    log_row(table, "positions of all", cells, n=200_000, of="heliostats")
    rates = []
    for count in (part // 16, part // 4, part):
        some = setups(field, square, every=200_000 // count)
        with Meter() as meter:
            total = superpose(
                Superposition(square, JUELICH_MODEL, (128, 128)),
                tiles(some, neighbours),
                Threads(2),
            )
        rates.append((total.heliostats, meter.cpu))
        print(
            f"  {total.heliostats:,} of them traced, 128 x 128: {meter.cpu:.1f} s of CPU, "
            f"{1e3 * meter.cpu / total.heliostats:.2f} ms each; memory {peak_mib():.0f} MiB"
        )
        cells = {"processor [s]": meter.cpu, "memory [MiB]": peak_mib()}
        log_row(table, f"{total.heliostats} traced", cells, n=total.heliostats, of="heliostats")
    counts, times = zip(*rates, strict=True)
    slope, start = np.polyfit(counts, times, 1)
    print(
        f"  projected, linear in the number: {(start + slope * 200_000) / 60:.1f} min of CPU for"
        " all 200,000"
    )
    cells = {"processor [s]": start + slope * 200_000}
    log_row(table, "all, projected from the parts", cells, n=200_000, of="heliostats")


def main() -> None:
    """Print times and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--part", type=int, default=8000, help="most of the 200,000 heliostats that are traced"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)  # the engine has separate threads
    print("Fleet (2 threads)")
    field_of_200000(options.part)  # first: memory is what the process ever held
    against_monte_carlo()
    field_of_2000()
    stored_field()


if __name__ == "__main__":
    with recording("fleet"):
        main()
