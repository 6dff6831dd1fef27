"""The times of a step: as those of the vector field, as what is traced, and their difference as a
divisor."""

import functools as ft
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Real

from ._custom_types import IntScalarLike, RealScalarLike
from ._options import dtype_of


@final
class FieldTime(eqx.Module):
    """The time of the vector field as a function of that of the solver, and the other way round.

    In a solve with `t1 < t0` diffrax negates all times before it calls the solver. The `direction`
    is -1 then, otherwise 1, and its product with a time leads either way.
    """

    direction: IntScalarLike | Real[Array, ""]

    def __call__(self, t: RealScalarLike) -> RealScalarLike:
        return t * self.direction


def traced_once(step: Callable[..., Any]) -> Callable[..., Any]:
    """The `step` of a solver, compiled once for all times: diffrax alone traces it three times. In
    a loop by hand times are Python's numbers, which `filter_jit` takes for parts of the program."""
    compiled = eqx.filter_jit(step)

    @ft.wraps(step)
    def at_times(
        self: Any,
        terms: Any,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Any,
        args: Any,
        solver_state: Any,
        made_jump: Any,
    ) -> Any:
        times = (_in_precision_of(y0, t) for t in (t0, t1))
        return compiled(self, terms, *times, y0, args, solver_state, made_jump)

    return at_times


def _in_precision_of(y: Any, t: RealScalarLike) -> RealScalarLike:
    """A number of Python as an array with the precision of a state; an array as it is."""
    if not isinstance(t, int | float):
        return t
    dtypes = [dtype_of(x) for x in jtu.tree_leaves(y)]
    inexact = [x for x in dtypes if jnp.issubdtype(x, jnp.inexact)]
    return jnp.asarray(t, jnp.finfo(jnp.result_type(*inexact or [float])).dtype)


def nonzero_length(t0: RealScalarLike, t1: RealScalarLike) -> Float[Array, ""]:
    """`t1 - t0`, or one for a step of no length.

    In a batch diffrax evaluates steps of no length in the lanes that have arrived, and discards the
    results. In reverse mode their cotangents are zero. So a quotient by the length must be finite,
    with its derivative: zero times infinity would be NaN.
    """
    length = jnp.asarray(t1 - t0)
    return jnp.where(length == 0, 1, length)
