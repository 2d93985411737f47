"""All that Prometheus reads: the meters of the process, and what the store says when it is asked.

Each `serve` and each `worker` counts what it did itself and is a target of its own. What stands in the database, such
as the queue, is told by `serve` alone, lest it be counted twice.
"""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import product

from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.base.meters import PROCESS
from service.base.settings import Settings
from service.store import queue, sizes
from service.store.job_tables import JobRow
from service.store.tables import DriftRow, HeliostatRow
from service.twin.attention import REASONS, Item, of_lines
from service.twin.cameras import Change
from service.twin.field import PATIENCE_S, FieldBook, Line
from service.twin.runtime import Runtime

_VERDICTS = {True: "yes", False: "no", None: "unknown"}

logger = logging.getLogger("heliotwin.service")


class StoreCollector(Collector):
    """What the store holds at the moment of asking; a database that is away is told, and harms no other figure."""

    def __init__(self, runtime: Runtime, book: FieldBook) -> None:
        self._runtime, self._book = runtime, book

    def describe(self) -> list[Metric]:
        """Nothing, so that registering asks no database."""
        return []

    def collect(self) -> Iterator[Metric]:
        """The figures, read in one transaction."""
        most = self._runtime.settings.metrics_heliostats
        try:
            with self._runtime.database.reading() as session:
                found = [*_queue(session), *_sizes(session, self._runtime.settings)]
                lines = self._book.read(session, PATIENCE_S).lines
                cameras = self._book.cameras.changes(session, self._runtime.settings)
                found.append(_attention(of_lines(session, lines, self._runtime.settings, cameras)))
                found.append(_cameras(cameras))
                found += [*_trust(lines, most), *_pointing(lines, most), _drift(session, most)]
        except SQLAlchemyError as error:
            logger.warning("metrics of the store are missing: %s", error)
            found = []
        yield GaugeMetricFamily("heliotwin_database_up", "Whether the database answers.", value=float(bool(found)))
        yield from found


def _queue(session: Session) -> Iterator[Metric]:
    counted = select(JobRow.kind, JobRow.state, func.count()).where(JobRow.state.not_in(queue.ENDED))
    depth = GaugeMetricFamily("heliotwin_jobs", "Jobs that wait or run.", labels=["kind", "state"])
    for kind, state, count in session.execute(counted.group_by(JobRow.kind, JobRow.state)):
        depth.add_metric([kind, state], count)
    yield depth
    oldest = session.scalar(select(func.min(JobRow.created_at)).where(JobRow.state == "queued"))
    waited_s = 0.0 if oldest is None else max(0.0, (queue.clock(session) - oldest).total_seconds())
    yield GaugeMetricFamily("heliotwin_jobs_oldest_seconds", "How long the oldest waiting job waits [s].", waited_s)


def _sizes(session: Session, settings: Settings) -> Iterator[Metric]:
    held = sizes.sizes(session)
    images = GaugeMetricFamily("heliotwin_images", "Images that are kept.", labels=["verdict"])
    size = GaugeMetricFamily("heliotwin_image_bytes", "Size of the images that are kept [B].", labels=["verdict"])
    age = GaugeMetricFamily("heliotwin_image_oldest_seconds", "Age of the oldest of them [s].", labels=["verdict"])
    at = queue.clock(session)
    for verdict, kept in (("accepted", held.accepted), ("refused", held.refused)):
        images.add_metric([verdict], kept.images)
        size.add_metric([verdict], kept.size_bytes)
        age.add_metric([verdict], 0.0 if kept.oldest is None else max(0.0, (at - kept.oldest).total_seconds()))
    yield from (images, size, age)
    quota = "Most that images may take [B]; 0 without a bound."
    yield GaugeMetricFamily("heliotwin_image_quota_bytes", quota, settings.image_quota_gb * 1e9)
    yield GaugeMetricFamily("heliotwin_database_bytes", "Size of the database [B].", held.database_bytes)


def _cameras(changes: Sequence[Change]) -> Metric:
    ratios = GaugeMetricFamily(
        "heliotwin_camera_change_ratio",
        "Of targets whose camera changed: what of its photographs is how many times what it was.",
        labels=["target", "figure"],
    )
    for change in changes:
        ratios.add_metric([change.target, change.figure], change.ratio)
    return ratios


