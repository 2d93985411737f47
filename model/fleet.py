"""The flux of a field of heliostats on one receiver.

Heliostats come in tiles, which an `Engine` may trace in any number of threads or machines. The
result of a tile is one map, so the memory does not grow with the field::

    task = Superposition(receiver, model, resolution=(128, 128))
    total = superpose(task, tiles(setups), engine)

Forecasts for a receiver are light in W/m2: effects of the camera (stage "image") do not act. If
neighbours are given (`model.neighbours`), their shadows are traced, and the effect `blocking`,
their mean, does not act either.

Each heliostat's losses are listed in the order of the light (`Losses`).

Approximations: the sun's cone is that of each mirror's centre; light reaches a curved receiver as
from the mirror's centre (`model.tracing.superposition`).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice, pairwise
from typing import Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from model.effects import Effect, acting, apply_mount_effects, apply_optics_effects, light_effects
from model.effects.blocking import Blocking
from model.errors import ModelError
from model.forecast import align, true_suns
from model.neighbours import Neighbours, Outlines, outlines
from model.plant import Heliostat, Receiver, TargetPlane
from model.plant_model import PlantModel
from model.progress import nothing_between
from model.setup import Setup
from model.tracing import Optics, Scene, Window
from model.tracing.superposition import Beams, SuperposedFlux, project
from model.tracing.superposition import superpose as superpose_scene

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


@dataclass(frozen=True)
class Losses:
    """What the light of a heliostat loses, as factors in the order of the light.

    Their product is the optical efficiency. Without light a factor is 1 and those before say why.

    Attributes
    ----------
    area : float [m2]
        Of its facets.
    cosine, shading, blocking, reflectance, cleanliness, attenuation, intercept, absorptance : float
    """

    area: float
    cosine: float
    shading: float
    blocking: float
    reflectance: float
    cleanliness: float
    attenuation: float
    intercept: float
    absorptance: float

    @property
    def efficiency(self) -> float:
        """Absorbed share of the light on the mirror's area, if it faced the sun."""
        return self.intercepted * self.absorptance

    @property
    def intercepted(self) -> float:
        """Share of that light that reaches the receiver."""
        mirror = self.cosine * self.shading * self.blocking * self.reflectance
        return mirror * self.cleanliness * self.attenuation * self.intercept


LOSSES = tuple(f.name for f in fields(Losses) if f.name != "area")
"""The factors, in the order of the light."""


def losses_of(
    heliostats: Sequence[Heliostat],
    beams: Beams,
    intercepted: torch.Tensor,
    optics: Optics,
    absorptance: float,
) -> dict[str, Losses]:
    """Losses by name of heliostats whose power on the receiver is ``intercepted`` (B,) [W]."""
    areas = np.array([heliostat.area for heliostat in heliostats])
    reflectance = optics.reflectivity * np.array([h.optics.reflectance for h in heliostats])
    clean = reflectance * np.array([h.optics.cleanliness for h in heliostats])
    lit, free, power, reached = (
        values.double().numpy() for values in (beams.lit, beams.free, beams.power, intercepted)
    )
    stages = [areas, *lit.T, free, free * reflectance, free * clean]
    stages.append(power / max(optics.dni, 1e-300))
    stages.append(reached.clip(min=0, max=power) / max(optics.dni, 1e-300))
    shares = [
        np.where(before > 0, after / np.where(before > 0, before, 1.0), 1.0)
        for before, after in pairwise(stages)
    ]
    shares.append(np.full(len(areas), absorptance))
    factors = [dict(zip(LOSSES, row, strict=True)) for row in np.stack(shares, axis=1).tolist()]
    return {
        heliostat.name: Losses(area=heliostat.area, **some)
        for heliostat, some in zip(heliostats, factors, strict=True)
    }


