"""The checks that the learned solvers share, when they are traced and at run time."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..._custom_types import Args, RealScalarLike, Y
from ..._solver.diffrax_private import member, register
from ..._solver.terms import is_backsolve, time_direction
from ..._tree import tree_shapes
from .._networks.flow_map import AbstractFlowMap
from .policies import StepResult
from .sweeps import increment


def check_nodes(nodes: int) -> None:
    if not isinstance(nodes, int) or nodes < 2:
        raise ValueError(f"`nodes` must be an integer of at least 2, but is {nodes!r}.")


def check_learned_terms(terms: PyTree[dfx.AbstractTerm], name: str) -> None:
    """Raises if the solver is given the adjoint equations, for which it was not trained."""
    if is_backsolve(terms):
        raise ValueError(
            f"`{name}` cannot solve the adjoint equations of `diffrax.BacksolveAdjoint`: it was "
            "trained for the equations themselves. Name another solver for them, for example "
            "`BacksolveAdjoint(solver=diffrax.Tsit5())`, or use "
            "`diffrax.RecursiveCheckpointAdjoint()`."
        )


def check_output(function: Callable[..., Any], arguments: tuple, y0: Y, name: str) -> None:
    """Raises unless `function(*arguments)` is shaped like the state."""
    arguments = jtu.tree_map(jnp.asarray, arguments)
    output = eqx.filter_eval_shape(function, *arguments)
    got, expected = tree_shapes(output), tree_shapes(y0)
    if got != expected:
        raise ValueError(
            f"`{name}` returns the structure {got}, but the state has {expected}. "
            "Both must be the same."
        )


_TOO_LONG = register(
    "a step is longer than the flow map was trained for, its `max_step`. Take a shorter `dt0`, or "
    "repeat the flow map by `diffrax_conserve.learned.Repeated`."
)


def refuse_backwards(h: Array, terms: Any, max_step: Any) -> Array:
    """`h`, with a run-time error in a solve backwards in time."""
    known = not isinstance(max_step, jax.core.Tracer)
    longest = f"{float(max_step):.6g}" if known else "its `max_step`"
    return eqx.error_if(
        h,
        ~(h * time_direction(terms, h) >= 0),
        "The solve goes backwards in time, but the flow map was trained for steps from 0 to "
        f"{longest}. Solve forwards in time.",
    )


def reject_too_long(step: StepResult, h: Array, t1: RealScalarLike, max_step: Any) -> StepResult:
    """`step`, or for a step that is too long a failure with an infinite error, so that an adaptive
    controller tries a smaller step."""
    # The difference of two large times has their roundoff.
    slack = 1e-6 * max_step + 8 * jnp.finfo(h.dtype).eps * jnp.abs(t1)
    fits = h <= max_step + slack
    error = jtu.tree_map(lambda e: jnp.where(fits, e, jnp.inf), step.error)
    result = dfx.RESULTS.where(fits, step.result, member(_TOO_LONG))
    return StepResult(step.y1, error, step.coefficients, result)


# The largest accepted difference of the two slopes, relative to the larger one. The slope of a
# Taylor polynomial is exact, those of the paper's networks are off by up to 70 % in some states.
_EXACT, _LEARNED = 1e-3, 0.75
# A difference that over the longest step moves the state by less than this, relative to its norm,
# is ignored.
_LITTLE = 1e-3


def refuse_another_field(
    flow_map: AbstractFlowMap,
    known: tuple[Args, ...],
    terms: dfx.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
) -> None:
    """A run-time error unless the slope of the flow map at `y0` is the vector field there.

    The check is not differentiated.
    """
    start, _ = ravel_pytree(y0)
    length = jnp.asarray(t1 - t0)
    slope = ravel_pytree(flow_map.slope(y0, *known))[0].astype(start.dtype)
    field = increment(terms, t0, t1, y0, args)(jnp.zeros_like(length), start) / length
    slope, field = lax.stop_gradient(slope), lax.stop_gradient(field)
    difference, size = _norm(slope - field), jnp.maximum(_norm(slope), _norm(field))
    little = _LITTLE * _norm(lax.stop_gradient(start)) / jnp.asarray(flow_map.max_step)
    allowed = _LEARNED * size + little if flow_map.order == 0 else _EXACT * size
    wrong = difference > allowed
    wrong, *norms = _worst(wrong, _norm(slope), _norm(field), difference)
    lax.cond(wrong, lambda *n: jax.debug.callback(_raise, *n), lambda *_: None, *norms)


def _raise(slope: Any, field: Any, difference: Any) -> None:
    raise ValueError(
        "The flow map was not trained for this vector field: at the initial state its slope for "
        f"h -> 0 has the norm {float(slope):.6g}, the vector field {float(field):.6g}, and their "
        f"difference {float(difference):.3g}. Solve the equation that it was trained for, with the "
        "same parameters, or pass `check_field=False` to the solver to use it all the same."
    )


def _norm(x: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(jnp.abs(x))))


@jax.custom_batching.custom_vmap
def _worst(wrong: Array, *norms: Array) -> tuple[Array, ...]:
    """Its arguments; in a batch those of a single lane, a wrong one if there is any, so that the
    branch is not batched."""
    return wrong, *norms


@_worst.def_vmap
def _(count: int, batched: Any, wrong: Array, *norms: Array) -> Any:
    whole = [
        x if is_batched else jnp.broadcast_to(x, (count, *x.shape))
        for x, is_batched in zip((wrong, *norms), batched, strict=True)
    ]
    index = jnp.argmax(whole[0])
    return _worst(*(x[index] for x in whole)), (False,) * len(whole)
