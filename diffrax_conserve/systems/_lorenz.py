"""The conservative part of the Lorenz-1963 model."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, annulus, real

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
        "E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131 (2023); "
        "E. N. Lorenz, J. Atmos. Sci. 20 (1963); "
        "P. Névir and R. Blender, Beitr. Phys. Atmosph. 67 (1994)."
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
        """A state inside the paper's sampling domain; the paper gives no initial state."""
        return jnp.array([0.9, 0.3, 1.2])

    def sample(self, key: PRNGKeyArray) -> State:
        plane_key, z_key = jr.split(key)
        z = jr.uniform(z_key, (1,), minval=0.5, maxval=1.5)
        return jnp.concatenate([annulus(plane_key, inner=0.5, outer=1.5), z])


ConservativeLorenz.__init__.__doc__ = r"""**Arguments:**

- `sigma`, `rho`: the Prandtl number $\sigma$ and the reduced Rayleigh number $\rho$.
"""
