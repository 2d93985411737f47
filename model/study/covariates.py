"""What the error of photographs may go with: where sun and heliostat stood, and when."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.frames import solar_time
from model.study.flux_images import FluxImage

Array = NDArray[np.float64]

DAY = 86400.0


@dataclass(frozen=True)
class Covariate:
    """A quantity that each photograph has: ``of`` a photograph and the plant's latitude [deg], None if unknown."""

    name: str
    unit: str
    of: Callable[[FluxImage, float], float | None]


def _recorded_day(flux_image: FluxImage, _: float) -> float | None:
    return None if flux_image.taken_at is None else flux_image.taken_at.timestamp() / DAY


RECORDED_TIME = Covariate("recorded time", "days since the first", _recorded_day)

COVARIATES = (
    Covariate("sun elevation", "deg", lambda p, _: p.elevation_deg),
    Covariate("slant range", "m", lambda p, _: p.slant_range),
    Covariate("solar time", "h", lambda p, latitude: float(solar_time(p.setup.sun, latitude))),
    RECORDED_TIME,
    Covariate("sun azimuth", "deg, east positive", lambda p, _: p.azimuth_deg),
    Covariate("height of the target", "m", lambda p, _: float(p.setup.plane.center[2])),
)


def covariates_of(flux_images: Sequence[FluxImage], latitude_deg: float) -> dict[Covariate, Array]:
    """Values (N,) of each of `COVARIATES` that is known of all photographs; recorded time begins with the first."""
    found: dict[Covariate, Array] = {}
    for covariate in COVARIATES:
        values = [value for p in flux_images if (value := covariate.of(p, latitude_deg)) is not None]
        if len(values) == len(flux_images):
            found[covariate] = np.array(values)
    if RECORDED_TIME in found:
        found[RECORDED_TIME] -= found[RECORDED_TIME].min()
    return found
