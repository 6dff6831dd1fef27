"""Linear solves with Gram matrices `G M⁻¹ Hᵀ`, which are singular where constraints depend on each
other.

A pivot at the level of roundoff belongs to a constraint whose gradient depends linearly on the
earlier ones; its multiplier is zero, which is exact for consistent constraints. Gradients that are
only nearly parallel are all kept, because the correction needs the direction in which they differ.
"""

import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Float

# Up to this many constraints a solve is written out, so that XLA fuses it with what is around it.
WRITTEN_OUT_MAX = 4


def gram_matrix(rows: Float[Array, "m n"], others: Float[Array, "m n"]) -> Float[Array, "m m"]:
    """`rows othersᵀ`."""
    if len(rows) > WRITTEN_OUT_MAX:
        return jnp.matmul(rows, others.T, precision=lax.Precision.HIGHEST)
    return jnp.sum(rows[:, None, :] * others[None], axis=2)


def combined(multiplier: Float[Array, " m"], rows: Float[Array, "m n"]) -> Float[Array, " n"]:
    """`rowsᵀ multiplier`."""
    if len(rows) > WRITTEN_OUT_MAX:
        return jnp.matmul(multiplier, rows, precision=lax.Precision.HIGHEST)
    return jnp.sum(multiplier[:, None] * rows, axis=0)


def gram_solve(
    gram: Float[Array, "m m"], b: Float[Array, " m"], damping: Array | float = 0.0
) -> Float[Array, " m"]:
    """`gram⁻¹ b`, for a matrix not symmetric in general; `damping` is relative to its diagonal."""
    m, dtype = len(gram), gram.dtype
    if m > WRITTEN_OUT_MAX:
        unit = _unit(gram)
        scaled = (gram * unit[:, None] * unit[None]).astype(jnp.promote_types(dtype, jnp.float32))
        right = (b * unit).astype(scaled.dtype)
        damped = jnp.eye(m, dtype=scaled.dtype) * jnp.asarray(damping, scaled.dtype)
        lu = jsp.linalg.lu_factor(scaled + damped + _roundoff(m, dtype).astype(scaled.dtype))
        x = jnp.zeros_like(right)
        for _ in range(3):  # which removes what the roundoff adds
            x = x + jsp.linalg.lu_solve(lu, right - (scaled + damped) @ x)
        return x.astype(dtype) * unit
    least = 4 * m * float(jnp.finfo(dtype).eps)
    if m == 2:  # with one division, because XLA compiles each into a kernel of its own
        (a, b01), (b10, d) = gram[0], gram[1]
        a, d = a * (1 + damping), d * (1 + damping)
        det = a * d - b01 * b10
        regular, first = jnp.abs(det) > least * jnp.abs(a * d), a != 0
        divisor = jnp.where(regular, det, jnp.where(first, a, d))
        upper = jnp.where(regular, d * b[0] - b01 * b[1], jnp.where(first, b[0], 0))
        lower = jnp.where(regular, a * b[1] - b10 * b[0], jnp.where(first, 0, b[1]))
        return jnp.stack([upper, lower]) / jnp.where(divisor == 0, jnp.inf, divisor)
    rows = [[gram[i, j] for j in range(m)] for i in range(m)]
    x, pivots = [b[i] for i in range(m)], []
    for k in range(m):
        pivot = rows[k][k] + damping * gram[k, k]
        pivots.append(jnp.where(jnp.abs(pivot) > least * jnp.abs(gram[k, k]), pivot, jnp.inf))
        for i in range(k + 1, m):
            share = rows[i][k] / pivots[k]
            x[i] = x[i] - share * x[k]
            for j in range(k + 1, m):
                rows[i][j] = rows[i][j] - share * rows[k][j]
    for k in reversed(range(m)):
        for j in range(k + 1, m):
            x[k] = x[k] - rows[k][j] * x[j]
        x[k] = x[k] / pivots[k]
    return jnp.stack(x)


# The inverse of the Cholesky factor of a matrix with scaled rows, and the factors of equations and
# multipliers.
Factors = tuple[Float[Array, "m m"], Float[Array, " m"], Float[Array, " m"]]


def factor(gram: Float[Array, "m m"], sizes: Float[Array, " m"]) -> Factors:
    """The factors of a symmetric matrix, for right-hand sides to be divided by `sizes`. With the
    inverse of the triangle each solve is two products."""
    m, dtype = len(gram), gram.dtype
    unit = _unit(gram)
    matrix = gram * unit[:, None] * unit[None] + _roundoff(m, dtype)
    matrix = matrix.astype(jnp.promote_types(dtype, jnp.float32))
    lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    inverse = jsp.linalg.solve_triangular(lower, jnp.eye(m, dtype=lower.dtype), lower=True)
    return inverse, unit / sizes, unit


def solve_factored(factors: Factors, b: Float[Array, " m"]) -> Float[Array, " m"]:
    inverse, left, right = factors
    x = jnp.matmul(inverse, (b * left).astype(inverse.dtype), precision=lax.Precision.HIGHEST)
    x = jnp.matmul(x, inverse, precision=lax.Precision.HIGHEST)
    return x.astype(b.dtype) * right


def row_sizes(rows: Float[Array, "m n"]) -> Float[Array, " m"]:
    """The largest element of each row, or one if all are zero. In float64 one, because products of
    elements neither overflow nor underflow in usual units."""
    if rows.dtype == jnp.float64:
        return jnp.ones(len(rows))
    sizes = jnp.max(jnp.abs(rows), axis=1)
    return jnp.where(sizes > 0, sizes, 1)


def _unit(gram: Float[Array, "m m"]) -> Float[Array, " m"]:
    diagonal = jnp.abs(jnp.diagonal(gram))
    return jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1)), 1)


def _roundoff(m: int, dtype: jnp.dtype) -> Float[Array, "m m"]:
    """Roundoff added to a unit diagonal: dependent constraints have small multipliers then."""
    return jnp.eye(m, dtype=dtype) * (16 * m**0.5 * float(jnp.finfo(dtype).eps))
