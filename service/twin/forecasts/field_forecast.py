"""Flux forecasts of many heliostats, tile by tile, for one sun and one receiver."""

import math
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.aiming.kernels import ImageTile, ImageTracer, Kernels, MirrorImages
from model.errors import ModelError
from model.fleet import (
    TILE,
    Engine,
    FleetFlux,
    Superposition,
    Tile,
    aligned_field,
    tile_of,
    tile_size,
)
from model.frames import sun_direction
from model.neighbours import Neighbours
from model.plant import Heliostat, Receiver, Tower
from model.setup import Setup
from model.surface import DEGREE, control_points
from service import store
from service.base.arrays import unpack
from service.base.errors import ConflictError
from service.base.fields import Sun
from service.base.processes import return_memory
from service.base.progress import Report
from service.store import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin.engines import Threads, engine_of
from service.twin.forecasts.mirror_states import MirrorState, MirrorStates, count_sources, in_state
from service.twin.forecasts.watts import Sunlight, dni_of
from service.twin.model_versions import ModelVersion
from service.twin.runtime import Runtime
from service.twin.stored_mount import as_calibrated

Array = NDArray[np.float64]

# Share of the work that reads all heliostats for blocking and shading.
_NEIGHBOURS_SHARE = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class Fleet:
    """Heliostats that light one receiver, of the store or of a plant's file, for any sun.

    Attributes
    ----------
    names : sequence of str
    receiver : Receiver
    model : ModelVersion
    sunlight : float [W/m2] or "clear_sky"
    aim : (3,) [m] or None
        Aim point of all heliostats that are not in ``aims``; None for the receiver's default.
    aims : mapping of heliostat names to (3,) [m]
    tower : Tower or None
        It shades mirrors.
    states : MirrorStates or None
        Measured states in which mirrors are traced; None for mirrors as declared.
    around : mapping of heliostat names to receivers or (3,) [m]
        Heliostats that send no light, and where they aim: they block and shade.
    """

    names: Sequence[str]
    receiver: Receiver
    model: ModelVersion
    sunlight: Sunlight
    aim: Sequence[float] | None
    aims: Mapping[str, Sequence[float] | Array]
    tower: Tower | None
    states: MirrorStates | None
    around: Mapping[str, Receiver | Array]

    def under(self, sun: Sun, ideal: bool) -> "HeliostatGroup":
        """The heliostats under this sun, with their current surfaces or ``ideal`` ones."""
        dni = dni_of(self.sunlight, sun.elevation_deg, self.model.site.altitude_m)
        known = vars(self) | {
            "model": self.model.with_dni(dni),
            "states": None if ideal else self.states,
        }
        direction = sun_direction(sun.azimuth_deg, sun.elevation_deg)
        return HeliostatGroup(**known, sun=direction, ideal=ideal)


@dataclass(frozen=True, eq=False, kw_only=True)
class HeliostatGroup(Fleet):
    """A fleet under one sun.

    Attributes
    ----------
    sun : (3,)
        Unit vector towards the recorded sun.
    ideal : bool
        Trace ideal surfaces instead of the active ones.
    skipped : dict
        Heliostats that could not be read, with the reason. The forecast fills it.
    without_surface : set of str
        Heliostats without a surface, which are traced as ideal mirrors. The forecast fills it.
    traced_states : dict
        States in which mirrors are traced, by heliostat. The forecast fills it.
    """

    sun: Array
    ideal: bool
    skipped: dict[str, str] = field(default_factory=dict)
    without_surface: set[str] = field(default_factory=set)
    traced_states: dict[str, MirrorState] = field(default_factory=dict)

    def aim_of(self, heliostat: Heliostat) -> Array:
        """Aim point of a heliostat (3,) [m]."""
        name = heliostat.name
        aim = self.around[name] if name in self.around else self.aims.get(name, self.aim)
        if aim is None:
            aim = self.receiver
        if isinstance(aim, Sequence | np.ndarray):
            return np.asarray(aim, dtype=np.float64)
        return aim.aim_of(heliostat.position)

    def in_state(self, heliostat: Heliostat) -> Heliostat:
        """A heliostat in its state, which ``traced_states`` receives."""
        if self.states is None or heliostat.name in self.around:
            return heliostat
        state = self.traced_states[heliostat.name] = self.states.of(heliostat)
        return in_state(heliostat, state)

    def setup(self, heliostat: Heliostat, points: Array, degree: int = DEGREE) -> Setup:
        """A heliostat, with its mirror's control points (F, I, J, 3) [m], under the sun."""
        aim, name = self.aim_of(heliostat), heliostat.name
        plane = self.receiver.middle
        return Setup(heliostat, points, self.sun, plane, aim=aim, degree=degree, identifier=name)

    def task(
        self, resolution: tuple[int, int], has_neighbours: bool = True, **options: Any
    ) -> Superposition:
        """What is traced of each tile; ``options`` are those of `Superposition`."""
        tower = self.tower.outline(self.sun) if self.tower and has_neighbours else None
        return Superposition(self.receiver, self.model, resolution, tower=tower, **options)

    def sources(self, skipped: Container[str] = ()) -> dict[str, dict[str, int]]:
        """How many values of traced mirrors are measured, declared and defaults."""
        kept = (state for name, state in self.traced_states.items() if name not in skipped)
        return count_sources(kept)


