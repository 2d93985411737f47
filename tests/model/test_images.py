import numpy as np
import pytest
import torch

from model.images import binned, normalized


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_numpy_and_torch_alike(kind):
    images = kind(np.random.default_rng(1).uniform(size=(2, 3, 8, 8)))
    np.testing.assert_allclose(normalized(images).sum((-2, -1)), 100.0)
    coarse = binned(images, 4)
    assert coarse.shape == (2, 3, 4, 4)
    np.testing.assert_allclose(coarse[1, 2, 3, 0], images[1, 2, 6:, :2].sum())


def test_a_black_image_stays_black():
    assert not normalized(np.zeros((4, 4))).any()
