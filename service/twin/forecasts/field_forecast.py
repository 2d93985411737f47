"""Flux forecasts of many heliostats, tile by tile, for one sun and one receiver."""

import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.aiming.kernels import ImageTracer, Kernels, MirrorImages
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
from model.neighbours import Neighbours
from model.plant import Heliostat, Receiver, Tower
from model.progress import nothing_between
from model.setup import Setup
from model.surface import control_points
from service import store
from service.base.arrays import unpack
from service.base.errors import ConflictError
from service.base.memory import return_memory
from service.base.progress import Report
from service.store.pointing import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin.forecasts.mirror_states import MirrorState, MirrorStates, count_sources, in_state
from service.twin.heliostats.stored_mount import as_calibrated
from service.twin.plant.model_versions import ModelVersion
from service.twin.runtime.engines import Threads, engine_of
from service.twin.runtime.runtime import Runtime

Array = NDArray[np.float64]

# Share of the work that reads all heliostats for blocking and shading.
_NEIGHBOURS_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class HeliostatGroup:
    """Stored heliostats that light one receiver.

    Attributes
    ----------
    names : sequence of str
    receiver : Receiver
    sun : (3,)
        Unit vector towards the recorded sun.
    model : ModelVersion
    aim : (3,) [m] or None
        Aim point of all heliostats that are not in ``aims``; None for the receiver's default.
    aims : mapping of heliostat names to (3,) [m]
    around : mapping of heliostat names to receivers or (3,) [m]
        Heliostats that send no light, and where they aim: they block and shade.
    ideal : bool
        Trace ideal surfaces instead of the active ones.
    tower : Tower or None
        It shades mirrors.
    states : MirrorStates or None
        Measured states in which mirrors are traced; None for mirrors as declared.
    skipped : dict
        Heliostats that could not be read, with the reason. The forecast fills it.
    without_surface : set of str
        Heliostats without a surface, which are traced as ideal mirrors. The forecast fills it.
    traced_states : dict
        States in which mirrors are traced, by heliostat. The forecast fills it.
    """

    names: Sequence[str]
    receiver: Receiver
    sun: Array
    model: ModelVersion
    aim: Array | None
    aims: Mapping[str, Sequence[float]]
    ideal: bool
    tower: Tower | None = None
    states: MirrorStates | None = None
    around: Mapping[str, Receiver | Array] = field(default_factory=dict)
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
    total = runtime.operations.superpose(
        _task(fleet, resolution, neighbours, engine, lambda: traced(number)),
        _tiles(runtime, fleet, field, size, number),
        engine,
        before=None if begun is None else begun.light,
        done=done,
    )
    return replace(total, skipped=fleet.skipped | total.skipped)


def _task(
    fleet: HeliostatGroup,
    resolution: tuple[int, int],
    neighbours: bool,
    engine: Engine,
    check: Callable[[], None],
) -> Superposition:
    """What is traced of each tile; ``check`` is called between its parts."""
    # Work on other machines cannot check whether it shall stop.
    between = check if isinstance(engine, Threads) else nothing_between
    tower = None if fleet.tower is None or not neighbours else fleet.tower.outline(fleet.sun)
    return Superposition(fleet.receiver, fleet.model, resolution, tower=tower, between=between)


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
    task = _task(fleet, resolution, neighbours, engine, lambda: traced(n_done))

    def tiles() -> Iterator[MirrorImages]:
        nonlocal n_done
        for tile in engine.map(ImageTracer(task), _tiles(runtime, fleet, field, TILE, 0)):
            fleet.skipped.update(tile.skipped)
            n_done += 1
            traced(n_done)
            yield from tile.images

    images = MirrorImages.join(tiles(), len(fleet.names))
    if images is None:
        name, reason = next(iter(fleet.skipped.items()), ("the store", "it holds no heliostat"))
        raise ConflictError(f"no heliostat reaches {fleet.receiver.name}; {name}: {reason}")
    return_memory()
    return images.on_map(fleet.receiver, resolution)


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
            heliostat = as_calibrated(batch.rows[name], batch.mounts.get(name), fleet.model)
            if fleet.states is not None and name not in fleet.around:
                state = fleet.traced_states[name] = fleet.states.of(heliostat)
                heliostat = in_state(heliostat, state)
            yield heliostat
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
        points = control_points(heliostat, heights.get(name))
        yield Setup(
            heliostat,
            points,
            fleet.sun,
            fleet.receiver.middle,
            aim=fleet.aim_of(heliostat),
            identifier=name,
        )
