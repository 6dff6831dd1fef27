"""Solves with Gram matrices that may be singular, by Gaussian elimination without pivoting.

A Gram matrix is positive semi-definite, and `G W Hᵀ` for two nearby Jacobians nearly so. A pivot at
the level of roundoff, relative to its diagonal element, belongs to a constraint whose gradient
depends linearly on the earlier ones; its multiplier is set to zero, which is exact for consistent
constraints. (With damping instead, huge multipliers along the null vector would remain, and their
roundoff would move the state.) Gradients that are only nearly parallel are all kept, because the
correction needs the direction in which they differ.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int, PyTree, Real

Vector = PyTree[Real[Array, "..."]]  # a tuple of m scalars, or an array of shape (m,)


class GramSolver(NamedTuple):
    """`b ↦ (G W Hᵀ)⁻¹ b`, and the numerical rank of the matrix."""

    solve: Callable[[Vector], Vector]
    rank: Int[Array, ""]

    def scaled(self, rows: Vector, columns: Vector) -> "GramSolver":
        """The solver for the matrix with rows and columns multiplied by `rows` and `columns`."""

        def solve(b: Vector) -> Vector:
            x = self.solve(jtu.tree_map(jnp.divide, b, rows))
            # XLA merges two quotients into one, whose divisor can overflow; the `where` prevents
            # this.
            x = jtu.tree_map(lambda x, s: jnp.where(s < jnp.inf, x, jnp.nan), x, columns)
            return jtu.tree_map(jnp.divide, x, columns)

        return GramSolver(solve, self.rank)


def _least_pivot(m: int, dtype: jnp.dtype) -> float:
    return 4 * m * float(jnp.finfo(dtype).eps)


def unrolled_solver(gram: list[list[Array]], damping: Real[Array, ""] | float) -> GramSolver:
    """Elimination written out, for a matrix given as `m²` scalars."""
    m = len(gram)
    least = _least_pivot(m, gram[0][0].dtype)
    lu = [list(row) for row in gram]
    pivots = []
    rank = jnp.asarray(0)
    for k in range(m):
        pivot = lu[k][k] + damping * gram[k][k]
        regular = jnp.abs(pivot) > least * jnp.abs(gram[k][k])
        rank = rank + regular.astype(int)
        pivots.append(jnp.where(regular, pivot, jnp.inf))
        for i in range(k + 1, m):
            lu[i][k] = lu[i][k] / pivots[k]
            for j in range(k + 1, m):
                lu[i][j] = lu[i][j] - lu[i][k] * lu[k][j]

    def solve(b: Vector) -> Vector:
        x = list(b)
        for i in range(1, m):
            for j in range(i):
                x[i] = x[i] - lu[i][j] * x[j]
        for i in reversed(range(m)):
            for j in range(i + 1, m):
                x[i] = x[i] - lu[i][j] * x[j]
            # A division, not a product with the inverse: XLA recomputes cheap operations, and all
            # that they depend on, in every loop that uses them, but not divisions.
            x[i] = x[i] / pivots[i]
        return tuple(x)

    return GramSolver(solve, rank)


def dense_solver(gram: Real[Array, "m m"], damping: Real[Array, ""] | float) -> GramSolver:
    """Elimination in a loop over the pivots, each of which updates the whole matrix."""
    m = gram.shape[0]
    least = _least_pivot(m, gram.dtype)
    index = jnp.arange(m)
    # Rows are scaled to a unit diagonal, so that rows of very different size have comparable
    # pivots.
    diagonal = jnp.diagonal(gram)
    inverse = jnp.where(diagonal != 0, 1 / jnp.where(diagonal != 0, diagonal, 1), 0)
    scaled = gram * inverse[:, None]

    def eliminate(k: Array, factors: tuple[Array, Array]) -> tuple[Array, Array]:
        lower, upper = factors
        pivot = upper[k, k]
        regular = jnp.abs(pivot) > least
        used = (index > k) & regular
        column = jnp.where(used, upper[:, k] / jnp.where(regular, pivot, 1), 0)
        upper = upper - column[:, None] * upper[k][None, :]
        return lower.at[:, k].add(column), upper

    identity = jnp.eye(m, dtype=gram.dtype)
    lower, upper = lax.fori_loop(0, m, eliminate, (identity, scaled + damping * identity))
    kept = jnp.abs(jnp.diagonal(upper)) > least

    # Substitution by columns, in loops: XLA cannot compile a loop that contains a library call,
    # such as a triangular solve, into one kernel.
    def forward(k: Array, x: Array) -> Array:
        return x - jnp.where(index > k, lower[:, k] * x[k], 0)

    def backward(i: Array, x: Array) -> Array:
        k = m - 1 - i
        value = jnp.where(kept[k], x[k] / jnp.where(kept[k], upper[k, k], 1), 0)
        x = x - jnp.where(index < k, upper[:, k] * value, 0)
        return x.at[k].set(value)

    def solve(b: Vector) -> Vector:
        x = lax.fori_loop(0, m, forward, b * inverse)
        return lax.fori_loop(0, m, backward, x)

    return GramSolver(solve, jnp.sum(kept))
