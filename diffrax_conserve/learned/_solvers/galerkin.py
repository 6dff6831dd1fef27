"""The equations of a step that fits random features, their solution and its error.

With the basis `q_k` of slopes, `s` the fraction of the step and `u(s) = u0 + Σ_k d_k ∫_0^s q_k`,
the `d_k` solve `d = P h f(t, u0 + Q d)`, where `Q` integrates, and `P` fits values at the Gauss
points by least squares: `u'` is the best approximation of `h f(t0 + s h, u)` in the span of the
basis. There are more points than members.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .chebyshev import multiply
from .feature_basis import FeatureBasis

Coefficients = Float[Array, "members n"]
Errors = Float[Array, "wide n"]

# If Newton's method has not converged by then, a shorter step is cheaper.
_MAX_STEPS = 10


class StepEquations(NamedTuple):
    """`d = P h f(t, u0 + Q d)` for one step, with the state as a vector."""

    basis: FeatureBasis
    increment: Callable[[Array, Array], Array]  # (s, u) -> h f(t0 + s h, u)
    y0: Float[Array, " n"]

    def states(self, coefficients: Coefficients) -> Float[Array, "points n"]:
        """`u` at the Gauss points."""
        integrals = self.basis.integrals[:, : len(coefficients)]
        return self.y0 + multiply(integrals, coefficients)

    def slopes(self, states: Float[Array, "points n"]) -> Float[Array, "points n"]:
        """`h f` at the Gauss points."""
        return jax.vmap(self.increment)(self._fractions(), states)

    def jacobians(self, states: Float[Array, "points n"]) -> Float[Array, "points n n"]:
        """`h ∂f/∂u` at the Gauss points."""
        return jax.vmap(jax.jacfwd(self.increment, argnums=1))(self._fractions(), states)

    def residual(self, coefficients: Coefficients) -> Coefficients:
        """`d - P h f`."""
        fit = self.basis.fit[: len(coefficients)]
        return coefficients - multiply(fit, self.slopes(self.states(coefficients)))

    def solve_linear(
        self, jacobians: Float[Array, "points n n"], right: Coefficients
    ) -> Coefficients:
        """`(1 - P h ∂f/∂u Q)⁻¹` applied to `right`, which has one row for each member in use."""
        count, n = right.shape
        fit, integrals = self.basis.fit[:count], self.basis.integrals[:, :count]
        products = multiply(
            (fit[:, None, :] * integrals.T[None]).reshape(count * count, -1),
            jacobians.reshape(-1, n * n),
        )
        coupling = products.reshape(count, count, n, n).swapaxes(1, 2).reshape(count * n, count * n)
        matrix = jnp.eye(count * n, dtype=right.dtype) - coupling
        return jnp.linalg.solve(matrix, right.ravel()).reshape(count, n)

    def _fractions(self) -> Float[Array, " points"]:
        return jnp.asarray(self.basis.fractions, self.y0.dtype)


def solve(equations: StepEquations) -> tuple[Coefficients, Bool[Array, ""]]:
    """The coefficients, and whether Newton's method converged. If not, they are zero: the state is
    then constant, where the vector field is finite, so that derivatives of a rejected step are
    finite.

    Derivatives follow from the implicit function theorem, not through the iteration.
    """
    slope = equations.increment(jnp.zeros((), equations.y0.dtype), equations.y0)
    rest = jnp.zeros((equations.basis.size - 1, slope.size), slope.dtype)
    start = jnp.concatenate([slope[None], rest])

    def tangent_solve(linear: Callable, right: Coefficients) -> Coefficients:
        units = jnp.eye(right.size, dtype=right.dtype).reshape(right.size, *right.shape)
        rows = jax.vmap(linear)(units).reshape(right.size, right.size)
        return jnp.linalg.solve(rows.T, right.ravel()).reshape(right.shape)

    # The flag is a floating-point number, because `custom_root` forms its tangent.
    coefficients, found = lax.custom_root(
        equations.residual,
        start,
        lambda residual, start: _newton(equations, residual, start),
        tangent_solve,
        has_aux=True,
    )
    return coefficients, found > 0


def _newton(
    equations: StepEquations, residual: Callable, start: Coefficients
) -> tuple[Coefficients, Float[Array, ""]]:
    tolerance = jnp.finfo(start.dtype).eps ** (2 / 3)

    def iterate(carry: tuple[Array, Coefficients, Array, Array]) -> tuple:
        _, coefficients, _, count = carry
        states = equations.states(coefficients)
        change = equations.solve_linear(equations.jacobians(states), residual(coefficients))
        size = jnp.max(jnp.abs(equations.states(change) - equations.y0))
        found = size <= tolerance * jnp.max(jnp.abs(states))
        unfinished = ~found & jnp.isfinite(size) & (count < _MAX_STEPS)
        return unfinished, coefficients - change, found, count + 1

    # The condition is carried, because a batched loop evaluates it in two places, which may round
    # differently.
    carry = (jnp.asarray(True), start, jnp.asarray(False), jnp.asarray(1))
    _, coefficients, found, _ = lax.while_loop(lambda carry: carry[0], iterate, carry)
    return jnp.where(found, coefficients, 0), found.astype(start.dtype)


def error(equations: StepEquations, coefficients: Coefficients) -> Errors:
    """The error of the solution over the step, in the wider basis, from its defect.

    The linearised equation of the error, `e' = h ∂f/∂u e + h f - u'`, is solved on the same points:
    one more linear system. Only the first member has a nonzero integral over the step, so the error
    at the end is the first row.
    """
    states = equations.states(coefficients)
    slopes = multiply(equations.basis.slopes[:, : len(coefficients)], coefficients)
    right = multiply(equations.basis.fit, equations.slopes(states) - slopes)
    return equations.solve_linear(equations.jacobians(states), right)


def dense_series(
    equations: StepEquations, coefficients: Coefficients, error: Errors
) -> Float[Array, "degrees n"]:
    """`u` over the step, as a Chebyshev series in `2 s - 1`.

    A Galerkin method is far more accurate at the end of a step than inside. So the estimated error
    is added inside the step, and the end is not changed.
    """
    inside = error.at[0].set(0).at[: len(coefficients)].add(coefficients)
    return multiply(equations.basis.series, inside).at[0].add(equations.y0)
