"""The ascent of aims: what too much light costs, and the most that any aims can give."""

import pytest
import torch

from model.aiming.bound import bound_power
from model.aiming.kernels import SIZE, Kernels
from model.aiming.plan import _MAX_PRESSURE, _RHO, penalty_of, single_aim


def test_slope_of_the_penalty_is_the_pressure_up_to_its_greatest() -> None:
    excess = torch.tensor([0.0, 0.05, 0.2, 0.4, 5.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(penalty_of(_RHO * excess).sum(), excess)
    assert slope.tolist() == pytest.approx([0.0, 0.5, 2.0, _MAX_PRESSURE, _MAX_PRESSURE])


def test_penalty_has_no_step_where_it_becomes_linear() -> None:
    below, above = penalty_of(torch.tensor([_MAX_PRESSURE - 1e-6, _MAX_PRESSURE + 1e-6]))
    assert above == pytest.approx(float(below), abs=1e-6)
    assert below == pytest.approx(_MAX_PRESSURE**2 / (2 * _RHO), rel=1e-5)


def one_pixel_kernels(right: float, down: float) -> Kernels:
    """One mirror, whose image of 64 m by 64 m is one bright pixel of 1 W/m2, and a map of one pixel
    of 1 m2.

    Light to that pixel passes the plane ``right`` and ``down`` of the image's middle, in halves of
    the image's side.
    """
    image = torch.zeros(1, SIZE, SIZE)
    image[0, SIZE // 2, SIZE // 2] = 1.0
    return Kernels(
        names=("A",),
        expected=image,
        sharp=image,
        sides=torch.full((1,), float(SIZE)),
        aims=torch.zeros(1, 3),
        mirrors=torch.tensor([[0.0, 100.0, 0.0]]),
        axes=torch.eye(3)[None],
        spread=torch.zeros(1, 2, 2),
        power=torch.ones(1),
        places=torch.tensor([[[right], [down]]]),
        factors=torch.ones(1, 1),
        pixels=torch.zeros(1, 1, dtype=torch.int32),
        areas=torch.ones(1),
        resolution=(1, 1),
        is_whole=False,
    )


@pytest.mark.parametrize(("right", "down"), [(1, 0), (0, 1)])
@pytest.mark.parametrize(
    ("place", "least"), [(-1.99, 0.5), (1.0, 0.5), (1.95, 0.5), (1.98, 0.0), (2.02, 0.0)]
)
def test_bound_has_no_more_light_in_a_pixel_than_the_image_has(
    right: int, down: int, place: float, least: float
) -> None:
    """Also at the edge of the plane on which aims are sought, two halves of the image's side away,
    and beyond it.
    """
    plan = single_aim(one_pixel_kernels(place * right, place * down), torch.full((1,), 1e3))
    assert least <= bound_power(plan, 0) <= 1.0 + 1e-6
