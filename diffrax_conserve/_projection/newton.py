"""Damped Newton's method for the nearest point of a manifold, for candidates far away.

The nearest point is a stationary point of the distance under the constraints, where the Lagrange
conditions `S⁻¹ (y - ŷ) = (G(y) S)ᵀ λ` and `g(y) = 0` hold. These are as many equations as unknowns,
`S⁻¹ y` and `λ`. So they are solved by the same damped iteration as `g(y) = 0` alone, whose steps
are then those of Newton's method, and the derivative follows from the implicit function theorem.
"""

import dataclasses
import functools as ft
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._constants import MAX_DENSE_SYSTEM, TOLERANCE_IN_EPS
from .._numerics.implicit import nan_tangent_unless, root
from .._numerics.iterate import Solved, damped_newton
from .._numerics.metric import Identity
from .._numerics.problem import Problem
from .._numerics.report import ProjectionInfo
from .._numerics.rows import solve_kkt
from .._tree import eps_of, tree_stop_gradient
from .options import NEWTON_OPTIONS, refuse_half_precision
from .within_bounds import AbstractNewton, Bounds, along_gradients


@final
class Newton(AbstractNewton):
    r"""Projects to the nearest point of the manifold, with a fresh Jacobian in each iteration.

    Finds the stationary point of the distance, $(y, \lambda)$ with

    $$y = \hat y + M^{-1} G(y)^\top \lambda, \qquad g(y) = 0,$$

    in two phases. First a damped Gauss-Newton iteration converges to a point of the manifold: a
    step that increases the largest residual, or leaves the domain of a function, is shortened. Then
    Newton's method for both equations moves along the manifold to the nearest point. If that fails,
    or with more than 512 unknowns and constraints, the result is that of the first phase, on the
    manifold but not nearest, and its derivative is NaN. For the close candidates of an integrator
    use [`diffrax_conserve.SimplifiedNewton`][].

    The derivative follows from the implicit function theorem for both equations, without
    constraints whose gradients are nearly parallel to others; see
    [Derivatives near a circular orbit][derivatives-near-a-circular-orbit].

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(circle, jnp.array([3.0, 4.0]), projection=dfc.Newton())
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, IV.4, (4.3).
    """

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        refuse_half_precision("`Newton`", candidate, ", or pass `projection=SimplifiedNewton()`")
        bounds = self.bounds(problem.like)
        given = _Given(problem.with_dense_jacobian(), candidate, bounds)
        start = bounds, problem, candidate
        # Nobody uses the derivative of the first phase: that of the nearest point is by the second
        # one, and elsewhere it is NaN.
        first_phase = ft.partial(along_gradients, max_steps=self.max_steps, iteration=damped_newton)
        if candidate.size + problem.num_residuals > MAX_DENSE_SYSTEM:
            first = first_phase(*start)
            y, more = nan_tangent_unless(given.clip(first.y), False), 0
        else:
            first = first_phase(*tree_stop_gradient(start))
            y, more = _nearest(given, first.y, self.max_steps)
        return y, problem.report(candidate, y, first.num_iterations + more)


Newton.__init__.__doc__ = NEWTON_OPTIONS


