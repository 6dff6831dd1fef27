r"""Jacobi's elliptic functions and the first elliptic integral, which JAX lacks.

In terms of the parameter $m = k^2$, $0 \le m \le 1$, as in `scipy.special`. All by the arithmetic
and geometric means, Abramowitz and Stegun, "Handbook of Mathematical Functions", 16.4 and 17.6;
they fail at $m = 1$, where the functions are hyperbolic.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

# The means converge quadratically: ten steps reach roundoff for every m < 1 of float64.
_STEPS = 10


def _means(m: Float[Array, "*s"]) -> list[tuple[Float[Array, "*s"], Float[Array, "*s"]]]:
    means = [(jnp.ones_like(m), jnp.sqrt(1 - m))]
    for _ in range(_STEPS):
        a, b = means[-1]
        means.append(((a + b) / 2, jnp.sqrt(a * b)))
    return means


def complete_elliptic(m: Float[Array, "*s"]) -> Float[Array, "*s"]:
    r"""$K(m) = \int_0^{\pi/2} (1 - m \sin^2\theta)^{-1/2} d\theta$."""
    a, _ = _means(m)[-1]
    return jnp.where(m == 1, jnp.inf, jnp.pi / (2 * a))


def incomplete_elliptic(phi: Float[Array, "*s"], m: Float[Array, "*s"]) -> Float[Array, "*s"]:
    r"""$F(\phi, m) = \int_0^\phi (1 - m \sin^2\theta)^{-1/2} d\theta$."""
    *means, (last, _) = _means(m)
    angle = phi
    for a, b in means:
        turned = jnp.arctan(b / a * jnp.tan(angle)) + jnp.pi * jnp.round(angle / jnp.pi)
        angle = angle + turned
    return jnp.where(m == 1, jnp.arctanh(jnp.sin(phi)), angle / (2.0**_STEPS * last))


def jacobi_elliptic(
    u: Float[Array, "*#s"], m: Float[Array, "*#s"]
) -> tuple[Float[Array, "*s"], Float[Array, "*s"], Float[Array, "*s"]]:
    r"""$\mathrm{sn}(u, m)$, $\mathrm{cn}(u, m)$, $\mathrm{dn}(u, m)$."""
    u, m = jnp.broadcast_arrays(u, m)
    *means, (last, _) = _means(m)
    phi = 2.0**_STEPS * last * u
    for a, b in reversed(means):
        phi = (phi + jnp.arcsin((a - b) / (a + b) * jnp.sin(phi))) / 2
    sn = jnp.where(m == 1, jnp.tanh(u), jnp.sin(phi))
    cn = jnp.where(m == 1, 1 / jnp.cosh(u), jnp.cos(phi))
    return sn, cn, jnp.sqrt((1 - m) + m * cn**2)
