"""Damped Newton's method for the nearest point of a manifold, for candidates far away.

The nearest point is a stationary point of the distance under the constraints, where the Lagrange
conditions `y - ŷ - M⁻¹ G(y)ᵀ λ = 0` and `g(y) = 0` hold. These are equations for the pair `(y, λ)`.
So they are solved by the same damped iteration as `g(y) = 0` alone, and the derivative follows from
the implicit function theorem for them.
"""

import dataclasses
from typing import final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._constants import MAX_STEPS, NEAREST
from .._step.equations import Equations
from .._step.implicit import AbstractSystem, known_if, solution, well_conditioned
from .._step.iterate import Solved, damped
from .._step.linear import (
    combined,
    gram_matrix,
    scaled_rows,
    solve,
    solve_large,
    times,
)
from .._step.metric import MatrixUnits, PreferredUnits, measured
from .._tree import tree_stop_gradient
from .base import Problem, ProjectionInfo
from .options import NEWTON_OPTIONS, option
from .within_bounds import AbstractNewton, Bounds, project_within


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

    The derivative follows from the implicit function theorem for both equations. It is NaN where
    the gradients of the constraints are nearly parallel at the projected state but not everywhere.

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

    max_steps: int = option(MAX_STEPS, static=True)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        if np.promote_types(candidate.dtype, np.float32) != candidate.dtype:
            # LAPACK has no half precision, in which the derivative would need singular values.
            raise TypeError(
                f"`Newton` cannot solve in the dtype of the state, {candidate.dtype}. Convert the "
                "state to float32, or pass `projection=SimplifiedNewton()`."
            )
        equations, bounds = problem.equations, self.bounds(problem.like)
        system = _Nearest(equations, candidate, bounds, max_steps=self.max_steps)
        (y, _), _, num_steps, _ = solution(system)
        return y, problem.report(candidate, y, num_steps)


Newton.__init__.__doc__ = NEWTON_OPTIONS


class _Optimality(eqx.Module):
    """The Lagrange conditions: `y - clip(ŷ + M⁻¹ G(y)ᵀ λ)` and `g(y)`, as functions of `y` and
    `sizes * λ` in one vector. The `sizes` are those of the gradients, so that all unknowns have
    comparable units. Without bounds `clip` is the identity."""

    equations: Equations
    candidate: Float[Array, " n"]
    bounds: Bounds | None
    sizes: Float[Array, " m"]

    def __call__(self, unknowns: Float[Array, " N"]) -> Float[Array, " N"]:
        y, multiplier = jnp.split(unknowns, [self.candidate.size])
        # `G(y)ᵀ λ` by one reverse pass, instead of one for each row of `G`.
        g, vjp = jax.vjp(self.equations.residual, y)
        gradient = self.equations.in_units(vjp(multiplier / self.sizes)[0])
        z = self.candidate + self.equations.change(gradient)
        return jnp.concatenate([y - (z if self.bounds is None else self.bounds.clip(z)), g])


