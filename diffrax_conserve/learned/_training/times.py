"""Distributions of the times of collocation points."""

import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from ..._custom_types import RealScalarLike


def uniform_times(
    key: PRNGKeyArray, count: int, first: RealScalarLike, last: RealScalarLike
) -> Float[Array, " points"]:
    """Independent times, uniform between `first` and `last`."""
    return jr.uniform(key, (count,), minval=first, maxval=last)


def grid_times(
    key: PRNGKeyArray, count: int, first: RealScalarLike, last: RealScalarLike
) -> Float[Array, " points"]:
    """Equally spaced times from `first` to `last`."""
    del key
    return jnp.linspace(first, last, count)
