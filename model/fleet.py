"""The light of a whole field on one receiver.

Heliostats come in tiles, which an `Engine` may work at in any number of threads or machines; what a tile gives is one
map, so that memory does not grow with the field::

    task = Superposition(receiver, resolution=(128, 128), optics=optics, effects=effects, latitude_deg=37.4)
    total = superpose(task, tiles(setups), engine)

Forecasts for a receiver are light in W/m2: effects of the camera, of stage "image", say how a photograph differs from
the light and do not act here. Where neighbours are given (`model.neighbours`), their shadows are traced, and the
effect `blocking`, which stands for their mean, does not act either.

Approximation: the cone of the sun is taken at each mirror's centre. A cylinder is traced on planes
that touch it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.effects import Effect, acting, light_effects
from model.effects.blocking import Blocking
from model.errors import ModelError, UnreachableError
from model.forecast import Setup, align, altered, optics_under, suns_under
from model.neighbours import Neighbours, outlines
from model.plant import Heliostat, Receiver, TargetPlane
from model.sunshape import half_angle
from model.tracing import Optics, Scene, Window
from model.tracing.convolution import superpose as superpose_scene

Array = NDArray[np.float64]
Item = TypeVar("Item")
Made = TypeVar("Made")


class _Items(Protocol):
    """What can be halved."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice) -> Self: ...


Some = TypeVar("Some", bound=_Items)

TILE = 32
"""Heliostats of a tile: some milliseconds' work each, which is much against what handing a tile over costs."""

# Pixels of maps that are traced at a time: so few that the processor's cache holds them.
_PIXELS = 2**18
# Light is followed beyond a map's edge as far as this share of the sun's cone reaches, with room for errors [rad].
_CONE_SHARE, _ERRORS = 0.98, 3e-3
# Cosine to a plane's normal below which light that grazes it is left out.
_GRAZING = 0.02


# --- one tile ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Tile:
    """Some heliostats of a field.

    Attributes
    ----------
    setups : sequence of Setup
        Before one sun; their planes are of no account, their aims are.
    obstacles : (B, K, 3, 3) [m] or None
        The neighbours in the way of each, as `Neighbours.obstacles` gives them; None: nothing is.
    """

    setups: Sequence[Setup]
    obstacles: Array | None = None

    def __getitem__(self, part: slice) -> "Tile":
        return Tile(self.setups[part], None if self.obstacles is None else self.obstacles[part])

    def __len__(self) -> int:
        return len(self.setups)


@dataclass(frozen=True, eq=False)
class FleetFlux:
    """Superposed light.

    Attributes
    ----------
    irradiance : (rows, columns) [W/m2]
        Row 0 at the top; on a cylinder unrolled, even in height and angle.
    power : float [W]
        What the mirrors throw towards the receiver, whether it lands there or not.
    heliostats : int
        How many are in it.
    skipped : dict
        The reason why a heliostat is not, by its name.
    """

    irradiance: Array
    power: float = 0.0
    heliostats: int = 0
    skipped: dict[str, str] = field(default_factory=dict)

    def __add__(self, other: "FleetFlux") -> "FleetFlux":
        return FleetFlux(
            self.irradiance + other.irradiance,
            self.power + other.power,
            self.heliostats + other.heliostats,
            self.skipped | other.skipped,
        )