def _attention(items: Sequence[Item]) -> Metric:
    counted = Counter((item.reason, "no" if item.acknowledged_by is None else "yes") for item in items)
    family = GaugeMetricFamily(
        "heliotwin_attention",
        "What needs attention, and whether it was acknowledged.",
        labels=["reason", "acknowledged"],
    )
    for reason, seen in product(REASONS, ("no", "yes")):
        family.add_metric([reason, seen], counted[reason, seen])
    return family


def _trust(lines: Sequence[Line], most: int) -> Iterator[Metric]:
    """Which surfaces of today are trusted; of those that are not, since when, those of longest standing first."""
    surfaces = [(line.name, line.surface) for line in lines if line.surface is not None]
    trusted = Counter(_VERDICTS[surface.trusted] for _, surface in surfaces)
    counts = GaugeMetricFamily("heliotwin_surfaces", "Surfaces of today by trust in them.", labels=["trusted"])
    for verdict in _VERDICTS.values():
        counts.add_metric([verdict], trusted[verdict])
    yield counts
    since = GaugeMetricFamily(
        "heliotwin_heliostat_doubted_since_seconds",
        "Since when the heliostat's surface is not trusted [s since 1970], and whether anybody has seen that.",
        labels=["heliostat", "seen"],
    )
    doubted = [
        (surface.doubted_since.timestamp(), name, "yes" if surface.seen_by else "no")
        for name, surface in surfaces
        if surface.doubted_since is not None
    ]
    for moment, name, seen in sorted(doubted)[:most]:
        since.add_metric([name, seen], moment)
    yield since
    spans = [(surface.sun_span_deg, name) for name, surface in surfaces]
    about = "Largest angle between the suns of the photographs that the surface was made from [deg]; the smallest only."
    yield _worst("heliotwin_heliostat_sun_span_degrees", about, spans, most, is_better_high=True)


def _pointing(lines: Sequence[Line], most: int) -> Iterator[Metric]:
    """The worst heliostats' pointing errors, and when heliostats moved, the last ones."""
    known = [(line, line.pointing) for line in lines if line.pointing is not None]
    prefix, worst = "heliotwin_heliostat_pointing", "; the worst heliostats only."
    errors = [(own.error_mrad, line.name) for line, own in known]
    yield _worst(f"{prefix}_error_mrad", f"The heliostat's pointing error [mrad]{worst}", errors, most)
    metres = [(line.pointing_m, line.name) for line, _ in known]
    yield _worst(f"{prefix}_error_metres", f"The same on the nearest receiver [m]{worst}", metres, most)
    trends = [(own.trend_mrad, line.name) for line, own in known]
    yield _worst(f"{prefix}_trend_mrad", f"How it grew over its newest photographs [mrad]{worst}", trends, most)
    moves = [(own.moved.before.timestamp(), line.name) for line, own in known if own.moved is not None]
    about = "When the heliostat moved last [s since 1970]; those that moved last only."
    yield _worst("heliotwin_heliostat_moved_seconds", about, moves, most)


def _worst(
    name: str, about: str, told: Iterable[tuple[float | None, str]], most: int, is_better_high: bool = False
) -> Metric:
    """A figure of heliostats, the worst first: a field of any size gives a bounded number of series."""
    family = GaugeMetricFamily(name, about, labels=["heliostat"])
    known = sorted(((value, of) for value, of in told if value is not None), reverse=not is_better_high)
    for value, heliostat in known[:most]:
        family.add_metric([heliostat], value)
    return family


def _drift(session: Session, most: int) -> Metric:
    """The worst heliostats' accuracies: a field of any size gives a bounded number of series."""
    worst = (
        select(HeliostatRow.name, DriftRow.accuracy)
        .join(DriftRow, DriftRow.heliostat_id == HeliostatRow.id)
        .order_by(DriftRow.accuracy, HeliostatRow.name)
        .limit(most)
    )
    family = GaugeMetricFamily(
        "heliotwin_heliostat_forecast_accuracy",
        "Flux accuracy of the twin on the heliostat's newest photograph when it came [1]; the worst heliostats only.",
        labels=["heliostat"],
    )
    for name, accuracy in session.execute(worst):
        family.add_metric([name], accuracy)
    return family


def registry(runtime: Runtime, book: FieldBook) -> CollectorRegistry:
    """The meters of this process together with the store's figures."""
    both = CollectorRegistry()
    both.register(PROCESS)  # it collects like any collector
    both.register(StoreCollector(runtime, book))
    return both
