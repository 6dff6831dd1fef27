"""The undamped iteration, for candidates as near as the local error of a step.

It is Newton's method for the multipliers `λ` in `y = ŷ + s Uᵀ λ` (Hairer, Lubich and Wanner, IV.4,
equations (4.4) to (4.6)). Here `ŷ` is the candidate, `s` the units of the components, so that the
metric is `M⁻¹ = diag(s²)`, and the rows of `U = G(ŷ) diag(s)` are the gradients at the candidate in
these units. The directions stay those at the candidate during the whole iteration. So the result is
a function of the candidate and the multipliers alone, and its derivative follows from the implicit
function theorem (see `implicit`). The iteration is a Newton iteration nevertheless, because its
matrix `G(y) diag(s) Uᵀ` is evaluated anew at each state, except with many constraints.

Two forms of the loop are compiled. A single trajectory is fastest in arrays. In a batch of small
systems the same iteration is written out in scalars, which XLA fuses to one kernel. In every batch
the lanes iterate together until none goes on. The loop carries little, a state and two counts,
because for small systems moving the carry costs more than the arithmetic.
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

# Newton's method converges quadratically, so six iterations are more than a nearby candidate needs.
# If those of two to four constraints are not enough, the plane `ŷ + s Uᵀ λ` may miss the manifold.
# That happens on circular orbits: there the states with the given energy and angular momentum are a
# curve, not a surface. Then the iteration starts again at the candidate, and from there on its
# directions are the gradients at the last state. The number is a choice; the law that needs a
# second start is `tests/laws/test_never_silent.py -k almost_circular`.
FROZEN_STEPS = 6
# If a correction leaves at most this many units of roundoff of a component, the component is set to
# zero. The subtraction `y - change` and the change itself are each rounded by one unit.
_CANCELLED = 2
# If a component is corrected by several constraints whose terms cancel, the rest is compared with
# the sum of their sizes instead. Up to four terms are rounded, in the multiplier and in the
# product.
_CANCELLED_TERMS = 8


class Solved(NamedTuple):
    """The state, whether it is on the manifold, and the number of iterations."""

    y: Float[Array, " n"]
    ok: Bool[Array, ""]
    num_steps: Int[Array, ""]


class Iterate(NamedTuple):
    """What a loop carries: the state, which may be a tuple of scalars; the number of tests that are
    left, see `counter`; and the number of iterations that were made."""

    y: Any
    left: Array
    num_steps: Array


def chord(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Float[Array, "m n"] | None = None,
    *,
    max_steps: int,
) -> Solved:
    """The state `y = ŷ + s Uᵀ λ` on the manifold. The rows of `U` are the `directions`, by default
    the gradients `G diag(s)` at the candidate. Two to four constraints may change them if they lead
    nowhere; see `FROZEN_STEPS`."""
    arrays, static = eqx.partition((equations, candidate, directions), eqx.is_array)
    # Directions are given for one constraint only, by the projections along a line.
    few = directions is not None or equations.magnitude.size <= WRITTEN_OUT_MAX

    def run(iterate: Callable[..., Solved], arrays: Any) -> Solved:
        return iterate(*eqx.combine(arrays, static), max_steps)

    if not few:
        return jax.jit(ft.partial(run, _of_many))(arrays)
    # These are jitted, so that JAX traces each once, although it batches the loop over the steps of
    # a solve several times. `alone` runs where nothing is batched, and `lane` in a batch.
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
    """The number of tests that are left at the start of an iteration.

    A test of the state comes before each iteration and after the last, so there is one more than
    iterations. A lane goes on while the number is positive. In the end it is 0 if the manifold was
    reached, otherwise -1. It is stored in a byte if it fits, because a loop carries it.
    """
    fits = max_steps + 1 < jnp.iinfo(jnp.int8).max
    return jnp.asarray(max_steps + 1, jnp.int8 if fits else jnp.int32)


def after_test(level: Array, left: Array, *, extra: int, gives_up: Array) -> Array:
    """The number of tests that are left after a state of the given `level` was tested.

    A state whose residuals are noise is done. One that is merely within the tolerance is improved
    by `extra` more iterations, which bring it to roundoff. If no test is left and the state is off
    the manifold, the iteration has failed. A residual that is not finite cannot recover, unless the
    iteration shortens its step. Where it does not but `gives_up`, it makes one more iteration, by
    which the NaN reaches the state, and stops.
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
    # After so many iterations, and the test that follows them, this is what `left` is. One more
    # iteration would be too few to start again; 1 is what is left in the extra iteration, too.
    left_then = max_steps - FROZEN_STEPS
    may_start_again = directions is None and equations.magnitude.size > 1 and left_then > 1

    def start(y: Any) -> Any:
        """The candidate and the directions, which the iterations share."""
        if directions is not None:
            return y, directions
        return y, scaled_rows(equations.scaled(equations.linearise(y)[1]))[1]

    def iterate(first: Any, y: Any, left: Array) -> tuple[Any, Array]:
        """Tests a state, and if tests are left moves it."""
        candidate, along = first
        if may_start_again:
            # If the manifold was not reached then, the state after the next iteration is replaced
            # by the candidate, because a plane that misses the manifold may have led far away.
            y = jnp.where(left == left_then, candidate, y)
        seen = equations.linearise(y)
        if not written_out:
            # Without a barrier XLA would evaluate the residuals once for each use of them.
            seen = lax.optimization_barrier(seen)
        g, jacobian = seen
        level, noise = equations.level(g, equations.scale(jacobian, y))
        left = after_test(level, left, extra=1, gives_up=left > 0)
        sizes, rows = scaled_rows(equations.scaled(jacobian))
        if may_start_again:
            # From then on the directions are the gradients at the last state. So they are in the
            # extra iteration within the tolerance too, where `left` is 1: there the correction is
            # so short that both are alike.
            along = jnp.where(left > left_then, along, rows)
        moved = corrected(equations, y, g / sizes, noise / sizes, rows, along)
        return jnp.where(left > 0, moved, y), left

    y: Any = candidate
    left = counter(max_steps)
    if written_out:
        like = jax.eval_shape(start, y)
        written: tuple[Any, ...] = in_scalars(start, y), in_scalars(iterate, like, y, left)
        if None not in written:  # a function that is too large stays in arrays
            start, iterate = written
            y = components(y)  # from here on arrays are tuples of scalars
    if not isinstance(y, tuple):
        # The candidate is the end of a step. Without a barrier XLA would evaluate that step once
        # for each use of the candidate.
        y = lax.optimization_barrier(y)
    first = start(y)

    def body(now: Iterate) -> Iterate:
        y, left = iterate(first, now.y, now.left)
        return Iterate(y, left, now.num_steps + (left > 0).astype(int))

    now = Iterate(y, left, jnp.asarray(0))
    end = lax.while_loop(lambda now: any_lane(now.left > 0), body, now)
    return Solved(joined(candidate, end.y), end.left != -1, end.num_steps)


