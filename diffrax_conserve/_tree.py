"""PyTree arithmetic, and states as real vectors."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree, Shaped

from ._custom_types import Y


def real_view(y: Any) -> Any:
    """`y` with the real and the imaginary part of each complex leaf stacked along a new first axis.

    All linear algebra of this package is real, and works on this view. Because the new axis is the
    first one, an option such as a weight that broadcasts against the leaf broadcasts against the
    view too.
    """
    parts = lambda x: jnp.stack([jnp.real(x), jnp.imag(x)]) if jnp.iscomplexobj(x) else x  # noqa: E731
    return jtu.tree_map(parts, y)


def tree_add(a: Y, b: Y) -> Y:
    """`a + b`, in the dtypes of `a`."""
    return jtu.tree_map(lambda x, y: x + y.astype(x.dtype), a, b)


def tree_sub(a: Y, b: Y) -> Y:
    return jtu.tree_map(lambda x, y: x - y, a, b)


def tree_all_finite(a: PyTree[Array]) -> Array:
    finite = [jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(a)]
    return jnp.all(jnp.stack(finite)) if finite else jnp.asarray(True)


def unflatten(vector: Shaped[Array, " n"], like: Any) -> Any:
    """The components of `vector` in the structure, shapes and dtypes of `like`, whose leaves are
    real; see `unravel` for states."""
    leaves, treedef = jtu.tree_flatten(like)
    stops = np.cumsum([math.prod(jnp.shape(leaf)) for leaf in leaves])[:-1]
    parts = jnp.split(vector, stops)
    out = [
        part.reshape(jnp.shape(leaf)).astype(jnp.result_type(leaf))
        for part, leaf in zip(parts, leaves, strict=True)
    ]
    return jtu.tree_unflatten(treedef, out)


def eps_of(x: Any) -> float:
    """The machine epsilon of an array or a dtype, the spacing of floats at one. "Units of roundoff"
    are multiples of it here, although the largest relative error of rounding is half of it."""
    return float(jnp.finfo(jnp.result_type(x)).eps)


def tree_size(a: Any) -> int:
    """The number of scalars in `a`."""
    return sum(math.prod(jnp.shape(x)) for x in jtu.tree_leaves(a))


def tree_shapes(a: Any) -> Any:
    """`a` with each leaf replaced by its shape."""
    return jtu.tree_map(jnp.shape, a)


def tree_stop_gradient(a: Any) -> Any:
    """`a` without its derivative. Leaves that are no arrays, such as functions, stay as they
    are."""
    return jtu.tree_map(lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, a)


def tree_tangents(a: Any, t_a: Any) -> Any:
    """`t_a`, the tangents of `a`, with zeros in the place of each `None`, which equinox gives where
    something is not differentiated."""
    return jtu.tree_map(lambda x, t: jnp.zeros_like(x) if t is None else t, a, t_a)


def key_of(entry: Any) -> Any:
    """What an entry of a path in a PyTree says: a key, a position or a name."""
    return getattr(entry, "key", getattr(entry, "idx", getattr(entry, "name", None)))


def irregular_weights(n: int, dtype: Any) -> Array:
    """The sines of 1, 4, 9, ..., in which there is no pattern: as a direction they are in general
    position, and the same in every call."""
    return jnp.asarray(np.sin(np.arange(1, n + 1, dtype=float) ** 2), dtype)


def ravel(y: Any) -> Any:
    """The components of `y` as one real vector, complex ones as real and imaginary parts."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)) for x in jtu.tree_leaves(real_view(y))])


def unravel(vector: Any, like: Any) -> Any:
    """The state whose `ravel` is `vector`, with the structure, shapes and dtypes of `like`."""
    view = unflatten(vector, jax.eval_shape(real_view, like))
    whole = lambda v, x: lax.complex(v[0], v[1]) if jnp.iscomplexobj(x) else v  # noqa: E731
    return jtu.tree_map(whole, view, like)
