"""The elimination of small matrices, LAPACK's factors of large ones, and iterative refinement."""

import functools as ft
import operator as op
from collections.abc import Callable
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from .._constants import MAX_WRITTEN_OUT, NUM_REFINEMENTS, REGULARISATION_POWER, ROUNDOFF
from .._tree import eps_of

Solve = Callable[[Float[Array, " m"]], Float[Array, " m"]]


def lu_factors(matrix: Float[Array, "m m"]) -> tuple[Array, Array]:
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
    operations with rows, for a few of them. LAPACK takes longer for such matrices, and its
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


def diagonal_shift(matrix: Array) -> float:
    """What is added by default to the diagonal of a larger Gram matrix, whose elements are one."""
    return eps_of(matrix) ** REGULARISATION_POWER * len(matrix) ** 0.5


def gram_inverse(rows: Float[Array, "m n lanes"], added: float | Array) -> Solve:
    """`(U Uᵀ)⁻¹ b` as a function of `b`, for the rows `U` of each lane, by Gaussian elimination as
    in `inverse_factors`, with `added` to the diagonal, whose elements are one.

    What is done with an element is one loop over the lanes, and the steps of the elimination are a
    loop too, so that no kernel repeats the steps before it. The inverses of both factors take the
    places of the elements that were eliminated (Gauss and Jordan).
    """
    m, n, _ = rows.shape
    rows = rows.astype(np.promote_types(rows.dtype, np.float32))
    if n > MAX_WRITTEN_OUT:
        matrix = jnp.einsum("ikl,jkl->ijl", rows, rows, precision=lax.Precision.HIGHEST)
    else:
        matrix = ft.reduce(op.add, (x[:, None] * x for x in jnp.unstack(rows, axis=1)))
    diagonal = jnp.stack([matrix[k, k] for k in range(m)])
    size = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    matrix = (
        matrix / (size[:, None] * size)
        + jnp.asarray(added, rows.dtype) * np.eye(m, dtype=rows.dtype)[..., None]
    )
    index = np.arange(m)[:, None]

    def eliminate(k: Array, matrix: Array) -> Array:
        row, column = matrix[k], matrix[:, k]
        is_k = index == k
        row, column = jnp.where(is_k, 1, row) / row[k], jnp.where(is_k, 1, column)
        crossing = (is_k | is_k.T)[..., None]
        rest = jnp.where(crossing, 0, matrix) - column[:, None] * row
        return jnp.where((jnp.maximum(index, index.T) > k)[..., None], rest, matrix)

    matrix = lax.fori_loop(0, m - 1, eliminate, matrix)
    pivots = jnp.stack([matrix[k, k] for k in range(m)])
    left = jnp.where((index > index.T)[..., None], matrix, 0)
    right = jnp.where((index < index.T)[..., None], matrix, 0)
    return jtu.Partial(_solution_of_lanes, left, right, pivots, size)


def _solution_of_lanes(left: Array, right: Array, pivots: Array, size: Array, b: Array) -> Array:
    # XLA does not repeat a quotient in each kernel that uses it, as it does with a product.
    x = b.astype(size.dtype) / size
    x = (x + written_out_product(left, x)) / pivots
    return ((x + written_out_product(right, x)) / size).astype(b.dtype)


def written_out_product(matrix: Float[Array, "m n *lanes"], x: Float[Array, "n *lanes"]) -> Array:
    """`matrix x`, as a sum that is written out, which XLA fuses with what is around it."""
    return ft.reduce(op.add, (matrix[:, k] * x[k] for k in range(len(x))))


def iterative_refinement(
    solve: Solve, product: Callable[[Array], Array], b: Float[Array, " m"]
) -> Float[Array, " m"]:
    """The solution of `product(x) = b` by iterative refinement, from a `solve` that is inaccurate,
    because something was added to the matrix."""
    x = solve(b)
    for _ in range(NUM_REFINEMENTS):
        x = x + solve(b - product(x))
    return x


# One flag for each comparison of pivots `(k, i)`, `1 ≤ k < i`: whether these rows are exchanged.
PivotOrder = tuple[Bool[Array, ""], ...]


def forward_elimination(
    gram: Float[Array, "m m"],
    b: Array,
    rows: Array,
    *,
    pivot_tolerance: float | Array | None = None,
    presorted: bool = False,
) -> tuple[Array, Array, PivotOrder]:
    """`R⁻ᵀ rows` and `L⁻¹ b` for a small matrix `gram = L R`, by Gaussian elimination, and the
    order of the pivots. The transpose of the first times the second is `rowsᵀ gram⁻¹ b`.

    Divided by the element on the diagonal of `gram`, the pivot of a constraint is the squared sine
    of the angle between its gradient and the span of the gradients before it. The next constraint
    is that with the largest: if a nearly parallel gradient came earlier, its roundoff would be
    magnified in the pivots of those that could replace it. The arguments may be `presorted` in this
    way already. A pivot of at most `pivot_tolerance` times the element on the diagonal, by default
    roundoff, counts as infinite, so that its multiplier is zero."""
    m = len(gram)
    pivot_tolerance = (
        roundoff_pivot_tolerance(gram.dtype) if pivot_tolerance is None else pivot_tolerance
    )
    matrix = [[*jnp.unstack(row)] for row in jnp.unstack(gram)]
    size = [jnp.abs(matrix[k][k]) for k in range(m)]
    rhs, reduced_rows, order = [*jnp.unstack(b)], [*jnp.unstack(rows)], []
    for k in range(m):
        # At `k = 0` all quotients are one, so that nothing is exchanged.
        for i in range(k + 1, m) if k and not presorted else ():
            larger = jnp.abs(matrix[i][i]) * size[k] > jnp.abs(matrix[k][k]) * size[i]
            order.append(larger)
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
    return jnp.stack(reduced_rows), jnp.stack(rhs), tuple(order)


def permuted(order: PivotOrder, each: Array) -> Array:
    """One element or row for each constraint, in this order."""
    if not order:
        return each
    x, m = [*jnp.unstack(each)], len(each)
    places = [(k, i) for k in range(1, m) for i in range(k + 1, m)]
    for (k, i), exchanged in zip(places, order, strict=True):
        _exchange(x, k, i, exchanged)
    return jnp.stack(x)


def _exchange(x: list[Any], k: int, i: int, exchanged: Bool[Array, ""]) -> None:
    """Exchanges two elements of a list, which may be lists, if the flag is set."""
    first, second = x[k], x[i]
    x[k] = jtu.tree_map(ft.partial(jnp.where, exchanged), second, first)
    x[i] = jtu.tree_map(ft.partial(jnp.where, exchanged), first, second)


def roundoff_pivot_tolerance(dtype: Any) -> float:
    """The largest share of the diagonal that a pivot can be by roundoff alone."""
    return ROUNDOFF * eps_of(dtype)
