"""Screen the scopes of effects: from which day on, until which, on which days or at which heliostat
an effect acts.

The cost of each photograph is compared with and without an effect at a few strengths. With the
right scope the photographs inside gain and those outside lose. The most promising scopes are then
fitted and judged by other photographs.

Notes
-----
With the savings s[k, n] of photograph n at strength k::

    always       max_k sum_n s[k, n]
    in a span    max_span max_k sum_{n: day_n in span} s[k, n]       (`best_span`)
    by day       sum_day max(0, max_k sum_{n: day_n = day} s[k, n])  (`time_scopes`)
    one mirror   max_k sum_{n: mirror_n = mirror} s[k, n]            (`single_heliostat_scopes`)

A scope is a candidate if it saves MIN_RATIO times as much as no scope. A span has an end if it
saves MIN_RATIO times as much as the best one without an end.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.study.flux_images import FluxImage
from model.study.parameters import Term

Array = NDArray[np.float64]

STRENGTHS = (1.0, 2.0, 4.0)
"""Strengths at which scopes are screened, as multiples of a fit to all photographs."""

MIN_DAYS = 3
"""Smallest number of days for scopes in time."""

MIN_RATIO = 1.1
"""Smallest ratio of a scope's saving to that of the effect without a scope or an end."""

MIN_SPAN = 2
"""Smallest number of days with photographs of an effect that ended."""

MAX_SCREENED, MIN_SHARE_OF_BEST = 5, 0.4
"""Number of scopes that are fitted, and their smallest saving as a share of the best one's."""


@dataclass(frozen=True)
class ScopeCandidate:
    """An effect in a scope, and the cost that it may save."""

    term: Term
    saved: float


@dataclass(frozen=True)
class Span:
    """Days on which an effect may begin and end, and the cost that it saves between them.

    ``until`` is the first day without it; None while it acts.
    """

    since: date
    until: date | None
    saved: float

    def of(self, term: Term) -> Term:
        """Return an effect in this span."""
        return replace(term, since=self.since, until=self.until)


def days_of(flux_images: Sequence[FluxImage]) -> list[date | None] | None:
    """Return the day of each photograph, if known; None without days of most photographs."""
    days = [None if p.taken_at is None else p.taken_at.date() for p in flux_images]
    known = [day for day in days if day is not None]
    return days if len(known) > len(days) / 2 and len(set(known)) >= MIN_DAYS else None


def time_scopes(
    kind: type[Effect], saved: Array, days: Sequence[date], heliostats: NDArray[np.str_]
) -> Iterator[ScopeCandidate]:
    """Iterate over the scopes in time in which an effect saves clearly more than always.

    ``saved`` (strengths, N) is the cost that each of the N photographs of ``days`` and
    ``heliostats`` saves.
    """
    if "since" in kind.comes:
        names = sorted(set(heliostats.tolist()))
        for chosen in (
            [None, *((name,) for name in names)]
            if Term(kind).is_per_heliostat and len(names) > 1
            else [None]
        ):
            rows = np.flatnonzero(np.isin(heliostats, names if chosen is None else chosen))
            found = best_span(saved[:, rows], [days[row] for row in rows.tolist()])
            if found is not None and found.saved > MIN_RATIO * max(
                0.0, saved[:, rows].sum(axis=1).max()
            ):
                yield ScopeCandidate(found.of(Term(kind, heliostats=chosen)), found.saved)
    if "day" in kind.comes:
        each = {
            day: saved[:, [d == day for d in days]].sum(axis=1).max().clip(min=0)
            for day in sorted(set(days))
        }
        total = float(sum(each.values()))
        if total > MIN_RATIO * max(0.0, saved.sum(axis=1).max()):
            yield ScopeCandidate(Term(kind, days=tuple(each)), total)


def single_heliostat_scopes(
    kind: type[Effect], saved: Array, heliostats: NDArray[np.str_]
) -> Iterator[ScopeCandidate]:
    """Iterate over the single heliostats that may have an effect; ``saved`` as in `time_scopes`.

    A shared effect must save clearly more at that heliostat alone. An effect with values per
    heliostat is a single one's if it saves next to nothing at the others.
    """
    names = sorted(set(heliostats.tolist()))
    if not kind.of_heliostats or len(names) < 2:
        return
    least = max(0.0, saved.sum(axis=1).max()) * (
        1 / MIN_RATIO if Term(kind).is_per_heliostat else MIN_RATIO
    )
    for name in names:
        total = float(saved[:, heliostats == name].sum(axis=1).max())
        if total > least:
            yield ScopeCandidate(Term(kind, heliostats=(name,)), total)


def best_span(saved: Array, days: Sequence[date]) -> Span | None:
    """Return the days between which an effect saves most; None if there is one day only.

    ``saved`` (strengths, N) is the saving of each photograph. A span of fewer than `MIN_SPAN` days
    with photographs has no end. Strengths at which the model fails save minus infinity, and do not
    count.
    """
    known, saved = sorted(set(days)), saved[np.isfinite(saved).all(axis=1)]
    if len(known) < 2 or not len(saved):
        return None
    of_day = np.array([saved[:, [d == day for d in days]].sum(axis=1) for day in known])
    sums = np.vstack([np.zeros(len(saved)), of_day.cumsum(axis=0)])
    total = (sums[None] - sums[:, None]).max(axis=-1)  # [first day, day after the last one]
    begin = 1 + int(total[1:-1, -1].argmax())
    best = Span(known[begin], None, float(total[begin, -1]))
    first, end = np.indices(total.shape)
    ended = np.where((end - first >= MIN_SPAN) & (end < len(known)), total, -np.inf)
    if ended.max() > MIN_RATIO * max(0.0, best.saved):
        begin, until = divmod(int(ended.argmax()), len(ended))
        best = Span(known[begin], known[until], float(ended.max()))
    return best
