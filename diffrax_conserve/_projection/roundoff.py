"""The roundoff of a function, which its gradient does not show.

In `1 - cos(q)` near zero the terms are about one and the gradient is about zero; in a network the
terms of the hidden layers cancel. Only sums cancel, and each of their operands has an error of half
a unit in the last place. To first order these change the value by `Σ v̄ v θ` over all operands `v`
with adjoints `v̄`: a derivative in the direction of the relative errors `θ`, which are random (as in
the stochastic arithmetic of J. Vignes, 1993). What does not depend on the state, such as a constant
or a masked element, has the same error at each evaluation, which is none here.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SAMPLES = 8
# What other operations contain is taken as one sum.
_SUMS = {"add", "add_any", "sub", "reduce_sum", "dot_general", "cumsum", "conv_general_dilated"}


def hidden_terms(
    fn: Callable[[Array], Float[Array, " m"]], y: Float[Array, " n"]
) -> Float[Array, " m"]:
    """The roundoff of `fn(y)` in units of roundoff: the largest of some samples."""
    closed = jax.make_jaxpr(fn)(y)
    evaluated = ft.partial(_evaluated, closed.jaxpr, closed.consts)

    def operands(y: Array) -> list[Any]:
        found = []
        evaluated([y], lambda x: found.append(x) or x)
        return found

    elsewhere = jnp.sin(jnp.arange(1, y.size + 1, dtype=y.dtype) ** 2) - y
    depends = [a != b for a, b in zip(operands(y), operands(elsewhere), strict=True)]

    def sample(weights: list[list[Array]]) -> Float[Array, " m"]:
        def rounded(size: Array) -> Array:
            given = zip(depends, weights, strict=True)

            def changed(x: Any) -> Array:
                moves, axes = next(given)
                share = 0.5 * ft.reduce(_outer, axes).reshape(np.shape(x))
                share = jnp.where(moves, share, 0).astype(jnp.finfo(jnp.result_type(x)).dtype)
                return _changed(x, share, size)

            return evaluated([y], changed)[0]

        zero = jnp.zeros((), y.dtype)
        return jnp.abs(jax.jvp(rounded, (zero,), (jnp.ones_like(zero),))[1])

    weights = [_weights(number, np.shape(x), y.dtype) for number, x in enumerate(depends)]
    return jnp.max(jax.vmap(sample)(weights), axis=0)


def _weights(seed: int, shape: tuple[int, ...], dtype: Any) -> list[Array]:
    """For each sample, random numbers of both signs and size one: for an array the product of one
    for each axis. Not of size one exactly: two equal terms would cancel in every other sample."""
    rng = np.random.default_rng(seed)
    sizes = [(_SAMPLES, n) for n in shape or (1,)]
    return [jnp.asarray(rng.choice([-1, 1], x) * rng.uniform(0.5, 1.5, x), dtype) for x in sizes]


def _outer(a: Array, b: Array) -> Array:
    return a[..., None] * b.reshape(*[1] * a.ndim, -1)


@jax.custom_jvp
def _changed(x: Any, share: Array, size: Array) -> Array:
    """`x * (1 + share * size)` for a size of zero."""
    del share, size
    return jnp.asarray(x)


@_changed.defjvp
def _changed_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    x, share, _ = primals
    return _changed(*primals), tangents[0] + x * share * tangents[2].astype(share.dtype)


def _evaluated(jaxpr: Any, consts: Any, inputs: Any, changed: Callable[[Any], Any]) -> list[Any]:
    """The outputs of a jaxpr whose sums have `changed` operands."""
    env: dict[Any, Any] = {}

    def read(var: Any) -> Any:
        return var.val if isinstance(var, jex.Literal) else env[var]

    def operand(x: Any) -> Any:
        return changed(x) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else x

    env.update(zip(jaxpr.constvars, consts, strict=True))
    env.update(zip(jaxpr.invars, inputs, strict=True))
    for eqn in jaxpr.eqns:
        given = [read(var) for var in eqn.invars]
        if eqn.primitive.name == "jit":
            inner = eqn.params["jaxpr"]
            outs = _evaluated(inner.jaxpr, inner.consts, given, changed)
        else:
            if eqn.primitive.name in _SUMS or jex.jaxprs_in_params(eqn.params):
                given = map(operand, given)
            outs = eqn.primitive.bind(*given, **eqn.primitive.get_bind_params(eqn.params))
            outs = outs if eqn.primitive.multiple_results else [outs]
        env.update(zip(eqn.outvars, outs, strict=True))
    return [read(var) for var in jaxpr.outvars]
