"""The roundoff of a function, which its gradient does not show.

In `1 - cos(q)` near zero the terms are about one and the gradient is about zero; in a network the
terms of the hidden layers cancel. The error of a sum is about one unit of roundoff of the sizes of
its terms, that of a cast or of the operand of a function one of its own size. Times their adjoints,
and as they are independent, they add up to the root of the sum of squares. A product passes
relative errors on. A function of what does not depend on the state has the same error each time,
which is none here; the error of the state is in the gradient.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Args, Manifold, RealScalarLike, Y
from .._manifold import calling_fn, named_entries
from .._tree import ravel, tree_stop_gradient
from .equations import Jacobian, functions_of, shown_terms
from .jaxprs import closed_jaxpr, jaxprs_inside, outputs, walk
from .sparse import LEAST_CONSTRAINTS, SparseRows, pattern_of

# Sums, and sums of products, each of which has an error of its own.
_SUMS = frozenset({"add", "add_any", "sub", "reduce_sum", "cumsum"})
_SUMS_OF_PRODUCTS = frozenset({"dot_general", "conv_general_dilated"})
# An operation with other operations inside is taken as one function, unless it is looked into.
_FUNCTION_NAMES = """acos acosh asin asinh atan atan2 atanh cos cosh erf erf_inv erfc exp exp2 expm1
fft lgamma log log1p logistic lu pow sin sinh tan tanh"""
# What these take from the state is still the state.
_PART_NAMES = """broadcast_in_dim concatenate gather reshape rev slice split squeeze stack transpose
unstack"""
_FUNCTIONS, _PARTS = frozenset(_FUNCTION_NAMES.split()), frozenset(_PART_NAMES.split())
# How a value depends on the state: not at all, as a part of it, or as computed from it.
_CONSTANT, _STATE, _COMPUTED = range(3)
_Measured = tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, " m"]]


def hidden_scale(
    manifold: Manifold, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, " m"], Jacobian, Float[Array, " m"]]:
    """Values and Jacobian of the functions of a manifold, and the part of their scales that the
    gradients do not show: nothing where they show more, because elsewhere they may show less."""
    manifold, t, y, args = tree_stop_gradient((manifold, t, y, args))
    vector = ravel(y)
    functions = functions_of(manifold, t, y, args)
    sizes = [jax.eval_shape(fn, vector).size for fn in functions]
    pattern = pattern_of(functions, sizes, vector)
    if pattern is None:
        measured = []
        for (name, _), fn in zip(named_entries(manifold), functions, strict=True):
            with calling_fn(name, t, y, args):  # JAX refuses to differentiate some loops
                measured.append(hidden_terms(fn, vector))
        value, jacobian, hidden = (jnp.concatenate(x) for x in zip(*measured, strict=True))
    else:  # not of entries with many elements, for which it would cost a reverse pass each
        value, jacobian = SparseRows.linearised(pattern, functions, vector)
        few = [size < LEAST_CONSTRAINTS for size in sizes]
        measured = [
            hidden_terms(fn, vector)[2] if one else jnp.zeros(size, vector.dtype)
            for fn, size, one in zip(functions, sizes, few, strict=True)
        ]
        hidden = jnp.concatenate(measured)
    shown = jnp.abs(value) + shown_terms(jacobian, vector)
    return value, jacobian, jnp.where(hidden <= shown, 0, hidden)


def hidden_terms(fn: Callable[[Array], Array], y: Float[Array, " n"]) -> _Measured:
    """The value and the Jacobian of `fn` at `y`, and its roundoff there in units of roundoff."""
    closed = jax.make_jaxpr(fn)(y)

    def evaluate(y: Array, *sums: Array) -> Array:
        return _inside(closed, [(y, _STATE)], lambda x, size: _rounded(x, size, *sums))[0][0]

    value, vjp = jax.vjp(evaluate, y, *jnp.zeros(2, y.dtype))
    one = jnp.eye(value.size, dtype=value.dtype)
    jacobian, total, squares = jax.vmap(vjp)(one)
    unit = jnp.ones_like(total)
    if y.dtype != jnp.float64:  # squares of small energies underflow
        unit = jnp.where(total > 0, total, 1)
        _, _, squares = jax.vmap(vjp)(one / unit[:, None].astype(value.dtype))
    return value, jacobian, unit * jnp.sqrt(squares)


@jax.custom_vjp
def _rounded(x: Array, size: Array, total: Array, squares: Array) -> Array:
    """`x`, which is rounded. The cotangents of the last two are sums over all that is rounded, of
    the sizes times their adjoints, and of the squares."""
    del size, total, squares
    return x


def _adjoint(given: tuple[Array, Array], adjoint: Array) -> tuple[Array, ...]:
    size, total = given
    unit = float(jnp.finfo(adjoint.dtype).eps) / float(jnp.finfo(total.dtype).eps)
    terms = unit * jnp.abs(adjoint * size).astype(total.dtype)
    terms = jnp.where(terms < jnp.inf, terms, 0)
    return adjoint, jnp.zeros_like(size), jnp.sum(terms), jnp.sum(terms**2)


_rounded.defvjp(lambda x, size, total, squares: (x, (size, total)), _adjoint)


_Pair = tuple[Any, int]  # a value, and how it depends on the state


def _inside(closed: Any, given: list[_Pair], changed: Callable[[Any, Any], Any]) -> list[_Pair]:
    """The values of a jaxpr in which `changed(x, size)` takes the place of an `x` with an error."""
    return walk(closed, given, lambda x: (x, _CONSTANT), ft.partial(_equation, changed))


def _equation(changed: Callable[[Any, Any], Any], eqn: Any, given: list[_Pair]) -> list[_Pair]:
    name, params = eqn.primitive.name, eqn.params
    inputs, kind = [x for x, _ in given], max((kind for _, kind in given), default=_CONSTANT)
    kind = _COMPUTED if kind == _STATE and name not in _PARTS else kind
    inner = params.get("call_jaxpr")
    if inner is not None and not _is_opaque(inner.jaxpr):  # a function with a rule of its own
        return _inside(inner, given, changed)
    if name in ("checkpoint", "remat2"):
        return _inside(closed_jaxpr(params["jaxpr"]), given, changed)
    if name == "cond":
        branches = [ft.partial(_values, changed, branch) for branch in params["branches"]]
        return [(x, kind) for x in jax.lax.switch(inputs[0], branches, *inputs[1:])]
    if name == "scan":
        return [(x, kind) for x in _scanned(changed, eqn, inputs)]
    products = name in _SUMS_OF_PRODUCTS
    computed = any(of == _COMPUTED for _, of in given)
    if ((products and kind) or (name in _SUMS and computed)) and _is_inexact(*inputs):
        counted = (x if products or of != _STATE else jnp.zeros_like(x) for x, of in given)
        sizes = [jnp.abs(x) for x in counted]
        size = sum(sizes) if name == "sub" else outputs(eqn, *sizes)[0]
        return [(changed(outputs(eqn, *inputs)[0], size), _COMPUTED)]
    if name == "convert_element_type" and kind and _is_inexact(*inputs, params["new_dtype"]):
        (x,) = outputs(eqn, *inputs)
        return [(changed(x, x), _COMPUTED)]
    if name in _FUNCTIONS or any(True for _ in jaxprs_inside(eqn)):
        inputs = [changed(x, x) if of == _COMPUTED and _is_inexact(x) else x for x, of in given]
    return [(x, kind) for x in outputs(eqn, *inputs)]


def _is_inexact(*xs: Any) -> bool:
    return all(jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in xs)


def _values(changed: Callable[[Any, Any], Any], closed: Any, *inputs: Any) -> list[Any]:
    """As `_inside`, where all inputs may be computed from the state."""
    return [x for x, _ in _inside(closed, [(x, _COMPUTED) for x in inputs], changed)]


def _scanned(changed: Callable[[Any, Any], Any], eqn: Any, inputs: list[Any]) -> list[Any]:
    params, inside = eqn.params, eqn.params["jaxpr"]
    # What is carried has the same shape inside.
    alike = lambda var, x: var.aval.shape == x.shape  # noqa: E731
    num_carry = sum(map(alike, eqn.outvars, inside.out_avals))
    first = (last := sum(map(alike, eqn.invars, inside.in_avals))) - num_carry

    @jax.checkpoint  # so that no step of a long scan is kept
    def body(carry: list[Any], x: list[Any]) -> tuple[list[Any], list[Any]]:
        outs = _values(changed, inside, *inputs[:first], *carry, *x)
        return outs[:num_carry], outs[num_carry:]

    given = inputs[first:last], inputs[last:]
    carry, ys = jax.lax.scan(body, *given, params["length"], params["reverse"])
    return [*carry, *ys]


def _is_opaque(jaxpr: Any) -> bool:
    """Whether a jaxpr has a loop or callback, through which reverse mode needs a rule."""
    return any(
        eqn.primitive.name in ("while", "pure_callback", "io_callback")
        or any(_is_opaque(inner.jaxpr) for inner in jaxprs_inside(eqn))
        for eqn in jaxpr.eqns
    )
