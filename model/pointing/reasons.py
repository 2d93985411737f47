"""Why a measurement contradicts all others of its heliostat: what would have to be true for it to fit.

Each reason says what the measurement would be if it were so, another target or another sun; the mount, or that of
another heliostat, says whether it then fits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.errors import ModelError
from model.plant import Heliostat, TargetPlane
from model.pointing.kinematics import ZEROS, Chain, residuals
from model.pointing.mounts import CalibratedMount, landed
from model.pointing.readings import Reading, later, padded

Array = NDArray[np.float64]

# What a reason leaves must be less than this [rad], or than this share of what it explains.
_FITS = 3e-3
_EXPLAINS = 0.15

# A spot of another heliostat lies further away than that [rad]; so many others are tried.
_ANOTHERS = 10e-3
_TRIED = 4

# Clocks are set to other zones, which are whole or half hours apart, or to summer.
_HOURS = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0)


@dataclass(frozen=True)
class Contradiction:
    """A measurement that was left out: ``reason`` is a short code, ``detail`` a sentence.

    ``off_mrad`` [mrad] is how far its spot lies from the forecast one, seen from the mirror.
    """

    reason: str
    detail: str
    off_mrad: float


def off_by(heliostat: Heliostat, mount: CalibratedMount, readings: Sequence[Reading]) -> Array:
    """Angles (N,) [rad] between forecast and measured spots, seen from the mirror."""
    motors, suns, spots = (np.array([getattr(one, name) for one in readings]) for name in ("motors", "sun", "spot"))
    centers, directions = mount.light(heliostat, motors, suns, np.array([one.day for one in readings]))
    ways = spots - centers
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(ways - directions, axis=-1) / 2, 0, 1)))


class Reasons:
    """What may explain readings of a calibrated field: its targets, the sun, and its other heliostats."""

    def __init__(
        self,
        heliostats: Mapping[str, Heliostat],
        mounts: Mapping[str, CalibratedMount],
        targets: Mapping[str, TargetPlane],
        latitude_deg: float,
    ) -> None:
        self._heliostats, self._mounts, self._targets = heliostats, mounts, targets
        self._latitude_deg = latitude_deg
        self._measured = [name for name, mount in mounts.items() if len(mount.days)]
        self._chain = Chain.of([heliostats[name] for name in self._measured])
        newest = [mounts[name].parameters.copy() for name in self._measured]
        for name, parameters in zip(self._measured, newest, strict=True):
            parameters[ZEROS] += mounts[name].stepped[-1]
        self._newest = np.array(newest)

    def explain(self, name: str, reading: Reading) -> Contradiction:
        """The likeliest reason why a reading of heliostat ``name`` contradicts its others."""
        heliostat, mount = self._heliostats[name], self._mounts[name]
        try:
            off = float(off_by(heliostat, mount, [reading])[0])
        except ModelError:
            return Contradiction("motors", "its drives cannot stand where its motors are said to be", 1e3 * np.pi)
        fits = {
            (code, detail): float(off_by(heliostat, mount, [other])[0])
            for code, detail, other in _otherwise(reading, self._targets, self._latitude_deg)
        }
        if off > _ANOTHERS:
            fits |= self._of_others(name, reading)
        (code, detail), left = min(fits.items(), key=lambda item: item[1], default=(("", ""), np.inf))
        if left < max(_FITS, _EXPLAINS * off) and left < off / 2:
            return Contradiction(code, f"{detail}, to {1e3 * left:.1f} mrad", 1e3 * off)
        return Contradiction(*_elsewhere(heliostat, mount, reading, self._targets), 1e3 * off)

    def _of_others(self, name: str, reading: Reading) -> dict[tuple[str, str], float]:
        """How well a reading fits those heliostats that it fits best [rad]."""
        count = len(self._measured)
        alike = padded([[reading]] * count)
        apart = residuals(self._chain, alike, self._newest, np.zeros((count, 1, 2)))[0][:, 0]
        found = {}
        for place in np.argsort(np.linalg.norm(apart, axis=-1))[:_TRIED]:
            other = self._measured[place]
            if other == name:
                continue
            try:
                left = float(off_by(self._heliostats[other], self._mounts[other], [reading])[0])
            except ModelError:  # that heliostat's drives cannot stand there
                continue
            found["wrong_heliostat", f"it fits heliostat {other}"] = left
        return found


def _otherwise(
    reading: Reading, targets: Mapping[str, TargetPlane], latitude_deg: float
) -> Iterator[tuple[str, str, Reading]]:
    """Code, detail and what the reading would be, of each reason that lies with it alone."""
    own = targets[reading.target]
    for name, plane in targets.items():
        if name != reading.target:
            spot = plane.to_enu(own.to_plane(reading.spot))
            yield "wrong_target", f"its spot fits on {name} in place of {own.name}", replace(reading, spot=spot)
    for hours in _HOURS:
        sun = later(reading.sun, 60 * hours, latitude_deg)
        way = "later" if hours > 0 else "earlier"
        yield "clock", f"it fits a sun {abs(hours):g} h {way}: check the clock's time zone", replace(reading, sun=sun)


def _elsewhere(
    heliostat: Heliostat, mount: CalibratedMount, reading: Reading, targets: Mapping[str, TargetPlane]
) -> tuple[str, str]:
    """Of a reading that nothing explains: whether its light should have been seen on the target."""
    plane = targets[reading.target]
    centers, directions = mount.light(heliostat, reading.motors[None], reading.sun[None], np.array([reading.day]))
    try:
        point = landed(centers[0], directions[0], plane)
    except ModelError:
        return "motors", "its motors send the light away from the target: check motors and sun"
    apart = float(np.linalg.norm(point - reading.spot))
    if plane.holds(point):
        return "foreign_spot", f"its light should lie {apart:.2f} m away on the same target: likely a foreign spot"
    return "motors", f"its motors send the light {apart:.1f} m away, off the target: check motors, sun and spot"
