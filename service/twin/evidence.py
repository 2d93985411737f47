"""What measurements tell the model, wherever they come from: a photograph's way from a row, or a folder, to the model.

The store and the command line's folders both make `Evidence` of a measurement; from there on there is one road to
surfaces (`Evidence.observation`) and to studies (`Evidence.photograph`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model import doubts
from model.errors import InvalidInputError
from model.forecast import Setup
from model.frames import sun_direction, wgs84_to_enu
from model.images import FLUX_WINDOW, normalized
from model.imaging.window import flux_window, share_window
from model.metrics import WINDOWS
from model.observation import Observation, spread_suns
from model.plant import Heliostat, TargetPlane
from model.study import FluxImage
from model.surface import DEGREE
from service import store
from service.base.arrays import unpack
from service.base.faults import ConflictError
from service.store import mounts
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow
from service.twin import versions
from service.twin.mounted import standing
from service.twin.versions import PlantModel

Array = NDArray[np.float64]
Item = TypeVar("Item")

# The newest measurements, this many times as many as are wanted, stand for the mirror's present state; those that
# are used are chosen among them for variety of the sun's position.
_RECENT = 4

# Share of a spot's brighter half that the camera's range may cut off before others are rather chosen: whole ones alone
# stand under too few suns (``python -m tests.benchmarks.light --consensus``, ``surfaces --only photographs``).
_WHOLE = 0.3


@dataclass(frozen=True, eq=False)
class Evidence:
    """An accepted measurement as the model takes it.

    Attributes
    ----------
    identifier : str
    sun : (3,)
        Unit vector towards the sun.
    target : TargetPlane
    flux : (rows, columns) or None
        Over the whole target; None where only the part about its centre of mass is known.
    centered : (64, 64)
        In a window of `FLUX_WINDOW` about the centre of mass, sum 100.
    spot : (3,) [m] or None
        Where the centre of mass lies, in ENU: as measured, else as the sender knew it.
    motor_position : (2,) [steps] or None
    taken_at : datetime or None
    clipped : bool (rows, columns) or None
        Where on the target the camera's range cut the light off.
    sheet_share : float [1]
        As `model.imaging.Quality` has it.
    """

    identifier: str
    sun: Array
    target: TargetPlane
    flux: NDArray[Any] | None
    centered: NDArray[np.float32]
    spot: Array | None
    motor_position: Array | None = None
    taken_at: datetime | None = None
    clipped: NDArray[np.bool_] | None = None
    sheet_share: float = 0.0

    def observation(self, side: float = FLUX_WINDOW) -> Observation:
        """What a square of ``side`` [m] about its spot shows of the mirror; others than `FLUX_WINDOW` need ``flux``."""
        return Observation(
            flux=self.centered if side == FLUX_WINDOW else self._about_spot(side),
            sun=self.sun,
            center_of_mass=np.array(self.target.center) if self.spot is None else self.spot,
            target=self.target,
            motor_position=self.motor_position,
            identifier=self.identifier,
            clipped=self._clipped_about_spot(side),
            taken_at=self.taken_at,
            side=side,
        )

    def _about_spot(self, side: float) -> NDArray[np.float32]:
        if self.flux is None or self.spot is None:
            raise InvalidInputError(f"{self.identifier}: a centred flux cannot be cut to {side:g} m")
        size = self.target.width, self.target.height
        return normalized(flux_window(self.flux, size, self.target.to_plane(self.spot), side)).astype(np.float32)

    def _clipped_about_spot(self, side: float) -> NDArray[np.float32] | None:
        if self.clipped is None or self.spot is None:
            return None
        size = self.target.width, self.target.height
        return share_window(self.clipped, size, self.target.to_plane(self.spot), side)

    def photograph(self, heliostat: Heliostat, points: Array, degree: int = DEGREE, seen: bool = False) -> FluxImage:
        """It as a study compares it with the mirror of control points (F, I, J, 3) [m].

        ``seen``: the mirror was found from this very photograph.

        Raises
        ------
        InvalidInputError
            Where it has no place on its target.
        """
        key = f"{heliostat.name}/{self.identifier}"
        if self.spot is None:
            raise InvalidInputError(f"{key}: a centred flux without 'focal_spot' has no place on the target")
        if not self.target.holds(self.spot):
            raise InvalidInputError(f"{key}: 'focal_spot' lies off its target {self.target.name}")
        image, plane, clipped = self.flux, self.target, self.clipped
        if image is None:  # the part about the spot is all there is
            image, plane = self.centered, replace(plane, center=self.spot, width=FLUX_WINDOW, height=FLUX_WINDOW)
        shot = Setup(
            heliostat, points, self.sun, plane, self.spot, degree=degree, identifier=key, taken_at=self.taken_at
        )
        return FluxImage(
            shot, np.asarray(image, dtype=np.float64), seen=seen, clipped=clipped, sheet_share=self.sheet_share
        )


def as_observations(evidence: Sequence[Evidence]) -> list[Observation]:
    """What a heliostat's photographs show, in the smallest of `WINDOWS` that their spots do not spill out of.

    None is larger than a target; photographs of which only the part about the spot is known leave it at the smallest.
    """
    observations = [one.observation() for one in evidence]
    if any(one.flux is None for one in evidence):
        return observations
    widest = min((min(one.target.width, one.target.height) for one in evidence), default=0.0)
    for side in WINDOWS[1:]:
        if side > widest or not doubts.spilt(observations):
            break
        observations = [one.observation(side) for one in evidence]
    return observations


def choose(
    items: Sequence[Item],
    count: int,
    sun_of: Callable[[Item], Array] = attrgetter("sun"),
    clipped_of: Callable[[Item], float] = attrgetter("clipped_share"),
) -> list[Item]:
    """Up to ``count`` of what was seen under some sun, the suns far apart.

    What the camera's range cut off tells less: such photographs come in where there are not enough others.
    """
    whole = [item for item in items if clipped_of(item) <= _WHOLE]
    kept = items if len(whole) < count else whole
    return [kept[index] for index in spread_suns(np.array([sun_of(item) for item in kept]), count)]


# --- out of the store -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Twin:
    """A stored heliostat as it stands, with the plant's model: all that tracing it takes but a surface and a sun."""

    row: HeliostatRow
    heliostat: Heliostat
    origin: tuple[float, float, float]
    model: PlantModel


