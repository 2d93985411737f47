"""Where a calibrated mount sends the light, with its uncertainty, and the motors for an aim.

Notes
-----
The light leaves the mirror's centre along ``2 (n . sun) n - sun``. A spot's covariance, with the
derivatives ``S`` (2, P) of the residuals by the parameters::

    S C S' + Z V Z' + spot_rad^2 I

for the parameters' covariance C, the zeros' part Z of S, and the zeros' variance V by interpolation
(`CalibratedMount.zeros_variance_at`). In all functions ``heliostat`` has the mount of its
properties, and N is the number of measurements.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import UnreachableError
from model.plant import Heliostat, TargetPlane
from model.pointing.kinematics import ZEROS, KinematicChain, Readings, apply_parameters, residuals
from model.pointing.mounts import CalibratedMount

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SpotForecast:
    """Centre of the light, ``point`` (3,) [m], and the standard deviation of a spot measured there.

    ``std_m`` [m] is that along one direction of the plane: the root mean square of both.
    """

    point: Array
    std_m: float


@dataclass(frozen=True, eq=False)
class ObservedAngles:
    """Axis angles at a measurement, by its motor positions.

    Attributes
    ----------
    angles : (2,) [rad]
    std_rad : float [rad]
        Standard deviation per direction of the measured spot about the forecast one.
    shared_rad : (2, P) [rad]
        Spot shifts by P independent deviations of the calibration, one standard deviation each:
        errors that several measurements have in common.
    """

    angles: Array
    std_rad: float
    shared_rad: Array


class ReflectedRays(NamedTuple):
    """Mirror centres (N, 3) [m] and unit vectors (N, 3) of the reflected light."""

    centers: Array
    directions: Array


def reflect_rays(
    mount: CalibratedMount, heliostat: Heliostat, motors: Array, suns: Array, days: Array
) -> ReflectedRays:
    """Reflect suns (N, 3) at motor positions (N, 2) [steps] and ``days`` (N,)."""
    calibrated = apply_parameters(heliostat.mount, mount.parameters)
    attitude = calibrated.attitude(calibrated.angles_from_motors(motors) + mount.zeros_at(days))
    normal = attitude[..., 2]
    direction = 2 * (normal * suns).sum(axis=-1, keepdims=True) * normal - suns
    return ReflectedRays(calibrated.mirror_center(heliostat.position, attitude), direction)


def intersect_plane(center: Array, direction: Array, plane: TargetPlane) -> Array:
    """Return the point (3,) [m] of a ray on a plane; `UnreachableError` if it misses."""
    falling = float(direction @ plane.normal)
    distance = float((plane.center - center) @ plane.normal) / falling if falling < -1e-6 else -1.0
    if distance <= 0:
        raise UnreachableError(
            f"the light does not reach the lit side of {plane.name}; check motors, sun and target"
        )
    return np.asarray(center + distance * direction)


def spot_covariance(
    mount: CalibratedMount,
    heliostat: Heliostat,
    motors: Array,
    suns: Array,
    spots: Array,
    days: Array,
) -> Array:
    """Return covariances (N, 2, 2) [rad2], sidewards and upwards, of ``spots`` (N, 3) [m]."""
    slope = _slope(mount, heliostat, motors, suns, spots, days)
    shared = slope @ mount.covariance @ slope.swapaxes(1, 2)
    return np.asarray(shared + _separate_covariance(mount, slope, days))


def _separate_covariance(mount: CalibratedMount, slope: Array, days: Array) -> Array:
    """Covariance (N, 2, 2) [rad2] that measurements do not share: drives since, and spots."""
    of_zeros = slope[..., ZEROS]
    moved = (of_zeros * mount.zeros_variance_at(days)[:, None]) @ of_zeros.swapaxes(1, 2)
    return np.asarray(moved + mount.noise.spot_rad**2 * np.eye(2))


def _slope(
    mount: CalibratedMount,
    heliostat: Heliostat,
    motors: Array,
    suns: Array,
    spots: Array,
    days: Array,
) -> Array:
    """Derivatives (N, 2, P) of the residuals by the parameters."""
    days = np.asarray(days, dtype=np.float64)
    used = np.ones((1, len(days)), dtype=bool)
    readings = Readings(motors[None], suns[None], spots[None], days[None], used)
    chain, zeros = KinematicChain.of([heliostat]), mount.zeros_at(days)
    found = residuals(chain, readings, mount.parameters[None], zeros[None])
    return np.asarray(found.jacobian[0])


def observe_angles(
    mount: CalibratedMount, heliostat: Heliostat, motors: Array, sun: Array, spot: Array, day: float
) -> ObservedAngles:
    """Return the axis angles at motors (2,) [steps], with the uncertainty of a ``spot`` (3,)."""
    heliostat.mount.require_within(motors)
    days = np.array([day])
    slope = _slope(mount, heliostat, motors[None], sun[None], spot[None], days)
    sizes, vectors = np.linalg.eigh(mount.covariance)
    shared = slope[0] @ (vectors * np.sqrt(sizes.clip(min=0)))
    separate = _separate_covariance(mount, slope, days)[0]
    std_rad = max(mount.residual_std_rad, float(np.sqrt(np.trace(separate) / 2)))
    angles = mount.mount(heliostat.mount, day).angles_from_motors(motors)
    return ObservedAngles(angles, std_rad, shared)


def forecast_spot(
    mount: CalibratedMount,
    heliostat: Heliostat,
    plane: TargetPlane,
    motors: ArrayLike,
    sun: ArrayLike,
    day: float = np.nan,
) -> SpotForecast:
    """Forecast the spot on a plane for motor positions (2,) [steps] and a unit ``sun`` (3,).

    Raises `UnreachableError` if the light misses the plane or the drives cannot get there.
    """
    steps = np.atleast_2d(motors).astype(np.float64)
    suns, days = np.atleast_2d(sun), np.array([day])
    (center,), (direction,) = reflect_rays(mount, heliostat, steps, suns, days)
    point = intersect_plane(center, direction, plane)
    covariance = spot_covariance(mount, heliostat, steps, suns, point[None], days)[0]
    sidewards = np.cross([0.0, 0.0, 1.0], direction)
    sidewards /= np.linalg.norm(sidewards)
    seen = np.stack([sidewards, np.cross(direction, sidewards)])
    slant = seen - np.outer(seen @ plane.normal, direction) / (direction @ plane.normal)
    on_plane = slant @ plane.axes[:2].T * np.linalg.norm(point - center)
    return SpotForecast(point, float(np.sqrt(np.trace(on_plane.T @ covariance @ on_plane) / 2)))


def find_motors(
    mount: CalibratedMount,
    heliostat: Heliostat,
    sun: ArrayLike,
    aim: ArrayLike,
    day: ArrayLike = np.nan,
) -> Array:
    """Return the motor positions (..., 2) [steps] that reflect a ``sun`` (..., 3) to an ``aim``.

    ``aim`` is (..., 3) [m], ``day`` (...). Raises `UnreachableError` if no attitude does, or if a
    drive would exceed its travel.
    """
    calibrated = apply_parameters(heliostat.mount, mount.parameters)
    days = np.asarray(day, dtype=np.float64)
    zeros = mount.zeros_at(days.ravel()).reshape(*days.shape, 2)
    return calibrated.motors_from_angles(calibrated.align(heliostat.position, sun, aim) - zeros)
