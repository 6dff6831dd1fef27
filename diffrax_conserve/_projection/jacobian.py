"""The constraint Jacobian `G` at a state, and linear solves with Gram matrices, in three forms."""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree, Real

from .._custom_types import Y
from .._tree import tree_dot, tree_max, tree_mul, working_dtype
from .elimination import GramSolver, Vector, dense_solver, unrolled_solver

# Up to this many constraints are unrolled, enough for the ten integrals of the N-body problem.
# Unrolling makes compile time grow as m³; a loop costs some microseconds even for a small matrix.
UNROLLED_MAX = 10
_UNROLLED_IN_ARRAYS_MAX = 3


class AbstractJacobian(eqx.Module):
    """The rows `∂g_i/∂y` at one state, each shaped like the state."""

    # The number of iterations that are made before convergence is tested. Where iterations are
    # cheap, these are enough for nearly every step of an integrator.
    inline_steps: ClassVar[int] = 2

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
    def gram_solver(
        self, weights: Y, other: Any = None, damping: Real[Array, ""] | float = 0.0
    ) -> GramSolver:
        """Solves with `G W Hᵀ`, where `H` is `other`, a Jacobian of the same kind, or `G`.

        Rows are divided by their largest element before they are multiplied, so that no product
        overflows or underflows for any units. `damping` is relative to the diagonal, to which it is
        added.
        """

    def derivative_solver(self, weights: Y, other: Any) -> GramSolver:
        """`gram_solver(weights, other)`, for derivatives: with NaN where it is not accurate."""
        return self.gram_solver(weights, other)

    @abc.abstractmethod
    def unit_rows(self) -> tuple["AbstractJacobian", Vector]:
        """The Jacobian with each row divided by its largest element, and these divisors; unchanged
        where rows are not formed."""

    def sines(self, weights: Y) -> Real[Array, " m"] | None:
        """The sine of the angle between each row and the span of those before it, in the norm of
        `W`; `None` where no matrix is formed."""
        del weights


@final
class Unrolled(AbstractJacobian):
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
        rows, y = jtu.tree_map(jnp.abs, (self.rows, y))
        return Unrolled(rows).pushforward(y)

    def gram_solver(
        self, weights: Y, other: Any = None, damping: Real[Array, ""] | float = 0.0
    ) -> GramSolver:
        rows, row_sizes = self._normalised()
        columns, column_sizes = (rows, row_sizes) if other is None else other._normalised()
        dtype = working_dtype(columns[0])
        weighted = [tree_mul(column, weights) for column in columns]
        gram: list[list[Array]] = []
        for i, row in enumerate(rows):
            known = gram if other is None else []
            gram.append(
                [
                    known[j][i] if j < len(known) else tree_dot(row, weighted[j], dtype)
                    for j in range(len(columns))
                ]
            )
        return unrolled_solver(gram, damping).scaled(row_sizes, column_sizes)

    def unit_rows(self) -> tuple["Unrolled", Vector]:
        rows, sizes = self._normalised(always=True)
        return Unrolled(rows), sizes

    def _normalised(self, always: bool = False) -> tuple[tuple[Y, ...], Vector]:
        sizes = tuple(
            _size([jnp.max(jnp.abs(x), initial=0) for x in jtu.tree_leaves(r)], always)
            for r in self.rows
        )
        inverses = [1 / size for size in sizes]
        rows = tuple(
            jtu.tree_map(lambda x, s=inverse: x * s.astype(x.dtype), row)
            for row, inverse in zip(self.rows, inverses, strict=True)
        )
        return rows, sizes


