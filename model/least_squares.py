"""Nonlinear least squares by the method of Levenberg and Marquardt.

Notes
-----
Near a state the cost is approximated by a quadratic form in the change ``d``, with the downhill
``gradient`` g and the Gauss-Newton ``curvature`` H::

    cost(d) = cost(0) - g' d + d' H d / 2

The step solves ``(H + damping diag(H)) d = g``, if there are bounds within them. A step that lowers
the cost is accepted and the damping is reduced; otherwise the step is repeated with more damping.

Sources: Marquardt 1963, doi:10.1137/0111030; for bounds, the bounded-variable least squares of
Stark and Parker 1995.
"""

from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

Array = NDArray[np.float64]
State = TypeVar("State")


class Quadratic(NamedTuple):
    """Downhill gradient (P,) and Gauss-Newton curvature (P, P) of a cost."""

    gradient: Array
    curvature: Array


class Bounds(NamedTuple):
    """Smallest and largest change (P,) of a state."""

    low: Array
    high: Array


class MinimizationProblem(Protocol[State]):
    """A cost to minimize, as a function of states, which may hold more than P numbers."""

    def cost(self, state: State) -> float:
        """Half the sum of squares; infinite if the model has no answer."""

    def jacobian(self, state: State) -> Array:
        """Derivatives (P, ...) of what is compared with the data."""

    def quadratic(self, state: State, jacobian: Array) -> Quadratic:
        """Quadratic approximation of the cost."""

    def bounds(self, state: State) -> Bounds | None:
        """Bounds on the change of a state; None if there are none."""

    def step(self, state: State, change: Array) -> State:
        """The state after a change (P,)."""


@dataclass(frozen=True)
class MinimizerOptions:
    """Options of `minimize`.

    Attributes
    ----------
    max_steps, max_jacobians : int
        Largest numbers of trial steps and of Jacobians; one Jacobian is computed after each
        accepted step.
    damping : float
        Of the first step.
    damping_decrease, damping_increase : float
        Factors after an accepted and after a rejected step.
    min_damping : float
    patience : float
        Number of rejected steps in a row after which it ends.
    min_gain, min_relative_gain : float
        It ends with a step that lowers the cost by less than their sum; the second is a share of
        the cost.
    """

    max_steps: int
    max_jacobians: int
    damping: float = 1e-2
    damping_decrease: float = 5.0
    damping_increase: float = 8.0
    min_damping: float = 0.0
    patience: float = np.inf
    min_gain: float = 0.0
    min_relative_gain: float = 0.0


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """A local minimum, its cost, and the Jacobian (P, ...) at it or at a state shortly before."""

    state: State
    cost: float
    jacobian: Array


def minimize(
    problem: MinimizationProblem[State],
    state: State,
    options: MinimizerOptions,
    jacobian: Array | None = None,
) -> Minimum[State]:
    """Find the local minimum downhill of a state of finite cost.

    ``jacobian`` is that of the state or of one nearby, if it is known.
    """
    n_jacobians = options.max_jacobians
    if jacobian is None:
        jacobian, n_jacobians = problem.jacobian(state), n_jacobians - 1
    cost, damping, n_rejected = problem.cost(state), options.damping, 0
    for _ in range(options.max_steps):
        if not n_rejected:
            quadratic = problem.quadratic(state, jacobian)
        change = damped_step(quadratic, damping, problem.bounds(state))
        trial = problem.step(state, change)
        trial_cost = problem.cost(trial)
        gain, enough = cost - trial_cost, options.min_gain + options.min_relative_gain * cost
        if gain > 0:
            state, cost, n_rejected = trial, trial_cost, 0
            damping = max(damping / options.damping_decrease, options.min_damping)
        else:
            damping, n_rejected = damping * options.damping_increase, n_rejected + 1
        if gain > 0 and gain >= enough:
            if not n_jacobians:
                break
            jacobian, n_jacobians = problem.jacobian(state), n_jacobians - 1
        elif gain > 0 or n_rejected >= options.patience:
            break
    return Minimum(state, cost, jacobian)


def damped_step(quadratic: Quadratic, damping: float, bounds: Bounds | None = None) -> Array:
    """Solve for the step (P,) of a quadratic form with a damped curvature.

    With ``bounds`` the constrained problem is solved: clipping the full step would mislead if
    parameters compensate each other.
    """
    gradient, curvature = quadratic
    damped = curvature + damping * np.diag(np.diag(curvature))
    if bounds is None:
        return np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
    root = np.linalg.cholesky(damped)
    solution = lsq_linear(
        root.T, solve_triangular(root, gradient, lower=True), tuple(bounds), method="bvls"
    )
    return np.asarray(np.clip(solution.x, *bounds))
