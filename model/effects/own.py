"""Effects that a plant writes: a few functions make them, and files and packages add them.

An example of such a file::

    import torch
    from heliotwin.effects import mirror_effect

    mirror_effect(
        "focus_by_hour",
        "Focus by hour: facets bend as the sun warms one side of them.",
        lambda x, y, X, Y, seen: 1e-3 / 2 * (x**2 + y**2) * torch.sin(seen.hour_angle),
        -4, 4, "mrad/m",
    )

Each has one parameter, ``amplitude``, by which its function is multiplied. It is fitted and judged
as those of the catalogue are.
"""

import math
import re
import runpy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, make_dataclass
from datetime import datetime
from functools import cached_property, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from model.effects.base import Effect, Owner, Scalar, Stage, parameter
from model.effects.catalogue import CATALOGUE, ORDER
from model.effects.deformation import coefficients_of, places_on
from model.errors import InvalidInputError
from model.frames import solar_time
from model.mount import Mount, rotation
from model.setup import Setup
from model.site import Site
from model.tracing.scene import Scene, Window

ENTRY_POINTS = "heliotwin.effects"
"""Group of the modules in installed packages that add effects."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Circumstances:
    """What is known of B photographs. Tensors are (B, 1, 1, 1): they multiply places on mirrors."""

    scene: Scene
    setups: Sequence[Setup]
    site: Site

    def _tensor(self, values: Any) -> Tensor:
        given: Tensor = torch.as_tensor(np.asarray(values)).to(self.scene.sun)
        return given.reshape(-1, 1, 1, 1)

    def _known(self, name: str, values: Sequence[Any]) -> Sequence[Any]:
        for setup, value in zip(self.setups, values, strict=True):
            if value is None:
                raise InvalidInputError(f"{setup.identifier or 'a forecast'} has no {name}")
        return values

    @property
    def time(self) -> Sequence[datetime]:
        """When they were taken, with time zones."""
        return self._known("time", [setup.taken_at for setup in self.setups])

    @property
    def temperature(self) -> Tensor:
        """Temperature of the air [deg C]."""
        temperatures = [setup.temperature_c for setup in self.setups]
        return self._tensor(self._known("temperature", temperatures))

    @cached_property
    def hour_angle(self) -> Tensor:
        """Angle [rad] by which the sun is past noon: 15 degrees for an hour."""
        hours = solar_time(self.scene.sun.double().cpu(), self.site.latitude_deg)
        return self._tensor(np.radians(15 * (hours - 12)))

    @cached_property
    def elevation(self) -> Tensor:
        """Elevation [rad] of the sun."""
        return torch.asin(self.scene.sun[:, 2].clamp(-1, 1)).reshape(-1, 1, 1, 1)

    @cached_property
    def incidence(self) -> Tensor:
        """Angle [rad] between the sun and the mirror's normal."""
        cosine = (self.scene.attitude[:, :, 2] * self.scene.sun).sum(dim=-1)
        return torch.acos(cosine.clamp(-1, 1)).reshape(-1, 1, 1, 1)

    @cached_property
    def slant_range(self) -> Tensor:
        """Distance [m] from the mirror to the target's centre."""
        distance: Tensor = torch.linalg.norm(self.scene.plane_center - self.scene.center, dim=-1)
        return distance.reshape(-1, 1, 1, 1)


Heights = Callable[[Tensor, Tensor, Tensor, Tensor, Circumstances], Tensor]
"""Heights [m] at places (B, F, I, J) [m]: x, y from each facet's centre, X, Y from the mirror's."""

Widths = Callable[[Circumstances], Tensor | float]
"""Widths for an amplitude of one, (B, 1, 1, 1) or one for all."""

Change = Callable[[Tensor, Tensor, Tensor, Scalar], Tensor]
"""Images (B, rows, columns) of such, x (columns,) and y (rows, 1) [m] from the image's centre,
right and up, and the amplitude.
"""


def mirror_effect(
    name: str, about: str, heights: Heights, low: float, high: float, unit: str
) -> type[Effect]:
    """Make an effect on the shape of mirrors.

    Parameters
    ----------
    name : str
        Its name in reports: lower-case letters, digits and underscores.
    about : str
        A short title, a colon, and a sentence.
    heights : callable
        ``heights(x, y, X, Y, seen)``: height changes [m] for an amplitude of one.
    low, high : float [``unit``]
        Bounds of the amplitude; zero lies between.
    unit : str

    Raises
    ------
    InvalidInputError
        For a name that the catalogue has, or bounds without zero.
    """

    def on_setups(self: Effect, scene: Scene, setups: Sequence[Setup], site: Site) -> Scene:
        points = scene.control_points.expand(scene.batch, -1, -1, -1, -1)
        place = places_on(points, scene.degree)
        local = place - place.mean(dim=(-2, -1), keepdim=True)
        parts = (*local.unbind(2), *place.unbind(2))
        given = _called(name, heights, *parts, Circumstances(scene, setups, site))
        change = _amplitude(self) * _tensor(name, given, points, points[:, :, 2].shape)
        x, y, z = points.unbind(2)
        raised = z + coefficients_of(change, scene.degree)
        return scene.with_(control_points=torch.stack([x, y, raised], dim=2))

    return _add(name, about, "geometry", (low, high, unit), on_setups=on_setups)


