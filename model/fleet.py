"""The flux of a field of heliostats on one receiver.

Heliostats come in tiles, which an `Engine` may trace in any number of threads or machines. The
result of a tile is one map, so the memory does not grow with the field::

    task = Superposition(receiver, model, resolution=(128, 128))
    total = superpose(task, tiles(setups), engine)

Forecasts for a receiver are light in W/m2: effects of the camera (stage "image") do not act. If
neighbours are given (`model.neighbours`), their shadows are traced, and the effect `blocking`,
their mean, does not act either.

Approximations: the sun's cone is that of each mirror's centre; a cylinder is traced on planes that
touch it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple, Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.effects import Effect, acting, apply_mount_effects, apply_optics_effects, light_effects
from model.effects.blocking import Blocking
from model.errors import ModelError, UnreachableError
from model.forecast import align, true_suns
from model.neighbours import Neighbours, Outlines, outlines
from model.plant import Heliostat, Receiver, TargetPlane
from model.plant_model import PlantModel
from model.progress import nothing_between
from model.setup import Setup
from model.sunshape import half_angle
from model.tracing import Optics, Scene, Window
from model.tracing.convolution import SuperposedFlux
from model.tracing.convolution import superpose as superpose_scene

Array = NDArray[np.float64]
Item = TypeVar("Item")
Result = TypeVar("Result")


class _Items(Protocol):
    """A sequence that slices to its own type."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice) -> Self: ...


Some = TypeVar("Some", bound=_Items)

TILE = 32
"""Heliostats of a tile: some milliseconds of work each, much more than the tile's transfer."""

# Pixels of a map above which tiles have fewer heliostats, so that their work does not grow.
_TILE_PIXELS = 2**16

# Pixels of maps that are traced at once: they fit into the processor's cache.
_PIXELS = 2**18
# Light is traced beyond a map's edge up to this share of the sun's cone, plus a margin for errors
# [rad].
_CONE_SHARE, _ERRORS = 0.98, 3e-3
# Cosine to a plane's normal below which grazing light is neglected.
_GRAZING = 0.02


# --- one tile
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Tile:
    """Some heliostats of a field.

    Attributes
    ----------
    setups : sequence of Setup
        Under one sun; their aims count, not their planes.
    obstacles : (B, K, 3, 3) [m] or None
        Neighbours that may hide parts of each, as in `Neighbours.obstacles`; None for no
        neighbours.
    """

    setups: Sequence[Setup]
    obstacles: Array | None = None

    def __getitem__(self, part: slice) -> "Tile":
        return Tile(self.setups[part], None if self.obstacles is None else self.obstacles[part])

    def __len__(self) -> int:
        return len(self.setups)


