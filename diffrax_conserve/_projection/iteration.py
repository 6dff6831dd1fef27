"""Newton's iteration for the multipliers, the loop that `Newton` and `SimplifiedNewton` share."""

from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, PyTree

from .._custom_types import Y
from .._tree import tree_cancel, tree_sub, tree_uniform
from .elimination import Vector
from .equations import Equations
from .linearise import linearise
from .residual import within

# The iteration ends if a step with this much damping does not reduce the residual.
_MOST_DAMPING = 1e8
# A `Start` is used if its squared residual is at most this fraction of the candidate's.
_WELL_STARTED = 1e-4


class Iterate(NamedTuple):
    """A state with its multipliers, residual and scale, and the number of steps up to it."""

    y: Y
    multiplier: Vector
    g: Vector
    scale: Vector
    num_steps: Int[Array, ""]


class _Carry(NamedTuple):
    unfinished: Bool[Array, ""]
    returned: Bool[Array, ""]  # to `best`, because the last state was worse
    damping: Array
    merit: Array  # of `best`
    y: Y
    multiplier: Vector
    best: Iterate


class Start(NamedTuple):
    """The state and multipliers after `num_steps` steps; after none, those of the candidate."""

    y: Y
    multiplier: Vector
    num_steps: Int[Array, ""]


def iterate(
    equations: Equations,
    *,
    frozen: bool,
    max_steps: int,
    start: Start | None = None,
    enabled: Bool[Array, ""] | bool = True,
) -> tuple[Vector, Iterate]:
    r"""Newton's method from the candidate, or from a `start`. Returns the residual at the candidate
    and the last iterate.

    Each step solves $(G(y) M^{-1} B^\top + D)\, \Delta = g(y)$ and moves $y$ by
    $-M^{-1} B^\top \Delta$. With `frozen`, $B$ is the Jacobian at the candidate, so that the
    result is $\hat y + M^{-1} B^\top \lambda$; otherwise it is that at $y$, which is a Gauss-Newton
    iteration. The damping $D = \mu \min(10^{-2}, |g|^2)$, relative to the diagonal, vanishes with
    the relative residual: the iteration can pass near points where gradients are parallel, and
    converges quadratically elsewhere. If a step increases the residual, it is repeated from the
    last state with ten times the $\mu$, as in the Levenberg-Marquardt method. If the residual of
    `start` is more than a hundredth of the candidate's, the iteration begins at the candidate.
    """
    before, at_candidate = linearise(equations.residual, equations.candidate)
    # A term may vanish at one state and not at the next; this scale does not.
    first = equations.scale(at_candidate, tree_uniform(equations.candidate))

    # In a batch, a loop evaluates its condition in two places. If these round differently, the loop
    # may never end, so the condition is evaluated once and carried.
    def body(carry: _Carry) -> _Carry:
        _, returned, damping, last, y, multiplier, best = carry
        g, jacobian = linearise(equations.residual, y)
        scale = equations.scale(jacobian, y)
        merit = equations.merit(g, scale)
        better = (equations.merit(g, best.scale) < last) & (merit < jnp.inf)
        stays = better | returned
        count = best.num_steps + (better & ~returned & (last < jnp.inf)).astype(int)
        success = within(g, equations.tolerance(scale))
        stalled = returned | (merit > 0.25 * last)
        ended = success & (equations.safely_satisfied(g, scale) | stalled)
        # Without an earlier state there is none to return to.
        lost = ~stays & ((damping > _MOST_DAMPING) | ~(last < jnp.inf))
        unfinished = ~lost & ~(stays & (ended | (count >= max_steps)))

        base = at_candidate if frozen else jacobian
        # Near a state where all terms vanish, the residual never becomes small relative to their
        # size there.
        most = equations.scale(jacobian, tree_uniform(y))
        most = jtu.tree_map(jnp.maximum, first, most)
        vanishing = jnp.minimum(1e-2, equations.merit(g, most))
        change = equations.gram_solver(jacobian, base, damping * vanishing).solve(g)
        trial = tree_cancel(y, equations.correction(base, change)), tree_sub(multiplier, change)

        def choose(a: PyTree[Array], b: PyTree[Array]) -> PyTree[Array]:
            return jtu.tree_map(lambda a, b: jnp.where(stays, a, b), a, b)

        best = choose(Iterate(y, multiplier, g, scale, count), best)
        y, multiplier = choose(trial, (best.y, best.multiplier))
        less = jnp.where(returned, damping, jnp.maximum(0.1 * damping, 1.0))
        damping, merit = choose((less, merit), (10.0 * damping, last))
        return _Carry(unfinished, ~stays, damping, merit, y, multiplier, best)

    carry = _begin(equations, before, first, start, jnp.asarray(enabled))
    return before, lax.while_loop(lambda carry: carry.unfinished, body, carry).best


def _begin(
    equations: Equations,
    before: Vector,
    scale: Vector,
    start: Start | None,
    enabled: Bool[Array, ""],
) -> _Carry:
    # All carried values are batched from the start; otherwise jax traces the body again to find out
    # which are.
    zero = jnp.where(enabled, 0, 0)
    zeros = jtu.tree_map(lambda x: jnp.zeros_like(x) + zero.astype(x.dtype), before)
    one = 1 + zero.astype(jtu.tree_leaves(before)[0].dtype)
    damping, merit = one, one * jnp.inf
    best = Iterate(equations.candidate, zeros, before, scale, zero)
    y, multiplier = best.y, zeros
    if start is not None:
        y, multiplier, count = start
        required = _WELL_STARTED * equations.merit(before, scale)
        known = (count > 0) & (required < jnp.inf)
        damping = jnp.where(known, 0.1 * damping, damping)  # which is one after a return
        merit = jnp.where(known, required, merit)
        best = best._replace(num_steps=zero + jnp.maximum(count - 1, 0))
    return _Carry(enabled, zero > 0, damping, merit, y, multiplier, best)