class _Nearest(AbstractSystem):
    """The nearest point to the candidate. The unknowns are the state and its multipliers times the
    sizes of the gradients. The multipliers are NaN if only a point of the manifold was found."""

    equations: Equations
    candidate: Float[Array, " n"]
    bounds: Bounds | None
    max_steps: int = eqx.field(static=True, kw_only=True)

    def found(self) -> Solved:
        equations, candidate, bounds = self.equations, self.candidate, self.bounds
        # First phase: some point of the manifold.
        if bounds is None:
            first = damped(equations, candidate, max_steps=self.max_steps)
        else:
            first = project_within(bounds, equations, candidate, max_steps=self.max_steps)
        y, nothing = first.y, jnp.full_like(equations.magnitude, jnp.nan)
        if not self._is_sought():
            return first._replace(y=(y, nothing))
        # Second phase: the nearest point. It starts from the multipliers that fit `y - ŷ` best. The
        # Lagrange conditions take the place of the constraints. There are as many as unknowns, so
        # the steps of the damped iteration are those of Newton's method.
        equations, sizes, units, start = self._at(y)
        conditions = dataclasses.replace(
            equations,
            parts=(_Optimality(equations, candidate, bounds, sizes),),
            magnitude=jnp.concatenate([jnp.abs(candidate), equations.magnitude]),
            hidden=jnp.concatenate([jnp.zeros_like(y), equations.hidden]),
            moved=None,
            units=units,
        )
        end, nearest, more, _ = damped(conditions, start, max_steps=self.max_steps, polish=True)
        end, multiplier = jnp.split(end, [y.size])
        if bounds is not None:
            end = bounds.clip(end)
        nearest = nearest & equations.holds(end)
        both = jnp.where(nearest, end, y), jnp.where(nearest, multiplier, nothing)
        return Solved(both, nearest | first.ok, first.num_steps + more)

    def _is_sought(self) -> bool:
        return self.candidate.size + self.equations.magnitude.size <= NEAREST

    def _at(self, y: Array) -> tuple[Equations, Array, Array, Array]:
        """The equations, dense; the sizes of the rows of `G S` at a state; units for the state and
        for the multipliers, with which no condition number depends on the units of the user; and
        the state with the multipliers that fit best."""
        equations = self.equations.dense()
        sizes, rows = scaled_rows(equations.in_units(equations.linearise(y)[1]))
        gram = gram_matrix(rows, rows)
        lengths = jnp.diagonal(gram)
        own = equations.units
        own = own.own if isinstance(own, PreferredUnits) else own
        own = (
            own.sizes if isinstance(own, MatrixUnits) else jnp.ones_like(y) if own is None else own
        )
        units = jnp.concatenate([own, lax.rsqrt(jnp.where(lengths > 0, lengths, 1))])
        fits = solve(gram, times(rows, measured(y - self.candidate, equations.units)))
        return equations, sizes, units, jnp.concatenate([y, fits])

    def _conditions(self, y: Array) -> tuple[_Optimality, Array, Array]:
        """The Lagrange conditions, with the `sizes` and `units` of a state. These are no
        parameters: they only say in which units the unknowns are."""
        _, sizes, units, _ = tree_stop_gradient(self._at(y))
        equations = self.equations.dense()
        return _Optimality(equations, self.candidate, self.bounds, sizes), sizes, units

    def unknowns(self, solved: Solved) -> tuple[Array, Array]:
        return solved.y

    def defect(self, unknowns: tuple[Array, Array]) -> Array:
        y, multiplier = unknowns
        if not self._is_sought():
            return jnp.concatenate([self.candidate, multiplier])
        conditions, _, _ = self._conditions(y)
        known = jnp.where(jnp.isfinite(multiplier), multiplier, 0)
        return conditions(jnp.concatenate([y, known]))

    def linear_solution(self, solved: Solved, right: Array) -> tuple[Array, Array]:
        """Rows and columns of the Jacobian are scaled by the units. Only the nearest point has a
        derivative, so it is NaN where only the first phase succeeded. The result of a failed
        projection is discarded, and its derivative must stay finite."""
        y, multiplier = solved.y
        if not self._is_sought():
            tangent = jnp.full_like(right, jnp.nan)
            return tangent[: y.size], tangent[y.size :]
        conditions, sizes, units = self._conditions(y)
        known = jnp.where(jnp.isfinite(multiplier), multiplier, 0)
        matrix = jax.jacfwd(conditions)(jnp.concatenate([y, known]))
        # A component that is never moved has no unit, but its tangent is known: that of the
        # candidate.
        fixed = jnp.where(units == 0, right, 0)
        right = right - combined(fixed, matrix.T)
        rows = jnp.concatenate([jnp.where(units == 0, 1, units)[: y.size], sizes / units[y.size :]])
        rows = lax.stop_gradient(rows)
        tangent = fixed + units * solve_large(matrix / rows[:, None] * units, right / rows)
        gradients = self.equations.dense()
        gradients = scaled_rows(gradients.in_units(gradients.linearise(y)[1]))[1]
        is_known = well_conditioned(self.equations, y, gradients, gradients)
        is_known = is_known & jnp.all(jnp.isfinite(multiplier)) | ~self.equations.holds(y)
        tangent = known_if(is_known, tangent)
        return tangent[: y.size], tangent[y.size :]
