"""Correction: what photographs demand, but no effect of the catalogue describes. It is no cause.

What it is
    The generic terms of a study's discrepancy (`model.study.discrepancy`), as an effect. Terms of
    the mirror and of angles change all light. Terms of camera, target, geometry and added light
    change images of calibration targets only, never the light on a receiver.

Source
    Coefficients of `model.effects.generic_kinds`, in proportion to covariates. Beyond the limits
    that the photographs covered, covariates count as the limit. Unknown ones count as their mean.

Approximations
    Terms act in the order of the light, not in the order in which they were found. Normalised
    images do not show how much light a mirror reflects, so its light is the same in sum.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import isfinite
from typing import Any, ClassVar, NamedTuple, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.covariates import SCALINGS, Covariate, slant_range
from model.effects.base import Effect, Factor, Stage
from model.effects.generic_kinds import (
    BEAM_KINDS,
    IMAGE_KINDS,
    MAX_FACETS,
    SUN_SIZE,
    GenericKind,
    SpotImages,
    beam_turns,
    changed_images,
    deformed,
    mirror_kinds,
    with_moments,
)
from model.effects.scope import ByDay, scope_from_json
from model.errors import InvalidInputError
from model.images import FLUX_WINDOW
from model.setup import Setup
from model.site import Site
from model.tracing.scene import Scene, Window

Array = NDArray[np.float64]

NAME = "correction"

CAMERA_KINDS = {kind.name: kind for kind in IMAGE_KINDS if kind.lives_in != "angle"}
COVARIATES = {covariate.key: covariate for covariate in SCALINGS}
KINDS = {
    kind.name: {component.name for component in kind.components}
    for kind in (*IMAGE_KINDS, SUN_SIZE, *mirror_kinds(np.zeros((MAX_FACETS, 2))))
}
"""Names of all kinds' components."""


class RelativeCovariate(NamedTuple):
    """A covariate less its center, within limits."""

    covariate: Covariate
    center: float
    limits: tuple[float, float]

    def of(self, setup: Setup, site: Site) -> float:
        """The value for a setup; zero if it is unknown."""
        value = self.covariate.of(setup, site)
        return 0.0 if value is None else float(np.clip(value, *self.limits)) - self.center

    def to_json(self) -> dict[str, Any]:
        """As in a study's report."""
        return self.covariate.per(self.center, self.limits)


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of a kind's component.

    Attributes
    ----------
    kind, name : str
        Of the kind and of its component.
    value : float
    of : str or None
        The heliostat or target that has it; None for all.
    per : RelativeCovariate or None
        None for a constant.
    """

    kind: str
    name: str
    value: float
    of: str | None = None
    per: RelativeCovariate | None = None

    @property
    def is_of_heliostat(self) -> bool:
        """Whether ``of`` is a heliostat, and not a target."""
        return self.of is not None and self.kind not in CAMERA_KINDS

    def amount(self, setup: Setup, site: Site) -> float:
        """The component's amount for a setup."""
        owner = setup.plane.name if self.kind in CAMERA_KINDS else setup.heliostat.name
        if self.of not in (None, owner):
            return 0.0
        return self.value * (1.0 if self.per is None else self.per.of(setup, site))

    def to_json(self) -> dict[str, Any]:
        """As in a study's report."""
        per = None if self.per is None else self.per.to_json()
        about = {"kind": self.kind, "name": self.name, "of": self.of}
        return {**about, "value": self.value, "per": per}


