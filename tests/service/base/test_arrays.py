"""Values that may be missing."""

import math

import numpy as np
import pytest

from service.base.arrays import pair_or_none, to_json_value


@pytest.mark.parametrize(
    ("first", "second", "pair"),
    [(1.0, 0.0, (1.0, 0.0)), (None, 0.0, None), (1.0, None, None), (None, None, None)],
)
def test_a_pair_lacks_nothing(first: float | None, second: float | None, pair: object):
    assert pair_or_none(first, second) == pair


def test_json_has_no_other_types():
    given = {1: np.array([1.0, np.nan]), "deep": [np.int64(3), (math.inf, "a")]}
    assert to_json_value(given) == {"1": [1.0, None], "deep": [3, [None, "a"]]}
