"""Fluids: convection in three numbers, vortices in the plane, waves in shallow water."""

from typing import final

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import PAPER, AbstractIntegratedSystem, Curves, Reduced, annulus, real

State = Float[Array, "3"]


@final
class ConservativeLorenz(AbstractIntegratedSystem):
    r"""The Lorenz-1963 model without dissipation, `y = [x, y, z]` of shape `(3,)`.

    $$x' = \sigma y, \qquad y' = \rho x - x z, \qquad z' = x y.$$

    It is Nambu's equation $y' = \nabla C \times \nabla H$ for the two first integrals

    $$C = \tfrac12 x^2 - \sigma z, \qquad H = \tfrac12 (y^2 + z^2) - \rho z.$$

    **Manifold**: Casimir $C$ and energy $H$. **Reference**: numerical. **Samples**: $(x, y)$
    uniform in area on the annulus of radii $\tfrac12$ and $\tfrac32$, $z$ uniform on
    $[\tfrac12, \tfrac32]$.

    Source: Cardoso-Bihlo and Bihlo, arXiv:2311.14131, whose parameters, sampling domain and
    time span (500 steps of 0.25) are the defaults; E. N. Lorenz, "Deterministic nonperiodic flow",
    J. Atmos. Sci. 20 (1963); P. Névir and R. Blender, "Hamiltonian and Nambu representation of the
    non-dissipative Lorenz equations", Beitr. Phys. Atmosph. 67 (1994).
    """

    sigma: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    rho: Float[Array, ""] = eqx.field(converter=real, default=0.5)

    name = "conservative-lorenz"
    title = "Conservative Lorenz-1963 model"
    citation = (
        f"{PAPER}; E. N. Lorenz, J. Atmos. Sci. 20 (1963); P. Névir and R. Blender, Beitr. Phys. "
        "Atmosph. 67 (1994)."
    )
    t1 = 125.0
    dt = 0.25
    axes = ("x", "y", "z")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        system = self.like(y)
        x1, x2, x3 = y
        return jnp.stack([system.sigma * x2, system.rho * x1 - x1 * x3, x1 * x2])

    def casimir(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return y[0] ** 2 / 2 - self.like(y).sigma * y[2]

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return (y[1] ** 2 + y[2] ** 2) / 2 - self.like(y).rho * y[2]

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {"Casimir": FirstIntegral(self.casimir), "energy": FirstIntegral(self.energy)}

    @property
    def y0(self) -> State:
        return jnp.array([0.9, 0.3, 1.2])

    def sample(self, key: PRNGKeyArray) -> State:
        plane_key, z_key = jr.split(key)
        z = jr.uniform(z_key, (1,), minval=0.5, maxval=1.5)
        return jnp.concatenate([annulus(plane_key, inner=0.5, outer=1.5), z])


ConservativeLorenz.__init__.__doc__ = r"""**Arguments:**

- `sigma`, `rho`: the Prandtl number $\sigma$ and the reduced Rayleigh number $\rho$.
"""


Places = Float[Array, "vortices 2"]
Pairs = Float[Array, "vortices vortices"]


@final
class PointVortices(AbstractIntegratedSystem):
    r"""$N$ point vortices of strengths $\Gamma_i$, `y` of shape `(N, 2)`: rows $(x_i, y_i)$.

    $$\Gamma_i x_i' = \frac{\partial H}{\partial y_i}, \qquad
    \Gamma_i y_i' = -\frac{\partial H}{\partial x_i}, \qquad
    H = -\frac{1}{4\pi} \sum_{i=1}^N \sum_{j \ne i} \Gamma_i \Gamma_j \log r_{ij},$$

    with $r_{ij}^2 = (x_i - x_j)^2 + (y_i - y_j)^2$.

    **Manifold**: energy $H$, linear impulse $(\sum \Gamma_i x_i, \sum \Gamma_i y_i)$ and angular
    impulse $\sum \Gamma_i (x_i^2 + y_i^2)$. At a relative equilibrium, such as a regular polygon of
    equal vortices, they are dependent. **Reference**: numerical; three vortices move regularly, but
    four or more are chaotic, so that roundoff grows exponentially over long times. **Samples**:
    each vortex uniform in area on the annulus of radii $\tfrac12$ and $\tfrac32$, drawn again until
    all are at least $0.3 / N$ apart, because close pairs rotate about each other arbitrarily fast.

    Source: Cardoso-Bihlo and Bihlo, arXiv:2311.14131, whose strengths and time span (500 steps of
    0.5) are the defaults; P. K. Newton, "The N-Vortex Problem" (2001).
    """

    strengths: Float[Array, " vortices"] = eqx.field(converter=real, default=(1.0, 1.0, 1.0))

    name = "point-vortices"
    title = "Point vortices"
    citation = f"{PAPER}; P. K. Newton, The N-Vortex Problem, Springer (2001)."
    t1 = 250.0
    dt = 0.5
    axes = ("x", "y")
    integrals = ("energy", "linear_impulse", "angular_impulse")

    def vector_field(self, t: RealScalarLike, y: Places, args: Args) -> Places:
        del t, args
        dx, dy, r2 = _separations(y)
        rates = self.like(y).strengths[None, :] / (2 * jnp.pi * r2)
        return jnp.stack([-jnp.sum(rates * dy, axis=1), jnp.sum(rates * dx, axis=1)], axis=1)

    def energy(self, t: RealScalarLike, y: Places, args: Args) -> Float[Array, ""]:
        del t, args
        _, _, r2 = _separations(y)
        gamma = self.like(y).strengths
        # The distances on the diagonal are 1, so that the self-energy is zero.
        return -jnp.sum(gamma[:, None] * gamma[None, :] * jnp.log(r2)) / (8 * jnp.pi)

    def linear_impulse(self, t: RealScalarLike, y: Places, args: Args) -> Float[Array, "2"]:
        del t, args
        return jnp.sum(self.like(y).strengths[:, None] * y, axis=0)

    def angular_impulse(self, t: RealScalarLike, y: Places, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(self.like(y).strengths[:, None] * y**2)

    @property
    def y0(self) -> Places:
        """An irregular polygon inside the paper's annulus; the paper gives no initial state."""
        k = jnp.arange(self.strengths.size, dtype=float)
        radius, angle = 1 + 0.4 * jnp.cos(k), 2 * jnp.pi * k / self.strengths.size
        return radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)

    def sample(self, key: PRNGKeyArray) -> Places:
        def is_too_close(carry: tuple[PRNGKeyArray, Places]) -> Bool[Array, ""]:
            _, _, r2 = _separations(carry[1])
            return jnp.min(r2) < (0.3 / self.strengths.size) ** 2

        def again(carry: tuple[PRNGKeyArray, Places]) -> tuple[PRNGKeyArray, Places]:
            key, draw_key = jr.split(carry[0])
            return key, annulus(draw_key, self.strengths.shape, inner=0.5, outer=1.5)

        return jax.lax.while_loop(is_too_close, again, again((key, self.y0)))[1]

    def frame(self, y: Places) -> Reduced:
        r"""The frame of three vortices of equal strengths, for a [`diffrax_conserve.DeepONet`][].

        Their flow commutes with translations, rotations, permutations, and changes of the length
        scale by $c$ together with the time scale by $c^2$. Two invariants remain of six numbers:
        with $r$ from one vortex of the closest pair to the other, $d = |r|$, and $q$ from their
        midpoint to the third vortex, they are the ratio $d / |q|$ and the angle between $r$ and
        $q$. The inputs are the cosine and sine of twice the angle and the ratio, which do not
        depend on the order of the pair. The columns of the basis stretch and rotate $r$, and move
        the third vortex along and across $q$ in units of $d$; the clock is $1 / d^2$. The frame is
        discontinuous where another pair becomes the closest.

        **Raises:**

        `ValueError` unless there are three vortices of equal strengths.
        """
        known = not isinstance(self.strengths, jax.core.Tracer)
        if self.strengths.size != 3 or (known and np.ptp(np.asarray(self.strengths)) > 0):
            raise ValueError(
                "`frame` is for three vortices of equal strengths, but these are "
                f"{self.strengths}. For others leave the frame out."
            )
        third = jnp.argmax(jnp.sum((y - jnp.mean(y, axis=0)) ** 2, axis=1))
        # The vortex that is farthest from the centre is opposite the closest pair.
        alone = jnp.arange(3) == third
        second, first = jnp.roll(alone, 1), jnp.roll(alone, -1)
        r, q = second @ y - first @ y, alone @ y - (first @ y + second @ y) / 2
        d, e = jnp.linalg.norm(r), q / jnp.linalg.norm(q)
        cosine, sine = r @ e / d, r @ _quarter_turn(e) / d
        inputs = [cosine**2 - sine**2, 2 * sine * cosine, d / jnp.linalg.norm(q)]
        # A change of `q` moves all three vortices, a change of `r` only the pair; neither moves the
        # centre.
        of_q, of_r = alone - 1 / 3, (second * 1.0 - first) / 2
        columns = [
            *(jnp.outer(of_q, d * x).reshape(-1) for x in (e, _quarter_turn(e))),
            *(jnp.outer(of_r, x).reshape(-1) for x in (r, _quarter_turn(r))),
        ]
        basis = jnp.stack(columns, axis=1).astype(y.dtype)
        return Reduced(jnp.stack(inputs), basis, 1 / d**2)

    def trajectories(self, ys: Float[Array, "times vortices 2"]) -> Curves:
        return {f"vortex {i + 1}": ys[:, i] for i in range(self.strengths.size)}


PointVortices.__init__.__doc__ = r"""**Arguments:**

- `strengths`: the strengths $\Gamma_1, \dots, \Gamma_N$, one for each vortex.
"""


def _quarter_turn(x: Float[Array, "2"]) -> Float[Array, "2"]:
    return jnp.stack([-x[1], x[0]])


def _separations(y: Places) -> tuple[Pairs, Pairs, Pairs]:
    """$x_i - x_j$, $y_i - y_j$ and $r_{ij}^2$, with ones on the diagonal of the last."""
    dx = y[:, None, 0] - y[None, :, 0]
    dy = y[:, None, 1] - y[None, :, 1]
    return dx, dy, dx**2 + dy**2 + jnp.eye(y.shape[0], dtype=y.dtype)


Wave = Float[Array, " points"]
Modes = Complex[Array, " modes"]


@final
class KortewegDeVries(AbstractIntegratedSystem):
    r"""Waves in shallow water at $N$ points of a ring, `y = u` of shape `(N,)`.

    $$u_t + 6 u u_x + u_{xxx} = 0, \qquad u(t, x + L) = u(t, x).$$

    This is the method of lines with Fourier modes. Let $v = P u$ consist of the modes of $u$ with a
    wave number of at most $(N - 1) / 3$. Products of three such functions are integrated exactly by
    the $N$ points, so the semi-discrete equation

    $$u' = -\partial_x P (3 v^2 + v_{xx})$$

    conserves three of the integrals of the partial differential equation exactly: mass, momentum
    and energy,

    $$\int u \,dx, \qquad \int \tfrac12 v^2 \,dx, \qquad \int \tfrac12 v_x^2 - v^3 \,dx.$$

    It is stiff: the fastest mode has the frequency $(2 \pi (N - 1) / 3 L)^3$, 297 by default, so
    RK4 is stable up to steps of 0.0095.

    **Manifold**: mass, momentum, energy. **Reference**: numerical. From `y0` it agrees with
    `soliton` to 1e-8. **Samples**: random combinations of the modes 0 to 4.

    Source: P. G. Drazin and R. S. Johnson, "Solitons: an Introduction", Cambridge 1989, 1.2 and
    5.1; J. P. Boyd, "Chebyshev and Fourier Spectral Methods", 11.5, for the number of modes.
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=80.0)
    wave_number: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    points: int = eqx.field(static=True, default=256, kw_only=True)

    name = "korteweg-de-vries"
    title = "Korteweg-de Vries equation, a soliton"
    citation = "P. G. Drazin and R. S. Johnson, Solitons: an Introduction, Cambridge 1989."
    t1 = 16.0
    dt = 0.008
    axes = ("cosine of mode 1", "sine of mode 1")
    integrals = ("mass", "momentum", "energy")

    def __check_init__(self):
        if self.points < 4:
            raise ValueError(
                "`KortewegDeVries(points=...)` needs at least 4 points, so that it has a mode "
                f"besides the mean. It was given {self.points}."
            )

    def vector_field(self, t: RealScalarLike, y: Wave, args: Args) -> Wave:
        del t, args
        modes, d = self._modes(y)
        square = jnp.fft.rfft(self._wave(modes) ** 2)
        return self._wave(-d * (3 * square + d * d * modes))

    def _modes(self, y: Wave) -> tuple[Modes, Modes]:
        """The modes of $P u$, and the factors $ik$ of a derivative; both are zero for modes that
        $P$ removes."""
        number = jnp.arange(self.points // 2 + 1)
        kept = number <= (self.points - 1) // 3
        k = jnp.where(kept, 2 * jnp.pi * number.astype(y.dtype) / self.like(y).length, 0)
        modes = jnp.fft.rfft(y)
        return jnp.where(kept, modes, jnp.zeros_like(modes)), jax.lax.complex(jnp.zeros_like(k), k)

    def _wave(self, modes: Modes) -> Wave:
        return jnp.fft.irfft(modes, self.points)

    def _integral(self, values: Wave) -> Float[Array, ""]:
        return self.like(values).length * jnp.mean(values)

    def mass(self, t: RealScalarLike, y: Wave, args: Args) -> Float[Array, ""]:
        del t, args
        return self._integral(y)

    def momentum(self, t: RealScalarLike, y: Wave, args: Args) -> Float[Array, ""]:
        del t, args
        modes, _ = self._modes(y)
        return self._integral(self._wave(modes) ** 2) / 2

    def energy(self, t: RealScalarLike, y: Wave, args: Args) -> Float[Array, ""]:
        del t, args
        modes, d = self._modes(y)
        slope, wave = self._wave(d * modes), self._wave(modes)
        return self._integral(slope**2 / 2 - wave**3)

    @property
    def x(self) -> Wave:
        """The grid points, starting at 0."""
        return self.length * jnp.arange(self.points, dtype=float) / self.points

    @property
    def y0(self) -> Wave:
        return self.soliton(0.0)

    def soliton(self, t: RealScalarLike) -> Wave:
        r"""The exact solution $2 \kappa^2 \operatorname{sech}^2 \kappa (x - L/4 - 4 \kappa^2 t)$
        of the partial differential equation on the line, at the points of the ring."""
        kappa = self.wave_number
        distance = self.x - self.length / 4 - 4 * kappa**2 * t
        half = self.length / 2
        return 2 * kappa**2 / jnp.cosh(kappa * ((distance + half) % self.length - half)) ** 2

    def sample(self, key: PRNGKeyArray) -> Wave:
        amplitudes = jr.uniform(key, (2, 5), minval=-0.5, maxval=0.5)
        angles = jnp.outer(jnp.arange(5.0), 2 * jnp.pi * self.x / self.length)
        return amplitudes[0] @ jnp.cos(angles) + amplitudes[1] @ jnp.sin(angles)

    def trajectories(self, ys: Float[Array, "times points"]) -> Curves:
        """The first Fourier mode, which moves on a circle for a travelling wave."""
        mode = 2 * jnp.fft.rfft(ys)[:, 1] / self.points
        return {"wave": jnp.stack([mode.real, -mode.imag], axis=1)}


KortewegDeVries.__init__.__doc__ = r"""**Arguments:**

- `length`: the length $L$ of the ring.
- `wave_number`: $\kappa$ of the soliton `y0`, whose height is $2 \kappa^2$ and whose speed is
    $4 \kappa^2$.
- `points`: the number $N$ of grid points.
"""
