"""The iterations that lead to the manifold: one loop, and the steps that it can make.

All are Newton's method, for at least as many unknowns as equations. They differ in their steps, so
a step is a function of the unknowns and of a counter, and the loop around it is written once, in
`iterate`. In this file a step is one of an iteration, unless it is called a step of the solver.

- `simplified_newton` is for candidates as near as the local error of a solver's step (Hairer,
  Lubich and Wanner, IV.4, (4.4) to (4.6)). It looks for multipliers `λ` such that `y = ŷ + S Uᵀ λ`
  is on the manifold, for the candidate `ŷ`, the factor `S` of the metric `M⁻¹ = S Sᵀ`, and the
  gradients `U = G(ŷ) S` at the candidate. As these directions are fixed, the result is a function
  of the candidate and of the multipliers, and has a derivative by the implicit function theorem;
  see `implicit`. For up to four constraints the matrix `G(y) S Uᵀ` of a step is evaluated at the
  last state, so that the iteration is Newton's method; for more it is evaluated at the candidate.
- `projected_newton` is `simplified_newton` within bounds.
- `damped_newton` is for starts far away. Each step is the shortest, in the metric, that solves the
  equations linearised at the last state (P. Deuflhard, *Newton Methods for Nonlinear Problems*,
  Springer 2004, Section 4.4). A step that increases the largest residual, or leaves the domain of a
  function, is shortened until it does not.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int

from .._constants import AT_BOUND, BACKTRACKING_FACTOR, FROZEN_STEPS, ROUNDOFF, WRITTEN_OUT
from .._fast.scalars import alone_or_in_lanes, joined, written_out_loop
from .linear import in_order, order_of, roundoff_pivot
from .problem import (
    ABOVE_TOLERANCE,
    AT_ROUNDOFF,
    NOT_FINITE,
    WITHIN_TOLERANCE,
    Problem,
    relative,
)
from .rows import AbstractRows, DenseRows

# A step of an iteration: the unknowns and the counter after it.
Advance = Callable[[Any, Array], tuple[Any, Array]]


class Solved(NamedTuple):
    """What an iteration has found.

    - `y`: the unknowns. In a projection they are the state.
    - `ok`: whether they solve the equations.
    - `num_iterations`: the number of steps.
    - `more`: what else was found, without a derivative.
    """

    y: Any
    ok: Bool[Array, ""]
    num_iterations: Int[Array, ""]
    more: Any = None


# ---- The loop ----


class _Now(NamedTuple):
    """What the loop carries. It carries little, because for small systems moving the carry costs
    more than the arithmetic."""

    y: Any
    counter: Array
    num_iterations: Array


def iterate(advance: Advance, y: Any, *, max_steps: int) -> Solved:
    """Advances the unknowns until the counter says that they are done.

    The counter is the number of tests that are left. The unknowns are tested before each step and
    after the last one, so that there is one more test than there are steps. When the iteration
    ends, the counter is zero if the unknowns passed their last test, and -1 if they did not.
    `after_test` computes it.

    The lanes of a batch advance together until none goes on. So `advance` must leave unknowns that
    are done, for which the counter is not positive, as they are.
    """

    def body(now: _Now) -> _Now:
        y, counter = advance(now.y, now.counter)
        return _Now(y, counter, now.num_iterations + (counter > 0).astype(int))

    start = _Now(y, tests(max_steps), jnp.asarray(0))
    end = lax.while_loop(lambda now: any_lane(now.counter > 0), body, start)
    return Solved(end.y, end.counter == 0, end.num_iterations)


def tests(max_steps: int) -> Int[Array, ""]:
    """The counter at the start of an iteration, in a byte if it fits."""
    fits = max_steps + 1 < jnp.iinfo(jnp.int8).max
    return jnp.asarray(max_steps + 1, jnp.int8 if fits else jnp.int32)


def after_test(level: Array, counter: Array, *, polish: bool = True) -> Array:
    """The counter after unknowns of this `level` were tested.

    Unknowns that are settled are done. Of those that are merely within the tolerance, one more step
    brings the residual to roundoff, where `polish` asks for it; should that step leave the
    tolerance, another tries to return to it. A residual that is not finite cannot recover, but one
    more step takes the NaN to the unknowns, where everybody sees it. If no test is left and the
    unknowns do not solve the equations, the iteration has failed.
    """
    then = jnp.where(level == NOT_FINITE, jnp.minimum(counter - 1, 1), counter - 1)
    then = jnp.where((level < WITHIN_TOLERANCE) & (then == 0), -1, then)
    then = jnp.where(level == WITHIN_TOLERANCE, jnp.where(counter > 2, 2, 0) if polish else 0, then)
    then = jnp.where(level == AT_ROUNDOFF, 0, then)
    return jnp.where(counter > 0, then, counter).astype(counter.dtype)


def after_step(settled: Array, hopeful: Array, counter: Array) -> Array:
    """The counter after a step, in an iteration that tests not the unknowns but the lengths of its
    steps: `settled` if the step was so short that it is the last, `hopeful` if another may help."""
    then = jnp.where(settled, 0, jnp.where(hopeful & (counter > 1), counter - 1, -1))
    return jnp.where(counter > 0, then, counter).astype(counter.dtype)


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether the flag of any lane of a batch is set, for the conditions of loops and branches.

    If the condition of a `while_loop` differs from lane to lane, `vmap` adds a select for each
    array in the carry, which keeps the lanes that are done. With this condition, which is the same
    for all lanes, it adds none. A branch with such a condition remains a branch.
    """
    return flag


