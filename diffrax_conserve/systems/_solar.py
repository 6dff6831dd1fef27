"""The outer solar system: the Sun and its five outer bodies."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, real

Vectors = Float[Array, "bodies 3"]
State = tuple[Vectors, Vectors]
States = tuple[Float[Array, "times bodies 3"], Float[Array, "times bodies 3"]]

_BODIES = ("Sun", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")

# Relative to the Sun; the mass of the Sun includes the four inner planets.
_MASSES = (
    1.00000597682,
    0.000954786104043,
    0.000285583733151,
    0.0000437273164546,
    0.0000517759138449,
    1 / 1.3e8,
)

# Heliocentric, at 0h00 on September 5, 1994, in AU.
_POSITIONS = (
    (0.0, 0.0, 0.0),
    (-3.5023653, -3.8169847, -1.5507963),
    (9.0755314, -3.0458353, -1.6483708),
    (8.3101420, -16.2901086, -7.2521278),
    (11.4707666, -25.7294829, -10.8169456),
    (-15.5387357, -25.2225594, -3.1902382),
)

# In AU per day.
_VELOCITIES = (
    (0.0, 0.0, 0.0),
    (0.00565429, -0.00412490, -0.00190589),
    (0.00168318, 0.00483525, 0.00192462),
    (0.00354178, 0.00137102, 0.00055029),
    (0.00288930, 0.00114527, 0.00039677),
    (0.00276725, -0.00170702, -0.00136504),
)

# The inverse mean motion of Jupiter, in days, which makes the weights of positions and velocities
# in the metric comparable.
_TIME_SCALE = 4332.6 / 6.283185307179586


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

    A Euclidean projection on the energy alone does not conserve the linear momentum: the gradient
    of the energy is $m_i v_i$, and $\sum m_i (m_i v_i) \ne 0$. In the mass metric (`metric`) the
    correction of $v_i$ is proportional to $v_i$, and $\sum m_i v_i = 0$ in the barycentric frame,
    so the default state is barycentric.

    **Reference**: numerical. **Samples**: the real state, with a normal deviate of 1 % of each
    body's heliocentric distance or speed added to each component of its position or velocity, then
    converted to barycentric coordinates.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", I.2.4, Table 2.2, with
    data from "Ahnerts Kalender für Sternfreunde 1994" for September 5, 1994.
    """

    masses: Float[Array, " bodies"] = eqx.field(converter=real, default=_MASSES)
    gravity: Float[Array, ""] = eqx.field(converter=real, default=2.95912208286e-4)

    name = "outer-solar-system"
    title = "Outer solar system"
    citation = "E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration, I.2.4."
    t1 = 200_000.0
    dt = 100.0
    axes = ("x [AU]", "y [AU]", "z [AU]")
    tolerances = (1e-15, 1e-18)  # the velocities are of size 1e-3

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        q, v = y
        system = self.like(y)
        separation = q[:, None] - q[None]
        pull = system.masses[None, :] / _distances(separation) ** 3
        return v, -system.gravity * jnp.sum(pull[:, :, None] * separation, axis=1)

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, v = y
        system = self.like(y)
        inverse = 1 / _distances(q[:, None] - q[None]) - jnp.eye(q.shape[0], dtype=q.dtype)
        pairs = jnp.sum(system.masses[:, None] * system.masses[None, :] * inverse) / 2
        return jnp.sum(system.masses[:, None] * v**2) / 2 - system.gravity * pairs

    def linear_momentum(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, "3"]:
        del t, args
        return jnp.sum(self.like(y).masses[:, None] * y[1], axis=0)

    def angular_momentum(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, "3"]:
        del t, args
        q, v = y
        return jnp.sum(self.like(y).masses[:, None] * jnp.cross(q, v), axis=0)

    def centre_of_mass(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, "3"]:
        r"""$\sum m_i (q_i - t v_i) / \sum m_i$, the centre of mass at time 0."""
        del args
        q, v = y
        masses = self.like(y).masses
        return jnp.sum(masses[:, None] * (q - t * v), axis=0) / jnp.sum(masses)

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {
            "energy": FirstIntegral(self.energy),
            "linear momentum": FirstIntegral(self.linear_momentum),
            "angular momentum": FirstIntegral(self.angular_momentum),
        }

    @property
    def metric(self) -> State:
        r"""$m_i$ for velocities and $m_i / \tau^2$ for positions, $\tau$ = 690 days."""
        weights = jnp.broadcast_to(self.masses[:, None], (self.masses.size, 3))
        return weights / _TIME_SCALE**2, weights

    @property
    def y0(self) -> State:
        return self.barycentric((jnp.array(_POSITIONS), jnp.array(_VELOCITIES)))

    def barycentric(self, y: State) -> State:
        """The state `y` relative to the centre of mass, which is then at rest at the origin."""
        q, v = y
        weights = self.like(y).masses[:, None]
        weights = weights / jnp.sum(weights)
        centre = jnp.sum(weights * q, axis=0, keepdims=True)
        velocity = jnp.sum(weights * v, axis=0, keepdims=True)
        return q - centre, v - velocity

    def sample(self, key: PRNGKeyArray) -> State:
        def perturbed(key: PRNGKeyArray, x: Vectors) -> Vectors:
            size = jnp.linalg.norm(x, axis=1, keepdims=True)
            return x + 0.01 * size * jr.normal(key, x.shape)

        q_key, v_key = jr.split(key)
        q, v = jnp.array(_POSITIONS), jnp.array(_VELOCITIES)
        return self.barycentric((perturbed(q_key, q), perturbed(v_key, v)))

    def trajectories(self, ys: States) -> dict[str, Float[Array, "times 3"]]:
        return {name: ys[0][:, i] for i, name in enumerate(_BODIES)}


OuterSolarSystem.__init__.__doc__ = r"""**Arguments:**

- `masses`: the masses of the six bodies, the Sun first, in solar masses.
- `gravity`: the gravitational constant $G$, in AU³ per day² and solar mass.
"""


def _distances(separation: Float[Array, "bodies bodies 3"]) -> Float[Array, "bodies bodies"]:
    """Distances between bodies, with ones on the diagonal."""
    own = jnp.eye(separation.shape[0], dtype=separation.dtype)
    return jnp.sqrt(jnp.sum(separation**2, axis=2) + own)
