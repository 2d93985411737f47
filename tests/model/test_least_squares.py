"""On problems whose minima are known in closed form."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from model.least_squares import Bounds, MinimizerOptions, Quadratic, damped_step, minimize

OPTIONS = MinimizerOptions(max_steps=100, max_jacobians=100, patience=5, min_relative_gain=1e-12)


@dataclass
class Problem:
    """Half the sum of squares of residuals of x, which are functions with a derivative."""

    residuals: object
    derivatives: object
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    taken: list = field(default_factory=list)

    def cost(self, x):
        return float(self.residuals(x) @ self.residuals(x)) / 2

    def jacobian(self, x):
        self.taken.append(x)
        return self.derivatives(x)

    def quadratic(self, x, jacobian):
        return Quadratic(-jacobian @ self.residuals(x), jacobian @ jacobian.T)

    def bounds(self, x):
        return None if self.low is None else Bounds(self.low - x, self.high - x)

    def step(self, x, change):
        return x + change


def linear(**bounds):
    rng = np.random.default_rng(0)
    matrix, data = rng.normal(size=(12, 4)), rng.normal(size=12)
    return Problem(lambda x: matrix @ x - data, lambda x: matrix.T, **bounds), matrix, data


def rosenbrock():
    """Its minimum lies at (1, 1), in a curved valley (Rosenbrock 1960)."""
    return Problem(
        lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
        lambda x: np.array([[-20 * x[0], -1], [10, 0]]),
    )


def test_linear_problem_is_solved():
    problem, matrix, data = linear()
    found = minimize(problem, np.zeros(4), OPTIONS)
    expected = np.linalg.lstsq(matrix, data, rcond=None)[0]
    np.testing.assert_allclose(found.state, expected, atol=1e-6)
    assert found.cost == pytest.approx(np.sum((matrix @ expected - data) ** 2) / 2)


def test_curved_valley_is_followed_to_its_end():
    problem = rosenbrock()
    found = minimize(problem, np.array([-1.2, 1.0]), OPTIONS)
    np.testing.assert_allclose(found.state, [1, 1], atol=1e-5)
    assert found.cost < 1e-10


def test_bounds_hold_and_the_rest_makes_the_best_of_it():
    """With x0 at its bound the others solve the problem that is left."""
    _, matrix, data = linear()
    free = np.linalg.lstsq(matrix, data, rcond=None)[0]
    high = np.array([free[0] - 0.2, 9, 9, 9])
    problem, *_ = linear(low=np.full(4, -9.0), high=high)
    found = minimize(problem, np.full(4, -1.0), OPTIONS)
    rest = np.linalg.lstsq(matrix[:, 1:], data - matrix[:, 0] * high[0], rcond=None)[0]
    np.testing.assert_allclose(found.state, [high[0], *rest], atol=1e-6)


def test_no_more_steps_and_jacobians_than_allowed():
    problem = rosenbrock()
    minimize(problem, np.array([-1.2, 1.0]), replace(OPTIONS, max_jacobians=3))
    assert len(problem.taken) == 3
    given = rosenbrock()
    start = np.array([-1.2, 1.0])
    found = minimize(
        given, start, replace(OPTIONS, max_steps=1, max_jacobians=0), given.derivatives(start)
    )
    assert not given.taken
    assert found.cost < given.cost(start)


def test_a_state_without_answer_is_not_entered():
    """Half of the line has none: the steps become shorter."""
    problem = Problem(lambda x: np.where(x > 0.5, np.inf, 1 - x), lambda x: -np.ones((1, 1)))
    found = minimize(problem, np.array([-1.0]), replace(OPTIONS, patience=50))
    assert 0 < found.state[0] <= 0.5


def test_damping_shortens_the_step():
    quadratic = Quadratic(np.array([1.0, 2.0]), np.diag([2.0, 1.0]))
    np.testing.assert_allclose(damped_step(quadratic, 0.0), [0.5, 2.0])
    np.testing.assert_allclose(damped_step(quadratic, 1.0), [0.25, 1.0])
    bounded = damped_step(quadratic, 0.0, Bounds(np.array([-1.0, -1.0]), np.array([1.0, 1.0])))
    np.testing.assert_allclose(bounded, [0.5, 1.0])
