"""The free rigid body: its angular momentum, and its attitude as a unit quaternion."""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import HAIRER, PAPER, AbstractIntegratedSystem, AbstractSystem, direction, real, shell
from ._elliptic import complete_elliptic, incomplete_elliptic, jacobi_elliptic

State = Float[Array, "3"]


@final
class RigidBody(AbstractSystem):
    r"""Euler's equations of a free rigid body, in its principal frame.

    The state `y = w` of shape `(3,)` is the angular momentum; the angular velocity is $w_i / I_i$.

    $$w_1' = \frac{I_2 - I_3}{I_2 I_3}\, w_2 w_3 \quad\text{and cyclically},$$

    $$H = \tfrac12 \sum_i w_i^2 / I_i, \qquad L = \tfrac12 \sum_i w_i^2.$$

    **Manifold**: energy $H$ and half the squared angular momentum $L$, which are dependent in a
    steady rotation about a principal axis. **Reference**: exact, by Jacobi's elliptic functions;
    needs at least two distinct moments, and loses accuracy at the separatrix $L = H I_2$, where the
    motion itself is unstable. **Samples**: uniform direction, $\tfrac12 \le |w| \le 2$ uniform.

    Source: Cardoso-Bihlo and Bihlo, arXiv:2311.14131, whose moments, initial state and time span
    (1.55 periods) are the defaults; the paper gives no step, so `dt` is our choice; Landau and
    Lifshitz, "Mechanics", §37 for the solution.
    """

    inertia: Float[Array, "3"] = eqx.field(converter=real, default=(0.1, 0.2, 0.3))

    name = "rigid-body"
    title = "Free rigid body"
    citation = f"{PAPER}; L. D. Landau and E. M. Lifshitz, Mechanics, §36-37."
    t1 = 1.75
    dt = 0.05
    axes = ("w₁", "w₂", "w₃")
    integrals = ("energy", "squared_angular_momentum")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        k1, k2, k3 = _rates(self.like(y).inertia)
        w1, w2, w3 = y
        return jnp.stack([k1 * w2 * w3, k2 * w3 * w1, k3 * w1 * w2])

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(y**2 / self.like(y).inertia) / 2

    def squared_angular_momentum(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(y**2) / 2

    @property
    def y0(self) -> State:
        return jnp.array([1.0, 1.0, 1.0])

    def sample(self, key: PRNGKeyArray) -> State:
        return shell(key, inner=0.5, outer=2.0)

    def solution(self, ts: Float[Array, " times"], y0: State) -> Float[Array, "times 3"]:
        axes, amplitudes, rate, m, u0 = _elliptic_form(self.inertia, y0)
        sn, cn, dn = jacobi_elliptic(rate * ts + u0, m)
        permuted = amplitudes * jnp.stack([dn, sn, cn], axis=-1)
        return jnp.zeros_like(permuted).at[:, axes].set(permuted)

    def period(self, y0: State | None = None) -> Float[Array, ""]:
        _, _, rate, m, _ = _elliptic_form(self.inertia, self.y0 if y0 is None else y0)
        return 4 * complete_elliptic(m) / rate


RigidBody.__init__.__doc__ = r"""**Arguments:**

- `inertia`: the principal moments of inertia $(I_1, I_2, I_3)$.
"""


def _rates(inertia: Float[Array, "3"]) -> tuple[Array, Array, Array]:
    i1, i2, i3 = inertia
    return (i2 - i3) / (i2 * i3), (i3 - i1) / (i3 * i1), (i1 - i2) / (i1 * i2)


def _elliptic_form(inertia: Float[Array, "3"], y0: State) -> tuple[Array, ...]:
    r"""The solution as $(w_a, w_b, w_c) = (A\,dn, B\,sn, C\,cn)(\lambda t + u_0)$.

    Here $b$ is the axis of the middle moment of inertia. With $w_i' = k_i w_j w_k$, inserting this
    form gives $\lambda^2 = -k_b k_c A^2$, $B = k_b A C / \lambda$ and $m = k_a C^2 / k_c A^2$. Of
    the two outer axes, $a$ is the one for which $m \le 1$, about which $w$ rotates.
    """
    order = jnp.argsort(inertia)
    k = jnp.stack(_rates(inertia))
    k_b, w_b = k[order[1]], y0[order[1]]

    # A^2 and C^2 as sums of positive terms: k_b has the sign opposite to k_a and k_c.
    squares = y0**2 - k / k_b * w_b**2
    first, last = jnp.abs(squares / k)[order[::2]]
    axes = jnp.where(first <= last, order[::-1], order)
    a, _, c = axes

    amplitude_a = jnp.copysign(jnp.sqrt(squares[a]), y0[a])
    amplitude_c = jnp.sqrt(squares[c])
    ratio = jnp.copysign(jnp.sqrt(-k_b / k[c]), k_b * amplitude_a)  # B / C
    rate = jnp.sqrt(-k_b * k[c]) * jnp.abs(amplitude_a)
    m = jnp.minimum(k[a] * squares[c] / (k[c] * squares[a]), 1.0)
    u0 = incomplete_elliptic(jnp.arctan2(w_b / ratio, y0[c]), m)
    amplitudes = jnp.stack([amplitude_a, ratio * amplitude_c, amplitude_c])
    return axes, amplitudes, rate, m, u0


Pose = tuple[Float[Array, "4"], Float[Array, "3"]]


@final
class RigidBodyAttitude(AbstractIntegratedSystem):
    r"""A free rigid body in space, `y = (Q, ω)` of shapes `(4,)` and `(3,)`.

    The quaternion $Q$, scalar part first, maps the frame of the body to that of space; $\omega$ is
    the angular velocity in the frame of the body and $I$ the diagonal of the inertia tensor:

    $$Q' = \tfrac12\, Q\, \omega, \qquad I \omega' = (I \omega) \times \omega.$$

    **Manifold**: unit quaternion $Q \bar Q = 1$ (a constraint), energy
    $\tfrac12\, \omega \cdot I \omega$ and the three components of the angular momentum in space,
    $Q\, (I \omega)\, \bar Q$. They are dependent in a steady rotation about a principal axis.
    **Reference**: numerical. **Samples**: $Q$ uniform, $\omega$ in a uniform direction with
    $\tfrac12 \le |\omega| \le 2$ uniform.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", VII.5.
    """

    inertia: Float[Array, "3"] = eqx.field(converter=real, default=(0.1, 0.2, 0.3))

    name = "rigid-body-attitude"
    title = "Attitude of a free rigid body"
    citation = f"{HAIRER}, VII.5."
    t1 = 20.0
    dt = 0.1
    axes = ("x", "y", "z")
    integrals = ("energy", "angular_momentum")

    def vector_field(self, t: RealScalarLike, y: Pose, args: Args) -> Pose:
        del t, args
        attitude, omega = y
        inertia = self.like(y).inertia
        scalar, vector = attitude[0], attitude[1:]
        real_part = -jnp.sum(vector * omega, keepdims=True)
        spin = jnp.concatenate([real_part, scalar * omega + jnp.cross(vector, omega)]) / 2
        return spin, jnp.cross(inertia * omega, omega) / inertia

    def squared_norm_minus_one(self, t: RealScalarLike, y: Pose, args: Args) -> Float[Array, ""]:
        del t, args
        attitude, _ = y
        return jnp.sum(attitude**2) - 1

    def energy(self, t: RealScalarLike, y: Pose, args: Args) -> Float[Array, ""]:
        del t, args
        _, omega = y
        return jnp.sum(self.like(y).inertia * omega**2) / 2

    def angular_momentum(self, t: RealScalarLike, y: Pose, args: Args) -> Float[Array, "3"]:
        del t, args
        attitude, omega = y
        return _rotate(attitude, self.like(y).inertia * omega)

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {"unit quaternion": Constraint(self.squared_norm_minus_one), **super().manifold}

    @property
    def y0(self) -> Pose:
        return jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 1.0, 1.0])

    def sample(self, key: PRNGKeyArray) -> Pose:
        attitude_key, omega_key = jr.split(key)
        return direction(attitude_key, 4), shell(omega_key, inner=0.5, outer=2.0)

    def trajectories(self, ys: Any) -> dict[str, Float[Array, "times 3"]]:
        attitudes, _ = ys
        third = jnp.zeros((attitudes.shape[0], 3), attitudes.dtype).at[:, 2].set(1)
        return {"third axis of the body": _rotate(attitudes, third)}


RigidBodyAttitude.__init__.__doc__ = RigidBody.__init__.__doc__


def _rotate(attitude: Float[Array, "*s 4"], v: Float[Array, "*s 3"]) -> Float[Array, "*s 3"]:
    r"""$Q v \bar Q$, by Hamilton's product."""
    scalar, vector = attitude[..., :1], attitude[..., 1:]
    size = scalar**2 - jnp.sum(vector**2, axis=-1, keepdims=True)
    along = jnp.sum(vector * v, axis=-1, keepdims=True)
    return size * v + 2 * (along * vector + scalar * jnp.cross(vector, v))
