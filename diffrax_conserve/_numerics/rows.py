"""The rows of a Jacobian, and their Gram matrices `U Vᵀ`, one row for each constraint.

A projection needs few operations with them, which are two interfaces, `AbstractRows` and
`AbstractGram`. Here are those of dense rows; sparse ones are in `sparse_rows`.

Gram matrices are singular where constraints depend on each other, as when an integral is given
twice. The multipliers are then not unique, but the correction is, if the constraints do not
contradict each other. There are three ways to solve such a system.

- Up to four constraints: Gaussian elimination with diagonal pivoting, written out in scalars in
  derivatives and for starts far away (`forward_elimination`), and as a loop in the simplified
  Newton iteration and in `RATTLE` (`ldu_factors`). The next constraint is that whose gradient has
  the largest angle to the span of the gradients before it. If the gradient is in this span, its
  pivot is roundoff, and the multiplier is set to zero: if the other constraints hold, this one
  holds too. Gradients that are only nearly parallel are all kept, because a correction needs the
  direction in which they differ. A derivative does not need it, and would lose its digits in that
  direction; see `implicit`. Below double precision, the last iteration, which only polishes, does
  not need it either; see `iterate`.
- More constraints: elimination without pivoting for up to sixteen, otherwise LU factors by LAPACK,
  with a small share of the diagonal added, so that no pivot vanishes. In a derivative the share is
  the least pivot that counts, so that smaller ones have hardly an effect.
- A sparse matrix: factors in blocks, with one share for corrections and derivatives.
"""

import abc
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, final, runtime_checkable

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._constants import MAX_ELIMINATION, MAX_PIVOTED
from .._tree import eps_of
from .linear import (
    Solve,
    diagonal_shift,
    forward_elimination,
    iterative_refinement,
    ldu_factors,
    ldu_solution,
    lu_factors,
    lu_solution,
    natural_order,
    roundoff_pivot_tolerance,
)

Rows = TypeVar("Rows", bound="AbstractRows")


@runtime_checkable
class HasSizes(Protocol):
    """A matrix that knows how large the terms of its products are."""

    def absolute_matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """`|U| x`."""
        ...


class AbstractRows(eqx.Module):
    """The rows `U` of a Jacobian, or of one whose columns were scaled."""

    @abc.abstractmethod
    def __len__(self) -> int: ...

    @abc.abstractmethod
    def matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """`U x`."""

    @abc.abstractmethod
    def rmatvec(self, multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
        """`Uᵀ λ`."""

    @abc.abstractmethod
    def gram(self, others: Any) -> Any:
        """`U Vᵀ`, an `AbstractGram`, for other rows of the same kind."""

    @abc.abstractmethod
    def scale_columns(self: Rows, x: Float[Array, " n"]) -> Rows:
        """`U diag(x)`."""

    @abc.abstractmethod
    def divide_rows(self: Rows, row_scales: Float[Array, "m *lanes"]) -> Rows:
        """`diag(row_scales)⁻¹ U`."""

    @abc.abstractmethod
    def largest_in_rows(self) -> Float[Array, "m *lanes"]:
        """The absolute value of the largest element of each row."""

    @abc.abstractmethod
    def largest_in_columns(self) -> Float[Array, " n"]:
        """The absolute value of the largest element of each column."""

    @abc.abstractmethod
    def map_rows(self: Rows, linear: Callable[[Array], Array], n: int) -> Rows:
        """A linear function of `n` numbers, applied to each row."""

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*jtu.tree_leaves(self))

    @property
    def is_large(self) -> bool:
        """Whether units may differ by any ratio, as along a grid in which voltages decay."""
        return False

    def absolute_matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """`|U| x`."""
        return jtu.tree_map(jnp.abs, self).matvec(x)

    def equilibrated(self: Rows) -> tuple[Float[Array, "m *lanes"], Rows]:
        """The scales of the rows, and the rows divided by them. A scale is the largest element of
        its row, or one if all are zero.

        The products in a Gram matrix could otherwise overflow or underflow in float32. In float64
        they do not in usual units, so there the scales of a few constraints are one, which saves
        time.
        """
        if self.dtype == jnp.float64 and not self.is_large:
            like = jax.eval_shape(self.largest_in_rows)  # with the lanes, if they are the last axis
            return jnp.ones(like.shape, like.dtype), self
        row_scales = lax.stop_gradient(self.largest_in_rows())
        row_scales = jnp.where(row_scales > 0, row_scales, 1)
        return row_scales, self.divide_rows(row_scales)

    def normalised(self: Rows) -> tuple[Float[Array, " m"], Rows]:
        """The norms of the rows, and the rows divided by them, so that the pivots of their Gram
        matrix are squares of sines. As no correction depends on the norms, they have no derivative:
        that of a row of zeros, of what is not asked for, would be NaN. Sparse rows are only
        equilibrated, because the pivots of a sparse matrix are not compared with
        `pivot_tolerance`."""
        return self.equilibrated()

    def derivative_pivot_tolerance(self) -> float:
        """The least pivot of normalised rows that counts in a derivative, `√ε`. As a pivot has an
        error of about `ε`, half of the digits of what is divided by it are right."""
        return eps_of(self.dtype) ** 0.5

    def multiplier(self, change: Float[Array, " n"], directions: Any) -> Float[Array, " m"]:
        """The `λ` for which `U Vᵀ λ = U change`, without nearly dependent rows. With its own rows
        as the `directions`, the rows `V`, the change `Uᵀ λ` is the nearest to the given one."""
        return self.gram(directions).solve(
            self.matvec(change), pivot_tolerance=self.derivative_pivot_tolerance()
        )


