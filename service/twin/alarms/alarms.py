"""Alarms: what an operator should look at, since when, and what to do.

Workers compute all alarms from the store and write them (`service.twin.alarms.field_updates`).
Readers read what was written. Each alarm has a ``fingerprint``, and an acknowledgement is valid as
long as the fingerprint is the same. The fingerprint changes when the reason disappears and returns,
or when its measured value doubles.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime, timedelta
from datetime import time as clock
from functools import cached_property, partial
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Annotated, NamedTuple
from zoneinfo import ZoneInfo

from pydantic import ConfigDict, Field, computed_field
from sqlalchemy import ColumnElement, case, func, or_, select
from sqlalchemy.orm import Session

from model.changes import LevelChange, find_changes
from model.pointing.report import clock_in_words
from model.times import format_minute
from service.base.fields import From
from service.base.settings import Settings
from service.store import acknowledgements, field_state, queue
from service.store.columns import now
from service.store.job_tables import AcknowledgementRow, AlarmRow, JobRow
from service.store.measurements import EXCLUDED, has_warning
from service.store.tables import (
    SUN_CONTRADICTS_TIME,
    UNLIKE_HELIOSTAT,
    DriftRow,
    HeliostatRow,
    MeasurementRow,
    ModelRow,
    MountRow,
    PlantRow,
    StudyRow,
    SurfaceRow,
)
from service.twin import model_versions
from service.twin.adoption_rules import is_of_images
from service.twin.alarms import offers
from service.twin.alarms.field_fall import LEAST, find_field_fall
from service.twin.alarms.field_overview import ActiveSurface, HeliostatOverview, read_marks
from service.twin.alarms.measured_states import LostLight, find_lost_light, measure_states
from service.twin.alarms.offers import Offer
from service.twin.alarms.reasons import REASONS, HeliostatOrPlant, Reason, ReasonOf, SeverityOf
from service.twin.forecasts.aims import outdated_plans, plant_time_zone
from service.twin.forecasts.mirror_states import MirrorStates
from service.twin.pointing_errors import DriveStep, PointingState
from service.twin.studies.cameras import FIGURES, CameraChange, CameraReadings, find_camera_choice
from service.twin.studies.field_change import AdoptableStudy, EffectFindings

AlarmId = Annotated[
    str,
    Field(
        max_length=80,
        pattern=r"^[A-Za-z0-9_-]+:[a-z_]+:[0-9a-f]{8}$",
        description=(
            "The item and its reason as they are now; another where the reason changes or returns."
        ),
        examples=["AA39:moved:1f0c22ab"],
    ),
]


@dataclass(frozen=True)
class Alarm:
    """Something that an operator should look at."""

    reason: ReasonOf
    heliostat: HeliostatOrPlant
    since: From
    message: Annotated[str, Field(description="What is wrong.")]
    action: Annotated[str, Field(description="What to do.")]
    fingerprint: Annotated[str, Field(exclude=True)]
    acknowledged_by: Annotated[
        str | None, Field(description="Name of the key; null if not acknowledged.")
    ] = None
    acknowledged_at: Annotated[datetime | None, Field(description="When; null: it is not.")] = None
    measurements: Annotated[
        list[str],
        Field(description="Ids of the heliostat's measurements to look at, where there are some."),
    ] = field(default_factory=list)
    acknowledged_reason: Annotated[
        str | None, Field(description="Why; null: it is not, or none was given.")
    ] = None
    acknowledgement: Annotated[
        int | None,
        Field(
            description="Number of the acknowledgement, which may be undone; null: there is none."
        ),
    ] = None
    offer: Annotated[
        Offer | None,
        Field(
            description=(
                "What to do, where one request does it; null: see the causes of the alarms, or of"
                " the heliostat."
            )
        ),
    ] = None

    __pydantic_config__ = ConfigDict(json_schema_serialization_defaults_required=True)

    @property
    def key(self) -> acknowledgements.Key:
        """What identifies the alarm in the store."""
        return acknowledgements.Key(self.heliostat, self.reason, self.fingerprint)

    def with_acknowledgement(self, row: AcknowledgementRow) -> "Alarm":
        """Add who acknowledged the alarm, when and why."""
        return replace(
            self,
            acknowledged_by=row.made_by,
            acknowledged_at=row.made_at,
            acknowledged_reason=row.comment or None,
            acknowledgement=row.batch,
        )

    @computed_field
    @cached_property
    def id(self) -> AlarmId:
        """The item and its reason as they are now; another where the reason changes or returns."""
        digest = hashlib.sha256(self.fingerprint.encode()).hexdigest()[:8]
        return f"{self.heliostat or 'plant'}:{self.reason}:{digest}"

    @computed_field
    @property
    def severity(self) -> SeverityOf:
        """By the reason: 1 act now, 2 act today, 3 when there is time."""
        return REASONS[self.reason].severity


class AlarmList(NamedTuple):
    """Alarms, when they were computed, and the number of heliostats with pending results.

    The number is at least 1 if something was stored since.
    """

    alarms: list[Alarm]
    computed_at: datetime
    pending: int


RECORDED = tuple(one.name for one in fields(Alarm) if hasattr(AlarmRow, one.name))
"""Fields of an alarm that its row has, too."""

_COLUMNS = {
    "heliostat": HeliostatRow.name,
    "acknowledged_by": AcknowledgementRow.made_by,
    "acknowledged_at": AcknowledgementRow.made_at,
    "acknowledged_reason": func.nullif(AcknowledgementRow.comment, ""),
    "acknowledgement": AcknowledgementRow.batch,
} | {name: getattr(AlarmRow, name) for name in RECORDED}
_OF_ALARM = [_COLUMNS[one.name] for one in fields(Alarm)]


def read_alarms(session: Session, heliostat: str | None = None) -> AlarmList:
    """Read all alarms, or those of a heliostat and of the plant.

    They are sorted by urgency of the reason, then by time with the newest first.
    """
    state = field_state.read_field_state(session)
    query = acknowledgements.open_with_acknowledgements(*_OF_ALARM)
    query = query.outerjoin(HeliostatRow, HeliostatRow.id == AlarmRow.heliostat_id)
    if heliostat is not None:
        query = query.where(or_(HeliostatRow.name == heliostat, HeliostatRow.id.is_(None)))
    alarms = [Alarm(*row) for row in session.execute(query)]
    order = {reason: place for place, reason in enumerate(REASONS)}
    alarms.sort(
        key=lambda item: (order[item.reason], -item.since.timestamp(), item.heliostat or "")
    )
    pending = max(state.pending, int(state.marks != read_marks(session)))
    return AlarmList(alarms, state.computed_at, pending)


def compute_alarms(
    session: Session,
    lines: Sequence[HeliostatOverview],
    settings: Settings,
    cameras: CameraReadings,
    effects: EffectFindings,
    levels: Mapping[str, float],
) -> list[Alarm]:
    """Compute the alarms of the plant, its cameras, its model and its heliostats.

    They are acknowledged only as surfaces are. ``levels`` are those of the field's accuracy.
    """
    at, zone = now(), plant_time_zone(session, settings.time_zone)
    lost = find_lost_light(cameras.light, settings.alarm_light_loss)
    found = [
        *_queue(session, settings),
        *_outdated_aims(session, settings, partial(measure_states, lines, cameras.light)),
        *_camera(session),
        *_undeclared_camera(session),
        *_watch_cameras(session, cameras.changes, zone),
        *_clock(session),
        *_ended_effects(session, effects),
        *_undecided(effects.adoptable),
        *_fallen_together(session, levels),
    ]
    found += _accuracies(session, settings)
    found += _without_photograph(session, timedelta(days=settings.alarm_photograph_days), at)
    found += [*_warned(session), *_dimmed(session, lost, settings)]
    for line in lines:
        found += _of_heliostat(line, settings, at, levels)
    return found


# --- heliostats
# --------------------------------------------------------------------------------------------------


def _of_heliostat(
    line: HeliostatOverview, settings: Settings, at: datetime, levels: Mapping[str, float]
) -> Iterator[Alarm]:
    if (untrusted := find_untrusted(line, at)) is not None:
        yield untrusted
    yield from _fallen(line, settings, levels)
    if line.pointing is not None:
        yield from _pointing(line, line.pointing, settings, at)


def find_untrusted(line: HeliostatOverview, at: datetime) -> Alarm | None:
    """The alarm that a heliostat's surface is not trusted; None without warnings."""
    surface = line.surface or line.candidate
    if surface is None or not surface.warnings:
        return None
    since = surface.valid_from or surface.warned_since or surface.created_at or at
    photographs = list(surface.suspicious or ())
    which = _named(photographs)
    return Alarm(
        "untrusted",
        line.name,
        since,
        "; ".join(surface.warnings or ()),
        f"look at {which if photographs else 'its photographs'}, exclude what is wrong, and predict"
        " its surface again",
        untrusted_fingerprint(surface),
        surface.acknowledged_by,
        surface.acknowledged_at,
        photographs,
    )


