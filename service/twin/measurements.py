"""Convert stored measurements to inputs of the model: for surfaces and for studies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from operator import attrgetter
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model import prediction_warnings
from model.errors import InvalidInputError
from model.frames import sun_direction, wgs84_to_enu
from model.images import FLUX_WINDOW, normalized
from model.imaging.window import flux_window, share_window
from model.metrics import WINDOWS, spot_window
from model.observation import Observation, spread_suns
from model.plant import Heliostat, TargetPlane
from model.setup import Setup
from model.study import FluxImage
from model.surface import DEGREE
from service import store
from service.base.arrays import unpack
from service.base.errors import ConflictError
from service.sources.photograph import CENTERED_SIZE_ERROR
from service.store import mounts
from service.store.surface_versions import NewSurface
from service.store.tables import HeliostatRow, MeasurementRow, MountRow, SurfaceRow
from service.twin import model_versions
from service.twin.model_versions import ModelVersion
from service.twin.stored_mount import as_calibrated

Array = NDArray[np.float64]
Item = TypeVar("Item")

# Measurements are chosen for different sun positions, among this many times as many newest ones.
# These represent the mirror's current state.
_RECENT = 4

# Largest saturated share of a spot's brighter half before other photographs are preferred.
# Unsaturated photographs alone have too few sun positions (``python -m benchmarks.light
# --consensus``, ``surfaces --only photographs``).
_WHOLE = 0.3


@dataclass(frozen=True, eq=False)
class AcceptedMeasurement:
    """An accepted measurement as an input of the model.

    Attributes
    ----------
    identifier : str
    sun : (3,)
        Unit vector towards the sun.
    target : TargetPlane
    flux : (rows, columns) or None
        Over the whole target; None if only the part about the centre of mass is known.
    centered : (64, 64)
        In a window of `FLUX_WINDOW` about the centre of mass, sum 100.
    spot : (3,) [m] or None
        Centre of mass in ENU: as measured, else as sent.
    motor_position : (2,) [steps] or None
    taken_at : datetime or None
    clipped : bool (rows, columns) or None
        Where the image of the target is saturated.
    sheet_share : float [1]
        See `model.imaging.Quality`.
    square : (64, 64) or None
        All of a ``flux-centered`` image, over `CENTERED_WINDOW`; None of other kinds.
    temperature_c : float or None [deg C]
        Of the air.
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
    square: NDArray[np.float32] | None = None
    temperature_c: float | None = None

    def observation(self, side: float = FLUX_WINDOW) -> Observation:
        """What a square of ``side`` [m] about the spot shows of the mirror.

        A side other than `FLUX_WINDOW` needs ``flux``.
        """
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
            size_error=0.0 if self.square is None else CENTERED_SIZE_ERROR,
        )

    def _about_spot(self, side: float) -> NDArray[np.float32]:
        if self.flux is None or self.spot is None:
            raise InvalidInputError(
                f"{self.identifier}: a centred flux cannot be cut to {side:g} m"
            )
        size = self.target.width, self.target.height
        return normalized(
            flux_window(self.flux, size, self.target.to_plane(self.spot), side)
        ).astype(np.float32)

    def _clipped_about_spot(self, side: float) -> NDArray[np.float32] | None:
        if self.clipped is None or self.spot is None:
            return None
        size = self.target.width, self.target.height
        return share_window(self.clipped, size, self.target.to_plane(self.spot), side)

    def photograph(
        self,
        heliostat: Heliostat,
        points: Array,
        degree: int = DEGREE,
        seen: bool = False,
        is_estimated: bool = False,
    ) -> FluxImage:
        """The flux image that a study compares with a mirror.

        ``points`` are the mirror's control points (F, I, J, 3) [m]. ``seen`` is whether the mirror
        was computed from this photograph, ``is_estimated`` whether from any.

        Raises
        ------
        InvalidInputError
            If the spot's position is unknown or off the target.
        """
        key = f"{heliostat.name}/{self.identifier}"
        if self.spot is None:
            raise InvalidInputError(
                f"{key}: a centred flux without 'focal_spot' has no place on the target"
            )
        if not self.target.contains(self.spot):
            raise InvalidInputError(f"{key}: 'focal_spot' lies off its target {self.target.name}")
        image, plane, clipped = self.flux, self.target, self.clipped
        if image is None:  # only the part about the spot is known
            image = self.centered
            plane = replace(plane, center=self.spot, width=FLUX_WINDOW, height=FLUX_WINDOW)
        shot = Setup(
            heliostat,
            points,
            self.sun,
            plane,
            self.spot,
            degree=degree,
            identifier=key,
            taken_at=self.taken_at,
            temperature_c=self.temperature_c,
        )
        return FluxImage(
            shot,
            image,
            seen=seen,
            is_estimated=is_estimated,
            clipped=clipped,
            sheet_share=self.sheet_share,
        )


def to_observations(
    evidence: Sequence[AcceptedMeasurement], heliostat: Heliostat | None = None
) -> list[Observation]:
    """Observations of a heliostat in the smallest of `WINDOWS` that contains their spots.

    The first window is that of the ideal mirror's spot if the ``heliostat`` is given. No window is
    larger than a target. If only the part about the spot is known of any photograph, all use the
    smallest window.
    """
    observations = [one.observation() for one in evidence]
    if any(one.flux is None for one in evidence):
        return observations
    widest = min((min(one.target.width, one.target.height) for one in evidence), default=0.0)
    expected = 0.0 if heliostat is None else _expected_window(evidence, heliostat)
    for side in WINDOWS[1:]:
        if side > widest:
            break
        if side > expected and not prediction_warnings.has_excess_spillage(observations):
            break
        observations = [one.observation(side) for one in evidence]
    return observations


