"""Bounds: the constraints as functions of `z`, where `y = clip(z)`.

The loop solves `g(clip(ŷ + M⁻¹ Gᵀ λ)) = 0` as any other equation, a semismooth Newton iteration
(L. Qi and D. Sun, "A nonsmooth version of Newton's method", 1993). For linear constraints this is
the dual of a quadratic program, whose solution is the nearest point within the bounds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._tree import ravel, real_view
from .base import check_like
from .equations import Equations

# A component beyond its bound has this derivative: with zero, a constraint all of whose components
# are at bounds would never change.
_AT_BOUND = 1e-10


class Box(eqx.Module):
    """Bounds, as vectors like the state."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def clip(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        # At a bound the derivative is taken from inside, so not by `jnp.clip`.
        beyond = z - jax.lax.stop_gradient(z)
        lower, upper = (x + _AT_BOUND * beyond for x in (self.lower, self.upper))
        clipped = jnp.where(z < self.lower, lower, jnp.where(z > self.upper, upper, z))
        return jnp.where(jnp.isnan(self.lower) | jnp.isnan(self.upper), jnp.nan, clipped)

    def compose(self, equations: Equations) -> Equations:
        """The equations as functions of `z`."""
        parts = tuple(_Clipped(part, self) for part in equations.parts)
        return dataclasses.replace(equations, parts=parts, clip=self.clip)


class _Clipped(eqx.Module):
    part: Callable[[Array], Array]
    box: Box

    def __call__(self, z: Float[Array, " n"]) -> Float[Array, " k"]:
        return self.part(self.box.clip(z))


def box_of(
    lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None, like: Any
) -> Box | None:
    """The box for the options `lower` and `upper`, or `None` if neither is given."""
    if lower is None and upper is None:
        return None
    return Box(_bound("lower", lower, -np.inf, like), _bound("upper", upper, np.inf, like))


def _bound(name: str, bound: PyTree[ArrayLike] | None, default: float, like: Any) -> Array:
    y = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    view = real_view(y)
    single = bound is None or jtu.treedef_is_leaf(jtu.tree_structure(bound))
    number = default if bound is None else bound
    if single and jnp.ndim(number) == 0:
        return ravel(jtu.tree_map(lambda x: jnp.full_like(x, number), view))
    remedy = "Give one number, or one bound (or an array) for each leaf of the state."
    check_like(name, bound, y, remedy)
    return ravel(
        jtu.tree_map(lambda a, x: jnp.broadcast_to(jnp.asarray(a, x.dtype), x.shape), bound, view)
    )


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, where both are known."""
    leaves: list[list[Any]] = [jtu.tree_leaves(x) for x in (lower, upper)]
    if len(leaves[0]) != len(leaves[1]) or any(
        isinstance(x, jax.core.Tracer) or not eqx.is_array_like(x) for x in [*leaves[0], *leaves[1]]
    ):
        return
    for a, b in zip(*leaves, strict=True):
        if not np.all(np.asarray(a) <= np.asarray(b)):
            raise ValueError(
                f"`lower` is {lower}, but `upper` is {upper}. Each lower bound must be at most its "
                "upper one."
            )