@final
class Dense(AbstractJacobian):
    rows: PyTree[Array]  # each leaf with a leading axis of length m

    def pullback(self, multiplier: Vector) -> Y:
        return jtu.tree_map(lambda x: _contract(multiplier.astype(x.dtype), x), self.rows)

    def pushforward(self, y: Y) -> Vector:
        dtype = working_dtype(y)
        return jax.vmap(lambda row: tree_dot(row, y, dtype))(self.rows)

    def scale(self, y: Y) -> Vector:
        rows, y = jtu.tree_map(jnp.abs, (self.rows, y))
        return Dense(rows).pushforward(y)

    def gram_solver(
        self, weights: Y, other: Any = None, damping: Real[Array, ""] | float = 0.0
    ) -> GramSolver:
        rows, row_sizes = self._normalised()
        columns, column_sizes = (rows, row_sizes) if other is None else other._normalised()
        dtype = working_dtype(columns)

        def product(row: Array, column: Array, weight: Array) -> Array:
            m = row.shape[0]
            weighted = column * weight.astype(column.dtype)[None]
            return _contract(row.reshape(m, -1), weighted.reshape(m, -1).T).astype(dtype)

        gram = ft.reduce(jnp.add, jtu.tree_leaves(jtu.tree_map(product, rows, columns, weights)))
        if len(gram) > _UNROLLED_IN_ARRAYS_MAX:
            solver = dense_solver(gram, damping)
        else:
            unrolled = unrolled_solver([[*row] for row in gram], damping)
            solver = unrolled._replace(solve=lambda b: jnp.stack(unrolled.solve(tuple(b))))
        return solver.scaled(row_sizes, column_sizes)

    def sines(self, weights: Y) -> Real[Array, " m"]:
        rows, _ = self._normalised()
        weighted = jtu.tree_map(lambda x, w: x * jnp.sqrt(w).astype(x.dtype)[None], rows, weights)
        dtype = working_dtype(weights)
        single = dtype if jnp.finfo(dtype).bits >= 32 else jnp.float32  # as QR needs
        columns = jnp.concatenate(
            [x.reshape(len(x), -1).astype(single) for x in jtu.tree_leaves(weighted)], axis=1
        ).T
        norms = jnp.linalg.norm(columns, axis=0)
        triangle = jnp.linalg.qr(columns, mode="r")
        lengths = jnp.abs(jnp.diagonal(triangle))
        return jnp.where(norms > 0, lengths / jnp.where(norms > 0, norms, 1), 1).astype(dtype)

    def unit_rows(self) -> tuple["Dense", Vector]:
        rows, size = self._normalised(always=True)
        return Dense(rows), size

    def _normalised(self, always: bool = False) -> tuple[PyTree[Array], Vector]:
        size = _size(
            [
                jnp.max(jnp.abs(x.reshape(len(x), -1)), axis=1, initial=0)
                for x in jtu.tree_leaves(self.rows)
            ],
            always,
        )
        rows = jtu.tree_map(
            lambda x: x / size.astype(x.dtype).reshape(-1, *[1] * (x.ndim - 1)), self.rows
        )
        return rows, size


def _size(maxima: list[Array], always: bool) -> Array:
    """The largest element of each row, or one if all are zero. In float64 it is one unless
    `always`, because products of elements neither overflow nor underflow in usual units."""
    dtype = working_dtype(maxima)
    if dtype == jnp.float64 and not always:
        return jnp.ones_like(maxima[0])
    size = ft.reduce(jnp.maximum, [x.astype(dtype) for x in maxima])
    return jnp.where(size > 0, size, jnp.ones_like(size))


def _contract(a: Array, b: Array) -> Array:
    """The contraction of the last axis of `a` with the first of `b`. For small arrays it is written
    so that XLA fuses it into the surrounding loop."""
    if a.size * b.size > _SMALL:
        return jnp.tensordot(a, b, axes=1, precision=lax.Precision.HIGHEST)
    axis = a.ndim - 1
    a = jnp.expand_dims(a, range(a.ndim, axis + b.ndim))
    return jnp.sum(a * jnp.expand_dims(b, range(axis)), axis=axis)


_SMALL = 4096


# With two different Jacobians, the number of corrections of the solve with one of them, which reach
# roundoff.
_CORRECTIONS = 7


@final
class MatrixFree(AbstractJacobian):
    """Uses products only: `G y` by forward mode, `Gᵀ λ` by reverse mode, solves by conjugate
    gradients.

    It needs the memory of a few states. Norms of rows are estimates with a relative error of about
    a third: see `estimated_norms`.
    """

    forward: Callable[[Y], Vector]
    backward: Callable[[Vector], Y]
    inline_steps: ClassVar[int] = 0

    def pullback(self, multiplier: Vector) -> Y:
        return self.backward(multiplier)

    def pushforward(self, y: Y) -> Vector:
        return self.forward(y)

    def scale(self, y: Y) -> Vector:
        # Neither is more than the sum of the moduli; the second equals it where no terms cancel.
        return jnp.maximum(estimated_norms(self.forward, y), jnp.abs(self.forward(y)))

    def unit_rows(self) -> tuple["MatrixFree", Vector]:
        return self, jnp.asarray(1.0)  # weakly typed, so that it changes no dtype

    def _product(self, x: Vector, weights: Y, other: "MatrixFree") -> Vector:
        return self.forward(tree_mul(other.backward(x), weights))

    def derivative_solver(self, weights: Y, other: Any) -> GramSolver:
        approximate = self.gram_solver(weights)

        def checked(product: Callable[[Vector], Vector], b: Vector) -> Vector:
            x = _corrected(approximate.solve, product, b)
            tolerance = float(jnp.finfo(b.dtype).eps) ** 0.75 * tree_max(b)
            return jnp.where(tree_max(b - product(x)) <= tolerance, x, jnp.nan)

        def product(x: Vector) -> Vector:
            return self._product(x, weights, other)

        def solve(b: Vector) -> Vector:
            return lax.custom_linear_solve(product, b, checked, checked)

        return GramSolver(solve, approximate.rank)

    def gram_solver(
        self, weights: Y, other: Any = None, damping: Real[Array, ""] | float = 0.0
    ) -> GramSolver:
        # The outer iteration corrects the remaining error, so the total number of inner iterations
        # hardly depends on the tolerance.
        solver = lx.CG(rtol=1e-4, atol=1e-4)
        return lineax_solver(solver, self, weights, other, damping)