@dataclass(frozen=True, eq=False)
class Superposition:
    """What is to be made of every tile: call it with one.

    Attributes
    ----------
    receiver : Receiver
    resolution : (rows, columns)
    optics : Optics
    effects : tuple of Effect
    latitude_deg : float [deg]
        Of the plant.
    samples : int
        Points along each side of each facet.
    """

    receiver: Receiver
    resolution: tuple[int, int] = (256, 256)
    optics: Optics = field(default_factory=Optics)
    effects: tuple[Effect, ...] = ()
    latitude_deg: float = field(kw_only=True)
    samples: int = 16

    def __call__(self, tile: Tile) -> FleetFlux:
        """The light of a tile; heliostats that cannot send any there are skipped by name."""
        total = FleetFlux(np.zeros(self.resolution))
        for part, made in in_parts(self._trace, tile):
            if isinstance(made, ModelError):
                made = FleetFlux(np.zeros(self.resolution), skipped={part.setups[0].heliostat.name: str(made)})
            total = total + made
        return total

    def _trace(self, tile: Tile) -> FleetFlux:
        flux, power = torch.zeros(self.resolution, dtype=torch.float64), 0.0
        with torch.no_grad():
            for there, part in self._alike(tile):
                optics = optics_under(there, self.optics)
                for group in align(part.setups, there, latitude_deg=self.latitude_deg).groups:
                    scene = group.scene
                    if part.obstacles is not None:
                        scene = scene.with_(obstacles=torch.as_tensor(part.obstacles[group.rows]).to(scene.sun))
                    for image, thrown in self._images(scene, group.aims, optics):
                        flux += image
                        power += thrown
        return FleetFlux(flux.numpy(), power, len(tile))

    def _alike(self, tile: Tile) -> Iterator[tuple[tuple[Effect, ...], Tile]]:
        """The heliostats of a tile by the effects on light that act at them today."""
        light: Sequence[Effect] = light_effects(self.effects)
        if tile.obstacles is not None:
            light = [effect for effect in light if not isinstance(effect, Blocking)]
        rows: dict[tuple[Effect, ...], list[int]] = {}
        for row, setup in enumerate(tile.setups):
            rows.setdefault(acting(light, None, setup.heliostat.name), []).append(row)
        for there, alike in rows.items():
            obstacles = None if tile.obstacles is None else tile.obstacles[alike]
            yield there, Tile([tile.setups[row] for row in alike], obstacles)

    def _images(self, scene: Scene, aims: Array, optics: Optics) -> Iterator[tuple[Tensor, float]]:
        """Maps (rows, columns) [W/m2] and power [W], of a few mirrors at a time."""
        step = max(1, _PIXELS // (self.resolution[0] * self.resolution[1]))
        for start in range(0, scene.batch, step):
            rows = list(range(start, min(start + step, scene.batch)))
            part = scene.subset(rows), aims[rows], optics
            if isinstance(self.receiver, TargetPlane):
                image, power = self._on_plane(self.receiver, self.resolution[1], *part)
            else:
                image, power = self._on_patches(*part)
            yield image, float(power.sum())

    def _on_plane(
        self, plane: TargetPlane, columns: int, scene: Scene, aims: Array, optics: Optics
    ) -> tuple[Tensor, Tensor]:
        """Map (rows, columns) [W/m2] and power (B,) [W] on a plane that takes the place of the scene's own."""
        scene = scene.with_(
            plane_center=torch.tensor(plane.center).to(scene.sun).expand(scene.batch, 3),
            plane_axes=torch.tensor(plane.axes).to(scene.sun).expand(scene.batch, 3, 3),
        )
        directions, ranges = _beams(scene, aims)
        cone = half_angle(optics.sun_shape, _CONE_SHARE) + _ERRORS
        beyond = float((ranges * cone / -(directions @ plane.normal).clip(max=-0.25)).max())
        beyond = min(beyond, max(plane.width, plane.height))
        padding = max(0.1, beyond / plane.height), max(0.1, beyond / plane.width)
        window = Window.of(plane, self.resolution[0], columns)
        return superpose_scene(scene, window, optics, samples=self.samples, padding=padding)

    def _on_patches(self, scene: Scene, aims: Array, optics: Optics) -> tuple[Tensor, Tensor]:
        """Unrolled map (rows, columns) [W/m2] and power (B,) [W], plane by plane."""
        image, power = torch.zeros(self.resolution), torch.zeros(scene.batch)
        directions, seen = _beams(scene, aims)[0], np.zeros(scene.batch, dtype=bool)
        for patch in self.receiver.patches(self.resolution[1]):
            plane, shares = patch.plane, torch.as_tensor(patch.shares, dtype=torch.float32)
            before = (scene.center.double().numpy() - plane.center) @ plane.normal > 0
            lighting = np.flatnonzero(before & (directions @ plane.normal < -_GRAZING)).tolist()
            if lighting:
                lit = scene.subset(lighting), aims[lighting], optics
                part, thrown = self._on_plane(plane, len(shares), *lit)
                image[:, patch.columns] += part * shares
                power[lighting] = torch.maximum(power[lighting], thrown)
                seen[lighting] = True
        if not seen.all():
            raise UnreachableError(
                "a mirror stands behind the lit part of the receiver; leave it out or aim it elsewhere"
            )
        return image, power


def _beams(scene: Scene, aims: Array) -> tuple[Array, Array]:
    """Unit vectors (B, 3) from the mirrors to their aims (B, 3) [m], and the distances (B,) [m]."""
    outgoing = aims - scene.center.double().numpy()
    ranges = np.linalg.norm(outgoing, axis=1)
    return outgoing / ranges[:, None], ranges


def in_parts(work: Callable[[Some], Made], items: Some) -> Iterator[tuple[Some, Made | ModelError]]:
    """What ``work`` makes of items; halved where it fails, until those that it fails for stand alone with the error."""
    try:
        made: Made | ModelError = work(items)
    except ModelError as error:
        made = error
    if not isinstance(made, ModelError) or len(items) == 1:
        yield items, made
    else:
        half = len(items) // 2
        yield from in_parts(work, items[:half])
        yield from in_parts(work, items[half:])


# --- the whole field --------------------------------------------------------------------------------------------------


class Engine(Protocol):
    """Works at items, in threads, processes or machines."""

    def map(self, work: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        """What ``work`` makes of the items, in their order; no more than a few of them are drawn ahead."""


def tiles(setups: Iterable[Setup], neighbours: Neighbours | None = None, size: int = TILE) -> Iterator[Tile]:
    """Tiles of ``size`` heliostats, with what of the neighbours stands in their way."""
    remaining = iter(setups)
    while some := list(islice(remaining, size)):
        yield tile_of(some, neighbours)


def tile_of(setups: Sequence[Setup], neighbours: Neighbours | None = None) -> Tile:
    """One tile; what is none of the neighbours, because it cannot be aimed, is skipped when it is traced."""
    if neighbours is None:
        return Tile(setups)
    return Tile(setups, neighbours.obstacles([setup.heliostat.name for setup in setups]))


def aligned_field(
    field: Iterable[tuple[Heliostat, ArrayLike]],
    sun: ArrayLike,
    effects: Iterable[Effect] = (),
    *,
    latitude_deg: float,
) -> Neighbours:
    """The aligned mirrors of heliostats with their aim points (3,) [m] under the recorded ``sun`` (3,).

    Those whose mounts cannot turn there are left out.
    """
    known = tuple(effects)
    true_sun = suns_under(acting(known, None, None), np.asarray(sun, dtype=np.float64)[None], latitude_deg)

    def outlined(part: Sequence[tuple[Heliostat, ArrayLike]]) -> tuple[list[str], Array, Array]:
        heliostats, aims = [one for one, _ in part], np.array([aim for _, aim in part], dtype=np.float64)
        standing = [there for one in heliostats for there in altered([one], acting(known, None, one.name))]
        return [one.name for one in heliostats], outlines(standing, true_sun[0], aims), aims

    remaining, found = iter(field), []
    while some := list(islice(remaining, TILE)):
        found += [made for _, made in in_parts(outlined, some) if not isinstance(made, ModelError)]
    return Neighbours.from_outlines(found, true_sun[0])


def superpose(task: Superposition, parts: Iterable[Tile], engine: Engine | None = None) -> FleetFlux:
    """The light of all tiles on the task's receiver, one after another without an engine.

    The same to the last bit whatever the engine.
    """
    total = FleetFlux(np.zeros(task.resolution))
    for part in map(task, parts) if engine is None else engine.map(task, parts):
        total = total + part
    # Frequency space leaves ripples below zero: 1e-5 of the peak, more where pixels are coarser than the spots.
    return replace(total, irradiance=total.irradiance.clip(min=0))
