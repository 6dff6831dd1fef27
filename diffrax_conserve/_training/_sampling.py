"""Collocation points: where the defect is made small."""

from collections.abc import Callable

import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

# `(key, count, first, last)` to times.
Times = Callable[[PRNGKeyArray, int, float, float], Float[Array, " points"]]


def uniform_times(
    key: PRNGKeyArray, count: int, first: float, last: float
) -> Float[Array, " points"]:
    """Independent times, uniform between `first` and `last`."""
    return jr.uniform(key, (count,), minval=first, maxval=last)


def grid_times(key: PRNGKeyArray, count: int, first: float, last: float) -> Float[Array, " points"]:
    """Equally spaced times from `first` to `last`."""
    del key
    return jnp.linspace(first, last, count)