def field_losses(losses: Iterable[Losses]) -> Losses:
    """Factors of a whole field: those of the sums of the light before and after each of them."""
    some = list(losses)
    stages = np.array([[one.area, *(getattr(one, name) for name in LOSSES)] for one in some])
    sums = np.cumprod(stages, axis=1).sum(axis=0)
    return Losses(sums[0], *(sums[1:] / np.maximum(sums[:-1], 1e-300)).tolist())


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
    losses : dict
        Of the heliostats included, by name.
    """

    irradiance: Array
    power: float = 0.0
    heliostats: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    losses: dict[str, Losses] = field(default_factory=dict)

    def __add__(self, other: "FleetFlux") -> "FleetFlux":
        return FleetFlux(
            self.irradiance + other.irradiance,
            self.power + other.power,
            self.heliostats + other.heliostats,
            self.skipped | other.skipped,
            self.losses | other.losses,
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
    tower : TargetPlane or None
        Outline of the tower as the sun sees it, which shades mirrors.
    between : callable
        Called repeatedly while a tile is traced; an exception ends the work.
    """

    receiver: Receiver
    model: PlantModel
    resolution: tuple[int, int] = (256, 256)
    samples: int = 16
    tower: TargetPlane | None = None
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
        total = FleetFlux(np.zeros(self.resolution))
        with torch.no_grad():
            for setups, scene, optics in self.scenes(tile):
                heliostats = [setup.heliostat for setup in setups]
                for rows, light in self._lights(scene, optics):
                    total = total + self._flux([heliostats[row] for row in rows], light, optics)
        return total

    def scenes(self, tile: Tile) -> Iterator[tuple[list[Setup], Scene, Optics]]:
        """Aligned mirrors of a tile with what hides them, and the optics that act on them."""
        for there, part in self._alike(tile):
            optics = apply_optics_effects(there, self.model.optics)
            for group in align(part.setups, replace(self.model, effects=there)).groups:
                yield group.setups, self._obstructed(group.scene, part, group.rows), optics

    def _obstructed(self, scene: Scene, part: Tile, rows: list[int]) -> Scene:
        """The scene of a part's mirrors in some rows, with neighbours and tower."""
        if part.obstacles is not None:
            scene = scene.with_(obstacles=torch.as_tensor(part.obstacles[rows]).to(scene.sun))
        if self.tower is not None:
            sides = self.tower.axes[:2] * np.array([[self.tower.width], [self.tower.height]]) / 2
            outline = torch.as_tensor(np.stack([self.tower.center, *sides])).to(scene.sun)
            scene = scene.with_(shades=outline.expand(scene.batch, 1, 3, 3))
        return scene

    def _flux(
        self, heliostats: Sequence[Heliostat], light: SuperposedFlux, optics: Optics
    ) -> FleetFlux:
        """The light of mirrors with their losses."""
        absorptance = self.receiver.absorptance
        losses = losses_of(heliostats, light.beams, light.intercepted, optics, absorptance)
        image = light.irradiance.double().numpy()
        power = float(light.beams.power.double().sum())
        return FleetFlux(image, power, len(heliostats), losses=losses)

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

    def _lights(self, scene: Scene, optics: Optics) -> Iterator[tuple[list[int], SuperposedFlux]]:
        """Rows of a few mirrors at once, and their light."""
        sides = self.receiver.width, self.receiver.height
        # A narrow plane is padded by its longer side.
        step = max(
            1, _PIXELS // (self.resolution[0] * self.resolution[1] * int(max(sides) / min(sides)))
        )
        for start in range(0, scene.batch, step):
            self.between()
            rows = list(range(start, min(start + step, scene.batch)))
            part = scene.subset(rows)
            if isinstance(self.receiver, TargetPlane):
                yield rows, self._on_plane(self.receiver, part, optics)
            else:
                light = project(part, self.receiver, self.resolution, optics, samples=self.samples)
                yield rows, light

    def _on_plane(self, plane: TargetPlane, scene: Scene, optics: Optics) -> SuperposedFlux:
        """Trace the flux on a plane that replaces the scene's planes."""
        scene = scene.with_(
            plane_center=torch.tensor(plane.center).to(scene.sun).expand(scene.batch, 3),
            plane_axes=torch.tensor(plane.axes).to(scene.sun).expand(scene.batch, 3, 3),
        )
        window = Window.of(plane, *self.resolution)
        return superpose_scene(scene, window, optics, samples=self.samples)


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
