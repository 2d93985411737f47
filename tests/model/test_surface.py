import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from model.errors import InvalidInputError
from model.surface import (
    basis,
    control_points,
    evaluate,
    greville,
    halved,
    heights,
    knots,
    sample,
    split_canting,
)
from tests.conftest import flat_heliostat

RNG = np.random.default_rng(2)


@pytest.mark.parametrize(("count", "degree"), [(8, 3), (20, 3), (6, 2), (5, 4), (2, 1)])
def test_basis_agrees_with_scipy(count, degree):
    u = np.linspace(0, 1, 101)
    values, slopes = basis(count, degree, u)
    for i in range(count):
        spline = BSpline(knots(count, degree), np.eye(count)[i], degree)
        np.testing.assert_allclose(values[:, i], spline(u), atol=1e-12)
        np.testing.assert_allclose(slopes[:-1, i], spline.derivative()(u[:-1]), atol=1e-9)


def test_greville_abscissae_make_the_parameter_linear():
    u = np.linspace(0, 1, 33)
    np.testing.assert_allclose(basis(8, 3, u)[0] @ greville(8), u, atol=1e-12)


def test_degree_needs_enough_points():
    with pytest.raises(InvalidInputError, match="degree 3"):
        basis(3, 3, [0.5])


def test_area_of_the_ideal_surface_is_that_of_its_facets():
    points = torch.as_tensor(control_points(flat_heliostat())).movedim(-1, -3)
    area = sample(points, 16).area_vectors.norm(dim=-2).sum()
    assert float(area) == pytest.approx(4 * 1.605 * 1.275, rel=1e-9)


def test_area_does_not_depend_on_the_parametrisation():
    """Evenly spaced control points crowd samples in the middle of the facet; the weights make up
    for it.
    """
    u = np.linspace(0, 1, 8)
    even = np.stack(np.broadcast_arrays(u[:, None] * 1.6, u[None, :] * 1.3, 0.0), axis=-1)
    samples = sample(torch.as_tensor(even).movedim(-1, -3)[None], 200)
    weights = samples.area_vectors.norm(dim=-2)
    assert float(weights.sum()) == pytest.approx(1.6 * 1.3, rel=1e-4)
    # The mean of x^2 over the rectangle, which unweighted samples get wrong.
    x = samples.points[0]
    assert float((x**2 * weights).sum() / weights.sum()) == pytest.approx(1.6**2 / 3, rel=1e-4)
    assert abs(float((x**2).mean()) - 1.6**2 / 3) > 0.02


def test_heights_invert_control_points():
    heliostat = flat_heliostat(focal_length=60.0)
    z = RNG.normal(0, 3e-4, (4, 8, 8))
    z -= z.mean(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(heights(heliostat, control_points(heliostat, z)), z, atol=2e-8)


def test_normals_are_those_of_the_tracer():
    heliostat = flat_heliostat(focal_length=50.0)
    points = control_points(heliostat, RNG.normal(0, 3e-4, (4, 8, 8)))
    u = (np.arange(9) + 0.5) / 9
    place, normals = evaluate(points, u, u)
    samples = sample(torch.as_tensor(points).movedim(-1, -3), 9)
    unit = samples.area_vectors / samples.area_vectors.norm(dim=-2, keepdim=True)
    np.testing.assert_allclose(samples.points.T.numpy(), place.reshape(-1, 3), atol=1e-12)
    np.testing.assert_allclose(unit.T.numpy(), normals.reshape(-1, 3), atol=1e-12)


def test_canting_is_separated_from_waviness():
    x = (2 * greville(8) - 1)[:, None] * np.ones((1, 8))
    waviness = np.sin(3 * x) * 1e-4
    canting, rest = split_canting(np.stack([x * 2e-4, x * 2e-4 + waviness, waviness, 0 * x]))
    np.testing.assert_allclose(
        canting + rest, np.stack([x * 2e-4, x * 2e-4 + waviness, waviness, 0 * x]), atol=1e-15
    )
    np.testing.assert_allclose(canting[1] - canting[0], canting[2], atol=1e-15)
    np.testing.assert_allclose(rest[0], 0, atol=1e-15)


def test_wrong_heights_are_named():
    with pytest.raises(InvalidInputError, match="z must be finite heights"):
        control_points(flat_heliostat(), np.full((4, 8, 8), np.nan))


def test_halved_spans_leave_the_surface_as_it_is():
    z = np.random.default_rng(1).normal(0, 1e-4, (2, 8, 8))
    fine = halved(z)
    assert fine.shape == (2, 13, 13)
    places = np.linspace(0, 1, 31)
    for coarse_facet, fine_facet in zip(z, fine, strict=True):
        coarse, finer = (basis(n, 3, places)[0] for n in (8, 13))
        np.testing.assert_allclose(
            finer @ fine_facet @ finer.T, coarse @ coarse_facet @ coarse.T, atol=1e-12
        )


def test_heights_of_another_grid_are_those_of_its_control_points():
    heliostat = flat_heliostat((0.0, 50.0, 1.8))
    z = np.random.default_rng(2).normal(0, 1e-4, (4, 13, 13))
    z -= z.mean(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(
        heights(heliostat, control_points(heliostat, z), shape=(13, 13)), z, atol=1e-9
    )
