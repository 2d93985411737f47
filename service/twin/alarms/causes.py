"""Rank likely causes of a heliostat's poor forecasts, each with its evidence and the next step."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date, datetime
from functools import cached_property
from statistics import median
from typing import Annotated, Literal, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from pydantic import ConfigDict, Field, computed_field
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.frames import sun_direction
from model.times import format_minute
from service import store
from service.base.settings import Settings
from service.store import decisions
from service.store.tables import (
    SUN_CONTRADICTS_TIME,
    UNLIKE_HELIOSTAT,
    DriftRow,
    HeliostatRow,
    StudyRow,
    SurfaceRow,
)
from service.twin import model_versions
from service.twin.alarms import offers
from service.twin.alarms.alarms import Alarm, read_alarms
from service.twin.alarms.field_overview import HeliostatOverview
from service.twin.alarms.offers import Offer
from service.twin.alarms.reasons import Reason
from service.twin.forecasts.aims import plant_time_zone
from service.twin.surfaces.accuracy import (
    PhotographComparison,
    photograph_name,
    photographs_of_surface,
    rank_of,
)
from service.twin.surfaces.present_shape import (
    DROP,
    AccuracyFall,
    DayOfOthers,
    Epoch,
    current_epoch,
    fell_with_others,
    list_outliers,
    others_on,
    read_fall,
)

CauseKind = Literal[
    "no_surface",
    "clock",
    "mirror",
    "foreign_light",
    "haze",
    "moved",
    "soiled",
    "few_suns",
    "model",
    "no_photograph",
    "times_unknown",
]

CAUSES: dict[CauseKind, str] = {
    "no_surface": "No surface is active",
    "clock": "Wrong sun or clock",
    "mirror": "The mirror changed",
    "foreign_light": "Another heliostat's light, a shadow or a cloud",
    "haze": "Haze, or the camera",
    "moved": "It moved",
    "soiled": "Dirty, covered or shaded",
    "few_suns": "Too few suns",
    "model": "The model lacks something",
    "no_photograph": "No recent photograph",
    "times_unknown": "Haze and clock not checked",
}
"""All causes with their labels; of equal shares the first is the likelier one."""

_OF_ALARM: dict[Reason, tuple[CauseKind, ...]] = {
    "moved": ("moved",),
    "pointing": ("moved",),
    "drift": ("moved",),
    "accuracy": ("model", "mirror", "haze", "foreign_light", "clock", "no_surface", "few_suns"),
    "fell": ("haze", "mirror"),
    "dimmed": ("soiled",),
    "untrusted": ("model", "mirror", "foreign_light", "few_suns", "no_surface", "clock"),
    "unlike_heliostat": ("foreign_light",),
    "sun_contradicts_time": ("clock",),
    "no_photograph": ("no_photograph",),
    "times_unknown": ("times_unknown",),
}
"""Causes that explain an alarm. Without any the first one is added, with the alarm's message."""

# Newest photographs that are looked at.
_NEWEST = 32
# Suns that a prediction takes; fewer than `_FEW` are too few, and so is a span below `_SPAN_DEG`.
_SUNS, _FEW, _SPAN_DEG, _SAME_SUN_DEG = 8, 4, 20.0, 5.0
# Least share of a fall that is dated and certain, and that of an alarm that nothing else explains.
_DATED, _OF_OPEN_ALARM = 0.9, 0.5
# Misfit relative to the field's median, above which the model or the mirror is unusual.
_MISFIT_RATIO = 1.5
# Photographs of a changed mirror whose cross-validation is shown to a person.
_MIN_TO_CONFIRM = 3


@dataclass(frozen=True)
class PhotographFacts:
    """What the store knows of a photograph.

    ``accuracy`` [1] is that of the compared forecast, else that of its arrival. ``warnings`` are
    those of the measurement. ``taken_at`` is in the plant's zone. ``was_used`` is whether the
    surface was computed from it.
    """

    identifier: str
    taken_at: datetime | None
    sun: tuple[float, float, float]
    accuracy: float | None
    warnings: tuple[Mapping[str, object], ...] = ()
    was_used: bool = False

    def warning(self, type_: str) -> Mapping[str, object] | None:
        """Its warning of a type; None without any."""
        return next((one for one in self.warnings if one["type"] == type_), None)


