"""Which of two surfaces is today's, by gains of accuracy on photographs and by what speaks for each before."""

import numpy as np
import pytest
from numpy.typing import NDArray

from service.twin.judging import LEAST_UNSEEN, Standing, decide, standing_of

MEASURED, REFINED, NETWORK = (standing_of(source, None) for source in ("measured", "refined", "network"))
DOUBTED = standing_of("refined", False)
OUTDATED = standing_of("refined", True, is_outdated=True)
# Sure gains and losses, and what chance makes of the same mirror: the mean is above zero, its interval holds zero.
BETTER, WORSE = np.full(6, 0.05), np.full(6, -0.05)
CHANCE = np.array([0.06, -0.05, 0.04, -0.03, 0.05, -0.02])


@pytest.mark.parametrize(
    ("gains", "unseen", "stood", "comes", "taken"),
    [
        (BETTER, 6, MEASURED, REFINED, True),
        (BETTER, 6, MEASURED, DOUBTED, False),  # only somebody may
        (BETTER, 6, REFINED, DOUBTED, True),
        (BETTER, LEAST_UNSEEN - 1, MEASURED, REFINED, False),
        (BETTER, 0, MEASURED, REFINED, False),
        (CHANCE, 6, MEASURED, REFINED, False),
        (CHANCE, 6, REFINED, NETWORK, False),
        (CHANCE, 6, REFINED, REFINED, True),  # of equals the newer one
        (-CHANCE, 6, REFINED, REFINED, False),
        (-CHANCE, 6, NETWORK, REFINED, True),
        (WORSE, 6, NETWORK, REFINED, False),
        (WORSE, 0, NETWORK, REFINED, True),  # both were made to fit these photographs, or one was
        (WORSE, 0, OUTDATED, NETWORK, True),
        (WORSE, 0, DOUBTED, NETWORK, True),
        (WORSE, 0, NETWORK, NETWORK, False),
    ],
)
def test_what_decides(gains: NDArray[np.float64], unseen: int, stood: Standing, comes: Standing, taken: bool):
    decided, reason = decide(gains[: unseen or None], unseen, stood, comes, "version 1")
    assert decided is taken
    assert "version 1" in reason
    assert len(reason) <= 200  # what the store keeps
