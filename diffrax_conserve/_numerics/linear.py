"""The elimination of small matrices, LAPACK's factors of large ones, and iterative refinement."""

import functools as ft
import operator as op
from collections.abc import Callable, Sequence
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact

from .._constants import MAX_UNROLLED_SUM, NUM_REFINEMENTS, REGULARISATION_POWER, TOLERANCE_IN_EPS
from .._tree import eps_of

Solve = Callable[[Float[Array, " m"]], Float[Array, " m"]]


def computed_after(x: Any, known: Any) -> Any:
    """The arrays of a PyTree, computed after those of another.

    In a batch the calls of LAPACK in jaxlib 0.10 wait for their parts in the pool of threads in
    which they run, as those of jaxlib 0.7 to 0.9, 0.11 and 0.12 do not. If as many run at once as
    there are threads, they wait for ever: on two cores two suffice. So in a program of ours no call
    is independent of another. XLA computes zero times a number, as it might be NaN, and here it is
    none.
    """
    for leaf in jtu.tree_leaves(lax.stop_gradient(known)):
        one = jnp.sum(jnp.ravel(leaf)[:1].real)  # zero of an empty array
        zero = 0 * jnp.where(jnp.isfinite(one), one, 0)
        x = jtu.tree_map(lambda x, zero=zero: x + zero.astype(x.dtype), x)
    return x


def lu_factors(matrix: Inexact[Array, "m m"]) -> tuple[Array, Array]:
    """`L` and `U` in one matrix, and the permutation of the rows. `jax.scipy.linalg` keeps the
    pivots instead, and each of its solves finds the permutation again, by a loop."""
    factors, _, permutation = lax.linalg.lu(matrix)
    return factors, permutation


def lu_solution(factors: tuple[Array, Array], b: Array) -> Array:
    """The solution for a vector, or for the columns of a matrix."""
    lu, permutation = factors
    x = jnp.reshape(b, (len(b), -1)).at[permutation].get(mode="promise_in_bounds")
    x = lax.linalg.triangular_solve(lu, x, left_side=True, lower=True, unit_diagonal=True)
    return lax.linalg.triangular_solve(lu, x, left_side=True).reshape(b.shape)


def inverse_factors(matrix: Float[Array, "*batch k k"]) -> tuple[Array, Array]:
    """Two matrices of which `right left` is the inverse, by Gaussian elimination, written out in
    operations with rows, for a small matrix. LAPACK takes longer for such matrices, and its
    threads wait for each other on a busy machine. There is no pivoting, which `U Uᵀ` does
    not need, nor `U Vᵀ` for directions `V` near `U`.

    We do not multiply the two: where constraints depend on each other, the elements of the inverse
    are as large as one over what is added to the diagonal, and the roundoff of the product would
    spoil what the constraints determine. In the factors only a row of `left` is large.
    """
    size = matrix.shape[-1]
    left = right = jnp.broadcast_to(jnp.eye(size, dtype=matrix.dtype), matrix.shape)
    for k in range(size - 1):
        pivot, later = matrix[..., k, k, None], np.arange(size) > k
        lower = jnp.where(later, matrix[..., :, k], 0) / pivot
        upper = jnp.where(later, matrix[..., k, :], 0) / pivot
        right = right - right[..., :, k, None] * upper[..., None, :]
        left = left - lower[..., :, None] * left[..., k, None, :]
        matrix = matrix - lower[..., :, None] * matrix[..., k, None, :]
    return left / jnp.diagonal(matrix, axis1=-2, axis2=-1)[..., :, None], right


def diagonal_shift(m: int, dtype: Any) -> float:
    """The share that is added by default to the diagonal of a Gram matrix of `m` rows, if these are
    many."""
    return eps_of(dtype) ** REGULARISATION_POWER * m**0.5


def gram_matrix(
    rows: Float[Array, "m n *lanes"], others: Float[Array, "m n *lanes"]
) -> Float[Array, "m m *lanes"]:
    """`U Vᵀ`, for the rows alone or of each lane, in float32 at least."""
    _, n, *lanes = rows.shape
    dtype = np.promote_types(rows.dtype, np.float32)
    rows, others = rows.astype(dtype), others.astype(dtype)
    if n > MAX_UNROLLED_SUM:
        return jnp.einsum("ik...,jk...->ij...", rows, others, precision=lax.Precision.HIGHEST)
    if not lanes:
        return jnp.sum(rows[:, None] * others[None], axis=2)
    pairs = zip(jnp.unstack(rows, axis=1), jnp.unstack(others, axis=1), strict=True)
    return ft.reduce(op.add, (x[:, None] * y[None] for x, y in pairs))


