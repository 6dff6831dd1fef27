"""Balance laws: what the rates of first integrals add up to along a solution."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ._custom_types import Args, Manifold, RealScalarLike, Values, Y
from ._manifold import evaluate, is_entry, rate_of

# Gauss quadrature of order eight, which is that of the solver of diffrax with the highest.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def integrated_rates(
    manifold: Manifold,
    start: RealScalarLike,
    end: RealScalarLike,
    path: Callable[[RealScalarLike], Y],
    args: Args,
    direction: RealScalarLike,
) -> Values:
    """The integral of each rate along `path`, zero for an entry without one.

    All times are the solver's, which are `direction` times those of the manifold.
    """
    half = (end - start) / 2

    def at(node: RealScalarLike) -> Values:
        t = start + (1 + node) * half
        y = path(t)
        values = jax.eval_shape(lambda: evaluate(manifold, t, y, args))
        return jtu.tree_map(
            lambda entry, like: _rate(entry, like, t * direction, y, args),
            manifold,
            values,
            is_leaf=is_entry,
        )

    dtype = jnp.result_type(half)
    rates = jax.vmap(at)(jnp.asarray(_NODES, dtype))
    weights = jnp.asarray(_WEIGHTS, dtype) * half * direction
    return jtu.tree_map(lambda x: _weighted_sum(weights.astype(x.dtype), x), rates)


def _rate(
    entry: Any, like: PyTree[jax.ShapeDtypeStruct], t: RealScalarLike, y: Y, args: Args
) -> Values:
    fn = rate_of(entry)
    if fn is None:
        return jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    return jtu.tree_map(lambda r, x: jnp.asarray(r, x.dtype), fn(t, y, args), like)


def _weighted_sum(weights: Array, x: Array) -> Array:
    return jnp.sum(weights.reshape(-1, *[1] * (x.ndim - 1)) * x, axis=0)
