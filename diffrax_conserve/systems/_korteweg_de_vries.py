"""The Korteweg-de Vries equation on a ring, in Fourier modes: a partial differential equation."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Complex, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from ._base import AbstractIntegratedSystem, real

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
        modes = jnp.where(kept, modes, jnp.zeros_like(modes))
        return modes, jax.lax.complex(jnp.zeros_like(k), k)

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

    def trajectories(self, ys: Float[Array, "times points"]) -> dict[str, Float[Array, "times 2"]]:
        """The first Fourier mode, which moves on a circle for a travelling wave."""
        mode = 2 * jnp.fft.rfft(ys)[:, 1] / self.points
        return {"wave": jnp.stack([mode.real, -mode.imag], axis=1)}


KortewegDeVries.__init__.__doc__ = r"""**Arguments:**

- `length`: the length $L$ of the ring.
- `wave_number`: $\kappa$ of the soliton `y0`, whose height is $2 \kappa^2$ and whose speed is
    $4 \kappa^2$.
- `points`: the number $N$ of grid points.
"""
