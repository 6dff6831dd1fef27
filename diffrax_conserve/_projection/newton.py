"""Damped Newton's method for the nearest point, with fresh Jacobians, for candidates far away."""

import functools as ft
from typing import Any, ClassVar, final

import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

from .._custom_types import Y
from .._tree import (
    tree_mul,
    tree_size,
    tree_sub,
    working_dtype,
)
from .base import (
    NEWTON_OPTIONS,
    AbstractProjection,
    Problem,
    check_options,
    option,
    positive_weights,
)
from .bounded import box_of, check_bounds, project_into
from .elimination import Vector
from .equations import Equations, ProjectionInfo
from .implicit import SYSTEM_DENSE_MAX, differentiated, finite_or_nan, optimality, units
from .iteration import iterate
from .linearise import linearise
from .residual import ROUNDOFF_MULTIPLE, Tolerance, within


@final
class Newton(AbstractProjection):
    r"""Projects to the nearest point of the manifold, with a fresh Jacobian in each iteration.

    Finds the stationary point of the distance, $(y, \lambda)$ with

    $$y = \hat y + M^{-1} G(y)^\top \lambda, \qquad g(y) = 0,$$

    in two phases. First a Gauss-Newton iteration converges to a point of the manifold. The damping
    $\min(10^{-2}, |g|^2)$ of its row-scaled Gram matrix vanishes with the (relative) residual: the
    iteration can pass near points where gradients are parallel, and converges quadratically
    elsewhere. Then Newton's method on both equations moves along the manifold to the point nearest
    to the candidate. If that fails, the result of the first phase is returned: it is on the
    manifold, but not the nearest point, and its derivative is NaN. The second phase needs second
    derivatives of the constraint functions and linear solves with all unknowns, so for the close
    candidates of an integrator use [`diffrax_conserve.SimplifiedNewton`][].

    Success is judged at the returned state, relative to the scale of the constraints there. The
    result is differentiated by the implicit function theorem for both equations. The derivative is
    NaN where the gradients of the constraints are nearly parallel at the projected state but not
    everywhere.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(circle, jnp.array([3.0, 4.0]), projection=dfc.Newton())
        ```

    ??? cite "Reference"

        E. Hairer, C. Lubich and G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer
        2006, Section IV.4, equations (4.3).
    """

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(50, static=True)
    metric: PyTree[ArrayLike] | None = option(None, converter=positive_weights)
    lower: PyTree[ArrayLike] | None = option(None)
    upper: PyTree[ArrayLike] | None = option(None)
    linear_solver: lx.AbstractLinearSolver | None = option(None, static=True)
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_options(self)
        check_bounds(self.lower, self.upper)

    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        if jnp.finfo(working_dtype(candidate)).bits < 32:
            raise TypeError(
                f"`Newton` was given a state of dtype {working_dtype(candidate)}, in which its "
                "linear solves cannot be done. Convert the state to float32, or pass "
                "`projection=SimplifiedNewton()`."
            )
        if len({x.dtype for x in jtu.tree_leaves(candidate)}) > 1:
            raise TypeError(
                "`Newton` was given a state with leaves of several dtypes. Convert them to one, or "
                "pass `projection=SimplifiedNewton()`."
            )
        tolerance = Tolerance(self.rtol, self.atol)
        equations = problem.equations(candidate, tolerance, self.linear_solver)
        box = box_of(self.lower, self.upper, candidate)
        steps = self.max_steps
        unbounded = ft.partial(_project, max_steps=steps)
        if box is None:
            y, _, info = unbounded(equations)
        else:
            y, _, info = project_into(
                equations, box, unbounded=unbounded, frozen=False, max_steps=steps
            )
        return y, info


Newton.__init__.__doc__ = NEWTON_OPTIONS


