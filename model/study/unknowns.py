"""Effects as numbers to be fitted, and back."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.effects import Always, ByDay, Effect, Parameter, Scope, Since

Array = NDArray[np.float64]


RELATIVE = 0.002
"""Prior standard deviation, in shares of the range, of what a mirror's facets share where only differences are seen."""


@dataclass(frozen=True)
class Term:
    """A kind of effect and the scope that it is sought in: always, since a day, or by the values of some days.

    Attributes
    ----------
    kind : Effect class
    since : date or None
    days : tuple of date
        Those that have values of their own; empty for the other scopes.
    heliostats : tuple of str or None
        Those that it is sought at, of a kind of mirror or drive; None for all.
    """

    kind: type[Effect]
    since: date | None = None
    days: tuple[date, ...] = ()
    heliostats: tuple[str, ...] | None = None

    @property
    def always(self) -> bool:
        """Whether it acts always, perhaps not everywhere."""
        return self.since is None and not self.days

    @property
    def own(self) -> bool:
        """Whether all its parameters belong to heliostats, or it does to some."""
        return self.heliostats is not None or not any(p.shared for p in self.kind.parameters())

    @property
    def scope(self) -> Scope:
        """When and where it acts, but for the values of days."""
        if self.days:
            return ByDay()
        return Always(self.heliostats) if self.since is None else Since(self.since, self.heliostats)

    def is_apart_from(self, other: "Term") -> bool:
        """Whether no heliostat has both."""
        if self.heliostats is None or other.heliostats is None:
            return False
        return not set(self.heliostats) & set(other.heliostats)

    def touches(self, heliostat: str, taken_at: datetime | None) -> bool:
        """Whether a photograph may change with it."""
        if self.heliostats is not None and heliostat not in self.heliostats:
            return False
        if self.always:
            return True
        if taken_at is None:  # of today, as `Since` has it
            return self.since is not None
        return taken_at.date() in self.days if self.since is None else taken_at.date() >= self.since


@dataclass(frozen=True)
class Unknown:
    """One number: a parameter of an effect, of one heliostat and one of its facets, or of a day, where it is theirs."""

    term: Term
    parameter: Parameter
    heliostat: str | None = None
    facet: int | None = None
    day: date | None = None

    @property
    def shared(self) -> bool:
        """Whether all heliostats have it in common."""
        return self.heliostat is None

    @property
    def group(self) -> tuple[Term, str, int | None]:
        """Unknowns of one group belong to different heliostats or days: no image depends on two of them.

        Their columns of a Jacobian are estimated at once (Curtis, Powell and Reid 1974, doi:10.1093/imamat/13.1.117).
        """
        return self.term, self.parameter.name, self.facet

    def touches(self, heliostat: str, taken_at: datetime | None) -> bool:
        """Whether a photograph may change with it."""
        return self.owns(heliostat, taken_at) and self.term.touches(heliostat, taken_at)

    def owns(self, heliostat: str, taken_at: datetime | None) -> bool:
        """Whether a photograph is of its heliostat and day, where it has such: others of its group leave that alone.

        Photographs from before an effect began are among them: where a mount's doubts are shared, they change as well.
        """
        theirs = self.heliostat is None or self.heliostat == heliostat
        return theirs and (self.day is None or (taken_at is not None and taken_at.date() == self.day))


