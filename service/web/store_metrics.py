"""Metrics for Prometheus: those of the process, and those that are queried from the store.

Each `serve` and each `worker` counts its own actions and is a separate target. Only `serve` reports
the contents of the database, such as the queue, so that they are not counted twice.
"""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import product

from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.base.monitoring import PROCESS
from service.base.settings import Settings
from service.store import field_state, queue, sizes
from service.store.job_tables import JobRow
from service.store.tables import DriftRow, HeliostatRow
from service.twin.alarms.alarms import Alarm, read_alarms
from service.twin.alarms.field_overview import PATIENCE_S, FieldOverviewCache, HeliostatOverview
from service.twin.alarms.reasons import REASONS
from service.twin.runtime import Runtime
from service.twin.studies.cameras import CHANGES, CameraChange

_VERDICTS = {True: "yes", False: "no", None: "unknown"}

logger = logging.getLogger("heliotwin.service")


class StoreCollector(Collector):
    """Collector of metrics from the store at the time of the scrape.

    If the database is unavailable, the collector reports that. Other metrics are not affected.
    """

    def __init__(self, runtime: Runtime, cache: FieldOverviewCache) -> None:
        self._runtime, self._cache = runtime, cache

    def describe(self) -> list[Metric]:
        """Return nothing, so that registration does not query the database."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Query the metrics in one transaction."""
        try:
            with self._runtime.database.reading() as session:
                found = [_alarms(read_alarms(session).alarms)]
                found += [*_queue(session), *_sizes(session, self._runtime.settings)]
                found.append(
                    _cameras(CHANGES.validate_python(field_state.read_field_state(session).cameras))
                )
                found += self._cache.recent(
                    session, "metrics", partial(self._of_heliostats, session)
                )
                found.append(_drift(session, self._runtime.settings.metrics_heliostats))
        except SQLAlchemyError as error:
            logger.warning("metrics of the store are missing: %s", error)
            found = []
        yield GaugeMetricFamily(
            "heliotwin_database_up", "Whether the database answers.", value=float(bool(found))
        )
        yield from found

    def _of_heliostats(self, session: Session) -> list[Metric]:
        lines = self._cache.read(session, PATIENCE_S).lines
        most = self._runtime.settings.metrics_heliostats
        return [*_trust(lines, most), *_pointing(lines, most)]


def _queue(session: Session) -> Iterator[Metric]:
    counted = select(JobRow.kind, JobRow.state, func.count()).where(
        JobRow.state.not_in(queue.ENDED)
    )
    depth = GaugeMetricFamily("heliotwin_jobs", "Jobs that wait or run.", labels=["kind", "state"])
    for kind, state, count in session.execute(counted.group_by(JobRow.kind, JobRow.state)):
        depth.add_metric([kind, state], count)
    yield depth
    oldest = session.scalar(select(func.min(JobRow.created_at)).where(JobRow.state == "queued"))
    waited_s = (
        0.0 if oldest is None else max(0.0, (queue.database_time(session) - oldest).total_seconds())
    )
    yield GaugeMetricFamily(
        "heliotwin_jobs_oldest_seconds", "How long the oldest waiting job waits [s].", waited_s
    )


def _sizes(session: Session, settings: Settings) -> Iterator[Metric]:
    held = sizes.sizes(session)
    images = GaugeMetricFamily("heliotwin_images", "Images that are kept.", labels=["verdict"])
    size = GaugeMetricFamily(
        "heliotwin_image_bytes", "Size of the images that are kept [B].", labels=["verdict"]
    )
    age = GaugeMetricFamily(
        "heliotwin_image_oldest_seconds", "Age of the oldest of them [s].", labels=["verdict"]
    )
    at = queue.database_time(session)
    for verdict, kept in (("accepted", held.accepted), ("refused", held.refused)):
        images.add_metric([verdict], kept.images)
        size.add_metric([verdict], kept.size_bytes)
        age.add_metric(
            [verdict], 0.0 if kept.oldest is None else max(0.0, (at - kept.oldest).total_seconds())
        )
    yield from (images, size, age)
    quota = "Most that images may take [B]; 0 without a bound."
    yield GaugeMetricFamily("heliotwin_image_quota_bytes", quota, settings.image_quota_gb * 1e9)
    yield GaugeMetricFamily(
        "heliotwin_database_bytes", "Size of the database [B].", held.database_bytes
    )


def _cameras(changes: Sequence[CameraChange]) -> Metric:
    ratios = GaugeMetricFamily(
        "heliotwin_camera_change_ratio",
        "Of targets whose camera changed: what of its photographs is how many times what it was.",
        labels=["target", "figure"],
    )
    for change in changes:
        ratios.add_metric([change.target, change.figure], change.ratio)
    return ratios


