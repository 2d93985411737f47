"""Fleet forecasts: the stored heliostats, tile by tile, before one sun and one receiver."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.errors import ModelError
from model.fleet import TILE, Engine, FleetFlux, Tile, aligned_field, tile_of
from model.forecast import Setup
from model.neighbours import Neighbours
from model.plant import Heliostat, Receiver
from model.surface import control_points
from model.tracing import Optics
from service import store
from service.base.arrays import unpack
from service.base.progress import Report
from service.store import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin.engines import engine_of
from service.twin.mounted import standing
from service.twin.runtime import Runtime
from service.twin.versions import PlantModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fleet:
    """Stored heliostats that are to light one receiver.

    Attributes
    ----------
    names : sequence of str
    receiver : Receiver
    sun : (3,)
        Unit vector towards the recorded sun.
    optics : Optics
    model : PlantModel
        Whose effects act; its optics are those above with another DNI.
    origin : (3,)
        The tower base in WGS84 [deg, deg, m].
    aim : (3,) [m]
        Of all heliostats but those in ``aims``.
    aims : mapping of heliostat names to (3,) [m]
    ideal : bool
        Trace ideal surfaces, in place of the current ones.
    skipped : dict
        Heliostats that could not be read, with the reason; filled as they are met.
    """

    names: Sequence[str]
    receiver: Receiver
    sun: Array
    optics: Optics
    model: PlantModel
    origin: tuple[float, float, float]
    aim: Array
    aims: Mapping[str, Sequence[float]]
    ideal: bool
    skipped: dict[str, str] = field(default_factory=dict)

    def aim_of(self, name: str) -> Array:
        """Where a heliostat aims (3,) [m]."""
        return np.asarray(self.aims.get(name, self.aim), dtype=np.float64)


def forecast_fleet(
    runtime: Runtime, fleet: Fleet, resolution: tuple[int, int], neighbours: bool, report: Report
) -> FleetFlux:
    """The light of a fleet; ``neighbours`` block and shade each other, also those that lack a surface.

    ``report`` is told how far it is, 0 to 1; what it raises ends the work.
    """
    share = 0.1 if neighbours else 0.0  # reading all heliostats once before takes about that much of the time
    field = _standing(runtime, fleet, lambda done: report(share * done, "neighbours")) if neighbours else None
    parts = _tiles(runtime, fleet, field, lambda done: report(share + (1 - share) * done, "flux"))
    engine: Engine = engine_of(runtime)
    made = runtime.operations.superpose(
        fleet.receiver,
        parts,
        resolution=resolution,
        optics=fleet.optics,
        effects=fleet.model.effects,
        latitude_deg=fleet.origin[0],
        engine=engine,
    )
    return FleetFlux(made.irradiance, made.power, made.heliostats, fleet.skipped | made.skipped)


def _batches(fleet: Fleet, report: Callable[[float], None]) -> Iterator[Sequence[str]]:
    for start in range(0, len(fleet.names), TILE):
        report(start / len(fleet.names))
        yield fleet.names[start : start + TILE]


@dataclass(frozen=True, eq=False)
class _Batch:
    """Some of a fleet's heliostats as they are stored, with their newest mounts, by name."""

    names: Sequence[str]
    rows: Mapping[str, HeliostatRow]
    mounts: Mapping[str, MountRow]

    @classmethod
    def read(cls, session: Session, names: Sequence[str]) -> "_Batch":
        kept = {row.name: mount for row, mount in mounts.current_mounts(session, names)}
        return cls(names, store.get_heliostats(session, names), kept)


def _heliostats(fleet: Fleet, batch: _Batch) -> Iterator[Heliostat]:
    """Those that can be read, as they stand; the others go to ``skipped``."""
    for name in batch.names:
        if name not in batch.rows:
            fleet.skipped[name] = f"there is no heliostat {name}; POST it to /v1/heliostats first"
            continue
        try:
            yield standing(batch.rows[name], batch.mounts.get(name), fleet.origin, fleet.model.effects)
        except ModelError as error:
            fleet.skipped[name] = str(error)


def _standing(runtime: Runtime, fleet: Fleet, report: Callable[[float], None]) -> Neighbours:
    """The mirrors of the fleet as they stand: a fraction of a kilobyte each, whatever their surfaces."""

    def all_of_them() -> Iterator[tuple[Heliostat, Array]]:
        for names in _batches(fleet, report):
            with runtime.database.reading() as session:
                batch = _Batch.read(session, names)
            for heliostat in _heliostats(fleet, batch):
                yield heliostat, fleet.aim_of(heliostat.name)

    return aligned_field(all_of_them(), fleet.sun, fleet.model.effects, latitude_deg=fleet.origin[0])


def _tiles(
    runtime: Runtime, fleet: Fleet, neighbours: Neighbours | None, report: Callable[[float], None]
) -> Iterator[Tile]:
    for names in _batches(fleet, report):
        with runtime.database.reading() as session:
            batch = _Batch.read(session, names)
            heights = {} if fleet.ideal else _heights(session, batch.rows)
        shots = list(_shots(fleet, batch, heights))
        if shots:
            yield tile_of(shots, neighbours)


def _heights(session: Session, rows: Mapping[str, HeliostatRow]) -> dict[str, Array]:
    """Heights (4, 8, 8) [m] of the current surfaces, by heliostat."""
    found = store.current_surfaces(session, [row.id for row in rows.values()])
    return {name: unpack(found[row.id])["z"].astype(np.float64) for name, row in rows.items() if row.id in found}


def _shots(fleet: Fleet, batch: _Batch, heights: Mapping[str, Array]) -> Iterator[Setup]:
    for heliostat in _heliostats(fleet, batch):
        name = heliostat.name
        if not fleet.ideal and name not in heights:
            fleet.skipped[name] = f'surface: heliostat {name} has no surface yet; predict one, or ask for "ideal"'
            continue
        points = control_points(heliostat, heights.get(name))
        yield Setup(heliostat, points, fleet.sun, fleet.receiver.middle, aim=fleet.aim_of(name), identifier=name)
