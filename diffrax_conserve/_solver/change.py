"""The change of first integrals along a short trajectory of the vector field."""

from collections.abc import Callable
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._balance import rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._projection.residual import residual_of
from .._tree import (
    real_view,
    tree_add,
    tree_norm,
    tree_scale,
    tree_stop_gradient,
    tree_sub,
    working_dtype,
)

# The share of its size by which the state moves, about.
_SPAN = 0.3
# The classical Runge-Kutta method: each stage needs only the slope before.
_NODES, _WEIGHTS = (0, 0.5, 0.5, 1), (1 / 6, 1 / 3, 1 / 3, 1 / 6)


def change_along(
    vector_field: Callable[[RealScalarLike, Y], Y],
    manifold: Manifold,
    values: Values,
    t: RealScalarLike,
    y: Y,
    args: Args,
    step: RealScalarLike,
    before: Array,
) -> tuple[Array, Array, PyTree[Array]]:
    """The change of every residual, which is `before` at `y`, along a short trajectory from there,
    less what its rate adds; the estimated error of this change; and how far each component of the
    `real_view` of `y` moves.

    The trajectory has the direction of `step`. It takes two steps of a Runge-Kutta method, and the
    error is estimated by the result of one step over the same time. It does not depend on the
    derivative at `y` alone, which can vanish there, and which is all roundoff where forces cancel.
    """
    dtype = working_dtype(y)
    t, step = jnp.asarray(t, dtype), jnp.asarray(step, dtype)

    def slope(t: Array, state: Any) -> Any:
        y, _ = state
        return tree_stop_gradient((vector_field(t, y), rates(manifold, t, y, args)))

    start = tree_stop_gradient((y, jtu.tree_map(jnp.zeros_like, values)))
    size, speed = tree_norm(y), tree_norm(slope(t, start)[0])
    moves = (size > 0) & (speed > 0)
    time = jnp.where(moves, _SPAN * size / jnp.where(moves, speed, 1), jnp.abs(step))
    h = jnp.sign(step) * time.astype(dtype)

    def end(t: Array, state: Any, h: Array) -> Any:
        nodes, weights = jnp.asarray(_NODES, dtype), jnp.asarray(_WEIGHTS, dtype)

        def stage(i: Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            k, total = carry
            k = slope(t + nodes[i] * h, tree_add(state, tree_scale(nodes[i] * h, k)))
            return k, tree_add(total, tree_scale(weights[i] * h, k))

        zeros = jtu.tree_map(jnp.zeros_like, state)
        _, total = lax.fori_loop(0, len(_NODES), stage, (zeros, state))
        return total

    def once(last: Any, given: tuple[Array, Array]) -> tuple[Any, Any]:
        first, h = given
        begin = jtu.tree_map(lambda a, b: jnp.where(first, a, b), start, last)
        reached = end(jnp.where(first, t, t + h), begin, h)
        return reached, reached

    # A loop, so that the vector field is compiled once: the whole time, then both halves.
    given = jnp.array([True, True, False]), h * jnp.array([1, 0.5, 0.5], dtype)
    _, reached = lax.scan(once, start, given)

    def change(index: int) -> Array:
        y, gained = jtu.tree_map(lambda x: x[index], reached)
        now = tree_add(values, gained)
        return residual_of(manifold, now, t + h, y, args)[0](real_view(y))

    coarse, fine = change(0) - before, change(2) - before
    ends = jtu.tree_map(lambda x: x[2], reached)
    moved = jtu.tree_map(jnp.abs, tree_sub(real_view(ends[0]), real_view(y)))
    return fine, jnp.abs(fine - coarse), moved
