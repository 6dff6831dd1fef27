"""Bounds: the constraints as functions of `z`, where `y = clip(z)`.

The loop solves `g(clip(ŷ + M⁻¹ Gᵀ λ)) = 0` as any other equation, a semismooth Newton iteration
(L. Qi and D. Sun, "A nonsmooth version of Newton's method", 1993). For linear constraints this is
the dual of a quadratic program, whose solution is the nearest point within the bounds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._printing import is_traced
from .base import AbstractProjection, has_bounds
from .equations import Equations
from .loop import Solved, project_along
from .options import check_options, option, positive_weights, spread

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
        return jnp.where(self.lower <= self.upper, clipped, jnp.nan)

    def compose(self, equations: Equations) -> Equations:
        """The equations as functions of `z`."""
        parts = tuple(eqx.Partial(_clipped, self, part) for part in equations.parts)
        return dataclasses.replace(equations, parts=parts, clip=self.clip)


def _clipped(box: Box, part: Callable[[Array], Array], z: Array) -> Array:
    return part(box.clip(z))


def project_within(
    box: Box, equations: Equations, candidate: Float[Array, " n"], *, max_steps: int
) -> Solved:
    """`loop.project_along` the gradients at the candidate, within bounds."""
    rows = equations.scaled(equations.linearise(candidate)[1])
    bounded = box.compose(equations)
    z, ok, count = project_along(bounded, candidate, rows, max_steps=2 * max_steps)
    return box.clip(z), ok, count


class AbstractNewton(AbstractProjection):
    """The options that the Newton iterations share."""

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    metric: PyTree[ArrayLike] | None = option(None, converter=positive_weights)
    lower: PyTree[ArrayLike] | None = option(None)
    upper: PyTree[ArrayLike] | None = option(None)
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_options(self)
        check_bounds(self.lower, self.upper)

    def box(self, like: Any) -> Box | None:
        if not has_bounds(self):
            return None
        low = -np.inf if self.lower is None else self.lower
        high = np.inf if self.upper is None else self.upper
        return Box(spread("lower", low, like), spread("upper", high, like))


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, where both are known."""
    for a, b in zip(jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=False):
        if not is_traced((a, b)) and not np.all(np.asarray(a) <= np.asarray(b)):
            raise ValueError(f"`lower` is {lower}, but it must be at most `upper`, {upper}.")
