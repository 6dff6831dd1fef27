"""Balance laws: the rates of first integrals, integrated along a solution."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from ._custom_types import Args, Manifold, RealScalarLike, Values, Y
from ._manifold import evaluate, exactly, is_entry, named_entries, rate_of

# Gauss quadrature of order eight, the highest order of any solver in diffrax.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def has_rates(manifold: Manifold) -> bool:
    return any(rate_of(entry) is not None for _, entry in named_entries(manifold))


def refuse_rates(manifold: Manifold, user: str) -> None:
    """Raises if an entry has a rate, because `user` does not integrate rates."""
    for name, entry in named_entries(manifold):
        if rate_of(entry) is not None:
            raise ValueError(
                f"`{name}` is a balance law, a `FirstIntegral` with a `rate`, but {user} keeps "
                "values that do not change. Leave it to a `ManifoldProjection`."
            )


def rates(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> Values:
    """`manifold` with each entry replaced by its rate, zero where it has none."""

    def rate(entry: Any, like: Any) -> Values:
        fn = rate_of(entry)
        if fn is None:
            return jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        return jtu.tree_map(lambda r, x: jnp.asarray(r, x.dtype), exactly(fn, t, y, args), like)

    values = jax.eval_shape(lambda: evaluate(manifold, t, y, args))
    return jtu.tree_map(rate, manifold, values, is_leaf=is_entry)


def integrated_rates(
    manifold: Manifold,
    start: RealScalarLike,
    end: RealScalarLike,
    path: Callable[[RealScalarLike], Y],
    args: Args,
    direction: RealScalarLike,
) -> Values:
    """The integral of each rate along `path`, zero for an entry without one. All times are those of
    the solver, that is `direction` times the times of the manifold."""
    half = (end - start) / 2

    def at(node: RealScalarLike) -> Values:
        t = start + (1 + node) * half
        return rates(manifold, t * direction, path(t), args)

    def total(x: Array) -> Array:
        return jnp.sum(jax.vmap(jnp.multiply)(weights.astype(x.dtype), x), axis=0)

    dtype = jnp.result_type(half)
    weights = jnp.asarray(_WEIGHTS, dtype) * half * direction
    return jtu.tree_map(total, jax.vmap(at)(jnp.asarray(_NODES, dtype)))
