"""Compare a new surface with the active one, or with the ideal mirror.

Both are compared on the same photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from model.metrics import flux_accuracy
from model.study.judging import Gain, few_gain
from service import store
from service.base.choices import Method
from service.store import decisions
from service.store.decisions import Justification
from service.store.surface_versions import NewSurface
from service.store.tables import MeasurementRow, SurfaceRow
from service.twin.measurements import (
    Array,
    HeliostatContext,
    accepted_measurement,
    heights_of,
    load_heliostat_context,
    to_observations,
)
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import (
    forecasts_of,
    held_out_first,
    photograph_name,
    photographs_of_surface,
)
from service.twin.surfaces.present_shape import epoch_of

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
    """Compare a new surface with the active one, on photographs of its epoch.

    At least `MIN_HELD_OUT` held-out photographs decide, if they distinguish the two surfaces
    significantly. But a surface that is not trusted never replaces a measured one. Otherwise the
    higher rank decides. Of equal ranks the new surface wins if its forecast is no worse, because
    its photographs are newer. A surface that would begin an epoch must be significantly better.
    """
    judged = _judge(runtime, twin, active, new)
    rank = precedence_of(active.source, active.trusted, bool(active.outdated or active.deleted))
    new_rank = precedence_of(new.source, None if new.trust is None else not new.trust.warnings)
    gains, name = judged.after - judged.before, f"version {active.version}"
    if new.epoch_since is not None and new.epoch_since != active.epoch_since:
        decision = begin_epoch_or_reject(gains, judged.by, rank, new_rank, name)
    else:
        decision = promote_or_reject(gains, judged.by, rank, new_rank, name)
    return _evaluation(active.version, decision, judged)


def evaluate_first_surface(runtime: Runtime, twin: HeliostatContext, new: NewSurface) -> Evaluation:
    """Compare a new surface with the ideal mirror, if no surface is active.

    At least `MIN_HELD_OUT` held-out photographs decide. If there are fewer, surfaces from parts of
    the photographs judge the rest, and the reason says so.
    """
    judged = _judge(runtime, twin, None, new)
    is_trusted = new.trust is None or not new.trust.warnings
    decision = promote_or_reject_first(judged.after - judged.before, judged.by, is_trusted)
    return _evaluation(None, decision, judged)


def justify_by_hand(runtime: Runtime, name: str, version: int, reason: str) -> Justification:
    """A person's reason, with what the photographs say that judge each new surface.

    If fewer than `MIN_HELD_OUT` are unseen, the last comparison of the two surfaces counts, since
    another cross-validation may take minutes. Without one it is made.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, name)
        active = store.find_surface_at(session, twin.row)
        chosen = store.get_surface(session, twin.row, version)
        seen = photographs_of_surface(active) | photographs_of_surface(chosen)
        held_out = held_out_first(session, twin.row, seen, epoch_of(session, twin.row, chosen))
        known = decisions.find_comparison(session, chosen, active)
    if known is not None and held_out.n_held_out < MIN_HELD_OUT:
        return replace(known, reason=reason)
    if not held_out.rows or (active is not None and chosen.id == active.id):
        return Justification(reason)
    return _grounds(reason, _judge(runtime, twin, active, chosen))


# --- photographs that judge
# --------------------------------------------------------------------------------------------------

PARTS = {"network": 4, "refined": 2}
"""Parts of a surface's photographs, each of which is forecast from the others."""


class JudgedBy(NamedTuple):
    """How photographs judge: the number of held-out ones, and whether by surfaces from parts."""

    unseen: int
    by_parts: bool = False

    def in_words(self, count: int) -> str:
        """The ``count`` photographs that judge, in words."""
        which = f"{count} photograph{'s' if count > 1 else ''}"
        if self.by_parts:
            return f"{which} in cross-validation (surfaces from parts judge the rest)"
        return f"{which} {'that neither has seen' if self.unseen else 'of which none is unseen'}"


@dataclass(frozen=True, eq=False)
class _JudgedSurface:
    """Accuracies (n,) [1] of the active and of the new surface, and how they were found."""

    before: Array
    after: Array
    by: JudgedBy


def _judge(
    runtime: Runtime,
    twin: HeliostatContext,
    active: SurfaceRow | None,
    new: SurfaceRow | NewSurface,
) -> _JudgedSurface:
    """Accuracies on photographs of the new surface's epoch, at least one.

    They are held out if there are at least `MIN_HELD_OUT`. Otherwise surfaces from parts of the
    photographs judge the rest (cross-validation: Hastie et al. 2009, *The Elements of Statistical
    Learning*, section 7.10).
    """
    seen, used = photographs_of_surface(active), photographs_of_surface(new)
    with runtime.database.reading() as session:
        epoch = epoch_of(session, twin.row, new)
        rows, unseen = held_out_first(session, twin.row, seen | used, epoch)
        by_active = held_out_first(session, twin.row, seen, epoch)
    if unseen >= MIN_HELD_OUT:
        before, after = (
            _accuracies(runtime, twin, rows[:unseen], heights_of(one)) for one in (active, new)
        )
        return _JudgedSurface(before, after, JudgedBy(unseen))
    if by_active.n_held_out:  # the active surface needs no parts
        rows = by_active.rows[: by_active.n_held_out]
    old, made = (_by_parts(runtime, twin, one, rows) for one in (active, new))
    fair = old.is_fair & made.is_fair
    if not fair.any():
        return _JudgedSurface(old.accuracies, made.accuracies, JudgedBy(0))
    by = JudgedBy(int(fair.sum()), by_parts=True)
    return _JudgedSurface(old.accuracies[fair], made.accuracies[fair], by)