def ldu_factors(
    matrix: Float[Array, "m m *lanes"],
    *,
    relative_shift: float | Array = 0.0,
    pivot_tolerance: float | Array = 0.0,
    pivoting: bool = False,
) -> tuple[Float[Array, "m m *lanes"], Array | np.ndarray]:
    """`A = L D U` for a small Gram matrix, by Gaussian elimination: `L⁻¹` below the diagonal, the
    pivots `D` on it, and `U⁻¹` above it, if rows and columns are in the order of elimination. The
    second result is the step in which each row was the pivot row, and `m` for the row that is left.

    Each element `a` of the diagonal becomes `(1 + relative_shift) a`. A pivot of at most
    `pivot_tolerance a` is replaced by infinity, so that its multiplier is zero.

    Divided by the element on the diagonal of the matrix, a pivot is the squared sine of the angle
    between the gradient of a constraint and the span of the gradients before it. If `pivoting`, the
    next constraint is that with the largest: if a nearly parallel gradient came earlier, its
    roundoff would be magnified in the pivots of those that could replace it. Otherwise the order is
    the natural one, which `U Uᵀ` allows, and `U Vᵀ` for directions `V` near `U`. No rows are
    exchanged. LAPACK takes longer for such matrices, and its threads wait for each other on a busy
    machine.

    The inverse factors are not multiplied, as in `inverse_factors`.

    Every operation is elementwise over the lanes of a batch, which are the last axis. The steps of
    the elimination are a `fori_loop`: if they were written out, XLA would repeat the earlier ones
    in the kernel of each later one.
    """
    m, _, *lanes = matrix.shape
    j = natural_order(m, lanes)
    on_diagonal = j[:, None] == j[None]
    of_lanes = lambda x: jnp.broadcast_to(jnp.asarray(x, matrix.dtype), (1, *lanes))  # noqa: E731
    relative_shift, pivot_tolerance = of_lanes(relative_shift), of_lanes(pivot_tolerance)
    matrix = jnp.where(on_diagonal, matrix + relative_shift[None] * matrix, matrix)
    size = jnp.abs(_diagonal(matrix))

    def nonzero(pivot: Array, size: Array) -> Array:
        return jnp.where(jnp.abs(pivot) <= pivot_tolerance * size, jnp.inf, pivot)

    def eliminate(k: Array | int, now: tuple[Array, Any], pivoting: bool) -> tuple[Array, Any]:
        matrix, pivot_step = now
        is_remaining = pivot_step == m
        if pivoting:
            relative_pivot = jnp.abs(_diagonal(matrix)) / jnp.where(size > 0, size, 1)
            relative_pivot = jnp.where(is_remaining, relative_pivot, -1)
            is_k = j == jnp.argmax(relative_pivot, axis=0, keepdims=True)
            row = jnp.sum(jnp.where(is_k[:, None], matrix, 0), axis=0)
            column = jnp.sum(jnp.where(is_k[None], matrix, 0), axis=1)
            pivot = jnp.sum(
                jnp.where(is_k, nonzero(_diagonal(matrix), size), 0), axis=0, keepdims=True
            )
        else:
            is_k, at_k = j == k, ft.partial(lax.dynamic_index_in_dim, index=k)
            row, column = (at_k(matrix, axis=axis, keepdims=False) for axis in (0, 1))
            pivot = nonzero(at_k(row), at_k(size))
        row, column = jnp.where(is_k, 1, row) / pivot, jnp.where(is_k, 1, column)
        rest = jnp.where(is_k[:, None] | is_k[None], 0, matrix) - column[:, None] * row[None]
        is_remaining = is_remaining & ~is_k
        matrix = jnp.where(is_remaining[:, None] | is_remaining[None], rest, matrix)
        return matrix, pivot_step + is_k.astype(int) * (k - m)

    pivot_step = np.full(j.shape, m)
    if m > 1:  # all relative pivots are one, so that the natural order will do
        matrix, pivot_step = eliminate(0, (matrix, pivot_step), False)
    if m > 2:
        steps = ft.partial(eliminate, pivoting=pivoting)
        if pivoting:
            pivot_step = jnp.broadcast_to(pivot_step, (m, *lanes))
        matrix, pivot_step = lax.fori_loop(1, m - 1, steps, (matrix, pivot_step))
    return jnp.where(on_diagonal, nonzero(_diagonal(matrix), size), matrix), pivot_step


def _diagonal(matrix: Float[Array, "m m *lanes"]) -> Float[Array, "m *lanes"]:
    order = natural_order(len(matrix), matrix.shape[2:])
    return jnp.sum(jnp.where(order[:, None] == order[None], matrix, 0), axis=0)


