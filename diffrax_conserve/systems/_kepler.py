"""Kepler's problem: one body about a fixed centre."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractSystem, Reduced, real

Pair = Float[Array, "2"]
State = tuple[Pair, Pair]
States = tuple[Float[Array, "times 2"], Float[Array, "times 2"]]


@final
class Kepler(AbstractSystem):
    r"""Kepler's problem in its plane, `y = (q, p)` of shapes `(2,)` and `(2,)`.

    $$q' = p, \qquad p' = -\mu\, q / |q|^3.$$

    **Manifold**: energy $H = \tfrac12 |p|^2 - \mu / |q|$ and angular momentum
    $L = q_1 p_2 - q_2 p_1$. The Laplace-Runge-Lenz vector `laplace_runge_lenz`, of length
    $\mu e$, is conserved too. It is not in the manifold, because $|A|^2 = \mu^2 + 2 H L^2$ makes it
    redundant: any three of $H$, $L$, $A_1$ and $A_2$ determine the fourth, and three of them leave
    only the position on the ellipse free. On a circular orbit $H$ and $L$ are dependent.
    **Reference**: exact, by Kepler's equation; bound orbits only ($H < 0$). **Samples**: ellipses
    of semi-major axis in $[\tfrac12, \tfrac32]$ and eccentricity in $[0, 0.8]$, with any
    orientation, direction of motion and eccentric anomaly, all uniform.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", I.2.2. The default state
    is the perihelion of the ellipse with semi-major axis 1 and eccentricity 0.6.
    """

    mu: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    name = "kepler"
    title = "Kepler's problem"
    citation = "E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration, I.2.2."
    t1 = 20.0
    dt = 0.2
    axes = ("q₁", "q₂")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        q, p = y
        return p, -self.like(y).mu * q / jnp.sum(q**2) ** 1.5

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        return jnp.sum(p**2) / 2 - self.like(y).mu / jnp.sqrt(jnp.sum(q**2))

    def angular_momentum(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        return q[0] * p[1] - q[1] * p[0]

    def laplace_runge_lenz(self, t: RealScalarLike, y: State, args: Args) -> Pair:
        r"""$A = p \times L - \mu\, q / |q|$, which points to the perihelion."""
        q, p = y
        l = self.angular_momentum(t, y, args)
        rotated = jnp.stack([p[1], -p[0]])
        return l * rotated - self.like(y).mu * q / jnp.sqrt(jnp.sum(q**2))

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {
            "energy": FirstIntegral(self.energy),
            "angular momentum": FirstIntegral(self.angular_momentum),
        }

    @property
    def y0(self) -> State:
        return jnp.array([0.4, 0.0]), jnp.array([0.0, 2.0])

    def sample(self, key: PRNGKeyArray) -> State:
        a_key, e_key, key = jr.split(key, 3)
        sense_key, orientation_key, anomaly_key = jr.split(key, 3)
        a = jr.uniform(a_key, minval=0.5, maxval=1.5)
        e = jr.uniform(e_key, maxval=0.8)
        b = a * jnp.sqrt(1 - e**2) * jr.rademacher(sense_key, dtype=a.dtype)
        angle, anomaly = jr.uniform(orientation_key), jr.uniform(anomaly_key)
        c, s = jnp.cos(2 * jnp.pi * anomaly), jnp.sin(2 * jnp.pi * anomaly)
        q = jnp.stack([a * (c - e), b * s])
        p = jnp.stack([-a * s, b * c]) * jnp.sqrt(self.mu / a**3) / (1 - e * c)
        return _turn(q, 2 * jnp.pi * angle), _turn(p, 2 * jnp.pi * angle)

    def solution(self, ts: Float[Array, " times"], y0: State) -> States:
        r"""By Lagrange's coefficients: $q(t) = f q_0 + g p_0$, and the derivative of this."""
        q, p = y0
        r0 = jnp.sqrt(jnp.sum(q**2))
        a, n = self._semi_major_axis(y0), 2 * jnp.pi / self.period(y0)
        e_cos, e_sin = 1 - r0 / a, jnp.sum(q * p) / jnp.sqrt(self.mu * a)
        e, anomaly0 = jnp.hypot(e_cos, e_sin), jnp.arctan2(e_sin, e_cos)
        anomaly = _eccentric_anomaly(anomaly0 - e_sin + n * ts, e)
        c, s = jnp.cos(anomaly - anomaly0), jnp.sin(anomaly - anomaly0)
        r = a * (1 - e * jnp.cos(anomaly))
        f = 1 - (1 - c) * a / r0
        g = (s * r0 / a + e_sin * (1 - c)) / n
        f_rate = -s * n * a**2 / (r * r0)
        g_rate = 1 - (1 - c) * a / r
        return jnp.outer(f, q) + jnp.outer(g, p), jnp.outer(f_rate, q) + jnp.outer(g_rate, p)

    def frame(self, y: State) -> Reduced:
        r"""The frame of an orbit, for a [`diffrax_conserve.DeepONet`][].

        The flow commutes with rotations, reflections, and changes of scale by $c$ together with
        those of time by $c^{3/2}$. What is left of four numbers are two, which tell the shape of
        the orbit and the place on it: $r |p|^2 / \mu - 1 = e \cos E$ and
        $q \cdot p / \sqrt{\mu r}$, with $r = |q|$, the eccentricity $e$ and the eccentric anomaly
        $E$. The third input is $e^2$, so that a domain that is a box ends with the eccentricity.
        The basis stretches position and velocity along each other, as Lagrange's coefficients do;
        it degenerates where the orbit becomes a line ($e \to 1$). The clock is
        $\nu = \sqrt{\mu / r^3}$, the rate of a circular orbit through the same place: in its time a
        passage of the perihelion is no faster than the rest.
        """
        q, p = y
        mu, r = self.like(y).mu, jnp.sqrt(jnp.sum(q**2))
        nu = jnp.sqrt(mu / r**3)
        e_cos, radial = r * jnp.sum(p**2) / mu - 1, jnp.sum(q * p) / (nu * r**2)
        # $1 - r / a = e \cos E$, and the second input is $e \sin E / \sqrt{1 - e \cos E}$.
        e2 = e_cos**2 + (1 - e_cos) * radial**2
        still = jnp.zeros_like(q)
        columns = [(q, still), (p / nu, still), (still, nu * q), (still, p)]
        basis = jnp.stack([jnp.concatenate(column) for column in columns], axis=1)
        return Reduced(jnp.stack([e_cos, radial, e2]), basis, nu)

    def period(self, y0: State | None = None) -> Float[Array, ""]:
        a = self._semi_major_axis(self.y0 if y0 is None else y0)
        return 2 * jnp.pi * jnp.sqrt(a**3 / self.mu)

    def _semi_major_axis(self, y: State) -> Float[Array, ""]:
        energy = self.energy(0.0, y, None)
        energy = eqx.error_if(
            energy,
            energy >= 0,
            "The exact solution of `Kepler` is for bound orbits, but the energy of `y0` is not "
            "negative. Integrate this orbit with `diffrax.diffeqsolve` instead.",
        )
        return -self.mu / (2 * energy)


Kepler.__init__.__doc__ = r"""**Arguments:**

- `mu`: the strength $\mu$ of the attraction.
"""


def _turn(x: Pair, angle: Float[Array, ""]) -> Pair:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])


def _eccentric_anomaly(
    mean_anomaly: Float[Array, " times"], e: Float[Array, ""]
) -> Float[Array, " times"]:
    r"""Solves Kepler's equation $E - e \sin E = M$, modulo $2\pi$.

    Newton's iteration from the starting value of J. M. A. Danby, "Fundamentals of Celestial
    Mechanics" (1988). It converges in far fewer than 12 iterations unless $e$ is very close to 1.
    """
    m = mean_anomaly - 2 * jnp.pi * jnp.round(mean_anomaly / (2 * jnp.pi))

    def newton(_: Any, x: Float[Array, " times"]) -> Float[Array, " times"]:
        return x - (x - e * jnp.sin(x) - m) / (1 - e * jnp.cos(x))

    return jax.lax.fori_loop(0, 12, newton, m + 0.85 * e * jnp.sign(m))
