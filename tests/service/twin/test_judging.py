"""Which of two surfaces is active, by accuracy gains on photographs and by precedence."""

import numpy as np
import pytest
from numpy.typing import NDArray

from service.store.decisions import Justification
from service.store.surface_versions import NewSurface, Trust
from service.twin.surfaces.evaluation import (
    MIN_HELD_OUT,
    Evaluation,
    JudgedBy,
    Precedence,
    begin_epoch_or_reject,
    precedence_of,
    promote_or_reject,
    promote_or_reject_first,
)
from service.twin.surfaces.prediction import _evaluated_first

MEASURED, REFINED, NETWORK = (
    precedence_of(source, None) for source in ("measured", "refined", "network")
)
UNTRUSTED = precedence_of("refined", False)
OUTDATED = precedence_of("refined", True, is_outdated=True)
# Sure gains and losses, and what chance makes of the same mirror: the mean is above zero, its
# interval holds zero.
BETTER, WORSE = np.full(6, 0.05), np.full(6, -0.05)
CHANCE = np.array([0.06, -0.05, 0.04, -0.03, 0.05, -0.02])


@pytest.mark.parametrize(
    ("gains", "unseen", "current", "candidate", "taken"),
    [
        (BETTER, 6, MEASURED, REFINED, True),
        (BETTER, 6, MEASURED, UNTRUSTED, False),  # only somebody may
        (BETTER, 6, REFINED, UNTRUSTED, True),
        (BETTER, MIN_HELD_OUT - 1, MEASURED, REFINED, False),
        (BETTER, 0, MEASURED, REFINED, False),
        (CHANCE, 6, MEASURED, REFINED, False),
        (CHANCE, 6, REFINED, NETWORK, False),
        (CHANCE, 6, REFINED, REFINED, True),  # of equals the newer one
        (-CHANCE, 6, REFINED, REFINED, False),
        (-CHANCE, 6, NETWORK, REFINED, True),
        (WORSE, 6, NETWORK, REFINED, False),
        (WORSE, 0, NETWORK, REFINED, True),  # both were made to fit these photographs, or one was
        (WORSE, 0, OUTDATED, NETWORK, True),
        (WORSE, 0, UNTRUSTED, NETWORK, True),
        (WORSE, 0, NETWORK, NETWORK, False),
    ],
)
def test_what_decides(
    gains: NDArray[np.float64], unseen: int, current: Precedence, candidate: Precedence, taken: bool
):
    judges = gains[: unseen or None]
    decided, reason = promote_or_reject(judges, JudgedBy(unseen), current, candidate, "version 1")
    assert decided is taken
    assert "version 1" in reason
    assert len(reason) <= 200  # what the store keeps
    if unseen:
        by_parts = JudgedBy(unseen, by_parts=True)
        decided, reason = promote_or_reject(judges, by_parts, current, candidate, "version 1")
        assert decided is taken
        assert "neither has seen" not in reason or unseen < MIN_HELD_OUT
        assert len(reason) <= 200


@pytest.mark.parametrize(
    ("gains", "unseen", "candidate", "taken"),
    [
        (BETTER, 6, NETWORK, True),
        (BETTER[:5], 5, NETWORK, True),
        (BETTER[:4], 4, REFINED, False),  # too few to confirm it
        (CHANCE, 6, REFINED, False),  # no change
        (WORSE, 6, REFINED, False),
        (BETTER, 6, UNTRUSTED, True),
    ],
)
def test_an_epoch_begins_if_its_photographs_show_it(
    gains: NDArray[np.float64], unseen: int, candidate: Precedence, taken: bool
):
    by = JudgedBy(unseen, by_parts=True)
    decided, reason = begin_epoch_or_reject(gains, by, NETWORK, candidate, "version 12")
    assert decided is taken
    assert len(reason) <= 200
    if unseen < MIN_HELD_OUT:
        assert "1 more of the changed mirror" in reason


@pytest.mark.parametrize(
    ("gains", "unseen", "is_trusted", "taken"),
    [
        (BETTER, 6, False, True),
        (CHANCE, 6, False, False),  # in the mean better, but not by more than chance
        (WORSE, 6, False, False),
        (CHANCE, MIN_HELD_OUT - 1, False, True),
        (-CHANCE, MIN_HELD_OUT - 1, False, False),
        (np.array([0.05]), 0, False, True),
        (np.array([-0.05]), 0, False, False),
        (np.zeros(6), 0, False, False),
        (WORSE, 6, True, False),
        (CHANCE, 6, True, True),
        (WORSE, 0, True, True),
        (np.zeros(1), 0, True, True),
    ],
)
def test_a_first_surface_is_compared_with_the_ideal_mirror(
    gains: NDArray[np.float64], unseen: int, is_trusted: bool, taken: bool
):
    decided, reason = promote_or_reject_first(gains, JudgedBy(unseen), is_trusted)
    assert decided is taken
    assert "the ideal mirror" in reason
    used = len(gains) - unseen
    assert (
        "that it was not made from" in reason
        if unseen >= MIN_HELD_OUT
        else f"{used} of which" in reason
    )
    assert len(reason) <= 200


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (0.926, 0.874, "accuracy 93% on photographs, this surface 87%"),
        (0.0, 0.0, "accuracy 0% on photographs, this surface 0%"),
    ],
)
def test_the_warning_of_a_first_candidate_has_both_accuracies(
    before: float, after: float, said: str
):
    nothing = np.zeros((1, 8, 8))
    new = NewSurface("network", nothing, nothing, nothing, trust=Trust((), (), 1.0, 40.0))
    rejected = Evaluation(None, False, Justification("a reason", before, after, 2))
    found = _evaluated_first(None, new, rejected)
    assert found.new.trust is not None
    assert said in found.new.trust.warnings[-1]
