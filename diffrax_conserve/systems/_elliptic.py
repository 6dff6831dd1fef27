r"""Jacobi's elliptic functions and the first elliptic integral, which JAX lacks.

In terms of the parameter $m = k^2$, $0 \le m \le 1$, as in `scipy.special`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

# The arithmetic-geometric mean converges quadratically: ten steps reach roundoff for every m < 1
# of float64.
_AGM_STEPS = 10
# Each step of Carlson's duplication divides the spread of its arguments by four, and the error of
# the final series is of sixth order in that spread.
_DUPLICATIONS = 12


def complete_elliptic(m: Float[Array, "*s"]) -> Float[Array, "*s"]:
    r"""$K(m) = \int_0^{\pi/2} (1 - m \sin^2\theta)^{-1/2} d\theta$."""
    a, b = jnp.ones_like(m), jnp.sqrt(1 - m)
    for _ in range(_AGM_STEPS):
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    return jnp.where(m == 1, jnp.inf, jnp.pi / (2 * a))


def incomplete_elliptic(phi: Float[Array, "*s"], m: Float[Array, "*s"]) -> Float[Array, "*s"]:
    r"""$F(\phi, m) = \int_0^\phi (1 - m \sin^2\theta)^{-1/2} d\theta$.

    Computed as $\sin\phi\, R_F(\cos^2\phi, 1 - m \sin^2\phi, 1)$ (B. C. Carlson, "Numerical
    computation of real or complex elliptic integrals", Numer. Algorithms 10 (1995)), after
    removing integer multiples of $\pi$ from $\phi$.
    """
    turns = jnp.round(phi / jnp.pi)
    s, c = jnp.sin(phi - turns * jnp.pi), jnp.cos(phi - turns * jnp.pi)
    x, y, z = c**2, c**2 + (1 - m) * s**2, jnp.ones_like(c)
    for _ in range(_DUPLICATIONS):
        shift = jnp.sqrt(x * y) + jnp.sqrt(y * z) + jnp.sqrt(z * x)
        x, y, z = (x + shift) / 4, (y + shift) / 4, (z + shift) / 4
    mean = (x + y + z) / 3
    dx, dy = 1 - x / mean, 1 - y / mean
    dz = -dx - dy
    e2, e3 = dx * dy - dz**2, dx * dy * dz
    series = 1 - e2 / 10 + e3 / 14 + e2**2 / 24 - 3 * e2 * e3 / 44
    periods = jnp.where(turns == 0, 0.0, 2 * turns * complete_elliptic(m))
    return s * series / jnp.sqrt(mean) + periods


def jacobi_elliptic(
    u: Float[Array, "*#s"], m: Float[Array, "*#s"]
) -> tuple[Float[Array, "*s"], Float[Array, "*s"], Float[Array, "*s"]]:
    r"""$\mathrm{sn}(u, m)$, $\mathrm{cn}(u, m)$, $\mathrm{dn}(u, m)$.

    Computed by the descending Landen transformation (Abramowitz and Stegun, "Handbook of
    Mathematical Functions", 16.4); at $m = 1$, where it fails, by the hyperbolic functions.
    """
    u, m = jnp.broadcast_arrays(u, m)
    a, b = jnp.ones_like(m), jnp.sqrt(1 - m)
    ratios = []
    for _ in range(_AGM_STEPS):
        a, b, c = (a + b) / 2, jnp.sqrt(a * b), (a - b) / 2
        ratios.append(c / a)
    phi = 2.0**_AGM_STEPS * a * u
    for ratio in reversed(ratios):
        phi = (phi + jnp.arcsin(ratio * jnp.sin(phi))) / 2
    sn = jnp.where(m == 1, jnp.tanh(u), jnp.sin(phi))
    cn = jnp.where(m == 1, 1 / jnp.cosh(u), jnp.cos(phi))
    return sn, cn, jnp.sqrt((1 - m) + m * cn**2)
