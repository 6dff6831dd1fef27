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

from .._constants import AT_BOUND, MAX_STEPS
from .._printing import is_traced
from .._step.equations import Equations
from .._step.implicit import Along, solution
from .._step.iterate import Solved, bounded
from .._step.metric import positive_weights, spread
from .base import AbstractProjection
from .options import check_options, option


class Bounds(eqx.Module):
    """Bounds, as vectors like the state."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    @classmethod
    def of(cls, lower: Any, upper: Any, like: Any) -> "Bounds":
        """The bounds of a state of given shapes, of which `None` is none."""
        low = -np.inf if lower is None else lower
        high = np.inf if upper is None else upper
        return cls(spread("lower", low, like), spread("upper", high, like))

    def clip(self, z: Float[Array, " n"], *, slope: float = AT_BOUND) -> Float[Array, " n"]:
        """`z` within the bounds, with the derivative `slope` where it is beyond them. A component
        exactly at its bound has the derivative one, that from inside, unlike in `jnp.clip`."""
        lower, upper = self.lower, self.upper
        if slope:
            nothing = z - jax.lax.stop_gradient(z)  # zero, but with the derivative one
            lower, upper = lower + slope * nothing, upper + slope * nothing
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
    rows = equations.factor.of_rows(equations.linearise(candidate)[1])
    within = bounds.compose(equations)
    return solution(Along(within, candidate, rows, iteration=bounded, max_steps=2 * max_steps))


class AbstractNewton(AbstractProjection):
    """The options that the Newton iterations share."""

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(MAX_STEPS, static=True)
    metric: PyTree[Any] | None = option(None, converter=positive_weights)
    lower: PyTree[ArrayLike] | None = option(None)
    upper: PyTree[ArrayLike] | None = option(None)
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_options(self)
        check_bounds(self.lower, self.upper)

    def bounds(self, like: Any) -> Bounds | None:
        """The bounds for a state of given shapes, `None` if there are none."""
        return Bounds.of(self.lower, self.upper, like) if bounded_parts(self) else None


def bounded_parts(projection: AbstractProjection) -> list[AbstractNewton]:
    """The projection and its stages, as far as they have bounds."""
    is_newton = lambda x: isinstance(x, AbstractNewton)  # noqa: E731
    parts = filter(is_newton, jtu.tree_leaves(projection, is_leaf=is_newton))
    return [x for x in parts if x.lower is not None or x.upper is not None]


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, as far as both are known and have the same
    structure. If one is a tracer, `Bounds.clip` returns NaN instead."""
    for a, b in zip(jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=False):
        if not is_traced((a, b)) and not np.all(np.asarray(a) <= np.asarray(b)):
            raise ValueError(f"`lower` is {lower}, but it must be at most `upper`, {upper}.")
