"""Dense output by a shorter step."""

from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._custom_types import RealScalarLike, Y
from .._interpolation import AsArrays
from .._tree import tree_sub


class StepOf(eqx.Module):
    """What a step needs beside its times and its state."""

    solver: dfx.AbstractSolver
    terms: PyTree[dfx.AbstractTerm]
    args: Any
    state: Any


@final
class ShorterStep(dfx.AbstractLocalInterpolation):
    """The state at a time inside a step is that of a step of the same solver to this time.

    So it is on the manifold and as accurate as the step, and it meets the states at both ends.
    There is no extrapolation: a time outside the step is replaced by the nearer end.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    y0: Y
    step: AsArrays

    @eqx.filter_jit  # traced once for all saved times
    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        # A time exactly at an end is inside, so that there is a derivative in time.
        t = jnp.where(t0 < self.t0, self.t0, jnp.where(t0 > self.t1, self.t1, t0))
        of: Any = self.step.unpack()
        return of.solver.step(of.terms, self.t0, t, self.y0, of.args, of.state, False)[0]
