"""Projection within bounds: the constraints as functions of a vector `z`, where `y = clip(z)`.

The iteration solves `g(clip(ŷ + S Uᵀ λ)) = 0` for the multipliers `λ`. The function has kinks where
a component reaches its bound, so this is a semismooth Newton method (L. Qi and J. Sun, "A nonsmooth
version of Newton's method", *Mathematical Programming* 58 (1993), 353-367): at a kink it takes the
derivative from one side.

If the constraints are linear, this is the dual of a quadratic program, whose solution is the
nearest point within the bounds.
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

from .._constants import AT_BOUND
from .._printing import is_traced
from .._step.equations import Equations
from .._step.implicit import Along, solution
from .._step.iterate import Solved, bounded
from .._step.metric import positive_weights, spread
from .base import AbstractProjection, has_bounds
from .options import check_options, option


class Bounds(eqx.Module):
    """Bounds, as vectors like the state."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def clip(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        # A component exactly at its bound has the derivative one, that from inside. The derivative
        # of `jnp.clip` there is another.
        nothing = z - jax.lax.stop_gradient(z)  # zero, but with the derivative one
        lower, upper = (x + AT_BOUND * nothing for x in (self.lower, self.upper))
        clipped = jnp.where(z < self.lower, lower, jnp.where(z > self.upper, upper, z))
        return jnp.where(self.lower <= self.upper, clipped, jnp.nan)

    def compose(self, equations: Equations) -> Equations:
        """The equations of a manifold as functions of `z`."""
        parts = tuple(eqx.Partial(_clipped, self, part) for part in equations.parts)
        return dataclasses.replace(equations, parts=parts, clip=self.clip)


def _clipped(bounds: Bounds, part: Callable[[Array], Array], z: Array) -> Array:
    return part(bounds.clip(z))


def project_within(
    bounds: Bounds, equations: Equations, candidate: Float[Array, " n"], *, max_steps: int
) -> Solved:
    """The projection along the gradients at the candidate, within bounds: the vector `z`, whose
    `clip` is the state.

    The candidate may be beyond the bounds, and so may `z`. The gradients are those at the candidate
    without the clip. A component that reaches its bound costs a step, so there may be twice as many
    of them.
    """
    rows = equations.in_units(equations.linearise(candidate)[1])
    within = bounds.compose(equations)
    return solution(Along(within, candidate, rows, iteration=bounded, max_steps=2 * max_steps))


class AbstractNewton(AbstractProjection):
    """The options that the Newton iterations share."""

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    metric: PyTree[Any] | None = option(None, converter=positive_weights)
    lower: PyTree[ArrayLike] | None = option(None)
    upper: PyTree[ArrayLike] | None = option(None)
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_options(self)
        check_bounds(self.lower, self.upper)

    def bounds(self, like: Any) -> Bounds | None:
        """The bounds for a state of given shapes, `None` if there are none."""
        if not has_bounds(self):
            return None
        low = -np.inf if self.lower is None else self.lower
        high = np.inf if self.upper is None else self.upper
        return Bounds(spread("lower", low, like), spread("upper", high, like))


def nearest_within(
    projection: AbstractProjection, like: Any, y: Float[Array, " n"]
) -> Float[Array, " n"]:
    """The nearest vector to `y` within the bounds of a projection, or of all of its stages."""
    parts = jtu.tree_leaves(projection, is_leaf=lambda x: isinstance(x, AbstractNewton))
    for part in parts:
        bounds = part.bounds(like) if isinstance(part, AbstractNewton) else None
        y = y if bounds is None else bounds.clip(y)
    return y


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, as far as both are known and have the same
    structure. If one is a tracer, `Bounds.clip` returns NaN instead."""
    for a, b in zip(jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=False):
        if not is_traced((a, b)) and not np.all(np.asarray(a) <= np.asarray(b)):
            raise ValueError(f"`lower` is {lower}, but it must be at most `upper`, {upper}.")
