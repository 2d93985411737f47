"""Time and memory that ``heliotwin export`` takes: ``python -m benchmarks.exporting
[--heliostats N ...]``.

Fills stores of N heliostats with photographs of random bytes and one surface per heliostat. Each
store is exported by a separate process. If the memory is the same for all, it does not grow with
the field.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.record import log_row, recording
from model.imaging import MeasuredFlux, Quality
from service import store
from service.base.fields import Sun
from service.base.settings import Settings
from service.sources.documents import read_targets
from service.sources.photograph import IncomingPhotograph
from service.store.backup import images_of
from service.store.columns import now
from service.store.database import Database
from service.store.surface_versions import NewSurface
from service.store.tables import ImageRow
from service.twin.photographs.ingest import measurement_row
from tests.service.conftest import ORIGIN, properties_document, tower_document


def fill(settings: Settings, heliostats: int, photographs: int, size: int) -> None:
    """A store with photographs of ``size`` bytes."""
    database, images, rng = (
        Database(settings.database),
        images_of(settings),
        np.random.default_rng(1),
    )
    database.upgrade()
    flux = np.full((256, 256), 100 / 256**2, dtype=np.float32)
    measured = MeasuredFlux(Quality(accepted=True), flux, flux[96:160, 96:160], np.zeros(2))
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        target = store.put_target(session, read_targets(tower_document())["lower"])[0]
    for number in range(heliostats):
        with database.writing() as session:
            place = (float(number % 50), float(number // 50), 1.0)
            row = store.put_heliostat(session, f"H{number:05d}", properties_document(), place)[0]
            for one in range(photographs):
                sun = Sun(azimuth_deg=5.0 * one, elevation_deg=30.0)
                about = IncomingPhotograph(
                    target.name, "cropped", sun, f"{one}", now(), (31234.0, 45012.0)
                )
                kept = measurement_row(about, measured, target.id, None)
                image = ImageRow(
                    sha256=images.put(rng.bytes(size)), media_type="image/png", size_bytes=size
                )
                image.width_px, image.height_px = 1000, 800
                store.add_measurement(session, row, image, kept)
            z = rng.normal(0, 2e-4, (4, 8, 8))
            points = np.stack([z, z, z], axis=-1)
            store.add_surface(
                session,
                row,
                NewSurface("network", z, abs(z), points, now(), "network", "1:none", [], 0.05),
            )
    database.close()


def export(settings: Settings, folder: Path) -> tuple[float, float]:
    """Seconds, and megabytes at most, that the verb takes."""
    environment = os.environ | {"HELIOTWIN_DATA_DIR": str(settings.data_dir)}
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "service", "export", str(folder), "--json"],
        env=environment,
        stdout=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return time.perf_counter() - started, used.ru_maxrss / 1e3


def main() -> None:
    """Print a line a size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--heliostats", type=int, nargs="+", default=[215, 2153])
    parser.add_argument("--photographs", type=int, default=8)
    parser.add_argument("--kilobytes", type=int, default=100, help="of a photograph")
    options = parser.parse_args()
    for heliostats in options.heliostats:
        with tempfile.TemporaryDirectory() as folder:
            settings = Settings(data_dir=Path(folder) / "data")
            fill(settings, heliostats, options.photographs, 1000 * options.kilobytes)
            seconds, megabytes = export(settings, Path(folder) / "out")
            files = sum(len(names) for _, _, names in os.walk(Path(folder) / "out"))
        print(
            f"{heliostats} heliostats x {options.photographs}: {files} files, {seconds:.0f} s,"
            f" {megabytes:.0f} MB",
            flush=True,
        )
        log_row(
            "Export of a store",
            f"{heliostats} heliostats with {options.photographs} photographs each",
            {"files": files, "time [s]": seconds, "memory at most [MB]": megabytes},
        )


if __name__ == "__main__":
    with recording("exporting"):
        main()
