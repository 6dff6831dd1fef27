"""The constraint Jacobian `G`, and linear solves with Gram matrices `G W Hᵀ`.

Vectors of `m` numbers (residuals, multipliers) come in two forms, and code that uses them must
treat them as PyTrees: one array of shape `(m,)`, which compiles fast, or a tuple of `m` scalars,
which runs fast if there are few: each product, sum and 2×2 solve is plain elementwise arithmetic
that XLA fuses into the step around it (a `linalg` call on a 2×2 matrix costs more than the step
itself). For very many constraints the rows are never formed.
"""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree, Real

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import DENSE_MAX, estimated_norms, evaluate
from .._scalars import elements_in_scalars
from .._tree import tree_dot, tree_mul, working_dtype
from ._elimination import GramSolver, Vector, dense_solver, unrolled_solver

Residual = Callable[[Y], Vector]

# Up to this many constraints are unrolled: the ten integrals of gravitating bodies. Compile time
# grows as m³, against a loop that costs some microseconds however small the matrix.
UNROLLED_MAX = 10


class AbstractJacobian(eqx.Module):
    """The rows `∂g_i/∂y` at one state, each shaped like the state."""

    # How many iterations to make before asking whether they are needed. Enough for nearly every
    # step of an integrator where they are cheap: so in a batch no lane waits for a loop that it
    # does not need.
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
    def squared_norms(self, weights: Y) -> Vector:
        """The diagonal of `G W Gᵀ`."""

    @abc.abstractmethod
    def gram_solver(
        self,
        weights: Y,
        other: Any = None,
        damping: Real[Array, ""] | float = 0.0,
    ) -> GramSolver:
        """Solves with `G W Hᵀ`, where `H` is `other`, a Jacobian of the same kind, or `G`.

        `damping` is relative to the diagonal, to which it is added.
        """


def linearise(residual: Residual, y: Y) -> tuple[Vector, AbstractJacobian]:
    """`g(y)` and `G(y)`."""
    struct = eqx.filter_eval_shape(residual, y)
    if isinstance(struct, tuple):
        # One reverse pass per constraint, each of which touches only what that constraint depends
        # on; XLA merges the forward passes.
        fns = [lambda y, i=i: residual(y)[i] for i in range(len(struct))]
        fns = residual.fns if isinstance(residual, Elements) else fns
        outs, rows = zip(*(jax.value_and_grad(fn)(y) for fn in fns), strict=True)
        return outs, _Unrolled(rows)
    out, vjp = jax.vjp(residual, y)
    if out.size > DENSE_MAX:
        _, jvp = jax.linearize(residual, y)
        return out, _MatrixFree(jvp, lambda multiplier: vjp(multiplier)[0])
    (rows,) = jax.vmap(vjp)(jnp.eye(out.size, dtype=out.dtype))
    return out, _Dense(rows)


def residual_parts(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args, dtype: jnp.dtype
) -> list[Array]:
    """What the functions of the manifold return less their conserved values, in `dtype`."""
    out = evaluate(manifold, t, y, args)
    residuals = jtu.tree_map(lambda a, b: a - jnp.asarray(b, a.dtype), out, values)
    return [x.astype(dtype) for x in jtu.tree_leaves(residuals)]


def joined(parts: list[Array]) -> Real[Array, " m"]:
    """Arrays of any shapes as one vector."""
    return jnp.concatenate([x.reshape(-1) for x in parts])


class Joined(eqx.Module):
    """A residual of shape `(m,)`, joined from the arrays that `parts` returns."""

    parts: Callable[[Y], list[Array]]

    def __call__(self, y: Y) -> Real[Array, " m"]:
        return joined(self.parts(y))


class Elements(eqx.Module):
    """A residual given as a list of functions, whose values are a tuple of scalars."""

    fns: list[Residual]

    @classmethod
    def of(cls, residual: Joined, y: Y) -> "Elements":
        # Of the parts, not of the whole: the gradient of an element of that would be made of the
        # gradients of all parts, most of them times zero.
        sizes = [x.size for x in eqx.filter_eval_shape(residual.parts, y)]

        def element(part: int, i: int) -> Residual:
            return lambda y: residual.parts(y)[part].reshape(-1)[i]

        return cls([element(part, i) for part, size in enumerate(sizes) for i in range(size)])

    def __call__(self, y: Y) -> tuple[Array, ...]:
        return tuple(fn(y) for fn in self.fns)


