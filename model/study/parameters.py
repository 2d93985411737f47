"""Convert effects to a vector of parameters, and back."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.effects import Always, ByDay, Effect, Parameter, Scope, Since
from model.effects.correction import Correction
from model.least_squares import Bounds

Array = NDArray[np.float64]


RELATIVE = 0.002
"""Prior deviation [of the range] of the mean over facets, if only differences are observable."""


@dataclass(frozen=True)
class Term:
    """A kind of effect in a scope: always, since a day, perhaps until another, or by day.

    Attributes
    ----------
    kind : Effect class
    since : date or None
    days : tuple of date
        Days with separate values; empty for the other scopes.
    heliostats : tuple of str or None
        Heliostats with the effect; None for all.
    until : date or None
        First day without an effect that began; None while it acts.
    """

    kind: type[Effect]
    since: date | None = None
    days: tuple[date, ...] = ()
    heliostats: tuple[str, ...] | None = None
    until: date | None = None

    @property
    def is_permanent(self) -> bool:
        """Whether it acts always, perhaps at some heliostats only."""
        return self.since is None and not self.days

    @property
    def is_per_heliostat(self) -> bool:
        """Whether it belongs to some heliostats, or all its parameters are per heliostat."""
        return self.heliostats is not None or not any(p.shared for p in self.kind.parameters())

    @property
    def scope(self) -> Scope:
        """When and where it acts, without the values of days."""
        if self.days:
            return ByDay()
        if self.since is None:
            return Always(self.heliostats)
        return Since(self.since, self.heliostats, self.until)

    def is_disjoint_from(self, other: "Term") -> bool:
        """Whether no heliostat has both."""
        if self.heliostats is None or other.heliostats is None:
            return False
        return not set(self.heliostats) & set(other.heliostats)

    def touches(self, heliostat: str, taken_at: datetime | None) -> bool:
        """Whether it may change a photograph."""
        if self.heliostats is not None and heliostat not in self.heliostats:
            return False
        if self.is_permanent:
            return True
        if self.since is not None:
            return Since(self.since, until=self.until).acts_at(taken_at)
        return taken_at is not None and taken_at.date() in self.days


class UnknownGroup(NamedTuple):
    """The common part of unknowns of different heliostats or days."""

    term: Term
    parameter: str
    facet: int | None


@dataclass(frozen=True)
class Unknown:
    """One number: an effect's parameter, perhaps of one heliostat, one facet or one day."""

    term: Term
    parameter: Parameter
    heliostat: str | None = None
    facet: int | None = None
    day: date | None = None

    @property
    def shared(self) -> bool:
        """Whether all heliostats have the same value."""
        return self.heliostat is None

    @property
    def group(self) -> UnknownGroup:
        """The group of unknowns of different heliostats or days: no image depends on two of a
        group.

        Their columns of a Jacobian are estimated at once (Curtis, Powell and Reid 1974,
        doi:10.1093/imamat/13.1.117).
        """
        return UnknownGroup(self.term, self.parameter.name, self.facet)

    def touches(self, heliostat: str, taken_at: datetime | None) -> bool:
        """Whether it may change a photograph."""
        return self.owns(heliostat, taken_at) and self.term.touches(heliostat, taken_at)

    def owns(self, heliostat: str, taken_at: datetime | None) -> bool:
        """Whether a photograph is of its heliostat and day; no other unknown of its group changes
        that photograph.

        This includes photographs from before the effect began: shared errors of a mount change them
        as well.
        """
        is_of_heliostat = self.heliostat is None or self.heliostat == heliostat
        return is_of_heliostat and (
            self.day is None or (taken_at is not None and taken_at.date() == self.day)
        )


