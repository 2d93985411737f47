"""Least squares by Levenberg and Marquardt, for refinements and studies.

A damped Gauss-Newton step is tried; if it lowers the cost it is taken and the damping eased, otherwise it is tried
again with more. Where a Jacobian is much more work than a step, one may serve many steps: every step corrects it by
what the response really did (Broyden 1965), and it is taken anew where corrections no longer help.

Sources: Marquardt 1963, doi:10.1137/0111030; Broyden 1965, doi:10.1090/S0025-5718-1965-0198670-6; for bounds, the
bounded-variable least squares of Stark and Parker 1995.
"""

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

Array = NDArray[np.float64]
State = TypeVar("State")


class Problem(Protocol[State]):
    """What is to be minimised, at states that know more of themselves than P numbers."""

    def cost(self, state: State) -> float:
        """Half the sum of squares; infinite where there is no answer."""

    def response(self, state: State) -> Array:
        """What is compared with data (...), whose change a Jacobian tells."""

    def jacobian(self, state: State) -> Array:
        """Derivatives (P, ...) of the response."""

    def quadratic(self, state: State, jacobian: Array) -> tuple[Array, Array]:
        """Downhill gradient (P,) and Gauss-Newton curvature (P, P) of the cost."""

    def bounds(self, state: State) -> tuple[Array, Array] | None:
        """Least and greatest change (P,) of a state; None for any."""

    def moved(self, state: State, change: Array) -> State:
        """The state after a change (P,)."""


@dataclass(frozen=True)
class Descent:
    """How a minimum is sought.

    At most ``steps`` are tried, with at most ``jacobians`` taken on the way. A Jacobian is taken anew after every step,
    or ``corrected`` as long as that helps. ``damping``, the first, is divided by ``easing`` after a step that was
    taken, down to ``least_damping``, and multiplied by ``raising`` after one that was not. It ends with a step that
    gains less than ``least_gain`` and ``least_share`` of the cost; after ``patience`` steps in a row that gain nothing;
    or where they take more than ``most_damping``.
    """

    steps: int
    jacobians: int
    corrected: bool = False
    damping: float = 1e-2
    easing: float = 5.0
    raising: float = 8.0
    least_damping: float = 0.0
    most_damping: float = np.inf
    patience: float = np.inf
    least_gain: float = 0.0
    least_share: float = 0.0


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """A local minimum: the state, its cost, and the last Jacobian (P, ...), of it or of a state shortly before."""

    state: State
    cost: float
    jacobian: Array


def minimize(problem: Problem[State], state: State, descent: Descent, jacobian: Array | None = None) -> Minimum[State]:
    """The local minimum below a state of finite cost; a ``jacobian`` there or nearby may be given, to be corrected."""
    left = descent.jacobians
    fresh = jacobian is None
    if jacobian is None:
        jacobian, left = problem.jacobian(state), left - 1
    cost, damping, failed = problem.cost(state), descent.damping, 0
    for _ in range(descent.steps):
        change = damped_step(*problem.quadratic(state, jacobian), damping, problem.bounds(state))
        trial = problem.moved(state, change)
        trial_cost = problem.cost(trial)
        gain, enough = cost - trial_cost, descent.least_gain + descent.least_share * cost
        if gain > 0:
            if descent.corrected:
                jacobian = broyden(jacobian, change, problem.response(trial) - problem.response(state))
            state, cost, failed = trial, trial_cost, 0
            damping = max(damping / descent.easing, descent.least_damping)
        else:
            damping, failed = damping * descent.raising, failed + 1
        if gain > 0 and gain >= enough:
            fresh = False
            anew = not descent.corrected
            if anew and not left:
                break
        else:
            anew = descent.corrected and not fresh and left > 0
            if not anew and (gain > 0 or failed >= descent.patience or damping > descent.most_damping):
                break
        if anew:
            jacobian, fresh, left = problem.jacobian(state), True, left - 1
    return Minimum(state, cost, jacobian)


def damped_step(gradient: Array, curvature: Array, damping: float, bounds: tuple[Array, Array] | None = None) -> Array:
    """The change (P,) to the least of a quadratic form with damped curvature (P, P), down a gradient (P,).

    Within ``bounds``, least and greatest changes (P,): a full step that was only cut at the bounds would go astray
    where unknowns make up for each other.
    """
    damped = curvature + damping * np.diag(np.diag(curvature))
    if bounds is None:
        return np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
    root = np.linalg.cholesky(damped)
    solution = lsq_linear(root.T, solve_triangular(root, gradient, lower=True), bounds, method="bvls")
    return np.asarray(np.clip(solution.x, *bounds))


def broyden(jacobian: Array, change: Array, response: Array) -> Array:
    """A Jacobian (P, ...) corrected, as little as can be, to tell what a change (P,) made of the response (...)."""
    missed = response - np.tensordot(change, jacobian, axes=1)
    return np.asarray(jacobian + np.multiply.outer(change / (change @ change), missed))
