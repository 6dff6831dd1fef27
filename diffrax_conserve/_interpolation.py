"""Dense output on the manifold: the inner solver's interpolant, projected at each evaluation.

A value always belongs to its time: what cannot be projected stays where the interpolant is. At
the ends of a step it is projected too, because stored states would have no slope, which the root
finder of an event needs.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ._custom_types import DenseInfo, RealScalarLike, Y
from ._projection.base import Target, has_bounds
from ._projection.equations import any_lane, length, reach
from ._projection.loop import solve
from ._tree import ravel, tree_all_finite, tree_sub, tree_tangents

# The largest number of damped steps.
_DAMPED_STEPS = 100


@final
class PackedTarget(eqx.Module):
    """A `Target` in the form in which `dense_info` stores it: only arrays are leaves."""

    arrays: PyTree[Array]
    static: Target = eqx.field(static=True)

    def __init__(self, target: Target):
        # Python numbers are kept static, because a function may use them as a shape or an index.
        arrays, self.static = eqx.partition(target, lambda x: isinstance(x, jax.Array | np.ndarray))
        self.arrays = jtu.tree_map(jnp.asarray, arrays)

    def unpack(self) -> Target:
        return eqx.combine(self.arrays, self.static)


@final
class ManifoldInterpolation(dfx.AbstractLocalInterpolation):
    """A local interpolation whose values lie on a manifold.

    The interpolant `u` of the wrapped solver ends at the candidate `ŷ₁`. It is moved so that it
    meets the projected states at both ends of the step, `u(θ) + θ (y₁ - ŷ₁)`, and then projected as
    a step is. Where that fails, damped steps with fresh gradients are tried from the same state.
    Where they fail too, or lead further away than the step is long, the value is the moved
    interpolant itself, which is off the manifold by the error of the interpolation.

    There is no extrapolation: a time outside the step is replaced by the nearer end.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    inner: dfx.AbstractLocalInterpolation
    shift: Y
    error: Y | None
    target: PackedTarget
    due: Bool[Array, ""] | None

    @eqx.filter_jit  # traced once for all saved times
    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        return _evaluated(t0, self, left=left)

    def moved(self, t: RealScalarLike, left: bool) -> Y:
        """The interpolant of the wrapped solver, which meets the projected states at both ends."""
        # Strict inequalities keep the derivative of the interpolant at the ends of the step.
        first, last = jnp.minimum(self.t0, self.t1), jnp.maximum(self.t0, self.t1)
        t = jnp.where(t < first, first, jnp.where(t > last, last, t))
        share = (t - self.t0) / (self.t1 - self.t0)

        def move(y: Array, shift: Array) -> Array:
            return y + share.astype(shift.real.dtype) * shift

        return jtu.tree_map(move, self.inner.evaluate(t, left=left), self.shift)

    def projected(self, t: RealScalarLike, left: bool) -> Y:
        start, end, candidate = (self.moved(t, left) for t in (self.t0, self.t1, t))
        target = self.target.unpack().advanced(self.t0, t, self.inner.evaluate)
        step = target.step(self.t0, self.t1, start, self.error)
        problem = target.problem(t, candidate, step)
        units = problem.equations.units
        limit = lax.stop_gradient(reach(ravel(start), ravel(end), units))

        def by(damped: bool) -> Callable[..., Any]:
            def project(candidate: Array) -> tuple[Array, Array]:
                if damped:
                    given = problem.equations, candidate
                    y, ok, _ = solve(*given, max_steps=_DAMPED_STEPS, fresh=True, damped=True)
                else:
                    y, info = target.projection.solve(problem, candidate)
                    ok = info.ok
                return y, ok & (length(y - candidate, units) <= limit)

            # Arrays over which the functions of the manifold close become leaves.
            return eqx.filter_closure_convert(project, ravel(candidate))

        bounded = has_bounds(target.projection)  # damped steps keep no bounds
        y, _ = _nearby(by(False), None if bounded else by(True), ravel(candidate))
        y = problem.state(y)
        due = self.due
        return y if due is None else jtu.tree_map(ft.partial(jnp.where, due), y, candidate)


@eqx.filter_custom_jvp
def _evaluated(t: RealScalarLike, path: ManifoldInterpolation, *, left: bool) -> Y:
    return path.projected(t, left)


@_evaluated.def_jvp
def _evaluated_jvp(primals: Any, tangents: Any, *, left: bool) -> Any:
    """The slope in time is that of the projected interpolant. Where this is not certain, as on a
    circular orbit, it is that of the interpolant itself: the root finder of an event needs a slope,
    but not an exact one. A derivative in anything else is exact or NaN."""
    (t, path), (t_t, t_path) = primals, tangents
    y = _evaluated(t, path, left=left)
    _, t_y = eqx.filter_jvp(lambda path: path.projected(t, left), (path,), (t_path,))
    t_y = tree_tangents(y, t_y)
    if t_t is not None:
        one = (jnp.ones_like(t),)
        _, slope = jax.jvp(lambda t: path.projected(t, left), (t,), one)
        _, other = jax.jvp(lambda t: path.moved(t, left), (t,), one)
        certain = tree_all_finite(slope)
        slope = jtu.tree_map(ft.partial(jnp.where, certain), slope, other)
        t_y = jtu.tree_map(lambda x, s: x + s * t_t.astype(s.real.dtype), t_y, slope)
    return y, t_y


@eqx.filter_custom_jvp
def _nearby(
    project: Callable[..., Any], damped: Callable[..., Any] | None, candidate: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Int[Array, ""]]:
    """The state, and the attempt that it comes from: 0 for the projection, 1 for damped steps, and
    2 where both failed, so that it is the candidate."""
    y, ok = project(candidate)
    attempt = jnp.where(ok, 0, 2)
    if damped is not None:

        def again() -> tuple[Array, Array]:
            found, better = damped(candidate)
            better = better & ~ok
            return jnp.where(better, found, y), jnp.where(better, 1, attempt)

        y, attempt = lax.cond(any_lane(~ok), again, lambda: (y, attempt))
    return jnp.where(attempt < 2, y, candidate), attempt


@_nearby.def_jvp
def _nearby_jvp(primals: Any, tangents: Any) -> Any:
    """Damped steps have no derivative; that of the candidate is its own."""
    project, _, candidate = primals
    y, attempt = _nearby(*primals)
    t_candidate = tree_tangents(candidate, tangents[2])
    given = (project, candidate), (tangents[0], tangents[2])
    _, t_y = eqx.filter_jvp(lambda project, candidate: project(candidate)[0], *given)
    t_y = jnp.where(attempt == 0, tree_tangents(y, t_y), t_candidate)
    return (y, attempt), (jnp.where(attempt == 1, jnp.nan, 1) * t_y, None)


@dataclasses.dataclass(frozen=True)
class MakeManifoldInterpolation:
    """The `interpolation_cls` of a projected solver: equal for equal inner classes, so that two
    solves with dense output share one compiled evaluation."""

    inner_cls: Callable[..., dfx.AbstractLocalInterpolation]

    def __call__(
        self, *, t0: RealScalarLike, t1: RealScalarLike, inner: DenseInfo, **fields: Any
    ) -> ManifoldInterpolation:
        path = self.inner_cls(t0=t0, t1=t1, **inner)
        return ManifoldInterpolation(t0=t0, t1=t1, inner=path, **fields)
