"""The undamped iteration, for candidates as near as the local error of a step.

It is Newton's method for the multipliers `λ` in `y = ŷ + s Uᵀ λ` (Hairer, Lubich and Wanner, IV.4).
The directions `U` are the gradients at the candidate in the units `s`, so the result depends on the
candidate and the multipliers alone, and has a derivative by the implicit function theorem.

A single trajectory is fastest in arrays. In a batch of small systems the same iteration is written
out in scalars; in every batch, lanes iterate together until none goes on. What matters for speed is
how little the loop carries: a state and a count.
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

from .elimination import (
    WRITTEN_OUT_MAX,
    combined,
    eliminated,
    factored,
    gram_matrix,
    gram_solve,
    scaled_rows,
)
from .equations import NOT_FINITE, ON, SETTLED, Equations, Jacobian, any_lane
from .scalars import components, in_scalars, joined
from .sparse import SparseRows

# Newton's method for the multipliers converges quadratically. If that of several constraints has
# not after this many iterations, the plane of its corrections may miss the manifold, as on circular
# orbits, whose states are a curve: then it starts again, along the gradients at the last state.
FROZEN_STEPS = 6
# A component that a correction reduces to as many units of roundoff of itself is zero, or, where
# the terms of several constraints cancel in it, of these terms.
_CANCELLED, _CANCELLED_TERMS = 2, 8


class Solved(NamedTuple):
    """The state, whether it is on the manifold, and the number of iterations."""

    y: Float[Array, " n"]
    ok: Bool[Array, ""]
    num_steps: Int[Array, ""]


def chord(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Float[Array, "m n"] | None = None,
    *,
    max_steps: int,
) -> Solved:
    """The state `y = ŷ + s Uᵀ λ` on the manifold. The `directions` are by default the gradients
    `G diag(s)` at the candidate; see `FROZEN_STEPS`."""
    arrays, static = eqx.partition((equations, candidate, directions), eqx.is_array)
    few = directions is not None or equations.magnitude.size <= WRITTEN_OUT_MAX

    def run(iterate: Callable[..., Solved], arrays: Any) -> Solved:
        return iterate(*eqx.combine(arrays, static), max_steps)

    if not few:
        return jax.jit(ft.partial(run, _of_many))(arrays)
    # Jitted, because jax batches the loop over the steps several times.
    alone = jax.custom_batching.custom_vmap(jax.jit(ft.partial(run, _of_few)))
    lane = jax.jit(ft.partial(run, ft.partial(_of_few, written_out=True)))

    @alone.def_vmap
    def batched(size: int, axes: Any, arrays: Any) -> Any:
        del size
        (axes,) = jtu.tree_map(lambda batched: 0 if batched else None, axes)
        is_batched: Any = Solved(*[True] * 3)  # pyright: ignore
        return jax.vmap(lane, (axes,))(arrays), is_batched

    return alone(arrays)


def counter(max_steps: int) -> Int[Array, ""]:
    """The number of tests that are left: one more than iterations, because the last state is
    tested too. In the end it is 0, or -1 if the manifold was not reached. It fits into a byte."""
    return jnp.asarray(max_steps + 1, jnp.int8 if max_steps < 126 else jnp.int32)


def after_test(level: Array, left: Array, *, extra: int, gives_up: Array) -> Array:
    """What is left after the test of a state.

    A state whose residuals are noise is done. One that is merely within the tolerance is improved
    by `extra` more iterations, which bring it to roundoff. A residual that is not finite cannot
    recover, unless steps are shortened: where the iteration `gives_up`, it makes one more, so that
    the NaN reaches the state, and stops.
    """
    more = jnp.minimum(left - 1, extra)
    now = jnp.where(level >= ON, more, jnp.where(left == 1, -1, left - 1))
    now = jnp.where((level == NOT_FINITE) & gives_up, jnp.minimum(now, 1), now)
    now = jnp.where(level == SETTLED, 0, now)
    return jnp.where(left > 0, now, left).astype(left.dtype)


def _of_few(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Float[Array, "m n"] | None,
    max_steps: int,
    written_out: bool = False,
) -> Solved:
    """For up to four constraints: each iteration has a Jacobian and an elimination of its own."""
    several = equations.magnitude.size > 1

    def start(y: Any) -> Any:
        if directions is not None:
            return y, directions
        return y, scaled_rows(equations.scaled(equations.linearise(y)[1]))[1]

    def iterate(first: Any, y: Any, left: Array) -> tuple[Any, Array]:
        candidate, along = first
        refreshed = directions is None and several
        if refreshed:  # from the candidate, because a plane that misses may lead far away
            y = jnp.where(left == max_steps - FROZEN_STEPS, candidate, y)
        seen = equations.linearise(y)
        if not written_out:  # otherwise XLA evaluates residuals for each use
            seen = lax.optimization_barrier(seen)
        g, jacobian = seen
        level, noise = equations.level(g, equations.scale(jacobian, y))
        left = after_test(level, left, extra=1, gives_up=left > 0)
        sizes, rows = scaled_rows(equations.scaled(jacobian))
        if refreshed:  # and in the extra iteration, within the tolerance, where both are alike
            along = jnp.where(left > max_steps - FROZEN_STEPS, along, rows)
        moved = corrected(equations, y, g / sizes, noise / sizes, rows, along)
        return jnp.where(left > 0, moved, y), left

    y: Any = candidate
    left = counter(max_steps)
    if written_out:
        like = jax.eval_shape(start, y)
        written: tuple[Any, ...] = in_scalars(start, y), in_scalars(iterate, like, y, left)
        if None not in written:
            # From here on arrays are tuples of scalars.
            start, iterate = written
            y = components(y)
    if not isinstance(y, tuple):
        y = lax.optimization_barrier(y)  # otherwise XLA evaluates it for each use
    first = start(y)

    def body(carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        y, left, count = carry
        y, left = iterate(first, y, left)
        return y, left, count + (left > 0).astype(int)

    y, left, count = lax.while_loop(lambda x: any_lane(x[1] > 0), body, (y, left, jnp.asarray(0)))
    return Solved(joined(candidate, y), left != -1, count)


def _of_many(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: None,
    max_steps: int,
) -> Solved:
    """For more constraints, dense or sparse: an iteration evaluates only the residuals. The Gram
    matrix at the candidate is factored once, and residuals are judged by their scales there. By
    those at the result it is decided at the end whether that is on the manifold."""
    del directions
    y = lax.optimization_barrier(candidate)
    g, jacobian = equations.linearise(y)
    scale = equations.scale(jacobian, y)
    scaled = equations.scaled(jacobian)
    sizes, rows = scaled_rows(scaled)
    solve = factored(gram_matrix(rows, rows), sizes)
    if isinstance(scaled, SparseRows):  # a reverse pass has no indices
        _, vjp = jax.vjp(equations.residual, y)
        combine = lambda multiplier: equations.scaled(vjp(multiplier)[0])  # noqa: E731
    else:
        combine = lambda multiplier: combined(multiplier, scaled)  # noqa: E731

    def test(g: Array, left: Array) -> tuple[Array, Array]:
        level, noise = equations.level(g, scale)
        left = after_test(level, left, extra=1, gives_up=left > 0)
        return jnp.where(jnp.abs(g) <= noise, 0, g), left

    def body(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        y, g, left, count = carry
        multiplier, terms = solve(g), None
        if equations.may_vanish and not isinstance(scaled, SparseRows):
            terms = combined(jnp.abs(multiplier), jnp.abs(scaled))
        moved = _moved(equations, y, combine(multiplier), terms)
        y = jnp.where(left > 0, moved, y)
        g, left = test(equations.residual(y), left)
        return y, g, left, count + (left > 0).astype(int)

    g, left = test(g, counter(max_steps))
    start = y, g, left, (left > 0).astype(int)
    y, _, left, count = lax.while_loop(lambda x: any_lane(x[2] > 0), body, start)
    return Solved(y, (left != -1) & equations.holds(y), count)


def corrected(
    equations: Equations, y: Array, g: Array, noise: Array, rows: Jacobian, along: Jacobian
) -> Array:
    """`y - s Vᵀ (U Vᵀ)⁻¹ g` for the rows `U`, which are scaled as the residuals `g` and their noise
    are, and the directions `V`."""
    gram, terms = gram_matrix(rows, along), None
    if equations.may_vanish:
        sizes = jtu.tree_map(jnp.abs, along)
        terms = combined(jnp.abs(gram_solve(gram, g, noise)), sizes)
    return _moved(equations, y, combined(*eliminated(gram, g, along, noise)), terms)


def _moved(equations: Equations, y: Array, change: Array, terms: Array | None) -> Array:
    """`y - s change`. If a correction cancels a component down to roundoff, that is set to zero: a
    tolerance that is relative to the component could never be met by what is left."""
    rest = y - equations.moved(change)
    size, units = jnp.abs(y), _CANCELLED
    if terms is not None:
        size, units = size + jnp.abs(equations.moved(terms)), _CANCELLED_TERMS
    return jnp.where(jnp.abs(rest) <= units * float(jnp.finfo(y.dtype).eps) * size, 0, rest)
