"""Steps of a flow map that are longer than it was trained for, or negative."""

import math
from typing import Any

import diffrax as dfx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._custom_types import RealScalarLike
from ._outside import Taken
from ._refusal import refuse_if
from ._results import numbered
from ._terms import time_direction


def refuse_backwards(h: Array, terms: Any, max_step: Any) -> Array:
    """`h`, with a run-time error in a solve backwards in time."""
    signed = h * time_direction(terms, h)
    return refuse_if(h, ~(signed >= 0), signed, _refusal(max_step, "{:.6g}"))


def reject_too_long(taken: Taken, h: Array, t1: RealScalarLike, max_step: Any) -> Taken:
    """`taken`, or a failure with an infinite error: an adaptive controller tries a smaller step."""
    # The difference of two large times carries their roundoff.
    slack = 1e-6 * max_step + 8 * jnp.finfo(h.dtype).eps * jnp.abs(t1)
    fits = h <= max_step + slack
    too_long = numbered(_refusal(max_step, "{}"), h, digits=3, decades=_decades(max_step))
    error = jtu.tree_map(lambda e: jnp.where(fits, e, jnp.inf), taken.error)
    result = dfx.RESULTS.where(fits, taken.result, too_long)
    return Taken(taken.y1, error, taken.coefficients, result)


def _refusal(max_step: Any, number: str) -> str:
    longest = f"{float(max_step):.6g}" if _is_known(max_step) else "its `max_step`"
    return (
        f"A step of {number} was asked of a flow map that was trained for steps from 0 to {longest}"
        ". Take a shorter `dt0`, and solve forwards in time."
    )


def _decades(max_step: Any) -> tuple[int, int]:
    """Where the lengths of steps that are too long lie."""
    if not (_is_known(max_step) and 0 < max_step < math.inf):
        return -4, 4
    first = math.floor(math.log10(max_step))
    return first, first + 2


def _is_known(max_step: Any) -> bool:
    return not isinstance(max_step, jax.core.Tracer)
