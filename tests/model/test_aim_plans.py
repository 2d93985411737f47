"""The ascent of aims: what too much light costs."""

import pytest
import torch

from model.aiming.plan import _MAX_PRESSURE, _RHO, penalty_of


def test_slope_of_the_penalty_is_the_pressure_up_to_its_greatest() -> None:
    excess = torch.tensor([0.0, 0.05, 0.2, 0.4, 5.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(penalty_of(_RHO * excess).sum(), excess)
    assert slope.tolist() == pytest.approx([0.0, 0.5, 2.0, _MAX_PRESSURE, _MAX_PRESSURE])


def test_penalty_has_no_step_where_it_becomes_linear() -> None:
    below, above = penalty_of(torch.tensor([_MAX_PRESSURE - 1e-6, _MAX_PRESSURE + 1e-6]))
    assert above == pytest.approx(float(below), abs=1e-6)
    assert below == pytest.approx(_MAX_PRESSURE**2 / (2 * _RHO), rel=1e-5)