def _named(photographs: Sequence[str]) -> str:
    return f"photograph{'s' if len(photographs) > 1 else ''} {', '.join(photographs)}"


def untrusted_fingerprint(surface: ActiveSurface | SurfaceRow) -> str:
    """Fingerprint of the alarm that a surface is not trusted; a repeated prediction keeps it."""
    since, which = surface.warned_since or surface.created_at, _named(surface.suspicious or ())
    began = "" if since is None else since.isoformat()
    return f"{began} {hashlib.sha256(which.encode()).hexdigest()[:8]}"


def _pointing(
    line: HeliostatOverview, pointing: PointingState, settings: Settings, at: datetime
) -> Iterator[Alarm]:
    moved, is_new = pointing.moved, False
    if moved is not None:
        is_new = not moved.is_calibrated
        is_late = at - moved.until < timedelta(days=settings.alarm_moved_days)
        if is_new or is_late:
            yield _moved_drives(line.name, moved)
    if pointing.beyond_since is not None and pointing.error_mrad is not None and not is_new:
        metres = "" if line.pointing_m is None else f", {line.pointing_m:.2f} m on the receiver"
        yield Alarm(
            "pointing",
            line.name,
            pointing.beyond_since,
            f"its spot is {pointing.error_mrad:.1f} mrad off{metres}",
            "photograph it where the calibration plan says, and calibrate its mount again",
            _fingerprint(pointing.beyond_since, pointing.error_mrad / settings.alarm_pointing_mrad),
            offer=offers.calibrate([line.name]),
        )
    if pointing.drifted is not None:
        drifted = pointing.drifted
        yield Alarm(
            "drift",
            line.name,
            drifted.since,
            f"its drives went {drifted.size_mrad:.1f} mrad slowly until"
            f" {format_minute(drifted.until)}",
            "look at its foundation and drives, and calibrate its mount often",
            _fingerprint(drifted.since, drifted.size_mrad),
        )