class _ByParts(NamedTuple):
    """Accuracies (n,) [1] on photographs, and which of them (n,) are of held-out ones."""

    accuracies: Array
    is_fair: NDArray[np.bool_]


def _by_parts(
    runtime: Runtime,
    twin: HeliostatContext,
    surface: SurfaceRow | NewSurface | None,
    rows: Sequence[MeasurementRow],
) -> _ByParts:
    """Accuracies of a surface on photographs.

    A photograph that the surface was computed from is forecast by one from other photographs.
    """
    accuracies = _accuracies(runtime, twin, rows, heights_of(surface))
    made_from = [] if surface is None else list(surface.measurements)
    used = {photograph_name(row) for row in made_from}
    is_fair = np.array([photograph_name(row) not in used for row in rows])
    if is_fair.all() or surface is None or surface.source not in PARTS:
        return _ByParts(accuracies, is_fair)
    with runtime.database.reading() as session:
        names = [row.identifier for row in made_from if row.accepted]
        stored = store.get_measurements(session, twin.row, names, arrays=True)
    stored.sort(key=lambda row: row.id)
    count = min(PARTS[surface.source], len(stored))
    for part in range(count if count > 1 else 0):
        left_out = {photograph_name(row) for row in stored[part::count]}
        rest = [row for row in stored if photograph_name(row) not in left_out]
        places = [n for n, row in enumerate(rows) if photograph_name(row) in left_out]
        if places and rest:
            heights = _predict_from(runtime, twin, rest, surface.source)
            accuracies[places] = _accuracies(runtime, twin, [rows[n] for n in places], heights)
            is_fair[places] = True
    return _ByParts(accuracies, is_fair)


def _predict_from(
    runtime: Runtime, twin: HeliostatContext, rows: Sequence[MeasurementRow], method: str
) -> Array:
    """Heights (F, 8, 8) [m] that photographs show."""
    photos = [accepted_measurement(row, twin.origin) for row in rows]
    with runtime.computing(f"predict_{method}") as operations:
        observations = to_observations(photos, twin.heliostat)
        found = operations.predict(twin.heliostat, observations, twin.model, cast(Method, method))
    return np.asarray(found.z, dtype=np.float64)


class Decision(NamedTuple):
    """Whether a surface becomes active, and the reason."""

    becomes_active: bool
    reason: str


def _evaluation(against: int | None, decision: Decision, judged: _JudgedSurface) -> Evaluation:
    return Evaluation(against, decision.becomes_active, _grounds(decision.reason, judged))


def _grounds(reason: str, judged: _JudgedSurface) -> Justification:
    before, after = float(judged.before.mean()), float(judged.after.mean())
    return Justification(reason, before, after, len(judged.before))


def promote_or_reject_first(gains: Array, by: JudgedBy, is_trusted: bool) -> Decision:
    """Decide whether a first surface becomes active.

    ``gains`` (n,) are accuracy gains over the ideal mirror. A surface that is not trusted must
    forecast better: significantly on at least `MIN_HELD_OUT` held-out photographs, else in the
    mean. A trusted surface stays a candidate only if held-out photographs prove it worse.
    """
    is_held_out, used = by.unseen >= MIN_HELD_OUT, len(gains) - by.unseen
    said = f"{used} of which it was made from" if used else "that it was not made from"
    which = f"{len(gains)} photograph{'s' if len(gains) > 1 else ''}, {said}"
    which = by.in_words(len(gains)) if by.by_parts else which
    gain = few_gain(gains) if is_held_out else None
    better = float(gains.mean()) > 0 if gain is None else gain.low > 0
    worse = gain is not None and gain.high < 0
    word = "better" if better else "worse" if worse else "no better"
    reason = f"forecasts {word} than the ideal mirror on {which}"
    reason = reason if is_trusted else f"is not trusted, and {reason}"
    return Decision(better or (is_trusted and not worse), reason)


def promote_or_reject(
    gains: Array, by: JudgedBy, active: Precedence, new: Precedence, name: str
) -> Decision:
    """Decide whether a new surface becomes active.

    ``gains`` (n,) are accuracy gains over the active surface, which ``name`` names.
    """
    unseen, which = by.unseen, by.in_words(len(gains))
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


def begin_epoch_or_reject(
    gains: Array, by: JudgedBy, active: Precedence, new: Precedence, name: str
) -> Decision:
    """Decide whether a surface begins an epoch of the mirror; arguments of `promote_or_reject`.

    Its photographs must show that it is better. If they are too few, only a person may promote it.
    """
    if by.unseen < MIN_HELD_OUT:
        missing = MIN_HELD_OUT - by.unseen
        reason = f"forecasts {by.in_words(len(gains))} with {gains.mean():+.1%}; {missing} more of"
        return Decision(False, f"{reason} the changed mirror confirm it, or a person")
    decision = promote_or_reject(gains, by, active, new, name)
    if decision.becomes_active and few_gain(gains).low <= 0:
        return Decision(False, f"{by.in_words(len(gains))} do not show that the mirror changed")
    return decision


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
