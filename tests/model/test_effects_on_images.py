"""Effects of the camera against analytic truth."""

import numpy as np
import pytest
import torch

from model.effects.background import Background
from model.effects.camera_blur import CameraBlur
from model.effects.camera_response import CameraResponse
from model.effects.camera_shoulder import CameraShoulder
from model.effects.target_registration import TargetRegistration
from model.tracing import Window

WINDOW = Window(8.0, 6.0, 96, 128)


def places(window: Window = WINDOW) -> tuple[torch.Tensor, torch.Tensor]:
    """Right and up [m] of each pixel, (1, columns) and (rows, 1)."""
    x = (torch.arange(window.columns, dtype=torch.float64) + 0.5) * window.pixel[
        0
    ] - window.width / 2
    y = window.height / 2 - (torch.arange(window.rows, dtype=torch.float64) + 0.5) * window.pixel[1]
    return x[None, :], y[:, None]


def spot(x0=0.4, y0=-0.3, sigma_x=0.5, sigma_y=0.35, peak=800.0) -> torch.Tensor:
    """A Gaussian spot (1, rows, columns) [W/m2]."""
    x, y = places()
    return peak * torch.exp(-(((x - x0) / sigma_x) ** 2 + ((y - y0) / sigma_y) ** 2) / 2)[None]


def moments(image: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass (2,) [m] and covariance (2, 2) [m2], right and up, of an image (1, rows,
    columns).
    """
    x, y = places()
    weight = image[0] / image.sum()
    mean = torch.stack([(weight * x).sum(), (weight * y).sum()])
    dx, dy = x - mean[0], y - mean[1]
    cross = (weight * dx * dy).sum()
    covariance = torch.stack([(weight * dx**2).sum(), cross, cross, (weight * dy**2).sum()]).view(
        2, 2
    )
    return mean.numpy(), covariance.numpy()


@pytest.mark.parametrize("sigma", [0.03, 0.2, 0.4])
def test_blur_adds_its_variance_and_keeps_energy_and_place(sigma):
    before, after = spot(), CameraBlur(sigma).on_image(spot(), WINDOW)
    assert float(after.sum() / before.sum()) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(moments(after)[0], moments(before)[0], atol=1e-4)
    np.testing.assert_allclose(
        moments(after)[1] - moments(before)[1], sigma**2 * np.eye(2), atol=2e-3 * 0.16
    )


def test_blur_loses_nothing_over_the_edge():
    at_the_edge = spot(x0=3.9, y0=2.9)
    assert float(
        CameraBlur(0.5).on_image(at_the_edge, WINDOW).sum() / at_the_edge.sum()
    ) == pytest.approx(1, abs=1e-12)


def test_blurs_add_in_quadrature():
    twice = CameraBlur(0.4).on_image(CameraBlur(0.3).on_image(spot(), WINDOW), WINDOW)
    np.testing.assert_allclose(CameraBlur(0.5).on_image(spot(), WINDOW), twice, atol=1e-9)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_response_is_the_known_curve(gamma):
    ramp = torch.linspace(0, 500, 128, dtype=torch.float64).expand(1, 4, 128)
    seen = CameraResponse(gamma, 0.7).on_image(ramp, WINDOW)
    expected = 500 * np.minimum(np.linspace(0, 1, 128), 0.7) ** gamma
    np.testing.assert_allclose(seen[0, 2], expected, atol=1e-3)


def test_a_gaussian_under_gamma_is_a_gaussian_of_another_width():
    seen = CameraResponse(0.5).on_image(spot(), WINDOW)
    np.testing.assert_allclose(
        seen, spot(sigma_x=0.5 * 2**0.5, sigma_y=0.35 * 2**0.5), rtol=0.01, atol=2.0
    )


@pytest.mark.parametrize("compression", [1e-6, 5e-4, 2e-3, 1.0, 4.0])
def test_shoulder_keeps_dark_and_peak_and_halves_light_where_it_should(compression):
    """Half of the peak's counts belong to the light -ln((1 + exp(-c)) / 2) / c, which is half of it
    for c = 0.
    """
    half = -np.log((1 + np.exp(-compression)) / 2) / compression
    light = torch.tensor([0.0, half, 1.0], dtype=torch.float64).expand(1, 2, 3) * 700
    seen = CameraShoulder(compression).on_image(light, WINDOW)
    np.testing.assert_allclose(seen[0, 1], [0.0, 350.0, 700.0], atol=1e-4)


def test_faint_light_under_a_shoulder_stays_in_proportion():
    faint = torch.tensor([1e-5, 2e-5, 1.0], dtype=torch.float64).expand(1, 2, 3)
    seen = CameraShoulder(1.5).on_image(faint, WINDOW)[0, 0]
    np.testing.assert_allclose(seen[:2] / faint[0, 0, :2], 1.5 / (1 - np.exp(-1.5)), rtol=1e-4)


def test_background_is_a_plane_in_shares_of_the_peak():
    image = spot()
    plane = (Background(0.05, 0.02, -0.01).on_image(image, WINDOW) - image)[0] / image.max()
    x, y = places()
    np.testing.assert_allclose(plane, 0.05 + 0.02 * x - 0.01 * y, atol=1e-12)


def test_registration_moves_the_spots_moments():
    effect = TargetRegistration(scale_x=1.1, scale_y=0.9, shear=0.1, rotation_deg=8.0)
    turn = np.radians(8.0)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ [
        [1.1, 0.11],
        [0, 0.9],
    ]
    (mean, covariance), image = moments(spot()), effect.on_image(spot(), WINDOW)
    moved_mean, moved_covariance = moments(image)
    np.testing.assert_allclose(moved_mean, matrix @ mean, atol=1e-3)
    np.testing.assert_allclose(moved_covariance, matrix @ covariance @ matrix.T, atol=1e-3)
    assert float(image.max() / spot().max()) == pytest.approx(1, abs=5e-3)
    assert float(image.sum() / spot().sum()) == pytest.approx(np.linalg.det(matrix), abs=1e-3)


def test_an_anticlockwise_turn_lifts_what_lies_to_the_right():
    mean, _ = moments(TargetRegistration(rotation_deg=10.0).on_image(spot(x0=2.0, y0=0.0), WINDOW))
    np.testing.assert_allclose(
        mean, [2 * np.cos(np.radians(10)), 2 * np.sin(np.radians(10))], atol=1e-2
    )


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        (CameraResponse, (1.3, 0.8)),
        (CameraResponse, (0.6, 1.0)),
        (CameraShoulder, (1.2,)),
        (CameraShoulder, (5e-4,)),
        (CameraBlur, (0.2,)),
        (Background, (0.1, 0.02, -0.03)),
        (TargetRegistration, (1.03, 0.97, 0.02, 3.0)),
    ],
)
def test_gradients(effect, values):
    """In the parameters and in the image; at a saturation of one the slope is one-sided, so it is
    left out there.
    """
    small = Window(4.0, 3.0, 6, 8)
    image = torch.as_tensor(np.random.default_rng(0).random((2, 6, 8))) + 0.1
    parameters = [torch.tensor(v, dtype=torch.float64, requires_grad=v != 1.0) for v in values]

    def seen(image: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return effect(*parameters).on_image(image, small)

    assert torch.autograd.gradcheck(seen, (image.requires_grad_(), *parameters), atol=1e-5)


def test_the_dark_has_finite_gradients():
    gamma = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    image = spot().clamp(min=1).sub(1).requires_grad_()
    CameraResponse(gamma).on_image(image, WINDOW).sum().backward()
    assert torch.isfinite(image.grad).all()
    assert torch.isfinite(gamma.grad)
