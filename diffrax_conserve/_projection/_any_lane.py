"""A branch that stays a branch in a batch."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool

_State = TypeVar("_State")


def continue_if_any(
    fn: Callable[[Bool[Array, ""], _State, Any], _State],
    flag: Bool[Array, ""],
    state: _State,
    operands: Any,
) -> _State:
    """`fn(flag, state, operands)` if `flag` is set, and `state` if not.

    In a batch, `fn` runs if the flag of any lane is set, with each lane's own flag, and must leave
    the lanes alone whose flag is not set. (A `lax.cond` in a batch runs both branches, always.)
    `fn` may close over no arrays.
    """
    arrays, static = eqx.partition(operands, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def branch(flag, state, arrays):
        def taken(state, arrays):
            return fn(flag, state, eqx.combine(arrays, static))

        return lax.cond(flag, taken, lambda state, _: state, state, arrays)

    @branch.def_vmap
    def batched_branch(size, batched, flag, state, arrays):
        flag_batched, state_batched, arrays_batched = batched

        def broadcast(x, batched):
            return x if batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

        flags = broadcast(flag, flag_batched)
        states = jtu.tree_map(broadcast, state, state_batched)
        axes = jtu.tree_map(lambda b: 0 if b else None, arrays_batched)

        def lanes(_, states, operands):
            def lane(flag, state, arrays):
                return fn(flag, state, eqx.combine(arrays, static))

            return jax.vmap(lane, (0, 0, axes))(operands[0], states, operands[1])

        out = continue_if_any(lanes, jnp.any(flags), states, (flags, arrays))
        return out, jtu.tree_map(lambda _: True, out)

    return branch(flag, state, arrays)