@any_lane.def_vmap
def _any_lane(size: int, axes: Any, flags: Bool[Array, " lanes"]) -> tuple[Array, bool]:
    del size, axes
    return any_lane(jnp.any(flags)), False


def keep_done(counter: Array, moved: Any, y: Any) -> Any:
    """The moved unknowns where the iteration goes on, and the others where it is done."""
    return jtu.tree_map(lambda a, b: jnp.where(counter > 0, a, b), moved, y)


# ---- For candidates nearby ----


def simplified_newton(
    problem: Problem,
    candidate: Float[Array, " n"],
    directions: DenseRows | None = None,
    *,
    max_steps: int,
) -> Solved:
    """The state `ŷ + S Uᵀ λ` on the manifold. The rows of `U` are the gradients at the candidate.
    Up to four constraints may have other `directions` instead; without them the rows are the
    gradients at each state, if those at the candidate have failed for `FROZEN_STEPS` steps."""
    if problem.magnitude.size > WRITTEN_OUT:
        return _of_many(problem, candidate, max_steps)
    return alone_or_in_lanes(ft.partial(_of_few, max_steps=max_steps))(
        (problem, candidate, directions)
    )


def _of_few(given: Any, lanes: bool, *, max_steps: int) -> Solved:
    """Each step has a Jacobian and an elimination of its own. In the lanes of a batch it is written
    out in scalars, which XLA fuses to one kernel; alone it is fastest in arrays."""
    problem, candidate, directions = given
    dtype = problem.magnitude.dtype
    roundoff = roundoff_pivot(dtype)

    def shared(y: Any) -> Any:
        """What the steps share: the order in which they eliminate the constraints, and in this
        order the directions, or the gradients at the candidate."""
        rows = problem.gradients(y).scaled()[1]
        along = rows if directions is None else directions
        order = order_of(rows.gram(along).matrix)
        return order, in_order(order, along.matrix)

    def advance(common: Any, y: Any, counter: Array) -> tuple[Any, Array]:
        order, at_candidate = common
        linearised = problem.linearise(y)
        # Without a barrier XLA would evaluate the residuals once for each use of them.
        g, jacobian = linearised if lanes else lax.optimization_barrier(linearised)
        level, wrong = problem.level(g, problem.scale(jacobian, y))
        sizes, rows = problem.factor.scale_columns(jacobian).scaled()
        rows, wrong = in_order(order, rows.matrix), in_order(order, wrong / sizes)
        may_switch = directions is None and max_steps > FROZEN_STEPS
        # In each step the counter goes down by one, but before the last step, which polishes, the
        # test sets it to two. So we look at it before the test. Should the last step leave the
        # tolerance, the one that tries to return is along the gradients at its state.
        frozen = counter > max_steps + 1 - FROZEN_STEPS
        along = jnp.where(frozen, at_candidate, rows) if may_switch else at_candidate
        counter = after_test(level, counter)
        # A step that only polishes is as long as roundoff over the sine of the angle between
        # gradients. So that it is at most `ROUNDOFF` times as long as with a right angle, a
        # constraint whose gradient is more nearly parallel to others takes no part in it. In
        # float64 it is short in any case, and a batch is faster without the distinction.
        least = None
        if dtype != jnp.float64:
            least = jnp.where(level < WITHIN_TOLERANCE, roundoff, max(roundoff, 1 / ROUNDOFF**2))
        rows, along = DenseRows(rows), DenseRows(along)
        change = rows.gram(along).row_space_correction(along, wrong, least=least, ordered=True)
        moved = y - problem.factor.to_state(change)
        return keep_done(counter, moved, y), counter

    if lanes:
        start, step, y = written_out_loop(shared, advance, candidate, tests(max_steps))
    else:
        # The candidate is the end of a step of the solver. Without a barrier XLA would evaluate
        # that step once for each use of the candidate.
        start, step, y = shared, advance, lax.optimization_barrier(candidate)
    found = iterate(ft.partial(step, start(y)), y, max_steps=max_steps)
    return found._replace(y=joined(candidate, found.y))