def group_warnings(ideal: int, heliostats: int) -> list[str]:
    """Warn if ``ideal`` of ``heliostats`` are forecast without a surface."""
    if not ideal:
        return []
    return [
        f"{ideal} of {heliostats} heliostats have no surface and are forecast as ideal mirrors; "
        "POST /v1/jobs/predictions predicts surfaces"
    ]


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Flux of the first ``tiles`` tiles of a heliostat group."""

    tiles: int
    light: FleetFlux


def _unsaved(_checkpoint: Checkpoint) -> None:
    """Do not save a checkpoint."""


def forecast_group(
    runtime: Runtime,
    fleet: HeliostatGroup,
    resolution: tuple[int, int],
    neighbours: bool,
    report: Report,
    begun: Checkpoint | None = None,
    save: Callable[[Checkpoint], None] = _unsaved,
) -> FleetFlux:
    """Forecast the flux of a heliostat group.

    With ``neighbours``, heliostats block and shade each other, also those without a surface, and
    the tower shades them.
    ``report`` receives the progress from 0 to 1. An exception that it raises stops the work.
    ``save`` receives a checkpoint after each tile. ``begun`` is a checkpoint to continue from.
    """
    size = tile_size(resolution)
    share = _NEIGHBOURS_SHARE if neighbours else 0.0
    field = _seen_neighbours(runtime, fleet, report, share) if neighbours else None
    number = 0 if begun is None else begun.tiles
    traced = _Counted(report, "tiles of the field", math.ceil(len(fleet.names) / size), share, 1.0)

    def done(light: FleetFlux) -> None:
        nonlocal number
        number += 1
        save(Checkpoint(number, light))
        traced(number)

    engine: Engine = engine_of(runtime)
    between = _between(engine, lambda: traced(number))
    total = runtime.operations.superpose(
        fleet.task(resolution, neighbours, **between),
        _tiles(runtime, fleet, field, size, number),
        engine,
        before=None if begun is None else begun.light,
        done=done,
    )
    return replace(total, skipped=fleet.skipped | total.skipped)


def _between(engine: Engine, check: Callable[[], None]) -> dict[str, Callable[[], None]]:
    """The option of `Superposition` that calls ``check`` between the parts of a tile."""
    # Work on other machines cannot check whether it shall stop.
    return {"between": check} if isinstance(engine, Threads) else {}


def trace_kernels(
    runtime: Runtime,
    fleet: HeliostatGroup,
    resolution: tuple[int, int],
    neighbours: bool,
    report: Report,
) -> Kernels:
    """Trace an image of each heliostat of a group about its aim; see `model.aiming.kernels`.

    Parameters are those of `forecast_group`. ``fleet.skipped`` receives heliostats without one.

    Raises
    ------
    ConflictError
        If no heliostat reaches the receiver.
    """
    field = _seen_neighbours(runtime, fleet, report, _NEIGHBOURS_SHARE) if neighbours else None
    count = math.ceil(len(fleet.names) / TILE)
    traced = _Counted(report, "images of mirrors", count, _NEIGHBOURS_SHARE, 0.5)
    engine, n_done = engine_of(runtime), 0
    task = fleet.task(resolution, neighbours, **_between(engine, lambda: traced(n_done)))

    def tile_done(_images: int) -> None:
        nonlocal n_done
        n_done += 1
        traced(n_done)

    tiles = _tiles(runtime, fleet, field, TILE, 0)
    images = engine.map(ImageTracer(task, len(fleet.names)), tiles)
    kernels = join_images(task, images, fleet, tile_done)
    if kernels is None:
        name, reason = next(iter(fleet.skipped.items()), ("the store", "it holds no heliostat"))
        raise ConflictError(f"no heliostat reaches {fleet.receiver.name}; {name}: {reason}")
    return kernels


def join_images(
    task: Superposition,
    tiles: Iterable[ImageTile],
    fleet: HeliostatGroup,
    done: Callable[[int], None],
) -> Kernels | None:
    """Join the images of a group's ``tiles`` on the map; None if no heliostat has one.

    ``done`` receives the number of images of each tile. ``fleet.skipped`` receives heliostats
    without one.
    """

    def traced() -> Iterator[MirrorImages]:
        for tile in tiles:
            fleet.skipped.update(tile.skipped)
            done(len(tile.images))
            yield from tile.images

    images = MirrorImages.join(traced(), len(fleet.names))
    return_memory()
    return None if images is None else images.on_map(task.receiver, task.resolution)


@dataclass(frozen=True, eq=False)
class TracedImages:
    """Images of a group's mirrors, and the flux of the same group without a plan.

    ``skipped``, ``without_surface`` and ``sources`` are those of `HeliostatGroup`.
    """

    kernels: Kernels
    single_aim: FleetFlux
    skipped: Mapping[str, str]
    without_surface: frozenset[str]
    sources: Mapping[str, Mapping[str, int]]

    @property
    def nbytes(self) -> int:
        """Memory of the images [bytes]."""
        parts = vars(self.kernels).values()
        return sum(part.nbytes for part in parts if hasattr(part, "nbytes"))


@dataclass(frozen=True, eq=False)
class _Counted:
    """Report steps of a phase, which is one part of the whole work.

    The part is from ``begin`` to ``end``, and has ``total`` steps.
    """

    report: Report
    phase: str
    total: int
    begin: float
    end: float

    def __call__(self, done: int) -> None:
        share = self.begin + (self.end - self.begin) * done / max(self.total, 1)
        self.report(
            share, self.phase, phase=self.phase, n_done=min(done, self.total), n_total=self.total
        )


def _batches(names: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    return (names[start : start + size] for start in range(0, len(names), size))


@dataclass(frozen=True, eq=False)
class _Batch:
    """Stored heliostats of one batch with their newest mounts, by name."""

    names: Sequence[str]
    rows: Mapping[str, HeliostatRow]
    mounts: Mapping[str, MountRow]

    @classmethod
    def read(cls, session: Session, names: Sequence[str]) -> "_Batch":
        calibrated = {row.name: mount for row, mount in mounts.current_mounts(session, names)}
        return cls(names, store.get_heliostats(session, names), calibrated)


def _heliostats(fleet: HeliostatGroup, batch: _Batch) -> Iterator[Heliostat]:
    """Heliostats that can be read, on their calibrated mounts; ``skipped`` receives the others."""
    for name in batch.names:
        if name not in batch.rows:
            fleet.skipped[name] = f"there is no heliostat {name}; POST it to /v1/heliostats first"
            continue
        try:
            yield fleet.in_state(
                as_calibrated(batch.rows[name], batch.mounts.get(name), fleet.model)
            )
        except ModelError as error:
            fleet.skipped[name] = str(error)


def _seen_neighbours(
    runtime: Runtime, fleet: HeliostatGroup, report: Report, share: float
) -> Neighbours:
    """The group's mirrors as obstacles, which are the first ``share`` of the work."""
    phase = "mirrors that may stand in each other's way"
    return _neighbours(runtime, fleet, _Counted(report, phase, len(fleet.names), 0.0, share))


