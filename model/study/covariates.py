"""Covariates of the error of photographs: positions of sun and heliostat, and time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.frames import solar_time
from model.site import Site
from model.study.flux_images import FluxImage

Array = NDArray[np.float64]

DAY = 86400.0


@dataclass(frozen=True)
class Covariate:
    """A quantity ``of`` a photograph at the plant's site; None if it is unknown."""

    name: str
    unit: str
    of: Callable[[FluxImage, Site], float | None]


def _recorded_day(flux_image: FluxImage, _: Site) -> float | None:
    return None if flux_image.taken_at is None else flux_image.taken_at.timestamp() / DAY


RECORDED_TIME = Covariate("recorded time", "days since the first", _recorded_day)

COVARIATES = (
    Covariate("sun elevation", "deg", lambda p, _: p.elevation_deg),
    Covariate("slant range", "m", lambda p, _: p.slant_range),
    Covariate("solar time", "h", lambda p, site: float(solar_time(p.setup.sun, site.latitude_deg))),
    RECORDED_TIME,
    Covariate("sun azimuth", "deg, from north", lambda p, _: p.azimuth_deg),
    Covariate("height of the target", "m", lambda p, _: float(p.setup.plane.center[2])),
)


def covariates_of(flux_images: Sequence[FluxImage], site: Site) -> dict[Covariate, Array]:
    """Values (N,) of each of `COVARIATES` that is known of all photographs."""
    found: dict[Covariate, Array] = {}
    for covariate in COVARIATES:
        values = [value for p in flux_images if (value := covariate.of(p, site)) is not None]
        if len(values) == len(flux_images):
            found[covariate] = np.array(values)
    if RECORDED_TIME in found:
        found[RECORDED_TIME] -= found[RECORDED_TIME].min()
    return found
