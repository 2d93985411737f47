"""Compare a new surface with the active one, or with the ideal mirror.

Both are compared on the same photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from model.metrics import flux_accuracy
from model.study.judging import Gain, few_gain
from service.store.surfaces.decisions import Justification
from service.store.surfaces.surface_versions import NewSurface
from service.store.tables import MeasurementRow, SurfaceRow
from service.twin.heliostats.measurements import (
    Array,
    HeliostatContext,
    accepted_measurement,
    heights_of,
)
from service.twin.runtime.runtime import Runtime
from service.twin.surfaces.accuracy import (
    forecasts_of,
    held_out_first,
    photograph_name,
    photographs_of_surface,
)

MIN_HELD_OUT = 5
"""Least number of held-out photographs that can decide which surface is better."""


@dataclass(frozen=True)
class Evaluation:
    """Decision on a new surface.

    ``became_active`` is whether it becomes active. ``against`` is the version of the active
    surface, None for the ideal mirror.
    """

    against: int | None
    became_active: bool
    grounds: Justification


@dataclass(frozen=True)
class Precedence:
    """Rank of a surface by its source, before forecasts are compared.

    ``said`` gives the reason in words.
    """

    rank: int
    said: str


_BY_SOURCE = {
    "measured": Precedence(3, "was measured"),
    "refined": Precedence(2, "is refined"),
    "network": Precedence(1, "is the network's alone"),
    "imported": Precedence(1, "was imported"),
}


def precedence_of(source: str, trusted: bool | None, is_outdated: bool = False) -> Precedence:
    """Rank a surface by its source: measured, refined, then network or imported.

    A surface that is outdated or not trusted has the lowest rank.
    """
    if is_outdated:
        return Precedence(0, "was made from photographs that were corrected or deleted since")
    if trusted is False:
        return Precedence(0, "is not trusted")
    return _BY_SOURCE[source]


def evaluate_surface(
    runtime: Runtime, twin: HeliostatContext, active: SurfaceRow, new: NewSurface
) -> Evaluation:
    """Compare a predicted surface with the active one.

    At least `MIN_HELD_OUT` held-out photographs decide, if they distinguish the two surfaces
    significantly. But a surface that is not trusted never replaces a measured one. Otherwise the
    higher rank decides. Of equal ranks the new surface wins if its forecast is no worse, because
    its photographs are newer.
    """
    used = {photograph_name(row) for row in new.measurements}
    with runtime.database.reading() as session:
        rows, unseen = held_out_first(session, twin.row, photographs_of_surface(active) | used)
    rows = rows[:unseen] if unseen else rows
    before, after = (_accuracies(runtime, twin, rows, z) for z in (heights_of(active), new.z))
    rank = precedence_of(active.source, active.trusted, bool(active.outdated or active.deleted))
    new_rank = precedence_of(new.source, None if new.trust is None else not new.trust.warnings)
    decision = promote_or_reject(
        after - before, unseen, rank, new_rank, f"version {active.version}"
    )
    return _evaluation(active.version, decision, before, after)


def evaluate_first_surface(runtime: Runtime, twin: HeliostatContext, new: NewSurface) -> Evaluation:
    """Compare a predicted surface with the ideal mirror, if no surface is active.

    At least `MIN_HELD_OUT` held-out photographs decide. If there are fewer, photographs that the
    surface was computed from are added, and the reason says so.
    """
    used = {photograph_name(row) for row in new.measurements}
    with runtime.database.reading() as session:
        rows, unseen = held_out_first(session, twin.row, used)
    rows = rows[:unseen] if unseen >= MIN_HELD_OUT else rows
    before, after = (_accuracies(runtime, twin, rows, z) for z in (None, new.z))
    is_trusted = new.trust is None or not new.trust.warnings
    decision = promote_or_reject_first(after - before, unseen, is_trusted)
    return _evaluation(None, decision, before, after)


class Decision(NamedTuple):
    """Whether a surface becomes active, and the reason."""

    becomes_active: bool
    reason: str


def _evaluation(against: int | None, decision: Decision, before: Array, after: Array) -> Evaluation:
    grounds = Justification(decision.reason, float(before.mean()), float(after.mean()), len(before))
    return Evaluation(against, decision.becomes_active, grounds)


def promote_or_reject_first(gains: Array, unseen: int, is_trusted: bool) -> Decision:
    """Decide whether a first surface becomes active.

    ``gains`` (n,) are accuracy gains over the ideal mirror. ``unseen`` is the number of held-out
    photographs. A surface that is not trusted must forecast better: significantly on at least
    `MIN_HELD_OUT` held-out photographs, else in the mean. A trusted surface stays a candidate only
    if held-out photographs prove it worse.
    """
    is_held_out, used = unseen >= MIN_HELD_OUT, len(gains) - unseen
    said = "that it was not made from" if is_held_out else f"{used} of which it was made from"
    which = f"{len(gains)} photograph{'s' if len(gains) > 1 else ''}, {said}"
    gain = few_gain(gains) if is_held_out else None
    better = float(gains.mean()) > 0 if gain is None else gain.low > 0
    worse = gain is not None and gain.high < 0
    word = "better" if better else "worse" if worse else "no better"
    reason = f"forecasts {word} than the ideal mirror on {which}"
    reason = reason if is_trusted else f"is not trusted, and {reason}"
    return Decision(better or (is_trusted and not worse), reason)


def promote_or_reject(
    gains: Array, unseen: int, active: Precedence, new: Precedence, name: str
) -> Decision:
    """Decide whether a new surface becomes active.

    ``gains`` (n,) are accuracy gains over the active surface, which ``name`` names. ``unseen`` is
    the number of held-out photographs.
    """
    used = "that neither has seen" if unseen else "of which none is unseen"
    which = f"{len(gains)} photograph{'s' if len(gains) > 1 else ''} {used}"
    gain = few_gain(gains) if unseen >= MIN_HELD_OUT else Gain(0.0, 0.0, 0.0, 0.0)
    if gain.low > 0 and active is _BY_SOURCE["measured"] and new.rank == 0:
        reason = f"{name} {active.said}, and this one {new.said}: only a person may promote it"
        return Decision(False, reason)
    if gain.low > 0 or gain.high < 0:
        word = "better" if gain.low > 0 else "worse"
        low, high = sorted((abs(gain.low), abs(gain.high)))
        reason = f"forecasts {word} than {name} on {which}, by {low:.1%} to {high:.1%}"
        return Decision(gain.low > 0, reason)
    if new.rank != active.rank:
        is_enough = unseen >= MIN_HELD_OUT
        reason = f"{which} do not distinguish them" if is_enough else _explain_too_few(unseen)
        reason = f"{reason}; {name} {active.said}, this one {new.said}"
        return Decision(new.rank > active.rank, reason)
    is_no_worse = float(gains.mean()) >= 0
    word = "no worse" if is_no_worse else "worse"
    return Decision(is_no_worse, f"forecasts {word} than {name} on {which}")


def _explain_too_few(unseen: int) -> str:
    return f"{unseen} photographs that neither has seen are too few to judge ({MIN_HELD_OUT} do)"


def _accuracies(
    runtime: Runtime, twin: HeliostatContext, rows: Sequence[MeasurementRow], z: Array | None
) -> Array:
    """Flux accuracy [1] on each photograph (n,)."""
    photos = [accepted_measurement(row, twin.origin) for row in rows]
    forecasts = forecasts_of(runtime, twin, photos, z)
    return np.array(
        [flux_accuracy(e.centered, forecast) for e, forecast in zip(photos, forecasts, strict=True)]
    )
