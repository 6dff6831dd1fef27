"""A check whether a flow map was trained for the equation that is to be solved."""

from typing import Any

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..._custom_types import Args, RealScalarLike, Y
from .._networks.flow_map import AbstractFlowMap
from .sweeps import increment

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
