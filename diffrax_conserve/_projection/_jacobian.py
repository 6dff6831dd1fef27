"""The constraint Jacobian `G`, and linear solves with Gram matrices `G W Hᵀ`.

Vectors of `m` numbers (residuals, multipliers) come in two forms, and code that uses them must
treat them as PyTrees: for few constraints a tuple of `m` scalars, so that each product, sum and
2×2 solve is plain elementwise arithmetic that XLA fuses into the step around it (a `linalg` call on
a 2×2 matrix costs more than the step itself); for many, one array of shape `(m,)`.
"""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real

from .._custom_types import Y
from .._tree import tree_dot, tree_mul, working_dtype

Vector = PyTree[Real[Array, "..."]]  # a tuple of m scalars, or an array of shape (m,)
Residual = Callable[[Y], Vector]

# Up to this many constraints are unrolled: work and compile time grow as m², against a call into
# LAPACK that costs some microseconds however small the matrix.
UNROLLED_MAX = 6


class AbstractJacobian(eqx.Module):
    """The rows `∂g_i/∂y` at one state, each shaped like the state."""

    @abc.abstractmethod
    def pullback(self, multiplier: Vector) -> Y:
        """`Gᵀ λ`, shaped like the state."""

    @abc.abstractmethod
    def pushforward(self, y: Y) -> Vector:
        """`G y`."""

    @abc.abstractmethod
    def scale(self, y: Y) -> Vector:
        """`Σ_k |y_k ∂g_i/∂y_k|`, the size of the terms that cancel in `g_i`."""

    @abc.abstractmethod
    def squared_norms(self, weights: Y) -> Vector:
        """The diagonal of `G W Gᵀ`."""

    @abc.abstractmethod
    def gram_solver(
        self,
        weights: Y,
        other: Any = None,
        damping: Real[Array, ""] | float = 0.0,
    ) -> Callable[[Vector], Vector]:
        """`b ↦ (G W Hᵀ)⁻¹ b`, where `H` is `other`, a Jacobian of the same kind, or `G`.

        `damping` is added to the diagonal after the rows are scaled to a diagonal of ones.
        """


def linearise(residual: Residual, y: Y) -> tuple[Vector, AbstractJacobian]:
    """`g(y)` and `G(y)`."""
    struct = eqx.filter_eval_shape(residual, y)
    if isinstance(struct, tuple):
        # One reverse pass per constraint, each of which touches only what that constraint depends
        # on; XLA merges the forward passes.
        outs, rows = zip(
            *(jax.value_and_grad(lambda y, i=i: residual(y)[i])(y) for i in range(len(struct))),
            strict=True,
        )
        return outs, _Unrolled(rows)
    out, vjp = jax.vjp(residual, y)
    (rows,) = jax.vmap(vjp)(jnp.eye(out.size, dtype=out.dtype))
    return out, _Dense(rows)


@final
class _Unrolled(AbstractJacobian):
    rows: tuple[Y, ...]

    def pullback(self, multiplier: Vector) -> Y:
        def combine(*leaves: Array) -> Array:
            terms = [c.astype(x.dtype) * x for c, x in zip(multiplier, leaves, strict=True)]
            return ft.reduce(jnp.add, terms)

        return jtu.tree_map(combine, *self.rows)

    def pushforward(self, y: Y) -> Vector:
        dtype = working_dtype(y)
        return tuple(tree_dot(row, y, dtype) for row in self.rows)

    def scale(self, y: Y) -> Vector:
        magnitude = jtu.tree_map(jnp.abs, y)
        dtype = working_dtype(y)
        return tuple(tree_dot(jtu.tree_map(jnp.abs, r), magnitude, dtype) for r in self.rows)

    def squared_norms(self, weights: Y) -> Vector:
        dtype = working_dtype(weights)
        return tuple(tree_dot(tree_mul(row, weights), row, dtype) for row in self.rows)

    def gram_solver(
        self,
        weights: Y,
        other: Any = None,
        damping: Real[Array, ""] | float = 0.0,
    ) -> Callable[[Vector], Vector]:
        columns = self.rows if other is None else other.rows
        dtype = working_dtype(columns[0])
        weighted = [tree_mul(column, weights) for column in columns]
        symmetric = other is None
        gram: list[list[Array]] = []
        for i, row in enumerate(self.rows):
            gram.append(
                [
                    gram[j][i] if symmetric and j < i else tree_dot(row, weighted[j], dtype)
                    for j in range(len(columns))
                ]
            )
        return _unrolled_solver(gram, damping)


