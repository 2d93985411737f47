"""Warnings about predicted surfaces, in addition to the images that they leave unexplained.

Predictions were trained and evaluated on mirrors of one type at up to 300 m (`training.cases`). For
others the error is unknown. Photographs of a mirror with a dark or a displaced facet may be
explained by a surface, but not by a likely one.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.images import FLUX_SIZE
from model.mirror_kind import MirrorKind
from model.observation import Observation, common_side
from model.plant import Heliostat
from model.prior import SurfacePrior
from model.surface import canting_rises

Array = NDArray[np.float64]

MAX_DISTANCE = 320.0
"""Distance [m] of a target up to which predictions have been evaluated."""

RIM, MAX_RIM_SHARE = 2, 0.05
"""Width [px] of a flux image's rim, and the share of light in it that means much spillage.

At 300 m 0.045 of a sharp mirror's light is in the rim, at 400 m 0.067.
"""

MAX_SATURATED_SHARE = 0.5
"""Saturated share of a spot's brighter half above which little but its rim is measured."""

MAX_CANTING = 3.2
"""Standard deviations of a facet's canting; of the measured mirrors one reaches 3.1, AA39 4.3."""

MAX_DIMMING, MIN_SIGNIFICANCE = 0.3, 5.0
"""Share of a facet's light that may be missing, and the standard deviations of a significant
difference.

For photographs of good mirrors the share is 0.13 or less, at 3.5 standard deviations.
"""


def geometry_warnings(heliostat: Heliostat, observations: Sequence[Observation]) -> list[str]:
    """Warnings about distances and images beyond those of the evaluation."""
    warnings = []
    distance = max(
        float(np.linalg.norm(o.target.center - heliostat.position)) for o in observations
    )
    if distance > MAX_DISTANCE:
        warnings.append(
            f"the target is {distance:.0f} m away; predictions have been evaluated up to"
            f" {MAX_DISTANCE:.0f} m"
        )
    if has_excess_spillage(observations):
        warnings.append("the spots are larger than the window of their flux images")
    if np.median([o.clipped_share for o in observations]) > MAX_SATURATED_SHARE:
        warnings.append(
            "most photographs are saturated: little but the rim of their spots is measured"
        )
    return warnings


def network_warnings(
    heliostat: Heliostat, observations: Sequence[Observation], kind: MirrorKind
) -> list[str]:
    """Warnings about facets and images of other sizes than those of the network's training.

    Refinement accepts all sizes.
    """
    warnings = []
    if not kind.has_facets_of(heliostat):
        width, height = 2 * heliostat.facet_frames.half_sizes.mean(axis=0)
        trained = " m x ".join(f"{2 * half:.4g}" for half in kind.half_sizes.mean(axis=0))
        warnings.append(
            f"the facets of {width:.2f} m x {height:.2f} m differ in size from those that"
            f" the network was trained on ({trained} m)"
        )
    side = common_side(observations)
    if side not in kind.windows:
        trained = ", ".join(f"{window:g}" for window in kind.windows)
        warnings.append(
            f"the spots fill a window of {side:g} m; the network was trained on {trained} m"
        )
    return warnings


def canting_warnings(prior: SurfacePrior, z: Array) -> list[str]:
    """Warnings about facets of heights (F, 8, 8) [m] whose canting is unlikely by the prior.

    The canting is relative to the facets' mean: a tilt of the whole mirror is the mount's. A single
    facet has none.
    """
    if len(z) == 1:
        return []
    mean, std = _usual_canting(prior)
    distances = np.linalg.norm((_relative_canting(z) - mean) / std, axis=-1)
    return [
        f"facet {number} is canted {distance:.2f} standard deviations off; known mirrors are within"
        f" {MAX_CANTING:.2f}"
        for number, distance in enumerate(distances, start=1)
        if distance > MAX_CANTING
    ]


def facet_light_warnings(excess: ArrayLike, std: ArrayLike) -> list[str]:
    """Warnings about dim facets.

    ``excess`` (F,) is each facet's light relative to the mean of the others, minus one.
    """
    return [
        f"facet {number} sends {max(0.0, 1 + share):.0%} of the light of the others; check whether"
        " it is soiled, broken or covered"
        for number, (share, sigma) in enumerate(
            zip(np.asarray(excess), np.asarray(std), strict=True), start=1
        )
        if share < -MAX_DIMMING and share < -MIN_SIGNIFICANCE * sigma
    ]


def has_excess_spillage(observations: Sequence[Observation]) -> bool:
    """Whether the rims of most images hold so much light that much is outside of the window."""
    return bool(np.median([_rim_share(o.flux) for o in observations]) > MAX_RIM_SHARE)


def _rim_share(flux: NDArray[np.floating]) -> float:
    inner = slice(RIM, FLUX_SIZE - RIM)
    return float(1 - flux[inner, inner].sum() / flux.sum())


def _relative_canting(z: Array) -> Array:
    """`canting_rises` (..., F, 2) [m] of heights (..., F, I, J) [m], minus the facets' mean."""
    rises = canting_rises(z)
    return np.asarray(rises - rises.mean(axis=-2, keepdims=True))


class _CantingPrior(NamedTuple):
    """Mean and standard deviation, each (F, 2) [m], of relative canting by a prior."""

    mean: Array
    std: Array


@lru_cache(maxsize=4)
def _usual_canting(prior: SurfacePrior) -> _CantingPrior:
    std = np.sqrt((_relative_canting(prior.basis) ** 2).sum(axis=0))
    return _CantingPrior(_relative_canting(prior.mean), std)
