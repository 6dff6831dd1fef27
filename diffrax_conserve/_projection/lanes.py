"""A branch that few lanes of a batch take, computed for those lanes only."""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, Int8

_State = TypeVar("_State")

# Lanes are gathered separately in up to this many blocks, so that a batch sharded over as many
# devices needs no communication between them.
_BLOCKS = 32
# The reciprocal of the fraction of lanes that is finished at a time, and the least number of such
# lanes: for fewer lanes, starting the computation costs more than the arithmetic.
_SHARES = 32
_LEAST_WIDTH = 64
# The reciprocal of the share of lanes from which they iterate together, and the largest number of
# such iterations.
_CROWD = 64
_MOST_ROUNDS = 8
# The status of a lane that iterates with the others. One number, because XLA computes an iteration
# again for each of its outputs.
DONE, TRYING, LOST = range(3)


def continue_if_any(
    fn: Callable[[Bool[Array, ""], _State, Any], _State],
    flag: Bool[Array, ""],
    state: _State,
    operands: Any,
    *,
    crowd: Callable[[_State, Any], tuple[Int8[Array, ""], _State]],
    rounds: int,
) -> _State:
    """`fn(flag, state, operands)` if `flag` is set, otherwise `state`.

    In a batch, the lanes whose flag is set are gathered, some at a time, passed to `fn`, and
    scattered back. (A `lax.cond` in a batch runs both branches for every lane.) The value of `fn`
    for a lane whose flag is not set is not used. `fn` must not close over arrays.

    Many lanes are not gathered, which would cost more than it saves. Instead, while many are
    flagged, and at most `rounds` times, all lanes compute `crowd(state, operands)`: whether a lane
    is `DONE`, `TRYING` or `LOST`, and its next state. Lanes that are not done in the end are
    gathered, with their first state, so that they do not depend on the others.
    """
    arrays, static = eqx.partition(operands, eqx.is_array)

    def lane(flag: Array, state: _State, arrays: Any) -> _State:
        return fn(flag, state, eqx.combine(arrays, static))

    def together(state: _State, arrays: Any) -> tuple[Array, _State]:
        return crowd(state, eqx.combine(arrays, static))

    @jax.custom_batching.custom_vmap
    def alone(flag, state, arrays):
        # Not `flag`: XLA may compute it twice with different rounding, for the branch and for `fn`.
        return lax.cond(flag, lambda: lane(jnp.asarray(True), state, arrays), lambda: state)

    @alone.def_vmap
    def batched(size, axes, flag, state, arrays):
        flags, states = _broadcast(size, tuple(axes[:2]), (flag, state))
        batch, shared = _split(arrays, axes[2])
        out = _lanes(flags, states, batch, shared)
        return out, jtu.tree_map(lambda _: True, out)

    def finish(flags, states, batch, shared):
        if rounds > 0:
            most = min(rounds, _MOST_ROUNDS)
            flags, states = _iterate_together(together, most, flags, states, batch, shared)
        return _if_any(ft.partial(_gather, lane), flags, states, batch, shared)

    # The loop of a solve is traced more than once, but a jitted function only once.
    finish = jax.jit(finish, inline=True)

    # A nested `vmap` is flattened to one batch.
    @jax.custom_batching.custom_vmap
    def _lanes(flags, states, batch, shared):
        return _if_any(finish, flags, states, batch, shared)

    @_lanes.def_vmap
    def batch_of_batches(size, axes, flags, states, batch, shared):
        lanes = flags.shape[1 if axes[0] else 0]
        more, same = _split(shared, axes[3])
        # Operands shared within each inner batch, but not across batches, are repeated.
        more = jtu.tree_map(lambda x: jnp.repeat(x, lanes, axis=0), more)
        flat = jtu.tree_map(
            lambda x: x.reshape(size * lanes, *x.shape[2:]),
            _broadcast(size, tuple(axes[:3]), (flags, states, batch)),
        )
        out = _lanes(*flat[:2], eqx.combine(flat[2], more), same)
        out = jtu.tree_map(lambda x: x.reshape(size, lanes, *x.shape[1:]), out)
        return out, jtu.tree_map(lambda _: True, out)

    return alone(flag, state, arrays)


