"""The lanes of a batch: conditions that they share, and arrays in which they are the last axis."""

import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.custom_batching
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool

from .._fast.scalars import scalarised


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, "*lanes"]) -> Bool[Array, ""]:
    """Whether the flag of any lane of a batch is set, for the conditions of loops and branches.

    If the condition of a `while_loop` differs from lane to lane, `vmap` adds a select for each
    array in the carry, which keeps the lanes that are done. With this condition, which is the same
    for all lanes, it adds none. A branch with such a condition remains a branch.
    """
    return jnp.any(flag)


@any_lane.def_vmap
def _any_lane(size: int, axes: Any, flags: Bool[Array, "size *lanes"]) -> tuple[Array, bool]:
    del size, axes
    return any_lane(jnp.any(flags)), False


def where_active(tests_left: Array, moved: Any, y: Any) -> Any:
    """The moved unknowns where the iteration goes on, and the old ones where it is done."""
    return jtu.tree_map(lambda a, b: jnp.where(tests_left > 0, a, b), moved, y)


def with_lanes_last(run: Callable[[Any, Array, bool], Any], given: Any, y: Array) -> Any:
    """`run(map_lanes, y, is_batched)`, where `map_lanes(fn)(*xs)` is `fn(given, *xs)`.

    In a batch the lanes are the last axis of `y`, of all `xs`, and of all results, so that an
    operation on small arrays is a loop over the lanes, which the processor does several at a time.
    With the lanes first, as `vmap` has them, its innermost loop is over the few elements of one.
    `map_lanes(fn)` maps a function of one lane over them, in scalars, if that is not too large.
    """
    arrays, static = eqx.partition(given, eqx.is_array)
    leaves, treedef = jtu.tree_flatten(arrays)
    whole = lambda leaves: eqx.combine(treedef.unflatten(leaves), static)  # noqa: E731

    @jax.custom_batching.custom_vmap
    @jax.jit
    def alone(leaves: Any, y: Array) -> Any:
        return run(lambda fn: ft.partial(fn, whole(leaves)), y, False)

    @ft.partial(jax.jit, static_argnums=0)
    def lanes(axes: tuple[int | None, ...], leaves: Any, y: Array) -> Any:
        def map_lanes(fn: Callable[..., Any]) -> Callable[..., Any]:
            of_leaves = lambda leaves, *xs: fn(whole(leaves), *xs)  # noqa: E731
            return lambda *xs: _mapped(of_leaves, [*axes], leaves, xs)

        out = run(map_lanes, jnp.moveaxis(y, 0, -1), True)
        return jtu.tree_map(lambda x: jnp.moveaxis(x, -1, 0), out)

    @alone.def_vmap
    def batched(size: int, axes: Any, leaves: Any, y: Array) -> Any:
        of_leaves, of_y = axes
        y = y if of_y else jnp.broadcast_to(y, (size, *y.shape))
        out = lanes(tuple(0 if x else None for x in of_leaves), leaves, y)
        return out, jtu.tree_map(lambda x: True, out)

    return alone(leaves, y)


class _TooLarge(Exception):
    """A function that is too large to be written out in scalars."""


def _mapped(fn: Callable[..., Any], axes: Any, leaves: Any, xs: tuple[Any, ...]) -> Any:
    """`fn(leaves, *xs)` in each lane, which are the last axis of the `xs` and of the results."""
    like = [jax.ShapeDtypeStruct(x.shape[:-1], x.dtype) for x in xs]
    out_like = None

    def in_scalars(leaves: Any, parts: Any) -> Any:
        nonlocal out_like
        of_lane = ft.partial(fn, leaves)
        out_like, evaluate = jax.eval_shape(of_lane, *like), scalarised(of_lane, *like)
        if evaluate is None:
            raise _TooLarge
        return evaluate(*parts)

    parts = [tuple(x.reshape(-1, x.shape[-1])) if x.ndim > 1 else x for x in xs]
    try:
        found = jax.vmap(in_scalars, (axes, 0))(leaves, parts)
    except _TooLarge:
        return jax.vmap(fn, (axes, *[-1] * len(xs)), -1)(leaves, *xs)
    return jtu.tree_map(
        lambda like, x: jnp.stack(x).reshape(*like.shape, -1) if like.ndim else x, out_like, found
    )
