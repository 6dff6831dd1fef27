"""What a network is given: states, which it takes and returns as vectors, and checks."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree, Shaped

from ..._custom_types import Y
from ..._options import ONE_STATE, check_number, is_real
from ..._printing import is_traced


def working_dtype(y: Y) -> jnp.dtype:
    """The real dtype that represents the parts of every leaf of `y` without loss."""
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*jtu.tree_leaves(y))
    return jnp.finfo(dtype).dtype if jnp.issubdtype(dtype, jnp.complexfloating) else dtype


def flatten(y: Y) -> Float[Array, " n"]:
    """All components of `y` in one vector, of a dtype that represents every leaf."""
    dtype = working_dtype(y)
    leaves = [jnp.asarray(x).astype(dtype).reshape(-1) for x in jtu.tree_leaves(y)]
    return leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)


def check_key(key: Any) -> None:
    if not (eqx.is_array(key) and (jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.ndim)):
        raise TypeError(f"`key` is {key!r}, but it must be a random key: `jax.random.key(0)`.")


def check_scalars(
    *, least: Any = None, above: Any = None, optional: bool = True, **values: Any
) -> None:
    for name, value in values.items():
        if np.ndim(value):
            raise TypeError(f"`{name}` is {value!r}, but it must be one number.")
        check_number(name, value, least=least, above=above, optional=optional)


def check_within(name: str, value: Any, first: float, last: float) -> None:
    """Raises if a value that is known, outside of `jit`, is not from `first` to `last`."""
    if isinstance(value, jax.core.Tracer):
        return
    slack = 1e-6 * (last - first)
    if not np.all((first - slack <= np.asarray(value)) & (np.asarray(value) <= last + slack)):
        raise ValueError(
            f"`{name}` is {value}, but the network was trained from {first:g} to {last:g}, and "
            "does not extrapolate."
        )


def check_one(name: str, value: Any, function: str) -> None:
    """Raises unless `value` is one number, not an array of them."""
    if np.ndim(value):
        raise ValueError(
            f"`{name}` has shape {np.shape(value)}, but the network takes one number. For several "
            f"write `jax.vmap({function})({name}s)`."
        )


def largest(leaf: Array) -> Float[Array, ""]:
    """The size of the largest component of a leaf, or 1 if all are zero."""
    size = jnp.max(jnp.abs(leaf), initial=0)
    return jnp.where(size > 0, size, 1)


def as_state(y: PyTree[Shaped[ArrayLike, "..."]]) -> PyTree[Float[Array, "..."]]:
    """`y` with arrays as leaves; raises unless they are real and floating-point."""
    leaves = jtu.tree_leaves(y)
    if wrong := [x for x in leaves if not is_real(x)]:
        raise TypeError(
            f"The state has the leaf {wrong[0]!r}, but a network needs real numbers. Split complex "
            "ones into real and imaginary parts."
        )
    if not any(jnp.size(x) for x in leaves):
        raise ValueError("The state has no numbers: there is nothing to learn.")

    def floating(leaf: ArrayLike) -> Array:
        dtype = jnp.result_type(leaf)
        return jnp.asarray(leaf, dtype if jnp.issubdtype(dtype, jnp.floating) else float)

    return jtu.tree_map(floating, y)


def as_states(
    states: PyTree[Shaped[ArrayLike, "..."]], name: str = "states"
) -> PyTree[Float[Array, "..."]]:
    """`as_state` of states that are stacked along a leading axis; raises unless they are."""
    if callable(states):
        raise TypeError(
            f"`{name}` is a function. Draw states from it: "
            "`jax.vmap(function)(jax.random.split(key, 1000))`."
        )
    states = as_state(states)
    shapes = [jnp.shape(x) for x in jtu.tree_leaves(states)]
    lengths = {shape[:1] for shape in shapes}
    if len(lengths) != 1 or lengths == {()} or lengths == {(0,)}:
        raise ValueError(
            f"`{name}` must be one state or more, stacked along a leading axis, but the leaves "
            f"have shapes {shapes}. " + ONE_STATE
        )
    if not is_traced(states) and not all(np.all(np.isfinite(x)) for x in jtu.tree_leaves(states)):
        raise ValueError(f"`{name}` holds a state that is not finite. Leave it out.")
    return states


def stacked_vectors(ys: Y) -> Float[Array, "count n"]:
    """States stacked along a leading axis, as the rows of a matrix."""
    return jax.vmap(flatten)(ys)
