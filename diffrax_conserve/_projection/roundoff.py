"""The roundoff of a function, which its gradient does not show.

In `1 - cos(q)` near zero the terms are about one and the gradient is about zero; in a network the
terms of the hidden layers cancel. Each operand `v` of an operation has an error of about half a
unit in the last place. With the adjoint `v̄` it changes the value by `v̄ v` units of roundoff, and
as errors are independent, all together by the root of the sum of squares. A product passes relative
errors on, so operands of sums and functions count. What does not depend on the state has the same
error at each evaluation, which is none here.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jaxtyping import Array, Float

from .scalars import walk

# What other operations contain is taken as one function.
_NAMES = """
add add_any sub reduce_sum dot_general cumsum conv_general_dilated
acos acosh asin asinh atan atan2 atanh cos cosh erf erf_inv erfc exp exp2 expm1 lgamma log log1p
logistic pow sin sinh tan tanh
"""
_COUNTED = frozenset(_NAMES.split())


def hidden_terms(
    fn: Callable[[Array], Float[Array, " m"]], y: Float[Array, " n"]
) -> Float[Array, " m"]:
    """The roundoff of `fn(y)` in units of roundoff."""
    evaluated = ft.partial(_evaluated, jax.make_jaxpr(fn)(y))
    like: list[Array] = []
    out = jax.eval_shape(lambda y: evaluated(y, lambda x: like.append(x) or x), y)
    if not like:
        return jnp.zeros(out.shape, out.dtype)

    def shifted(shifts: list[Array]) -> tuple[Array, list[Array]]:
        given, operands = iter(shifts), []
        out = evaluated(y, lambda x: operands.append(x) or x + next(given))
        return out, operands

    zeros = [jnp.zeros(x.shape, x.dtype) for x in like]
    value, vjp, operands = jax.vjp(shifted, zeros, has_aux=True)
    (adjoints,) = jax.vmap(vjp)(jnp.eye(value.size, dtype=value.dtype))
    pairs = zip(adjoints, operands, strict=True)
    terms = [jnp.abs(adjoint * x).reshape(value.size, -1) for adjoint, x in pairs]
    sizes = jnp.nan_to_num(jnp.concatenate(terms, axis=1)).astype(value.dtype)
    # Squares of small energies underflow in float32.
    largest = jnp.max(sizes, axis=1, keepdims=True)
    unit = sizes / jnp.where(largest > 0, largest, 1)
    return largest[:, 0] * jnp.sqrt(jnp.sum(unit**2, axis=1))


def _evaluated(closed: Any, y: Array, changed: Callable[[Any], Any]) -> Array:
    """The value of a jaxpr whose operands are `changed` where they depend on `y`."""

    def equation(eqn: Any, given: list[tuple[Any, bool]]) -> list[tuple[Any, bool]]:
        inputs = [x for x, _ in given]
        if eqn.primitive.name in _COUNTED or list(jex.jaxprs_in_params(eqn.params)):
            moving = [
                moves and jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x, moves in given
            ]
            inputs = [changed(x) if moves else x for x, moves in zip(inputs, moving, strict=True)]
        outs = eqn.primitive.bind(*inputs, **eqn.primitive.get_bind_params(eqn.params))
        outs = outs if eqn.primitive.multiple_results else [outs]
        return [(x, any(moves for _, moves in given)) for x in outs]

    return walk(closed, [(y, True)], lambda x: (x, False), equation)[0][0]
