"""Test cases: mirrors with known surfaces, placed in the field and photographed.

The cases follow the paper (Lewen et al. 2024). Slant distances are up to 300 m, and azimuths within
45 degrees of north. The images are on one calibration target. Forecasts use new suns, on that
target and on a plane 18 m to its west and 15 m above it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.network.architecture import MAX_IMAGES
from model.observation import Observation
from model.plant import Heliostat, TargetPlane
from training.render import CleanCamera, RealCamera, SceneSampler, observe, places

Array = NDArray[np.float64]

NEW_SUNS = 4
"""Suns of the forecasts of a case; no image of the prediction has one of them."""

MAX_DISTANCE = 300.0
"""Largest distance [m]."""

MAX_AZIMUTH = 45.0
"""Largest azimuth east or west of north, seen from the tower [deg]."""

SOURCE = TargetPlane(
    "source", np.array([0.0, -3.2, 35.9]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.6, 7.2
)
"""Approximately Juelich's solar_tower_juelich_lower."""

ELSEWHERE = TargetPlane(
    "elsewhere", SOURCE.center + [-18.0, 0.0, 15.0], SOURCE.normal, SOURCE.up, 8.6, 7.2
)
"""Approximately Juelich's multi_focus_tower."""


@dataclass(frozen=True, eq=False)
class Case:
    """One heliostat with a known surface.

    Attributes
    ----------
    surface : str
        Name of its measured surface.
    heliostat : Heliostat
    truth : (4, 8, 8) [m]
    observations : list of Observation
        `MAX_IMAGES` images to predict from.
    forecasts : list of Observation
        `NEW_SUNS` on the source target, then the same on `ELSEWHERE`; without images.
    """

    surface: str
    heliostat: Heliostat
    truth: Array
    observations: list[Observation]
    forecasts: list[Observation]

    @property
    def distance(self) -> float:
        """Distance from the mirror to the source target [m]."""
        return float(np.linalg.norm(self.heliostat.position - SOURCE.center))


def make_cases(
    surfaces: Array,
    names: Sequence[str],
    field: Array,
    count: int,
    camera: RealCamera | CleanCamera,
    seed: int = 100,
) -> list[Case]:
    """Make ``count`` cases of surfaces (N, 4, 8, 8) [m] at random positions of a field.

    The surfaces are used in turn; ``field`` is (M, 3) [m]. A case depends only on the seed and its
    number, so that the first cases are the same for any count.
    """
    near = field[within_reach(field)]
    return [
        _case(
            names[i % len(names)],
            surfaces[i % len(names)],
            near,
            camera,
            np.random.default_rng((seed, i)),
        )
        for i in range(count)
    ]


def _case(
    name: str,
    truth: Array,
    field: Array,
    camera: RealCamera | CleanCamera,
    rng: np.random.Generator,
) -> Case:
    scenes = SceneSampler()
    (heliostat,) = scenes.heliostats(field[rng.integers(len(field), size=1)], rng)
    suns = scenes.suns(MAX_IMAGES + NEW_SUNS, rng)
    setups = places(suns[:MAX_IMAGES], [SOURCE] * MAX_IMAGES)
    new = places(np.tile(suns[MAX_IMAGES:], (2, 1)), [SOURCE] * NEW_SUNS + [ELSEWHERE] * NEW_SUNS)
    return Case(name, heliostat, truth, observe(heliostat, truth, setups, camera, rng), new)


def within_reach(field: Array) -> NDArray[np.bool_]:
    """Mask of the positions (N, 3) [m] within the paper's distances and azimuths."""
    azimuth = np.degrees(np.arctan2(field[:, 0], field[:, 1]))
    distance = np.linalg.norm(field - SOURCE.center, axis=1)
    return np.asarray((np.abs(azimuth) <= MAX_AZIMUTH) & (distance <= MAX_DISTANCE))
