"""Covariates of photographs and forecasts: positions of sun and heliostat, and time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.frames import solar_time, sun_angles
from model.setup import Setup
from model.site import Site

Array = NDArray[np.float64]

DAY = 86400.0

FIRST_DAY = datetime(2000, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class Covariate:
    """A quantity ``of`` a setup at the plant's site; None if it is unknown."""

    name: str
    unit: str
    of: Callable[[Setup, Site], float | None]

    @property
    def key(self) -> str:
        """The name in a report."""
        return self.name.replace(",", "").replace(" ", "_")

    def per(self, center: float, limits: tuple[float, float]) -> dict[str, Any]:
        """What a coefficient is per: the covariate less its ``center``, in its unit.

        Beyond the ``limits``, which photographs cover, the covariate counts as the limit.
        """
        return {
            "covariate": self.key,
            "unit": self.unit,
            "center": round(center, 4),
            "limits": [round(limit, 4) for limit in limits],
        }


def _recorded_day(setup: Setup, _: Site) -> float | None:
    at = setup.taken_at
    return None if at is None else (at - FIRST_DAY).total_seconds() / DAY


def slant_range(setup: Setup) -> float:
    """Distance [m] from the heliostat to its target."""
    return float(np.linalg.norm(setup.heliostat.position - setup.plane.center))


RECORDED_TIME = Covariate("recorded time", "days since 2000", _recorded_day)

COVARIATES = (
    Covariate("sun elevation", "deg", lambda s, _: float(sun_angles(s.sun)[1])),
    Covariate("slant range", "m", lambda s, _: slant_range(s)),
    Covariate("solar time", "h", lambda s, site: float(solar_time(s.sun, site.latitude_deg))),
    RECORDED_TIME,
    Covariate("sun azimuth", "deg, from north", lambda s, _: float(sun_angles(s.sun)[0])),
    Covariate("height of the target", "m", lambda s, _: float(s.plane.center[2])),
    Covariate("temperature of the air", "°C", lambda s, _: s.temperature_c),
)


def _outgoing(setup: Setup) -> Array:
    """Unit vector (3,) from the heliostat to its spot."""
    to_spot = setup.goal - setup.heliostat.position
    return np.asarray(to_spot / np.linalg.norm(to_spot))


def _facing(setup: Setup, axis: int) -> float:
    """Angle [deg] by which the mirror faces an axis of ENU."""
    normal = setup.sun + _outgoing(setup)
    return float(np.degrees(np.arcsin(normal[axis] / np.linalg.norm(normal))))


def _incidence(setup: Setup) -> float:
    """Angle [deg] between the sun and the mirror's normal: half of that to the target."""
    return float(np.degrees(np.arccos(_outgoing(setup) @ setup.sun)) / 2)


def _on_target(setup: Setup, axis: int) -> float:
    """Place [m] of the light on the target, right or up of its centre."""
    return float((setup.goal - setup.plane.center) @ setup.plane.axes[axis])


SCALINGS = (
    *COVARIATES,
    Covariate("incidence", "deg", lambda s, _: _incidence(s)),
    Covariate("mirror to the east", "deg", lambda s, _: _facing(s, 0)),
    Covariate("mirror upwards", "deg", lambda s, _: _facing(s, 2)),
    Covariate("place on the target, right", "m", lambda s, _: _on_target(s, 0)),
    Covariate("place on the target, up", "m", lambda s, _: _on_target(s, 1)),
)
"""What generic terms may scale with (`model.study.discrepancy`)."""


def covariates_of(
    setups: Sequence[Setup], site: Site, among: Sequence[Covariate] = COVARIATES
) -> dict[Covariate, Array]:
    """Values (N,) of each covariate that is known of all setups."""
    found: dict[Covariate, Array] = {}
    for covariate in among:
        values = [value for s in setups if (value := covariate.of(s, site)) is not None]
        if len(values) == len(setups):
            found[covariate] = np.array(values)
    return found
