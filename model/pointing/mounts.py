"""A calibrated mount: where its light lands at a time, how sure that is, and the steps that send it to a place."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import date, datetime, timedelta
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import UnreachableError
from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from model.pointing.calibration import Calibrated
from model.pointing.drives import Believed, Noise
from model.pointing.kinematics import SPREAD, STROKES, ZEROS, Chain, Readings, calibrated, residuals

Array = NDArray[np.float64]

DETERMINED = 0.5
"""A parameter is determined where data leave less than this share of its prior's spread."""

# Standard deviations by which a drive has surely moved.
_SURE = 3.0

_DRIVES = ("first", "second")


@dataclass(frozen=True, eq=False)
class Step:
    """A change of the drives' zeros between two measurements.

    Attributes
    ----------
    before, after : int
        Places of the last measurement before it and the first after.
    zeros, std : (2,) [rad]
        What was added to the zeros, and its standard deviation.
    motors : (2,) [steps]
        The same in steps of the motors, where they stood then.
    """

    before: int
    after: int
    zeros: Array
    std: Array
    motors: Array


@dataclass(frozen=True, eq=False)
class CalibratedMount:
    """What calibration knows of one mount.

    Attributes
    ----------
    parameters : (P,)
        In the order of `PARAMETERS`, added to the heliostat's properties.
    covariance : (P, P)
        Theirs at the newest measurement, its drift in it.
    spread, prior_spread : (P,)
        Standard deviations of the parameters with the data and without.
    days : (M,) [d]
        When it was measured, ascending.
    drift, jitter, stepped : (M, 2) [rad]
        What the zeros had beside their parameters then: slow, of hours, and by steps up to then.
    drifted_std : (2,) [rad]
        Of the drift from the first measurement to the newest.
    foreign : (M,) of bool
        Measurements that contradict all others.
    residuals : (M, 2) [rad]
        What they leave.
    steps : tuple of Step
    noise : Noise
    """

    parameters: Array
    covariance: Array
    spread: Array
    prior_spread: Array
    days: Array
    drift: Array
    jitter: Array
    stepped: Array
    drifted_std: Array
    foreign: NDArray[np.bool_]
    residuals: Array
    steps: tuple[Step, ...]
    noise: Noise = field(default_factory=Noise)

    @classmethod
    def uncalibrated(cls) -> "CalibratedMount":
        """That of a heliostat that was never measured, and whose field was not."""
        none = np.zeros((0, 2))
        return cls(
            parameters=np.zeros(len(SPREAD)),
            covariance=np.diag(SPREAD**2),
            spread=SPREAD,
            prior_spread=SPREAD,
            days=np.zeros(0),
            drift=none,
            jitter=none,
            stepped=none,
            drifted_std=np.zeros(2),
            foreign=np.zeros(0, dtype=bool),
            residuals=none,
            steps=(),
        )

    def change(self, step: Step) -> tuple[str, str]:
        """What likely happened at one of its steps: a short code, ``referenced`` or ``lost_steps``, and in words.

        A drive that loses steps does so alone; who references drives, or mends a mount, moves both at once, or brings
        one back to where it stood before an earlier step.
        """
        moved = np.abs(step.zeros) > _SURE * step.std
        moved |= np.abs(step.zeros) == np.abs(step.zeros).max()
        variance = step.std**2
        for earlier in reversed([one for one in self.steps if one.after <= step.before]):
            variance = variance + earlier.std**2
            apart = np.abs(self.stepped[step.after] - self.stepped[earlier.before])
            if (apart < _SURE * np.sqrt(variance))[moved].all():
                return "referenced", "back to where it stood before an earlier step: referenced anew"
        if moved.all():
            return "referenced", "both drives at once: referenced anew, or mended"
        return "lost_steps", f"the {_DRIVES[int(moved.argmax())]} drive alone: it likely lost steps"

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which parameters (P,) the data tell."""
        return np.asarray(self.spread < DETERMINED * self.prior_spread)

    @property
    def off(self) -> Array:
        """Angles (M,) [rad] between forecast and measured spots."""
        return np.asarray(np.linalg.norm(self.residuals, axis=-1))

    def zeros_at(self, days: ArrayLike) -> Array:
        """What is added to the zeros (N, 2) [rad] at ``days`` (N,); NaN stands for the newest measurement.

        Between two measurements drift and jitter are what both leave likely; a step lies halfway.
        """
        when, before, after, shares = self._between(days)
        if not len(self.days):
            return np.zeros((len(when), 2))
        nearest = np.where(2 * when < self.days[before] + self.days[after], before, after)
        slow, quick = (
            first[:, None] * value[before] + second[:, None] * value[after]
            for value, (first, second, _) in zip((self.drift, self.jitter), shares, strict=True)
        )
        return np.asarray(self.stepped[nearest] + slow + quick)

    def zeros_variance_at(self, days: ArrayLike) -> Array:
        """Variances (N, 2) [rad2] of the zeros at ``days`` beyond those at measurements."""
        when, _, _, shares = self._between(days)
        if not len(self.days):
            return np.zeros((len(when), 2))
        spreads = (self.noise.drift_rad, self.noise.jitter_rad)
        left = [unknown[:, None] * np.square(spread) for (_, _, unknown), spread in zip(shares, spreads, strict=True)]
        return np.asarray(np.sum(left, axis=0))

    def _between(
        self, days: ArrayLike
    ) -> tuple[Array, NDArray[np.intp], NDArray[np.intp], list[tuple[Array, Array, Array]]]:
        """For each of ``days`` the measurements before and after, their shares and the variance's that is left.

        An Ornstein-Uhlenbeck process between two known places: what came before or comes after tells nothing more.
        """
        when = np.atleast_1d(np.asarray(days, dtype=np.float64))
        if not len(self.days):
            return when, np.zeros(len(when), np.intp), np.zeros(len(when), np.intp), []
        when = np.where(np.isnan(when), self.days[-1], when)
        after = np.searchsorted(self.days, when)
        before = np.clip(after - 1, 0, len(self.days) - 1)
        after = np.clip(after, 0, len(self.days) - 1)
        shares = []
        for memory in (self.noise.drift_days, self.noise.jitter_days):
            first, second = (np.exp(-np.abs(when - self.days[place]) / memory) for place in (before, after))
            both = np.maximum(1 - (first * second) ** 2, 1e-12)
            one, two = first * (1 - second**2) / both, second * (1 - first**2) / both
            alone = before == after
            one, two = np.where(alone, first, one), np.where(alone, 0.0, two)
            exact = ~alone & (first * second > 1 - 1e-12)  # two at one moment
            one = np.where(exact, 1.0, one)
            shares.append((one, two, np.clip(1 - one * first - two * second, 0, 1)))
        return when, before, after, shares

    def mount(self, nominal: Mount, day: float = np.nan) -> Mount:
        """The mount as calibrated, of that which the properties have, at a day; by default as newly measured."""
        parameters = self.parameters.copy()
        parameters[ZEROS] += self.zeros_at(day)[0]
        return replace(calibrated(nominal, parameters), calibrated_until=self.until)

    @property
    def until(self) -> date | None:
        """The day of the newest measurement; None where there was none."""
        return date(1970, 1, 1) + timedelta(days=float(self.days[-1])) if len(self.days) else None

    @property
    def usual_rad(self) -> float:
        """Standard deviation [rad] per direction of what measurements leave: robust, from the median of their angles.

        The median angle of two equal normal components is sqrt(2 ln 2) deviations.
        """
        off = self.off[~self.foreign]
        return float(np.median(off) / np.sqrt(2 * np.log(2))) if len(off) else self.noise.spot_rad

    def light(self, heliostat: Heliostat, motors: Array, suns: Array, days: Array) -> tuple[Array, Array]:
        """Mirror centres (N, 3) [m] and directions (N, 3) of their light at motor positions (N, 2) [steps]."""
        mount = calibrated(heliostat.mount, self.parameters)
        attitude = mount.attitude(mount.angles_from_motors(motors) + self.zeros_at(days))
        normal = attitude[..., 2]
        direction = 2 * (normal * suns).sum(axis=-1, keepdims=True) * normal - suns
        return mount.mirror_center(heliostat.position, attitude), direction

    def covariance_at(self, heliostat: Heliostat, motors: Array, suns: Array, spots: Array, days: Array) -> Array:
        """Covariances (N, 2, 2) [rad2], sidewards and upwards, of spots measured at motor positions (N, 2) [steps]."""
        slope = self._slope(heliostat, motors, suns, spots, days)
        return np.asarray(slope @ self.covariance @ slope.swapaxes(1, 2) + self._own_covariance(slope, days))

    def _own_covariance(self, slope: Array, days: Array) -> Array:
        """What each of N measurements adds to it by itself (N, 2, 2) [rad2]: its drives since, and its spot."""
        of_zeros = slope[..., ZEROS]
        moved = (of_zeros * self.zeros_variance_at(days)[:, None]) @ of_zeros.swapaxes(1, 2)
        return np.asarray(moved + self.noise.spot_rad**2 * np.eye(2))

    def _slope(self, heliostat: Heliostat, motors: Array, suns: Array, spots: Array, days: Array) -> Array:
        """Derivatives (N, 2, P) of residuals by the parameters."""
        days = np.asarray(days, dtype=np.float64)
        readings = Readings(motors[None], suns[None], spots[None], days[None], np.ones((1, len(days)), dtype=bool))
        chain, zeros = Chain.of([heliostat]), self.zeros_at(days)
        return np.asarray(residuals(chain, readings, self.parameters[None], zeros[None])[1][0])

    def is_before(self, moment: datetime | None) -> bool:
        """Whether all that it was calibrated by was taken before the day of a moment; never where that is not known."""
        return self.until is not None and moment is not None and moment.date() > self.until

    def told(
        self, heliostat: Heliostat, motors: Array, sun: Array, spot: Array, day: float
    ) -> tuple[Array, float, Array]:
        """Angles (2,) [rad] of the axes at a measurement, as its motors (2,) [steps] say, and how sure that is.

        Beside them the standard deviation [rad] per direction by which its ``spot`` (3,) [m] lies about where that
        sends the light of the ``sun`` (3,), and what the calibration leaves open of it (2, P) [rad]: what P independent
        deviations of the mount move the spot by, one standard deviation each, which spots of several measurements have
        in common. ``heliostat`` is as its properties have it.
        """
        heliostat.mount.require_within(motors)
        days = np.array([day])
        slope = self._slope(heliostat, motors[None], sun[None], spot[None], days)
        sizes, vectors = np.linalg.eigh(self.covariance)
        doubts = slope[0] @ (vectors * np.sqrt(sizes.clip(min=0)))
        alone = self._own_covariance(slope, days)[0]
        std_rad = max(self.usual_rad, float(np.sqrt(np.trace(alone) / 2)))
        return self.mount(heliostat.mount, day).angles_from_motors(motors), std_rad, doubts

    def spot(
        self, heliostat: Heliostat, plane: TargetPlane, motors: ArrayLike, sun: ArrayLike, day: float = np.nan
    ) -> tuple[Array, float]:
        """Where the light's centre lands on a plane (3,) [m], and the standard deviation [m] of a spot measured there.

        The latter is that along one direction of the plane, the mean of both. Raises `UnreachableError` where the light
        does not reach the plane, or the drives cannot stand there.
        """
        steps, source, days = np.atleast_2d(motors), np.atleast_2d(sun), np.array([day])
        centers, directions = self.light(heliostat, steps.astype(np.float64), source, days)
        point = landed(centers[0], directions[0], plane)
        cov = self.covariance_at(heliostat, steps.astype(np.float64), source, point[None], days)[0]
        sidewards = np.cross([0.0, 0.0, 1.0], directions[0])
        sidewards /= np.linalg.norm(sidewards)
        seen = np.stack([sidewards, np.cross(directions[0], sidewards)])
        slant = seen - np.outer(seen @ plane.normal, directions[0]) / (directions[0] @ plane.normal)
        on_plane = slant @ plane.axes[:2].T * np.linalg.norm(point - centers[0])
        return point, float(np.sqrt(np.trace(on_plane.T @ cov @ on_plane) / 2))

    def motors(self, heliostat: Heliostat, sun: ArrayLike, aim: ArrayLike, day: float = np.nan) -> Array:
        """Motor positions (2,) [steps] that send the sun's light to ``aim`` (3,) [m].

        Raises `UnreachableError` where no attitude does, or a drive would go beyond an end of its travel.
        """
        mount = self.mount(heliostat.mount, day)
        return mount.motors_from_angles(mount.align(heliostat.position, sun, aim))


def landed(center: Array, direction: Array, plane: TargetPlane) -> Array:
    """Where a ray meets a plane (3,) [m]; `UnreachableError` where it goes away from its lit side."""
    falling = float(direction @ plane.normal)
    distance = float((plane.center - center) @ plane.normal) / falling if falling < -1e-6 else -1.0
    if distance <= 0:
        raise UnreachableError(f"the light does not reach the lit side of {plane.name}; check motors, sun and target")
    return np.asarray(center + distance * direction)


def mounts_of(done: Calibrated, heliostats: Sequence[Heliostat], readings: Readings) -> list[CalibratedMount]:
    """Each heliostat's own part of a calibration of ``heliostats`` by ``readings``."""
    own, believed = Chain.of(heliostats), done.believed
    parameters = believed.parameters.copy()
    # They count from each heliostat's own properties, also where the field's drives were the start.
    parameters[:, ZEROS] += done.chain.zero - own.zero
    parameters[:, STROKES] += done.chain.stroke - own.stroke
    mounts = []
    for row, heliostat in enumerate(heliostats):
        known = slice(0, int(readings.used[row].sum()))
        nominal = calibrated(heliostat.mount, parameters[row])
        mounts.append(
            CalibratedMount(
                parameters=parameters[row],
                covariance=believed.covariance[row],
                spread=believed.spread[row],
                prior_spread=np.sqrt(np.diag(done.field.covariance)),
                days=readings.days[row, known],
                drift=believed.drift[row, known],
                jitter=believed.jitter[row, known],
                stepped=believed.steps[row, known],
                drifted_std=believed.drifted_std[row],
                foreign=believed.foreign[row, known],
                residuals=done.residuals[row, known],
                steps=tuple(_steps(believed, row, nominal, readings)),
                noise=done.noise,
            )
        )
    return mounts


def _steps(believed: Believed, row: int, mount: Mount, readings: Readings) -> Iterator[Step]:
    """Steps between two measurements that are believed; what is said of those between them is one step."""
    good = np.nonzero(readings.used[row] & ~believed.foreign[row])[0]
    for before, after in pairwise(good):
        begun = slice(before + 1, after + 1)
        if not believed.stepped[row, begun].any():
            continue
        zeros = believed.steps[row, after] - believed.steps[row, before]
        std = np.sqrt((believed.steps_std[row, begun] ** 2).sum(axis=0))
        motors = readings.steps[row, after]
        angle_of_a_step = (mount.angles_from_motors(motors + 1) - mount.angles_from_motors(motors - 1)) / 2
        yield Step(int(before), int(after), zeros, std, zeros / angle_of_a_step)
