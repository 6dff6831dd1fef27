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
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._constants import MAX_STEPS, SLOPE_BEYOND_BOUNDS
from .._numerics.implicit import MultiplierSystem, implicit_solution
from .._numerics.iterate import Solved, semismooth_newton, simplified_newton
from .._numerics.metric import broadcast_option, positive_weights
from .._numerics.problem import Problem
from .._numerics.rows import AbstractRows
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

    def clip(self, z: Float[Array, " n"], *, slope: float = 0.0) -> Float[Array, " n"]:
        """`z` within the bounds, with the derivative `slope` where it is beyond them. A component
        exactly at its bound has the derivative one, that from inside, unlike in `jnp.clip`."""
        lower, upper = self.lower, self.upper
        if slope:
            zero = z - jax.lax.stop_gradient(z)  # zero, but with the derivative one
            lower, upper = lower + slope * zero, upper + slope * zero
        clipped = jnp.where(z < self.lower, lower, jnp.where(z > self.upper, upper, z))
        return jnp.where(self.lower <= self.upper, clipped, jnp.nan)

    def corrected(self, z: Float[Array, " n"], rows: AbstractRows) -> Bool[Array, " n"]:
        """The components to which the derivative of a projection adds a correction: those strictly
        within the bounds, and all of a constraint that contains none of these.

        The derivative of a component that rests at its bound is that of the candidate. While it
        rests, steps may be far too long for its stiffness, and multiply its derivative by large
        numbers. So if it is zero, it must stay zero, without roundoff of a correction."""
        within = (self.lower < z) & (z < self.upper)
        contain = rows.scale_columns(within.astype(z.dtype)).largest_in_rows() > 0
        others = rows.divide_rows(jnp.where(contain, jnp.inf, 1)).largest_in_columns() > 0
        return within | others


def _clipped(bounds: Bounds, fn: Callable[[Array], Array], slope: float, z: Array) -> Array:
    return fn(bounds.clip(z, slope=slope))


def _semismooth_newton(problem: Problem, *given: Any, max_steps: int) -> Solved:
    """The iteration, for functions that have a derivative beyond the bounds."""
    functions: Any = problem.functions
    sloping = [eqx.Partial(_clipped, *fn.args[:2], SLOPE_BEYOND_BOUNDS) for fn in functions]
    problem = dataclasses.replace(problem, functions=tuple(sloping))
    return semismooth_newton(problem, *given, max_steps=max_steps)


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
    functions = tuple(eqx.Partial(_clipped, bounds, fn, 0.0) for fn in problem.functions)
    within = dataclasses.replace(problem, functions=functions, clip=bounds.clip)
    return implicit_solution(
        MultiplierSystem(
            within,
            candidate,
            rows,
            corrected=bounds.corrected,
            iteration=_semismooth_newton,
            max_steps=2 * max_steps,
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
