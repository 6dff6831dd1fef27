"""The step whose candidate is projected, as far as a projection may use it."""

from typing import final

import diffrax as dfx
import equinox as eqx
from jaxtyping import Array, Float

from .._custom_types import RealScalarLike
from .._tree import ravel


@final
class Step(eqx.Module):
    r"""The step of a solve in which a projection is called.

    Times are those of the vector field, states are real vectors. At a saved time inside the step
    and in dense output this is the same step, and the candidate is the dense output at `Problem.t`.

    **Attributes:**

    - `t0`, `t1`: where the step starts and ends; in a solve backwards in time `t1 < t0`.
    - `y0`: the state $y_n$ at `t0`, which lies on the manifold.
    - `error`: the error estimate of the wrapped solver at `t1`, or `None` if the solver has none.
    """

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Float[Array, " n"]
    error: Float[Array, " n"] | None
    path: dfx.AbstractLocalInterpolation
    direction: RealScalarLike

    def evaluate(self, t: RealScalarLike) -> Float[Array, " n"]:
        """The dense output of the wrapped solver, before any projection, at a time `t` between `t0`
        and `t1`."""
        return ravel(self.path.evaluate(t * self.direction))
