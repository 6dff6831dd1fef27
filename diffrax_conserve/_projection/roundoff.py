"""The roundoff of a function, which its gradient does not show.

In `1 - cos(q)` near zero the terms are about one and the gradient is about zero; in a network the
terms of the hidden layers cancel. Only sums cancel, and each of their operands has an error of half
a unit in the last place. To first order these change the value by `Σ v̄ v θ` over all operands `v`
with adjoints `v̄`: a derivative in the direction of the relative errors `θ`, for which random signs
are taken (as in the stochastic arithmetic of J. Vignes, 1993). An operand of one, as often where
elements are masked, has no error.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SAMPLES = 4
# What other operations contain is taken as one sum.
_SUMS = {"add", "add_any", "sub", "reduce_sum", "dot_general", "cumsum", "conv_general_dilated"}


def hidden_terms(
    fn: Callable[[Array], Float[Array, " m"]], y: Float[Array, " n"]
) -> Float[Array, " m"]:
    """The roundoff of `fn(y)` in units of roundoff: the largest of some samples."""
    closed = jax.make_jaxpr(fn)(y)

    def sample(sample: Array) -> Float[Array, " m"]:
        def rounded(size: Array) -> Array:
            errors = _Errors(size, sample)
            return _evaluated(errors, closed.jaxpr, closed.consts, [y])[0]

        zero = jnp.zeros((), y.dtype)
        return jnp.abs(jax.jvp(rounded, (zero,), (jnp.ones_like(zero),))[1])

    # A sample is the one of its signs that is not zero, so that the signs are constants.
    return jnp.max(jax.vmap(sample)(jnp.eye(_SAMPLES, dtype=y.dtype)), axis=0)


class _Errors:
    """Relative errors of `size` times plus or minus a half, others for each operand."""

    def __init__(self, size: Array, sample: Array):
        self.size, self.sample, self.operands = size, sample, 0

    def __call__(self, x: Any) -> Any:
        if not jnp.issubdtype(jnp.result_type(x), jnp.inexact):
            return x
        self.operands += 1
        rng = np.random.default_rng(self.operands)
        # A product of one sign for each axis.
        shape = np.shape(x) or (1,)
        axes = [self.sample @ rng.choice([-1.0, 1.0], (_SAMPLES, n)) for n in shape]
        signs = ft.reduce(jnp.multiply.outer, axes).reshape(np.shape(x))
        share = jnp.where(jnp.abs(x) == 1, 0, 0.5 * signs)
        return _changed(x, share.astype(jnp.finfo(jnp.result_type(x)).dtype), self.size)


@jax.custom_jvp
def _changed(x: Any, share: Array, size: Array) -> Array:
    """`x * (1 + share * size)` for a size of zero."""
    del share, size
    return jnp.asarray(x)


@_changed.defjvp
def _changed_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    x, share, _ = primals
    return _changed(*primals), tangents[0] + x * share * tangents[2].astype(share.dtype)


def _evaluated(errors: _Errors, jaxpr: Any, consts: Any, inputs: Any) -> list[Any]:
    """The outputs of a jaxpr whose sums have operands with errors."""
    env: dict[Any, Any] = {}

    def read(var: Any) -> Any:
        return var.val if isinstance(var, jex.Literal) else env[var]

    env.update(zip(jaxpr.constvars, consts, strict=True))
    env.update(zip(jaxpr.invars, inputs, strict=True))
    for eqn in jaxpr.eqns:
        given = [read(var) for var in eqn.invars]
        if eqn.primitive.name == "jit":
            inner = eqn.params["jaxpr"]
            outs = _evaluated(errors, inner.jaxpr, inner.consts, given)
        else:
            if eqn.primitive.name in _SUMS or jex.jaxprs_in_params(eqn.params):
                given = map(errors, given)
            outs = eqn.primitive.bind(*given, **eqn.primitive.get_bind_params(eqn.params))
            outs = outs if eqn.primitive.multiple_results else [outs]
        env.update(zip(eqn.outvars, outs, strict=True))
    return [read(var) for var in jaxpr.outvars]