@dataclass(frozen=True, eq=False)
class FleetFlux:
    """Superposed flux.

    Attributes
    ----------
    irradiance : (rows, columns) [W/m2]
        Row 0 at the top; on an unrolled cylinder equally spaced in height and angle.
    power : float [W]
        Power that the mirrors reflect towards the receiver.
    heliostats : int
        Number of heliostats included.
    skipped : dict
        Reasons why others are not, by name.
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


def tile_size(resolution: tuple[int, int]) -> int:
    """Number of heliostats of a tile for a map of (rows, columns)."""
    return max(1, TILE * _TILE_PIXELS // max(_TILE_PIXELS, resolution[0] * resolution[1]))


@dataclass(frozen=True, eq=False)
class Superposition:
    """The task of each tile; calling it with a tile traces the tile.

    Attributes
    ----------
    receiver : Receiver
    model : PlantModel
    resolution : (rows, columns)
    samples : int
        Rays along each side of each facet.
    between : callable
        Called repeatedly while a tile is traced; an exception ends the work.
    """

    receiver: Receiver
    model: PlantModel
    resolution: tuple[int, int] = (256, 256)
    samples: int = 16
    between: Callable[[], None] = nothing_between

    def __call__(self, tile: Tile) -> FleetFlux:
        """Trace the flux of a tile, and skip heliostats that cannot reach the receiver."""
        total = FleetFlux(np.zeros(self.resolution))
        for part, made in in_parts(self._trace, tile):
            if isinstance(made, ModelError):
                made = FleetFlux(
                    np.zeros(self.resolution), skipped={part.setups[0].heliostat.name: str(made)}
                )
            total = total + made
        return total

    def _trace(self, tile: Tile) -> FleetFlux:
        flux, power = torch.zeros(self.resolution, dtype=torch.float64), 0.0
        with torch.no_grad():
            for there, part in self._alike(tile):
                optics = apply_optics_effects(there, self.model.optics)
                for group in align(part.setups, replace(self.model, effects=there)).groups:
                    scene = group.scene
                    if part.obstacles is not None:
                        scene = scene.with_(
                            obstacles=torch.as_tensor(part.obstacles[group.rows]).to(scene.sun)
                        )
                    for image, thrown in self._images(scene, group.aims, optics):
                        flux += image
                        power += thrown
        return FleetFlux(flux.numpy(), power, len(tile))

    def _alike(self, tile: Tile) -> Iterator[tuple[tuple[Effect, ...], Tile]]:
        """Group the heliostats of a tile by the effects on light that act on them at present."""
        light: Sequence[Effect] = light_effects(self.model.effects)
        if tile.obstacles is not None:
            light = [effect for effect in light if not isinstance(effect, Blocking)]
        rows: dict[tuple[Effect, ...], list[int]] = {}
        for row, setup in enumerate(tile.setups):
            rows.setdefault(acting(light, None, setup.heliostat.name), []).append(row)
        for there, alike in rows.items():
            obstacles = None if tile.obstacles is None else tile.obstacles[alike]
            yield there, Tile([tile.setups[row] for row in alike], obstacles)

    def _images(self, scene: Scene, aims: Array, optics: Optics) -> Iterator[tuple[Tensor, float]]:
        """Maps (rows, columns) [W/m2] and power [W], of a few mirrors at once."""
        sides = self.receiver.width, self.receiver.height
        # A narrow plane is padded by its longer side.
        step = max(
            1, _PIXELS // (self.resolution[0] * self.resolution[1] * int(max(sides) / min(sides)))
        )
        for start in range(0, scene.batch, step):
            self.between()
            rows = list(range(start, min(start + step, scene.batch)))
            part = scene.subset(rows), aims[rows], optics
            if isinstance(self.receiver, TargetPlane):
                image, power = self._on_plane(self.receiver, self.resolution[1], *part)
            else:
                image, power = self._on_patches(*part)
            yield image, float(power.sum())

    def _on_plane(
        self, plane: TargetPlane, columns: int, scene: Scene, aims: Array, optics: Optics
    ) -> SuperposedFlux:
        """Trace the flux on a plane that replaces the scene's planes."""
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

    def _on_patches(self, scene: Scene, aims: Array, optics: Optics) -> SuperposedFlux:
        """Trace the flux on the unrolled surface, plane by plane."""
        image, power = torch.zeros(self.resolution), torch.zeros(scene.batch)
        directions, is_reached = _beams(scene, aims).directions, np.zeros(scene.batch, dtype=bool)
        for patch in self.receiver.patches(self.resolution[1]):
            self.between()
            plane, shares = patch.plane, torch.as_tensor(patch.shares, dtype=torch.float32)
            before = (scene.center.double().numpy() - plane.center) @ plane.normal > 0
            reaching = np.flatnonzero(before & (directions @ plane.normal < -_GRAZING)).tolist()
            if reaching:
                lit = scene.subset(reaching), aims[reaching], optics
                part, thrown = self._on_plane(plane, len(shares), *lit)
                image[:, patch.columns] += part * shares
                power[reaching] = torch.maximum(power[reaching], thrown)
                is_reached[reaching] = True
        if not is_reached.all():
            raise UnreachableError(
                "a mirror is behind the lit part of the receiver; leave it out or aim it elsewhere"
            )
        return SuperposedFlux(image, power)


