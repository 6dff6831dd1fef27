"""How a step fails: why, whether a shorter step could be better, and what is reported.

diffrax forgets the solver state of a step that it rejects. So no rule here can count attempts or
compare a step with the last one that failed: each must tell from the step alone.
"""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._constants import TOLERANCE_IN_EPS
from .._custom_types import BoolScalarLike, Manifold, RealScalarLike
from .._manifold import Constraint, is_entry
from .._numerics.problem import Problem
from .._tree import eps_of
from .diffrax_private import register, result_at

_ENTRY = (
    "`print(diffrax_conserve.statistics(sol))`, with `SaveAt(solver_state=True)`, names the entry."
)
FIRST_RESULT = register(
    "a step cannot start: its state is off the manifold. At the start of a solve it must satisfy "
    "each `Constraint`: `y0, info = diffrax_conserve.project(manifold, y0, t=t0, args=args)`, of a "
    "`DAE` `y0 = dae.consistent(x, z, t=t0, args=args)`; a quantity that keeps the "
    "value that it has at the start is a `FirstIntegral`. A solve that continues from a "
    "`solver_state` keeps the values of that one: leave it out if you have changed the state, "
    "`args` or the manifold. After a jump of the vector field end the solve there, `project`, and "
    "go on. " + _ENTRY,
    "the projection of a step failed: a state is not finite, or a function of the manifold there, "
    "or the iteration diverged. At the first step look for NaN in `y0` and `args`, for "
    "derivatives of roots and norms at zero, which are infinite or NaN, and for overflow, in "
    "float32 of squares of 2e19: use other units, or float64. Later check the vector "
    "field and `fn`, and take smaller steps. " + _ENTRY,
    "the projection of a step failed: the correction is a larger share of the step than "
    "`max_correction` allows. Check by `check_invariance` that the quantity is conserved at all, "
    "take smaller steps, or pass another `max_correction`.",
    "the projection of a step failed: the manifold was not reached. Take smaller steps, as "
    "`diffrax.PIDController` does, or pass `projection=diffrax_conserve.Newton()` to a "
    "`ManifoldProjection`, which copes with far candidates. Check by `check_invariance` that the "
    "quantity is conserved at all. If terms that cancel inside `fn` have grown since the start, "
    "pass a projection with `atol`. " + _ENTRY,
    "the projection of a step failed: the manifold was not reached, by the first step or however "
    "short a step. What is asked for may contradict itself: a `value` that no state has, `lower` "
    "or `upper` that exclude the manifold, or entries that exclude each other, such as all "
    "integrals of a single wave on a coarse grid, for which `SimplifiedNewton(metric=1.0)` may do: "
    "change or leave out one of them. Or the quantity is not conserved, as `check_invariance` "
    "tells, or a first step of fixed length is too long. " + _ENTRY,
)
# The causes of a failure, in the order of their messages above, of which `FIRST_RESULT` is the
# first. Zero is no failure.
_START, _NOT_FINITE, _TOO_FAR, _NOT_REACHED, _NO_STATE = range(1, 6)


def starts_off_manifold(
    problem: Problem, manifold: Manifold, y: Float[Array, " n"]
) -> Bool[Array, ""]:
    """Whether a residual at a state exceeds its tolerance, and also `√ε` of its scale.

    Not tested are integrals with a `value`, to which the first projection moves the state, and
    integrals whose gradient is NaN, as that of the speed is at rest. The limit is `√ε`, because
    initial states are often given with fewer digits. The changes of the state in a step enter the
    scale, because all terms may vanish at one state.
    """
    g, jacobian = problem.linearise(y)
    scale = problem.scale(jacobian, y)
    limit = jnp.maximum(eps_of(y) ** 0.5 * scale, problem.tolerance(scale))
    entries = jtu.tree_leaves(manifold, is_leaf=is_entry)
    is_tested = problem.per_residual([entry.value is None for entry in entries])
    is_constraint = problem.per_residual([isinstance(entry, Constraint) for entry in entries])
    is_untestable = jnp.isnan(limit) & ~is_constraint
    return jnp.any(is_tested & ~is_untestable & ~(jnp.abs(g) <= limit))


def failure_cause(
    ok: Bool[Array, ""],
    cannot_start: Bool[Array, ""],
    values: Float[Array, " m"],
    must_be_finite: Float[Array, " n"],
    too_far: BoolScalarLike = False,
    unreachable: BoolScalarLike = False,
) -> Int[Array, ""]:
    """Why a step failed, 0 if it did not.

    - `values`: the conserved values, or what else must be known from the start of the solve.
    - `must_be_finite`: the state at its end, or the correction.
    - `unreachable`: whether a failure to reach the manifold is reported as a contradiction of its
      entries, instead of with the advice to take shorter steps.
    """
    # A sum is finite only if all its terms are. It is one kernel, a test of each component is two.
    finite = jnp.abs(jnp.sum(must_be_finite)) < jnp.inf
    finite_values = jnp.all(jnp.isfinite(values))
    cause = jnp.where(ok, 0, jnp.where(unreachable, _NO_STATE, _NOT_REACHED))
    cause = jnp.where(ok & too_far, _TOO_FAR, cause)
    cause = jnp.where(cannot_start, _START, cause)
    return jnp.where(finite_values & (finite | (cause == 0)), cause, _NOT_FINITE)


def is_shortest_step(
    length: RealScalarLike,
    time: RealScalarLike,
    change: Float[Array, " n"],
    candidate: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Whether a step that failed is so short that no shorter one is better.

    A controller answers a failed step by a shorter one. That ends when no component moves by more
    than roundoff, or when the length of the step is roundoff of the `time`, the larger one of the
    time itself and the length of the first step. The time alone would not do in a solve from zero.
    """
    size = jnp.abs(candidate)
    at_rest = jnp.all(change <= TOLERANCE_IN_EPS * eps_of(size) * size)
    return at_rest | no_time_passes(length, time)


def no_time_passes(length: RealScalarLike, time: RealScalarLike) -> Bool[Array, ""]:
    """Whether the length of a step is roundoff of a time."""
    return jnp.abs(length) <= TOLERANCE_IN_EPS * eps_of(length) * time


def nan_if_failed(
    cause: Int[Array, ""], y: PyTree[Array], result: dfx.RESULTS
) -> tuple[Any, dfx.RESULTS]:
    """The state and the result of a step. The state at the end of a step that failed is NaN. In a
    batch the lanes that have failed are evaluated until the last one ends, and with NaN each
    projection ends after one iteration. If the wrapped solver has failed by itself, its own
    `result` is kept, unless the step could not start."""
    failed = (cause > 0) & ((result == dfx.RESULTS.successful) | (cause == _START))
    result = dfx.RESULTS.where(failed, result_at(FIRST_RESULT - 1 + cause), result)
    return jtu.tree_map(lambda y: jnp.where(cause > 0, jnp.nan, y), y), result


def error_for_controller(cause: Int[Array, ""], final: Bool[Array, ""], error: Any) -> Any:
    """The error estimate that a step reports.

    diffrax looks at the result of a step only if the step is accepted. So a failed step reports a
    huge error, by which an adaptive controller rejects it and tries a shorter one. A failure that
    is final reports no error: the step is accepted, and its result ends the solve. The error is
    huge but finite, because the norm of an infinite complex number would be NaN.
    """

    def report(e: Array) -> Array:
        huge = jnp.where(final, 0, float(jnp.finfo(e.dtype).max) ** 0.5)
        return jnp.where(cause > 0, huge.astype(e.dtype), e)

    return jtu.tree_map(report, error)