@dataclass(frozen=True)
class Unknowns:
    """All numbers of some effects for some heliostats.

    Attributes
    ----------
    terms : tuple of Term
    facets : tuple of (str, int)
        Heliostats with their number of facets.
    """

    terms: tuple[Term, ...]
    facets: tuple[tuple[str, int], ...]

    @cached_property
    def all(self) -> tuple[Unknown, ...]:
        """In the order of the vectors."""
        return tuple(u for term in self.terms for p in term.kind.parameters() for u in self._of(term, p))

    def _of(self, term: Term, parameter: Parameter) -> list[Unknown]:
        facets = [(name, count) for name, count in self.facets if term.heliostats is None or name in term.heliostats]
        if parameter.shared:
            return [Unknown(term, parameter, day=day) for day in term.days or (None,) if facets]
        if parameter.owner == "heliostat":
            return [Unknown(term, parameter, name) for name, _ in facets]
        return [Unknown(term, parameter, name, facet) for name, count in facets for facet in range(count)]

    @property
    def neutral(self) -> Array:
        """Values (P,) that change nothing."""
        return np.array([u.parameter.neutral for u in self.all])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest values, (P,) each."""
        return np.array([u.parameter.low for u in self.all]), np.array([u.parameter.high for u in self.all])

    @cached_property
    def prior_precision(self) -> Array:
        """Inverse of the prior's covariance (P, P) about neutral."""
        low, high = self.bounds
        precision = np.diag(1 / (np.array([u.term.kind.prior_std for u in self.all]) * (high - low)) ** 2)
        alike: dict[tuple[Term, str, str | None], list[int]] = {}
        for place, unknown in enumerate(self.all):
            if unknown.term.kind.relative:
                alike.setdefault((unknown.term, unknown.parameter.name, unknown.heliostat), []).append(place)
        for places in alike.values():
            mean_std = RELATIVE * (high - low)[places[0]]
            precision[np.ix_(places, places)] += 1 / (len(places) * mean_std) ** 2
        return precision

    @property
    def groups(self) -> dict[tuple[Term, str, int | None], list[int]]:
        """Places of the unknowns that may be changed at once, by group."""
        places: dict[tuple[Term, str, int | None], list[int]] = {}
        for place, unknown in enumerate(self.all):
            places.setdefault(unknown.group, []).append(place)
        return places

    def nested(self, term: Term, values: Sequence[object]) -> dict[str, object]:
        """Parameters of one term as its effect's constructor and the report have them: plain, by heliostat, or by day.

        ``values`` are any P objects, one for each unknown.
        """
        parameters: dict[str, object] = {}
        for unknown, value in zip(self.all, values, strict=True):
            if unknown.term != term:
                continue
            name, key = unknown.parameter.name, unknown.heliostat if unknown.day is None else unknown.day.isoformat()
            if key is None:
                parameters[name] = value
                continue
            owned = parameters.setdefault(name, {})
            assert isinstance(owned, dict)
            if unknown.facet is None:
                owned[key] = value
            else:
                owned.setdefault(key, []).append(value)
        return parameters

    def effects(self, values: Array) -> list[Effect]:
        """Effects with parameters ``values`` (P,)."""
        return [self._effect(term, [float(v) for v in values]) for term in self.terms]

    def acting(self, values: Array) -> list[Effect]:
        """Those effects with parameters ``values`` (P,) that change something."""
        moved = {u.term for u, value in zip(self.all, values, strict=True) if value != u.parameter.neutral}
        return [effect for term, effect in zip(self.terms, self.effects(values), strict=True) if term in moved]

    def _effect(self, term: Term, values: Sequence[float]) -> Effect:
        parameters: dict[str, Any] = _arrays(self.nested(term, values))
        if not term.days:
            return term.kind(**parameters, scope=term.scope)
        by_day = {
            day: {name: float(of_days[day.isoformat()]) for name, of_days in parameters.items()} for day in term.days
        }
        usual = {name: float(np.median(list(of_days.values()))) for name, of_days in parameters.items()}
        return term.kind(**usual, scope=ByDay(by_day))

    def put(self, values: Array, into: "Unknowns") -> Array:
        """Values of the unknowns of ``into``: these where it has them too, neutral elsewhere."""
        known = dict(zip(self.all, values, strict=True))
        return np.array([known.get(u, u.parameter.neutral) for u in into.all])

    def copies(self, trials: Array) -> tuple["Unknowns", Array]:
        """Unknowns of as many copies of the heliostats as trials (M, P), and their values.

        The trials must have what heliostats share in common.
        """
        numbers = range(len(trials))
        copies = Unknowns(
            tuple(_copied_term(term, len(trials)) for term in self.terms),
            tuple((copy_name(h, m), n) for m in numbers for h, n in self.facets),
        )
        known = {
            replace(
                u,
                term=_copied_term(u.term, len(trials)),
                heliostat=None if u.heliostat is None else copy_name(u.heliostat, m),
            ): value
            for m, values in enumerate(trials)
            for u, value in zip(self.all, values, strict=True)
        }
        return copies, np.array([known[u] for u in copies.all])

    @property
    def own(self) -> "Unknowns":
        """Those that belong to heliostats."""
        return Unknowns(tuple(term for term in self.terms if term.own), self.facets)

    def without(self, terms: Iterable[Term]) -> "Unknowns":
        """Those of other terms."""
        return Unknowns(tuple(term for term in self.terms if term not in set(terms)), self.facets)

    def of(self, heliostats: Sequence[str]) -> "Unknowns":
        """The same terms for fewer heliostats."""
        return Unknowns(self.terms, tuple((name, count) for name, count in self.facets if name in heliostats))


def copy_name(heliostat: str, number: int) -> str:
    """Name of a copy of a heliostat."""
    return f"{heliostat}#{number}"


def _copied_term(term: Term, count: int) -> Term:
    """A term at copies of its heliostats."""
    if term.heliostats is None:
        return term
    return replace(term, heliostats=tuple(copy_name(h, m) for m in range(count) for h in term.heliostats))


def copied(effect: Effect, count: int) -> Effect:
    """An effect whose heliostats are there ``count`` times."""
    scope = effect.scope
    if not isinstance(scope, ByDay) and scope.heliostats is not None:
        scope = replace(scope, heliostats=tuple(copy_name(h, m) for m in range(count) for h in scope.heliostats))
    changes: dict[str, Any] = {
        p.name: {copy_name(h, m): v for m in range(count) for h, v in getattr(effect, p.name).items()}
        for p in effect.parameters()
        if not p.shared
    }
    return replace(effect, **changes, scope=scope)


def _arrays(parameters: Mapping[str, object]) -> dict[str, Any]:
    """Lists by heliostat as arrays, the rest as it is."""
    return {
        name: {h: np.asarray(v) for h, v in value.items()} if isinstance(value, dict) else value
        for name, value in parameters.items()
    }