@eqx.filter_custom_jvp
def _project(equations: Equations, *, max_steps: int) -> tuple[Y, Vector, ProjectionInfo]:
    before, reached = iterate(equations, frozen=False, max_steps=max_steps)
    nearest, multiplier, num_steps, arrived = _nearest(equations, reached.y, max_steps)

    g, scale = equations.measure(nearest)
    found = within(g, equations.tolerance(scale)) & arrived
    y = jtu.tree_map(lambda a, b: jnp.where(found, a, b), nearest, reached.y)
    g, jacobian = linearise(equations.residual, y)
    measured = g, equations.scale(jacobian, y)
    rank = jacobian.gram_solver(equations.weights).rank
    info = equations.report(y, before, measured, reached.num_steps + num_steps, rank)
    # Only the multipliers of the nearest point have a derivative.
    return y, jnp.where(info.ok & ~found, jnp.nan, multiplier), info


class _SVD(lx.SVD):
    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        return super().init(lx.MatrixLinearOperator(finite_or_nan(operator.as_matrix())), options)


def _nearest(
    equations: Equations, start: Y, max_steps: int
) -> tuple[Y, Vector, Int[Array, ""], Bool[Array, ""]]:
    """Newton's method on the optimality system, from a point of the manifold and its least-squares
    multipliers. Returns the state, its multipliers, the number of steps, and whether it
    converged."""
    residual, candidate, weights = equations.residual, equations.candidate, equations.weights
    _, jacobian = linearise(residual, start)
    offset = jacobian.pushforward(tree_sub(start, candidate))
    # Scaled, so that a linear solver finds the right rank of the system.
    roots, norms = units(jacobian, weights)
    multiplier = equations.gram_solver(jacobian).solve(offset) * norms

    def scaled(unknowns: tuple[Y, Vector], parameters: Any) -> tuple[Y, Vector]:
        (y, multiplier), (residual, candidate, weights, roots, norms) = unknowns, parameters
        given = (lambda y: residual(y) / norms), candidate, weights, None
        off, g = optimality((tree_mul(y, roots), multiplier), given)
        return jtu.tree_map(jnp.divide, off, roots), g

    def tolerance(y: Y, multiplier: Vector) -> Array:
        """The tolerance for the optimality condition. It allows for the roundoff of the
        multipliers, which are large and cancel where gradients are nearly parallel."""
        free = jtu.tree_map(lambda x, w: jnp.where(w > 0, x, 0), y, weights)
        return rtol * optx.max_norm(free) + ROUNDOFF_MULTIPLE * eps * optx.max_norm(multiplier)

    eps = float(jnp.finfo(working_dtype(candidate)).eps)
    rtol = eps ** (2 / 3)
    if tree_size((candidate, multiplier)) <= SYSTEM_DENSE_MAX:
        # Dependent constraints make the system singular but consistent.
        linear_solver = _SVD()
    else:
        linear_solver = lx.GMRES(rtol=rtol, atol=rtol)
    y = jtu.tree_map(jnp.divide, start, roots)
    atol: Any = tolerance(y, multiplier)
    parameters = residual, candidate, weights, roots, norms
    unknowns, unravel = jfu.ravel_pytree((y, multiplier))

    def state_norm(x: Array) -> Array:
        # Where gradients are nearly parallel, only the state is well determined, not the
        # multipliers.
        return optx.max_norm(unravel(x)[0])

    solution = optx.root_find(
        lambda x, parameters: jfu.ravel_pytree(scaled(unravel(x), parameters))[0],
        optx.Newton(rtol=rtol, atol=atol, norm=state_norm, linear_solver=linear_solver),
        unknowns,
        parameters,
        max_steps=max_steps,
        throw=False,
    )
    y, multiplier = unravel(solution.value)
    # Judged with the tolerance at the end, because multipliers may be much smaller at the start.
    off, _ = scaled((y, multiplier), parameters)
    arrived = optx.max_norm(off) <= tolerance(y, multiplier)
    return tree_mul(y, roots), multiplier / norms, solution.stats["num_steps"], arrived


@_project.def_jvp
def _project_jvp(primals, tangents, *, max_steps):
    solution = _project(*primals, max_steps=max_steps)
    return differentiated(solution, (*primals, None), (*tangents, None), frozen=False)