def _moved_drives(name: str, moved: DriveStep) -> Alarm:
    offer = None if moved.is_calibrated else offers.calibrate([name])
    if moved.is_calibrated:
        size = f"its drives stepped by {moved.size_mrad:.1f} mrad"
        action = "find out why; its mount is calibrated since"
    else:
        size = f"its spot is {moved.size_mrad:.1f} mrad off since"
        action = "look at its drives and encoders, and calibrate its mount again"
    fingerprint = f"{moved.since.isoformat()} {moved.until.isoformat()}"
    message = f"it moved {moved.when}: {size}"
    return Alarm("moved", name, moved.until, message, action, fingerprint, offer=offer)


def _without_photograph(session: Session, allowed: timedelta, at: datetime) -> Iterator[Alarm]:
    """Find heliostats without a recent photograph, or whose photographs all have unknown times."""
    row, photograph = HeliostatRow, MeasurementRow
    newest, is_undated = func.max(photograph.taken_at), photograph.taken_at.is_(None)
    undated = func.count(func.distinct(case((is_undated, _photograph()))))
    came = func.min(case((is_undated, photograph.created_at)))
    query = select(row.name, row.created_at, newest, undated, came).group_by(
        row.id, row.name, row.created_at
    )
    is_photograph = photograph.accepted & photograph.image_sha256.is_not(None)
    query = query.outerjoin(photograph, (photograph.heliostat_id == row.id) & is_photograph)
    query = query.having(or_(func.coalesce(newest, row.created_at) < at - allowed, undated > 0))
    for name, created, last, count, first in session.execute(query):
        if last is None and count:
            yield _times_unknown(name, count, first)
            continue
        begun = last or created
        if begun >= at - allowed:
            continue
        message = (
            "none was ever accepted"
            if last is None
            else f"the last accepted one is of {format_minute(last)}"
        )
        action = "photograph it where the calibration plan says"
        if count:
            message = f"{message}; the time of {count} more is unknown"
            action = f"{action}, or {_GIVE_TIMES}"
        yield Alarm("no_photograph", name, begun + allowed, message, action, begun.isoformat())


