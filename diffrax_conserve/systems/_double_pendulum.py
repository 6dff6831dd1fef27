"""The planar double pendulum, in angles and momenta."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, real

State = Float[Array, "4"]
Pair = Float[Array, "2"]


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
    - 2 g \cos\theta_1 - g \cos\theta_2;$$

    the paper lacks a bracket here. **Reference**: numerical. **Samples**: uniform on
    $[-\pi/6, \pi/6]^4$.

    Source: Cardoso-Bihlo and Bihlo, arXiv:2311.14131, whose parameters, sampling domain and
    time span (20 steps of 0.5) are the defaults; it gives no initial state, so `y0` is our choice.
    Landau and Lifshitz, "Mechanics", §5.
    """

    masses: Pair = eqx.field(converter=real, default=(1.0, 1.0))
    lengths: Pair = eqx.field(converter=real, default=(1.0, 1.0))
    gravity: Float[Array, ""] = eqx.field(converter=real, default=9.81)

    name = "double-pendulum"
    title = "Double pendulum"
    citation = (
        "E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131 (2023); "
        "L. D. Landau and E. M. Lifshitz, Mechanics, §5."
    )
    t1 = 10.0
    dt = 0.5
    axes = ("θ₁", "θ₂")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        theta, p = y[:2], y[2:]
        system = self.like(y)
        m2, (l1, l2) = system.masses[1], system.lengths
        rates = system._angular_velocities(theta, p)
        coupling = m2 * l1 * l2 * rates[0] * rates[1] * jnp.sin(theta[0] - theta[1])
        force = -system._weights() * jnp.sin(theta)
        return jnp.concatenate([rates, force + jnp.stack([-coupling, coupling])])

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
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
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {"energy": FirstIntegral(self.energy)}

    @property
    def y0(self) -> State:
        """A state inside the paper's sampling domain; the paper gives no initial state."""
        return jnp.array([0.5, -0.3, 0.2, 0.4])

    def sample(self, key: PRNGKeyArray) -> State:
        return jr.uniform(key, (4,), minval=-jnp.pi / 6, maxval=jnp.pi / 6)


DoublePendulum.__init__.__doc__ = r"""**Arguments:**

- `masses`: the masses $(m_1, m_2)$, upper first.
- `lengths`: the lengths $(l_1, l_2)$ of the rods.
- `gravity`: the acceleration $g$.
"""