@final
class _Dense(AbstractJacobian):
    rows: PyTree[Array]  # each leaf with a leading axis of length m

    def pullback(self, multiplier: Vector) -> Y:
        return jtu.tree_map(
            lambda x: jnp.tensordot(
                multiplier.astype(x.dtype), x, axes=1, precision=lax.Precision.HIGHEST
            ),
            self.rows,
        )

    def pushforward(self, y: Y) -> Vector:
        dtype = working_dtype(y)
        return jax.vmap(lambda row: tree_dot(row, y, dtype))(self.rows)

    def scale(self, y: Y) -> Vector:
        magnitude = jtu.tree_map(jnp.abs, y)
        dtype = working_dtype(y)
        return jax.vmap(lambda row: tree_dot(jtu.tree_map(jnp.abs, row), magnitude, dtype))(
            self.rows
        )

    def squared_norms(self, weights: Y) -> Vector:
        dtype = working_dtype(weights)
        return jax.vmap(lambda row: tree_dot(tree_mul(row, weights), row, dtype))(self.rows)

    def gram_solver(
        self,
        weights: Y,
        other: Any = None,
        damping: Real[Array, ""] | float = 0.0,
    ) -> Callable[[Vector], Vector]:
        columns = self.rows if other is None else other.rows
        dtype = working_dtype(columns)

        def product(row: Array, column: Array, weight: Array) -> Array:
            m = row.shape[0]
            weighted = column * weight.astype(column.dtype)[None]
            return jnp.matmul(
                row.reshape(m, -1), weighted.reshape(m, -1).T, precision=lax.Precision.HIGHEST
            ).astype(dtype)

        products = jtu.tree_leaves(jtu.tree_map(product, self.rows, columns, weights))
        gram = ft.reduce(jnp.add, products)
        inverse = _reciprocal(jnp.diagonal(gram))
        return _dense_solver(gram * inverse[:, None], inverse, damping)


# Rows are scaled so that the diagonal of the Gram matrix is 1. The factors are those of Gaussian
# elimination without pivoting: a Gram matrix is positive semi-definite, and `G W Hᵀ` of two nearby
# Jacobians nearly so. A pivot at the level of roundoff marks a constraint whose gradient depends on
# the earlier ones; its multiplier is zero, which changes nothing where the constraints are
# consistent. (Damping instead would leave huge multipliers along the null vector, whose roundoff
# moves the state.) Where gradients are merely almost parallel nothing is dropped: the direction in
# which they differ is the one that is needed.


def _least_pivot(m: int, dtype: jnp.dtype) -> float:
    return 4 * m * float(jnp.finfo(dtype).eps)


def _reciprocal(x: Array) -> Array:
    positive = x > 0
    return jnp.where(positive, 1 / jnp.where(positive, x, 1), 0)


def _unrolled_solver(
    gram: list[list[Array]], damping: Real[Array, ""] | float
) -> Callable[[Vector], Vector]:
    m = len(gram)
    least = _least_pivot(m, gram[0][0].dtype)
    inverse = [_reciprocal(gram[i][i]) for i in range(m)]
    lu = [[gram[i][j] * inverse[i] for j in range(m)] for i in range(m)]
    pivots = []
    for k in range(m):
        pivot = lu[k][k] + damping
        pivots.append(jnp.where(pivot > least, 1 / jnp.where(pivot > least, pivot, 1), 0))
        for i in range(k + 1, m):
            lu[i][k] = lu[i][k] * pivots[k]
            for j in range(k + 1, m):
                lu[i][j] = lu[i][j] - lu[i][k] * lu[k][j]

    def solve(b: Vector) -> Vector:
        x = [b[i] * inverse[i] for i in range(m)]
        for i in range(1, m):
            for j in range(i):
                x[i] = x[i] - lu[i][j] * x[j]
        for i in reversed(range(m)):
            for j in range(i + 1, m):
                x[i] = x[i] - lu[i][j] * x[j]
            x[i] = x[i] * pivots[i]
        return tuple(x)

    return solve


def _dense_solver(
    scaled: Real[Array, "m m"], inverse: Real[Array, " m"], damping: Real[Array, ""] | float
) -> Callable[[Vector], Vector]:
    m = scaled.shape[0]
    least = _least_pivot(m, scaled.dtype)
    index = jnp.arange(m)

    def eliminate(k: Array, factors: tuple[Array, Array]) -> tuple[Array, Array]:
        lower, upper = factors
        pivot = upper[k, k]
        used = (index > k) & (pivot > least)
        column = jnp.where(used, upper[:, k] / jnp.where(pivot > least, pivot, 1), 0)
        upper = upper - column[:, None] * upper[k][None, :]
        return lower.at[:, k].add(column), upper

    identity = jnp.eye(m, dtype=scaled.dtype)
    lower, upper = lax.fori_loop(0, m, eliminate, (identity, scaled + damping * identity))
    kept = jnp.diagonal(upper) > least
    upper = jnp.where(kept[:, None], upper, identity)

    def solve(b: Vector) -> Vector:
        x = jax.scipy.linalg.solve_triangular(lower, b * inverse, lower=True, unit_diagonal=True)
        return jax.scipy.linalg.solve_triangular(upper, jnp.where(kept, x, 0))

    return solve
