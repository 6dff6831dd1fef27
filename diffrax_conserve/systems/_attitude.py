"""The attitude of a free rigid body, as a unit quaternion."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, direction, real, shell

State = tuple[Float[Array, "4"], Float[Array, "3"]]


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
    citation = "E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration, VII.5."
    t1 = 20.0
    dt = 0.1
    axes = ("x", "y", "z")

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        del t, args
        attitude, omega = y
        inertia = self.like(y).inertia
        spin = _multiply(attitude, _pure(omega)) / 2
        return spin, jnp.cross(inertia * omega, omega) / inertia

    def squared_norm_minus_one(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        attitude, _ = y
        return jnp.sum(attitude**2) - 1

    def energy(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        _, omega = y
        return jnp.sum(self.like(y).inertia * omega**2) / 2

    def angular_momentum(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, "3"]:
        del t, args
        attitude, omega = y
        return _rotate(attitude, self.like(y).inertia * omega)

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return {
            "unit quaternion": Constraint(self.squared_norm_minus_one),
            "energy": FirstIntegral(self.energy),
            "angular momentum": FirstIntegral(self.angular_momentum),
        }

    @property
    def y0(self) -> State:
        return jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 1.0, 1.0])

    def sample(self, key: PRNGKeyArray) -> State:
        attitude_key, omega_key = jr.split(key)
        return direction(attitude_key, 4), shell(omega_key, inner=0.5, outer=2.0)

    def trajectories(
        self, ys: tuple[Float[Array, "times 4"], Float[Array, "times 3"]]
    ) -> dict[str, Float[Array, "times 3"]]:
        attitudes, _ = ys
        third = jnp.zeros((attitudes.shape[0], 3), attitudes.dtype).at[:, 2].set(1)
        return {"third axis of the body": _rotate(attitudes, third)}


RigidBodyAttitude.__init__.__doc__ = r"""**Arguments:**

- `inertia`: the principal moments of inertia $(I_1, I_2, I_3)$.
"""


def _pure(v: Float[Array, "*s 3"]) -> Float[Array, "*s 4"]:
    return jnp.concatenate([jnp.zeros_like(v[..., :1]), v], axis=-1)


def _multiply(a: Float[Array, "*s 4"], b: Float[Array, "*s 4"]) -> Float[Array, "*s 4"]:
    """Hamilton's product."""
    a0, av, b0, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = a0 * b0 - jnp.sum(av * bv, axis=-1, keepdims=True)
    return jnp.concatenate([scalar, a0 * bv + b0 * av + jnp.cross(av, bv)], axis=-1)


def _rotate(attitude: Float[Array, "*s 4"], v: Float[Array, "*s 3"]) -> Float[Array, "*s 3"]:
    conjugate = jnp.concatenate([attitude[..., :1], -attitude[..., 1:]], axis=-1)
    return _multiply(_multiply(attitude, _pure(v)), conjugate)[..., 1:]
