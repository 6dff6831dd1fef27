"""Projection within bounds: the constraints as functions of a vector `z`, where `y = clip(z)`.

The iteration solves `g(clip(ŷ + s Uᵀ λ)) = 0` for the multipliers `λ`. The function has kinks where
a component reaches its bound, so this is a semismooth Newton method (L. Qi and J. Sun, "A nonsmooth
version of Newton's method", *Mathematical Programming* 58 (1993), 353-367): at a kink it takes the
derivative from one side.

If the constraints are linear, this is the dual of a quadratic program, whose solution is the
nearest point within the bounds. The residual is then the gradient of a function of the multipliers
that is convex and has kinks. Newton's method for its minimum may go round in a circle if it makes
full steps across kinks, so each iteration looks for the minimum along its step.
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
from .chord import Iterate, Solved, after_test, counter
from .elimination import combined, eliminated, gram_matrix, gram_solve, scaled_rows
from .equations import Equations, Jacobian, any_lane
from .implicit import project_along
from .metric import positive_weights, spread
from .options import check_options, option

# Beyond its bound a component is constant, but `clip` has this derivative there. With zero, a
# constraint whose components are all at bounds would have no gradient, and would never be met. The
# number is a choice: it is negligible beside the derivative one of the other components.
_AT_BOUND = 1e-10
# So many bisections find the minimum along a step to 1e-9 of its length.
_HALVINGS = 30
# A full step is kept if it ends just past the minimum, where the slope has the opposite sign, but
# is at most this share of the slope at the start. Bisection would not make it better.
_JUST_PAST = 1e-3
# A component that an iteration reduces to this share of itself is set to zero. The share is larger
# than in `chord`, because a shortened step is known to 1e-9 of its length only.
_VANISHES = 1e-8
# Once the residuals are within the tolerance, up to this many more iterations are made, because at
# a kink one iteration can leave the manifold again.
_EXTRA = 4


class Box(eqx.Module):
    """Bounds, as vectors like the state."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def clip(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        # A component exactly at its bound has the derivative one, that from inside. The derivative
        # of `jnp.clip` there is another.
        nothing = z - jax.lax.stop_gradient(z)  # zero, but with the derivative one
        lower, upper = (x + _AT_BOUND * nothing for x in (self.lower, self.upper))
        clipped = jnp.where(z < self.lower, lower, jnp.where(z > self.upper, upper, z))
        return jnp.where(self.lower <= self.upper, clipped, jnp.nan)

    def compose(self, equations: Equations) -> Equations:
        """The equations of a manifold as functions of `z`."""
        parts = tuple(eqx.Partial(_clipped, self, part) for part in equations.parts)
        return dataclasses.replace(equations, parts=parts, clip=self.clip)


def _clipped(box: Box, part: Callable[[Array], Array], z: Array) -> Array:
    return part(box.clip(z))


def project_within(
    box: Box, equations: Equations, candidate: Float[Array, " n"], *, max_steps: int
) -> Solved:
    """The projection along the gradients at the candidate, within bounds.

    The candidate may be beyond the bounds, and so may `z`. The gradients are those at the candidate
    without the clip. A component that reaches its bound costs an iteration, so there may be twice
    as many of them.
    """
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

    def body(now: Iterate) -> Iterate:
        z = now.y
        g, jacobian = lax.optimization_barrier(equations.linearise(z))
        level, _ = equations.level(g, equations.scale(jacobian, z))
        left = after_test(level, now.left, extra=_EXTRA, gives_up=now.left > 0)
        sizes, rows = scaled_rows(equations.scaled(jacobian))
        gram, right = gram_matrix(rows, directions), g / sizes
        # Residuals that are noise are corrected too, unlike in `chord`. Components at their bounds
        # couple the constraints, so that a residual which is noise for one constraint may be what
        # another needs.
        change = equations.moved(combined(*eliminated(gram, right, directions)))
        share = _share(equations, z, gram_solve(gram, right), change)
        rest = z - share * change
        rest = jnp.where(jnp.abs(rest) <= _VANISHES * jnp.abs(z), 0, rest)
        return Iterate(jnp.where(left > 0, rest, z), left, now.num_steps + (left > 0).astype(int))

    start = Iterate(candidate, counter(max_steps), jnp.asarray(0))
    end = lax.while_loop(lambda now: any_lane(now.left > 0), body, start)
    return Solved(end.y, end.left != -1, end.num_steps)


def _share(equations: Equations, z: Array, multiplier: Array, change: Array) -> Array:
    """The share of a step at which the convex function is least. Its slope along the step is the
    product of the residual with the step of the multipliers, and the share is found by bisection
    of this slope."""

    def falls(share: Array) -> Array:
        return jnp.sum(multiplier * equations.residual(z - share * change)) >= 0

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = ends
        middle = (a + b) / 2
        further = falls(middle)
        return jnp.where(further, middle, a), jnp.where(further, b, middle)

    one = jnp.ones((), z.dtype)
    _, end = lax.fori_loop(0, _HALVINGS, halve, (0 * one, one))
    # A step that stays within the bounds crosses no kink, so it is made in full. So is one that
    # ends just past the minimum.
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
        """The bounds for a state of given shapes, `None` if there are none."""
        if not has_bounds(self):
            return None
        low = -np.inf if self.lower is None else self.lower
        high = np.inf if self.upper is None else self.upper
        return Box(spread("lower", low, like), spread("upper", high, like))


def nearest_within(
    projection: AbstractProjection, like: Any, y: Float[Array, " n"]
) -> Float[Array, " n"]:
    """The nearest vector to `y` within the bounds of a projection, or of all of its stages."""
    parts = jtu.tree_leaves(projection, is_leaf=lambda x: isinstance(x, AbstractNewton))
    for part in parts:
        box = part.box(like) if isinstance(part, AbstractNewton) else None
        y = y if box is None else box.clip(y)
    return y


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, as far as both are known and have the same
    structure. If one is a tracer, `Box.clip` returns NaN instead."""
    for a, b in zip(jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=False):
        if not is_traced((a, b)) and not np.all(np.asarray(a) <= np.asarray(b)):
            raise ValueError(f"`lower` is {lower}, but it must be at most `upper`, {upper}.")