@eqx.filter_jit
def _of_many(problem: Problem, candidate: Float[Array, " n"], max_steps: int) -> Solved:
    """The matrix is that at the candidate, factored once, so that a step evaluates only residuals.

    They are compared with the scales at the candidate, because those at each state would need a
    Jacobian. So at the end we test the result once more, by its own scales.
    """
    candidate = lax.optimization_barrier(candidate)
    jacobian = problem.linearise(candidate)[1]
    scale = problem.scale(jacobian, candidate)
    along = problem.factor.scale_columns(jacobian)
    sizes, rows = along.scaled()
    solve = rows.gram(rows).factorise()
    _, vjp = jax.vjp(problem.residual, candidate)

    def along_gradients(multiplier: Array) -> Array:
        """`S Sᵀ Gᵀ λ`. If `G` is sparse, a reverse pass is faster than a sum over indices."""
        if problem.pattern is not None:
            return problem.factor.to_state(problem.factor.scale_gradient(vjp(multiplier)[0]))
        return problem.factor.to_state(along.rmatvec(multiplier))

    def advance(y: Array, counter: Array) -> tuple[Array, Array]:
        level, wrong = problem.level(problem.residual(y), scale)
        counter = after_test(level, counter)
        move = lambda: y - along_gradients(solve(wrong / sizes) / sizes)  # noqa: E731
        moved = lax.cond(any_lane(counter > 0), move, lambda: y)
        return keep_done(counter, moved, y), counter

    y, ok, num_iterations, _ = iterate(advance, candidate, max_steps=max_steps)
    return Solved(y, ok & problem.holds(y), num_iterations)


# ---- For starts far away ----


class _Descent(NamedTuple):
    """The state to be tested, and the best one so far with its largest residual, relative to the
    scales at the first state. A scale grows with the state, so that by their own scales residuals
    far away would look smaller than they are."""

    y: Float[Array, " n"]
    best: Float[Array, " n"]
    largest: Float[Array, ""]
    scale: Float[Array, " m"]