_GIVE_TIMES = (
    "give the times of its photographs (page /photographs/times, PATCH /v1/measurements/times, or"
    " `heliotwin times FILE`)"
)


def _times_unknown(name: str, count: int, first: datetime) -> Alarm:
    which = "its one accepted photograph" if count == 1 else f"all {count} accepted photographs"
    message = f"the time of {which} is unknown, and so is the age; the first arrived then"
    action = f"{_GIVE_TIMES}, and have taken_at sent with each photograph"
    return Alarm("times_unknown", name, first, message, action, first.isoformat())


_WARNED: dict[Reason, tuple[str, str, str]] = {
    "unlike_heliostat": (
        UNLIKE_HELIOSTAT,
        "that another heliostat explains much better",
        "delete what was sent by mistake, and send it for its heliostat; or look at the mirror",
    ),
    "sun_contradicts_time": (
        SUN_CONTRADICTS_TIME,
        "with a sun that contradicts the time",
        "correct time or sun, or exclude what is wrong",
    ),
}
"""Reasons that count measurements with a warning: warning type, message and remedy."""


def _warned(session: Session) -> Iterator[Alarm]:
    """Find heliostats that have measurements with a warning; excluded measurements do not count."""
    row, photograph = HeliostatRow, MeasurementRow
    count = func.count(func.distinct(_photograph()))
    began = func.min(func.coalesce(photograph.taken_at, photograph.created_at))
    query = select(row.name, count, began, row.id).group_by(row.id, row.name)
    query = query.join(photograph, photograph.heliostat_id == row.id)
    query = query.where(
        photograph.warnings.is_not(None), func.coalesce(photograph.reason, "") != EXCLUDED
    )
    for reason, (type_, said, remedy) in _WARNED.items():
        for name, warned, first, number in session.execute(query.where(has_warning(type_))):
            message = f"{warned} measurement{'s' if warned > 1 else ''} {said}"
            change = _begin_of_warnings(session, number, type_)
            if change is not None:
                message += f", most since a time after {format_minute(change.since)}"
            action = f"see /photographs?heliostat={name}&warned=true, and {remedy}"
            since = first if change is None else change.until
            yield Alarm(reason, name, since, message, action, _fingerprint(first, warned))


def _begin_of_warnings(session: Session, heliostat: int, type_: str) -> LevelChange | None:
    """The last change from photographs without a warning to photographs with it."""
    row = MeasurementRow
    query = select(row.taken_at, has_warning(type_)).order_by(row.taken_at.desc(), row.id.desc())
    query = query.where(row.heliostat_id == heliostat, row.accepted, row.taken_at.is_not(None))
    found = session.execute(query.limit(_WARNINGS_READ)).all()[::-1]
    times = [at for at, _ in found if at is not None]
    changes = find_changes(times, [float(bool(one)) for _, one in found], _NOT_WARNED)
    return next((one for one in reversed(changes) if one.max_drop < 0), None)


_WARNINGS_READ = 24
"""Newest photographs of a heliostat that date its warnings."""

_NOT_WARNED = 0.25
"""Noise of the share of photographs with a warning: some have none by chance."""


def _photograph() -> ColumnElement[str]:
    """The name that all images of one photograph share, as an SQL expression."""
    return func.coalesce(MeasurementRow.external_id, MeasurementRow.identifier)


def _fingerprint(since: datetime, times: float) -> str:
    """A fingerprint that changes each time ``times`` doubles."""
    return f"{since.isoformat()} {math.floor(math.log2(max(times, 1.0)))}"


