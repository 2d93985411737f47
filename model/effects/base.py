"""What an effect is: a few bounded parameters and pure functions that act where the physics acts.

Light meets the hooks in this order: `Effect.on_sun` and `Effect.on_mount` change where things point, in numpy, since
the alignment that follows is numpy; `Effect.on_scene` changes mirrors that already stand before the sun,
`Effect.on_optics` what the light meets on its way, and `Effect.on_image` what the camera makes of the flux, all three
in torch, where parameters that are tensors carry gradients.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import date, datetime
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.effects.scope import Always, ByDay, Scope
from model.errors import InvalidInputError
from model.mount import Mount
from model.plant import Heliostat
from model.tracing.scene import Optics, Scene, Window

Array = NDArray[np.float64]
Scalar = float | Tensor
ByHeliostat = Mapping[str, Any]
"""Heliostat name to a number, an array or a tensor: (facets,) or a scalar, as the parameter's owner says."""

Owner = Literal["set", "camera", "heliostat", "facet"]
Stage = Literal["geometry", "optics", "image"]
Arrival = Literal["since", "day"]
Factor = Literal["distance", "heliostat", "elevation", "side", "roll", "weather", "camera"]
"""What may vary between photographs; `model.study.advice` says which photographs vary it."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes
    ----------
    name, unit : str
    low, high : float
        Bounds.
    neutral : float
        The value at which the effect changes nothing.
    owner : {"set", "camera", "heliostat", "facet"}
        Whom one value belongs to: all measurements, a camera's, one heliostat, or each facet of one heliostat.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float
    owner: Owner

    @property
    def shared(self) -> bool:
        """Whether all heliostats have one value in common."""
        return self.owner in ("set", "camera")

    def check(self, effect: str, value: object) -> None:
        """Raise `InvalidInputError` unless ``value``, a number or an array, is finite and within the bounds."""
        try:
            numbers = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
        except ValueError:  # rows of different lengths
            numbers = np.array("")
        fits = numbers.dtype.kind in "iuf" and numbers.ndim == (self.owner == "facet")
        if not fits or not ((numbers >= self.low) & (numbers <= self.high)).all():
            kind = "numbers, one a facet," if self.owner == "facet" else "a number"
            unit = "" if self.unit == "1" else f" {self.unit}"
            raise InvalidInputError(
                f"effect {effect}: '{self.name}' must be {kind} in [{self.low:g}, {self.high:g}]{unit}, "
                f"got {str(value)[:80]}"
            )


def parameter(neutral: float, low: float, high: float, unit: str, owner: Owner = "set") -> Any:
    """A dataclass field of an effect; one that belongs to heliostats is a mapping, empty where none is named."""
    about = {"neutral": neutral, "low": low, "high": high, "unit": unit, "owner": owner}
    if owner in ("heliostat", "facet"):
        return field(default_factory=dict, metadata=about)
    return field(default=neutral, metadata=about)


@dataclass(frozen=True, eq=False)
class Effect:
    """Base of all effects, which are frozen dataclasses of parameters; without arguments an effect changes nothing.

    Attributes
    ----------
    name : str
        As in DESIGN.md, section 5.
    about : str
        What it is, in one sentence for people.
    stage : {"geometry", "optics", "image"}
        What must be done anew when a parameter changes: the alignment of the mirrors, the tracing, or only the image.
    scales_with : frozenset of Factor
        What changes the effect's mark in an image; what is not named leaves it alone.
    guesses : tuple of dict
        Parameters to begin a fit from, where those near neutral lead nowhere one by one.
    prior_std : float
        Prior standard deviation of a parameter about neutral, in shares of its range. It should matter only for what
        images cannot tell.
    relative : bool
        Whether images show only by how much a mirror's facets differ, and not what they share.
    only_moves : bool
        Whether it leaves the light's shape and moves its centre alone: photographs without motors say nothing of it.
    comes : frozenset of {"since", "day"}
        How it may come, if it is not always there: at a date, to stay, or with each day anew.
    of_heliostats : bool
        Whether it is of mirror, mount or drive, so that one heliostat may have it alone; not of the sun or a camera.
    scope : Scope
        When and where this one acts.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    stage: ClassVar[Stage]
    scales_with: ClassVar[frozenset[Factor]]
    guesses: ClassVar[tuple[dict[str, float], ...]] = ()
    prior_std: ClassVar[float] = 1.0
    relative: ClassVar[bool] = False
    only_moves: ClassVar[bool] = False
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since"})
    of_heliostats: ClassVar[bool] = False

    scope: Scope = field(default=Always(), kw_only=True)

    def __post_init__(self) -> None:
        if isinstance(self.scope, ByDay):
            if not all(p.shared for p in self.parameters()):
                raise InvalidInputError(f"effect {self.name}: what belongs to heliostats has no values by day")
        elif self.scope.heliostats is not None and not self.of_heliostats:
            raise InvalidInputError(
                f"effect {self.name}: the sun and the camera are the same for all heliostats; "
                "leave 'heliostats' out of its scope"
            )
        for p in self.parameters():
            value = getattr(self, p.name)
            if p.shared:
                p.check(self.name, value)
            elif not isinstance(value, Mapping):
                raise InvalidInputError(f"effect {self.name}: '{p.name}' must map heliostat names to values")
            else:
                for one in value.values():
                    p.check(self.name, one)

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """The effect's parameters in their order."""
        return tuple(Parameter(name=f.name, **f.metadata) for f in fields(cls) if f.metadata)

    @property
    def heliostats(self) -> list[str] | None:
        """Those that its parameters name; None for what all have in common."""
        named = [getattr(self, p.name) for p in self.parameters() if not p.shared]
        return sorted({name for by_heliostat in named for name in by_heliostat}) if named else None

    def at(self, taken_at: datetime | None, heliostat: str | None) -> "Effect | None":
        """What it is at a time and a heliostat, None where it does not act; of one day it is always the same object.

        What is of no known time is of today: what has changed stays so, and the day is as days usually are. What is of
        no heliostat, as the sun, has only what all have.
        """
        phase = self.scope.phase(taken_at, heliostat)
        return self._days[phase] if isinstance(phase, date) else self if phase else None

    @cached_property
    def _days(self) -> dict[date, "Effect"]:
        """The effect of each day that has values of its own."""
        by_day = self.scope.by_day if isinstance(self.scope, ByDay) else {}
        return {day: replace(self, **values, scope=Always()) for day, values in by_day.items()}

    def on_sun(self, suns: Array, latitude_deg: float) -> Array:
        """Unit vectors (B, 3) towards the sun, as they were recorded, to where it really stood."""
        return suns

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """The mount of a heliostat of that name as it was surveyed to how it really stands."""
        return mount

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """A scene of B mirrors, those of the B ``heliostats``, to how they really are."""
        return scene

    def on_optics(self, optics: Optics) -> Optics:
        """The declared optics to what the light really meets."""
        return optics

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Irradiance (B, rows, columns) over ``window`` to what the camera shows of it."""
        return images


def acting(effects: Iterable[Effect], taken_at: datetime | None, heliostat: str | None) -> tuple[Effect, ...]:
    """The effects that act at a time and a heliostat, as they are then; the same objects wherever the same act."""
    return tuple(there for effect in effects if (there := effect.at(taken_at, heliostat)) is not None)


def quadrature(first: Scalar, second: Scalar) -> Scalar:
    """Standard deviation of the sum of two independent errors; differentiable where the first is zero, too."""
    if not isinstance(first, Tensor) and not isinstance(second, Tensor):
        return math.hypot(first, second)
    if not isinstance(first, Tensor) and first == 0:
        return second
    return torch.sqrt(torch.as_tensor(first) ** 2 + torch.as_tensor(second) ** 2)


def stacked(effect: str, values: ByHeliostat, heliostats: Sequence[Heliostat], neutral: Tensor) -> Tensor:
    """The values (B, ...) of B heliostats, ``neutral`` (...) for those that are not named.

    Raises
    ------
    InvalidInputError
        Where a heliostat has not as many facets as values.
    """
    rows = []
    for heliostat in heliostats:
        value = values.get(heliostat.name)
        row = neutral if value is None else torch.as_tensor(value).to(neutral)
        if row.shape != neutral.shape:
            raise InvalidInputError(
                f"effect {effect}: {heliostat.name} has {neutral.shape[0]} facets, got {row.shape[0]} values"
            )
        rows.append(row)
    return torch.stack(rows)
