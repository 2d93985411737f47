"""What speaks against a predicted surface beside the photographs that it leaves unexplained, in sentences.

Predictions were learnt from and judged on mirrors of one kind at up to 300 m (`training.cases`): of others the error is
unknown. A mirror with a facet that sends no light, or with one that was knocked, is explained by a surface, but not
by a likely one.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.images import FLUX_SIZE, FLUX_WINDOW
from model.observation import Observation, common_side
from model.plant import Heliostat
from model.prior import MEASURED_FACET, SurfacePrior, of_measured_kind
from model.surface import canting_rises

Array = NDArray[np.float64]

FARTHEST = 320.0
"""Distance [m] of a target up to which predictions have been judged."""

RIM, RIM_SHARE = 2, 0.05
"""Pixels of a flux image's rim, and the share of light in it from which on much must lie outside the window.

At 300 m 0.045 of a sharp mirror's light lies there, at 400 m 0.067.
"""

CLIPPED = 0.5
"""Share of a spot's brighter half beyond the camera's range from which on a photograph shows little more than a rim."""

UNLIKE_FACET = 3.2
"""Deviations by which a facet may be canted from the others': of the measured mirrors one reaches 3.1, AA39 4.3."""

DARK, CERTAIN = 0.3, 5.0
"""Share by which a facet's light falls short of the others', and in standard deviations, from which on it is told.

Of good mirrors' photographs the share is 0.13 at most, at 3.5 deviations.
"""


def of_the_situation(heliostat: Heliostat, observations: Sequence[Observation]) -> list[str]:
    """Where distance or images are not what predictions have been judged by."""
    doubts = []
    farthest = max(float(np.linalg.norm(o.target.center - heliostat.position)) for o in observations)
    if farthest > FARTHEST:
        doubts.append(f"its target is {farthest:.0f} m away; predictions have been judged up to {FARTHEST:.0f} m")
    if spilt(observations):
        doubts.append("its spots are larger than the window of their flux images")
    if np.median([o.clipped_share for o in observations]) > CLIPPED:
        doubts.append("most of its photographs show little but their rim: the rest lies beyond the camera's range")
    return doubts


def of_the_network(heliostat: Heliostat, observations: Sequence[Observation]) -> list[str]:
    """Where facets or images are not of the sizes that networks learn from; a refinement takes all."""
    doubts = []
    _, _, half_sizes = heliostat.facet_frames
    if not of_measured_kind(half_sizes):
        width, height = 2 * half_sizes.mean(axis=0)
        known = " m x ".join(str(2 * half) for half in MEASURED_FACET)
        doubts.append(
            f"its facets of {width:.2f} m x {height:.2f} m are not of the size that the network learnt from ({known} m)"
        )
    side = common_side(observations)
    if side != FLUX_WINDOW:
        doubts.append(f"its spots fill a window of {side:g} m; the network learnt from {FLUX_WINDOW:g} m")
    return doubts


def of_canting(prior: SurfacePrior, z: Array) -> list[str]:
    """Facets that are canted as no mirror of the known kind has them, of heights (4, 8, 8) [m].

    Against the mean of the facets: a tilt of the whole mirror is the mount's.
    """
    usual, spread = _usual_canting(prior)
    distances = np.linalg.norm((_relative_canting(z) - usual) / spread, axis=-1)
    return [
        f"facet {number} is canted {distance:.1f} standard deviations off; {UNLIKE_FACET} are usual at most"
        for number, distance in enumerate(distances, start=1)
        if distance > UNLIKE_FACET
    ]


def of_facet_light(light: ArrayLike, deviation: ArrayLike) -> list[str]:
    """Facets that send less than the others, of each one's ``light`` (F,) [1] over the others' mean, less one."""
    return [
        f"facet {number} seems to send {max(0.0, 1 + share):.0%} of the light that the others do; look whether it is "
        "soiled, broken or covered"
        for number, (share, sigma) in enumerate(zip(np.asarray(light), np.asarray(deviation), strict=True), start=1)
        if share < -DARK and share < -CERTAIN * sigma
    ]


def spilt(observations: Sequence[Observation]) -> bool:
    """Whether so much light lies on the rims of most images that much must lie outside of them."""
    return bool(np.median([_rim_share(o.flux) for o in observations]) > RIM_SHARE)


def _rim_share(flux: NDArray[np.floating]) -> float:
    inner = slice(RIM, FLUX_SIZE - RIM)
    return float(1 - flux[inner, inner].sum() / flux.sum())


def _relative_canting(z: Array) -> Array:
    """`canting_rises` (..., F, 2) [m] of heights (..., F, I, J) [m], less the facets' mean."""
    rises = canting_rises(z)
    return np.asarray(rises - rises.mean(axis=-2, keepdims=True))


@lru_cache(maxsize=4)
def _usual_canting(prior: SurfacePrior) -> tuple[Array, Array]:
    """Mean and standard deviation (F, 2) [m] of the same, of mirrors of the known kind."""
    spread = np.sqrt((_relative_canting(prior.basis) ** 2).sum(axis=0))
    return _relative_canting(prior.mean), spread