def _accuracies(session: Session, settings: Settings) -> Iterator[Alarm]:
    least = settings.alarm_accuracy
    query = select(HeliostatRow.name, DriftRow.accuracy, DriftRow.poor_since, DriftRow.taken_at)
    poor = query.join(DriftRow, DriftRow.heliostat_id == HeliostatRow.id).where(
        DriftRow.accuracy < least
    )
    for name, accuracy, poor_since, taken_at in session.execute(poor):
        yield _poor_forecast(name, accuracy, poor_since or taken_at, least)


def _poor_forecast(name: str, accuracy: float, since: datetime, least: float) -> Alarm:
    return Alarm(
        "accuracy",
        name,
        since,
        f"its newest photograph was forecast with an accuracy of {accuracy:.0%}, and"
        f" {least:.0%} is the least",
        "predict its surface again; if that does not help, study the photographs",
        _fingerprint(since, (1 - accuracy) / max(1 - least, 1e-6)),
    )


def find_ended_accuracies(
    session: Session, settings: Settings, after: datetime, open_since: Mapping[str, datetime]
) -> Iterator[tuple[Alarm, datetime]]:
    """Alarms of poor forecasts that photographs stored ``after`` a time ended, with their ends.

    ``open_since`` is when the alarms began that are recorded as present, by heliostat.
    """
    row, least = MeasurementRow, settings.alarm_accuracy
    query = select(HeliostatRow.name, row.taken_at, row.forecast_accuracy)
    query = query.join(row, row.heliostat_id == HeliostatRow.id).where(
        row.accepted, row.created_at > after, row.taken_at.is_not(None)
    )
    query = query.where(row.forecast_accuracy.is_not(None))
    found = session.execute(query.order_by(HeliostatRow.name, row.taken_at, row.id))
    for name, photographs in groupby(found, itemgetter(0)):
        begun, poor = open_since.get(name), least
        for _, at, accuracy in photographs:
            assert at is not None
            assert accuracy is not None
            if accuracy < least:
                begun, poor = begun or at, accuracy
            elif begun is not None and begun <= at:
                yield _poor_forecast(name, poor, begun, least), at
                begun = None


def _fallen(
    line: HeliostatOverview, settings: Settings, levels: Mapping[str, float]
) -> Iterator[Alarm]:
    """Report a heliostat whose photographs are worse since a change, by more than the field's."""
    fall, allowed = line.fall, settings.alarm_accuracy_drop
    if fall is None or not fall.exceeds(allowed, levels):
        return
    message = (
        f"its accuracy fell {fall.when}: photographs since are forecast with {fall.recent:.0%},"
        f" those before with {fall.earlier:.0%}, by the same surface; by {fall.min_drop:.0%} at"
        f" least, and {allowed:.0%} is allowed"
    )
    action = "look for what changed, and predict its surface from photographs since then"
    size = fall.min_drop / max(allowed, 1e-6)
    yield Alarm("fell", line.name, fall.until, message, action, _fingerprint(fall.until, size))


def _fallen_together(session: Session, levels: Mapping[str, float]) -> Iterator[Alarm]:
    """Report that the photographs of the whole field are forecast worse since a change."""
    fall = find_field_fall(levels)
    if fall is None:
        return
    drop = fall.earlier - fall.recent
    studies = model_versions.list_studied(session)
    yield Alarm(
        "fell",
        None,
        fall.until,
        f"the accuracy of the whole field fell {fall.when}, by {100 * drop:.1f} points in the"
        " median of its heliostats",
        "look for haze, a changed camera or a moved target, and study the photographs",
        _fingerprint(fall.until, drop / LEAST),
        offer=None if offers.has_seen(studies, fall.until) else offers.study(None, fall.until),
    )


