"""Bounds: the constraints as functions of `z`, where `y = clip(z)`.

The iteration solves `g(clip(ŷ + s Uᵀ λ)) = 0` by a semismooth Newton method (L. Qi and D. Sun, "A
nonsmooth version of Newton's method", 1993). For linear constraints this is the dual of a quadratic
program, whose solution is the nearest point within the bounds: the residual is the gradient of a
convex function of the multipliers with kinks, and each iteration looks for the minimum along its
step.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._printing import is_traced
from .base import AbstractProjection, has_bounds
from .chord import Solved, after_test, counter
from .elimination import combined, eliminated, gram_matrix, gram_solve, scaled_rows
from .equations import Equations, Jacobian, any_lane
from .implicit import project_along
from .metric import positive_weights, spread
from .options import check_options, option

# A component beyond its bound has this derivative: with zero, a constraint all of whose components
# are at bounds would never change.
_AT_BOUND = 1e-10
# The bisections of a step where it must be shortened, and how far past the minimum, as a share of
# the first slope, a full step may end.
_HALVINGS, _JUST_PAST = 30, 1e-3
# A component that an iteration reduces to this share of itself is zero.
_VANISHES = 1e-8
# Within the tolerance up to this many more iterations are made, because at a kink one can leave the
# manifold again.
_EXTRA = 4


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
    """The projection along the gradients at the candidate, within bounds."""
    rows = equations.scaled(equations.linearise(candidate)[1])
    options: Any = dict(max_steps=2 * max_steps, solve=_semismooth)
    z, ok, count = project_along(box.compose(equations), candidate, rows, **options)
    return Solved(box.clip(z), ok, count)


def _semismooth(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Jacobian,
    *,
    max_steps: int,
) -> Solved:
    """The iteration for a vector `z` without bounds, where `clip(z)` is the state."""

    def body(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        z, left, count = carry
        g, jacobian = lax.optimization_barrier(equations.linearise(z))
        level, _ = equations.level(g, equations.scale(jacobian, z))
        left = after_test(level, left, extra=_EXTRA, gives_up=left > 0)
        sizes, rows = scaled_rows(equations.scaled(jacobian))
        gram, right = gram_matrix(rows, directions), g / sizes
        # What is noise for one constraint may be needed for another, so none is left out.
        change = equations.moved(combined(*eliminated(gram, right, directions)))
        share = _share(equations, z, gram_solve(gram, right), change)
        rest = z - share * change
        rest = jnp.where(jnp.abs(rest) <= _VANISHES * jnp.abs(z), 0, rest)
        return jnp.where(left > 0, rest, z), left, count + (left > 0).astype(int)

    start = candidate, counter(max_steps), jnp.asarray(0)
    z, left, count = lax.while_loop(lambda x: any_lane(x[1] > 0), body, start)
    return Solved(z, left != -1, count)


def _share(equations: Equations, z: Array, multiplier: Array, change: Array) -> Array:
    """The share of a step at which the convex function is least, by bisection of its slope."""

    def falls(length: Array) -> Array:
        return jnp.sum(multiplier * equations.residual(z - length * change)) >= 0

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = ends
        middle = (a + b) / 2
        further = falls(middle)
        return jnp.where(further, middle, a), jnp.where(further, b, middle)

    one = jnp.ones((), z.dtype)
    _, end = lax.fori_loop(0, _HALVINGS, halve, (0 * one, one))
    # A full step is taken within the bounds, and if it ends just past the minimum.
    clip = equations.clip or (lambda z: z)
    inside = jnp.all(clip(z) == z) & jnp.all(clip(z - change) == z - change)
    last = jnp.sum(multiplier * equations.residual(z - change))
    first = jnp.sum(multiplier * equations.residual(z))
    return jnp.where(inside | (last >= -_JUST_PAST * first), one, end)


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