def _expected_window(evidence: Sequence[AcceptedMeasurement], heliostat: Heliostat) -> float:
    """Side [m] of the window that contains the ideal mirror's spots."""
    ranges = [float(np.linalg.norm(one.target.center - heliostat.position)) for one in evidence]
    return max((spot_window(heliostat, slant_range) for slant_range in ranges), default=0.0)


def choose_diverse(
    items: Sequence[Item],
    count: int,
    sun_of: Callable[[Item], Array] = attrgetter("sun"),
    clipped_of: Callable[[Item], float] = attrgetter("clipped_share"),
) -> list[Item]:
    """Choose up to ``count`` items with suns far apart.

    Saturated photographs are less informative. They are used only if there are too few others.
    """
    whole = [item for item in items if clipped_of(item) <= _WHOLE]
    kept = items if len(whole) < count else whole
    return [kept[index] for index in spread_suns(np.array([sun_of(item) for item in kept]), count)]


# --- from the store
# -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HeliostatContext:
    """A stored heliostat with the plant's model: inputs of tracing without surface and sun.

    ``mount`` is the row id of its newest mount; None if there is none.
    """

    row: HeliostatRow
    heliostat: Heliostat
    model: ModelVersion
    mount: int | None

    @classmethod
    def of(cls, row: HeliostatRow, mount: MountRow | None, model: ModelVersion) -> Self:
        """The heliostat on a stored mount if that is valid, else as in its properties."""
        return cls(
            row, as_calibrated(row, mount, model), model, None if mount is None else mount.id
        )

    @property
    def origin(self) -> tuple[float, float, float]:
        """The tower base in WGS84 [deg, deg, m]."""
        return self.model.site.origin


def load_heliostat_context(
    session: Session, name: str, model_version: int | None = None
) -> HeliostatContext:
    """Load a heliostat on its newest mount, with a version of the plant's model.

    The default is the current version.

    Raises
    ------
    NotFoundError
        If the heliostat or the version is not stored.
    ConflictError
        If the plant is not set.
    """
    row = store.get_heliostat(session, name)
    model = model_versions.get_model(session, model_version)
    return HeliostatContext.of(row, mounts.find_mount_at(session, row), model)


def heights_of(surface: SurfaceRow | NewSurface | None) -> Array | None:
    """Control heights (4, 8, 8) [m] of a surface; None for the ideal one.

    A stored surface must be loaded with its arrays.
    """
    if surface is None or isinstance(surface, NewSurface):
        return None if surface is None else surface.z
    return unpack(surface.arrays)["z"].astype(np.float64)


def accepted_measurement(
    row: MeasurementRow, origin: tuple[float, float, float], target: TargetPlane | None = None
) -> AcceptedMeasurement:
    """Convert the row of an accepted measurement, loaded with its arrays.

    ``target`` is needed if the row is not in the store yet.
    """
    plane, arrays = target or store.target_plane(row.target), unpack(row.arrays or b"")
    motors, clipped = (row.motor_axis_1, row.motor_axis_2), arrays.get("clipped")
    return AcceptedMeasurement(
        identifier=row.identifier,
        sun=sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        target=plane,
        flux=arrays.get("flux"),
        centered=arrays["centered"],
        spot=spot_position(row, plane, origin),
        motor_position=None if None in motors else np.array(motors),
        taken_at=row.taken_at,
        clipped=None if clipped is None else np.asarray(clipped, dtype=bool),
        sheet_share=float(row.quality.get("sheet_share") or 0),
        square=arrays.get("square"),
        temperature_c=row.temperature_c,
    )


def spot_position(
    row: MeasurementRow, plane: TargetPlane, origin: tuple[float, float, float]
) -> Array | None:
    """Position (3,) [m] of a measurement's spot in ENU: as measured, else as sent."""
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
    """Choose up to ``spare * count`` accepted measurements: recent, with different sun positions.

    ``since`` and ``until`` limit their time.

    Raises
    ------
    ConflictError
        If the heliostat has none.
    """
    recent = store.recent_measurements(session, heliostat, _RECENT * count, since, until)
    if not recent and (since or until):
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement of this time")
    if not recent:
        raise ConflictError(
            f"heliostat {heliostat.name} has no accepted measurement; post target images of it"
            " first"
        )
    return choose_diverse(
        recent,
        spare * count,
        lambda row: sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        lambda row: float(row.quality.get("clipped_share") or 0),
    )


def named_measurements(
    session: Session, heliostat: HeliostatRow, names: Sequence[str]
) -> list[MeasurementRow]:
    """Accepted measurements by identifier, with arrays; ConflictError if one was refused."""
    found = store.get_measurements(session, heliostat, list(dict.fromkeys(names)), arrays=True)
    rows = list({row.id: row for row in found}.values())  # one photograph may have two names
    for row in rows:
        if not row.accepted or row.arrays is None:
            why = (
                "came without an image"
                if row.image_sha256 is None
                else f"was refused ({row.reason})"
            )
            raise ConflictError(f"measurements: {row.identifier} {why}; choose accepted ones")
    return rows