@dataclass(frozen=True)
class ParameterVector:
    """The unknowns of some effects at some heliostats.

    Attributes
    ----------
    terms : tuple of Term
    facets : tuple of (str, int)
        Heliostats with their number of facets.
    unseen : frozenset of (str, str)
        Effects and their parameters that the heliostats' mounts do not show (`Effect.unseen`).
    """

    terms: tuple[Term, ...]
    facets: tuple[tuple[str, int], ...]
    unseen: frozenset[tuple[str, str]] = frozenset()

    @cached_property
    def all(self) -> Sequence[Unknown]:
        """All unknowns, in the order of the vector."""
        return tuple(
            u
            for term in self.terms
            for p in term.kind.parameters()
            if (term.kind.name, p.name) not in self.unseen
            for u in self._of(term, p)
        )

    def _of(self, term: Term, parameter: Parameter) -> list[Unknown]:
        facets = [
            (name, count)
            for name, count in self.facets
            if term.heliostats is None or name in term.heliostats
        ]
        if parameter.shared:
            return [Unknown(term, parameter, day=day) for day in term.days or (None,) if facets]
        if parameter.owner == "heliostat":
            return [Unknown(term, parameter, name) for name, _ in facets]
        return [
            Unknown(term, parameter, name, facet)
            for name, count in facets
            for facet in range(count)
        ]

    @property
    def neutral(self) -> Array:
        """Values (P,) without any effect."""
        return np.array([u.parameter.neutral for u in self.all])

    @property
    def bounds(self) -> Bounds:
        """Lower and upper bounds of the values."""
        low, high = ([getattr(u.parameter, end) for u in self.all] for end in Bounds._fields)
        return Bounds(np.array(low), np.array(high))

    @cached_property
    def prior_precision(self) -> Array:
        """Inverse covariance (P, P) of the prior about neutral."""
        low, high = self.bounds
        precision = np.diag(
            1 / (np.array([u.term.kind.prior_std for u in self.all]) * (high - low)) ** 2
        )
        alike: dict[tuple[Term, str, str | None], list[int]] = {}
        for place, unknown in enumerate(self.all):
            if unknown.term.kind.relative:
                alike.setdefault(
                    (unknown.term, unknown.parameter.name, unknown.heliostat), []
                ).append(place)
        for places in alike.values():
            mean_std = RELATIVE * (high - low)[places[0]]
            precision[np.ix_(places, places)] += 1 / (len(places) * mean_std) ** 2
        return precision

    @property
    def groups(self) -> dict[UnknownGroup, list[int]]:
        """Indices of the unknowns of each group."""
        places: dict[UnknownGroup, list[int]] = {}
        for place, unknown in enumerate(self.all):
            places.setdefault(unknown.group, []).append(place)
        return places

    def nested(self, term: Term, values: Sequence[object]) -> dict[str, object]:
        """Return one term's parameters as in its effect's constructor: plain, by heliostat, or by
        day.

        ``values`` are P objects of any type, one for each unknown.
        """
        parameters: dict[str, object] = {}
        for unknown, value in zip(self.all, values, strict=True):
            if unknown.term != term:
                continue
            name = unknown.parameter.name
            key = unknown.heliostat if unknown.day is None else unknown.day.isoformat()
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
        """Return the effects with ``values`` (P,)."""
        plain = [float(value) for value in values]
        return [_effect(term, _arrays(self.nested(term, plain))) for term in self.terms]

    def acting(self, values: Array) -> list[Effect]:
        """Return the effects that differ from neutral, with ``values`` (P,)."""
        moved = {
            u.term
            for u, value in zip(self.all, values, strict=True)
            if value != u.parameter.neutral
        }
        return [
            effect
            for term, effect in zip(self.terms, self.effects(values), strict=True)
            if term in moved
        ]

    def transfer(self, values: Array, target: "ParameterVector") -> Array:
        """Return the values of another vector: ``values`` of common unknowns, else neutral."""
        known = dict(zip(self.all, values, strict=True))
        return np.array([known.get(u, u.parameter.neutral) for u in target.all])

    @property
    def per_heliostat(self) -> "ParameterVector":
        """Those of effects per heliostat."""
        return self.of_terms(term for term in self.terms if term.is_per_heliostat)

    def without(self, terms: Iterable[Term]) -> "ParameterVector":
        """Return the unknowns of all other terms."""
        left_out = set(terms)
        return self.of_terms(term for term in self.terms if term not in left_out)

    def of_terms(self, terms: Iterable[Term]) -> "ParameterVector":
        """Return the unknowns of other terms at the same heliostats."""
        return replace(self, terms=tuple(terms))

    def for_heliostats(self, heliostats: Sequence[str]) -> "ParameterVector":
        """Return the same terms for some of the heliostats."""
        return replace(
            self, facets=tuple((name, count) for name, count in self.facets if name in heliostats)
        )


def _effect(term: Term, parameters: Mapping[str, Any]) -> Effect:
    """Make the effect of a term with parameters as in its constructor."""
    if not term.days:
        return term.kind(**parameters, scope=term.scope)
    by_day = {
        day: {name: float(of_days[day.isoformat()]) for name, of_days in parameters.items()}
        for day in term.days
    }
    usual = {name: float(np.median(list(of_days.values()))) for name, of_days in parameters.items()}
    return term.kind(**usual, scope=ByDay(by_day))


class VectorCopies(NamedTuple):
    """The unknowns of copies of heliostats, and their values."""

    unknowns: ParameterVector
    values: Array


def copy_vector(unknowns: ParameterVector, trials: Array) -> VectorCopies:
    """Copy the heliostats of a vector once for each of its trials (M, P).

    All trials must have the same values of shared unknowns.
    """
    count = len(trials)
    copies = ParameterVector(
        tuple(_copied_term(term, count) for term in unknowns.terms),
        tuple((copy_name(h, m), n) for m in range(count) for h, n in unknowns.facets),
        unknowns.unseen,
    )
    known = {
        replace(
            u,
            term=_copied_term(u.term, count),
            heliostat=None if u.heliostat is None else copy_name(u.heliostat, m),
        ): value
        for m, values in enumerate(trials)
        for u, value in zip(unknowns.all, values, strict=True)
    }
    return VectorCopies(copies, np.array([known[u] for u in copies.all]))


def copy_name(heliostat: str, number: int) -> str:
    """Return the name of a copy of a heliostat."""
    return f"{heliostat}#{number}"


def _copied_term(term: Term, count: int) -> Term:
    """Return a term at copies of its heliostats."""
    if term.heliostats is None:
        return term
    return replace(
        term, heliostats=tuple(copy_name(h, m) for m in range(count) for h in term.heliostats)
    )


def copied(effect: Effect, count: int) -> Effect:
    """Return an effect with ``count`` copies of its heliostats."""
    scope = effect.scope
    if not isinstance(scope, ByDay) and scope.heliostats is not None:
        scope = replace(
            scope, heliostats=tuple(copy_name(h, m) for m in range(count) for h in scope.heliostats)
        )
    if isinstance(effect, Correction):
        effect = effect.copied(lambda name: [copy_name(name, m) for m in range(count)])
    changes: dict[str, Any] = {
        p.name: {
            copy_name(h, m): v for m in range(count) for h, v in getattr(effect, p.name).items()
        }
        for p in effect.parameters()
        if not p.shared
    }
    return replace(effect, **changes, scope=scope)


def _arrays(parameters: Mapping[str, object]) -> dict[str, Any]:
    """Convert lists by heliostat to arrays."""
    return {
        name: {h: np.asarray(v) for h, v in value.items()} if isinstance(value, dict) else value
        for name, value in parameters.items()
    }
