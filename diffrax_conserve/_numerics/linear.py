"""The small linear systems of projections: Gram matrices `U Vᵀ` of rows, one for each constraint.

The matrices are singular where constraints depend on each other, as when an integral is given
twice. Their multipliers are then not determined, but what they move is, if the constraints do not
contradict each other. There are three ways to solve such a system.

- Up to four constraints are eliminated one after the other, written out in scalars, and next always
  the one whose gradient is farthest from a combination of those before it. Once it is such a
  combination, its pivot is roundoff. We give it the multiplier zero: if the others hold, it holds
  too. Gradients that are only nearly parallel are all kept, because a correction needs the
  direction in which they differ. A derivative does not, and would lose its digits in that
  direction; see `implicit`. Nor, below double precision, does a step that only polishes; see
  `iterate`.
- More are factored by LAPACK, with a share of the diagonal added, so that no pivot vanishes. In a
  derivative the share is the least pivot that counts: what is smaller has nearly no effect.
- A sparse matrix is factored in blocks, with the same share in a derivative too; see `sparse`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from .._constants import NUM_REFINEMENTS, REGULARISATION_POWER, ROUNDOFF, WRITTEN_OUT
from .._large.sparse import BlockGram, SparseRows

Solve = Callable[[Float[Array, " m"]], Float[Array, " m"]]


def gram_matrix(rows: Any, others: Any) -> Any:
    """`rows othersᵀ`."""
    if isinstance(rows, SparseRows):
        return rows.gram(others)
    if len(rows) > WRITTEN_OUT:
        return jnp.matmul(rows, others.T, precision=lax.Precision.HIGHEST)
    return jnp.sum(rows[:, None, :] * others[None], axis=2)


def rmatvec(rows: Any, multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
    """`rowsᵀ multiplier`."""
    if isinstance(rows, SparseRows):
        return rows.rmatvec(multiplier)
    if len(rows) > WRITTEN_OUT:
        return jnp.matmul(multiplier, rows, precision=lax.Precision.HIGHEST)
    return jnp.sum(multiplier[:, None] * rows, axis=0)


def matvec(rows: Any, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """`rows x`."""
    return rows.matvec(x) if isinstance(rows, SparseRows) else rmatvec(rows.T, x)


def row_space_correction(
    rows: Any,
    along: Any,
    b: Float[Array, " m"],
    *,
    least: float | Array | None = None,
    ordered: bool = False,
) -> Float[Array, " n"]:
    """`alongᵀ (rows alongᵀ)⁻¹ b`, the combination of the rows `along` that changes `rows x` by `b`.
    The `least` pivot that counts, and whether the rows are `ordered`: see `forward_elimination`.

    If gradients are nearly parallel, the multipliers `(rows alongᵀ)⁻¹ b` are large and cancel in
    the sum. XLA may evaluate `b` once for each of them, and round it differently each time, and
    then they do not cancel. So up to four constraints we do not form the multipliers. With the
    factors `rows alongᵀ = L R` we compute `(R⁻ᵀ along)ᵀ (L⁻¹ b)`: the elimination takes the
    differences of nearly parallel rows before anything is large.
    """
    gram = gram_matrix(rows, along)
    if _is_large(gram):
        return rmatvec(along, solve(gram, b, least=least))
    return rmatvec(*forward_elimination(gram, b, along, least=least, ordered=ordered)[:2])


def solve(
    gram: Any, b: Float[Array, " m"], *, least: float | Array | None = None
) -> Float[Array, " m"]:
    """`gram⁻¹ b`, for a matrix that is not symmetric in general."""
    if isinstance(gram, BlockGram):
        return iterative_refinement(gram.factorise(), gram.matvec, b)
    if _is_large(gram):
        return iterative_refinement(factorise(gram, least=least), lambda x: rmatvec(gram.T, x), b)
    return rmatvec(*forward_elimination(gram, b, jnp.eye(len(b), dtype=b.dtype), least=least)[:2])


def solve_kkt(n: int, matrix: Float[Array, "N N"], b: Float[Array, " N"]) -> Float[Array, " N"]:
    """`matrix⁻¹ b` for equations of `n` components of the state and of multipliers,
    `A y + B λ = b₁` and `G y = b₂`, without the multipliers whose gradients are nearly parallel;
    see `implicit`.

    The state is eliminated first. The matrix `A` alone may be singular, so we add to the first
    equations the second ones times the transpose of `G`, which does not change the solution. All
    rows of `G` and columns of `B` are taken with the length one, so that nothing depends on the
    units of the multipliers.
    """
    heights, rows = unit_rows(matrix[n:, :n])
    widths, along = unit_rows(matrix[:n, n:].T)
    factors = lu_factors(matrix[:n, :n] + gram_matrix(rows.T, rows.T))
    along = lu_solution(factors, along.T).T
    second = b[n:] / heights
    first = lu_solution(factors, b[:n] + rmatvec(rows, second))
    wrong = matvec(rows, first) - second
    multiplier = solve(gram_matrix(rows, along), wrong, least=least_pivot(rows))
    return jnp.concatenate([first - rmatvec(along, multiplier), multiplier / widths])


def lu_factors(matrix: Float[Array, "m m"]) -> tuple[Array, Array]:
    """`L` and `U` by LAPACK, and the permutation of the rows. `jax.scipy.linalg` keeps the pivots
    instead, and each of its solves finds the permutation again, by a loop."""
    factors, _, permutation = lax.linalg.lu(matrix)
    return factors, permutation


def lu_solution(factors: tuple[Array, Array], b: Array) -> Array:
    """The solution for a vector, or for the columns of a matrix."""
    both, permutation = factors
    x = jnp.reshape(b, (len(b), -1)).at[permutation].get(mode="promise_in_bounds")
    x = lax.linalg.triangular_solve(both, x, left_side=True, lower=True, unit_diagonal=True)
    return lax.linalg.triangular_solve(both, x, left_side=True).reshape(b.shape)


class Factors(eqx.Module):
    """The two factors of a matrix. Those of a small one are inverted, so that a solve is two
    products, which XLA fuses with what is around them. Those of a large one are LAPACK's, and a
    solve is two substitutions: to invert them takes longer than the few solves of a step.

    - `unit`: the rows and columns of the matrix are multiplied by it, so that the diagonal is one.
    """

    factors: tuple[Array, Array]
    unit: Float[Array, " m"]

    def __call__(self, b: Float[Array, " m"]) -> Float[Array, " m"]:
        x = (b * self.unit).astype(self.factors[0].dtype)
        if _is_large(b):
            x = lu_solution(self.factors, x)
        else:
            below, above = self.factors
            x = rmatvec(above.T, rmatvec(below.T, x))
        return x.astype(b.dtype) * self.unit


def factorise(gram: Any, *, least: float | Array | None = None) -> Solve:
    """`gram⁻¹ b` as a function of `b`. What is added to the diagonal of a large matrix is an error
    of the solution, which `solve` removes, and so do the steps of an iteration."""
    if isinstance(gram, BlockGram):
        return gram.factorise()
    diagonal = jnp.abs(jnp.diagonal(gram))
    unit = lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    matrix = gram * unit[:, None] * unit
    if not _is_large(gram):
        one = jnp.eye(len(gram), dtype=gram.dtype)
        above, below, _ = forward_elimination(matrix, one, one)
        return Factors((below, above.T), unit)
    dtype = np.promote_types(matrix.dtype, np.float32)  # LAPACK has no half precision
    eps, one = float(jnp.finfo(matrix.dtype).eps), jnp.eye(len(matrix), dtype=dtype)
    added = eps**REGULARISATION_POWER * len(matrix) ** 0.5 if least is None else least
    return Factors(lu_factors(matrix.astype(dtype) + added * one), unit)


def _is_large(gram: Any) -> bool:
    return len(gram) > WRITTEN_OUT


def iterative_refinement(
    solve: Solve, product: Callable[[Array], Array], b: Float[Array, " m"]
) -> Float[Array, " m"]:
    """The solution of `product(x) = b` by iterative refinement, from a `solve` that is inaccurate,
    because something was added to the matrix."""
    x = solve(b)
    for _ in range(NUM_REFINEMENTS):
        x = x + solve(b - product(x))
    return x


# For each two places, from the second on, whether the constraints there are exchanged.
Order = tuple[Bool[Array, ""], ...]


def forward_elimination(
    gram: Float[Array, "m m"],
    b: Array,
    rows: Array,
    *,
    least: float | Array | None = None,
    ordered: bool = False,
) -> tuple[Array, Array, Order]:
    """`R⁻ᵀ rows` and `L⁻¹ b` for a small matrix `gram = L R`, by Gaussian elimination, and its
    order. The `rmatvec` of the first two is `rowsᵀ gram⁻¹ b`.

    Relative to the squares of the lengths of rows the pivots are the squares of the sines of the
    angles between the gradient of each constraint and those before it. Next is always the
    constraint with the largest of them: if a nearly parallel one came earlier, its roundoff would
    be magnified in the pivots of those that could replace it. What is given may be `ordered` in
    this way already. A pivot of at most `least` of the diagonal, by default roundoff, counts as
    infinite, so that its multiplier is zero."""
    m = len(gram)
    least = roundoff_pivot(gram.dtype) if least is None else least
    matrix = [[gram[i, j] for j in range(m)] for i in range(m)]
    size = [jnp.abs(gram[k, k]) for k in range(m)]
    right, sides, order = list(b), list(rows), []
    for k in range(m):
        for i in range(k + 1, m) if k and not ordered else ():  # at first all are equal
            larger = jnp.abs(matrix[i][i]) * size[k] > jnp.abs(matrix[k][k]) * size[i]
            order.append(larger)
            for each in (*matrix[k:], matrix, size, right, sides):
                _exchange(each, k, i, larger)
        pivot = jnp.where(jnp.abs(matrix[k][k]) > least * size[k], matrix[k][k], jnp.inf)
        for i in range(k + 1, m):
            below, beside = matrix[i][k] / pivot, matrix[k][i] / pivot
            right[i], sides[i] = right[i] - below * right[k], sides[i] - beside * sides[k]
            for j in range(k + 1, m):
                matrix[i][j] = matrix[i][j] - below * matrix[k][j]
        right[k] = right[k] / pivot
    return jnp.stack(sides), jnp.stack(right), tuple(order)


def order_of(gram: Float[Array, "m m"]) -> Order:
    """The order in which the elimination takes the constraints, whatever the right side is."""
    return forward_elimination(gram, gram[0], gram)[2]


def in_order(order: Order, each: Array) -> Array:
    """One element or row for each constraint, in this order."""
    if not order:
        return each
    x, m = list(each), len(each)
    places = [(k, i) for k in range(1, m) for i in range(k + 1, m)]
    for (k, i), exchanged in zip(places, order, strict=True):
        _exchange(x, k, i, exchanged)
    return jnp.stack(x)


def _exchange(x: list[Any], k: int, i: int, exchanged: Bool[Array, ""]) -> None:
    """Exchanges two elements of a list, which may be lists, if the flag is set."""
    first, second = x[k], x[i]
    x[k] = jtu.tree_map(ft.partial(jnp.where, exchanged), second, first)
    x[i] = jtu.tree_map(ft.partial(jnp.where, exchanged), first, second)


def scaled_rows(rows: Any) -> tuple[Float[Array, " m"], Any]:
    """The largest element of each row, or one if all are zero, and the rows divided by it.

    The products in a Gram matrix could otherwise overflow or underflow in float32. In float64 they
    do not in usual units, so there the sizes are one, which saves time.
    """
    if jnp.result_type(*jtu.tree_leaves(rows)) == jnp.float64:
        return jnp.ones(len(rows)), rows
    if isinstance(rows, SparseRows):
        return rows.scaled()
    sizes = jnp.max(jnp.abs(rows), axis=1)
    sizes = jnp.where(sizes > 0, sizes, 1)
    return sizes, rows / sizes[:, None]


def unit_rows(rows: Any) -> tuple[Float[Array, " m"], Any]:
    """The lengths of rows, and the rows with the length one, so that their pivots are squares of
    sines. Sparse rows are those of `scaled_rows`, because their pivots are not looked at."""
    sizes, rows = scaled_rows(rows)
    if isinstance(rows, SparseRows):
        return sizes, rows
    lengths = jnp.linalg.norm(rows, axis=1)
    lengths = jnp.where(lengths > 0, lengths, 1)
    return sizes * lengths, rows / lengths[:, None]


def roundoff_pivot(dtype: Any) -> float:
    """The largest share of the diagonal that a pivot can be by roundoff alone."""
    return ROUNDOFF * float(jnp.finfo(dtype).eps)


def least_pivot(rows: Any) -> float:
    """The least pivot of unit rows that counts in a derivative, `√ε`. As a pivot has an error of
    about `ε`, half of the digits of what is divided by it are right."""
    return float(jnp.finfo(jnp.result_type(*jtu.tree_leaves(rows))).eps) ** 0.5
