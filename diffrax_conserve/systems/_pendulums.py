"""The pendulum with its constraints, and the double pendulum in angles and momenta."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import HAIRER, PAPER, AbstractIntegratedSystem, AbstractSystem, real
from ._elliptic import complete_elliptic, incomplete_elliptic, jacobi_elliptic

Pair = Float[Array, "2"]
State = tuple[Pair, Pair]
States = tuple[Float[Array, "times 2"], Float[Array, "times 2"]]


@final
class CartesianPendulum(AbstractSystem):
    r"""A unit mass on a rod, `y = (q, v)` of shapes `(2,)` and `(2,)`, gravity along $-q_2$.

    $$q' = v, \qquad v' = -g e_2 - \lambda q, \qquad |q|^2 = l^2.$$

    This is a differential-algebraic equation of index 3. Differentiating its position constraint
    once gives the hidden velocity constraint $q \cdot v = 0$, and once more the multiplier
    $\lambda = (|v|^2 - g q_2) / |q|^2$. With this $\lambda$ it is an ordinary differential equation
    that conserves both constraints, but a numerical solution drifts away from them.

    **Manifold**: rod length and velocity constraint (both constraints), energy
    $\tfrac12 |v|^2 + g q_2$ (conserved where the constraints hold). **Reference**: exact, by
    Jacobi's elliptic functions; it loses accuracy at the separatrix, where the mass just reaches
    the upper equilibrium. **Samples**: any angle, with $l |\theta'| \le 3$ uniform, so both swings
    and full turns.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", IV.4 and VII.1; Landau and
    Lifshitz, "Mechanics", §11 for the solution.
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    gravity: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    name = "cartesian-pendulum"
    title = "Pendulum in Cartesian coordinates"
    citation = f"{HAIRER}, IV.4, VII.1."
    t1 = 30.0
    dt = 0.1
    axes = ("q₁", "q₂")
    integrals = ("energy",)

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        q, v = y
        gravity = self.like(y).gravity
        multiplier = (jnp.sum(v**2) - gravity * q[1]) / jnp.sum(q**2)
        return v, -multiplier * q - jnp.stack([jnp.zeros_like(gravity), gravity])

    def length_constraint(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(y[0] ** 2) - self.like(y).length ** 2

    def velocity_constraint(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, v = y
        return jnp.sum(q * v)

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, v = y
        return jnp.sum(v**2) / 2 + self.like(y).gravity * q[1]

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {
            "rod length": Constraint(self.length_constraint),
            "velocity constraint": Constraint(self.velocity_constraint),
            **super().manifold,
        }

    @property
    def y0(self) -> State:
        """A wide swing, released above the horizontal."""
        return self.length * jnp.array([0.8, 0.6]), jnp.array([0.3, -0.4])

    def sample(self, key: PRNGKeyArray) -> State:
        angle_key, speed_key = jr.split(key)
        angle = jr.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
        speed = jr.uniform(speed_key, minval=-3.0, maxval=3.0)
        s, c = jnp.sin(angle), jnp.cos(angle)
        return self.length * jnp.stack([s, -c]), speed * jnp.stack([c, s])

    def solution(self, ts: Float[Array, " times"], y0: State) -> States:
        swings, modulus, m, u0 = self._elliptic_form(y0)
        frequency = jnp.sqrt(self.gravity / self.length)
        u = frequency * ts * jnp.where(swings, 1.0, modulus) + u0
        sn, cn, dn = jacobi_elliptic(u, m)
        sine = jnp.where(swings, modulus * sn, sn)
        cosine = jnp.where(swings, dn, cn)
        half_rate = jnp.where(swings, modulus * cn, modulus * dn)
        s, c = 2 * sine * cosine, cosine**2 - sine**2
        speed = 2 * frequency * self.length * half_rate
        q = self.length * jnp.stack([s, -c], axis=1)
        return q, speed[:, None] * jnp.stack([c, s], axis=1)

    def period(self, y0: State | None = None) -> Float[Array, ""]:
        """The period of a swing back and forth, or of one full turn."""
        swings, modulus, m, _ = self._elliptic_form(self.y0 if y0 is None else y0)
        quarters = jnp.where(swings, 4.0, 2 / jnp.abs(modulus))
        return quarters * complete_elliptic(m) * jnp.sqrt(self.length / self.gravity)

    def _elliptic_form(self, y0: State) -> tuple[Array, Array, Array, Array]:
        r"""Whether the pendulum swings, the modulus $k$, the parameter $m$ and the phase $u_0$.

        With $\omega^2 = g / l$ and the angle $\theta$ from the lower equilibrium,
        $k^2 = \sin^2(\theta/2) + (\theta' / 2 \omega)^2$. For $k < 1$ it swings:
        $\sin(\theta/2) = k\, sn$, $\cos(\theta/2) = dn$ and $\theta' / 2 \omega = k\, cn$, at
        $\omega t + u_0$ with $m = k^2$. Otherwise it turns: $\sin(\theta/2) = sn$,
        $\cos(\theta/2) = cn$ and $\theta' / 2 \omega = k\, dn$, at $k \omega t + u_0$ with
        $m = 1 / k^2$ and with $k$ given the sign of $\theta'$.
        """
        (q1, q2), (v1, v2) = y0
        half_angle = jnp.arctan2(q1, -q2) / 2
        sine = jnp.sin(half_angle)
        rate = (q1 * v2 - q2 * v1) / self.length**2
        half_rate = rate / (2 * jnp.sqrt(self.gravity / self.length))
        modulus = jnp.hypot(sine, half_rate)
        swings = modulus < 1
        m = jnp.where(swings, modulus**2, 1 / jnp.maximum(modulus, 1.0) ** 2)
        phi = jnp.where(swings, jnp.arctan2(sine, half_rate), half_angle)
        signed = jnp.where(swings, modulus, jnp.copysign(modulus, half_rate))
        return swings, signed, m, incomplete_elliptic(phi, m)


CartesianPendulum.__init__.__doc__ = r"""**Arguments:**

- `length`: the length $l$ of the rod.
- `gravity`: the acceleration $g$.
"""


Phase = Float[Array, "4"]


@final
class DoublePendulum(AbstractIntegratedSystem):
    r"""Two point masses on two massless rods, `y = [θ₁, θ₂, p₁, p₂]` of shape `(4,)`.

    Both angles are measured from the downward vertical, and $\Delta = \theta_1 - \theta_2$. With
    the angular velocities $\theta' = M(\Delta)^{-1} p$, where

    $$M = \begin{pmatrix} (m_1 + m_2) l_1^2 & m_2 l_1 l_2 \cos\Delta \\
    m_2 l_1 l_2 \cos\Delta & m_2 l_2^2 \end{pmatrix},$$

    the momenta obey

    $$p_{1,2}' = \mp m_2 l_1 l_2\, \theta_1' \theta_2' \sin\Delta
    - \partial V / \partial \theta_{1,2}, \qquad
    V = -(m_1 + m_2) g l_1 \cos\theta_1 - m_2 g l_2 \cos\theta_2.$$

    **Manifold**: energy, the Hamiltonian $H = \tfrac12\, p \cdot M^{-1} p + V$. For unit masses
    and lengths,

    $$H = \frac{p_1^2 + 2 p_2^2 - 2 p_1 p_2 \cos\Delta}{2 (1 + \sin^2\Delta)}
    - 2 g \cos\theta_1 - g \cos\theta_2.$$

    **Reference**: numerical. **Samples**: uniform on $[-\pi/6, \pi/6]^4$.

    Source: Cardoso-Bihlo and Bihlo, arXiv:2311.14131, whose parameters, sampling domain and
    time span (20 steps of 0.5) are the defaults; it gives no initial state, so `y0` is our choice.
    Landau and Lifshitz, "Mechanics", §5.
    """

    masses: Pair = eqx.field(converter=real, default=(1.0, 1.0))
    lengths: Pair = eqx.field(converter=real, default=(1.0, 1.0))
    gravity: Float[Array, ""] = eqx.field(converter=real, default=9.81)

    name = "double-pendulum"
    title = "Double pendulum"
    citation = f"{PAPER}; L. D. Landau and E. M. Lifshitz, Mechanics, §5."
    t1 = 10.0
    dt = 0.5
    axes = ("θ₁", "θ₂")
    integrals = ("energy",)

    def vector_field(self, t: RealScalarLike, y: Phase, args: Args) -> Phase:
        del t, args
        theta, p = y[:2], y[2:]
        system = self.like(y)
        m2, (l1, l2) = system.masses[1], system.lengths
        rates = system._angular_velocities(theta, p)
        coupling = m2 * l1 * l2 * rates[0] * rates[1] * jnp.sin(theta[0] - theta[1])
        force = -system._weights() * jnp.sin(theta)
        return jnp.concatenate([rates, force + jnp.stack([-coupling, coupling])])

    def energy(self, t: RealScalarLike, y: Phase, args: Args) -> Float[Array, ""]:
        del t, args
        theta, p = y[:2], y[2:]
        system = self.like(y)
        kinetic = jnp.sum(p * system._angular_velocities(theta, p)) / 2
        return kinetic - jnp.sum(system._weights() * jnp.cos(theta))

    def _angular_velocities(self, theta: Pair, p: Pair) -> Pair:
        m1, m2 = self.masses
        l1, l2 = self.lengths
        p1, p2 = p
        c, s = jnp.cos(theta[0] - theta[1]), jnp.sin(theta[0] - theta[1])
        determinant = m1 + m2 * s**2
        rate1 = (l2 * p1 - l1 * p2 * c) / (l1**2 * l2 * determinant)
        rate2 = ((m1 + m2) * l1 * p2 - m2 * l2 * p1 * c) / (m2 * l1 * l2**2 * determinant)
        return jnp.stack([rate1, rate2])

    def _weights(self) -> Pair:
        """The factors of -cos θ in the potential energy."""
        m1, m2 = self.masses
        return self.gravity * self.lengths * jnp.stack([m1 + m2, m2])

    @property
    def y0(self) -> Phase:
        return jnp.array([0.5, -0.3, 0.2, 0.4])

    def sample(self, key: PRNGKeyArray) -> Phase:
        return jr.uniform(key, (4,), minval=-jnp.pi / 6, maxval=jnp.pi / 6)


DoublePendulum.__init__.__doc__ = r"""**Arguments:**

- `masses`: the masses $(m_1, m_2)$, upper first.
- `lengths`: the lengths $(l_1, l_2)$ of the rods.
- `gravity`: the acceleration $g$.
"""