def _of_many(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: None,
    max_steps: int,
) -> Solved:
    """For more constraints, dense or sparse: the simplified Newton iteration, whose matrix is that
    at the candidate too. It is factored once, so that an iteration evaluates only the residuals.

    The iteration also compares residuals with their scales at the candidate, because those at each
    state would need a Jacobian. So at the end we test the result once more, by its own scales.
    """
    del directions
    y = lax.optimization_barrier(candidate)
    g, jacobian = equations.linearise(y)
    scale = equations.scale(jacobian, y)
    scaled = equations.scaled(jacobian)
    sizes, rows = scaled_rows(scaled)
    solve = factored(gram_matrix(rows, rows), sizes)
    if isinstance(scaled, SparseRows):  # a reverse pass is faster than a sum over indices
        _, vjp = jax.vjp(equations.residual, y)
        combine = lambda multiplier: equations.scaled(vjp(multiplier)[0])  # noqa: E731
    else:
        combine = lambda multiplier: combined(multiplier, scaled)  # noqa: E731

    def test(g: Array, left: Array) -> tuple[Array, Array]:
        """The residuals without those that are noise, which are not corrected, and `left`."""
        level, noise = equations.level(g, scale)
        left = after_test(level, left, extra=1, gives_up=left > 0)
        return jnp.where(jnp.abs(g) <= noise, 0, g), left

    def body(carry: tuple[Iterate, Array]) -> tuple[Iterate, Array]:
        now, g = carry
        multiplier, terms = solve(g), None
        if equations.may_vanish and not isinstance(scaled, SparseRows):
            terms = combined(jnp.abs(multiplier), jnp.abs(scaled))
        moved = _moved(equations, now.y, combine(multiplier), terms)
        y = jnp.where(now.left > 0, moved, now.y)
        g, left = test(equations.residual(y), now.left)
        return Iterate(y, left, now.num_steps + (left > 0).astype(int)), g

    g, left = test(g, counter(max_steps))
    start = Iterate(y, left, (left > 0).astype(int)), g
    end, _ = lax.while_loop(lambda carry: any_lane(carry[0].left > 0), body, start)
    return Solved(end.y, (end.left != -1) & equations.holds(end.y), end.num_steps)


def corrected(
    equations: Equations, y: Array, g: Array, noise: Array, rows: Jacobian, along: Jacobian
) -> Array:
    """`y - s Vᵀ (U Vᵀ)⁻¹ g`, one iteration of Newton's method along given directions.

    The rows `U` are the gradients at `y`, the rows of `along` the directions `V`. The residuals `g`
    and their noise are divided by the same sizes as the rows of `U`.
    """
    gram, terms = gram_matrix(rows, along), None
    if equations.may_vanish:
        sizes = jtu.tree_map(jnp.abs, along)
        terms = combined(jnp.abs(gram_solve(gram, g, noise)), sizes)
    return _moved(equations, y, combined(*eliminated(gram, g, along, noise)), terms)


def _moved(equations: Equations, y: Array, change: Array, terms: Array | None) -> Array:
    """`y - s change`. If the correction cancels a component down to roundoff, we set it to exactly
    zero: a tolerance that is relative to the component could never be met by what is left.

    The `terms` are the sizes of the constraints' contributions to `change`, given where all terms
    of a residual may vanish. If they are much larger than their sum, their roundoff is what is
    left.
    """
    rest = y - equations.moved(change)
    size, units = jnp.abs(y), _CANCELLED
    if terms is not None:
        size, units = size + jnp.abs(equations.moved(terms)), _CANCELLED_TERMS
    return jnp.where(jnp.abs(rest) <= units * float(jnp.finfo(y.dtype).eps) * size, 0, rest)