def _neighbours(
    runtime: Runtime, fleet: HeliostatGroup, report: Callable[[int], None]
) -> Neighbours:
    """All mirrors of the group and around it as they are aligned, whatever their surfaces.

    Each takes a fraction of a kilobyte.
    """

    def all_of_them() -> Iterator[tuple[Heliostat, Array]]:
        every = [*fleet.names, *fleet.around]
        for number, names in enumerate(_batches(every, TILE)):
            report(number * TILE)
            with runtime.database.reading() as session:
                batch = _Batch.read(session, names)
            for heliostat in _heliostats(fleet, batch):
                yield heliostat, fleet.aim_of(heliostat)

    return aligned_field(all_of_them(), fleet.sun, fleet.model)


def _tiles(
    runtime: Runtime, fleet: HeliostatGroup, neighbours: Neighbours | None, size: int, n_done: int
) -> Iterator[Tile]:
    """Tiles of ``size`` heliostats, without the first ``n_done`` ones.

    The heliostats of those are read again, so ``skipped`` and ``without_surface`` are complete.
    """
    for names in _batches(fleet.names, size):
        with runtime.database.reading() as session:
            batch = _Batch.read(session, names)
            heights = {} if fleet.ideal else _heights(session, batch.rows)
        shots = list(_setups(fleet, batch, heights))
        if not shots:
            continue
        if n_done:
            n_done -= 1
        else:
            yield tile_of(shots, neighbours)


def _heights(session: Session, rows: Mapping[str, HeliostatRow]) -> dict[str, Array]:
    """Heights (4, 8, 8) [m] of the active surfaces, by heliostat."""
    found = store.current_surfaces(session, [row.id for row in rows.values()])
    return {
        name: unpack(found[row.id])["z"].astype(np.float64)
        for name, row in rows.items()
        if row.id in found
    }


def _setups(fleet: HeliostatGroup, batch: _Batch, heights: Mapping[str, Array]) -> Iterator[Setup]:
    for heliostat in _heliostats(fleet, batch):
        name = heliostat.name
        if not fleet.ideal and name not in heights:
            fleet.without_surface.add(name)
        yield fleet.setup(heliostat, control_points(heliostat, heights.get(name)))
