"""Find the likeliest reason why a measurement contradicts all others of its heliostat.

Each reason changes the measurement: another target, another sun, another heliostat. A reason is
likely if the changed measurement fits the mount.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from model.errors import ModelError
from model.plant import Heliostat, TargetPlane
from model.pointing.kinematics import ZEROS, KinematicChain, residuals
from model.pointing.mounts import CalibratedMount
from model.pointing.readings import Reading, pad_readings
from model.pointing.spots import intersect_plane, reflect_rays
from model.site import Site

Array = NDArray[np.float64]

# Largest error with a reason [rad], or its largest share of the error without.
_FITS = 3e-3
_EXPLAINS = 0.15

OTHER_SPOT = 10e-3
"""Smallest error [rad] at which other heliostats are tried."""

# Number of other heliostats whose drives are looked at.
_N_OTHERS = 4

# Time zones and summer time differ by whole or half hours.
_HOURS = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0)


@dataclass(frozen=True)
class Contradiction:
    """An excluded measurement: ``reason`` is a short code, ``detail`` a sentence.

    ``error_mrad`` [mrad] is the angle between its spot and the forecast one, from the mirror.
    ``other`` is the heliostat that it fits, where that is the reason.
    """

    reason: str
    detail: str
    error_mrad: float
    other: str | None = None


def pointing_error(
    heliostat: Heliostat, mount: CalibratedMount, readings: Sequence[Reading]
) -> Array:
    """Return the angles (N,) [rad] between forecast and measured spots, from the mirror."""
    motors, suns, spots = (
        np.array([getattr(reading, name) for reading in readings])
        for name in ("motors", "sun", "spot")
    )
    centers, directions = reflect_rays(
        mount, heliostat, motors, suns, np.array([reading.day for reading in readings])
    )
    to_spots = spots - centers
    to_spots /= np.linalg.norm(to_spots, axis=-1, keepdims=True)
    return np.asarray(
        2 * np.arcsin(np.clip(np.linalg.norm(to_spots - directions, axis=-1) / 2, 0, 1))
    )


class ContradictionClassifier:
    """Finds reasons for contradictory readings: other targets, suns or heliostats of the field."""

    def __init__(
        self,
        heliostats: Mapping[str, Heliostat],
        mounts: Mapping[str, CalibratedMount],
        targets: Mapping[str, TargetPlane],
        site: Site,
    ) -> None:
        self._heliostats, self._mounts, self._targets = heliostats, mounts, targets
        self._site = site
        self._measured = [name for name, mount in mounts.items() if len(mount.days)]
        self._chain = KinematicChain.of([heliostats[name] for name in self._measured])
        newest = [mounts[name].parameters.copy() for name in self._measured]
        for name, parameters in zip(self._measured, newest, strict=True):
            parameters[ZEROS] += mounts[name].stepped[-1]
        self._newest = np.array(newest)

    def classify(self, name: str, reading: Reading) -> Contradiction:
        """Return the likeliest reason why a reading of heliostat ``name`` is contradictory."""
        heliostat, mount = self._heliostats[name], self._mounts[name]
        try:
            error = float(pointing_error(heliostat, mount, [reading])[0])
        except ModelError:
            return Contradiction(
                "motors", "its drives cannot reach the reported motor positions", 1e3 * np.pi
            )
        fits: list[tuple[float, str, str, str | None]] = [
            (float(pointing_error(heliostat, mount, [changed])[0]), code, detail, None)
            for code, detail, changed in _alternatives(reading, self._targets, self._site)
        ]
        if error > OTHER_SPOT:
            fits += [
                (left, "wrong_heliostat", f"it fits heliostat {other}", other)
                for other, left in self._other_heliostats(name, reading).items()
            ]
        left, code, detail, other = min(fits, default=(np.inf, "", "", None), key=itemgetter(0))
        if left < max(_FITS, _EXPLAINS * error) and left < error / 2:
            return Contradiction(code, f"{detail}, to {1e3 * left:.1f} mrad", 1e3 * error, other)
        return _unexplained(heliostat, mount, reading, self._targets, 1e3 * error)

    def _other_heliostats(self, name: str, reading: Reading) -> dict[str, float]:
        """Return the errors [rad] of a reading at the heliostats that it fits best, by name."""
        count = len(self._measured)
        copies = pad_readings([[reading]] * count)
        apart = residuals(self._chain, copies, self._newest, np.zeros((count, 1, 2))).values[:, 0]
        found = dict[str, float]()
        for place in np.argsort(np.linalg.norm(apart, axis=-1))[:_N_OTHERS]:
            other = self._measured[place]
            if other == name:
                continue
            try:
                left = float(
                    pointing_error(self._heliostats[other], self._mounts[other], [reading])[0]
                )
            except ModelError:  # the drives of that heliostat cannot get there
                continue
            found[other] = left
        return found


def _alternatives(
    reading: Reading, targets: Mapping[str, TargetPlane], site: Site
) -> Iterator[tuple[str, str, Reading]]:
    """Iterate over code, detail and changed reading of each reason within one heliostat."""
    target = targets[reading.target]
    for name, plane in targets.items():
        if name != reading.target:
            spot = plane.to_enu(target.to_plane(reading.spot))
            yield (
                "wrong_target",
                f"its spot fits on {name} in place of {target.name}",
                replace(reading, spot=spot),
            )
    for hours in _HOURS:
        sun = site.advance_sun(reading.sun, 60 * hours)
        direction = "later" if hours > 0 else "earlier"
        yield (
            "clock",
            f"it fits a sun {abs(hours):g} h {direction}: check the clock's time zone",
            replace(reading, sun=sun),
        )


def _unexplained(
    heliostat: Heliostat,
    mount: CalibratedMount,
    reading: Reading,
    targets: Mapping[str, TargetPlane],
    error_mrad: float,
) -> Contradiction:
    """Describe a reading without a likely reason, and where its light should have been."""
    plane = targets[reading.target]
    centers, directions = reflect_rays(
        mount, heliostat, reading.motors[None], reading.sun[None], np.array([reading.day])
    )
    try:
        point = intersect_plane(centers[0], directions[0], plane)
    except ModelError:
        detail = "its motors point the light away from the target: check motors and sun"
        return Contradiction("motors", detail, error_mrad)
    apart = float(np.linalg.norm(point - reading.spot))
    if plane.contains(point):
        detail = f"its light should be {apart:.2f} m away on the same target: likely a foreign spot"
        return Contradiction("foreign_spot", detail, error_mrad)
    detail = (
        f"its motors point the light {apart:.1f} m away, off the target: check motors, sun and spot"
    )
    return Contradiction("motors", detail, error_mrad)
