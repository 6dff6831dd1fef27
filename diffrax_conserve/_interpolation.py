"""Dense output on the manifold: the inner solver's interpolant, projected at each evaluation.

Between the ends of a step the interpolant is off the manifold by its own error, so it does not
suffice to replace its end values. At the ends of a step the interpolant is projected too, because
replacing it by the stored states would make its time derivative zero there, which the root finder
of an event needs.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ._custom_types import DenseInfo, RealScalarLike, Y
from ._projection.simplified_newton import SimplifiedNewton
from ._projection.target import Target
from ._tree import tree_sub


@final
class PackedTarget(eqx.Module):
    """A `Target` in the form in which `dense_info` stores it: only arrays are leaves."""

    arrays: PyTree[Array]
    static: Any = eqx.field(static=True)

    def __init__(self, target: Target):
        # Python numbers are kept static, because a function may use them as a shape or an index.
        arrays, static = eqx.partition(target, lambda x: isinstance(x, jax.Array | np.ndarray))
        self.arrays = jtu.tree_map(jnp.asarray, arrays)
        leaves, treedef = jtu.tree_flatten(static)
        self.static = (tuple(leaves), treedef)

    def unpack(self) -> Target:
        leaves, treedef = self.static
        return eqx.combine(self.arrays, jtu.tree_unflatten(treedef, leaves))


@final
class ManifoldInterpolation(dfx.AbstractLocalInterpolation):
    """A local interpolation whose values lie on a manifold.

    Where the projection of the interpolant fails, `SimplifiedNewton` is tried, which starts again
    closer and closer to the nearer end of the step, a state on the manifold, and at last there. If
    that fails too, the value is NaN. There is no extrapolation: a time outside the step is replaced
    by the nearer end.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    inner: dfx.AbstractLocalInterpolation
    ends: tuple[Y, Y]
    error: Y | None
    target: PackedTarget

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        # Strict inequalities keep the derivative of the interpolant at the ends of the step.
        first, last = jnp.minimum(self.t0, self.t1), jnp.maximum(self.t0, self.t1)
        t0 = jnp.where(t0 < first, first, jnp.where(t0 > last, last, t0))
        early = jnp.abs(t0 - self.t0) < jnp.abs(self.t1 - t0)
        anchor = jtu.tree_map(lambda a, b: jnp.where(early, a, b), *self.ends)
        candidate = self.inner.evaluate(t0, left=left)
        target = self.target.unpack().advanced(self.t0, t0, self.inner.evaluate)
        step = target.step(self.t0, self.t1, self.ends[0], self.error, lambda: self.inner)
        y, info = target.project(t0, candidate, anchor, step)
        okay = info.ok
        if not isinstance(target.projection, SimplifiedNewton):
            lower, upper = (getattr(target.projection, name, None) for name in ("lower", "upper"))
            metric = target.projection.metric
            again = SimplifiedNewton(metric=metric, lower=lower, upper=upper)
            second, info = dataclasses.replace(target, projection=again).project(
                t0, candidate, anchor
            )
            y = jtu.tree_map(lambda a, b: jnp.where(okay, a, b), y, second)
            okay = okay | info.ok
        return jtu.tree_map(lambda x: jnp.where(okay, x, jnp.asarray(np.nan, x.dtype)), y)


@dataclasses.dataclass(frozen=True)
class MakeManifoldInterpolation:
    """The `interpolation_cls` of a projected solver. Two instances are equal if their inner classes
    are, so that two solves with dense output share one compiled evaluation."""

    inner_cls: Callable[..., dfx.AbstractLocalInterpolation]

    def __call__(
        self, *, t0: RealScalarLike, t1: RealScalarLike, inner: DenseInfo, **fields: Any
    ) -> ManifoldInterpolation:
        path = self.inner_cls(t0=t0, t1=t1, **inner)
        return ManifoldInterpolation(t0=t0, t1=t1, inner=path, **fields)