def written_out(
    residual: Joined, magnitude: Real[Array, " m"], y: Y
) -> tuple[Joined | Elements, Vector, Callable[[Y], Y], Callable[[Y], Y]]:
    """The same residual and magnitude with scalars in the place of vectors, if they are few, and
    of states, if they are small, and the maps to its states and back."""
    if magnitude.size > UNROLLED_MAX:
        return residual, magnitude, _same, _same
    converted = elements_in_scalars(residual, y)
    if converted is None:
        return Elements.of(residual, y), tuple(magnitude), _same, _same
    fns, split, join = converted
    return Elements(fns), tuple(magnitude), split, join


def _same(y: Y) -> Y:
    return y


def as_array(vector: Vector) -> Real[Array, " m"]:
    """A vector in either form, of shape `(m,)`."""
    return jnp.stack(vector) if isinstance(vector, tuple) else vector


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
    ) -> GramSolver:
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
        return unrolled_solver(gram, damping)


@final
class _Dense(AbstractJacobian):
    rows: PyTree[Array]  # each leaf with a leading axis of length m

    def pullback(self, multiplier: Vector) -> Y:
        return jtu.tree_map(lambda x: _contract(multiplier.astype(x.dtype), x), self.rows)

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
    ) -> GramSolver:
        columns = self.rows if other is None else other.rows
        dtype = working_dtype(columns)

        def product(row: Array, column: Array, weight: Array) -> Array:
            m = row.shape[0]
            weighted = column * weight.astype(column.dtype)[None]
            return _contract(row.reshape(m, -1), weighted.reshape(m, -1).T).astype(dtype)

        products = jtu.tree_leaves(jtu.tree_map(product, self.rows, columns, weights))
        gram = ft.reduce(jnp.add, products)
        if len(gram) > UNROLLED_MAX:
            return dense_solver(gram, damping)
        solver = unrolled_solver([[*row] for row in gram], damping)
        return GramSolver(lambda b: jnp.stack(solver.solve(tuple(b))), solver.rank)


def _contract(a: Array, b: Array) -> Array:
    """`a @ b`, over the last axis of `a` and the first of `b`, for small arrays in a way that XLA
    fuses and compiles into a loop around it."""
    if a.size * b.size > _SMALL:
        return jnp.tensordot(a, b, axes=1, precision=lax.Precision.HIGHEST)
    axis = a.ndim - 1
    a = jnp.expand_dims(a, range(a.ndim, axis + b.ndim))
    return jnp.sum(a * jnp.expand_dims(b, range(axis)), axis=axis)


_SMALL = 4096


# The accuracy of one iterative solve. The iteration around it corrects what is left, so the total
# number of inner iterations hardly depends on it.
_SOLVE_RTOL = 1e-4
# With two different Jacobians, how often the solve with one is corrected: to roundoff.
_CORRECTIONS = 4


@final
class _MatrixFree(AbstractJacobian):
    """Only products: `G y` by forward mode, `Gᵀ λ` by reverse mode, solves by conjugate gradients.

    Memory is that of a few states. Norms of rows are estimates, good to about a third: see
    `estimated_norms`.
    """

    forward: Callable[[Y], Vector]
    backward: Callable[[Vector], Y]
    inline_steps: ClassVar[int] = 0

    def pullback(self, multiplier: Vector) -> Y:
        return self.backward(multiplier)

    def pushforward(self, y: Y) -> Vector:
        return self.forward(y)

    def scale(self, y: Y) -> Vector:
        return estimated_norms(self.forward, y)

    def squared_norms(self, weights: Y) -> Vector:
        return jnp.square(estimated_norms(self.forward, jtu.tree_map(jnp.sqrt, weights)))

    def gram_solver(
        self,
        weights: Y,
        other: Any = None,
        damping: Real[Array, ""] | float = 0.0,
    ) -> GramSolver:
        diagonal = self.squared_norms(weights)
        diagonal = jnp.where(diagonal > 0, diagonal, 1)
        struct = jax.eval_shape(lambda: diagonal)

        def symmetric(x: Vector) -> Vector:
            return self.forward(tree_mul(self.backward(x), weights)) + damping * diagonal * x

        tag = lx.positive_semidefinite_tag
        operator = lx.FunctionLinearOperator(symmetric, struct, tag)
        preconditioner = lx.TaggedLinearOperator(lx.DiagonalLinearOperator(1 / diagonal), tag)
        solver = lx.CG(rtol=_SOLVE_RTOL, atol=float(jnp.finfo(diagonal.dtype).tiny))

        def solve(b: Vector) -> Vector:
            options = dict(preconditioner=preconditioner)
            return lx.linear_solve(operator, b, solver, options=options, throw=False).value

        def corrected(b: Vector) -> Vector:
            x = solve(b)
            for _ in range(_CORRECTIONS):
                product = self.forward(tree_mul(other.backward(x), weights))
                x = x + solve(b - product)
            return x

        rank = jnp.asarray(diagonal.size)
        return GramSolver(solve if other is None else corrected, rank)