class StudyFinding(NamedTuple):
    """The number of a study, and what it says."""

    number: int
    said: str


@dataclass(frozen=True)
class HeliostatFacts:
    """What the store knows of a heliostat, as `rank_causes` needs it.

    ``study`` is the newest study's sentence about what the model lacks. ``usual_misfit`` [1] is the
    median of the field's active surfaces. ``alarms`` are its open alarms, and ``adopting`` is the
    offer to adopt that study. ``studies`` are all. ``confirming`` is the offer to make a changed
    mirror's surface active.
    """

    limit: float
    photographs: Sequence[PhotographFacts]
    line: HeliostatOverview
    others: Mapping[date, DayOfOthers]
    suspicious: Sequence[str] = ()
    sun_span_deg: float | None = None
    misfit: float | None = None
    usual_misfit: float | None = None
    study: StudyFinding | None = None
    fall: AccuracyFall | None = None
    epoch: Epoch | None = None
    alarms: Mapping[Reason, Alarm] = field(default_factory=dict)
    adopting: Offer | None = None
    studies: Sequence[store.Studied] = ()
    confirming: Offer | None = None

    @cached_property
    def usual_accuracy(self) -> float:
        """The median accuracy [1] of its photographs; zero if none is known."""
        known = [one.accuracy for one in self.photographs if one.accuracy is not None]
        return median(known) if known else 0.0

    def since_change(self) -> list[PhotographFacts]:
        """Photographs since its accuracy fell, or since it moved until it was calibrated.

        None if the accuracy of other heliostats fell then, too. A spot that moved may be truncated.
        """
        pointing, changes = self.line.pointing, list[tuple[datetime, datetime | None]]()
        if pointing is not None and pointing.moved is not None:
            moved = pointing.moved
            changes.append((moved.until, pointing.calibrated_at if moved.is_calibrated else None))
        if self.fall is not None:
            changes.append((self.fall.until, None))
        found = [
            one
            for one in self.photographs
            for begin, end in changes
            if one.taken_at and begin <= one.taken_at and (end is None or one.taken_at < end)
        ]
        days = [one.taken_at.date() for one in found if one.taken_at]
        return [] if fell_with_others(days, self.others) else found


@dataclass(frozen=True)
class LikelyCause:
    """A likely cause of poor forecasts, with its evidence."""

    kind: Annotated[CauseKind, Field(description="Which cause it is.")]
    explained_share: Annotated[
        float,
        Field(
            description="Share of the poor photographs, or of the shortfall, that it explains [1]."
        ),
    ]
    evidence: Annotated[str, Field(description="What the store knows of it.")]
    measurements: Annotated[
        Sequence[str], Field(description="Ids of the measurements that show it.")
    ] = field(default_factory=tuple)
    day: Annotated[date | None, Field(description="The day of haze, in the plant's time zone.")] = (
        None
    )
    since: Annotated[datetime | None, Field(description="When the mirror changed.")] = None
    study: Annotated[
        int | None, Field(description="The study that found what the model lacks.")
    ] = None
    offer: Annotated[
        Offer | None, Field(description="What to do about it; null: nothing that a request does.")
    ] = None

    __pydantic_config__ = ConfigDict(json_schema_serialization_defaults_required=True)

    @computed_field
    @property
    def label(self) -> str:
        """The cause in words."""
        return CAUSES[self.kind]


def percent(share: float) -> str:
    """A share [1] as a percentage, as pages write it."""
    return f"{100 * share:.1f}\N{NO-BREAK SPACE}%"


def count_photographs(count: int) -> str:
    """A number of photographs in words."""
    return f"{count} photograph{'' if count == 1 else 's'}"


