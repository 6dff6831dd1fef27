"""The harmonic oscillator."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractSystem, annulus, real

State = Float[Array, "2"]


@final
class HarmonicOscillator(AbstractSystem):
    r"""A unit mass on a spring, `y = [q, p]` of shape `(2,)`.

    $$q' = p, \qquad p' = -\omega^2 q, \qquad H = \tfrac12 (p^2 + \omega^2 q^2).$$

    **Manifold**: energy. **Reference**: exact. **Samples**: uniform in area on the annulus
    $\tfrac12 \le |y| \le \tfrac32$.

    Source: Cardoso-Bihlo and Bihlo, arXiv:2311.14131, whose initial state and time span are the
    defaults.
    """

    omega: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    name = "harmonic-oscillator"
    title = "Harmonic oscillator"
    citation = "E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131 (2023)."
    t1 = 30.0
    dt = 0.25
    axes = ("q", "p")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        q, p = y
        return jnp.stack([p, -(self.like(y).omega ** 2) * q])

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        return (p**2 + (self.like(y).omega * q) ** 2) / 2

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {"energy": FirstIntegral(self.energy)}

    @property
    def y0(self) -> State:
        return jnp.array([1.0, 1.0])

    def sample(self, key: PRNGKeyArray) -> State:
        return annulus(key, inner=0.5, outer=1.5)

    def solution(self, ts: Float[Array, " times"], y0: State) -> Float[Array, "times 2"]:
        q, p = y0
        c, s = jnp.cos(self.omega * ts), jnp.sin(self.omega * ts)
        return jnp.stack([c * q + s * p / self.omega, c * p - s * self.omega * q], axis=-1)

    def period(self, y0: State | None = None) -> Float[Array, ""]:
        del y0
        return 2 * jnp.pi / self.omega


HarmonicOscillator.__init__.__doc__ = r"""**Arguments:**

- `omega`: the angular frequency $\omega$.
"""