def ldu_solution(
    factors: Float[Array, "m m *lanes"],
    pivot_step: Array | np.ndarray,
    b: Float[Array, "m *lanes"],
) -> Array:
    """`matrix⁻¹ b`, by what `ldu_factors` returns."""
    row_step, column_step = pivot_step[:, None], pivot_step[None]
    pivots = _diagonal(factors)
    # XLA does not repeat a quotient in each kernel that uses it, as it does with a product. Where
    # gradients are nearly parallel, the multipliers are large and cancel, so that all that uses one
    # must see the same number.
    x = b.astype(factors.dtype)
    x = (x + unrolled_matvec(factors, x, where=row_step > column_step)) / pivots
    return (x + unrolled_matvec(factors, x, where=row_step < column_step)).astype(b.dtype)


def natural_order(m: int, lanes: Sequence[int]) -> np.ndarray:
    """The indices of the rows, which are their steps of elimination without pivoting."""
    return np.arange(m).reshape(m, *[1] * len(lanes))


def unrolled_matvec(
    matrix: Float[Array, "m n *lanes"], x: Float[Array, "n *lanes"], where: Any = None
) -> Array:
    """`matrix x`, as a sum that is written out, which XLA fuses with what is around it. Only the
    elements `where` a mask is set take part."""
    columns = jnp.unstack(matrix, axis=1)
    if where is not None:
        columns = (jnp.where(where[:, i], y, 0) for i, y in enumerate(columns))
    terms = (
        column * element[None] for column, element in zip(columns, jnp.unstack(x), strict=True)
    )
    return ft.reduce(op.add, terms)


def iterative_refinement(
    solve: Solve, product: Callable[[Array], Array], b: Float[Array, " m"]
) -> Float[Array, " m"]:
    """The solution of `product(x) = b` by iterative refinement, from a `solve` that is inaccurate,
    because something was added to the matrix."""
    x = solve(b)
    for _ in range(NUM_REFINEMENTS):
        x = x + solve(b - product(x))
    return x


def forward_elimination(
    gram: Float[Array, "m m"],
    b: Array,
    rows: Array,
    *,
    pivot_tolerance: float | Array | None = None,
) -> tuple[Array, Array]:
    """`R⁻ᵀ rows` and `L⁻¹ b` for a small matrix `gram = L R`, by Gaussian elimination. The
    transpose of the first times the second is `rowsᵀ gram⁻¹ b`.

    Divided by the element on the diagonal of `gram`, the pivot of a constraint is the squared sine
    of the angle between its gradient and the span of the gradients before it. The next constraint
    is that with the largest: if a nearly parallel gradient came earlier, its roundoff would be
    magnified in the pivots of those that could replace it. A pivot of at most `pivot_tolerance`
    times the element on the diagonal, by default roundoff, counts as infinite, so that its
    multiplier is zero."""
    m = len(gram)
    pivot_tolerance = (
        roundoff_pivot_tolerance(gram.dtype) if pivot_tolerance is None else pivot_tolerance
    )
    matrix = [[*jnp.unstack(row)] for row in jnp.unstack(gram)]
    size = [jnp.abs(matrix[k][k]) for k in range(m)]
    rhs, reduced_rows = [*jnp.unstack(b)], [*jnp.unstack(rows)]
    for k in range(m):
        # At `k = 0` all relative pivots are one, so that nothing is exchanged.
        for i in range(k + 1, m) if k else ():
            larger = jnp.abs(matrix[i][i]) * size[k] > jnp.abs(matrix[k][k]) * size[i]
            for each in (*matrix[k:], matrix, size, rhs, reduced_rows):
                _exchange(each, k, i, larger)
        pivot = jnp.where(jnp.abs(matrix[k][k]) > pivot_tolerance * size[k], matrix[k][k], jnp.inf)
        for i in range(k + 1, m):
            lower, upper = matrix[i][k] / pivot, matrix[k][i] / pivot
            rhs[i] = rhs[i] - lower * rhs[k]
            reduced_rows[i] = reduced_rows[i] - upper * reduced_rows[k]
            for j in range(k + 1, m):
                matrix[i][j] = matrix[i][j] - lower * matrix[k][j]
        rhs[k] = rhs[k] / pivot
    return jnp.stack(reduced_rows), jnp.stack(rhs)


def _exchange(x: list[Any], k: int, i: int, exchanged: Bool[Array, ""]) -> None:
    """Exchanges two elements of a list, which may be lists, if the flag is set."""
    first, second = x[k], x[i]
    x[k] = jtu.tree_map(ft.partial(jnp.where, exchanged), second, first)
    x[i] = jtu.tree_map(ft.partial(jnp.where, exchanged), first, second)


def roundoff_pivot_tolerance(dtype: Any) -> float:
    """The largest share of the diagonal that a pivot can be by roundoff alone."""
    return TOLERANCE_IN_EPS * eps_of(dtype)
