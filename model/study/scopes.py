"""Which scope an effect may have: since when a mirror or a camera is another one, which days or mirrors differ.

Found by what every photograph gains from an effect at a few strengths: the photographs after a change gain, those
before it lose; those of one heliostat gain, those of others lose. What looks best is then fitted in earnest, and
judged by photographs that had no say in it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.study.flux_images import FluxImage
from model.study.unknowns import Term

Array = NDArray[np.float64]

STRENGTHS = (1.0, 2.0, 4.0)
"""Multiples, of what fits all photographs best, at which gains are looked at: what is not always there is diluted."""

LEAST_DAYS = 3
"""Days from which on some of them can differ from the others."""

BEYOND = 1.1
"""Gain of a scope, in gains of the same effect without one, below which it is not worth a fit."""

SCREENED, OF_THE_BEST = 5, 0.4
"""How many of the most promising scopes are fitted, and from which share of the best one's promise on."""


@dataclass(frozen=True)
class Promise:
    """An effect in a scope, and the cost that it may save."""

    term: Term
    saved: float


def days_of(flux_images: Sequence[FluxImage]) -> list[date | None] | None:
    """The day of each photograph, where it is known; None unless most are, and there are several."""
    days = [None if p.taken_at is None else p.taken_at.date() for p in flux_images]
    known = [day for day in days if day is not None]
    return days if len(known) > len(days) / 2 and len(set(known)) >= LEAST_DAYS else None


def promises(kind: type[Effect], saved: Array, days: Sequence[date], heliostats: NDArray[np.str_]) -> Iterator[Promise]:
    """The scopes in which a kind of effect saves clearly more than without one.

    ``saved`` (strengths, N) is the cost that each of the N photographs of ``days`` and ``heliostats`` saves.
    """
    if "since" in kind.comes:
        names = sorted(set(heliostats.tolist()))
        for chosen in [None, *((name,) for name in names)] if Term(kind).own and len(names) > 1 else [None]:
            rows = np.flatnonzero(np.isin(heliostats, names if chosen is None else chosen))
            found = change(saved[:, rows], [days[row] for row in rows.tolist()])
            if found is not None and found[1] > BEYOND * max(0.0, saved[:, rows].sum(axis=1).max()):
                yield Promise(Term(kind, since=found[0], heliostats=chosen), found[1])
    if "day" in kind.comes:
        each = {day: saved[:, [d == day for d in days]].sum(axis=1).max().clip(min=0) for day in sorted(set(days))}
        total = float(sum(each.values()))
        if total > BEYOND * max(0.0, saved.sum(axis=1).max()):
            yield Promise(Term(kind, days=tuple(each)), total)


def alone(kind: type[Effect], saved: Array, heliostats: NDArray[np.str_]) -> Iterator[Promise]:
    """One heliostat, where an effect of mirror or drive is its own, in the photographs as in `promises`.

    What all share in kind and size must save clearly more there alone. What every heliostat has values of its own for
    is one's where the others' save next to nothing.
    """
    names = sorted(set(heliostats.tolist()))
    if not kind.of_heliostats or len(names) < 2:
        return
    least = max(0.0, saved.sum(axis=1).max()) * (1 / BEYOND if Term(kind).own else BEYOND)
    for name in names:
        total = float(saved[:, heliostats == name].sum(axis=1).max())
        if total > least:
            yield Promise(Term(kind, heliostats=(name,)), total)


def change(saved: Array, days: Sequence[date]) -> tuple[date, float] | None:
    """The day from which on most is saved, and how much; None where there is but one.

    ``saved`` (strengths, N) is what each photograph saves.
    """
    best: tuple[date, float] | None = None
    for day in sorted(set(days))[1:]:
        after = np.array([d >= day for d in days])
        total = float(saved[:, after].sum(axis=1).max())
        if best is None or total > best[1]:
            best = day, total
    return best
