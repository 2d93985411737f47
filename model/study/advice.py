"""Suggest photographs that distinguish effects which a study could not.

In such photographs one effect changes and the other does not. The suggestions are derived from the
factors that each effect scales with. Its class names them, and its file explains them.
"""

from model.effects.base import Factor
from model.effects.catalogue import CATALOGUE

PHOTOGRAPHS: dict[Factor, str] = {
    "distance": "a near and a far heliostat under the same sun",
    "heliostat": "several heliostats within the same hour",
    "elevation": "the same heliostat under a high and a low sun",
    "side": "heliostats east and west of the tower within the same hour",
    "roll": "the same heliostat in the early morning, at noon and in the late afternoon",
    "weather": "the same heliostats on another day of other haze and wind",
    "camera": "a spot on another target or with another camera and exposure",
}
"""Factors, each with the photographs that vary it, the most informative first."""

SAME_SCALING = (
    "a lamp or an edge of known shape on the target, for both effects are the camera's own"
)

MOST = 2


def photographs_to_distinguish(first: str, second: str) -> str:
    """The photographs that would distinguish two effects of the catalogue."""
    differ = CATALOGUE[first].scales_with ^ CATALOGUE[second].scales_with
    wanted = [photographs for factor, photographs in PHOTOGRAPHS.items() if factor in differ]
    return ", and ".join(wanted[:MOST]) or SAME_SCALING