class _Beams(NamedTuple):
    """Unit vectors (B, 3) from mirrors to their aims, and the distances (B,) [m]."""

    directions: Array
    ranges: Array


def _beams(scene: Scene, aims: Array) -> _Beams:
    outgoing = aims - scene.center.double().numpy()
    ranges = np.linalg.norm(outgoing, axis=1)
    return _Beams(outgoing / ranges[:, None], ranges)


def in_parts(
    work: Callable[[Some], Result], items: Some
) -> Iterator[tuple[Some, Result | ModelError]]:
    """Call ``work`` with items; if it fails, with halves of them, down to single items."""
    try:
        made: Result | ModelError = work(items)
    except ModelError as error:
        made = error
    if not isinstance(made, ModelError) or len(items) == 1:
        yield items, made
    else:
        half = len(items) // 2
        yield from in_parts(work, items[:half])
        yield from in_parts(work, items[half:])


# --- the whole field
# --------------------------------------------------------------------------------------------------


class Engine(Protocol):
    """Calls a function for items, in threads, processes or machines."""

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results for the items, in their order; only a few items are requested ahead."""


def tiles(
    setups: Iterable[Setup], neighbours: Neighbours | None = None, size: int = TILE
) -> Iterator[Tile]:
    """Divide setups into tiles of ``size`` heliostats, with the neighbours in their way."""
    remaining = iter(setups)
    while some := list(islice(remaining, size)):
        yield tile_of(some, neighbours)


def tile_of(setups: Sequence[Setup], neighbours: Neighbours | None = None) -> Tile:
    """One tile; heliostats that are not among the neighbours cannot be aimed, and are skipped."""
    if neighbours is None:
        return Tile(setups)
    return Tile(setups, neighbours.obstacles([setup.heliostat.name for setup in setups]))


def aligned_field(
    field: Iterable[tuple[Heliostat, ArrayLike]], sun: ArrayLike, model: PlantModel
) -> Neighbours:
    """Align mirrors to aims (3,) [m] under a recorded ``sun`` (3,), without those that cannot."""
    (true_sun,) = true_suns(model, np.asarray(sun, dtype=np.float64)[None])

    def align_part(part: Sequence[tuple[Heliostat, ArrayLike]]) -> Outlines:
        aims = np.array([aim for _, aim in part], dtype=np.float64)
        names, changed = [heliostat.name for heliostat, _ in part], []
        for heliostat, _ in part:
            effects = acting(model.effects, None, heliostat.name)
            changed += apply_mount_effects([heliostat], effects)
        return Outlines(names, outlines(changed, true_sun, aims), aims)

    remaining, found = iter(field), []
    while some := list(islice(remaining, TILE)):
        found += [
            made for _, made in in_parts(align_part, some) if not isinstance(made, ModelError)
        ]
    return Neighbours.from_outlines(found, true_sun)


def superpose(
    task: Superposition,
    parts: Iterable[Tile],
    engine: Engine | None = None,
    before: FleetFlux | None = None,
    done: Callable[[FleetFlux], None] = lambda _: None,
) -> FleetFlux:
    """Superpose the flux of all tiles on the task's receiver, one after another without an engine.

    Parameters
    ----------
    task : Superposition
    parts : iterable of Tile
    engine : Engine, optional
    before : FleetFlux, optional
        Of tiles that are not among the ``parts``.
    done : callable
        Receives the sum after each tile; an exception ends the work.

    The result is the same to the last bit for all engines, also if the work was resumed.
    """
    total = before or FleetFlux(np.zeros(task.resolution))
    for part in map(task, parts) if engine is None else engine.map(task, parts):
        total = total + part
        done(total)
    # Frequency space leaves ripples below zero: 1e-5 of the peak, more where pixels are coarser
    # than the spots.
    return replace(total, irradiance=total.irradiance.clip(min=0))