def _dimmed(
    session: Session, lost_light: Sequence[LostLight], settings: Settings
) -> Iterator[Alarm]:
    """Report heliostats that lost light."""
    numbers = [one.heliostat for one in lost_light]
    query = select(HeliostatRow.id, HeliostatRow.name).where(HeliostatRow.id.in_(numbers))
    names: dict[int, str] = {row.id: row.name for row in session.execute(query)}
    for lost in lost_light:
        yield Alarm(
            "dimmed",
            names[lost.heliostat],
            lost.since,
            f"since {lost.when} its {lost.photographs} photographs on {lost.target} have"
            f" {lost.share:.0%} less light than before, compared with other heliostats on the same"
            f" days; by {lost.min_share:.0%} at least, and {settings.alarm_light_loss:.0%} is"
            " allowed",
            "look whether its mirror is dirty, covered or broken, and whether others shade it",
            _fingerprint(lost.since, lost.min_share / settings.alarm_light_loss),
        )


# --- the plant
# --------------------------------------------------------------------------------------------------


def _queue(session: Session, settings: Settings) -> Iterator[Alarm]:
    oldest = session.execute(
        select(JobRow.id, JobRow.created_at)
        .where(JobRow.state == "queued")
        .order_by(JobRow.created_at)
        .limit(1)
    ).one_or_none()
    if oldest is None or queue.database_time(session) - oldest.created_at < timedelta(
        seconds=settings.alarm_queue_s
    ):
        return
    message = f"job {oldest.id} has waited since then"
    action = "see whether a worker is alive, and what its log says"
    yield Alarm("queue", None, oldest.created_at, message, action, str(oldest.id))


# Most heliostats that the alarm of a plan names.
_NAMED = 10


def _outdated_aims(
    session: Session, settings: Settings, measure: Callable[[], MirrorStates]
) -> Iterator[Alarm]:
    """Find plans of aims for the current day whose heliostats or model changed since."""
    for plan in outdated_plans(session, settings.time_zone, measure):
        names = plan.heliostats
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        parts = [f"{part} of {len(of)}" for part, of in plan.changes.items()]
        said = [f"{', '.join(parts)}: {', '.join(names[:_NAMED])}{more}"] if names else []
        if plan.models is not None:
            before, current = plan.models
            said.insert(0, f"model version {current} instead of {before}, for all heliostats")
        on = "" if plan.target is None else f" on {plan.target}"
        yield Alarm(
            "aims_outdated",
            None,
            plan.made_at,
            f"since plan {plan.job} of aims for today{on} was made, changed: {'; '.join(said)}",
            f"plan the aims of today again (POST /v1/jobs/aim-plans), see /jobs/{plan.job}",
            f"{plan.job} {plan.models} {_fingerprint(plan.made_at, len(names))}",
        )


def _camera(session: Session) -> Iterator[Alarm]:
    """Find camera changes in the newest study of several heliostats, and newly declared cameras.

    The study does not count if it is adopted. That of one heliostat says nothing about the camera.
    """
    study = session.execute(
        select(StudyRow.id, StudyRow.report["effects"])
        .where(func.json_array_length(StudyRow.heliostats) > 1)
        .order_by(StudyRow.id.desc())
        .limit(1)
    ).one_or_none()
    if study is not None and model_versions.find_adopted(session, study.id) is None:
        for effect in study[1] or ():
            scope = effect.get("scope") or {}
            is_acting = scope.get("kind") == "since" and not scope.get("until")
            if is_acting and is_of_images(effect["name"]):
                name, day = effect["name"], scope["since"]
                yield Alarm(
                    "camera",
                    None,
                    datetime.fromisoformat(f"{day}T00:00:00+00:00"),
                    f"study {study.id} found {name.replace('_', ' ')} in photographs from {day} on",
                    f"read study {study.id}, and adopt it or declare the camera again",
                    f"{name} {day}",
                )
    declared = _declared_anew(session)
    if declared is not None and declared.reason is None:  # else a job measures them again
        yield Alarm(
            "camera",
            None,
            declared.adopted_at,
            f"version {declared.number} of the model declared another camera; photographs from"
            " before it stay measured as they were",
            "measure the stored photographs again (POST /v1/jobs/measurements), and predict"
            " surfaces again",
            f"version {declared.number}",
        )