def outlier_reasons(facts: HeliostatFacts) -> dict[str, str]:
    """Why each outlier is one, by identifier, the worst first; other photographs are left out."""
    usual = facts.usual_accuracy
    in_time = sorted(
        (one for one in facts.photographs if one.accuracy is not None),
        key=lambda one: (one.taken_at is not None, one.taken_at),
    )
    undated = sum(one.taken_at is None for one in in_time)
    apart = list_outliers([1 - (one.accuracy or 0) for one in in_time], undated) if in_time else []
    far = {in_time[place].identifier for place in apart}
    reasons = {}
    for one in facts.photographs:
        said = []
        if (found := one.warning(SUN_CONTRADICTS_TIME)) is not None:
            said.append(f"its sun contradicts its time: {found['detail']}")
        if (found := one.warning(UNLIKE_HELIOSTAT)) is not None:
            said.append(str(found["detail"]))
        if one.identifier in facts.suspicious:
            said.append("the surface does not explain it, although it was made from it")
        is_far = one.accuracy is not None and (one.identifier in far or one.accuracy < facts.limit)
        if is_far and facts.line.surface is not None:  # the ideal mirror proves nothing of them
            assert one.accuracy is not None
            said.append(
                f"it is forecast with an accuracy of {percent(one.accuracy)}, the others with"
                f" {percent(usual)} in the median"
            )
        if said:
            reasons[one.identifier] = "; ".join(said)
    known_of = {one.identifier: one.accuracy for one in facts.photographs}
    return dict(sorted(reasons.items(), key=lambda one: known_of[one[0]] or 0.0))


def rank_causes(facts: HeliostatFacts) -> list[LikelyCause]:
    """Rank the causes by the share of the poor photographs that they explain, the largest first."""
    poor = outlier_reasons(facts)
    found = [
        *_no_surface(facts),
        *_clock(facts, poor),
        *_mirror(facts, poor),
        *_foreign_light(facts, poor),
        *_haze(facts, poor),
        *_moved(facts, poor),
        *_few_suns(facts),
        *_model(facts),
    ]
    undated = sum(one.taken_at is None for one in facts.photographs)
    if undated and not any(one.kind in ("clock", "haze") for one in found):
        said = f"the times of {undated} of {count_photographs(len(facts.photographs))} are unknown"
        found.append(LikelyCause("times_unknown", 0.0, said))
    for reason, alarm in facts.alarms.items():
        kinds = _OF_ALARM.get(reason, ())
        if kinds and not any(one.kind in kinds for one in found):
            found.append(LikelyCause(kinds[0], _OF_OPEN_ALARM, alarm.message))
    order = list(CAUSES)
    found.sort(key=lambda one: (-one.explained_share, order.index(one.kind)))
    return [replace(one, offer=_offer(facts, one)) for one in found]


def _offer(facts: HeliostatFacts, cause: LikelyCause) -> Offer | None:
    """What a person would do about a cause, where a request does it."""
    name, dimmed = facts.line.name, facts.alarms.get("dimmed")
    match cause.kind:
        case "no_surface" if facts.line.candidate is None:
            return offers.predict("Predict its surface", name)
        case "clock":
            return _correct_times(facts)
        case "mirror" if facts.confirming is not None:
            return facts.confirming
        case "mirror" if cause.since is not None:
            return offers.predict("Predict again from photographs since then", name, cause.since)
        case "foreign_light" if cause.measurements:
            (one,) = (p for p in facts.photographs if p.identifier == cause.measurements[0])
            return offers.exclude(name, one.identifier, cause.evidence, one.was_used)
        case "moved":
            alarms = (facts.alarms.get("moved"), facts.alarms.get("pointing"))
            return next((one.offer for one in alarms if one is not None and one.offer), None)
        case "soiled" if dimmed is not None:
            said = "its mirror is to be cleaned; forecasts take its light as photographs show it"
            return offers.acknowledge("Acknowledge, and have it cleaned", [dimmed.id], said)
        case "model" if cause.study is not None:
            return facts.adopting
        case "model" | "haze":
            taken = [at for one in facts.photographs if (at := one.taken_at) is not None]
            of_day = (at for at in taken if cause.day in (None, at.date()))
            last = max(of_day, default=None)
            of_field = cause.kind == "haze"
            if last is None or offers.has_seen(facts.studies, last, None if of_field else name):
                return None
            changed = facts.fall.until if of_field and facts.fall is not None else last
            return offers.study(None, changed) if of_field else offers.study([name], None)
    return None


