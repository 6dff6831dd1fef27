"""The iterations that lead to the manifold: one loop, and the steps that it can make.

All are variants of Newton's method, for at most as many equations as unknowns. They differ in their
steps, so a step is a function of the unknowns and of the number of tests that are left, and the
loop around it is written once, in `iterate`. In this file a step is one of an iteration, unless it
is called a step of the solver.

- `simplified_newton` is for candidates as near as the local error of a solver's step (Hairer,
  Lubich and Wanner, IV.4, (4.4) to (4.6)). It looks for multipliers `λ` such that `y = ŷ + S Uᵀ λ`
  is on the manifold, for the candidate `ŷ`, the factor `S` of the metric `M⁻¹ = S Sᵀ`, and the
  gradients `U = G(ŷ) S` at the candidate. As these directions are fixed, the result is a function
  of the candidate and of the multipliers, and has a derivative by the implicit function theorem;
  see `implicit`. For up to four constraints the matrix `G(y) S Uᵀ` of a step is evaluated at the
  current state, so that the iteration is Newton's method; for more it is evaluated at the
  candidate, and if a few steps are not enough, at states after them.
- `semismooth_newton` keeps a state within bounds, along given directions, with a line search.
- `damped_newton` is for starts far away. Without given directions each step is the shortest, in the
  metric, that solves the equations linearised at the last state (P. Deuflhard, *Newton Methods for
  Nonlinear Problems*, Springer 2004, Section 4.4). A step that increases the largest residual, or
  leaves the domain of a function, is shortened until it does not.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._constants import (
    BACKTRACKING_FACTOR,
    FROZEN_STEPS,
    MAX_ELIMINATION,
    MAX_PIVOTED,
    SLOPE_BEYOND_BOUNDS,
    TOLERANCE_IN_EPS,
)
from .lanes import any_lane, where_active, with_lanes_last
from .linear import (
    diagonal_shift,
    gram_matrix,
    ldu_factors,
    ldu_solution,
    natural_order,
    roundoff_pivot_tolerance,
    unrolled_matvec,
)
from .problem import (
    ABOVE_TOLERANCE,
    AT_ROUNDOFF,
    NOT_FINITE,
    WITHIN_TOLERANCE,
    Problem,
    relative_to_scale,
)
from .rows import AbstractRows, DenseRows

# A step of an iteration: from the unknowns and `tests_left` to both after it. While `tests_left` is
# positive it is the number of tests that are still allowed; zero means success, and a negative
# number a failure.
Advance = Callable[[Any, Array], tuple[Any, Array]]


class Solved(NamedTuple):
    """What an iteration returns.

    - `y`: the unknowns. In a projection they are the state.
    - `ok`: whether they solve the equations.
    - `num_iterations`: the number of steps.
    - `aux`: what else was found, without a derivative.
    """

    y: Any
    ok: Bool[Array, ""]
    num_iterations: Int[Array, ""]
    aux: Any = None


# ---- The loop ----


def iterate(
    advance: Advance, y: Any, *, max_steps: int | Array, lanes: tuple[int, ...] = ()
) -> Solved:
    """Advances the unknowns until no test is left.

    `tests_left` is the number of tests that are left. The unknowns are tested before each step and
    after the last one, so that it starts at `max_steps + 1`. When the iteration ends, it is zero if
    the unknowns passed their last test, and -1 if they did not; see `remaining_after_test`.

    The lanes of a batch advance together until none goes on. So `advance` must leave unknowns that
    are done, for which no test is left, as they are. If the lanes are the last axis of the
    unknowns, `lanes` is its shape, and each lane has a number of tests of its own.
    """

    def body(now: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        y, tests_left = advance(*now[:2])
        return y, tests_left, now[2] + (tests_left > 0).astype(int)

    tests_left = jnp.asarray(max_steps + 1)
    if isinstance(max_steps, int):
        # The carry is small, because for small systems moving it costs more than the arithmetic.
        tests_left = tests_left.astype(np.min_scalar_type(-max_steps - 2))
    tests_left = jnp.broadcast_to(tests_left, lanes)
    begin = y, tests_left, jnp.zeros(lanes, int)
    y, tests_left, count = lax.while_loop(lambda now: any_lane(now[1] > 0), body, begin)
    return Solved(y, tests_left == 0, count)


def remaining_after_test(status: Array, tests_left: Array, *, polish: bool = True) -> Array:
    """The number of tests that are left after unknowns of this `status` were tested.

    At `AT_ROUNDOFF` the iteration ends. Where the unknowns are merely within the tolerance, one
    more step brings the residual to roundoff, if `polish` asks for it; should that step leave the
    tolerance, another tries to return to it. A residual that is not finite cannot recover, but one
    more step takes the NaN to the unknowns, where everybody sees it. If no test is left and the
    unknowns do not solve the equations, the iteration has failed.
    """
    then = jnp.where(status == NOT_FINITE, jnp.minimum(tests_left - 1, 1), tests_left - 1)
    then = jnp.where((status < WITHIN_TOLERANCE) & (then == 0), -1, then)
    then = jnp.where(status == WITHIN_TOLERANCE, jnp.where(tests_left > 2, 2 * polish, 0), then)
    then = jnp.where(status == AT_ROUNDOFF, 0, then)
    return jnp.where(tests_left > 0, then, tests_left).astype(tests_left.dtype)


def remaining_after_step(converged: Array, hopeful: Array, tests_left: Array) -> Array:
    """The number of tests that are left after a step, in an iteration that tests the lengths of its
    steps: `converged` if the step is so short that it is the last, `hopeful` if more may help."""
    then = jnp.where(converged, 0, jnp.where(hopeful & (tests_left > 1), tests_left - 1, -1))
    return jnp.where(tests_left > 0, then, tests_left).astype(tests_left.dtype)


# ---- For candidates nearby ----


def simplified_newton(
    problem: Problem,
    candidate: Float[Array, " n"],
    directions: DenseRows | None = None,
    *,
    max_steps: int,
) -> Solved:
    """The state `ŷ + S Uᵀ λ` on the manifold. The rows of `U` are the `directions` if these are
    given, for at most `MAX_PIVOTED` constraints. Otherwise they are the gradients at the candidate,
    and after `FROZEN_STEPS` iterations those at later states."""
    m = problem.num_residuals
    assert directions is None or m <= MAX_PIVOTED
    if m > MAX_ELIMINATION:
        return _with_frozen_jacobian(problem, candidate, max_steps)
    return with_lanes_last(
        ft.partial(_newton_of_few_constraints, m, directions is not None, max_steps),
        (problem, directions),
        candidate,
    )


def _newton_of_few_constraints(
    m: int,
    has_directions: bool,
    max_steps: int,
    map_lanes: Callable[..., Any],
    candidate: Array,
    is_batched: bool,
) -> Solved:
    """For up to `MAX_ELIMINATION` constraints. In a batch the lanes are the last axis of all
    arrays, and `map_lanes(fn)(*xs)` is `fn((problem, directions), *xs)` of each lane. The Jacobian
    stands at one place in the program, which makes it small.

    For up to `MAX_PIVOTED` constraints the matrix `G(y) S Uᵀ` is evaluated at each iterate. Pivots
    that are roundoff count as infinite: if the other constraints hold, these hold too.

    For more the matrix at the candidate is factored once, in the first step. For
    `FROZEN_STEPS` steps the Jacobian at each state serves for the scales of its residuals alone;
    after them for the directions and the matrix too. Where constraints depend on each other, their
    residuals contradict each other by roundoff, so that in general the default is added to the
    diagonal. It keeps corrections from directions in which gradients differ by less than a
    millionth, as near a circular orbit. What the first steps have left over may be in such a
    direction, so after them only roundoff is added.
    """
    keeps_matrix = m > MAX_PIVOTED

    def residual_test(given: Any, y: Array) -> tuple[Array, ...]:
        problem, _ = given
        g, jacobian = problem.linearise(y)
        status, residual_to_correct = problem.status(g, problem.scale(jacobian, y))
        return status, residual_to_correct, problem.factor.scaled_rows(jacobian).matrix

    def advance(now: Any, tests_left: Array) -> tuple[Any, Array]:
        y, *previous = now
        status, residual_to_correct, rows = map_lanes(residual_test)(y)
        is_first, frozen = tests_left > max_steps, tests_left > max_steps + 1 - FROZEN_STEPS
        # `is_first` and `frozen` follow from the number of tests before this one, which may set it
        # to two, for a step that polishes. If that leaves the tolerance, the next one is along the
        # current gradients.
        tests_left = remaining_after_test(status, tests_left)
        refresh = is_first | (~frozen & (tests_left > 0))

        def factors_of(rows: Array, directions: Array) -> tuple[Any, ...]:
            left, right = (DenseRows(x).equilibrated()[1].matrix for x in (rows, directions))
            matrix = gram_matrix(left, right)
            if not keeps_matrix:
                tolerance = _pivot_tolerance(status, rows.dtype)
                return ldu_factors(matrix, pivot_tolerance=tolerance, pivoting=True)
            shift = jnp.where(
                frozen, diagonal_shift(m, rows.dtype), roundoff_pivot_tolerance(rows.dtype)
            )
            return ldu_factors(matrix, relative_shift=shift)[:1]

        def refreshed() -> list[Array]:
            new = [rows, *factors_of(rows, rows)]
            return [jnp.where(refresh, a, b) for a, b in zip(new, previous, strict=True)]

        def move() -> list[Array]:
            if keeps_matrix:
                linearisation = lax.cond(any_lane(refresh), refreshed, lambda: previous)
                matrix_rows, factors = linearisation
                pivot_step = natural_order(m, lanes)
            else:
                linearisation, matrix_rows = previous, rows
                if not has_directions:
                    linearisation = [jnp.where(refresh, rows, *previous)]
                factors, pivot_step = factors_of(rows, *linearisation)
            row_scales, _ = DenseRows(matrix_rows).equilibrated()
            _, directions = DenseRows(linearisation[0]).equilibrated()
            multiplier = ldu_solution(factors, pivot_step, residual_to_correct / row_scales)
            change = unrolled_matvec(jnp.moveaxis(directions.matrix, 1, 0), multiplier)
            to_state = map_lanes(lambda given, x: given[0].factor.to_state(x))
            return [y - to_state(change), *linearisation]

        # Outside a batch, for a few constraints, a branch takes longer than what it avoids.
        branch = is_batched or keeps_matrix
        moved, *kept = lax.cond(any_lane(tests_left > 0), move, lambda: now) if branch else move()
        return [where_active(tests_left, moved, y), *kept], tests_left

    n, *lanes = candidate.shape
    if has_directions:
        begin = [candidate, map_lanes(lambda given, y: given[1].matrix)(candidate)]
    else:
        begin = [candidate, jnp.zeros((m, n, *lanes), candidate.dtype)]
    if keeps_matrix:
        begin.append(jnp.zeros((m, m, *lanes), np.promote_types(candidate.dtype, np.float32)))
    solved = iterate(advance, begin, max_steps=max_steps, lanes=tuple(lanes))
    return solved._replace(y=solved.y[0])


def _pivot_tolerance(status: Array, dtype: Any) -> float | Array:
    """A step that only polishes is as long as roundoff divided by the sine of the angle between
    gradients. So that it is at most `TOLERANCE_IN_EPS` times as long as with a right angle,
    constraints with a sine of at most `1 / TOLERANCE_IN_EPS` take no part in it. In float64 it is
    short in any case, and a batch is faster without the distinction."""
    roundoff = roundoff_pivot_tolerance(dtype)
    if dtype == jnp.float64:
        return roundoff
    return jnp.where(status < WITHIN_TOLERANCE, roundoff, max(roundoff, 1 / TOLERANCE_IN_EPS**2))


@eqx.filter_jit
def _with_frozen_jacobian(
    problem: Problem, candidate: Float[Array, " n"], max_steps: int
) -> Solved:
    """For more than `MAX_ELIMINATION` constraints: for `FROZEN_STEPS` steps directions and matrix
    stay those at one state, first the candidate, so that a step evaluates only residuals.

    These are compared with the scales at that state, because those at each state would need a
    Jacobian. So after these steps the result is tested once more, by its own scales. If it is not
    on the manifold, the next steps have the directions, the matrix and the scales there. The values
    and the Jacobian at the result are returned as `aux`.
    """

    def linearised_once(now: _Rounds) -> _Rounds:
        y, (_, jacobian) = now.y, now.linearised
        scale = problem.scale(jacobian, y)
        row_scales, rows = problem.factor.scaled_rows(jacobian).equilibrated()
        solve = rows.gram(rows).factorise()

        def advance(y: Array, tests_left: Array) -> tuple[Array, Array]:
            status, residual_to_correct = problem.status(problem.residual(y), scale)
            tests_left = remaining_after_test(status, tests_left)

            def move() -> Array:
                return y - problem.factor.to_state(
                    rows.rmatvec(solve(residual_to_correct / row_scales))
                )

            moved = lax.cond(any_lane(tests_left > 0), move, lambda: y)
            return where_active(tests_left, moved, y), tests_left

        steps = jnp.where(now.goes_on, jnp.minimum(FROZEN_STEPS, max_steps - now.num_iterations), 0)
        moved, _, count, _ = iterate(advance, y, max_steps=steps)
        linearised = problem.linearise(moved)
        ok = problem.holds(moved, *linearised)
        hopeful = (count > 0) & jnp.all(jnp.isfinite(moved))
        count = now.num_iterations + count
        goes_on = now.goes_on & ~ok & hopeful & (count < max_steps)
        return _Rounds(moved, linearised, ok, count, goes_on)

    begin = _Rounds(
        candidate,
        problem.linearise(candidate),
        ok=jnp.asarray(False),
        num_iterations=jnp.asarray(0),
        goes_on=jnp.asarray(True),
    )
    end = lax.while_loop(lambda now: any_lane(now.goes_on), linearised_once, begin)
    return Solved(end.y, end.ok, end.num_iterations, end.linearised)


class _Rounds(NamedTuple):
    """The state after some rounds of steps, each with one Jacobian, the values and the Jacobian
    there, whether it is on the manifold, the number of iterations, and whether there is another
    round."""

    y: Float[Array, " n"]
    linearised: tuple[Float[Array, " m"], AbstractRows]
    ok: Bool[Array, ""]
    num_iterations: Int[Array, ""]
    goes_on: Bool[Array, ""]


# ---- For starts far away ----


class _DampedState(NamedTuple):
    """The state to be tested, and the best one so far with its largest residual, relative to the
    scales at the start. A scale grows with the state, so that by their own scales residuals
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

    def advance(now: _DampedState, tests_left: Array) -> tuple[_DampedState, Array]:
        y, is_first = now.y, now.largest == jnp.inf
        g, jacobian = lax.optimization_barrier(problem.linearise(y))
        scale_at_y = problem.scale(jacobian, y)
        status, residual_to_correct = problem.status(g, scale_at_y)
        # A start that is not finite is hopeless. Later states are not: their step was too long.
        status = jnp.where(is_first, status, jnp.maximum(status, ABOVE_TOLERANCE))
        tests_left = remaining_after_test(status, tests_left, polish=polish)
        scale = jnp.where(is_first, scale_at_y, now.scale)
        residuals = jnp.abs(relative_to_scale(g, scale))
        is_smaller = jnp.all(residuals <= now.largest)  # false if one is NaN
        row_scales, rows = problem.factor.scaled_rows(jacobian).equilibrated()
        current = rows if directions is None else directions
        change = rows.gram(current).row_space_correction(current, residual_to_correct / row_scales)
        newton_point = y - problem.factor.to_state(change)
        backtracked = now.best + BACKTRACKING_FACTOR * (y - now.best)
        best = jnp.where(is_smaller, y, now.best)
        largest = jnp.where(is_smaller, jnp.max(residuals), now.largest)
        moved = where_active(tests_left, jnp.where(is_smaller, newton_point, backtracked), y)
        return _DampedState(moved, best, largest, scale), tests_left

    begin = _DampedState(start, start, jnp.full_like(start[0], jnp.inf), problem.magnitude)
    solved = iterate(advance, begin, max_steps=max_steps)
    return solved._replace(y=solved.y.y)