def damped_newton(
    problem: Problem,
    start: Float[Array, " n"],
    directions: AbstractRows | None = None,
    *,
    max_steps: int,
    polish: bool = False,
) -> Solved:
    """A state on the manifold, which is near the start if that is near the manifold.

    The steps are along the given `directions`, or along the gradients at each state. In the second
    case the result depends on the path.
    """

    def advance(now: _Descent, counter: Array) -> tuple[_Descent, Array]:
        y, first = now.y, now.largest == jnp.inf
        g, jacobian = lax.optimization_barrier(problem.linearise(y))
        here = problem.scale(jacobian, y)
        level, wrong = problem.level(g, here)
        # A start that is not finite is hopeless. Later states are not: their step was too long.
        level = jnp.where(first, level, jnp.maximum(level, ABOVE_TOLERANCE))
        counter = after_test(level, counter, polish=polish)
        scale = jnp.where(first, here, now.scale)
        residuals = jnp.abs(relative(g, scale))
        better = jnp.all(residuals <= now.largest)  # false if one is NaN
        sizes, rows = problem.factor.scale_columns(jacobian).scaled()
        along = rows if directions is None else directions
        change = rows.gram(along).row_space_correction(along, wrong / sizes)
        further = y - problem.factor.to_state(change)
        shorter = now.best + BACKTRACKING_FACTOR * (y - now.best)
        best = jnp.where(better, y, now.best)
        largest = jnp.where(better, jnp.max(residuals), now.largest)
        moved = keep_done(counter, jnp.where(better, further, shorter), y)
        return _Descent(moved, best, largest, scale), counter

    begin = _Descent(start, start, jnp.full_like(start[0], jnp.inf), problem.magnitude)
    found = iterate(advance, begin, max_steps=max_steps)
    return found._replace(y=found.y.y)


# ---- Within bounds ----


def projected_newton(
    problem: Problem, start: Float[Array, " n"], directions: AbstractRows, *, max_steps: int
) -> Solved:
    """A vector `z` along the given `directions` for which `clip(z)` is on the manifold.

    If the constraints are linear, their residuals are the gradient of a convex function of the
    multipliers. Where components reach their bounds, this gradient has kinks, and Newton's method
    for the minimum may cycle if it makes full steps across them. So each step goes to the minimum
    of the function along the step.
    """

    def advance(z: Array, counter: Array) -> tuple[Array, Array]:
        g, jacobian = lax.optimization_barrier(problem.linearise(z))
        level, _ = problem.level(g, problem.scale(jacobian, z))
        counter = after_test(level, counter, polish=False)
        sizes, rows = problem.factor.scale_columns(jacobian).scaled()
        # Residuals that are noise are corrected too. Components at their bounds couple the
        # constraints, so that what is noise for one constraint may be what another needs.
        multiplier = rows.gram(directions).solve(g / sizes)
        change = problem.factor.to_state(directions.rmatvec(multiplier))
        share = _share(problem, z, multiplier, change, counter > 0)
        return keep_done(counter, z - share * change, z), counter

    return iterate(advance, start, max_steps=max_steps)


def _share(problem: Problem, z: Array, multiplier: Array, change: Array, goes_on: Array) -> Array:
    """The share of a Newton step at which the convex function is least, by bisection of its descent
    along the step, the product of the residuals with what is subtracted from the multipliers."""

    def descent(share: Array | float) -> Array:
        return jnp.sum(multiplier * problem.residual(z - share * change))

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        further = descent(middle) >= 0
        return jnp.where(further, middle, ends[0]), jnp.where(further, ends[1], middle)

    # A full step is kept if it goes hardly past the minimum. If all components that it moves are
    # beyond their bounds, where `clip` has the derivative `AT_BOUND`, the step is far too long.
    ends = jnp.zeros((), z.dtype), jnp.ones((), z.dtype)
    in_full = (descent(1.0) >= -(AT_BOUND**0.5) * descent(0.0)) | ~goes_on
    bisected = lambda: lax.fori_loop(0, round(-math.log2(AT_BOUND)), halve, ends)[1]  # noqa: E731
    share = lax.cond(any_lane(~in_full), bisected, lambda: ends[1])
    return jnp.where(in_full, ends[1], share)