class _Given(eqx.Module):
    """What is given: the equations, the candidate and the bounds."""

    problem: Problem
    candidate: Float[Array, " n"]
    bounds: Bounds | None

    def clip(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        return z if self.bounds is None else self.bounds.clip(z)


class _Conditions(eqx.Module):
    """The Lagrange conditions as functions of one vector: the change `u` from a `base`, with
    `y = base + S u`, and the multipliers times the norms of the gradients there. So no unknown has
    a unit, and no digits are lost if the candidate is far away. Within bounds `base + S u` is a
    vector without bounds, which `clip` maps to the state. In a derivative only what is strictly
    within them is `corrected`; see `Bounds`."""

    given: _Given
    base: Float[Array, " n"]
    row_norms: Float[Array, " m"]
    corrected: Bool[Array, " n"] | None = None

    def state(self, unknowns: Float[Array, " N"]) -> Float[Array, " n"]:
        # The base is only a place to start from. It moves with the candidate, and with nothing
        # else, so that a component that is never moved has the derivative of the candidate.
        candidate = self.given.candidate
        change = self.given.problem.factor.to_state(unknowns[: self.base.size])
        if self.corrected is not None:  # the solution of a linear system has roundoff everywhere
            change = jnp.where(self.corrected, change, 0)
        return self.given.clip(self.base + (candidate - lax.stop_gradient(candidate)) + change)

    def __call__(self, unknowns: Float[Array, " N"]) -> Float[Array, " N"]:
        problem, away = self.given.problem, self.base - lax.stop_gradient(self.given.candidate)
        change, multiplier = jnp.split(unknowns, [self.base.size])
        # `G(y)ᵀ λ` by one reverse pass, instead of one for each row of `G`.
        g, vjp = jax.vjp(problem.residual, self.state(unknowns))
        gradient = problem.factor.scaled_gradient(vjp(multiplier / self.row_norms)[0])
        return jnp.concatenate([problem.factor.to_euclidean(away) + change - gradient, g])


def _conditions(given: _Given, base: Float[Array, " n"]) -> tuple[_Conditions, Array, Problem]:
    """The conditions around a base; the unknowns there, with the multipliers that fit best; and the
    conditions as equations with their scales and tolerances."""
    problem, y = given.problem, given.clip(base)
    jacobian = problem.linearise(y)[1]
    row_norms, rows = problem.factor.scaled_rows(jacobian).normalised()
    conditions = _Conditions(given, base, row_norms)
    sizes_of = [jnp.abs(problem.factor.to_euclidean(x)) for x in (base, given.candidate)]
    change = problem.factor.to_euclidean(base - given.candidate)
    scale = problem.scale(jacobian, y)

    def tolerance(default: float, of_user: Any) -> Array:
        """The tolerances of the user are for the constraints. The others hold to roundoff."""
        of_user = jnp.broadcast_to(default if of_user is None else of_user, scale.shape)
        return jnp.concatenate([jnp.full_like(y, default), of_user.astype(y.dtype)])

    tested = dataclasses.replace(
        problem,
        functions=(conditions,),
        sizes=(y.size + scale.size,),
        magnitude=jnp.concatenate([sizes_of[0] + sizes_of[1], scale]),
        cancellation=jnp.concatenate([jnp.zeros_like(y), problem.cancellation]),
        changes=None,
        factor=Identity(),
        rtol=tolerance(TOLERANCE_IN_EPS * eps_of(y), problem.rtol),
        atol=tolerance(0.0, problem.atol),
    )
    return (
        conditions,
        jnp.concatenate([jnp.zeros_like(y), rows.multiplier(change, rows)]),
        tested,
    )


def _nearest(given: _Given, first: Array, max_steps: int) -> tuple[Array, Array]:
    """Second phase: the nearest point, and the number of steps. If the first phase has reached the
    manifold, but no nearest point was found, the derivative is NaN. If it has not, the result is
    discarded, and its derivative stays finite."""
    still = tree_stop_gradient(given)

    def approach(now: Any) -> Any:
        base, _, count, left = now
        _, start, tested = _conditions(still, base)
        solved = damped_newton(tested, start, max_steps=max_steps, polish=True)
        end = base + still.problem.factor.to_state(solved.y[: base.size])
        left = jnp.where(solved.ok, left - 1, 0)
        return jnp.where(solved.ok, end, base), solved.ok, count + solved.num_iterations, left

    # The change from the first base may be so large that its roundoff exceeds that of the result.
    # So we start once more, with the result as the base: now the change itself is roundoff.
    begin = first, jnp.asarray(False), jnp.asarray(0), jnp.asarray(2)
    base, ok, count, _ = lax.while_loop(lambda now: now[-1] > 0, approach, begin)
    ok = ok & still.problem.is_on_manifold(still.clip(base))
    conditions, start, _ = _conditions(still, jnp.where(ok, base, first))
    conditions = dataclasses.replace(conditions, given=given)
    if given.bounds is not None:
        rows = still.problem.linearise(still.clip(conditions.base))[1]
        corrected = still.bounds.corrected(conditions.base, rows)
        conditions = dataclasses.replace(conditions, corrected=corrected)
    solved = root(
        conditions, lambda x: Solved(x, ok, count), start, ft.partial(solve_kkt, first.size)
    )
    y = conditions.state(solved.y)
    return nan_tangent_unless(y, ok | ~still.problem.is_on_manifold(lax.stop_gradient(y))), count
