"""Derivatives of functions along vector fields."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ._custom_types import Args, ConstraintFn, RealScalarLike, Values, Y
from ._tree import tree_shapes


class Along(eqx.Module):
    """The derivative of a function along a vector field."""

    fn: ConstraintFn
    vector_field: Callable[[RealScalarLike, Any, Args], Any]

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        t = jnp.asarray(t, jnp.result_type(float, t))
        y = jtu.tree_map(jnp.asarray, y)
        slope = slope_like(y, self.vector_field(t, y, args))
        _, along = jax.jvp(lambda t, y: self.fn(t, y, args), (t, y), (jnp.ones_like(t), slope))
        return along


def slope_like(y: Y, slope: Any) -> Y:
    """The value of a vector field, broadcast and cast to the shapes and dtypes of the state."""
    if jtu.tree_structure(slope) == jtu.tree_structure(y):
        pairs = zip(jtu.tree_leaves(slope), jtu.tree_leaves(y), strict=True)
        if all(jnp.shape(f) in ((), jnp.shape(x)) for f, x in pairs):
            return jtu.tree_map(
                lambda x, f: jnp.broadcast_to(jnp.asarray(f, x.dtype), x.shape), y, slope
            )
    raise ValueError(
        f"`vector_field` returns the structure {tree_shapes(slope)}, but the state has "
        f"{tree_shapes(y)}. Both must be the same."
    )
