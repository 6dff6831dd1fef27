"""The predator-prey model of Lotka and Volterra."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from ._base import HAIRER, AbstractIntegratedSystem, real

State = Float[Array, "2"]


@final
class LotkaVolterra(AbstractIntegratedSystem):
    r"""Predators $u$ and prey $v$, `y = [u, v]` of shape `(2,)`, both positive.

    $$u' = u (\beta v - \alpha), \qquad v' = v (\gamma - \delta u),$$

    $$I = \gamma \log u - \delta u + \alpha \log v - \beta v.$$

    **Manifold**: the first integral $I$, which is NaN outside the positive quadrant. It is
    stationary at the equilibrium $(\gamma / \delta, \alpha / \beta)$. **Reference**: numerical.
    **Samples**: uniform on $[\tfrac12, 4]^2$.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", I.1.1, whose
    coefficients are the defaults.
    """

    alpha: Float[Array, ""] = eqx.field(converter=real, default=2.0)
    beta: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    gamma: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    delta: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    name = "lotka-volterra"
    title = "Lotka-Volterra model"
    citation = f"{HAIRER}, I.1.1."
    t1 = 50.0
    dt = 0.2
    axes = ("predators", "prey")
    integrals = ("first_integral",)

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        s = self.like(y)
        u, v = y
        return jnp.stack([u * (s.beta * v - s.alpha), v * (s.gamma - s.delta * u)])

    def first_integral(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        s = self.like(y)
        u, v = y
        return s.gamma * jnp.log(u) - s.delta * u + s.alpha * jnp.log(v) - s.beta * v

    @property
    def y0(self) -> State:
        return jnp.array([2.0, 2.0])

    def sample(self, key: PRNGKeyArray) -> State:
        return jr.uniform(key, (2,), minval=0.5, maxval=4.0)


LotkaVolterra.__init__.__doc__ = r"""**Arguments:**

- `alpha`, `beta`: death rate of the predators, and their growth rate per prey.
- `gamma`, `delta`: birth rate of the prey, and their loss rate per predator.
"""