def blur_effect(
    name: str, about: str, width: Widths, low: float, high: float, unit: str = "mrad"
) -> type[Effect]:
    """Make an effect that widens the light's cone on its way from mirror to target.

    ``width(seen)`` is the standard deviation [mrad] per axis for an amplitude of one; a width in
    metres on the target is divided by ``seen.slant_range / 1000``. Others as `mirror_effect`.
    """

    def on_setups(self: Effect, scene: Scene, setups: Sequence[Setup], site: Site) -> Scene:
        given = _called(name, width, Circumstances(scene, setups, site))
        like, shape = scene.sun, (scene.batch, 1, 1, 1)
        added = 1e-3 * _amplitude(self) * _tensor(name, given, like, shape).flatten()
        slope, pointing = (
            torch.zeros_like(added) if known is None else known
            for known in (scene.slope_error, scene.pointing_error)
        )
        return scene.with_(slope_error=slope, pointing_error=(pointing**2 + added**2).sqrt())

    return _add(name, about, "geometry", (low, high, unit), on_setups=on_setups)


def mount_effect(name: str, about: str, axis: Vector, low: float, high: float) -> type[Effect]:
    """Make an effect that turns mounts about an ``axis`` (east, north, up) by degrees."""
    length = math.hypot(*axis)
    if not (math.isfinite(length) and length > 0):
        raise InvalidInputError(f"effect {name}: 'axis' must be three numbers, not all zero")
    unit_axis = [part / length for part in axis]

    def on_mount(self: Effect, mount: Mount, heliostat: str) -> Mount:
        return mount.tilted(rotation(unit_axis, math.radians(float(_amplitude(self)))))

    return _add(name, about, "geometry", (low, high, "deg"), on_mount=on_mount)


def image_effect(
    name: str, about: str, change: Change, low: float, high: float, unit: str
) -> type[Effect]:
    """Make an effect of the camera: ``change(images, x, y, amplitude)`` are the changed images.

    It must change nothing for an amplitude of zero. Others as `mirror_effect`.
    """

    def on_image(self: Effect, images: Tensor, window: Window) -> Tensor:
        rows, columns = images.shape[-2:]
        x = _centers(columns, window.width, images)
        y = -_centers(rows, window.height, images)[:, None]
        changed = _called(name, change, images, x, y, _amplitude(self))
        return _tensor(name, changed, images, images.shape)

    methods = {"on_image": on_image, "of_heliostats": False}
    return _add(name, about, "image", (low, high, unit), **methods)


def _centers(size: int, extent: float, like: Tensor) -> Tensor:
    """Centres (size,) [m] of pixels over ``extent`` [m]."""
    return extent * ((torch.arange(size).to(like) + 0.5) / size - 0.5)


def _amplitude(effect: Effect) -> Scalar:
    return effect.amplitude  # type: ignore[attr-defined, no-any-return]


def _called(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a plant's function returns."""
    try:
        return function(*arguments)
    except Exception as error:
        raise InvalidInputError(f"effect {name}: {_in_words(error)}") from error


def _in_words(error: Exception) -> str:
    kind = (
        "" if isinstance(error, InvalidInputError) else f"its code fails: {type(error).__name__}: "
    )
    return f"{kind}{error}"


def _tensor(name: str, values: Any, like: Tensor, shape: Sequence[int]) -> Tensor:
    """What a function returned, in a shape."""
    made = torch.as_tensor(values).to(like)
    try:
        return made.expand(shape)
    except RuntimeError:
        raise InvalidInputError(
            f"effect {name}: its function must return {tuple(shape)} values, got"
            f" {tuple(made.shape)}"
        ) from None


def _add(
    name: str, about: str, stage: Stage, bounds: tuple[float, float, str], **members: Any
) -> type[Effect]:
    """Make an effect of one parameter, and add it to the catalogue."""
    low, high, unit = bounds
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", str(name)):
        raise InvalidInputError(
            f"effect {name}: its name must be 1 to 40 lower-case letters, digits and underscores"
        )
    if name in ORDER:
        raise InvalidInputError(
            f"effect {name}: the catalogue has one of this name; choose another"
        )
    if not (math.isfinite(low) and math.isfinite(high) and low <= 0 <= high and low < high):
        raise InvalidInputError(
            f"effect {name}: 'low' and 'high' must be bounds with zero between, got {low}, {high}"
        )
    owner: Owner = "camera" if stage == "image" else "set"
    about_it = {"name": name, "about": about, "stage": stage, "scales_with": frozenset()}
    kind = make_dataclass(
        name.title().replace("_", ""),
        [("amplitude", Scalar, parameter(0.0, low, high, unit, owner))],
        bases=(Effect,),
        namespace=about_it | {"of_heliostats": True, "__module__": __name__} | members,
        frozen=True,
        eq=False,
    )
    CATALOGUE[name] = kind
    return kind


def load_effects(files: Iterable[Path] = ()) -> None:
    """Add the effects of installed packages (`ENTRY_POINTS`) and of ``files`` to the catalogue.

    Raises
    ------
    InvalidInputError
        If a file or package is missing or fails, or a file adds no effect.
    """
    for point in entry_points(group=ENTRY_POINTS):
        _run(f"{point.name} of the entry points {ENTRY_POINTS}", point.load)
    for file in files:
        if not file.is_file():
            raise InvalidInputError(f"{file}: no such file of effects")
        before = dict(CATALOGUE)
        _run(str(file), partial(runpy.run_path, str(file)))
        if before == CATALOGUE:
            raise InvalidInputError(
                f"{file}: adds no effect; call mirror_effect, blur_effect, mount_effect or"
                " image_effect in it"
            )


def _run(place: str, code: Callable[[], object]) -> None:
    """Run code that adds effects; whatever it raises is one error that names the place."""
    try:
        code()
    except Exception as error:
        raise InvalidInputError(f"{place}: {_in_words(error)}") from error
