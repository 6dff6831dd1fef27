"""The small linear systems of projections: Gram matrices `U Vᵀ` of rows, one for each constraint.

The matrices are singular where constraints depend on each other, as when an integral is given
twice. In an elimination without pivoting the pivot of a constraint is then at the level of roundoff
if its gradient is a combination of those of the constraints before it. We give such a constraint
the multiplier zero. That is exact if the constraints are consistent, because meeting the earlier
ones then meets this one too. Gradients that are only nearly parallel are all kept, because the
correction needs the direction in which they differ: a truncated singular value decomposition, which
would drop this direction, makes Newton's method stall.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .sparse import ADDED_POWER, BlockGram, SparseRows

# Up to this many constraints the elimination is written out, element by element, so that XLA fuses
# it with what is around it. A call of LAPACK would take most of the time of a small projection.
WRITTEN_OUT_MAX = 4
# A pivot counts as roundoff if it is at most this many units of roundoff, times the number `m` of
# constraints, of its diagonal element. It is the rest of `m` products of about the size of that
# element, each of which is rounded, as are the elements themselves.
_LEAST_PIVOT = 4
# For more constraints we add this many units of roundoff, times `√m`, to a diagonal of ones, so
# that a factor exists where constraints depend on each other. The rounding of a factorisation
# perturbs the matrix by about `√m` units (N. J. Higham, *Accuracy and Stability of Numerical
# Algorithms*, SIAM 2002, 2.8 and 10.1), so that a pivot which should be zero stays positive. Where
# no iterative refinement follows, we add at least the power `ADDED_POWER` of roundoff: the noise in
# the residuals of dependent constraints becomes an error of all others, in the ratio of roundoff to
# what is added. With `_ADDED` alone one in five projections on the seven integrals of an orbit, of
# which five are independent, does not converge.
_ADDED = 16
# So many solves, all but the first for what is left of the right side, remove from a solution the
# error that the addition causes. Each multiplies it by what was added, divided by the smallest
# eigenvalue of the scaled matrix.
_REFINEMENTS = 3


def gram_matrix(rows: Any, others: Any) -> Any:
    """`rows othersᵀ`."""
    if isinstance(rows, SparseRows):
        return rows.gram(others)
    if len(rows) > WRITTEN_OUT_MAX:
        return jnp.matmul(rows, others.T, precision=lax.Precision.HIGHEST)
    return jnp.sum(rows[:, None, :] * others[None], axis=2)


def combined(multiplier: Float[Array, " m"], rows: Any) -> Float[Array, " n"]:
    """`rowsᵀ multiplier`."""
    if isinstance(rows, SparseRows):
        return rows.combined(multiplier)
    if len(rows) > WRITTEN_OUT_MAX:
        return jnp.matmul(multiplier, rows, precision=lax.Precision.HIGHEST)
    return jnp.sum(multiplier[:, None] * rows, axis=0)


def times(rows: Any, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """`rows x`."""
    return rows.times(x) if isinstance(rows, SparseRows) else combined(x, rows.T)


def gram_solve(gram: Any, b: Array, noise: Array | None = None) -> Array:
    """`gram⁻¹ b`, for a matrix that is not symmetric in general."""
    if isinstance(gram, BlockGram):
        return _refined(gram.factored(), gram.times, b)
    return combined(*eliminated(gram, b, jnp.eye(len(b), dtype=b.dtype), noise))


def eliminated(
    gram: Any, b: Array, rows: Any, noise: Array | None = None
) -> tuple[Float[Array, " m"], Any]:
    """`L⁻¹ b` and `R⁻ᵀ rows` for `gram = L R`, by Gaussian elimination without pivoting. The matrix
    is not symmetric in general. The `combined` of both is the correction `rowsᵀ gram⁻¹ b`.

    Why not multiply `rowsᵀ` by the multipliers `gram⁻¹ b`? If gradients are nearly parallel, the
    multipliers are large and cancel in the sum. XLA may evaluate `b` once for each of them, with
    another rounding each time, and then they do not cancel. The elimination takes differences of
    the rows first, so that nothing large is left.

    If `noise` is given and the elimination is written out, elements of `L⁻¹ b` that are within the
    noise are set to zero, because a small pivot would amplify them to a large, random correction.
    For more than four constraints, and in blocks, the first result is the multipliers, and the
    second the rows themselves.
    """
    if isinstance(gram, BlockGram):
        return gram_solve(gram, b), rows
    m, dtype = len(gram), gram.dtype
    if m > WRITTEN_OUT_MAX:
        # The rows and columns are scaled such that the diagonal is one.
        added, diagonal = _added(gram), jnp.abs(jnp.diagonal(gram))
        unit = lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
        scaled = gram * unit[:, None] * unit
        right = (b * unit).astype(added.dtype)
        lu = jsp.linalg.lu_factor(scaled + added)
        x = _refined(ft.partial(jsp.linalg.lu_solve, lu), lambda x: combined(x, scaled.T), right)
        return x.astype(dtype) * unit, rows
    least = _LEAST_PIVOT * m * float(jnp.finfo(dtype).eps)
    matrix = [[gram[i, j] for j in range(m)] for i in range(m)]
    left, right = list(b), list(rows)
    small = [] if noise is None else list(noise)
    for k in range(m):
        regular = jnp.abs(matrix[k][k]) > least * jnp.abs(gram[k, k])
        pivot = jnp.where(regular, matrix[k][k], jnp.inf)  # so that the multiplier is zero
        if noise is not None:
            left[k] = jnp.where(jnp.abs(left[k]) <= small[k], 0, left[k])
        for i in range(k + 1, m):
            below, beside = matrix[i][k] / pivot, matrix[k][i] / pivot
            left[i], right[i] = left[i] - below * left[k], right[i] - beside * right[k]
            if noise is not None:
                # The noise of a row grows by that of the rows subtracted from it. It is at most
                # half of the tolerance, of which `noise` is an eighth: so what we leave out cannot
                # keep a state off the manifold.
                small[i] = jnp.minimum(small[i] + jnp.abs(below) * small[k], 4 * noise[i])
            for j in range(k + 1, m):
                matrix[i][j] = matrix[i][j] - below * matrix[k][j]
        left[k] = left[k] / pivot
    return jnp.stack(left), jnp.stack(right)


def factored(gram: Any, sizes: Float[Array, " m"]) -> Callable[[Array], Array]:
    """`S⁻¹ gram⁻¹ S⁻¹ g` as a function of `g`, for the diagonal matrix `S` of `sizes`."""
    if isinstance(gram, BlockGram):
        solve = gram.factored()
        return lambda g: solve(g / sizes) / sizes
    return by_triangle(inverse_triangle(gram, sizes))


def inverse_triangle(gram: Float[Array, "m m"], sizes: Float[Array, " m"]) -> Float[Array, "m m"]:
    """`L⁻¹ S⁻¹` for `gram = L Lᵀ`, for `by_triangle`. Each solve is then two products with a
    matrix, which are faster than two substitutions, in a batch above all.

    We do not multiply the two: where constraints depend on each other, the elements of the inverse
    are as large as one over what is added to the diagonal, and those of its triangle only as large
    as the root of that. So the roundoff of the product would spoil what the constraints determine.
    """
    added = _added(gram, ADDED_POWER) * jnp.where(gram > 0, gram, 1)
    lower = lax.linalg.cholesky(gram + added, symmetrize_input=False)
    one = jnp.eye(len(gram), dtype=added.dtype)
    return jsp.linalg.solve_triangular(lower, one, lower=True) / sizes


def by_triangle(inverse: Float[Array, "m m"]) -> Callable[[Array], Array]:
    """What `factored` says, from the `inverse_triangle`."""
    return lambda g: combined(combined(g.astype(inverse.dtype), inverse.T), inverse).astype(g.dtype)


def _refined(
    solve: Callable[[Array], Array], product: Callable[[Array], Array], b: Float[Array, " m"]
) -> Float[Array, " m"]:
    """The solution of `product(x) = b` by iterative refinement, from a `solve` that is inaccurate,
    because something was added to the matrix."""
    x = solve(b)
    for _ in range(_REFINEMENTS - 1):
        x = x + solve(b - product(x))
    return x


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


def _added(gram: Float[Array, "m m"], power: float = 1) -> Float[Array, "m m"]:
    """What is added to a matrix with a diagonal of ones, so that its factor exists where
    constraints depend on each other; see `_ADDED`. The multipliers of such constraints then stay
    small."""
    eps = float(jnp.finfo(gram.dtype).eps)
    roundoff = max(_ADDED * eps, eps**power) * len(gram) ** 0.5
    return roundoff * jnp.eye(len(gram), dtype=np.promote_types(gram.dtype, np.float32))
