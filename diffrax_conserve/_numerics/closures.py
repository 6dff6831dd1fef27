"""Functions whose closed-over arrays are leaves, so that derivative rules see them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.tree_util as jtu


class ClosureConverted(eqx.Module):
    """A function of one PyTree of arrays that is like `like`, as its program. The arrays over which
    it closes, such as the parameters of a network, are leaves: only so can a custom rule
    differentiate by them.

    The integers over which it closes keep their values. They are usually indices, such as of
    `y[indices]`, and `scalars` can follow a function that moves elements only if it knows the
    indices. For JAX the function `program` is a leaf that is no array, so that no transformation
    replaces these values by tracers.

    `equinox.filter_closure_convert` would compare the shardings of its arguments too, which in
    `jax.shard_map` are others for each trace.
    """

    arrays: list[Any]
    program: Callable[..., Any]

    def __init__(self, fn: Callable[[Any], Any], like: Any):
        closed, out = jax.make_jaxpr(fn, return_shape=True)(like)
        treedef = jtu.tree_structure(out)
        is_variable = lambda x: isinstance(x, jax.core.Tracer) or eqx.is_inexact_array(x)  # noqa: E731
        self.arrays, constants = eqx.partition(closed.consts, is_variable)

        def program(arrays: list[Any], *leaves: Any) -> Any:
            constants_too = eqx.combine(arrays, constants)
            return treedef.unflatten(jax.core.eval_jaxpr(closed.jaxpr, constants_too, *leaves))

        self.program = program

    def __call__(self, x: Any) -> Any:
        return self.program(self.arrays, *jtu.tree_leaves(x))