@dataclass(frozen=True, eq=False)
class Correction(Effect):
    """A correction by ``coefficients`` that were fitted to cuts of side ``window`` [m]."""

    name: ClassVar[str] = NAME
    about: ClassVar[str] = (
        "Correction (no cause): what photographs demand, but no effect describes."
    )
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset()
    of_heliostats: ClassVar[bool] = True

    coefficients: tuple[Coefficient, ...] = ()
    window: float = FLUX_WINDOW

    @cached_property
    def kinds(self) -> list[str]:
        """Names of its kinds, in their order."""
        return list(dict.fromkeys(c.kind for c in self.coefficients))

    @cached_property
    def stages(self) -> frozenset[Stage]:
        """Geometry for what changes light, image for what only cameras show."""
        return frozenset("image" if name in CAMERA_KINDS else "geometry" for name in self.kinds)

    @property
    def heliostats(self) -> list[str] | None:
        """Heliostats that all of its coefficients name; None if any is of others, too."""
        if not all(c.is_of_heliostat for c in self.coefficients):
            return None
        return sorted({str(c.of) for c in self.coefficients})

    def amounts(self, kind: GenericKind, setups: Sequence[Setup], site: Site) -> Array:
        """Amounts (n, K) of a kind's components for n setups."""
        places = {component.name: place for place, component in enumerate(kind.components)}
        found = np.zeros((len(setups), len(places)))
        for c in self.coefficients:
            if c.kind == kind.name and c.name in places:
                found[:, places[c.name]] += [c.amount(setup, site) for setup in setups]
        return found

    def on_setups(self, scene: Scene, setups: Sequence[Setup], site: Site) -> Scene:
        """Deform the mirrors, and change the beams."""
        centers = scene.control_points.mean(dim=(-2, -1))[:, :, :2].double().numpy()
        centers = np.broadcast_to(centers.round(6), (len(setups), *centers.shape[1:]))
        mirrors = [_mirror_kinds(facets.tobytes()) for facets in centers]
        for name in self.kinds:
            if name in mirrors[0]:
                amounts = self.amounts(mirrors[0][name], setups, site)
                kinds = [kinds[name] for kinds in mirrors]
                scene = deformed(scene, kinds, torch.as_tensor(amounts))
        moments = np.hstack([self.amounts(kind, setups, site) for kind in BEAM_KINDS])
        if not moments.any():
            return scene
        turned = scene.with_(beam_turns=beam_turns(setups, scene))
        return with_moments(turned, torch.as_tensor(moments))

    def on_images(
        self, images: Tensor, window: Window, setups: Sequence[Setup], site: Site
    ) -> Tensor:
        """Change the images (B, rows, columns) of B setups, as camera and target do."""
        axes = np.array([setup.plane.axes[:2] for setup in setups])
        away = np.array([setup.goal - setup.plane.center for setup in setups])
        spots = SpotImages(
            images=images.detach().double().cpu().numpy(),
            size=(window.width, window.height),
            places=np.einsum("nij,nj->ni", axes, away) * window.on_spot,
            half=np.array([setup.plane.width / 2 for setup in setups])[:, None, None],
            slant_range=np.array([slant_range(setup) for setup in setups]),
            window=self.window,
        )
        for kind in (CAMERA_KINDS[name] for name in self.kinds if name in CAMERA_KINDS):
            changed = changed_images(kind, spots, self.amounts(kind, setups, site))
            spots = replace(spots, images=changed.clip(min=0))
        return torch.as_tensor(spots.images).to(images)

    def parameters_to_json(self) -> dict[str, Any]:
        """The parameters, as `correction_from_json` reads them."""
        coefficients = [c.to_json() for c in self.coefficients]
        return {"coefficients": coefficients, "window_m": self.window}

    def copied(self, names: Callable[[str], Sequence[str]]) -> "Correction":
        """The same for copies of heliostats, with the ``names`` of each heliostat's copies."""
        copies = [
            replace(c, of=name)
            for c in self.coefficients
            for name in (names(str(c.of)) if c.is_of_heliostat else [c.of])
        ]
        return replace(self, coefficients=tuple(copies))


@lru_cache(maxsize=256)
def _mirror_kinds(centers: bytes) -> dict[str, GenericKind]:
    """Kinds of a mirror with facets at some ``centers`` (F, 2) [m], by name."""
    return {kind.name: kind for kind in mirror_kinds(np.frombuffer(centers).reshape(-1, 2))}


def correction_from_json(data: object, scope: object = None) -> Correction:
    """Parse the parameters of a correction; a study's report has the same ``coefficients``.

    Raises
    ------
    InvalidInputError
        If they are malformed, or a kind or component is unknown.
    """
    given = data if isinstance(data, Mapping) else {}
    entries, window = given.get("coefficients"), given.get("window_m", FLUX_WINDOW)
    if not isinstance(entries, list) or not _is_number(window) or window <= 0:
        raise InvalidInputError(
            "effect correction: 'parameters' must have a list of 'coefficients', and 'window_m' [m]"
        )
    when = scope_from_json(scope, NAME)
    if isinstance(when, ByDay):
        raise InvalidInputError("effect correction: it has no values by day")
    coefficients = tuple(_coefficient(entry) for entry in entries)
    return Correction(coefficients=coefficients, window=float(window), scope=when)


def _coefficient(data: Any) -> Coefficient:
    entry = data if isinstance(data, Mapping) else {}
    kind, name, of, value = (entry.get(key) for key in ("kind", "name", "of", "value"))
    is_known = name in KINDS.get(str(kind), ())
    if not is_known or not isinstance(of, str | None) or not _is_number(value):
        raise InvalidInputError(
            "effect correction: a coefficient must have a known 'kind' and 'name', a number"
            f" 'value', and may have 'of', got {str(data)[:120]}"
        )
    return Coefficient(str(kind), str(name), float(value), of, _per(entry.get("per")))


def _per(data: Any) -> RelativeCovariate | None:
    if data is None:
        return None
    entry = data if isinstance(data, Mapping) else {}
    covariate, limits = COVARIATES.get(str(entry.get("covariate"))), entry.get("limits")
    given = [entry.get("center"), *(limits if isinstance(limits, list) else [])]
    numbers = [float(number) for number in given if _is_number(number)]
    if covariate is None or len(numbers) != 3:
        raise InvalidInputError(
            "effect correction: 'per' must have a known 'covariate', its 'center' and two 'limits',"
            f" got {str(data)[:120]}; a study of this version writes them"
        )
    center, low, high = numbers
    return RelativeCovariate(covariate, center, (low, high))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
