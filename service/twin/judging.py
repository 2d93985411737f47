"""Whether a new surface is better than today's: both held against the same photographs, ones that neither has seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.metrics import flux_accuracy
from model.study.judging import Gain, few_gain
from service.store.decisions import Grounds
from service.store.surfaces import NewSurface
from service.store.tables import MeasurementRow, SurfaceRow
from service.twin.accuracy import forecasts_of, name_of, seen_by, unseen_first
from service.twin.evidence import Array, Twin, evidence_of, heights_of
from service.twin.runtime import Runtime

LEAST_UNSEEN = 5
"""Fewer photographs that neither surface has seen tell nothing of which one is better."""


@dataclass(frozen=True)
class Judgement:
    """Whether a new surface takes the place of the one that is today's, which has version ``against``."""

    against: int
    taken: bool
    grounds: Grounds


@dataclass(frozen=True)
class Standing:
    """What speaks for a surface before any forecast is compared; ``said`` says it of a version."""

    rank: int
    said: str


_BY_SOURCE = {
    "measured": Standing(3, "was measured"),
    "refined": Standing(2, "is refined"),
    "network": Standing(1, "is the network's alone"),
    "imported": Standing(1, "was imported"),
}


def standing_of(source: str, trusted: bool | None, is_outdated: bool = False) -> Standing:
    """What speaks for a surface: measured before refined, refined before the network's, and last what is doubted."""
    if is_outdated:
        return Standing(0, "was made from photographs that were corrected since")
    if trusted is False:
        return Standing(0, "is not trusted")
    return _BY_SOURCE[source]


def judge_surface(runtime: Runtime, twin: Twin, today: SurfaceRow, new: NewSurface) -> Judgement:
    """Hold a surface that was just predicted against today's.

    `LEAST_UNSEEN` or more photographs that neither has seen decide, where they tell the two apart by more than chance;
    but in the place of one that was measured comes none that is not trusted. Where they do not, the surface stays that
    stands better, and of equals the new one comes where it forecasts no worse: its photographs are newer.
    """
    used = {name_of(row) for row in new.measurements}
    with runtime.database.reading() as session:
        rows, unseen = unseen_first(session, twin.row, seen_by(today) | used)
    rows = rows[:unseen] if unseen else rows
    before, after = (_accuracies(runtime, twin, rows, z) for z in (heights_of(today), new.z))
    stood = standing_of(today.source, today.trusted, bool(today.outdated))
    comes = standing_of(new.source, None if new.trust is None else not new.trust.doubts)
    taken, reason = decide(after - before, unseen, stood, comes, f"version {today.version}")
    return Judgement(today.version, taken, Grounds(reason, float(before.mean()), float(after.mean()), len(rows)))


def decide(gains: Array, unseen: int, stood: Standing, comes: Standing, today: str) -> tuple[bool, str]:
    """Whether the surface that comes is today's from now on, and why, by its ``gains`` (n,) on the photographs."""
    said = "that neither has seen" if unseen else "of which none is unseen"
    which = f"{len(gains)} photograph{'s' if len(gains) > 1 else ''} {said}"
    gain = few_gain(gains) if unseen >= LEAST_UNSEEN else Gain(0.0, 0.0, 0.0, 0.0)
    if gain.low > 0 and stood is _BY_SOURCE["measured"] and comes.rank == 0:
        return False, f"{today} {stood.said}, and this one {comes.said}: only somebody puts it in its place"
    if gain.low > 0 or gain.high < 0:
        told = "better" if gain.low > 0 else "worse"
        by = sorted((abs(gain.low), abs(gain.high)))
        return gain.low > 0, f"forecasts {told} than {today} on {which}, by {by[0]:.1%} to {by[1]:.1%}"
    if comes.rank != stood.rank:
        told = f"{which} do not tell them apart" if unseen >= LEAST_UNSEEN else _too_few(unseen)
        return comes.rank > stood.rank, f"{told}; {today} {stood.said}, this one {comes.said}"
    taken = float(gains.mean()) >= 0
    return taken, f"forecasts {'no worse' if taken else 'worse'} than {today} on {which}"


def _too_few(unseen: int) -> str:
    return f"{unseen} photographs that neither has seen are too few to judge ({LEAST_UNSEEN} do)"


def _accuracies(runtime: Runtime, twin: Twin, rows: Sequence[MeasurementRow], z: Array | None) -> Array:
    """Flux accuracy [1] on each photograph (n,)."""
    shown = [evidence_of(row, twin.origin) for row in rows]
    forecasts = forecasts_of(runtime, twin, shown, z)
    return np.array([flux_accuracy(e.centered, forecast) for e, forecast in zip(shown, forecasts, strict=True)])
