"""Base of effects: bounded parameters, and functions that act at one stage of the light's path.

The methods act in this order. `Effect.on_sun` and `Effect.on_mount` change directions; they use
numpy, because the alignment after them does. `Effect.on_scene` changes aligned mirrors,
`Effect.on_optics` the optics on the light's path, and `Effect.on_image` the camera's image of the
flux. These three use torch, so that parameters can be tensors with gradients.
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
from model.setup import Setup
from model.site import Site
from model.tracing.scene import Optics, Scene, Window

Array = NDArray[np.float64]
Scalar = float | Tensor
ByHeliostat = Mapping[str, Any]
"""Heliostat name to a number, an array or a tensor.

The shape is (facets,) or a scalar, depending on the parameter's owner.
"""

Owner = Literal["set", "camera", "heliostat", "facet"]
Stage = Literal["geometry", "optics", "image"]
Arrival = Literal["since", "day"]
Factor = Literal["distance", "heliostat", "elevation", "side", "roll", "weather", "camera"]
"""What may vary between photographs; `model.study.advice` names photographs that vary it."""


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
        What has one value: all measurements, a camera, a heliostat, or each facet of a heliostat.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float
    owner: Owner

    @property
    def shared(self) -> bool:
        """True if all heliostats have the same value."""
        return self.owner in ("set", "camera")

    def check(self, effect: str, value: object) -> None:
        """Raise `InvalidInputError` unless ``value`` is finite and within the bounds.

        ``value`` is a number or an array.
        """
        try:
            numbers = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
        except ValueError:  # rows of different lengths
            numbers = np.array("")
        fits = numbers.dtype.kind in "iuf" and numbers.ndim == (self.owner == "facet")
        if not fits or not ((numbers >= self.low) & (numbers <= self.high)).all():
            kind = "numbers, one a facet," if self.owner == "facet" else "a number"
            unit = "" if self.unit == "1" else f" {self.unit}"
            raise InvalidInputError(
                f"effect {effect}: '{self.name}' must be {kind} in [{self.low:g},"
                f" {self.high:g}]{unit}, got {str(value)[:80]}"
            )


def parameter(neutral: float, low: float, high: float, unit: str, owner: Owner = "set") -> Any:
    """A dataclass field for a parameter of an effect.

    Parameters of heliostats or facets are mappings, which are empty by default.
    """
    about = {"neutral": neutral, "low": low, "high": high, "unit": unit, "owner": owner}
    if owner in ("heliostat", "facet"):
        return field(default_factory=dict, metadata=about)
    return field(default=neutral, metadata=about)


@dataclass(frozen=True, eq=False)
class Effect:
    """Base of all effects: frozen dataclasses of parameters.

    Without arguments, an effect changes nothing.

    Attributes
    ----------
    name : str
        Key of the effect in `model.effects.catalogue.CATALOGUE`.
    about : str
        One sentence that describes the effect.
    stage : {"geometry", "optics", "image"}
        What to repeat if a parameter changes: the alignment of the mirrors, the tracing, or only
        the image.
    scales_with : frozenset of Factor
        What changes the effect's trace in an image; other factors do not.
    guesses : tuple of dict
        Start values of a fit, if parameters near neutral, changed one by one, do not lead anywhere.
    prior_std : float
        Prior standard deviation of a parameter about neutral, relative to its range. It should
        matter only if images do not determine the parameter.
    relative : bool
        True if images show only the differences between a mirror's facets, not their common part.
    only_moves : bool
        True if the effect only moves the spot and keeps its shape. Photographs without motor
        positions do not show it.
    comes : frozenset of {"since", "day"}
        How the effect may appear, if it is not always present: permanently from a date, or with
        separate values for each day.
    of_heliostats : bool
        True if the effect belongs to mirror, mount or drive, so that a single heliostat may have
        it. False if it belongs to the sun or a camera.
    needs_neighbours : bool
        True if only setups with ``neighbours`` show the effect.
    scope : Scope
        When and where this effect acts.
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
    needs_neighbours: ClassVar[bool] = False

    scope: Scope = field(default=Always(), kw_only=True)

    @property
    def stages(self) -> frozenset[Stage]:
        """Its stage, or several if it acts at several."""
        return frozenset({self.stage})

    def __post_init__(self) -> None:
        if isinstance(self.scope, ByDay):
            if not all(p.shared for p in self.parameters()):
                raise InvalidInputError(
                    f"effect {self.name}: what belongs to heliostats has no values by day"
                )
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
                raise InvalidInputError(
                    f"effect {self.name}: '{p.name}' must map heliostat names to values"
                )
            else:
                for one in value.values():
                    p.check(self.name, one)

    @classmethod
    def parameters(cls) -> Sequence[Parameter]:
        """The effect's parameters in their order."""
        return tuple(Parameter(name=f.name, **f.metadata) for f in fields(cls) if f.metadata)

    def parameters_to_json(self) -> dict[str, Any]:
        """Values of the parameters, by name, and by heliostat where each has one."""
        return {p.name: _plain(getattr(self, p.name)) for p in self.parameters()}

    @classmethod
    def unseen(cls, mounts: Sequence[Mount]) -> frozenset[str]:
        """Names of the parameters that studies of heliostats on these ``mounts`` do not fit."""
        return frozenset()

    @property
    def heliostats(self) -> list[str] | None:
        """Heliostats that its parameters name; None for an effect with shared parameters."""
        named = [getattr(self, p.name) for p in self.parameters() if not p.shared]
        return sorted({name for by_heliostat in named for name in by_heliostat}) if named else None

    def at(self, taken_at: datetime | None, heliostat: str | None) -> "Effect | None":
        """The effect at a time and a heliostat; None if it does not act.

        For one day, it is always the same object. Without a time, the current state counts: a
        permanent change persists, and values by day are the usual ones. Without a heliostat, such
        as for the sun, only the effects of all heliostats act.
        """
        phase = self.scope.phase(taken_at, heliostat)
        return self._days[phase] if isinstance(phase, date) else self if phase else None

    @cached_property
    def _days(self) -> dict[date, "Effect"]:
        """The effect for each day that has separate values."""
        by_day = self.scope.by_day if isinstance(self.scope, ByDay) else {}
        return {day: replace(self, **values, scope=Always()) for day, values in by_day.items()}

    def on_sun(self, suns: Array, site: Site) -> Array:
        """Convert recorded unit vectors (B, 3) towards the sun to the true ones."""
        return suns

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Convert a heliostat's surveyed mount to the real one; ``heliostat`` is its name."""
        return mount

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Convert a scene of B mirrors to the real mirrors of B ``heliostats``."""
        return scene

    def on_setups(self, scene: Scene, setups: Sequence[Setup], site: Site) -> Scene:
        """Convert a scene as `on_scene`, also by what else is known of B setups at a site."""
        return self.on_scene(scene, [setup.heliostat for setup in setups])

    def on_optics(self, optics: Optics) -> Optics:
        """Convert the declared optics to the real optics."""
        return optics

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Convert irradiance (B, rows, columns) over ``window`` to the camera's image."""
        return images

    def on_images(
        self, images: Tensor, window: Window, setups: Sequence[Setup], site: Site
    ) -> Tensor:
        """Convert irradiance as `on_image`, also by what is known of B setups at a site."""
        return self.on_image(images, window)