def _alarms(items: Sequence[Alarm]) -> Metric:
    counted = Counter(
        (item.reason, "no" if item.acknowledged_by is None else "yes") for item in items
    )
    family = GaugeMetricFamily(
        "heliotwin_alarms",
        "Alarms by reason, and whether they were acknowledged.",
        labels=["reason", "severity", "acknowledged"],
    )
    for reason, seen in product(REASONS, ("no", "yes")):
        family.add_metric([reason, str(REASONS[reason].severity), seen], counted[reason, seen])
    return family


def _trust(lines: Sequence[HeliostatOverview], most: int) -> Iterator[Metric]:
    """Counts of active surfaces by trust, and the surfaces that are untrusted longest."""
    surfaces = [(line.name, line.surface) for line in lines if line.surface is not None]
    trusted = Counter(_VERDICTS[surface.trusted] for _, surface in surfaces)
    counts = GaugeMetricFamily(
        "heliotwin_surfaces", "Active surfaces by trust in them.", labels=["trusted"]
    )
    for verdict in _VERDICTS.values():
        counts.add_metric([verdict], trusted[verdict])
    yield counts
    since = GaugeMetricFamily(
        "heliotwin_heliostat_warned_since_seconds",
        "Since when the heliostat's surface has warnings [s since 1970], and whether anybody"
        " acknowledged them.",
        labels=["heliostat", "acknowledged"],
    )
    warned = [
        (surface.warned_since.timestamp(), name, "yes" if surface.acknowledged_by else "no")
        for name, surface in surfaces
        if surface.warned_since is not None
    ]
    for moment, name, acknowledged in sorted(warned)[:most]:
        since.add_metric([name, acknowledged], moment)
    yield since
    spans = [(surface.sun_span_deg, name) for name, surface in surfaces]
    about = (
        "Largest angle between the suns of the photographs that the surface was made from [deg];"
        " the smallest only."
    )
    yield _worst("heliotwin_heliostat_sun_span_degrees", about, spans, most, is_better_high=True)


def _pointing(lines: Sequence[HeliostatOverview], most: int) -> Iterator[Metric]:
    """Pointing errors of the worst heliostats, and the latest moves."""
    known = [(line, line.pointing) for line in lines if line.pointing is not None]
    prefix, worst = "heliotwin_heliostat_pointing", "; the worst heliostats only."
    errors = [(own.error_mrad, line.name) for line, own in known]
    yield _worst(
        f"{prefix}_error_mrad", f"The heliostat's pointing error [mrad]{worst}", errors, most
    )
    metres = [(line.pointing_m, line.name) for line, _ in known]
    yield _worst(
        f"{prefix}_error_metres", f"The same on the nearest receiver [m]{worst}", metres, most
    )
    trends = [(own.trend_mrad, line.name) for line, own in known]
    yield _worst(
        f"{prefix}_trend_mrad",
        f"How it grew over its newest photographs [mrad]{worst}",
        trends,
        most,
    )
    moves = [
        (own.moved.until.timestamp(), line.name) for line, own in known if own.moved is not None
    ]
    about = "When the heliostat moved last [s since 1970]; those that moved last only."
    yield _worst("heliotwin_heliostat_moved_seconds", about, moves, most)


def _worst(
    name: str,
    about: str,
    values: Iterable[tuple[float | None, str]],
    most: int,
    is_better_high: bool = False,
) -> Metric:
    """A metric of the worst heliostats first.

    The number of series is bounded, however large the field is.
    """
    family = GaugeMetricFamily(name, about, labels=["heliostat"])
    known = sorted(
        ((value, of) for value, of in values if value is not None), reverse=not is_better_high
    )
    for value, heliostat in known[:most]:
        family.add_metric([heliostat], value)
    return family


def _drift(session: Session, most: int) -> Metric:
    """Flux accuracies of the worst heliostats. The number of series is bounded."""
    worst = (
        select(HeliostatRow.name, DriftRow.accuracy)
        .join(DriftRow, DriftRow.heliostat_id == HeliostatRow.id)
        .order_by(DriftRow.accuracy, HeliostatRow.name)
        .limit(most)
    )
    family = GaugeMetricFamily(
        "heliotwin_heliostat_forecast_accuracy",
        "Flux accuracy of the twin on the heliostat's newest photograph when it came [1]; the worst"
        " heliostats only.",
        labels=["heliostat"],
    )
    for name, accuracy in session.execute(worst):
        family.add_metric([name], accuracy)
    return family


def registry(runtime: Runtime, cache: FieldOverviewCache) -> CollectorRegistry:
    """The metrics of this process together with those of the store."""
    both = CollectorRegistry()
    both.register(PROCESS)  # PROCESS has the interface of a collector
    both.register(StoreCollector(runtime, cache))
    return both
