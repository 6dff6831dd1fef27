"""The places of a Jacobian that can differ from zero, and keys for the functions that have it."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.core
import jax.extend.core as jex
import numpy as np
from jaxtyping import Array

from .._fast.jaxprs import jaxprs_inside
from .asdex_import import asdex


def constants_of(closed: Any) -> Iterator[Any]:
    """The arrays over which a jaxpr and those inside it close, which their text does not show."""
    yield from closed.consts
    for eqn in closed.jaxpr.eqns:
        yield from (x.val for x in eqn.invars if isinstance(x, jex.Literal) and np.ndim(x.val))
        for inside in jaxprs_inside(eqn):
            yield from constants_of(inside)


def content_key(x: Any) -> Any:
    """A key for a constant of a function. The value of a tracer is not known, only its shape."""
    if isinstance(x, jax.core.Tracer):
        return x.shape, x.dtype
    return np.shape(x), np.asarray(x).tobytes()


def jacobian_places(closed: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """The rows and columns of the elements of a Jacobian that can differ from zero.

    Constants of which the values are not known, because they are tracers, become arguments of the
    function: the pattern is one for all their values.
    """
    unknown = [i for i, x in enumerate(closed.consts) if isinstance(x, jax.core.Tracer)]

    def fn(y: Array, *others: Array) -> Array:
        consts = list(closed.consts)
        for i, x in zip(unknown, others, strict=True):
            consts[i] = x
        return jex.jaxpr_as_fun(jex.ClosedJaxpr(closed.jaxpr, consts))(y)[0]

    like = [closed.consts[i] for i in unknown]
    others = [np.zeros(x.shape, x.dtype) for x in like]
    found = asdex().jacobian_sparsity(fn, np.zeros(y.shape, y.dtype), *others)
    return np.asarray(found.rows), np.asarray(found.cols)
