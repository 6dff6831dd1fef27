"""The verdict on a step: whether its projection failed, why, and whether it can be saved."""

import diffrax as dfx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._custom_types import RealScalarLike, Y
from .._tree import ravel
from .diffrax_private import member as _member
from .diffrax_private import register
from .state import State

_SMALLER = (
    "Take smaller steps, or pass `projection=diffrax_conserve.Newton()`, which copes with "
    "candidates far from the manifold. Check by `check_invariance` that the quantity is conserved "
    "at all. "
)
_ENTRY = (
    "`diffrax_conserve.statistics(sol).worst`, of a solve with `SaveAt(solver_state=True)`, tells "
    "the entry of the manifold."
)
_FIRST = register(
    "the solve cannot start: the initial state violates a `Constraint`, or a function of the "
    "manifold is not finite there. Start on the manifold: "
    "`y0, info = diffrax_conserve.project(manifold, y0, t=t0, args=args)`. " + _ENTRY,
    "the projection of a step failed: the state that the wrapped solver proposed is not finite, or "
    "a function of the manifold there or at the initial state, or the iteration diverged. Check "
    "the vector field and `fn`. " + _SMALLER + _ENTRY,
    "the projection of a step failed: the correction moved the state further than `max_correction` "
    "allows. Perhaps the quantity is not conserved at all, which `check_invariance` tells, or the "
    "state jumped to another part of the manifold. Take smaller steps, or pass another "
    "`max_correction`.",
    "the projection of a step failed: the manifold was not reached. " + _SMALLER + "If it is, the "
    "constraints may contradict each other or the bounds. " + _ENTRY,
)
_START, _NOT_FINITE, _TOO_FAR, _NOT_REACHED = 1, 2, 3, 4


def member(cause: Int[Array, ""]) -> dfx.RESULTS:
    """The result for a cause other than 0."""
    return _member(_FIRST - 1 + cause)


def verdict(
    ok: Bool[Array, ""],
    state: State,
    times: tuple[RealScalarLike, RealScalarLike],
    states: tuple[Y, Y, Y],
    max_correction: RealScalarLike | None,
    every: int,
    has_constraints: bool,
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """The cause of the failure of a step, 0 if it succeeded; and whether a failure is final,
    because the candidate is already very close to the last state, the step is a roundoff of time,
    or the solve cannot start. `states` are the last state, the candidate and the result."""
    last, candidate, result = (ravel(y) for y in states)
    eps = float(jnp.finfo(candidate.dtype).eps)
    # By sums, because NaN can get lost in a maximum on a CPU; in one, which is one kernel.
    parts = jnp.stack([candidate - last, candidate, result - candidate])
    moved, size, correction = jnp.sum(jnp.abs(parts), axis=1)
    cause = jnp.where(ok, 0, jnp.where(jnp.isfinite(correction), _NOT_REACHED, _NOT_FINITE))
    if max_correction is not None:
        # A correction this small is allowed however short the step.
        share = jnp.asarray(max_correction, size.dtype) * every
        share = jnp.minimum(share, float(jnp.finfo(size.dtype).max))  # infinity times zero is NaN
        too_far = ok & ~(correction <= share * moved + 8 * eps**0.5 * size)
        too_far = too_far if state.is_first is None else too_far & ~state.is_first
        cause = jnp.where(too_far, _TOO_FAR, cause)
    lost = jnp.any(jnp.isnan(state.values))
    if has_constraints:  # otherwise a function was not finite
        cause = jnp.where(lost, _START, cause)
    t0, t1 = times
    instant = jnp.abs(t1 - t0) <= 8 * jnp.finfo(jnp.result_type(t1)).eps * jnp.abs(t1)
    near = moved <= max(5e-4, 16 * eps) * size
    return cause, near | instant | lost
