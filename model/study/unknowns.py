"""Effects as numbers to be fitted, and back."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, Parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Unknown:
    """One number: a parameter of an effect, of one heliostat and one of its facets where it belongs to those."""

    effect: type[Effect]
    parameter: Parameter
    heliostat: str | None = None
    facet: int | None = None

    @property
    def shared(self) -> bool:
        """Whether all heliostats have it in common."""
        return self.heliostat is None

    @property
    def group(self) -> tuple[str, str, int | None]:
        """Unknowns of one group belong to different heliostats: no image depends on two of them.

        Their columns of a Jacobian are estimated at once (Curtis, Powell and Reid 1974, doi:10.1093/imamat/13.1.117).
        """
        return self.effect.name, self.parameter.name, self.facet


@dataclass(frozen=True)
class Unknowns:
    """All numbers of some kinds of effect for some heliostats.

    Attributes
    ----------
    kinds : tuple of Effect classes
    facets : tuple of (str, int)
        Heliostats with their number of facets.
    """

    kinds: tuple[type[Effect], ...]
    facets: tuple[tuple[str, int], ...]

    @cached_property
    def all(self) -> tuple[Unknown, ...]:
        """In the order of the vectors."""
        return tuple(u for kind in self.kinds for p in kind.parameters() for u in self._of(kind, p))

    def _of(self, kind: type[Effect], parameter: Parameter) -> list[Unknown]:
        if parameter.scope in ("set", "camera"):
            return [Unknown(kind, parameter)]
        if parameter.scope == "heliostat":
            return [Unknown(kind, parameter, name) for name, _ in self.facets]
        return [Unknown(kind, parameter, name, facet) for name, count in self.facets for facet in range(count)]

    @property
    def neutral(self) -> Array:
        """Values (P,) that change nothing."""
        return np.array([u.parameter.neutral for u in self.all])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest values, (P,) each."""
        return np.array([u.parameter.low for u in self.all]), np.array([u.parameter.high for u in self.all])

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations (P,) about neutral."""
        low, high = self.bounds
        return np.array([u.effect.prior_std for u in self.all]) * (high - low)

    @property
    def groups(self) -> dict[tuple[str, str, int | None], list[int]]:
        """Places of the unknowns that may be changed at once, by group."""
        places: dict[tuple[str, str, int | None], list[int]] = {}
        for place, unknown in enumerate(self.all):
            places.setdefault(unknown.group, []).append(place)
        return places

    def nested(self, kind: type[Effect], values: Sequence[object]) -> dict[str, object]:
        """Parameters of one kind of effect as its constructor and the report have them: plain or by heliostat.

        ``values`` are any P objects, one for each unknown.
        """
        parameters: dict[str, object] = {}
        for unknown, value in zip(self.all, values, strict=True):
            if unknown.effect is not kind:
                continue
            name = unknown.parameter.name
            if unknown.heliostat is None:
                parameters[name] = value
                continue
            by_heliostat = parameters.setdefault(name, {})
            assert isinstance(by_heliostat, dict)
            if unknown.facet is None:
                by_heliostat[unknown.heliostat] = value
            else:
                by_heliostat.setdefault(unknown.heliostat, []).append(value)
        return parameters

    def effects(self, values: Array) -> list[Effect]:
        """Effects with parameters ``values`` (P,)."""
        return [kind(**_arrays(self.nested(kind, [float(v) for v in values]))) for kind in self.kinds]

    def put(self, values: Array, into: "Unknowns") -> Array:
        """Values of the unknowns of ``into``: these where it has them too, neutral elsewhere."""
        known = dict(zip(self.all, values, strict=True))
        return np.array([known.get(u, u.parameter.neutral) for u in into.all])

    def copies(self, trials: Array) -> tuple["Unknowns", Array]:
        """Unknowns of as many copies of the heliostats as trials (M, P), and their values.

        The trials must have what heliostats share in common.
        """
        copies = Unknowns(self.kinds, tuple((copy_name(h, m), n) for m in range(len(trials)) for h, n in self.facets))
        known = {
            replace(u, heliostat=None if u.heliostat is None else copy_name(u.heliostat, m)): value
            for m, values in enumerate(trials)
            for u, value in zip(self.all, values, strict=True)
        }
        return copies, np.array([known[u] for u in copies.all])

    @property
    def own(self) -> "Unknowns":
        """Those that belong to heliostats."""
        kinds = [k for k in self.kinds if all(p.scope in ("heliostat", "facet") for p in k.parameters())]
        return Unknowns(tuple(kinds), self.facets)

    def without(self, kinds: Iterable[type[Effect]]) -> "Unknowns":
        """Those of other kinds."""
        return Unknowns(tuple(k for k in self.kinds if k not in set(kinds)), self.facets)

    def of(self, heliostats: Sequence[str]) -> "Unknowns":
        """The same kinds for fewer heliostats."""
        return Unknowns(self.kinds, tuple((name, count) for name, count in self.facets if name in heliostats))


def copy_name(heliostat: str, number: int) -> str:
    """Name of a copy of a heliostat."""
    return f"{heliostat}#{number}"


def copied(effect: Effect, count: int) -> Effect:
    """An effect whose heliostats are there ``count`` times."""
    changes = {
        p.name: {copy_name(h, m): v for m in range(count) for h, v in getattr(effect, p.name).items()}
        for p in effect.parameters()
        if p.scope in ("heliostat", "facet")
    }
    return replace(effect, **changes)


def _arrays(parameters: Mapping[str, object]) -> dict[str, object]:
    """Lists by heliostat as arrays, the rest as it is."""
    return {
        name: {h: np.asarray(v) for h, v in value.items()} if isinstance(value, dict) else value
        for name, value in parameters.items()
    }
