"""Dense output on the manifold: the inner solver's interpolant, projected at each evaluation.

Between nodes an interpolant leaves the manifold by its own error, so overwriting its end points is
not enough. It is not snapped to the nodes at the ends of a step: that would kill the time
derivative there, which the root finder of an event needs.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, PyTree

from ._custom_types import DenseInfo, RealScalarLike
from ._projection import Target
from ._tree import tree_sub


@final
class PackedTarget(eqx.Module):
    """A `Target` as it travels in `dense_info`: only arrays are leaves."""

    arrays: PyTree[Array]
    static: Any = eqx.field(static=True)

    def __init__(self, target: Target):
        arrays, static = eqx.partition(target, eqx.is_array_like)
        self.arrays = jtu.tree_map(jnp.asarray, arrays)
        leaves, treedef = jtu.tree_flatten(static)
        self.static = (tuple(leaves), treedef)

    def unpack(self) -> Target:
        leaves, treedef = self.static
        return eqx.combine(self.arrays, jtu.tree_unflatten(treedef, leaves))


@final
class ManifoldInterpolation(dfx.AbstractLocalInterpolation):
    """A local interpolation whose values lie on a manifold, or are NaN where the projection
    fails."""

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    inner: dfx.AbstractLocalInterpolation
    target: PackedTarget

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        y, info = self.target.unpack().project(t0, self.inner.evaluate(t0, left=left))
        success = info.result == optx.RESULTS.successful
        return jtu.tree_map(lambda x: jnp.where(success, x, jnp.asarray(np.nan, x.dtype)), y)


@dataclasses.dataclass(frozen=True)
class MakeManifoldInterpolation:
    """The `interpolation_cls` of a projected solver. Equal if the inner classes are, so that two
    solves with dense output share their compiled evaluation."""

    inner_cls: Callable[..., dfx.AbstractLocalInterpolation]

    def __call__(
        self, *, t0: RealScalarLike, t1: RealScalarLike, inner: DenseInfo, target: PackedTarget
    ) -> ManifoldInterpolation:
        return ManifoldInterpolation(t0, t1, self.inner_cls(t0=t0, t1=t1, **inner), target)