def _correct_times(facts: HeliostatFacts) -> Offer | None:
    """The correction of the clock that explains most photographs."""
    name, taken = facts.line.name, defaultdict[float, list[tuple[str, str, datetime]]](list)
    for one in facts.photographs:
        warning = one.warning(SUN_CONTRADICTS_TIME) or {}
        ahead = warning.get("clock_ahead_h")
        if one.taken_at is not None and isinstance(ahead, (int, float)):
            taken[ahead].append((name, one.identifier, one.taken_at))
    if not taken:
        return None
    hours = max(taken, key=lambda one: len(taken[one]))
    return offers.correct_times(taken[hours], hours)


def _no_surface(facts: HeliostatFacts) -> list[LikelyCause]:
    """That forecasts are those of the ideal mirror."""
    if facts.line.surface is not None or not facts.photographs:
        return []
    known = [one.accuracy for one in facts.photographs if one.accuracy is not None]
    with_accuracy = f" with {percent(median(known))} in the median" if known else ""
    said = (
        f"the ideal mirror forecasts its {count_photographs(len(facts.photographs))}{with_accuracy}"
    )
    if facts.line.candidate is not None:
        said = f"{said}; version {facts.line.candidate.version} is a candidate only"
    return [LikelyCause("no_surface", 1.0, said)]


def _of_photographs(
    kind: CauseKind, concerned: Sequence[PhotographFacts], poor: Mapping[str, str], said: str
) -> list[LikelyCause]:
    names = tuple(one.identifier for one in concerned)
    return [LikelyCause(kind, len(names) / max(len(poor), len(names)), said, names)]


def _clock(facts: HeliostatFacts, poor: Mapping[str, str]) -> list[LikelyCause]:
    wrong = [one for one in facts.photographs if one.warning(SUN_CONTRADICTS_TIME)]
    if not wrong:
        return []
    detail = (wrong[0].warning(SUN_CONTRADICTS_TIME) or {})["detail"]
    said = (
        f"{count_photographs(len(wrong))} of {len(facts.photographs)}, the newest first: {detail}"
    )
    return _of_photographs("clock", wrong, poor, said)


def _mirror(facts: HeliostatFacts, poor: Mapping[str, str]) -> list[LikelyCause]:
    """A change of the mirror's shape that no surface has confirmed yet."""
    epoch = facts.epoch
    if epoch is None or epoch.is_confirmed:
        return []
    names = tuple(
        one.identifier
        for one in facts.photographs
        if one.taken_at is not None and one.taken_at >= epoch.since
    )
    share = max(_DATED, len(set(names) & poor.keys()) / max(len(poor), 1))
    return [
        LikelyCause(
            "mirror",
            share,
            f"{epoch.said}; {epoch.needs}",
            names,
            study=epoch.study,
            since=epoch.since,
        )
    ]


def _foreign_light(facts: HeliostatFacts, poor: Mapping[str, str]) -> list[LikelyCause]:
    """Photographs that contradict the others, without a contradicting time or a day of haze."""
    unlike = [one for one in facts.photographs if one.warning(UNLIKE_HELIOSTAT)]
    if unlike:
        likes = sorted({str((one.warning(UNLIKE_HELIOSTAT) or {})["like"]) for one in unlike})
        said = (
            f"{', '.join(likes)} explain{'s' if len(likes) == 1 else ''}"
            f" {count_photographs(len(unlike))} of {len(facts.photographs)} much better"
        )
        return _of_photographs("foreign_light", unlike, poor, said)
    days, changed = set(_hazy_days(facts, poor)), facts.since_change()
    apart = [
        one
        for one in facts.photographs
        if one.identifier in poor
        and one not in changed
        and one.warning(SUN_CONTRADICTS_TIME) is None
        and (one.taken_at is None or one.taken_at.date() not in days)
    ]
    usual = [one for one in facts.photographs if one.identifier not in poor]
    # If most are poor, none contradicts the others.
    if not apart or len(poor) > len(usual):
        return []
    values = [one.accuracy for one in apart if one.accuracy is not None]
    worst = f", {percent(min(values))} accurate at worst" if values else ""
    said = (
        f"{count_photographs(len(apart))} of {len(facts.photographs)} contradict the others{worst}"
    )
    return _of_photographs("foreign_light", apart, poor, said)


