"""The small linear systems of projections: Gram matrices `U Vᵀ` of rows, one for each constraint.

They are singular where constraints depend on each other. A pivot at the level of roundoff belongs
to a constraint whose gradient depends linearly on the earlier ones: its multiplier is zero, which
is exact if the constraints are consistent. Of gradients that are only nearly parallel all are kept,
because the correction needs the direction in which they differ.
"""

from collections.abc import Callable
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .sparse import BlockGram, SparseRows

# Up to this many constraints a solve is written out, so that XLA fuses it with what is around it.
WRITTEN_OUT_MAX = 4
# A pivot below this many units of roundoff, times the number of constraints, is one of roundoff.
_LEAST_PIVOT = 4
# The roundoff that is added to the unit diagonal of a large matrix, in units of roundoff times the
# root of the number of constraints, so that a factor exists where constraints depend on each other.
_ADDED = 16
# And where no iterative refinement follows, as a power of roundoff: noise in the residuals of
# dependent constraints becomes an error of all others, in the ratio of roundoff to what is added.
# With `_ADDED` one in five projections on the seven integrals of an orbit does not converge.
_ADDED_POWER = 3 / 4
# The steps of iterative refinement that remove from a solution what was added.
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
    """`gram⁻¹ b`, for a matrix not symmetric in general."""
    if isinstance(gram, BlockGram):
        return gram.factored()(b)
    return combined(*eliminated(gram, b, jnp.eye(len(b), dtype=b.dtype), noise))


def eliminated(
    gram: Any, b: Array, rows: Any, noise: Array | None = None
) -> tuple[Float[Array, " m"], Any]:
    """`L⁻¹ b` and `U⁻ᵀ rows` for `gram = L U`, not symmetric in general: combined they are
    `rowsᵀ gram⁻¹ b`. The multipliers `gram⁻¹ b` of nearly parallel gradients are large and cancel
    in the sum, which is wrong if XLA evaluates `b` once for each. If a small matrix is written out,
    what is within the `noise` of `b` is zero in `L⁻¹ b`: a small pivot would amplify it."""
    if isinstance(gram, BlockGram):
        return gram.factored()(b), rows
    m, dtype = len(gram), gram.dtype
    if m > WRITTEN_OUT_MAX:
        added, diagonal = _added(gram), jnp.abs(jnp.diagonal(gram))
        unit = lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
        scaled = gram * unit[:, None] * unit
        right = (b * unit).astype(added.dtype)
        lu, x = jsp.linalg.lu_factor(scaled + added), jnp.zeros_like(right)
        for _ in range(_REFINEMENTS):
            x = x + jsp.linalg.lu_solve(lu, right - combined(x, scaled.T))
        return x.astype(dtype) * unit, rows
    least = _LEAST_PIVOT * m * float(jnp.finfo(dtype).eps)
    u, x, d = [[gram[i, j] for j in range(m)] for i in range(m)], list(b), list(rows)
    small = [] if noise is None else list(noise)
    for k in range(m):
        regular = jnp.abs(u[k][k]) > least * jnp.abs(gram[k, k])
        pivot = jnp.where(regular, u[k][k], jnp.inf)
        if noise is not None:
            x[k] = jnp.where(jnp.abs(x[k]) <= small[k], 0, x[k])
        for i in range(k + 1, m):
            below, right = u[i][k] / pivot, u[k][i] / pivot
            x[i], d[i] = x[i] - below * x[k], d[i] - right * d[k]
            if noise is not None:  # what is not corrected is within half of the tolerance
                small[i] = jnp.minimum(small[i] + jnp.abs(below) * small[k], 4 * noise[i])
            for j in range(k + 1, m):
                u[i][j] = u[i][j] - below * u[k][j]
        x[k] = x[k] / pivot
    return jnp.stack(x), jnp.stack(d)


def factored(gram: Any, sizes: Float[Array, " m"]) -> Callable[[Array], Array]:
    """`S⁻¹ gram⁻¹ S⁻¹ g` as a function of `g`, for the diagonal matrix `S` of `sizes`. With the
    inverse of a triangle, `L⁻¹ S⁻¹` for `gram = L Lᵀ`, each solve is two products."""
    if isinstance(gram, BlockGram):
        solve = gram.factored()
        return lambda g: solve(g / sizes) / sizes
    added = _added(gram, _ADDED_POWER) * jnp.where(gram > 0, gram, 1)
    lower = jnp.linalg.cholesky(gram + added, symmetrize_input=False)
    one = jnp.eye(len(gram), dtype=added.dtype)
    inverse = jsp.linalg.solve_triangular(lower, one, lower=True) / sizes
    return lambda g: combined(combined(g.astype(inverse.dtype), inverse.T), inverse).astype(g.dtype)


def scaled_rows(rows: Any) -> tuple[Float[Array, " m"], Any]:
    """The largest element of each row, or one if all are zero, and the rows divided by it. In
    float64 one: products of elements neither overflow nor underflow in usual units."""
    if jnp.result_type(*jtu.tree_leaves(rows)) == jnp.float64:
        return jnp.ones(len(rows)), rows
    if isinstance(rows, SparseRows):
        return rows.scaled()
    sizes = jnp.max(jnp.abs(rows), axis=1)
    sizes = jnp.where(sizes > 0, sizes, 1)
    return sizes, rows / sizes[:, None]


def _added(gram: Float[Array, "m m"], power: float = 1) -> Float[Array, "m m"]:
    """Roundoff that is added to a unit diagonal: dependent constraints have small multipliers."""
    eps = float(jnp.finfo(gram.dtype).eps)
    roundoff = max(_ADDED * eps, eps**power) * len(gram) ** 0.5
    return roundoff * jnp.eye(len(gram), dtype=jnp.promote_types(gram.dtype, jnp.float32))