# ---- Within bounds ----


def semismooth_newton(
    problem: Problem, start: Float[Array, " n"], directions: AbstractRows, *, max_steps: int
) -> Solved:
    """A vector `z` along the given `directions` for which `clip(z)` is on the manifold.

    If the constraints are linear, their residuals are the gradient of a convex function of the
    multipliers. Where components reach their bounds, this gradient has kinks, and Newton's method
    for the minimum may cycle if it makes full steps across them. So each step goes to the minimum
    of the function along the step.
    """

    def advance(z: Array, tests_left: Array) -> tuple[Array, Array]:
        g, jacobian = lax.optimization_barrier(problem.linearise(z))
        status, _ = problem.status(g, problem.scale(jacobian, z))
        tests_left = remaining_after_test(status, tests_left, polish=False)
        row_scales, rows = problem.factor.scaled_rows(jacobian).equilibrated()
        # Residuals that are noise are corrected too. Components at their bounds couple the
        # constraints, so that what is noise for one constraint may be what another needs.
        multiplier = rows.gram(directions).solve(g / row_scales)
        change = problem.factor.to_state(directions.rmatvec(multiplier))
        step_fraction = _line_search(problem, z, multiplier, change, tests_left > 0)
        return where_active(tests_left, z - step_fraction * change, z), tests_left

    return iterate(advance, start, max_steps=max_steps)


def _line_search(
    problem: Problem, z: Array, multiplier: Array, change: Array, goes_on: Array
) -> Array:
    """The fraction of a Newton step at which the convex function is least. It is found by bisection
    of the directional derivative, `slope`, whose sign tells the side of the minimum."""

    def slope(step_fraction: Array | float) -> Array:
        return jnp.sum(multiplier * problem.residual(z - step_fraction * change))

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        descends = slope(middle) >= 0
        return jnp.where(descends, middle, ends[0]), jnp.where(descends, ends[1], middle)

    # A full step is kept if it goes hardly past the minimum. If all components that it moves are
    # beyond their bounds, where `clip` has a tiny derivative, the step is far too long.
    ends = jnp.zeros((), z.dtype), jnp.ones((), z.dtype)
    in_full = (slope(1.0) >= -(SLOPE_BEYOND_BOUNDS**0.5) * slope(0.0)) | ~goes_on
    bisected = lambda: lax.fori_loop(0, round(-math.log2(SLOPE_BEYOND_BOUNDS)), halve, ends)[1]  # noqa: E731
    step_fraction = lax.cond(any_lane(~in_full), bisected, lambda: ends[1])
    return jnp.where(in_full, ends[1], step_fraction)