def _hazy_days(facts: HeliostatFacts, poor: Mapping[str, str]) -> list[date]:
    """Days whose poor photographs are so with those of other heliostats; the worst day first.

    Others were much worse than usual, or by a third of what this heliostat was: thin haze lowers
    small spots more than large ones.
    """
    counts: dict[date, int] = {}
    for one in facts.photographs:
        if one.identifier in poor and one.taken_at is not None:
            day = one.taken_at.date()
            other = facts.others.get(day)
            own = facts.usual_accuracy - (one.accuracy or 0.0)
            if other is not None and (other.is_worse or 0 < own <= 3 * other.drop):
                counts[day] = counts.get(day, 0) + 1
    return sorted(counts, key=lambda day: (-counts[day], day))


def _haze(facts: HeliostatFacts, poor: Mapping[str, str]) -> list[LikelyCause]:
    days = _hazy_days(facts, poor)
    if not days:
        return []
    day, other = days[0], facts.others[days[0]]
    own = [
        one
        for one in facts.photographs
        if one.identifier in poor and one.taken_at is not None and one.taken_at.date() == day
    ]
    values = [one.accuracy for one in own if one.accuracy is not None]
    mine = f" ({percent(median(values))})" if values else ""
    said = (
        f"on {day:%Y-%m-%d}, not only {count_photographs(len(own))} of it{mine} but also"
        f" {count_photographs(other.photographs)} of {other.heliostats} other heliostat"
        f"{'' if other.heliostats == 1 else 's'} were forecast with"
        f" {percent(other.accuracy)} instead of {percent(other.usual)}"
    )
    (cause,) = _of_photographs("haze", own, poor, said)
    return [replace(cause, day=day)]


def _moved(facts: HeliostatFacts, poor: Mapping[str, str]) -> list[LikelyCause]:
    pointing = facts.line.pointing
    if pointing is None:
        return []
    metres = (
        "" if facts.line.pointing_m is None else f", {facts.line.pointing_m:.2f} m on the receiver"
    )
    if pointing.moved is not None and not pointing.moved.is_calibrated:
        moved = pointing.moved
        said = f"it moved {moved.when}: its spot is {moved.size_mrad:.1f} mrad off since{metres}"
        since = {
            one.identifier
            for one in facts.photographs
            if one.taken_at is not None and one.taken_at >= moved.until
        }
        return [LikelyCause("moved", max(0.5, len(since & poor.keys()) / max(len(poor), 1)), said)]
    if pointing.beyond_since is not None and pointing.error_mrad is not None:
        said = (
            f"its spot is {pointing.error_mrad:.1f} mrad off{metres}, beyond the limit since"
            f" {format_minute(pointing.beyond_since)}"
        )
        return [LikelyCause("moved", 0.5, said)]
    return []


def count_suns(suns: Sequence[tuple[float, float, float]]) -> int:
    """Number of suns that lie at least 5 degrees apart, of unit vectors (n, 3)."""
    kept: list[np.ndarray] = []
    for sun in np.asarray(suns).reshape(-1, 3):
        if all(sun @ other < np.cos(np.radians(_SAME_SUN_DEG)) for other in kept):
            kept.append(sun)
    return len(kept)


def _few_suns(facts: HeliostatFacts) -> list[LikelyCause]:
    used = [one for one in facts.photographs if one.was_used]
    if not used:
        return []
    suns, span = count_suns([one.sun for one in used]), facts.sun_span_deg or 0.0
    if suns >= _FEW and span >= _SPAN_DEG:
        return []
    others = count_suns([one.sun for one in facts.photographs])
    said = (
        f"its surface was made from {count_photographs(len(used))} under {suns}"
        f" sun{'' if suns == 1 else 's'}, {span:.0f}° apart at most; a prediction takes up to"
        f" {_SUNS}, and its accepted photographs have {others}"
    )
    return [LikelyCause("few_suns", 1 - suns / _SUNS, said)]


def _model(facts: HeliostatFacts) -> list[LikelyCause]:
    misfit, usual = facts.misfit or 0.0, facts.usual_misfit or 0.0
    excess = 1 - usual / misfit if usual and misfit > _MISFIT_RATIO * usual else 0.0
    if facts.study is not None:
        number, said = facts.study
        return [LikelyCause("model", max(excess, 0.25), said, study=number)]
    if not excess:
        return []
    said = (
        f"its surface misses {percent(misfit)} of the photographs that it was made from;"
        f" {percent(usual)} is the field's median"
    )
    return [LikelyCause("model", excess, said)]