def lineax_solver(
    linear_solver: lx.AbstractLinearSolver,
    jacobian: AbstractJacobian,
    weights: Y,
    other: AbstractJacobian | None = None,
    damping: Real[Array, ""] | float = 0.0,
) -> GramSolver:
    """As `jacobian.gram_solver`, by a solver of lineax for positive semi-definite operators."""
    if other is jacobian:
        other = None
    if other is not None and not isinstance(jacobian, MatrixFree):
        return jacobian.gram_solver(weights, other, damping)  # not symmetric
    rows, row_sizes = jacobian.unit_rows()
    columns, column_sizes = (rows, row_sizes) if other is None else other.unit_rows()
    roots = jtu.tree_map(jnp.sqrt, weights)
    many = isinstance(rows, MatrixFree)
    norms = estimated_norms(rows.forward, roots) if many else rows.scale(roots)
    diagonal = jtu.tree_map(jnp.square, norms)
    # If constraints depend on each other, the roundoff of their residuals does not. Undamped, it
    # would be solved for, by huge multipliers.
    damping = jnp.maximum(damping, float(jnp.finfo(working_dtype(diagonal)).eps) ** 0.75)

    def product(x: Vector, columns: AbstractJacobian = rows) -> Vector:
        g = rows.pushforward(tree_mul(columns.pullback(x), weights))
        return jtu.tree_map(lambda g, d, x: g + damping * d * x, g, diagonal, x)

    struct, tag = jax.eval_shape(lambda: diagonal), lx.positive_semidefinite_tag
    operator, options = lx.FunctionLinearOperator(product, struct, tag), {}
    if many:
        inverse = lx.DiagonalLinearOperator(1 / jnp.where(diagonal > 0, diagonal, 1))
        options = dict(preconditioner=lx.TaggedLinearOperator(inverse, tag))
        rank = jnp.asarray(diagonal.size)
    else:
        rank = jacobian.gram_solver(weights).rank

    def solve(b: Vector) -> Vector:
        # An absolute tolerance is relative to `b`, and zero is solved by zero.
        size = tree_max(b)
        found = jnp.where((size > 0) & (size < jnp.inf), size, 1)
        unit = jtu.tree_map(lambda b: jnp.where(size == 0, 1, b / found), b)
        x = lx.linear_solve(operator, unit, linear_solver, options=options, throw=False).value
        return jtu.tree_map(lambda x: jnp.where(size == 0, 0, x * found), x)

    def corrected(b: Vector) -> Vector:
        return _corrected(solve, lambda x: product(x, columns), b)

    return GramSolver(solve if other is None else corrected, rank).scaled(row_sizes, column_sizes)


def _corrected(
    solve: Callable[[Vector], Vector], product: Callable[[Vector], Vector], b: Vector
) -> Vector:
    """The solution of `product(x) = b`, if `solve` solves with a similar matrix."""
    x = solve(b)
    for _ in range(_CORRECTIONS):
        left = jtu.tree_map(jnp.subtract, b, product(x))
        x = jtu.tree_map(jnp.add, x, solve(left))
    return x


def estimated_norms(linear: Callable[[Y], Vector], weights: Y) -> Vector:
    """The norms of the rows of `G diag(weights)`, where `linear` is `y ↦ G y`.

    No row is formed: for random signs `s` the mean of `(G (weights s))²` is the squared norm. The
    mean over 16 fixed draws has a relative error of about a third.
    """
    leaves, treedef = jtu.tree_flatten(weights)
    keys = jr.split(jr.key(0), len(leaves))

    def probe(index: Array) -> Vector:
        signed = [
            jr.rademacher(jr.fold_in(key, index), jnp.shape(leaf), jnp.result_type(leaf)) * leaf
            for key, leaf in zip(keys, leaves, strict=True)
        ]
        return jnp.square(linear(jtu.tree_unflatten(treedef, signed)))

    return jnp.sqrt(jnp.mean(jax.vmap(probe)(jnp.arange(16)), axis=0))
