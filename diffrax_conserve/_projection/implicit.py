"""The linear systems of the implicit function theorem, in all unknowns of a projection."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, PyTree

# Above this many unknowns systems are solved iteratively, matrix-free.
SYSTEM_DENSE_MAX = 256


def solve_linearised(
    fn: Callable[[Any], Any], unknowns: PyTree[Array], right: PyTree[Array]
) -> PyTree[Array]:
    """The shortest solution of `F' x = right` for the Jacobian `F'` of `fn` at `unknowns`."""
    x, unravel = jfu.ravel_pytree(unknowns)
    b, _ = jfu.ravel_pytree(right)
    if x.size > SYSTEM_DENSE_MAX:
        eps = float(jnp.finfo(x.dtype).eps)
        tolerance = eps ** (2 / 3)
        operator = lx.JacobianLinearOperator(lambda y, _: fn(y), unknowns)
        solver = lx.GMRES(rtol=tolerance, atol=tolerance)
        return lx.linear_solve(operator, right, solver, throw=False).value
    matrix = jax.jacfwd(lambda x: jfu.ravel_pytree(fn(unravel(x)))[0])(x)
    # Rows and columns of comparable size, so that the condition is that of the problem.
    columns = lax.stop_gradient(_sizes(matrix, 0))
    rows = lax.stop_gradient(_sizes(matrix / columns, 1))
    scaled = matrix / columns / rows[:, None]
    finite = jnp.all(jnp.isfinite(scaled))
    operator = lx.MatrixLinearOperator(jnp.where(finite, scaled, jnp.eye(x.size, dtype=x.dtype)))
    # Dependent constraints make the system singular but consistent.
    solver = lx.SVD(rcond=64 * float(jnp.finfo(x.dtype).eps))
    solution = lx.linear_solve(operator, jnp.where(finite, b / rows, 0), solver, throw=False).value
    return unravel(jnp.where(finite, 1, jnp.nan) * solution / columns)


def _sizes(matrix: Array, axis: int) -> Array:
    size = jnp.max(jnp.abs(matrix), axis=axis)
    return jnp.where(size > 0, size, 1)
