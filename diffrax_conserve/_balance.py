"""Balance laws: the rates of first integrals, integrated along a solution.

Between two times a first integral with a `rate` changes by the integral of its rate. Within a step
we know the solution by the dense output of the solver, and compute the integral by quadrature.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from ._custom_types import Args, Manifold, RealScalarLike, Values, Y
from ._manifold import at_full_precision, evaluate, is_entry, named_entries

# Gauss quadrature with four nodes is exact for polynomials of degree seven, so its error in a step
# is of order nine, like that of the most accurate solver in diffrax, Dopri8.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def has_rates(manifold: Manifold) -> bool:
    return any(entry.rate is not None for _, entry in named_entries(manifold))


def refuse_rates(manifold: Manifold, user: str) -> None:
    """Raises if an entry has a rate, because `user` does not integrate rates."""
    for name, entry in named_entries(manifold):
        if entry.rate is not None:
            raise ValueError(
                f"`{name}` is a balance law, a `FirstIntegral` with a `rate`, but {user} keeps "
                "values that do not change. Leave it to a `ManifoldProjection`."
            )


def rates(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> Values:
    """`manifold` with each entry replaced by its rate, shaped like its value. The rate of an entry
    that has none is zero."""

    def rate(entry: Any, like: Any) -> Values:
        fn = entry.rate
        if fn is None:
            return jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        return jtu.tree_map(
            lambda r, x: jnp.asarray(r, x.dtype), at_full_precision(fn, t, y, args), like
        )

    values = jax.eval_shape(lambda: evaluate(manifold, t, y, args))
    return jtu.tree_map(rate, manifold, values, is_leaf=is_entry)


def integrated_rates(
    manifold: Manifold,
    start: RealScalarLike,
    end: RealScalarLike,
    interpolant: Callable[[RealScalarLike], Y],
    args: Args,
) -> Values:
    """The integral of each rate along the `interpolant`, zero for an entry without a rate."""
    half = (end - start) / 2  # the nodes are in the interval from -1 to 1

    def at(node: RealScalarLike) -> Values:
        t = start + (1 + node) * half
        return rates(manifold, t, interpolant(t), args)

    def total(x: Array) -> Array:
        return jnp.sum(jax.vmap(jnp.multiply)(weights.astype(x.dtype), x), axis=0)

    dtype = jnp.result_type(half)
    weights = jnp.asarray(_WEIGHTS, dtype) * half
    return jtu.tree_map(total, jax.vmap(at)(jnp.asarray(_NODES, dtype)))
