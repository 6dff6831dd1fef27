"""The roundoff of a function, which its gradient does not show.

In `1 - cos(q)` near zero the terms are about one and the gradient is about zero; in a network the
terms of the hidden layers cancel. The error of a sum is about one unit of roundoff of the sizes of
its terms, that of the operand of a function one of its own size. Times their adjoints, and as they
are independent, they add up to the root of the sum of squares. A product passes relative errors on.
What does not depend on the state has the same error at each evaluation, which is none here; the
error of the state itself is in the gradient.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Args, Manifold, RealScalarLike, Y
from .._tree import ravel, tree_stop_gradient
from .equations import functions_of, scaled_rows, shown_terms
from .scalars import walk

# Sums, and sums of products, each of which has an error of its own.
_SUMS = frozenset({"add", "add_any", "sub", "reduce_sum", "cumsum"})
_SUMS_OF_PRODUCTS = frozenset({"dot_general", "conv_general_dilated"})
# An operation with other operations inside is taken as one function, unless it is looked into.
_NAMES = """
acos acosh asin asinh atan atan2 atanh cos cosh erf erf_inv erfc exp exp2 expm1 fft lgamma log log1p
logistic pow sin sinh tan tanh
"""
_FUNCTIONS = frozenset(_NAMES.split())
# What these take from the state is still the state.
_PART_NAMES = """
broadcast_in_dim concatenate convert_element_type gather reshape rev slice split squeeze stack
transpose unstack
"""
_PARTS = frozenset(_PART_NAMES.split())
# How a value depends on the state: not at all, as a part of it, or as computed from it.
_CONSTANT, _STATE, _COMPUTED = range(3)
_Measured = tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, " m"]]


def hidden_scale(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> _Measured:
    """Values and Jacobian of the functions of a manifold, and the part of their scales that the
    gradients do not show: nothing where they show more, because elsewhere they may show less."""
    manifold, t, y, args = tree_stop_gradient((manifold, t, y, args))
    vector = ravel(y)
    measured = [hidden_terms(fn, vector) for fn in functions_of(manifold, t, y, args)]
    value, jacobian, hidden = (jnp.concatenate(x) for x in zip(*measured, strict=True))
    shown = jnp.abs(value) + shown_terms(jacobian, vector)
    return value, jacobian, jnp.where(hidden <= shown, 0, hidden)


def hidden_terms(fn: Callable[[Array], Array], y: Float[Array, " n"]) -> _Measured:
    """The value and the Jacobian of `fn` at `y`, and its roundoff there in units of roundoff."""
    closed = jax.make_jaxpr(fn)(y)
    like: list[Array] = []
    evaluate = lambda y, changed: _inside(closed, [(y, _STATE)], changed)[0][0]  # noqa: E731
    jax.eval_shape(lambda y: evaluate(y, lambda x, _: like.append(x) or x), y)

    def shifted(y: Array, shifts: list[Array]) -> tuple[Array, list[Array]]:
        given, sizes = iter(shifts), []
        return evaluate(y, lambda x, size: sizes.append(size) or x + next(given)), sizes

    zeros = [jnp.zeros(x.shape, x.dtype) for x in like]
    value, vjp, sizes = jax.vjp(shifted, y, zeros, has_aux=True)
    jacobian, adjoints = jax.vmap(vjp)(jnp.eye(value.size, dtype=value.dtype))
    pairs = zip(adjoints, sizes, strict=True)
    terms = [jnp.abs(v * s[None]).reshape(value.size, -1) for v, s in pairs]
    terms = [jnp.where(jnp.isfinite(x), x, 0).astype(value.dtype) for x in terms]
    # Squares of small energies underflow in float32.
    unit, _ = scaled_rows(jnp.concatenate([jnp.zeros_like(jacobian), *terms], axis=1))
    squares = sum(jnp.sum((x / unit[:, None]) ** 2, axis=1) for x in terms)
    return value, jacobian, unit * jnp.sqrt(squares)


# A value, and how it depends on the state.
_Pair = tuple[Any, int]


def _inside(closed: Any, given: list[_Pair], changed: Callable[[Any, Any], Any]) -> list[_Pair]:
    """The values of a jaxpr in which `changed(x, size)` takes the place of an `x` with an error."""
    return walk(closed, given, lambda x: (x, _CONSTANT), ft.partial(_equation, changed))


def _equation(changed: Callable[[Any, Any], Any], eqn: Any, given: list[_Pair]) -> list[_Pair]:
    name, params = eqn.primitive.name, eqn.params
    inputs, kind = [x for x, _ in given], max((kind for _, kind in given), default=_CONSTANT)
    kind = _COMPUTED if kind == _STATE and name not in _PARTS else kind
    inner = params.get("call_jaxpr")
    if inner is not None and not _has_loop(inner.jaxpr):  # a function with a rule of its own
        return _inside(inner, given, changed)
    if name in ("checkpoint", "remat2"):
        return _inside(jex.ClosedJaxpr(params["jaxpr"], ()), given, changed)
    if name == "cond":
        branches = [_inside(branch, given[1:], changed) for branch in params["branches"]]
        which = jnp.clip(inputs[0].astype(int), 0, len(branches) - 1)
        return [
            (jnp.stack([x for x, _ in outs])[which], max(kind for _, kind in outs))
            for outs in zip(*branches, strict=True)
        ]
    if name == "scan":
        return [(x, kind) for x in _scanned(changed, params, inputs)]
    evaluate = ft.partial(eqn.primitive.bind, **eqn.primitive.get_bind_params(params))
    products = name in _SUMS_OF_PRODUCTS
    computed = any(of == _COMPUTED for _, of in given)
    if ((products and kind) or (name in _SUMS and computed)) and _is_inexact(*inputs):
        counted = (x if products or of == _COMPUTED else jnp.zeros_like(x) for x, of in given)
        sizes = [jnp.abs(x) for x in counted]
        size = sum(sizes) if name == "sub" else evaluate(*sizes)
        return [(changed(evaluate(*inputs), size), _COMPUTED)]
    if name in _FUNCTIONS or list(jex.jaxprs_in_params(params)):
        inputs = [changed(x, x) if of == _COMPUTED and _is_inexact(x) else x for x, of in given]
    outs = evaluate(*inputs)
    return [(x, kind) for x in (outs if eqn.primitive.multiple_results else [outs])]


def _is_inexact(*xs: Any) -> bool:
    return all(jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in xs)


def _scanned(changed: Callable[[Any, Any], Any], params: Any, inputs: list[Any]) -> list[Any]:
    """A scan whose operands are changed. A first run finds their sizes."""
    first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
    consts, init, xs = inputs[:first], inputs[first:last], inputs[last:]

    def run(shifts: list[Array] | None) -> Any:
        def body(carry: list[Any], x: Any) -> tuple[list[Any], Any]:
            given, sizes = None if shifts is None else iter(x[1]), []

            def shifted(x: Any, size: Any) -> Any:
                sizes.append(size)
                return x if given is None else x + next(given)

            values = [(x, _COMPUTED) for x in (*consts, *carry, *x[0])]
            outs = [x for x, _ in _inside(params["jaxpr"], values, shifted)]
            return outs[: last - first], (outs[last - first :], sizes)

        return jax.lax.scan(body, init, (xs, shifts), params["length"], params["reverse"])

    _, (_, sizes) = run(None)
    carry, (ys, _) = run([changed(jnp.zeros_like(size), size) for size in sizes])
    return [*carry, *ys]


def _has_loop(jaxpr: Any) -> bool:
    """Whether a jaxpr has a loop, through which there is no reverse mode."""
    return any(
        eqn.primitive.name == "while" or any(map(_has_loop, jex.jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )
