"""Projection to a manifold and a box, by a semismooth Newton iteration on the multipliers.

`y = clip(ŷ + M⁻¹ Bᵀ λ)` with `g(y) = 0`, where `B` is the constraint Jacobian at the candidate or,
for the nearest point, at `y`. For linear constraints this is a quadratic program, whose dual is
convex and once differentiable: Newton's method with a line search converges globally (L. Qi and D.
Sun, "A nonsmooth version of Newton's method", 1993). For nonlinear constraints a sequence of such
programs is solved, each with the constraints linearised about the last state.
"""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

from .._custom_types import Y
from .._tree import (
    tree_add,
    tree_dot,
    tree_max,
    tree_mul,
    tree_scale,
    tree_sub,
    working_dtype,
)
from .base import check_like
from .elimination import Vector
from .equations import Equations, ProjectionInfo
from .implicit import differentiated
from .jacobian import AbstractJacobian
from .linearise import linearise
from .residual import largest, relative

# For one quadratic program: the largest number of Newton steps, and the number of bisections in the
# line search of each.
_INNER_STEPS, _HALVINGS = 100, 30
# Relative weights in the Gram matrix of a component beyond its bound, used in alternate steps: with
# weight zero a constraint all of whose components are at bounds would never change. With either
# value alone, one in some thousand random programs with nearly contradictory bounds and balances
# failed.
_AT_BOUND = (1e-8, 1e-4)


class Box(eqx.Module):
    """Bounds, shaped like the state."""

    lower: Y
    upper: Y

    def clip(self, y: Y) -> Y:
        def clip(x: Array, a: Array, b: Array) -> Array:
            # At a bound the derivative is taken from inside, so not by `jnp.clip`.
            inside = jnp.where(x < a, a, jnp.where(x > b, b, x))
            return jnp.where(jnp.isnan(a) | jnp.isnan(b), jnp.nan, inside)

        return jtu.tree_map(clip, y, self.lower, self.upper)

    def inside(self, y: Y) -> Y:
        """1 where a component is within its bounds, otherwise 0."""
        return jtu.tree_map(
            lambda x, a, b: ((x >= a) & (x <= b)).astype(x.dtype), y, self.lower, self.upper
        )


def box_of(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None, y: Y) -> Box | None:
    """The box for the options `lower` and `upper`, or `None` if neither is given."""
    if lower is None and upper is None:
        return None
    return Box(_bound("lower", lower, -np.inf, y), _bound("upper", upper, np.inf, y))


def _bound(name: str, bound: PyTree[ArrayLike] | None, default: float, y: Y) -> Y:
    leaves = [default] if bound is None else jtu.tree_leaves(bound)
    single = bound is None or jtu.treedef_is_leaf(jtu.tree_structure(bound))
    if single and jnp.ndim(leaves[0]) == 0:
        return jtu.tree_map(lambda x: jnp.full_like(x, leaves[0]), y)
    remedy = "Give one number, or one bound (or an array) for each leaf of the state."
    check_like(name, bound, y, remedy)
    return jtu.tree_map(lambda a, x: jnp.broadcast_to(jnp.asarray(a, x.dtype), x.shape), bound, y)


def check_bounds(lower: PyTree[ArrayLike] | None, upper: PyTree[ArrayLike] | None) -> None:
    """Raises if a lower bound is above its upper bound, where both are known."""
    leaves = [jtu.tree_leaves(x) for x in (lower, upper)]
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


class _Carry(NamedTuple):
    unfinished: Bool[Array, ""]
    last: Array
    y: Y
    multiplier: Vector
    num_steps: Int[Array, ""]


Unbounded = Callable[[Equations], tuple[Y, Vector, ProjectionInfo]]


@eqx.filter_custom_jvp
def project_into(
    equations: Equations, box: Box, *, unbounded: Unbounded, frozen: bool, max_steps: int
) -> tuple[Y, Vector, ProjectionInfo]:
    """The state, its multipliers and the report. If the result of the `unbounded` projection is
    within the box, it is returned."""
    candidate = equations.candidate
    free, free_multiplier, free_info = unbounded(equations)
    within_box = ft.reduce(jnp.logical_and, map(jnp.all, jtu.tree_leaves(box.inside(free))))
    settled = free_info.ok & within_box
    before, at_candidate = linearise(equations.residual, candidate)
    eps, tiny = (float(getattr(jnp.finfo(working_dtype(candidate)), x)) for x in ("eps", "tiny"))

    def body(carry: _Carry) -> _Carry:
        _, last, y, multiplier, count = carry
        g, at_y = linearise(equations.residual, y)
        base = at_candidate if frozen else at_y
        multiplier = _quadratic_program(equations, box, base, g, y, multiplier)
        trial, multiplier = _polished(equations, box, base, multiplier)
        after, jacobian = linearise(equations.residual, trial)
        scale = equations.scale(jacobian, trial)
        satisfied = equations.safely_satisfied(after, scale)
        if frozen:
            left = largest(relative(after, scale))
            unfinished = ~satisfied & (left < last)
        else:  # until the state no longer moves towards the nearest point
            left = tree_max(tree_sub(trial, y)) / jnp.maximum(tree_max(trial), tiny)
            unfinished = (left > 16 * eps) & (~satisfied | (left < 0.5 * last)) & (left < jnp.inf)
        return _Carry(unfinished & (count + 1 < max_steps), left, trial, multiplier, count + 1)

    zeros = jtu.tree_map(jnp.zeros_like, before)
    infinite = jnp.asarray(jnp.inf, working_dtype(candidate))
    start = _Carry(~settled, infinite, box.clip(candidate), zeros, jnp.asarray(0))
    end = lax.while_loop(lambda carry: carry.unfinished, body, start)

    def choose(a: PyTree[Array], b: PyTree[Array]) -> PyTree[Array]:
        return jtu.tree_map(lambda a, b: jnp.where(settled, a, b), a, b)

    y, count = choose((free, free_info.num_steps), (end.y, end.num_steps))
    rank = at_candidate.gram_solver(equations.weights).rank
    info = equations.report(y, before, equations.measure(y), count, rank)
    # Only the nearest point has a derivative.
    moving = jnp.asarray(False) if frozen else end.last > eps**0.5
    multiplier = jtu.tree_map(lambda x: jnp.where(moving, jnp.nan, x), end.multiplier)
    return y, choose(free_multiplier, multiplier), info


def _polished(
    equations: Equations, box: Box, base: AbstractJacobian, multiplier: Vector
) -> tuple[Y, Vector]:
    """The state for these multipliers after two further corrections, and the corrected multipliers:
    without them a component much smaller than its candidate only has the absolute accuracy of the
    candidate."""
    z = tree_add(equations.candidate, equations.correction(base, multiplier))
    y, active = box.clip(z), tree_mul(equations.weights, box.inside(z))
    gram_solver = equations.gram_solver(base, weights=active)
    for _ in range(2):
        change = gram_solver.solve(equations.residual(y))
        y = box.clip(tree_sub(y, tree_mul(base.pullback(change), active)))
        multiplier = tree_sub(multiplier, change)
    return y, multiplier


def _quadratic_program(
    equations: Equations, box: Box, base: AbstractJacobian, g: Vector, y: Y, multiplier: Vector
) -> Vector:
    """The multipliers of the nearest point of the box with `g + B (x - y) = 0`.

    They minimise a convex function whose gradient is this residual. Only the gradient is used: in
    the value of the function, small components of the state would be lost in roundoff.
    """
    candidate, weights = equations.candidate, equations.weights
    dtype = working_dtype(candidate)
    scale = equations.scale(base, y)

    def body(carry: tuple[Array, Vector, Array]) -> tuple[Array, Vector, Array]:
        _, multiplier, count = carry
        z = tree_add(candidate, equations.correction(base, multiplier))
        x = box.clip(z)
        gradient = jtu.tree_map(jnp.add, base.pushforward(tree_sub(x, y)), g)
        merit = largest(relative(gradient, scale))
        share = jnp.where(count % 2 == 0, *_AT_BOUND)
        active = jtu.tree_map(
            lambda w, i: w * (i + share.astype(w.dtype) * (1 - i)), weights, box.inside(z)
        )
        gram_solver = equations.gram_solver(base, weights=active)
        change = jtu.tree_map(jnp.negative, gram_solver.solve(gradient))
        pull = base.pullback(change)
        step = tree_mul(pull, weights)
        slope = tree_dot(gradient, change, dtype)

        def slope_at(length: Array) -> Array:
            """The derivative of the function along the step, which increases with the length."""
            moved = tree_sub(box.clip(tree_add(z, tree_scale(length, step))), x)
            return slope + tree_dot(pull, moved, dtype)

        length = _least(slope_at, dtype)
        multiplier = tree_add(multiplier, tree_scale(length, change))
        unfinished = (merit > float(jnp.finfo(dtype).eps)) & (slope < 0) & (merit < jnp.inf)
        return unfinished & (count + 1 < _INNER_STEPS), multiplier, count + 1

    start = jnp.asarray(True), multiplier, jnp.asarray(0)
    return lax.while_loop(lambda carry: carry[0], body, start)[1]


def _least(slope_at: Callable[[Array], Array], dtype: jnp.dtype) -> Array:
    """The zero in [0, 1] of an increasing slope, by bisection; 1 if the slope is negative there."""

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = ends
        middle = (a + b) / 2
        falls = slope_at(middle) < 0
        return jnp.where(falls, middle, a), jnp.where(falls, b, middle)

    one = jnp.ones((), dtype)
    # A full step that ends just past the minimum is accepted too.
    good = slope_at(one) <= 1e-3 * jnp.abs(slope_at(jnp.zeros((), dtype)))
    _, b = lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros((), dtype), one))
    return jnp.where(good, one, b)


@project_into.def_jvp
def _project_into_jvp(primals, tangents, *, unbounded, frozen, max_steps):
    solution = project_into(*primals, unbounded=unbounded, frozen=frozen, max_steps=max_steps)
    return differentiated(solution, primals, tangents, frozen=frozen)