# --- from the store
# --------------------------------------------------------------------------------------------------


def read_facts(
    session: Session,
    line: HeliostatOverview,
    row: HeliostatRow,
    surface: SurfaceRow | None,
    comparisons: Sequence[PhotographComparison],
    settings: Settings,
) -> HeliostatFacts | None:
    """Read what `rank_causes` needs of a heliostat and of the surface that forecasts it.

    None if it is good: not below the accuracy limit, and none of its alarms is open.
    """
    compared = {one.measurement.id: one.accuracy for one in comparisons}
    used = photographs_of_surface(surface)
    recent = store.recent_measurements(session, row, _NEWEST)
    zone = ZoneInfo(plant_time_zone(session, settings.time_zone))
    photographs = [
        PhotographFacts(
            one.identifier,
            None if one.taken_at is None else one.taken_at.astimezone(zone),
            tuple(sun_direction(one.sun_azimuth_deg, one.sun_elevation_deg).tolist()),
            compared.get(one.id, one.forecast_accuracy),
            tuple(one.warnings or ()),
            photograph_name(one) in used,
        )
        for one in recent
    ]
    drift = session.get(DriftRow, row.id)
    fall, epoch = (read_fall(session, row.id, settings), current_epoch(session, row, settings))
    is_candidate = epoch is not None and not epoch.is_confirmed
    accuracies = [rank_of(comparisons).accuracy, None if drift is None else drift.accuracy]
    is_below = any(one is not None and one < settings.alarm_accuracy for one in accuracies)
    has_warnings = any(one.warnings for one in photographs)
    opened = [one for one in read_alarms(session, row.name).alarms if not one.acknowledged_by]
    alarms = {one.reason: one for one in opened if one.heliostat is not None}
    is_ideal = line.surface is None and bool(photographs)
    is_bad = is_below or fall or is_candidate or has_warnings or is_ideal or alarms
    if not is_bad:
        return None
    days = {one.taken_at.date() for one in photographs if one.taken_at is not None}
    newest = store.newest_study(session)
    study = None if newest is None else _study(session, row.name, newest)
    adopting = next((one.offer for one in opened if one.reason == "study_undecided"), None)
    return HeliostatFacts(
        settings.alarm_accuracy,
        photographs,
        line,
        others_on(session, row.id, days, zone),
        () if surface is None else tuple(surface.suspicious or ()),
        None if surface is None else surface.sun_span_deg,
        None if surface is None else surface.misfit,
        _usual_misfit(session),
        study,
        fall,
        epoch,
        alarms,
        adopting if study is not None else None,
        model_versions.list_studied(session),
        None if epoch is None else _confirming(session, row, epoch),
    )


def _confirming(session: Session, heliostat: HeliostatRow, epoch: Epoch) -> Offer | None:
    """What confirms an epoch of few photographs: a surface of them all that is clearly better."""
    made = decisions.find_undecided(session, heliostat, epoch.since) if epoch.missing else None
    if made is None or len(made.measurements) < epoch.photographs:
        return None
    active = store.find_surface_at(session, heliostat)
    compared = decisions.find_comparison(session, made, active)
    if compared is None or compared.photographs < _MIN_TO_CONFIRM or compared.gain < DROP:
        return None
    said = f"version {made.version} {compared.reason}"
    return offers.activate(heliostat.name, made.version, said)


def _usual_misfit(session: Session) -> float | None:
    """Median misfit [1] of the newest active surfaces of the field; None for fewer than three."""
    query = select(SurfaceRow.misfit).where(
        SurfaceRow.misfit.is_not(None), ~SurfaceRow.is_candidate
    )
    found = session.scalars(query.order_by(SurfaceRow.id.desc()).limit(200)).all()
    return median(one or 0.0 for one in found) if len(found) > 2 else None


def _study(session: Session, heliostat: str, study: StudyRow) -> StudyFinding | None:
    """What a study found that the model lacks, if it included the heliostat."""
    if study.verdict == "none" or heliostat not in study.heliostats:
        return None
    if model_versions.find_adopted(session, study.id) is not None:
        return None
    return StudyFinding(
        study.id, f"study {study.id} of its photographs: {study.conclusion.rstrip('.')}"
    )
