"""What an image model keeps of the changes of an image."""

import numpy as np
import pytest

from model.refinement.image_model import _strongest


@pytest.mark.parametrize("count", [1, 3])
def test_the_strongest_combinations_are_those_of_the_singular_values(count: int) -> None:
    rng = np.random.default_rng(4)
    left, _ = np.linalg.qr(rng.normal(size=(20, 20)))
    right, _ = np.linalg.qr(rng.normal(size=(24, 20)))
    white = (left * 10.0 ** -np.arange(20) @ right.T).reshape(20, 4, 6)
    found = _strongest(white, count)
    assert found.shape == (count, 20)
    assert found @ found.T == pytest.approx(np.eye(count), abs=1e-9)
    assert abs(np.diag(found @ left[:, :count])) == pytest.approx(np.ones(count))
