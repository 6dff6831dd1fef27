"""Checks for steps of a flow map that are negative or too long."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from ..._custom_types import RealScalarLike
from ..._solver.diffrax_private import member, register
from ..._solver.terms import time_direction
from .policies import StepResult

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
