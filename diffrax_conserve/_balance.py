"""Balance laws: what the rates of first integrals add up to along a solution."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from ._custom_types import Args, Manifold, RealScalarLike, Values, Y
from ._manifold import rates

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
        return rates(manifold, t * direction, path(t), args)

    dtype = jnp.result_type(half)
    found = jax.vmap(at)(jnp.asarray(_NODES, dtype))
    weights = jnp.asarray(_WEIGHTS, dtype) * half * direction
    return jtu.tree_map(lambda x: _weighted_sum(weights.astype(x.dtype), x), found)


def _weighted_sum(weights: Array, x: Array) -> Array:
    return jnp.sum(weights.reshape(-1, *[1] * (x.ndim - 1)) * x, axis=0)
