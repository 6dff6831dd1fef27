"""The damped iteration, for starts far from the manifold.

It is the Gauss-Newton method for fewer equations than unknowns (P. Deuflhard, *Newton Methods for
Nonlinear Problems*, Springer 2004, Section 4.4): each step is the shortest, in the metric, that
solves the equations linearised at the current state. A step that increases the largest residual, or
leaves the domain of a function, is shortened until it does not: the loop goes back to the best
state so far, and tries a quarter of the way.
"""

from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .chord import Iterate, Solved, after_test, corrected, counter
from .elimination import scaled_rows
from .equations import Equations, Jacobian, any_lane, relative

# A step that does not help is shortened to this share of itself. A half needs twice as many
# evaluations where a step is far too long, and a much smaller share gives away steps that would do.
_SHORTER = 1 / 4


class _Best(NamedTuple):
    """The best state so far, and its largest residual relative to the scales.

    The scales are those at the first state for all states. A scale grows with the state, so that by
    their own scales residuals far away would look smaller than they are.
    """

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
    """A state on the manifold, which is near the start if that is near the manifold.

    The steps are along the given `directions`, or along the gradients at each state. In the second
    case the result depends on the path, so that its derivative is unknown. Once a state is within
    the tolerance, `extra` more iterations are made.
    """

    def body(carry: tuple[Iterate, _Best]) -> tuple[Iterate, _Best]:
        now, best = carry
        y = now.y
        g, jacobian = lax.optimization_barrier(equations.linearise(y))
        here = equations.scale(jacobian, y)
        level, noise = equations.level(g, here)
        # A start that is not finite is hopeless. Later states are not: their step was too long.
        left = after_test(level, now.left, extra=extra, gives_up=now.left == max_steps + 1)
        first = best.largest == jnp.inf
        scale = jnp.where(first, here, best.scale)
        sizes = jnp.abs(relative(g, scale))
        better = jnp.all(sizes <= best.largest)  # false if one is NaN
        largest = jnp.where(better, jnp.max(sizes), best.largest)
        best = _Best(jnp.where(better, y, best.y), largest, scale)
        sizes, rows = scaled_rows(equations.scaled(jacobian))
        along = rows if directions is None else directions
        further = corrected(equations, y, g / sizes, noise / sizes, rows, along)
        further = jnp.where(left > 0, further, y)
        shorter = best.y + _SHORTER * (y - best.y)
        y = jnp.where(better | (left <= 0), further, shorter)
        return Iterate(y, left, now.num_steps + (left > 0).astype(int)), best

    best = _Best(start, jnp.full_like(start[0], jnp.inf), equations.magnitude)
    carry = Iterate(start, counter(max_steps), jnp.asarray(0)), best
    end, _ = lax.while_loop(lambda carry: any_lane(carry[0].left > 0), body, carry)
    return Solved(end.y, end.left != -1, end.num_steps)