class AbstractGram(eqx.Module):
    """A square matrix `U Vᵀ`. It need not be symmetric, as `U` and `V` may differ.

    A matrix of up to four rows drops pivots of at most `pivot_tolerance`, by default roundoff;
    its `factorise` uses this default always. A larger one adds this share of its diagonal to it, by
    default `diagonal_shift`. A sparse one does not use it.
    """

    @abc.abstractmethod
    def matvec(self, x: Float[Array, " m"]) -> Float[Array, " m"]:
        """`U Vᵀ x`."""

    @abc.abstractmethod
    def factorise(self, *, pivot_tolerance: float | Array | None = None) -> Solve:
        """`(U Vᵀ)⁻¹ b` as a function of `b`, which is a PyTree of the factors. The share of the
        diagonal that is added to a large matrix makes an error, which `solve` removes by iterative
        refinement, and an iteration by its further steps."""

    def solve(
        self, b: Float[Array, " m"], *, pivot_tolerance: float | Array | None = None
    ) -> Float[Array, " m"]:
        """`(U Vᵀ)⁻¹ b`."""
        return iterative_refinement(self.factorise(pivot_tolerance=pivot_tolerance), self.matvec, b)

    def row_space_correction(
        self,
        directions: Any,
        b: Float[Array, " m"],
        *,
        pivot_tolerance: float | Array | None = None,
    ) -> Float[Array, " n"]:
        """`Vᵀ (U Vᵀ)⁻¹ b`, the combination of the rows `V` that changes `U x` by `b`.
        `directions`: the rows `V`."""
        return directions.rmatvec(self.solve(b, pivot_tolerance=pivot_tolerance))


