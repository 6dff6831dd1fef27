"""Random points of the plane and of space, for the initial states of the systems."""

import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray


def annulus(
    key: PRNGKeyArray, shape: tuple[int, ...] = (), *, inner: float, outer: float
) -> Float[Array, "*shape 2"]:
    """Points of the plane with radius between `inner` and `outer`, uniform in area."""
    radius_key, angle_key = jr.split(key)
    r = jnp.sqrt(jr.uniform(radius_key, shape, minval=inner**2, maxval=outer**2))
    phi = jr.uniform(angle_key, shape, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(phi), r * jnp.sin(phi)], axis=-1)


def shell(key: PRNGKeyArray, *, inner: float, outer: float) -> Float[Array, "3"]:
    """A point of space with radius uniform between `inner` and `outer`, in any direction."""
    radius_key, direction_key = jr.split(key)
    return jr.uniform(radius_key, minval=inner, maxval=outer) * direction(direction_key, 3)


def direction(key: PRNGKeyArray, dimension: int) -> Float[Array, " dimension"]:
    """A unit vector, uniform on the sphere."""
    x = jr.normal(key, (dimension,))
    return x / jnp.linalg.norm(x)
