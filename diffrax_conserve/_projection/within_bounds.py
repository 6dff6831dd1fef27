"""Projection within bounds: the constraints as functions of a vector `z`, where `y = clip(z)`.

The iteration solves `g(clip(ŷ + S Uᵀ λ)) = 0` for the multipliers `λ`. The function has kinks where
a component reaches its bound, so this is a semismooth Newton method (L. Qi and J. Sun, "A nonsmooth
version of Newton's method", *Mathematical Programming* 58 (1993), 353-367): at a kink it takes the
derivative from one side.

If the constraints are linear, this is the dual of a quadratic program, whose solution is the
nearest point within the bounds.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._constants import MAX_STEPS, SLOPE_BEYOND_BOUNDS
from .._numerics.implicit import MultiplierSystem, implicit_solution
from .._numerics.iterate import Solved, semismooth_newton, simplified_newton
from .._numerics.metric import broadcast_option, positive_weights
from .._numerics.problem import Problem
from .._options import check_numbers
from .._printing import is_traced
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
        return cls(broadcast_option("lower", low, like), broadcast_option("upper", high, like))

    def clip(
        self, z: Float[Array, " n"], *, slope: float = SLOPE_BEYOND_BOUNDS
    ) -> Float[Array, " n"]:
        """`z` within the bounds, with the derivative `slope` where it is beyond them. A component
        exactly at its bound has the derivative one, that from inside, unlike in `jnp.clip`."""
        lower, upper = self.lower, self.upper
        if slope:
            zero = z - jax.lax.stop_gradient(z)  # zero, but with the derivative one
            lower, upper = lower + slope * zero, upper + slope * zero
        clipped = jnp.where(z < self.lower, lower, jnp.where(z > self.upper, upper, z))
        return jnp.where(self.lower <= self.upper, clipped, jnp.nan)


def _clipped(bounds: Bounds, fn: Callable[[Array], Array], z: Array) -> Array:
    return fn(bounds.clip(z))


def along_gradients(
    bounds: Bounds | None,
    problem: Problem,
    candidate: Float[Array, " n"],
    *,
    max_steps: int,
    iteration: Callable[..., Solved] = simplified_newton,
) -> Solved:
    """The projection along the gradients, by an `iteration`; within bounds, if there are any, by a
    semismooth Newton method, which returns a vector `z`, whose `clip` is the state.

    The candidate may be beyond the bounds, and so may `z`. The gradients are those at the candidate
    without the clip. A component that reaches its bound costs an iteration, so twice as many
    iterations are allowed.
    """
    if bounds is None:
        return implicit_solution(
            MultiplierSystem(problem, candidate, iteration=iteration, max_steps=max_steps)
        )
    rows = problem.factor.scaled_rows(problem.linearise(candidate)[1])
    functions = tuple(eqx.Partial(_clipped, bounds, fn) for fn in problem.functions)
    within = dataclasses.replace(problem, functions=functions, clip=bounds.clip)
    return implicit_solution(
        MultiplierSystem(
            within, candidate, rows, iteration=semismooth_newton, max_steps=2 * max_steps
        )
    )


class AbstractNewton(AbstractProjection):
    """The options that the Newton iterations share."""

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(MAX_STEPS, static=True)
    metric: PyTree[Any] | None = option(None, converter=positive_weights)
    lower: PyTree[ArrayLike] | None = option(None)
    upper: PyTree[ArrayLike] | None = option(None)
    sees_step: ClassVar[bool] = False
    follows_gradients: ClassVar[bool] = True

    def __check_init__(self):
        check_options(self)
        check_bounds(self.lower, self.upper)

    def bounds(self, like: Any) -> Bounds | None:
        """The bounds for a state of given shapes, `None` if there are none."""
        return Bounds.of(self.lower, self.upper, like) if self.has_bounds else None

    @property
    def has_bounds(self) -> bool:
        return self.lower is not None or self.upper is not None

    def clip(self, y: Float[Array, " n"], like: Any) -> Float[Array, " n"]:
        return y if (bounds := self.bounds(like)) is None else bounds.clip(y)


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, as far as both are known and have the same
    structure. If one is a tracer, `Bounds.clip` returns NaN instead."""
    for name, bound in (("lower", lower), ("upper", upper)):
        check_numbers(name, bound, least=-math.inf)
    for a, b in zip(jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=False):
        if not is_traced((a, b)) and not np.all(np.asarray(a) <= np.asarray(b)):
            raise ValueError(f"`lower` is {lower}, but it must be at most `upper`, {upper}.")
