"""The one loop of the projections, Newton's method for the multipliers, and its derivative by the
implicit function theorem, which is exact for the returned state.

A single trajectory is fastest in arrays. In a batch of small systems the same iteration is written
out in scalars; in every batch, lanes iterate together until none goes on.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int

from .._tree import tree_tangents
from .equations import (
    WRITTEN_OUT_MAX,
    Equations,
    any_lane,
    combined,
    eliminated,
    gram_matrix,
    gram_solve,
    in_units,
    inverse_factor,
    relative,
    scaled_rows,
)
from .scalars import components, in_scalars, joined

# Gradients count as nearly parallel if the sine of their angle is below the cube root of roundoff,
# or if it is below `_SMALL_ANGLE` and the correction, relative to the state and divided by the
# sine, is above `_SHORT_CORRECTION`. Whether they are so everywhere is tested at this distance.
_SMALL_ANGLE, _SHORT_CORRECTION, _OFFSET = 1e-2, 1e-5, 1e-3
# Newton's method for the multipliers converges quadratically. If that of several constraints has
# not after this many iterations, the plane of its corrections may miss the manifold, as on circular
# orbits, whose states are a curve: from then on it follows the gradients at the last state.
_FROZEN_STEPS = 4
# The bisections of a step where it must be shortened.
_HALVINGS = 30
# With bounds, a component that an iteration reduces to this share of itself is zero.
_VANISHES = 1e-8


class _Kept(NamedTuple):
    """What an iteration keeps from the candidate: the directions of the correction, and with many
    constraints the factor of the Gram matrix."""

    rows: Any = None
    inverse: Float[Array, "m m"] | None = None


# The residuals and the Jacobian at a state, and if it is judged the noise of the residuals.
_Seen = tuple[Array, ...]
# The best state so far, its largest residual, and the scales of residuals at the first one.
_Best = tuple[Float[Array, " n"], Float[Array, ""], Float[Array, " m"]]
# The state, whether it is on the manifold, and the number of iterations.
Solved = tuple[Float[Array, " n"], Bool[Array, ""], Int[Array, ""]]


def solve(
    equations: Equations,
    candidate: Float[Array, " n"],
    *,
    max_steps: int,
    directions: Float[Array, "m n"] | None = None,
    fresh: bool = False,
    damped: bool = False,
) -> Solved:
    """The state `y = ŷ + s Uᵀ λ` on the manifold, for the units `s` of the components. The
    directions `U` are by default `G diag(s)` at the candidate, with `fresh` at the last state. With
    `damped` a step that increases the largest residual, or leaves the domain of a function, is
    shortened until it does not."""
    arrays, static = eqx.partition((equations, candidate, directions), eqx.is_array)
    small = equations.magnitude.size <= WRITTEN_OUT_MAX

    def run(small: bool, arrays: Any) -> Solved:
        given = eqx.combine(arrays, static)
        return _solve(*given, max_steps=max_steps, fresh=fresh, damped=damped, small=small)

    # Jitted, because jax batches the loop over the steps several times.
    in_arrays = jax.jit(ft.partial(run, False))
    if fresh or not small:
        return in_arrays(arrays)
    alone, lane = jax.custom_batching.custom_vmap(in_arrays), jax.jit(ft.partial(run, True))

    @alone.def_vmap
    def batched(size: int, axes: Any, arrays: Any) -> Any:
        del size
        (axes,) = jtu.tree_map(lambda batched: 0 if batched else None, axes)
        return jax.vmap(lane, (axes,))(arrays), (True, True, True)

    return alone(arrays)


def _solve(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Float[Array, "m n"] | None,
    *,
    max_steps: int,
    fresh: bool,
    damped: bool,
    small: bool,
) -> Solved:
    def start(y: Any) -> tuple[_Kept, _Seen | None]:
        if directions is not None:
            return _Kept(directions), None
        if fresh:
            return _Kept(), None
        g, jacobian = equations.linearise(y)
        scaled = equations.scaled(jacobian)
        sizes, unit = scaled_rows(scaled)
        if len(unit) <= WRITTEN_OUT_MAX:
            return _Kept(unit), None
        # A large Jacobian is carried, so that none is computed twice.
        return _Kept(scaled, inverse_factor(gram_matrix(unit, unit), sizes)), (g, jacobian)

    def judge(seen: _Seen, y: Any, left: Array) -> tuple[Array, _Seen]:
        """The iterations that are left, at first `max_steps + 1`; in the end 0, success, or -1."""
        level, noise = equations.verdict(seen[0], seen[1], y)
        on = level > 0
        # Within the tolerance one more, unless it would only serve a start far away, or some, as at
        # bounds one may lead away.
        more = jnp.minimum(left - 1, 0 if damped else 1 if equations.clip is None else 4)
        now = jnp.where(on, more, jnp.where(left == 1, -1, left - 1))
        # NaN stays NaN, in the state after one more, unless the step is shortened.
        stays = (left == max_steps + 1) if damped else (left > 0)
        now = jnp.where((level < 0) & stays, jnp.minimum(now, 1), now)
        now = jnp.where(left > 0, jnp.where(level == 2, 0, now), left).astype(left.dtype)
        return now, (seen[0], seen[1], noise)

    def move(kept: _Kept, seen: _Seen, y: Any, left: Array) -> Any:
        refreshed = directions is None and not fresh and equations.magnitude.size > 1
        frozen = left > max_steps - _FROZEN_STEPS if refreshed else None
        return jnp.where(left > 0, _corrected(equations, kept, seen, y, frozen), y)

    def test(kept: _Kept, y: Any, left: Array) -> tuple[Any, Array]:
        seen = equations.linearise(y)
        if not small:  # otherwise XLA evaluates residuals for each use
            seen = lax.optimization_barrier(seen)
        left, seen = judge(seen, y, left)
        return move(kept, seen, y, left), left

    y: Any = candidate
    left = jnp.asarray(max_steps + 1, jnp.int8 if max_steps < 126 else jnp.int32)
    if small:
        like, _ = jax.eval_shape(start, y)
        written: tuple[Any, ...] = in_scalars(start, y), in_scalars(test, like, y, left)
        if None not in written:
            # From here on arrays are tuples of scalars.
            start, test = written
            y = components(y)
    if not isinstance(y, tuple):
        y = lax.optimization_barrier(y)  # otherwise XLA evaluates it for each use
    kept, seen = start(y)
    if seen is not None:
        left, seen = judge(seen, y, left)
    count = ((left > 0) & (left <= max_steps)).astype(int)

    last: Any = (y, jnp.full_like(candidate[0], jnp.inf), equations.magnitude) if damped else seen

    def body(carry: tuple[Any, Any, Array, Array]) -> tuple[Any, Any, Array, Array]:
        y, last, left, count = carry
        if damped:
            seen = lax.optimization_barrier(equations.linearise(y))
            left, seen = judge(seen, y, left)
            better, last = _better(equations, seen, y, last)
            shorter = last[0] + (y - last[0]) / 4
            y = jnp.where(better | (left <= 0), move(kept, seen, y, left), shorter)
        elif last is None:
            y, left = test(kept, y, left)
        else:
            y = move(kept, last, y, left)
            left, last = judge(equations.linearise(y), y, left)
        return y, last, left, count + (left > 0).astype(int)

    y, _, left, count = lax.while_loop(lambda x: any_lane(x[2] > 0), body, (y, last, left, count))
    return joined(candidate, y), left != -1, count


def _better(equations: Equations, seen: _Seen, y: Array, best: _Best) -> tuple[Array, _Best]:
    """Whether no residual at `y` is above the largest one of the best state, and the better one."""
    state, least, scale = best
    scale = jnp.where(least < jnp.inf, scale, equations.scale(seen[1], y))
    sizes = jnp.abs(relative(seen[0], scale))
    better = jnp.all(sizes <= least)  # NaN is not
    return better, (jnp.where(better, y, state), jnp.where(better, jnp.max(sizes), least), scale)


def _corrected(
    equations: Equations, kept: _Kept, seen: _Seen, y: Array, frozen: Array | None
) -> Array:
    """`y - s Uᵀ (G diag(s) Uᵀ)⁻¹ g`."""
    g, jacobian, noise = seen
    if kept.inverse is not None:
        g = jnp.where(jnp.abs(g) <= noise, 0, g)
        x = combined(g.astype(kept.inverse.dtype), kept.inverse.T)
        rows, multiplier = kept.rows, combined(x, kept.inverse).astype(g.dtype)
        change = combined(multiplier, rows)
    else:
        sizes, unit = scaled_rows(equations.scaled(jacobian))
        rows = unit if kept.rows is None else kept.rows
        rows = rows if frozen is None else jnp.where(frozen, rows, unit)
        # With bounds what is noise for one constraint may be needed for another.
        noise = noise / sizes if equations.clip is None else None
        gram, right = gram_matrix(unit, rows), g / sizes
        change = combined(*eliminated(gram, right, rows, noise))
        used = equations.clip is not None or equations.may_vanish
        multiplier = gram_solve(gram, right, noise) if used else right
    change = equations.scaled(change)
    if equations.clip is not None:
        change = _length(equations, equations.clip, y, multiplier, change) * change
    # A component that nearly vanishes does so: a true zero is never small relative to itself.
    rest, size, least = y - change, jnp.abs(y), 2 * float(jnp.finfo(y.dtype).eps)
    if equations.clip is not None:
        least = _VANISHES
    elif equations.may_vanish:  # the terms of several constraints cancel in it
        terms = equations.scaled(combined(jnp.abs(multiplier), jnp.abs(rows)))
        size, least = size + terms, 4 * least
    return jnp.where(jnp.abs(rest) <= least * size, 0, rest)


def _length(
    equations: Equations, clip: Callable[[Array], Array], y: Array, multiplier: Array, change: Array
) -> Array:
    """The share of a step at which a convex function is least, by bisection of its slope."""

    def falls(length: Array) -> Array:
        return jnp.sum(multiplier * equations.residual(y - length * change)) >= 0

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = ends
        middle = (a + b) / 2
        further = falls(middle)
        return jnp.where(further, middle, a), jnp.where(further, b, middle)

    one = jnp.ones((), y.dtype)
    _, end = lax.fori_loop(0, _HALVINGS, halve, (0 * one, one))
    # A full step is taken within the bounds, and if it ends just past the minimum.
    within_bounds = jnp.all(clip(y) == y) & jnp.all(clip(y - change) == y - change)
    last = jnp.sum(multiplier * equations.residual(y - change))
    first = jnp.sum(multiplier * equations.residual(y))
    return jnp.where(within_bounds | (last >= -1e-3 * first), one, end)


@eqx.filter_custom_jvp
def project_along(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Float[Array, "m n"] | None,
    *,
    max_steps: int,
) -> Solved:
    """`loop.solve` with the directions frozen, and its derivative."""
    return solve(equations, candidate, directions=directions, max_steps=max_steps)


@project_along.def_jvp
def _project_along_jvp(primals: Any, tangents: Any, *, max_steps: int) -> Any:
    """Let `ẏ` and `ġ` be the tangents of `y = ŷ + s Uᵀ λ` and of its residual at constant `λ`. Then
    `λ̇ = -(G(y) diag(s) Uᵀ)⁻¹ ġ`, and the tangent of the state is `ẏ + s Uᵀ λ̇`. The units depend
    on the solution too, so `ẏ` includes their tangent."""
    equations, candidate, directions = primals
    solved = y, ok, count = project_along(*primals, max_steps=max_steps)
    # What failed is not used. Its tangent is that of the candidate, which is finite: reverse mode
    # multiplies it by zero.
    y = jnp.where(ok, y, candidate)
    rows = directions
    if rows is None:
        rows = equations.scaled(equations.linearise(candidate)[1])
    sizes, rows = scaled_rows(rows)
    along = combined(in_units(y - candidate, equations.units), rows.T)
    multiplier = gram_solve(gram_matrix(rows, rows), along) / sizes

    def displaced(equations: Equations, candidate: Array, directions: Array | None) -> Any:
        if directions is not None:
            moved = combined(multiplier, directions)
        else:  # by one reverse pass, not row by row
            _, vjp = jax.vjp(equations.residual, candidate)
            moved = equations.scaled(vjp(multiplier)[0])
        moved = equations.scaled(moved)
        return candidate + moved, equations.residual(candidate + moved)

    tangent = eqx.filter_jvp(displaced, primals, tangents)[1]
    t_y, t_g = tree_tangents((y, multiplier), tangent)
    _, jacobian = equations.linearise(y)
    heights, unit = scaled_rows(equations.scaled(jacobian))
    change = combined(*eliminated(gram_matrix(unit, rows), t_g / heights, rows))
    t_y = t_y - equations.scaled(change)
    factor = certain(equations, candidate, y, jacobian, directions)
    if directions is None and 1 < len(rows) <= WRITTEN_OUT_MAX:
        factor = jnp.where(count <= _FROZEN_STEPS, factor, jnp.nan)  # not of this form
    factor = jnp.where(ok, factor, 1)
    return solved, (lax.stop_gradient(factor) * t_y, None, None)


def certain(
    equations: Equations,
    candidate: Array,
    y: Array,
    jacobian: Array,
    directions: Array | None = None,
) -> Float[Array, ""]:
    """One if the derivative of the projected state `y` is well determined, otherwise NaN: where
    gradients are nearly parallel, multipliers are large and cancel, so that roundoff dominates
    their derivatives. Constraints with gradients parallel everywhere are redundant: no harm."""
    one, eps = jnp.ones((), y.dtype), float(jnp.finfo(y.dtype).eps)
    if len(jacobian) == 1:
        if directions is None:
            return one
        gradient = equations.scaled(jacobian)
        lengths = jnp.linalg.norm(gradient) * jnp.linalg.norm(directions)
        crosses = jnp.abs(jnp.sum(gradient * directions)) > eps ** (1 / 3) * lengths
        return jnp.where(crosses | (lengths == 0), one, jnp.nan)
    sines = _sines(equations, jacobian)
    # The size of each component: where it crosses zero, how far it moves in a step, or, where that
    # is not known, a share of the largest component.
    motion = equations.motion
    sizes = jnp.abs(y) + (0.1 * jnp.max(jnp.abs(y), initial=0) if motion is None else motion)
    phases = jnp.sin(jnp.arange(1, y.size + 1, dtype=y.dtype) ** 2)
    beside = y + _OFFSET * sizes * phases
    dependent = _sines(equations, equations.linearise(beside)[1]) <= 64 * eps
    relative_change = jnp.abs(y - candidate) / jnp.where(sizes > 0, sizes, 1)
    amplified = jnp.max(relative_change, initial=0) > _SHORT_CORRECTION * sines
    doubtful = (sines <= eps ** (1 / 3)) | ((sines <= _SMALL_ANGLE) & amplified)
    return jnp.where(jnp.any(doubtful & ~dependent), jnp.nan, one)


def _sines(equations: Equations, jacobian: Float[Array, "m n"]) -> Float[Array, " m"]:
    """The sine of the angle between each gradient and the span of those before, in the metric."""
    _, unit = scaled_rows(equations.scaled(jacobian))
    columns = unit.astype(jnp.float32 if jnp.finfo(unit.dtype).bits < 32 else unit.dtype).T
    norms = jnp.linalg.norm(columns, axis=0)
    lengths = jnp.abs(jnp.diagonal(jnp.linalg.qr(columns, mode="r")))
    # Of more constraints than unknowns those that are left over depend on the others.
    lengths = jnp.pad(lengths, (0, norms.size - lengths.size))
    return jnp.where(norms > 0, lengths / jnp.where(norms > 0, norms, 1), 1).astype(unit.dtype)
