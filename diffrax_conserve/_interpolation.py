"""Dense output on the manifold: the inner solver's interpolant, projected at each evaluation.

It is off the manifold by its own error. At the ends of a step it is projected too: stored states in
its place would have no time derivative, which the root finder of an event needs.
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
from jaxtyping import Array, Bool, PyTree

from ._custom_types import DenseInfo, RealScalarLike, Y
from ._projection.base import Target, has_bounds
from ._projection.equations import any_lane
from ._projection.loop import solve
from ._tree import ravel, tree_sub, tree_tangents

# The first share of the way to the end of a step, which is multiplied by eight until it is one.
_CLOSER = 2.0**-30
# The largest number of damped steps: in mixed units they zigzag.
_FAR_STEPS = 1000


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

    Where the projection of the interpolant fails, that for far candidates is tried, then of states
    that are closer, at first by a hair, to the nearer end of the step, a state on the manifold, and
    at last there. If that fails too, the value is NaN.
    There is no extrapolation: a time outside the step is replaced by the nearer end.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    inner: dfx.AbstractLocalInterpolation
    ends: tuple[Y, Y]
    error: Y | None
    target: PackedTarget
    due: Bool[Array, ""] | None

    @eqx.filter_jit  # traced once for all saved times
    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        # Strict inequalities keep the derivative of the interpolant at the ends of the step.
        first, last = jnp.minimum(self.t0, self.t1), jnp.maximum(self.t0, self.t1)
        t0 = jnp.where(t0 < first, first, jnp.where(t0 > last, last, t0))
        early = jnp.abs(t0 - self.t0) < jnp.abs(self.t1 - t0)
        end = jtu.tree_map(ft.partial(jnp.where, early), *self.ends)
        candidate = self.inner.evaluate(t0, left=left)
        target = self.target.unpack().advanced(self.t0, t0, self.inner.evaluate)
        step = target.step(self.t0, self.t1, self.ends[0], self.error)
        # As far from the interpolant as both ends together nothing is nearest to it.
        apart = (jnp.linalg.norm(ravel(tree_sub(end, candidate))) for end in self.ends)
        limit = jnp.inf if target.projection.metric is not None else sum(apart)
        problem = target.problem(t0, candidate, step)

        def by(far: bool) -> Callable[..., Any]:
            def project(candidate: Y) -> tuple[Y, Array]:
                vector = ravel(candidate)
                if far:
                    given = problem.equations, vector
                    y, ok, _ = solve(*given, max_steps=_FAR_STEPS, fresh=True, damped=True)
                else:
                    y, info = target.projection.solve(problem, vector)
                    ok = info.ok
                near = jnp.linalg.norm(y - vector) <= lax.stop_gradient(limit)
                return problem.state(y), ok & near

            # Arrays over which the functions of the manifold close become leaves.
            return eqx.filter_closure_convert(project, candidate)

        unbounded = not has_bounds(target.projection)  # damped steps keep no bounds
        y, _ = _projected(by(False), by(unbounded), candidate, end)
        due = self.due
        return y if due is None else jtu.tree_map(ft.partial(jnp.where, due), y, candidate)


@eqx.filter_custom_jvp
def _projected(
    project: Callable[..., Any],
    far: Callable[..., Any],
    candidate: Y,
    end: Y,
) -> tuple[Y, Bool[Array, ""]]:
    """The projection of the interpolant, or by `far` of a state closer to the end; and whether it
    is the first."""
    y, direct = project(candidate)

    def body(carry: tuple[Array, Array, Y]) -> tuple[Array, Array, Y]:
        share, going, y = carry

        def closer(start: Array, end: Array) -> Array:
            part = share.astype(end.real.dtype)
            # The end is taken as it is, where the interpolant may not be finite.
            return jnp.where(part < 1, (1 - part) * start + part * end, end)

        found, ok = far(jtu.tree_map(closer, candidate, end))
        found = jtu.tree_map(lambda x: jnp.where(ok, x, jnp.nan), found)
        y = jtu.tree_map(ft.partial(jnp.where, going), found, y)
        return 8 * share, going & ~ok & (share < 1), y

    _, _, y = lax.while_loop(lambda x: any_lane(x[1]), body, (jnp.asarray(_CLOSER), ~direct, y))
    return y, direct


@_projected.def_jvp
def _projected_jvp(primals: Any, tangents: Any) -> Any:
    """Only the projection of the interpolant itself has a derivative."""
    y, direct = _projected(*primals)
    given = (primals[0], primals[2]), (tangents[0], tangents[2])
    _, t_y = eqx.filter_jvp(lambda project, candidate: project(candidate)[0], *given)
    factor = jnp.where(direct, 1, jnp.nan)
    t_y = jtu.tree_map(lambda x: factor.astype(x.dtype) * x, tree_tangents(y, t_y))
    return (y, direct), (t_y, None)


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