def _plain(value: Any) -> Any:
    """Convert tensors and arrays to floats and lists."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    return np.asarray(
        value.detach().cpu() if isinstance(value, Tensor) else value, dtype=np.float64
    ).tolist()


def acting(
    effects: Iterable[Effect], taken_at: datetime | None, heliostat: str | None
) -> tuple[Effect, ...]:
    """The effects that act at a time and a heliostat, as they are then.

    If the same effects act, the objects are the same.
    """
    return tuple(
        there for effect in effects if (there := effect.at(taken_at, heliostat)) is not None
    )


def quadrature(first: Scalar, second: Scalar) -> Scalar:
    """Standard deviation of the sum of two independent errors.

    It is differentiable even if the first error is zero.
    """
    if not isinstance(first, Tensor) and not isinstance(second, Tensor):
        return math.hypot(first, second)
    if not isinstance(first, Tensor) and first == 0:
        return second
    return torch.sqrt(torch.as_tensor(first) ** 2 + torch.as_tensor(second) ** 2)


def stacked(
    effect: str, values: ByHeliostat, heliostats: Sequence[Heliostat], neutral: Tensor
) -> Tensor:
    """The values (B, ...) of B heliostats, ``neutral`` (...) for missing names.

    Raises
    ------
    InvalidInputError
        If the number of values differs from the number of a heliostat's facets.
    """
    rows = []
    for heliostat in heliostats:
        value = values.get(heliostat.name)
        row = neutral if value is None else torch.as_tensor(value).to(neutral)
        if row.shape != neutral.shape:
            raise InvalidInputError(
                f"effect {effect}: {heliostat.name} has {neutral.shape[0]} facets, got"
                f" {row.shape[0]} values"
            )
        rows.append(row)
    return torch.stack(rows)
