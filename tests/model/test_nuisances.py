"""Changes of an image by its camera, against the changed image of an analytic spot."""

import numpy as np
import pytest
import torch
from torch import Tensor

from model.nuisances import BACKGROUND, BLACK, BLUR, EXPOSURE, GAMMA, SHIFT, nuisances

SIDE, N, WIDTH = 6.0, 96, 0.6


def spot(up: float = 0.0, right: float = 0.0, width: float = WIDTH) -> Tensor:
    """A Gaussian spot of one unit of light at a place [m] of a window of `SIDE` [m]."""
    places = (torch.arange(N, dtype=torch.float64) + 0.5) * SIDE / N - SIDE / 2
    across = torch.exp(-((places - right) ** 2) / (2 * width**2))
    along = torch.exp(-((places - up) ** 2) / (2 * width**2))
    return along[:, None] * across / (2 * np.pi * width**2)


IMAGE = spot()


@pytest.mark.parametrize(
    ("number", "changed"),
    [
        (0, spot(right=-SHIFT)),
        (1, spot(up=-SHIFT)),
        (2, IMAGE * (1 + EXPOSURE)),
        (3, IMAGE + BACKGROUND * IMAGE.max()),
        (4, spot(width=float(np.hypot(WIDTH, BLUR)))),
    ],
    ids=["right", "up", "exposure", "background", "blur"],
)
def test_a_nuisance_is_the_change_by_one_standard_deviation(number: int, changed: Tensor) -> None:
    expected = changed - IMAGE
    found = nuisances(IMAGE, SIDE)[number]
    assert (found - expected).abs().max() < 0.05 * expected.abs().max()


def test_a_response_changes_no_peak_and_nothing_without_light() -> None:
    found = nuisances(IMAGE, SIDE)[5]
    relative = IMAGE / IMAGE.max()
    expected = IMAGE.max() * (relative ** (1 + GAMMA / 100) - relative) * 100
    assert torch.allclose(found, expected, rtol=0.01, atol=1e-3 * float(IMAGE.max()))
    dark = torch.where(relative > 0.5, IMAGE, 0.0)
    assert not nuisances(dark, SIDE)[5][relative <= 0.5].any()


def test_a_response_follows_the_light_down_to_a_ten_thousandth_of_the_peak() -> None:
    two = torch.zeros(8, 8, dtype=torch.float64)
    two[0, 0], two[4, 4] = 1.0, 1e-3
    assert nuisances(two)[5, 4, 4] == pytest.approx(1e-3 * np.log(1e-3) * GAMMA)


def test_noise_cut_off_at_black_brightens_dark_pixels_only() -> None:
    two = torch.zeros(8, 8, dtype=torch.float64)
    two[0, 0], two[4, 4] = 1.0, BLACK
    changed = nuisances(two)[6]
    assert changed[7, 7] == pytest.approx(BACKGROUND, rel=0.02)
    assert changed[4, 4] == pytest.approx(BACKGROUND / np.e)
    assert changed[0, 0] == pytest.approx(0.0, abs=1e-12)
