"""Dense output on the manifold: the interpolant of the wrapped solver, projected at each
evaluation.

A value always belongs to its time. If the interpolant cannot be projected at a time, the value
there is the interpolant itself, and not the state of a time nearby that could be projected.

The ends of a step are evaluated in the same way, although their projected states are known. To
return these where the time is that of an end would give a zero derivative by the time, and the root
finder of an event needs the slope.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._custom_types import DenseInfo, RealScalarLike
from ._numerics.iterate import damped_newton
from ._numerics.lanes import any_lane
from ._numerics.problem import Step
from ._time import FieldTime, nonzero_length
from ._tree import ravel, tree_stop_gradient, tree_sub, unravel


@final
class AsArrays(eqx.Module):
    """A module, such as a `TargetManifold`, in the form in which `dense_info` can store it. diffrax
    copies the leaves of `dense_info` into arrays over the steps, so that only arrays may be
    leaves."""

    arrays: PyTree[Array]
    static: Any = eqx.field(static=True)

    def __init__(self, module: Any):
        # Python numbers stay what they are, because a function may use them as a shape or an index.
        arrays, self.static = eqx.partition(module, lambda x: isinstance(x, jax.Array | np.ndarray))
        self.arrays = jtu.tree_map(jnp.asarray, arrays)

    def unpack(self) -> Any:
        return eqx.combine(self.arrays, self.static)


@final
class ManifoldInterpolation(dfx.AbstractLocalInterpolation):
    """A local interpolation whose values lie on a manifold.

    The interpolant `u` of the wrapped solver ends at the candidate `ŷ₁`. It is moved so that it
    meets the projected states at both ends of the step, `u(θ) + θ (y₁ - ŷ₁)` after the share `θ` of
    the step, and this state is projected like a candidate. If the projection fails, the damped
    Newton method is tried from the same state. A projection has failed too if its correction is
    longer than the step, and longer than the distance of the moved interpolant from the start of
    the step. If both fail, the value is the moved interpolant itself, which is off the manifold by
    the error of the interpolation. With bounds there is one attempt, and if it fails, the value is
    the moved interpolant, clipped to the bounds.

    There is no extrapolation: a time outside the step is replaced by the nearer end.

    - `t0`, `t1`: the ends of the step, as times of the solver.
    - `inner`: the interpolant `u` of the wrapped solver.
    - `field_time`: the time of the vector field as a function of that of the solver, and back.
    - `step_correction`: the correction of the step, `y₁ - ŷ₁`.
    - `step_norm`: the norm of the step in the metric. A correction may be as long as it, or as the
      distance of the moved interpolant from the start of the step.
    - `error`: the error estimate of the step, if the projection uses it.
    - `target`: what the projection of the step aimed at, without the integrals of the rates over
      this step.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    inner: dfx.AbstractLocalInterpolation
    field_time: FieldTime
    step_correction: Float[Array, " n"]
    step_norm: Float[Array, ""]
    error: Float[Array, " n"] | None
    target: AsArrays

    @eqx.filter_jit  # traced once for all saved times
    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        # A time exactly at an end is inside, so that the slope there is that of the interpolant.
        first, last = jnp.minimum(self.t0, self.t1), jnp.maximum(self.t0, self.t1)
        t = jnp.where(t0 < first, first, jnp.where(t0 > last, last, t0))
        u = self.inner.evaluate(t, left=left)
        theta = (t - self.t0) / nonzero_length(self.t0, self.t1)
        # The correction of an attempt that failed is NaN. In a batch it is evaluated and discarded,
        # but in reverse mode zero times the derivative of NaN would be NaN.
        known = jnp.all(jnp.isfinite(self.step_correction))
        correction = jnp.where(known, self.step_correction, 0)
        moved = ravel(u) + theta.astype(correction.dtype) * correction
        y = self.projected(self.field_time(t), moved)
        return unravel(jnp.where(known, y, jnp.nan), u)

    def projected(self, t: RealScalarLike, candidate: Float[Array, " n"]) -> Float[Array, " n"]:
        """The projection of the moved interpolant, or that itself where no projection succeeds."""
        t_start, t_end = self.field_time(self.t0), self.field_time(self.t1)
        interpolant = lambda t: ravel(self.inner.evaluate(self.field_time(t)))  # noqa: E731
        target = self.target.unpack().with_rates_integrated(t_start, t, interpolant)
        y_start = interpolant(t_start)
        step = Step(t_start, t_end, y_start, self.error)
        problem = target.problem(t, candidate, step)
        metric, projection = problem.factor, target.projection
        distance = metric.norm(candidate - y_start)
        longest = lax.stop_gradient(jnp.maximum(self.step_norm, distance))

        def is_accepted(y: Array, ok: Array) -> Array:
            """Whether a projection succeeded without leading too far away."""
            return ok & (metric.norm(y - candidate) <= longest)

        y, info = projection.solve(problem, candidate)
        ok = is_accepted(y, info.ok)
        y = projection.clip(jnp.where(ok, y, candidate), problem.like)
        # A second attempt would lose the bounds.
        if not projection.follows_gradients or projection.has_bounds:
            return y
        primal_problem, primal_candidate = tree_stop_gradient((problem, candidate))

        def second_attempt() -> tuple[Array, Array]:
            found = damped_newton(primal_problem, primal_candidate, max_steps=projection.max_steps)
            return found.y, is_accepted(found.y, found.ok)

        found, better = lax.cond(any_lane(~ok), second_attempt, lambda: (primal_candidate, ok))
        # The derivative of the second attempt is that of the interpolant.
        zero = y - lax.stop_gradient(y)  # zero, but with a derivative
        return lax.stop_gradient(jnp.where(better & ~ok, found, y)) + zero


@dataclasses.dataclass(frozen=True)
class MakeManifoldInterpolation:
    """The `interpolation_cls` of a projected solver: equal for equal inner classes, so that two
    solves with dense output share one compiled evaluation."""

    inner_cls: Callable[..., dfx.AbstractLocalInterpolation]

    def __call__(
        self, *, t0: RealScalarLike, t1: RealScalarLike, inner: DenseInfo, **fields: Any
    ) -> ManifoldInterpolation:
        interpolation = self.inner_cls(t0=t0, t1=t1, **inner)
        return ManifoldInterpolation(t0=t0, t1=t1, inner=interpolation, **fields)
