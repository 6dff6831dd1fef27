"""Hénon and Heiles' model of a star in a galaxy."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, annulus, real

Pair = Float[Array, "2"]
State = tuple[Pair, Pair]


@final
class HenonHeiles(AbstractIntegratedSystem):
    r"""The Hénon-Heiles system, `y = (q, p)` of shapes `(2,)` and `(2,)`.

    $$H = \tfrac12 (|p|^2 + |q|^2) + \lambda \bigl(q_1^2 q_2 - \tfrac13 q_2^3\bigr), \qquad
    q' = p, \quad p' = -\partial H / \partial q.$$

    The motion is bounded below the escape energy $1 / (6 \lambda^2)$ and becomes chaotic as the
    energy approaches it; the default state, of energy close to $\tfrac{1}{12}$, moves almost
    regularly.

    **Manifold**: energy. **Reference**: numerical. **Samples**: uniform in area on the discs
    $|q| \le 0.3$ and $|p| \le 0.4$, where $H < \tfrac16$ for $\lambda = 1$.

    Source: M. Hénon and C. Heiles, "The applicability of the third integral of motion: some
    numerical experiments", Astron. J. 69 (1964).
    """

    coupling: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    name = "henon-heiles"
    title = "Hénon-Heiles system"
    citation = "M. Hénon and C. Heiles, Astron. J. 69 (1964)."
    t1 = 100.0
    dt = 0.25
    axes = ("q₁", "q₂")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        (q1, q2), p = y
        coupling = self.like(y).coupling
        force1 = -q1 - 2 * coupling * q1 * q2
        force2 = -q2 - coupling * (q1**2 - q2**2)
        return p, jnp.stack([force1, force2])

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        cubic = q[0] ** 2 * q[1] - q[1] ** 3 / 3
        return jnp.sum(p**2 + q**2) / 2 + self.like(y).coupling * cubic

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {"energy": FirstIntegral(self.energy)}

    @property
    def y0(self) -> State:
        return jnp.array([0.0, 0.2]), jnp.array([0.35, 0.1])

    def sample(self, key: PRNGKeyArray) -> State:
        q_key, p_key = jr.split(key)
        return annulus(q_key, inner=0.0, outer=0.3), annulus(p_key, inner=0.0, outer=0.4)


HenonHeiles.__init__.__doc__ = r"""**Arguments:**

- `coupling`: the strength $\lambda$ of the cubic terms.
"""
