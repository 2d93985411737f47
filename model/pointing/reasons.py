"""Why a measurement contradicts all others of its heliostat: what would have to be true for it to fit.

Each reason says what the measurement would be if it were so, another target or another sun; the mount, or that of
another heliostat, says whether it then fits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.errors import ModelError
from model.mount import rotation
from model.plant import Heliostat, TargetPlane
from model.pointing.mounts import CalibratedMount, landed
from model.pointing.readings import Reading

Array = NDArray[np.float64]

# What a reason leaves must be less than this [rad], or than this share of what it explains.
_FITS = 3e-3
_EXPLAINS = 0.15

# Clocks are set to whole hours of other zones, or of summer.
_HOURS = (-2, -1, 1, 2)


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


def explain(
    name: str,
    reading: Reading,
    heliostats: Mapping[str, Heliostat],
    mounts: Mapping[str, CalibratedMount],
    targets: Mapping[str, TargetPlane],
    latitude_deg: float,
) -> Contradiction:
    """The likeliest reason why a reading of heliostat ``name`` contradicts the others."""
    try:
        off = float(off_by(heliostats[name], mounts[name], [reading])[0])
    except ModelError:
        return Contradiction("motors", "its drives cannot stand where its motors are said to be", 1e3 * np.pi)
    fits = {
        (code, detail): float(off_by(heliostats[name], mounts[name], [other])[0])
        for code, detail, other in _otherwise(reading, targets, latitude_deg)
    }
    for other, mount in mounts.items():
        if other != name and len(mount.days):
            try:
                left = float(off_by(heliostats[other], mount, [reading])[0])
            except ModelError:  # that heliostat's drives cannot stand there
                continue
            fits["wrong_heliostat", f"it fits heliostat {other}"] = left
    (code, detail), left = min(fits.items(), key=lambda item: item[1], default=(("", ""), np.inf))
    if left < max(_FITS, _EXPLAINS * off) and left < off / 2:
        return Contradiction(code, f"{detail}, to {1e3 * left:.1f} mrad", 1e3 * off)
    return Contradiction(*_elsewhere(heliostats[name], mounts[name], reading, targets), 1e3 * off)


def _otherwise(
    reading: Reading, targets: Mapping[str, TargetPlane], latitude_deg: float
) -> Iterator[tuple[str, str, Reading]]:
    """Code, detail and what the reading would be, of each reason that lies with it alone."""
    own = targets[reading.target]
    for name, plane in targets.items():
        if name != reading.target:
            spot = plane.to_enu(own.to_plane(reading.spot))
            yield "wrong_target", f"its spot fits on {name} in place of {own.name}", replace(reading, spot=spot)
    pole = np.array([0.0, np.cos(np.radians(latitude_deg)), np.sin(np.radians(latitude_deg))])
    for hours in _HOURS:
        # The sun turns about the pole by 15 degrees an hour, clockwise seen from above.
        sun = rotation(pole, -np.radians(15.0 * hours)) @ reading.sun
        way = "later" if hours > 0 else "earlier"
        yield "clock", f"it fits a sun {abs(hours)} h {way}: check the clock's time zone", replace(reading, sun=sun)


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
