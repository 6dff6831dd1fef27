"""The periodic Toda lattice."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, real

Vector = Float[Array, " particles"]
State = tuple[Vector, Vector]


@final
class TodaLattice(AbstractIntegratedSystem):
    r"""$N \ge 3$ particles on a ring with exponential springs, `y = (q, p)` of shapes `(N,)`.

    $$H = \tfrac12 \sum_i p_i^2 + \frac{a}{b} \sum_i e^{b (q_i - q_{i+1})}, \qquad
    q' = p, \quad p' = -\partial H / \partial q, \qquad q_{N+1} = q_1.$$

    The system is integrable. With $d_i = \sqrt{a/b}\, e^{b (q_i - q_{i+1}) / 2}$, the symmetric
    matrix $L$ with $p_i$ on its diagonal and $d_i$ between the neighbours $i$ and $i + 1$ has
    constant eigenvalues, so

    $$I_k = \tfrac1k \operatorname{tr} L^k, \qquad k = 1, \dots, N$$

    are first integrals: $I_1 = \sum p_i$, $I_2 = H$, and Hénon's

    $$I_3 = \tfrac13 \sum_i p_i^3 + \sum_i (p_i + p_{i+1})\, d_i^2 \quad (+\, 2 d_1 d_2 d_3,
    \text{ a constant, for } N = 3).$$

    **Manifold**: linear momentum, energy, and the higher traces $I_3, \dots, I_N$, an array of
    shape `(N - 2,)`. They are dependent at the equilibrium. For many particles the powers make them
    poorly scaled, and momentum and energy alone may be preferable. **Reference**: numerical.
    **Samples**: $q_i$ and $p_i$ uniform on $[-1, 1]$.

    Source: M. Hénon, "Integrals of the Toda lattice", and H. Flaschka, "The Toda lattice. II",
    both Phys. Rev. B 9 (1974); Hairer, Lubich and Wanner, "Geometric Numerical Integration", X.1.5.
    """

    a: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    b: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    particles: int = eqx.field(static=True, default=3, kw_only=True)

    name = "toda-lattice"
    title = "Periodic Toda lattice"
    citation = "M. Hénon, Phys. Rev. B 9 (1974) 1921; H. Flaschka, Phys. Rev. B 9 (1974) 1924."
    t1 = 50.0
    dt = 0.1
    axes = ("q", "p")

    def __check_init__(self):
        if self.particles < 3:
            raise ValueError(
                "`TodaLattice(particles=...)` needs at least 3 particles: with fewer, each has "
                f"only one neighbour on the ring. It was given {self.particles}."
            )

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        q, p = y
        system = self.like(y)
        tension = system.b * system._squared_couplings(q)
        return p, jnp.roll(tension, 1) - tension

    def _squared_couplings(self, q: Vector) -> Vector:
        return self.a / self.b * jnp.exp(self.b * (q - jnp.roll(q, -1)))

    def linear_momentum(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(y[1])

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        return jnp.sum(p**2) / 2 + jnp.sum(self.like(y)._squared_couplings(q))

    def higher_traces(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, " traces"]:
        del t, args
        q, p = y
        off_diagonal = jnp.diag(jnp.sqrt(self.like(y)._squared_couplings(q)))
        shifted = jnp.roll(off_diagonal, 1, axis=1)
        matrix = jnp.diag(p) + shifted + shifted.T
        traces, power = [], matrix
        for k in range(2, self.particles + 1):
            # Without "highest" an accelerator multiplies in reduced precision.
            power = jnp.matmul(power, matrix, precision="highest")
            traces.append(jnp.trace(power) / k)
        return jnp.stack(traces[1:])

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {
            "linear momentum": FirstIntegral(self.linear_momentum),
            "energy": FirstIntegral(self.energy),
            "higher traces": FirstIntegral(self.higher_traces),
        }

    @property
    def y0(self) -> State:
        k = jnp.arange(self.particles, dtype=float)
        return jnp.sin(2 * k), jnp.cos(3 * k)

    def sample(self, key: PRNGKeyArray) -> State:
        q, p = jr.uniform(key, (2, self.particles), minval=-1.0)
        return q, p

    def trajectories(
        self, ys: tuple[Float[Array, "times particles"], Float[Array, "times particles"]]
    ) -> dict[str, Float[Array, "times 2"]]:
        """Each particle relative to the mean, which moves uniformly."""
        q, p = (x - jnp.mean(x, axis=1, keepdims=True) for x in ys)
        return {
            f"particle {i + 1}": jnp.stack([q[:, i], p[:, i]], axis=1)
            for i in range(self.particles)
        }


TodaLattice.__init__.__doc__ = r"""**Arguments:**

- `a`, `b`: the strength and steepness of the springs.
- `particles`: the number $N \ge 3$ of particles.
"""
