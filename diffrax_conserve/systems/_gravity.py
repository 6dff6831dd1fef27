"""Bodies that attract each other: Kepler's problem and the outer solar system."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from ._base import HAIRER, AbstractIntegratedSystem, AbstractSystem, Curves, Reduced, real

Pair = Float[Array, "2"]
State = tuple[Pair, Pair]
States = tuple[Float[Array, "times 2"], Float[Array, "times 2"]]


@final
class Kepler(AbstractSystem):
    r"""Kepler's problem in its plane, `y = (q, p)` of shapes `(2,)` and `(2,)`.

    $$q' = p, \qquad p' = -\mu\, q / |q|^3.$$

    **Manifold**: energy $H = \tfrac12 |p|^2 - \mu / |q|$ and angular momentum
    $L = q_1 p_2 - q_2 p_1$, which are dependent on a circular orbit. The Laplace-Runge-Lenz vector
    `laplace_runge_lenz`, of length $\mu e$, is conserved too, but redundant: $|A|^2 = \mu^2 + 2 H
    L^2$. **Reference**: exact, by Kepler's equation; bound orbits only ($H < 0$). **Samples**:
    ellipses of semi-major axis in $[\tfrac12, \tfrac32]$ and eccentricity in $[0, 0.8]$, with any
    orientation, direction of motion and eccentric anomaly, all uniform.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", I.2.2. The default state
    is the perihelion of the ellipse with semi-major axis 1 and eccentricity 0.6.
    """

    mu: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    name = "kepler"
    title = "Kepler's problem"
    citation = f"{HAIRER}, I.2.2."
    t1 = 20.0
    dt = 0.2
    axes = ("q₁", "q₂")
    integrals = ("energy", "angular_momentum")

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
        The basis stretches position and velocity along each other, and degenerates where the orbit
        becomes a line ($e \to 1$). The clock is $\nu = \sqrt{\mu / r^3}$, the rate of a circular
        orbit through the same place: in its time a perihelion passes no faster than the rest.
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


Kepler.__init__.__doc__ = "**Arguments:**\n\n- `mu`: the strength $\\mu$ of the attraction."


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


Vectors = Float[Array, "bodies 3"]
Bodies = tuple[Vectors, Vectors]

# Relative to the Sun; the mass of the Sun includes the four inner planets.
_MASSES = {
    "Sun": 1.00000597682,
    "Jupiter": 0.000954786104043,
    "Saturn": 0.000285583733151,
    "Uranus": 0.0000437273164546,
    "Neptune": 0.0000517759138449,
    "Pluto": 1 / 1.3e8,
}
# Heliocentric positions in AU and velocities in AU per day, at 0h00 on September 5, 1994.
_STATES = (
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((-3.5023653, -3.8169847, -1.5507963), (0.00565429, -0.00412490, -0.00190589)),
    ((9.0755314, -3.0458353, -1.6483708), (0.00168318, 0.00483525, 0.00192462)),
    ((8.3101420, -16.2901086, -7.2521278), (0.00354178, 0.00137102, 0.00055029)),
    ((11.4707666, -25.7294829, -10.8169456), (0.00288930, 0.00114527, 0.00039677)),
    ((-15.5387357, -25.2225594, -3.1902382), (0.00276725, -0.00170702, -0.00136504)),
)


@final
class OuterSolarSystem(AbstractIntegratedSystem):
    r"""Newton's equations of the Sun, Jupiter, Saturn, Uranus, Neptune and Pluto.

    The state `y = (q, v)` consists of positions and velocities, each of shape `(6, 3)`, in
    astronomical units and days, with masses in solar masses:

    $$q_i' = v_i, \qquad v_i' = -G \sum_{j \ne i} m_j \frac{q_i - q_j}{|q_i - q_j|^3}.$$

    **Manifold**: energy $\tfrac12 \sum m_i |v_i|^2 - G \sum_{i<j} m_i m_j / |q_i - q_j|$, linear
    momentum $\sum m_i v_i$ and angular momentum $\sum m_i q_i \times v_i$. `centre_of_mass` is a
    first integral that depends on time; it is not in the manifold because every Runge-Kutta method
    conserves it.

    A projection on the energy alone corrects $v_i$ by multiples of $m_i v_i$, which changes the
    linear momentum. In the mass metric (`metric`) it does so by multiples of $v_i$, and
    $\sum m_i v_i = 0$ in the barycentric frame of the default state.

    **Reference**: numerical. **Samples**: the real state, with normal deviates of 1 % of each
    body's heliocentric distance or speed, in barycentric coordinates.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", I.2.4, Table 2.2, with
    data from "Ahnerts Kalender für Sternfreunde 1994" for September 5, 1994.
    """

    masses: Float[Array, " bodies"] = eqx.field(converter=real, default=tuple(_MASSES.values()))
    gravity: Float[Array, ""] = eqx.field(converter=real, default=2.95912208286e-4)

    name = "outer-solar-system"
    title = "Outer solar system"
    citation = f"{HAIRER}, I.2.4."
    t1 = 200_000.0
    dt = 100.0
    axes = ("x [AU]", "y [AU]", "z [AU]")
    integrals = ("energy", "linear_momentum", "angular_momentum")
    tolerances = (1e-15, 1e-18)  # the velocities are of size 1e-3

    def vector_field(self, t: RealScalarLike, y: Bodies, args: Args) -> Bodies:
        del t, args
        q, v = y
        system = self.like(y)
        separation = q[:, None] - q[None]
        pull = system.masses[None, :] / _distances(separation) ** 3
        return v, -system.gravity * jnp.sum(pull[:, :, None] * separation, axis=1)

    def energy(self, t: RealScalarLike, y: Bodies, args: Args) -> Float[Array, ""]:
        del t, args
        q, v = y
        system = self.like(y)
        # Each pair once: a subtracted diagonal would count as a term that cancels.
        inverse = jnp.triu(1 / _distances(q[:, None] - q[None]), 1)
        pairs = jnp.sum(system.masses[:, None] * system.masses[None, :] * inverse)
        return jnp.sum(system.masses[:, None] * v**2) / 2 - system.gravity * pairs

    def linear_momentum(self, t: RealScalarLike, y: Bodies, args: Args) -> Float[Array, "3"]:
        del t, args
        return jnp.sum(self.like(y).masses[:, None] * y[1], axis=0)

    def angular_momentum(self, t: RealScalarLike, y: Bodies, args: Args) -> Float[Array, "3"]:
        del t, args
        q, v = y
        return jnp.sum(self.like(y).masses[:, None] * jnp.cross(q, v), axis=0)

    def centre_of_mass(self, t: RealScalarLike, y: Bodies, args: Args) -> Float[Array, "3"]:
        r"""$\sum m_i (q_i - t v_i) / \sum m_i$, the centre of mass at time 0."""
        del args
        q, v = y
        masses = self.like(y).masses
        return jnp.sum(masses[:, None] * (q - t * v), axis=0) / jnp.sum(masses)

    @property
    def metric(self) -> Bodies:
        r"""$m_i$ for velocities and $m_i / \tau^2$ for positions, where $\tau$ is the inverse mean
        motion of Jupiter, 690 days."""
        weights = jnp.broadcast_to(self.masses[:, None], (self.masses.size, 3))
        return weights / (4332.6 / (2 * jnp.pi)) ** 2, weights

    @property
    def y0(self) -> Bodies:
        q, v = jnp.moveaxis(jnp.array(_STATES), 1, 0)
        return self.barycentric((q, v))

    def barycentric(self, y: Bodies) -> Bodies:
        """The state `y` relative to the centre of mass, which is then at rest at the origin."""
        q, v = y
        weights = self.like(y).masses[:, None]
        weights = weights / jnp.sum(weights)
        centre = jnp.sum(weights * q, axis=0, keepdims=True)
        velocity = jnp.sum(weights * v, axis=0, keepdims=True)
        return q - centre, v - velocity

    def sample(self, key: PRNGKeyArray) -> Bodies:
        def perturbed(key: PRNGKeyArray, x: Vectors) -> Vectors:
            size = jnp.linalg.norm(x, axis=1, keepdims=True)
            return x + 0.01 * size * jr.normal(key, x.shape)

        q, v = jax.vmap(perturbed, in_axes=(0, 1))(jr.split(key), jnp.array(_STATES))
        return self.barycentric((q, v))

    def trajectories(self, ys: tuple[Float[Array, "times bodies 3"], ...]) -> Curves:
        return {name: ys[0][:, i] for i, name in enumerate(_MASSES)}


OuterSolarSystem.__init__.__doc__ = r"""**Arguments:**

- `masses`: the masses of the six bodies, the Sun first, in solar masses.
- `gravity`: the gravitational constant $G$, in AU³ per day² and solar mass.
"""


def _distances(separation: Float[Array, "bodies bodies 3"]) -> Float[Array, "bodies bodies"]:
    """Distances between bodies, with ones on the diagonal."""
    own = jnp.eye(separation.shape[0], dtype=separation.dtype)
    return jnp.sqrt(jnp.sum(separation**2, axis=2) + own)
