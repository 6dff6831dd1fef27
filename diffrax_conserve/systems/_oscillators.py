"""What oscillates: a spring, predators and prey, a star in a galaxy, particles on a ring."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from ._base import HAIRER, PAPER, AbstractIntegratedSystem, AbstractSystem, Curves, annulus, real

Pair = Float[Array, "2"]


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
    citation = f"{PAPER}."
    t1 = 30.0
    dt = 0.25
    axes = ("q", "p")
    integrals = ("energy",)

    def vector_field(self, t: RealScalarLike, y: Pair, args: Args) -> Pair:
        del t, args
        q, p = y
        return jnp.stack([p, -(self.like(y).omega ** 2) * q])

    def energy(self, t: RealScalarLike, y: Pair, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        return (p**2 + (self.like(y).omega * q) ** 2) / 2

    @property
    def y0(self) -> Pair:
        return jnp.array([1.0, 1.0])

    def sample(self, key: PRNGKeyArray) -> Pair:
        return annulus(key, inner=0.5, outer=1.5)

    def solution(self, ts: Float[Array, " times"], y0: Pair) -> Float[Array, "times 2"]:
        q, p = y0
        c, s = jnp.cos(self.omega * ts), jnp.sin(self.omega * ts)
        return jnp.stack([c * q + s * p / self.omega, c * p - s * self.omega * q], axis=-1)

    def period(self, y0: Pair | None = None) -> Float[Array, ""]:
        del y0
        return 2 * jnp.pi / self.omega


HarmonicOscillator.__init__.__doc__ = "**Arguments:**\n\n- `omega`: the angular frequency."


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

    def vector_field(self, t: RealScalarLike, y: Pair, args: Args) -> Pair:
        del t, args
        s = self.like(y)
        u, v = y
        return jnp.stack([u * (s.beta * v - s.alpha), v * (s.gamma - s.delta * u)])

    def first_integral(self, t: RealScalarLike, y: Pair, args: Args) -> Float[Array, ""]:
        del t, args
        s = self.like(y)
        u, v = y
        return s.gamma * jnp.log(u) - s.delta * u + s.alpha * jnp.log(v) - s.beta * v

    @property
    def y0(self) -> Pair:
        return jnp.array([2.0, 2.0])

    def sample(self, key: PRNGKeyArray) -> Pair:
        return jr.uniform(key, (2,), minval=0.5, maxval=4.0)


LotkaVolterra.__init__.__doc__ = r"""**Arguments:**

- `alpha`, `beta`: death rate of the predators, and their growth rate per prey.
- `gamma`, `delta`: birth rate of the prey, and their loss rate per predator.
"""


Planar = tuple[Pair, Pair]


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
    integrals = ("energy",)

    def vector_field(self, t: RealScalarLike, y: Planar, args: Args) -> Planar:
        del t, args
        (q1, q2), p = y
        coupling = self.like(y).coupling
        force1 = -q1 - 2 * coupling * q1 * q2
        force2 = -q2 - coupling * (q1**2 - q2**2)
        return p, jnp.stack([force1, force2])

    def energy(self, t: RealScalarLike, y: Planar, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        cubic = q[0] ** 2 * q[1] - q[1] ** 3 / 3
        return jnp.sum(p**2 + q**2) / 2 + self.like(y).coupling * cubic

    @property
    def y0(self) -> Planar:
        return jnp.array([0.0, 0.2]), jnp.array([0.35, 0.1])

    def sample(self, key: PRNGKeyArray) -> Planar:
        q_key, p_key = jr.split(key)
        return annulus(q_key, inner=0.0, outer=0.3), annulus(p_key, inner=0.0, outer=0.4)


HenonHeiles.__init__.__doc__ = "**Arguments:**\n\n- `coupling`: the strength of the cubic terms."


Vector = Float[Array, " particles"]
Ring = tuple[Vector, Vector]


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
    integrals = ("linear_momentum", "energy", "higher_traces")

    def __check_init__(self):
        if self.particles < 3:
            raise ValueError(
                "`TodaLattice(particles=...)` needs at least 3 particles: with fewer, each has "
                f"only one neighbour on the ring. It was given {self.particles}."
            )

    def vector_field(self, t: RealScalarLike, y: Ring, args: Args) -> Ring:
        del t, args
        q, p = y
        system = self.like(y)
        tension = system.b * system._squared_couplings(q)
        return p, jnp.roll(tension, 1) - tension

    def _squared_couplings(self, q: Vector) -> Vector:
        return self.a / self.b * jnp.exp(self.b * (q - jnp.roll(q, -1)))

    def linear_momentum(self, t: RealScalarLike, y: Ring, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(y[1])

    def energy(self, t: RealScalarLike, y: Ring, args: Args) -> Float[Array, ""]:
        del t, args
        q, p = y
        return jnp.sum(p**2) / 2 + jnp.sum(self.like(y)._squared_couplings(q))

    def higher_traces(self, t: RealScalarLike, y: Ring, args: Args) -> Float[Array, " traces"]:
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
    def y0(self) -> Ring:
        k = jnp.arange(self.particles, dtype=float)
        return jnp.sin(2 * k), jnp.cos(3 * k)

    def sample(self, key: PRNGKeyArray) -> Ring:
        q, p = jr.uniform(key, (2, self.particles), minval=-1.0)
        return q, p

    def trajectories(self, ys: tuple[Float[Array, "times particles"], ...]) -> Curves:
        """Each particle relative to the mean, which moves uniformly."""
        points = jnp.stack(ys, axis=2)
        points = points - jnp.mean(points, axis=1, keepdims=True)
        return {f"particle {i + 1}": points[:, i] for i in range(self.particles)}


TodaLattice.__init__.__doc__ = r"""**Arguments:**

- `a`, `b`: the strength and steepness of the springs.
- `particles`: the number $N \ge 3$ of particles.
"""
