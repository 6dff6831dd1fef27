"""The iterations of the paper's conservative layer, whose number grows in the training.

Their derivatives are those of what is computed, iteration by iteration, also far from the manifold.
"""

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ..._numerics.problem import Problem, relative_to_scale
from .trainable import LayerSchedule


def iterated(
    problem: Problem,
    candidate: Float[Array, " n"],
    radius: Float[Array, ""] | None,
    steps: int,
    schedule: LayerSchedule | None,
) -> Float[Array, " n"]:
    r"""`ŷ + G(ŷ)ᵀ λ` with `λ = (1 - s) λ_{p-1} + s λ_p`, where `schedule` is `(p, s)`; by default
    `λ` after all `steps`. Iterations beyond the `p`-th are not computed.

    Newton's method in `λ`, with rows scaled to norm one, a damping `μ = min(1e-2, |g|²)` that
    vanishes with the residual relative to its scale, and moves of at most `radius`. Without one it
    is the algorithm as printed: `G(y)` is `G(ŷ)`, and nothing is damped.
    """
    dtype = candidate.dtype
    p, s = (jnp.asarray(steps), jnp.ones(())) if schedule is None else schedule
    before, rows = problem.linearise(candidate)

    def improve(multipliers: Array) -> Array:
        y = candidate + rows.rmatvec(multipliers)
        g, jacobian = problem.linearise(y)
        if radius is None:
            return multipliers - rows.gram(rows).solve(g)
        ratio = relative_to_scale(g, problem.scale(jacobian, y))
        damping = jnp.minimum(1e-2, jnp.sum(ratio * ratio))
        damped = 1 + damping * jnp.eye(g.size, dtype=dtype)
        gram = jtu.tree_map(lambda matrix: matrix * damped, jacobian.gram(rows))
        change = gram.solve(g)
        step = rows.rmatvec(change)
        return multipliers - lax.rsqrt(1 + jnp.sum(step * step) / radius**2) * change

    def iterate(carry: tuple[Array, Array], i: Array) -> tuple[tuple[Array, Array], None]:
        return lax.cond(i < p, lambda c: (c[1], improve(c[1])), lambda c: c, carry), None

    zeros = jnp.zeros_like(before)
    (previous, last), _ = lax.scan(iterate, (zeros, zeros), jnp.arange(steps))
    return candidate + rows.rmatvec(previous + s.astype(dtype) * (last - previous))
