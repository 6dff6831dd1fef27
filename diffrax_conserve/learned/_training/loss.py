"""The physics-informed loss: from the defects at the collocation points to one number."""

from collections.abc import Callable
from typing import final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._options import check_number

# A function from the squared norm of the defect at each point, and a typical squared norm of `f`,
# to a loss.
Loss = Callable[[Float[Array, " points"], Float[Array, ""]], Float[Array, ""]]


def mean_square(squares: Float[Array, " points"], typical: Float[Array, ""]) -> Float[Array, ""]:
    """The mean of the squared norms, as in the paper."""
    del typical
    return jnp.mean(squares)


@final
class Bounded(eqx.Module):
    r"""The mean of $q / (1 + q / (c \bar q))$, with $q$ the squared norm of the defect.

    A point cannot contribute more than $c \bar q$, where $\bar q$ is the median of $|f|^2$ over the
    initial states. So a few states that change too fast for the network (a close pair of vortices)
    do not dominate the loss.
    """

    factor: float = 1.0

    def __check_init__(self):
        check_number("factor", self.factor, above=0.0, optional=False)

    def __call__(
        self, squares: Float[Array, " points"], typical: Float[Array, ""]
    ) -> Float[Array, ""]:
        bound = self.factor * typical
        return jnp.mean(squares / (1 + squares / jnp.where(bound > 0, bound, 1)))


Bounded.__init__.__doc__ = r"""**Arguments:**

- `factor`: the bound $c$, in units of the typical $|f|^2$.
"""
