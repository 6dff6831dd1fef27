"""The length of a step, as a divisor."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import RealScalarLike


def nonzero_length(t0: RealScalarLike, t1: RealScalarLike) -> Float[Array, ""]:
    """`t1 - t0`, or one for a step of no length.

    In a batch diffrax evaluates steps of no length in the lanes that have arrived, and discards the
    results. In reverse mode their cotangents are zero. So a quotient by the length must be finite,
    with its derivative: zero times infinity would be NaN.
    """
    length = jnp.asarray(t1 - t0)
    return jnp.where(length == 0, 1, length)