def _undeclared_camera(session: Session) -> Iterator[Alarm]:
    """Report images that are measured as light, and that forecasts fit better as sRGB counts."""
    job = find_camera_choice(session)
    if job is not None and job.result is not None and job.result["answer"] == "srgb":
        better = (
            f"accuracy {job.result['srgb']:.1%} as differences of sRGB counts,"
            f" {job.result['linear']:.1%} as light"
        )
        yield Alarm(
            "camera_undeclared",
            None,
            job.created_at,
            f"images without background are measured as light, and fit as counts better: {better}",
            "declare their camera, see /plant",
            "srgb",
            offer=offers.declare_counts(better),
        )


def _watch_cameras(session: Session, cameras: Sequence[CameraChange], zone: str) -> Iterator[Alarm]:
    """Report camera changes in photographs, until a camera is declared again."""
    declared = _declared_anew(session) if cameras else None
    studies = model_versions.list_studied(session) if cameras else []
    for change in cameras:
        since = datetime.combine(change.day, clock(), ZoneInfo(zone)).astimezone(UTC)
        if declared is None or since > declared.adopted_at:
            way = "up" if change.ratio > 1 else "down"
            times = f"{change.ratio:.2f} times what it was"
            yield Alarm(
                "camera",
                None,
                since,
                f"on {change.target} {FIGURES[change.figure]} is {times}, in the median of"
                f" {change.days[1]} days against {change.days[0]} before, from photographs of"
                f" {change.day} on",
                "look at the camera's exposure, focus and lens; study the photographs, or declare"
                " the camera again",
                f"{change.target} {change.figure} {way} {change.day:%Y-%m}",
                offer=None if offers.has_seen(studies, since) else offers.study(None, since),
            )


def _clock(session: Session) -> Iterator[Alarm]:
    """Report a clock error that the newest calibration found."""
    newest = (
        select(MountRow.document["clock"])
        .order_by(MountRow.created_at.desc(), MountRow.id.desc())
        .limit(1)
    )
    clock = session.scalar(newest)
    if clock is not None:
        yield Alarm(
            "clock",
            None,
            datetime.fromisoformat(f"{clock['since']}T00:00:00+00:00"),
            clock_in_words(clock),
            "set the clock that suns are computed by; correct the suns of photographs since then,"
            " and calibrate again",
            f"{clock['since']} {'slow' if clock['minutes'] > 0 else 'fast'}",
        )


def _ended_effects(session: Session, effects: EffectFindings) -> Iterator[Alarm]:
    """Report adopted effects that later photographs contradict."""
    for one in effects.contradicted:
        action = f"end it by {one.until}" if one.can_end else "withdraw it"
        same = [other for other in effects.contradicted if other.study == one.study]
        offer = None
        if all(other.can_end for other in same):
            ends = {other.effect: other.until for other in same}
            offer = offers.adopt(one.study, ends, one.in_words)
        elif model_versions.is_current(session, one.study):
            offer = offers.withdraw(one.study)
        yield Alarm(
            "effect_ended",
            None,
            datetime.combine(one.until, clock(), UTC),
            one.in_words,
            f"{action}, see /studies/{one.study}/change",
            f"{one.study} {one.effect}",
            offer=offer,
        )


def _undecided(adoptable: AdoptableStudy | None) -> Iterator[Alarm]:
    """Report a study whose effects make forecasts better, and that is not adopted."""
    if adoptable is not None:
        study, ends, change = adoptable
        gain = change.whole
        better = (
            f"with its effects the accuracy changes by {100 * gain.mean:+.1f} points on"
            f" {gain.photographs} photographs"
        )
        yield Alarm(
            "study_undecided",
            None,
            study.created_at,
            f"study {study.id} says: {study.conclusion.rstrip('.')}; {better}",
            f"adopt it, see /studies/{study.id}/change",
            str(study.id),
            offer=offers.adopt(study.id, ends, better),
        )


def _declared_anew(session: Session) -> ModelRow | None:
    """Find the newest model version with cameras different from the version before.

    Withdrawn versions do not count.
    """
    plant = session.get(PlantRow, 1)
    rows = [row for row in model_versions.list_models(session) if row.withdrawn_at is None]
    declared = [None if plant is None else plant.declared, *(row.declared for row in rows)]
    cameras = [(document or {}).get("cameras") or [] for document in declared]
    changed = [row for row, (old, new) in zip(rows, pairwise(cameras), strict=True) if old != new]
    return changed[-1] if changed else None