def _if_any(fn: Callable, flags: Bool[Array, " lanes"], states: Any, *operands: Any) -> Any:
    return lax.cond(jnp.any(flags), fn, lambda _, states, *__: states, flags, states, *operands)


def _gather(lane: Callable, flags: Bool[Array, " lanes"], states: Any, batch: Any, shared: Any):
    lanes = flags.shape[0]
    blocks = math.gcd(lanes, _BLOCKS)
    length = lanes // blocks
    width = min(length, -(-max(lanes // _SHARES, _LEAST_WIDTH) // blocks))
    rounds = -(-length // width)

    def finished(flag: Array, state: Any, batch: Any) -> Any:
        return lane(flag, state, eqx.combine(batch, shared))

    if rounds == 1:  # All lanes fit.
        return _choose(flags, jax.vmap(finished)(flags, states, batch), states)
    flags, states, batch = jtu.tree_map(
        lambda x: x.reshape(blocks, length, *x.shape[1:]), (flags, states, batch)
    )
    order = jax.vmap(lambda f: _positions(f, width * rounds))(flags)
    most = jnp.max(jnp.sum(flags, axis=1))

    def taken(x: Array, index: Array) -> Array:
        return x.at[index].get(mode="clip")

    def put(x: Array, index: Array, y: Array) -> Array:
        return x.at[index].set(y, mode="drop")

    def body(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        start, states = carry
        index = lax.dynamic_slice_in_dim(order, start, width, axis=1)

        # All blocks in one row, because loops over short rows are slow.
        def row_of(x: Array) -> Array:
            return jax.vmap(taken)(x, index).reshape(blocks * width, *x.shape[2:])

        flags = (index < length).reshape(-1)
        out = jax.vmap(finished)(flags, *jtu.tree_map(row_of, (states, batch)))
        states = jtu.tree_map(
            lambda x, y: jax.vmap(put)(x, index, y.reshape(blocks, width, *y.shape[1:])),
            states,
            out,
        )
        return start + width, states

    _, states = lax.while_loop(lambda carry: carry[0] < most, body, (jnp.zeros_like(most), states))
    return jtu.tree_map(lambda x: x.reshape(lanes, *x.shape[2:]), states)


def _iterate_together(
    crowd: Callable,
    rounds: int,
    flags: Bool[Array, " lanes"],
    states: Any,
    batch: Any,
    shared: Any,
) -> tuple[Bool[Array, " lanes"], Any]:
    def body(carry: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
        index, status, last = carry
        new_status, new = jax.vmap(lambda s, b: crowd(s, eqx.combine(b, shared)))(last, batch)
        trying = status == TRYING
        return index + 1, jnp.where(trying, new_status, status), _choose(trying, new, last)

    def crowded(carry: tuple[Array, Array, Any]) -> Array:
        index, status, _ = carry
        return (index < rounds) & (jnp.sum(status == TRYING) * _CROWD > status.size)

    status = jnp.where(flags, TRYING, DONE).astype(jnp.int8)
    _, status, last = lax.while_loop(crowded, body, (jnp.asarray(0), status, states))
    return status != DONE, _choose(status == DONE, last, states)


def _choose(flags: Bool[Array, " lanes"], a: Any, b: Any) -> Any:
    def choose(a: Array, b: Array) -> Array:
        return jnp.where(flags.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jtu.tree_map(choose, a, b)


def _positions(flags: Bool[Array, " length"], size: int) -> Int[Array, " size"]:
    """The indices of the set `flags`, padded with an index that is out of range. Like
    `jax.numpy.nonzero`, with one cumulative sum less."""
    length = flags.shape[0]
    place = jnp.where(flags, jnp.cumsum(flags) - 1, size)
    return jnp.full(size, length).at[place].set(jnp.arange(length), mode="drop")


def _broadcast(size: int, axes: Any, tree: Any) -> Any:
    return jtu.tree_map(
        lambda x, batched: x if batched else jnp.broadcast_to(x, (size, *jnp.shape(x))), tree, axes
    )


def _split(arrays: Any, axes: Any) -> tuple[Any, Any]:
    """The arrays with an axis of lanes, and those without."""
    return eqx.partition(arrays, axes)