def load_twin(session: Session, name: str, model_version: int | None = None) -> Twin:
    """A heliostat by its name on its newest mount, under a version of the plant's model, by default the current one.

    Raises
    ------
    NotFoundError
        Where the heliostat or the version is not stored.
    ConflictError
        Where the plant is not set.
    """
    row, origin = store.get_heliostat(session, name), store.get_plant(session).origin
    model = versions.get_model(session, model_version)
    heliostat = standing(row, mounts.find_mount_at(session, row), origin, model.effects)
    return Twin(row, heliostat, origin, model)


def heights_of(surface: SurfaceRow | None) -> Array | None:
    """Control heights (4, 8, 8) [m] of a stored surface, loaded with its arrays; None for the ideal one."""
    return None if surface is None else unpack(surface.arrays)["z"].astype(np.float64)


def evidence_of(row: MeasurementRow, origin: tuple[float, float, float], target: TargetPlane | None = None) -> Evidence:
    """An accepted measurement, loaded with its arrays; ``target`` where the row is not in the store yet."""
    plane, arrays = target or store.target_plane(row.target), unpack(row.arrays or b"")
    motors, clipped = (row.motor_axis_1, row.motor_axis_2), arrays.get("clipped")
    return Evidence(
        identifier=row.identifier,
        sun=sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        target=plane,
        flux=arrays.get("flux"),
        centered=arrays["centered"],
        spot=spot_of(row, plane, origin),
        motor_position=None if None in motors else np.array(motors),
        taken_at=row.taken_at,
        clipped=None if clipped is None else np.asarray(clipped, dtype=bool),
        sheet_share=float(row.quality.get("sheet_share") or 0),
    )


def spot_of(row: MeasurementRow, plane: TargetPlane, origin: tuple[float, float, float]) -> Array | None:
    """Where a measurement's spot lies (3,) [m]: as measured, else as its sender knew it."""
    if row.center_right_m is not None and row.center_up_m is not None:
        return plane.to_enu((row.center_right_m, row.center_up_m))
    return None if row.focal_spot_wgs84 is None else wgs84_to_enu(row.focal_spot_wgs84, origin)


def choose_measurements(
    session: Session,
    heliostat: HeliostatRow,
    count: int,
    since: datetime | None = None,
    until: datetime | None = None,
    spare: int = 1,
) -> list[MeasurementRow]:
    """Up to ``count`` accepted measurements of a time, ``spare`` times as many: recent, the sun at different places.

    Raises
    ------
    ConflictError
        Where the heliostat has none.
    """
    recent = store.recent_measurements(session, heliostat, _RECENT * count, since, until)
    if not recent and (since or until):
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement of this time")
    if not recent:
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement; post target images of it first")
    return choose(
        recent,
        spare * count,
        lambda row: sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        lambda row: float(row.quality.get("clipped_share") or 0),
    )


def named_measurements(session: Session, heliostat: HeliostatRow, names: Sequence[str]) -> list[MeasurementRow]:
    """Accepted measurements by their identifiers, with their arrays; ConflictError where one was refused."""
    rows = store.get_measurements(session, heliostat, list(dict.fromkeys(names)), arrays=True)
    for row in rows:
        if not row.accepted or row.arrays is None:
            raise ConflictError(f"measurements: {row.identifier} was refused ({row.reason}); choose accepted ones")
    return rows
