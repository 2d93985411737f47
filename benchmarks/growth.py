"""What a year of a plant takes on the disk: ``python -m benchmarks.growth [--database
postgres] [--share S]``.

Fills a store with a share of a year, spread over the year, by the store's own functions: rows as
the service writes them, with fluxes that it measured on real photographs. Prints the bytes of a row
of each table, what a year comes to, with and without the default retention, and how long the main
queries and the pruning take at the size that was filled.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from sqlalchemy import func, inspect, select, text
from sqlalchemy.orm import Session

from benchmarks import data_folder
from benchmarks.record import log_row, recording
from model.fleet import Losses
from model.imaging import ImageKind, MeasuredFlux
from model.imaging.quality import refused
from service import store
from service.base.arrays import pack
from service.base.fields import Sun
from service.base.settings import Settings
from service.sources.documents import read_targets
from service.sources.photograph import IncomingPhotograph
from service.store import audit, deletion, image_files, queue, sizes
from service.store.backup import images_of
from service.store.columns import Base, now
from service.store.database import Database
from service.store.image_files import digest
from service.store.job_tables import JobStepRow
from service.store.listing import Portion
from service.store.surface_versions import NewSurface
from service.store.tables import ForecastRow, ImageRow, MeasurementRow
from service.twin import operations
from service.twin.alarms.field_overview import read_summaries
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.forecasts.watts import light_watts
from service.twin.photographs.ingest import measurement_row
from tests.faults.harness import new_store
from tests.service.conftest import ORIGIN, properties_document, tower_document

HELIOSTATS = 2000
REFUSED = 0.2
IMAGE_KB = 360.0


@dataclass(frozen=True)
class Rate:
    """How much of something comes in a year, by assumption, and for how many days its rows are
    kept.
    """

    what: str
    a_year: float
    table: str
    kept_days: float = 0.0


def rates(settings: Settings) -> list[Rate]:
    """Eight photographs of each heliostat a day, a surface a week; forecasts and jobs as an
    operator's day has them.
    """
    photographed = HELIOSTATS * 8 * 365
    jobs = 50 * 365
    return [
        Rate("photographs, accepted", photographed * (1 - REFUSED), "measurements"),
        Rate("photographs, refused", photographed * REFUSED, "measurements"),
        Rate("surfaces", HELIOSTATS * 52, "surfaces"),
        Rate("forecasts", 500 * 365, "forecasts", settings.forecast_retention_days),
        Rate("jobs", jobs, "jobs", settings.job_retention_days),
        Rate(
            "audit entries",
            jobs + HELIOSTATS * 52 + 200 * 365,
            "audit",
            settings.audit_retention_days,
        ),
    ]


# --- filling
# --------------------------------------------------------------------------------------------------


def measured_fluxes(plane: Any) -> list[tuple[ImageKind, MeasuredFlux]]:
    """What the service measures on real photographs, each made another by a little of a camera's
    noise.
    """
    rng, found = np.random.default_rng(7), list[tuple[ImageKind, MeasuredFlux]]()
    kinds: tuple[ImageKind, ...] = ("flux", "cropped")
    files = [
        (kind, file)
        for kind in kinds
        for file in sorted(data_folder().glob(f"*/Calibration/*-{kind}.png"))
    ]
    for kind, file in islice(cycle(files), 2 * len(files)):
        pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert pixels is not None
        noisy = np.clip(pixels + rng.normal(0, 1, pixels.shape), 0, 255).astype(np.uint8)
        measured = operations.measure(noisy, kind, plane)
        if measured.quality.accepted:
            found.append((kind, measured))
    return found


class Filler:
    """A plant of 2000 heliostats and what comes to it."""

    def __init__(self, settings: Settings, share: float) -> None:
        self.settings, self.share = settings, share
        self.database, self.images = Database(settings.database), images_of(settings)
        self.rng, self.begin = np.random.default_rng(3), now() - timedelta(days=365)
        self.counts = {rate.what: max(1, round(rate.a_year * share)) for rate in rates(settings)}

    def moments(self, what: str) -> list[datetime]:
        return [
            self.begin + timedelta(days=365) * float(part)
            for part in np.linspace(0, 1, self.counts[what])
        ]

    def plant(self) -> None:
        with self.database.writing() as session:
            store.put_plant(session, "plant", ORIGIN)
            for plane in read_targets(tower_document()).values():
                self.target = store.put_target(session, plane)[0]
            self.heliostats = [
                store.put_heliostat(
                    session, f"H{number:04d}", properties_document(), (number % 50, number // 50, 1)
                )[0]
                for number in range(HELIOSTATS)
            ]

    def photographs(self) -> float:
        """All photographs, with files of the refused ones; seconds that writing such a file took in
        the mean.
        """
        fluxes = measured_fluxes(store.target_plane(self.target))
        accepted, turned_down = (
            self.moments("photographs, accepted"),
            self.moments("photographs, refused"),
        )
        coming = sorted([(at, True) for at in accepted] + [(at, False) for at in turned_down])
        file_s = 0.0
        for first in range(0, len(coming), 200):
            with self.database.writing() as session:
                for number, (at, is_good) in enumerate(coming[first : first + 200], first):
                    data = number.to_bytes(8, "big") * 32  # its size is assumed, not measured
                    started = time.perf_counter()
                    sha256 = digest(data) if is_good else self.images.put(data)
                    file_s += time.perf_counter() - started
                    kind, measured = fluxes[number % len(fluxes)]
                    if not is_good:
                        measured = MeasuredFlux(
                            refused("no_spot", "no spot is brighter than the background")
                        )
                    self._measurement(session, number, at, sha256, kind, measured)
        return file_s / len(turned_down)

    def _measurement(
        self,
        session: Session,
        number: int,
        at: datetime,
        sha256: str,
        kind: ImageKind,
        measured: MeasuredFlux,
    ) -> None:
        azimuth, elevation = float(self.rng.uniform(90, 270)), float(self.rng.uniform(5, 65))
        sun = Sun(azimuth_deg=azimuth, elevation_deg=elevation)
        about = IncomingPhotograph(
            self.target.name, kind, sun, f"{200_000 + number}", at, (31234.0, 45012.0)
        )
        row = measurement_row(about, measured, self.target.id, None)
        row.created_at = at
        image = ImageRow(
            sha256=sha256, media_type="image/png", size_bytes=round(IMAGE_KB * 1e3), created_at=at
        )
        image.width_px, image.height_px = 1000, 800
        store.add_measurement(session, self.heliostats[number % HELIOSTATS], image, row)

    def surfaces(self) -> None:
        """Each of eight photographs of its heliostat, as far as a share of a year has them."""
        moments, by_heliostat = self.moments("surfaces"), dict[int, list[MeasurementRow]]()
        with self.database.reading() as session:
            query = (
                select(MeasurementRow).where(MeasurementRow.accepted).order_by(MeasurementRow.id)
            )
            for row in session.scalars(query):
                by_heliostat.setdefault(row.heliostat_id, []).append(row)
        chosen = [heliostat for heliostat in self.heliostats if heliostat.id in by_heliostat]
        with self.database.writing() as session:
            for heliostat, at in zip(cycle(chosen), moments, strict=False):
                z = self.rng.normal(0, 2e-4, (4, 8, 8))
                points = np.stack([z, z, z], axis=-1) + self.rng.normal(0, 1, (4, 8, 8, 3))
                used = [session.merge(row, load=False) for row in by_heliostat[heliostat.id][:8]]
                new = NewSurface(
                    "network",
                    z,
                    abs(z),
                    points,
                    at,
                    "surface-network-0123456789ab",
                    "1:none",
                    used,
                    0.05,
                )
                store.add_surface(session, heliostat, new)

    def forecasts(self) -> None:
        fluxes = [
            measured.flux for _, measured in measured_fluxes(store.target_plane(self.target))[:20]
        ]
        maps = [pack({"flux": 1e4 * flux}) for flux in fluxes if flux is not None]
        for chunk in _chunks(self.moments("forecasts")):
            with self.database.writing() as session:
                for number, at in enumerate(chunk):
                    store.add_forecast(
                        session, self._forecast(number, at, maps[number % len(maps)])
                    )

    def _forecast(self, number: int, at: datetime, flux: bytes) -> ForecastRow:
        document = {
            "sun": {"azimuth_deg": 200.0, "elevation_deg": 45.0},
            "at": None,
            "aim_point_m": None,
            "motor_position": None,
            "dni_w_m2": 1000.0,
            "window_m": None,
            "normalised": False,
            "plane": receiver_as_json(store.target_plane(self.target)),
            "resolution": [256, 256],
            "unit": "W/m2",
            "peak_w_m2": 9e3,
            "power_w": 8e3,
            "center_of_mass_m": None,
            "losses": light_watts(Losses(8.2, *[0.9] * 8), 1000.0),
            "model_version": "1:none",
            "warnings": [],
        }
        return ForecastRow(
            heliostat_id=self.heliostats[number % HELIOSTATS].id,
            target_name=self.target.name,
            document=document,
            flux=flux,
            created_at=at,
        )

    def jobs(self) -> None:
        """Predictions of a few heliostats, each a step."""
        for chunk in _chunks(self.moments("jobs")):
            with self.database.writing() as session:
                for at in chunk:
                    names = [heliostat.name for heliostat in self.heliostats[:20]]
                    row, _ = queue.add_job(
                        session,
                        "predictions",
                        {"heliostats": names, "method": "network"},
                        "operator",
                    )
                    row.state, row.created_at, row.finished_at = "done", at, at
                    row.result = {"surfaces": dict.fromkeys(names, 3), "skipped": {}}
                    session.add_all(
                        JobStepRow(job_id=row.id, name=name, result={"version": 3})
                        for name in names
                    )

    def audit(self) -> None:
        for chunk in _chunks(self.moments("audit entries")):
            with self.database.writing() as session:
                for _ in chunk:
                    audit.record(
                        session,
                        "calibration",
                        "surface.predicted",
                        "heliostat H0001",
                        version=3,
                        method="network",
                    )


def _chunks(moments: list[datetime], size: int = 500) -> list[list[datetime]]:
    return [moments[first : first + size] for first in range(0, len(moments), size)]


# --- measuring
# --------------------------------------------------------------------------------------------------


def table_bytes(database: Database) -> dict[str, int]:
    """What each table takes with its indices and what is stored beside it."""
    names = Base.metadata.tables
    with database.engine.connect() as connection:
        if connection.dialect.name == "postgresql":
            asked = text("SELECT pg_total_relation_size(CAST(:name AS regclass))")
            return {name: connection.execute(asked, {"name": name}).scalar_one() for name in names}
        owners = {
            index["name"]: name for name in names for index in inspect(connection).get_indexes(name)
        }
        taken = dict.fromkeys(names, 0)
        for name, size in connection.execute(
            text("SELECT name, sum(pgsize) FROM dbstat GROUP BY name")
        ):
            owner = (
                owners.get(name)
                or name.removeprefix("sqlite_autoindex_").rpartition("_")[0]
                or name
            )
            owner = name if name in taken else owner
            if owner in taken:
                taken[owner] += size
        return taken


def rows_of(database: Database) -> dict[str, int]:
    with database.reading() as session:
        return {
            name: session.scalars(select(func.count()).select_from(table)).one()
            for name, table in Base.metadata.tables.items()
        }


def timed(database: Database, question: Callable[[Session], Any], times: int = 5) -> float:
    """Seconds of a read in the median."""
    taken = []
    for _ in range(times):
        with database.reading() as session:
            started = time.perf_counter()
            question(session)
            taken.append(time.perf_counter() - started)
    return statistics.median(taken)


def questions(filler: Filler) -> dict[str, Callable[[Session], Any]]:
    heliostat, settings = filler.heliostats[7], filler.settings
    return {
        "100 photographs of a heliostat": lambda s: store.list_measurements(s, heliostat, 100),
        "its 32 newest accepted": lambda s: store.recent_measurements(s, heliostat, 32),
        "its surface of today": lambda s: store.find_surface_at(s, heliostat),
        "the field's page, all statements": lambda s: read_summaries(s),
        "100 heliostats, 100 jobs, 100 forecasts": lambda s: (
            store.list_heliostats(s, 100),
            queue.list_jobs(s, Portion(100)),
            store.list_forecasts(s, Portion(100)),
        ),
        "sizes, as /jobs and /metrics report them": lambda s: sizes.sizes(s),
        "is a pruning due, for age or quota": lambda s: image_files.has_candidates(
            s, image_files.retention_rules(s, settings)
        ),
    }


def pruning(filler: Filler) -> dict[str, float]:
    """Seconds of each batch of 500; undone, but for the files of one."""
    settings, database, taken = filler.settings, filler.database, dict[str, float]()
    tight = settings.model_copy(update={"image_quota_gb": 1e-6, "image_retention_days": 90.0})
    with database.reading() as session:
        rules = {
            f"{rule.name}, {rule.reason}": rule
            for rule in image_files.retention_rules(session, tight)
        }
    for name, rule in rules.items():
        with database.reading() as session:
            started = time.perf_counter()
            image_files.mark_for_deletion(session, tight, rule, "benchmark")
            taken[f"delete 500 images ({name})"] = time.perf_counter() - started
    with database.writing() as session:
        image_files.mark_for_deletion(session, tight, rules["refused, age"], "benchmark")
    started = time.perf_counter()
    with filler.images.removing() as is_free, database.writing() as session:
        assert is_free
        image_files.remove_marked(session, filler.images)
    taken["remove their files"] = time.perf_counter() - started
    for name, prune in (
        ("500 old forecasts", deletion.prune_forecasts),
        ("500 old jobs", queue.purge),
        ("500 old audit entries", deletion.prune_audit),
    ):
        with database.reading() as session:
            started = time.perf_counter()
            prune(session, timedelta(days=30))
            taken[f"delete {name}"] = time.perf_counter() - started
    return taken


# --- telling
# --------------------------------------------------------------------------------------------------


def _gb(size: float) -> str:
    return f"{size / 1e9:,.1f}"


def project(filler: Filler, taken: dict[str, int], rows: dict[str, int]) -> None:
    """Print a table of bytes: of one row, of a year's rows, and of those stored after one and five
    years with the default settings.
    """
    settings = filler.settings
    beside = {
        "surfaces": ("surface_measurements",),
        "jobs": ("job_steps",),
        "measurements": ("images",),
    }
    print(
        f"\n{'what':26} {'a year':>10} {'bytes each':>11} {'GB a year':>10} {'kept, 1 year':>13}"
        f" {'kept, 5 years':>14}"
    )
    year = kept_1 = kept_5 = 0.0
    arrays, plain = _measurement_bytes(filler, taken, rows)
    for rate in rates(settings):
        tables = (rate.table, *beside.get(rate.table, ()))
        each = sum(taken[table] for table in tables) / max(1, rows[rate.table])
        each = {"photographs, accepted": arrays, "photographs, refused": plain}.get(rate.what, each)
        days = rate.kept_days or 1e9
        standing = [rate.a_year * each * min(days, 365 * years) / 365 for years in (1, 5)]
        year, kept_1, kept_5 = year + rate.a_year * each, kept_1 + standing[0], kept_5 + standing[1]
        print(
            f"{rate.what:26} {rate.a_year:10,.0f} {each:11,.0f} {_gb(rate.a_year * each):>10}"
            f" {_gb(standing[0]):>13} {_gb(standing[1]):>14}"
        )
        log_size(rate.what, rate.a_year * each, standing, each)
    log_size("database, together", year, (kept_1, kept_5))
    print(
        f"{'database, together':26} {'':10} {'':11} {_gb(year):>10} {_gb(kept_1):>13}"
        f" {_gb(kept_5):>14}"
    )
    _project_images(settings)


def _measurement_bytes(
    filler: Filler, taken: dict[str, int], rows: dict[str, int]
) -> tuple[float, float]:
    """Of an accepted photograph's rows and of a refused one's: they differ by the fluxes."""
    with filler.database.reading() as session:
        size = session.scalars(select(func.sum(func.length(MeasurementRow.arrays)))).one() or 0
        good = session.scalars(select(func.count()).where(MeasurementRow.accepted)).one()
    both = taken["measurements"] + taken["images"]
    plain = max(0.0, both - size) / rows["measurements"]
    return plain + size / good, plain


def log_size(what: str, a_year: float, kept: Sequence[float], each: float | None = None) -> None:
    """Record bytes of one row, of a year, and of what is kept after one and five years."""
    cells = {"each [kB]": None if each is None else each / 1e3, "a year [GB]": a_year / 1e9}
    cells |= {"kept, 1 year [GB]": kept[0] / 1e9, "kept, 5 years [GB]": kept[1] / 1e9}
    log_row(f"A year of {HELIOSTATS} heliostats on the disk", what, cells)


def _project_images(settings: Settings) -> None:
    a_year = HELIOSTATS * 8 * 365 * IMAGE_KB * 1e3
    standing = []
    for years in (1, 5):
        good = a_year * (1 - REFUSED) * min(years, settings.image_retention_days / 365)
        bad = a_year * REFUSED * min(years, settings.refused_image_retention_days / 365)
        standing.append((good + bad, min(good + bad, settings.image_quota_gb * 1e9)))
    print(
        f"{'images, by age alone':26} {HELIOSTATS * 8 * 365:10,} {IMAGE_KB * 1e3:11,.0f}"
        f" {_gb(a_year):>10} {_gb(standing[0][0]):>13} {_gb(standing[1][0]):>14}"
    )
    for row, index in (("images, by age alone", 0), ("images, with the quota", 1)):
        log_size(row, a_year, [one[index] for one in standing])
    print(
        f"{'images, quota too':26} {'':10} {'':11} {'':10} {_gb(standing[0][1]):>13}"
        f" {_gb(standing[1][1]):>14}"
    )


def main(arguments: list[str] | None = None) -> None:
    """Fill, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database", choices=("sqlite", "postgres"), default="sqlite")
    parser.add_argument("--share", type=float, default=0.001, help="Of a year.")
    options = parser.parse_args(arguments)
    with (
        tempfile.TemporaryDirectory() as folder,
        new_store(options.database, Path(folder)) as made,
        recording(f"growth-{options.database}"),
    ):
        made.settings.data_dir.mkdir(parents=True, exist_ok=True)
        filler = Filler(made.settings, options.share)
        filler.database.upgrade()
        started = time.perf_counter()
        filler.plant()
        file_s = filler.photographs()
        filler.surfaces()
        filler.forecasts()
        filler.jobs()
        filler.audit()
        filled_s = time.perf_counter() - started
        if options.database == "postgres":
            with filler.database.engine.connect().execution_options(
                isolation_level="AUTOCOMMIT"
            ) as connection:
                connection.execute(text("VACUUM ANALYZE"))
        rows, taken = rows_of(filler.database), table_bytes(filler.database)
        print(
            f"{options.database}: {options.share:g} of a year at {HELIOSTATS} heliostats in"
            f" {filled_s:.0f} s; rows:"
        )
        print(", ".join(f"{name} {count:,}" for name, count in rows.items() if count > 1))
        print(
            f"an image's file, on the disk for good: {1e3 * file_s:.1f} ms; images are taken for"
            f" {IMAGE_KB:g} kB each"
        )
        project(filler, taken, rows)
        print(f"\n{'ms at this size':44}")
        for name, question in questions(filler).items():
            taken_ms = 1e3 * timed(filler.database, question)
            print(f"{name:44} {taken_ms:8.1f}")
            log_row("Queries and pruning", name, {"time [ms]": taken_ms})
        for name, seconds in pruning(filler).items():
            print(f"{name:44} {1e3 * seconds:8.1f}")
            log_row("Queries and pruning", name, {"time [ms]": 1e3 * seconds})
        filler.database.close()


if __name__ == "__main__":
    main()
