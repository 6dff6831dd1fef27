"""The linear systems of the implicit function theorem, for the state and the multipliers."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree

from .._custom_types import Y
from .elimination import Vector
from .jacobian import AbstractJacobian

# Systems with more unknowns are solved iteratively, without forming the matrix.
SYSTEM_DENSE_MAX = 256


def units(jacobian: AbstractJacobian, weights: Y) -> tuple[Y, Vector]:
    """Units for the components of the state and for the residuals that make the condition number of
    a system independent of the user's units: the square roots of the weights, and the norms of the
    rows of `G` in that metric."""
    roots = jtu.tree_map(jnp.sqrt, weights)
    return jtu.tree_map(lambda x: jnp.where(x > 0, x, 1), (roots, jacobian.scale(roots)))


def solve_linearised(
    fn: Callable[[Any], Any],
    unknowns: tuple[Y, Vector],
    right: tuple[Y, Vector],
    measured_in: tuple[Y, Vector],
) -> tuple[Y, Vector]:
    """The minimum-norm solution of `F' x = right`, where `F'` is the Jacobian of `fn` at
    `unknowns`. The unknowns are a state and multipliers; `fn` returns a state and residuals of the
    same shapes."""
    rows = lax.stop_gradient(measured_in)
    columns = rows[0], jtu.tree_map(lambda x: 1 / x, rows[1])

    def divided(a: PyTree[Array], b: PyTree[Array]) -> PyTree[Array]:
        return jtu.tree_map(jnp.divide, a, b)

    def scaled(x: tuple[Y, Vector]) -> tuple[Y, Vector]:
        return divided(fn(jtu.tree_map(jnp.multiply, x, columns)), rows)

    x, b = divided(unknowns, columns), divided(right, rows)
    flat, unravel = jfu.ravel_pytree(x)
    eps = float(jnp.finfo(flat.dtype).eps)
    if flat.size > SYSTEM_DENSE_MAX:
        tolerance = eps ** (2 / 3)
        operator = lx.JacobianLinearOperator(lambda y, _: scaled(y), x)
        solver = lx.GMRES(rtol=tolerance, atol=tolerance)
        solution = lx.linear_solve(operator, b, solver, throw=False).value
    else:
        matrix = jax.jacfwd(lambda x: jfu.ravel_pytree(scaled(unravel(x)))[0])(flat)
        solution = unravel(_shortest(matrix, jfu.ravel_pytree(b)[0], 64 * eps))
    return jtu.tree_map(jnp.multiply, solution, columns)


def _shortest(matrix: Array, b: Array, rcond: float) -> Array:
    """By singular values, because dependent constraints make the system singular but consistent. If
    `matrix` is not finite the solution is NaN, in forward and in reverse mode."""
    finite = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(finite, matrix, jnp.eye(len(b), dtype=matrix.dtype))
    u, s, vt = jnp.linalg.svd(lax.stop_gradient(matrix))
    inverse = jnp.where(s > rcond * s[0], 1 / s, 0)

    def solve(_: Any, b: Array) -> Array:
        return vt.T @ (inverse * (u.T @ b))

    def transposed(_: Any, b: Array) -> Array:
        return u @ (inverse * (vt @ b))

    solution = lax.custom_linear_solve(lambda x: matrix @ x, b, solve, transposed)
    return jnp.where(finite, 1, jnp.nan) * solution
