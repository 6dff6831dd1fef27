"""The checks that the learned solvers share. At run time their outcome is the result of a lane.

An exception at run time would end a whole batch, also under `throw=False`. So `init` finds out
whether the solve can succeed at all, as an index into diffrax's results, which is carried in the
solver state; and a step that is refused returns that result.
"""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jax.numpy.linalg import norm
from jaxtyping import Array, Int, PyTree

from ..._custom_types import Args, RealScalarLike, Y
from ..._solver.diffrax_private import register, result_at
from ..._solver.terms import in_field_time, is_backsolve
from ..._tree import tree_all_finite, tree_shapes
from .._networks.flow_map import AbstractFlowMap
from .collocation import increment
from .policies import StepResult

# An index into diffrax's results; zero is success.
Refused = Int[Array, ""]

_TOO_LONG = register(
    "a step is longer than the flow map was trained for, its `max_step`. Take a shorter `dt0`, or "
    "repeat the flow map by `diffrax_conserve.learned.Repeated`."
)
_BACKWARDS = register(
    "the solve goes backwards in time, but the flow map was trained for steps from 0 to its "
    "`max_step`. Solve forwards in time."
)
_ANOTHER_FIELD = register(
    "the flow map was not trained for this vector field: at the initial state its slope for h -> 0 "
    "is another. Solve the equation that it was trained for, with the same parameters, or pass "
    "`check_field=False`."
)
_NOT_FINITE = register(
    "a state is not finite: the initial one, or that of the flow map after a step. Start where the "
    "flow map was trained, or let a classical solver take the steps outside its domain, by "
    "`outside=diffrax.Tsit5()`."
)


def check_learned_terms(terms: PyTree[dfx.AbstractTerm], name: str) -> None:
    """Raises if the solver is given the adjoint equations, for which it was not trained."""
    if is_backsolve(terms):
        raise ValueError(
            f"`{name}` cannot solve the adjoint equations of `diffrax.BacksolveAdjoint`. Name "
            "another solver for them, for example `BacksolveAdjoint(solver=diffrax.Tsit5())`, or "
            "use `diffrax.RecursiveCheckpointAdjoint()`."
        )


def check_output(function: Callable[..., Any], arguments: tuple, y0: Y, name: str) -> None:
    arguments = jtu.tree_map(jnp.asarray, arguments)
    output = eqx.filter_eval_shape(function, *arguments)
    got, expected = tree_shapes(output), tree_shapes(y0)
    if got != expected:
        raise ValueError(f"`{name}` returns the structure {got}, but the state has {expected}.")


# The largest accepted difference of the two slopes, relative to the larger one. The slope of a
# Taylor polynomial is exact, those of the paper's networks are off by up to 70 % in some states.
_EXACT, _LEARNED = 1e-3, 0.75
# A difference that over the longest step moves the state by less than this, relative to its norm,
# is ignored.
_LITTLE = 1e-2
# A learned slope for h -> 0 is an extrapolation from longer steps, so it is compared only as far as
# the field is nearly constant in them, which it is not in stiff equations. With these numbers no
# shipped flow map refuses any of a thousand states of its own system.
_CHANGE = 0.2


def refused_from_start(
    flow_map: AbstractFlowMap, known: tuple[Args, ...], check_field: bool, *given: Any
) -> Refused:
    """Why no step of a solve can succeed, or zero, `given` the arguments of the `init` of the
    solver. Not differentiated."""
    terms, t0, t1, y0, _ = given
    start, h = lax.stop_gradient(ravel_pytree(y0)[0]), jnp.asarray(t1 - t0)
    finite, another = tree_all_finite(start), jnp.asarray(False)
    if check_field:
        change = increment(*given)
        slope = ravel_pytree(flow_map.slope(y0, *known))[0].astype(start.dtype)
        field = change(jnp.zeros_like(h), start) / h
        later = change(jnp.zeros_like(h), start + flow_map.max_step * field) / h
        slope, field, later = (
            lax.stop_gradient(x).astype(start.dtype) for x in (slope, field, later)
        )
        size = jnp.maximum(norm(slope), norm(field))
        allowed = _EXACT * size
        if flow_map.order == 0:
            little = _LITTLE * norm(start) / flow_map.max_step
            allowed = _LEARNED * size + _CHANGE * norm(later - field) + little
        # False if that is not known.
        another = norm(slope - field) > allowed
        finite &= tree_all_finite((slope, field))
    refused = jnp.where(finite, jnp.where(another, _ANOTHER_FIELD, 0), _NOT_FINITE)
    _, h = in_field_time(terms, h)
    return jnp.where(h >= 0, refused, _BACKWARDS)


def with_result(
    step: StepResult, refused: Refused, h: Array, t1: RealScalarLike, max_step: Any
) -> StepResult:
    """`step` with its result. An adaptive controller tries again with a smaller step if this one
    is too long or not finite, as its error is infinite; it keeps a refused one, which has none."""
    # The difference of two large times has their roundoff.
    slack = 1e-6 * max_step + 8 * jnp.finfo(h.dtype).eps * jnp.abs(t1)
    failed = jnp.where(tree_all_finite(step.y1), 0, _NOT_FINITE)
    failed = jnp.where(h <= max_step + slack, failed, _TOO_LONG)
    failed = jnp.where(h >= 0, failed, _BACKWARDS)  # in steps by hand
    ended = refused > 0

    def error(e: Array) -> Array:
        return jnp.where(ended, 0, jnp.where(failed > 0, jnp.inf, e))

    failed = jnp.where(ended, refused, failed)
    result = dfx.RESULTS.where(failed > 0, result_at(failed), step.result)
    return StepResult(step.y1, jtu.tree_map(error, step.error), step.coefficients, result)
