"""The damped iteration, for starts far from the manifold.

It makes Gauss-Newton steps along the gradients at each state. A step that increases the largest
residual, or leaves the domain of a function, is shortened until it does not: the loop goes back to
the best state so far, and tries a quarter of the way.
"""

from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .chord import Solved, after_test, corrected, counter
from .elimination import scaled_rows
from .equations import Equations, Jacobian, any_lane, relative

_SHORTER = 1 / 4


class _Best(NamedTuple):
    """The best state so far, its largest residual relative to the scales, which are those at the
    first state, because scales elsewhere would make residuals there look smaller than they are."""

    y: Float[Array, " n"]
    largest: Float[Array, ""]
    scale: Float[Array, " m"]


def descend(
    equations: Equations,
    start: Float[Array, " n"],
    directions: Jacobian | None = None,
    *,
    max_steps: int,
    extra: int = 0,
) -> Solved:
    """A state on the manifold, near the start if that is near, along given `directions` or along
    the gradients at each state; then its derivative is unknown. Once it is within the tolerance,
    `extra` more iterations are made."""

    def body(carry: tuple[Array, _Best, Array, Array]) -> tuple[Array, _Best, Array, Array]:
        y, best, left, count = carry
        g, jacobian = lax.optimization_barrier(equations.linearise(y))
        here = equations.scale(jacobian, y)
        level, noise = equations.level(g, here)
        left = after_test(level, left, extra=extra, gives_up=left == max_steps + 1)
        first = best.largest == jnp.inf
        scale = jnp.where(first, here, best.scale)
        sizes = jnp.abs(relative(g, scale))
        better = jnp.all(sizes <= best.largest)  # NaN is not
        largest = jnp.where(better, jnp.max(sizes), best.largest)
        best = _Best(jnp.where(better, y, best.y), largest, scale)
        sizes, rows = scaled_rows(equations.scaled(jacobian))
        along = rows if directions is None else directions
        further = corrected(equations, y, g / sizes, noise / sizes, rows, along)
        further = jnp.where(left > 0, further, y)
        shorter = best.y + _SHORTER * (y - best.y)
        y = jnp.where(better | (left <= 0), further, shorter)
        return y, best, left, count + (left > 0).astype(int)

    best = _Best(start, jnp.full_like(start[0], jnp.inf), equations.magnitude)
    carry = start, best, counter(max_steps), jnp.asarray(0)
    y, _, left, count = lax.while_loop(lambda x: any_lane(x[2] > 0), body, carry)
    return Solved(y, left != -1, count)