@final
class DenseRows(AbstractRows):
    """Rows as a matrix. For scaling, the lanes of a batch may be its last axis."""

    matrix: Float[Array, "m n *lanes"]

    def __len__(self) -> int:
        return len(self.matrix)

    def matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return _transposed_product(x, self.matrix.T)

    def rmatvec(self, multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
        return _transposed_product(multiplier, self.matrix)

    def gram(self, others: "DenseRows") -> "PivotedGram | RegularisedGram":
        if len(self) > MAX_PIVOTED:
            product = jnp.matmul(self.matrix, others.matrix.T, precision=lax.Precision.HIGHEST)
            return RegularisedGram(product)
        return PivotedGram(jnp.sum(self.matrix[:, None, :] * others.matrix[None], axis=2))

    def scale_columns(self, x: Float[Array, " n"]) -> "DenseRows":
        return DenseRows(self.matrix * jnp.broadcast_to(x, self.matrix.shape))

    def divide_rows(self, row_scales: Float[Array, "m *lanes"]) -> "DenseRows":
        return DenseRows(self.matrix / row_scales[:, None])

    def largest_in_rows(self) -> Float[Array, "m *lanes"]:
        return jnp.max(jnp.abs(self.matrix), axis=1)

    def largest_in_columns(self) -> Float[Array, " n"]:
        return jnp.max(jnp.abs(self.matrix), axis=0)

    def map_rows(self, linear: Callable[[Array], Array], n: int) -> "DenseRows":
        del n
        return DenseRows(jax.vmap(linear)(self.matrix))

    def absolute_matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return jnp.sum(jnp.abs(self.matrix) * x[None], axis=1)

    def normalised(self) -> tuple[Float[Array, " m"], "DenseRows"]:
        row_scales, rows = self.equilibrated()
        norms = lax.stop_gradient(jnp.linalg.norm(rows.matrix, axis=1))
        norms = jnp.where(norms > 0, norms, 1)
        return row_scales * norms, rows.divide_rows(norms)


class _DenseGram(AbstractGram):
    """A Gram matrix as a matrix."""

    matrix: Float[Array, "m m"]

    def matvec(self, x: Float[Array, " m"]) -> Float[Array, " m"]:
        return _transposed_product(x, self.matrix.T)


@final
class PivotedGram(_DenseGram):
    """The Gram matrix of up to four rows."""

    def factorise(self, *, pivot_tolerance: float | Array | None = None) -> Solve:
        del pivot_tolerance
        tolerance = roundoff_pivot_tolerance(self.matrix.dtype)
        factors = ldu_factors(self.matrix, pivot_tolerance=tolerance, pivoting=True)
        return jtu.Partial(ldu_solution, *factors)

    def solve(
        self, b: Float[Array, " m"], *, pivot_tolerance: float | Array | None = None
    ) -> Float[Array, " m"]:
        one = DenseRows(jnp.eye(len(b), dtype=b.dtype))
        return self.row_space_correction(one, b, pivot_tolerance=pivot_tolerance)

    def row_space_correction(
        self,
        directions: DenseRows,
        b: Float[Array, " m"],
        *,
        pivot_tolerance: float | Array | None = None,
    ) -> Float[Array, " n"]:
        """If gradients are nearly parallel, the multipliers `(U Vᵀ)⁻¹ b` are large and cancel in
        the sum. XLA may evaluate `b` once for each of them, and round it differently each time, and
        then they do not cancel. So we do not form the multipliers. With the factors `U Vᵀ = L R` we
        compute `(R⁻ᵀ V)ᵀ (L⁻¹ b)`: the elimination takes the differences of nearly parallel rows
        before anything is large."""
        reduced_rows, right = forward_elimination(
            self.matrix, b, directions.matrix, pivot_tolerance=pivot_tolerance
        )
        return _transposed_product(right, reduced_rows)


@final
class RegularisedGram(_DenseGram):
    """The Gram matrix of more rows."""

    def factorise(self, *, pivot_tolerance: float | Array | None = None) -> Solve:
        relative_shift = (
            diagonal_shift(len(self.matrix), self.matrix.dtype)
            if pivot_tolerance is None
            else pivot_tolerance
        )
        if len(self.matrix) <= MAX_ELIMINATION:
            matrix = self.matrix.astype(np.promote_types(self.matrix.dtype, np.float32))
            factors, _ = ldu_factors(matrix, relative_shift=relative_shift)
            return jtu.Partial(ldu_solution, factors, natural_order(len(factors), []))
        # To invert larger factors takes longer than the few substitutions of a step.
        matrix, equilibration = _equilibrated(self.matrix)
        dtype = np.promote_types(matrix.dtype, np.float32)  # LAPACK has no half precision
        matrix = matrix.astype(dtype) + relative_shift * jnp.eye(len(matrix), dtype=dtype)
        return _Equilibrated(jtu.Partial(lu_solution, lu_factors(matrix)), equilibration, dtype)


class _Equilibrated(eqx.Module):
    """`A⁻¹ b` by a `solve` for `D A D`, where `equilibration` is the diagonal of `D`."""

    solve: Solve
    equilibration: Float[Array, " m"]
    dtype: Any = eqx.field(static=True)

    def __call__(self, b: Float[Array, " m"]) -> Float[Array, " m"]:
        x = self.solve((b * self.equilibration).astype(self.dtype))
        return x.astype(b.dtype) * self.equilibration


def _equilibrated(matrix: Float[Array, "m m"]) -> tuple[Array, Float[Array, " m"]]:
    """The matrix with its rows and columns multiplied by factors such that the diagonal is one in
    size, or zero where it was, and the factors."""
    diagonal = jnp.abs(jnp.diagonal(matrix))
    equilibration = lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    return matrix * equilibration[:, None] * equilibration[None], equilibration


def _transposed_product(x: Float[Array, " m"], rows: Float[Array, "m n"]) -> Float[Array, " n"]:
    """`rowsᵀ x`. A short sum is a reduction, which XLA fuses with what is around it."""
    if len(rows) > MAX_PIVOTED:
        return jnp.matmul(x, rows, precision=lax.Precision.HIGHEST)
    return jnp.sum(x[:, None] * rows, axis=0)


def solve_dense(matrix: Float[Array, "m m"], b: Float[Array, " m"]) -> Float[Array, " m"]:
    """`matrix⁻¹ b`."""
    return (PivotedGram(matrix) if len(b) <= MAX_PIVOTED else RegularisedGram(matrix)).solve(b)


def solve_kkt(n: int, matrix: Float[Array, "N N"], b: Float[Array, " N"]) -> Float[Array, " N"]:
    """`matrix⁻¹ b` for equations of `n` components of the state and of multipliers,
    `A y + B λ = b₁` and `G y = b₂`, without the multipliers whose gradients are nearly parallel;
    see `implicit`.

    The state is eliminated first. The matrix `A` alone may be singular, so we add to the first
    equations the second ones times the transpose of `G`, which does not change the solution. All
    rows of `G` and columns of `B` are taken with the length one, so that nothing depends on the
    units of the multipliers.
    """
    row_norms, rows = DenseRows(matrix[n:, :n]).normalised()
    column_norms, directions = DenseRows(matrix[:n, n:].T).normalised()
    columns = DenseRows(rows.matrix.T)
    factors = lu_factors(matrix[:n, :n] + columns.gram(columns).matrix)
    directions = DenseRows(lu_solution(factors, directions.matrix.T).T)
    second = b[n:] / row_norms
    first = lu_solution(factors, b[:n] + rows.rmatvec(second))
    defect = rows.matvec(first) - second
    multiplier = rows.gram(directions).solve(
        defect, pivot_tolerance=rows.derivative_pivot_tolerance()
    )
    return jnp.concatenate([first - directions.rmatvec(multiplier), multiplier / column_norms])
