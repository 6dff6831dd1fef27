"""The roundoff of a function, as far as its gradient does not show it.

In `1 - cos(q)` near zero the terms are about one, but the value and the gradient are about zero. In
a network the terms of the hidden layers cancel. Such a function is less accurate than its value and
gradient tell, and a tolerance made from them alone could not be met.

So we make a first-order error analysis by reverse differentiation (S. Linnainmaa, "Taylor expansion
of the accumulated rounding error", *BIT* 16 (1976), 146-160): an error `δ` of an intermediate value
changes the result by `δ` times the adjoint of that value. A large function is evaluated with errors
instead; see `_sampled`.

- The error of a sum is about one unit of roundoff of the sizes of its terms. That of a cast, or of
  the operand of a function such as the sine, is one unit of roundoff of its own size.
- These errors are independent, so that their squares add up.
- A product only passes relative errors on, so it counts as exact.
- What does not depend on the state counts as exact too. If it depends on `args` alone, its error is
  the same at each time, and shifts the conserved value, which does no harm.
- The components of the state themselves are exact here, because their errors are what the gradient
  shows.
"""

import functools as ft
import itertools as it
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._constants import MAX_SCALAR_OPERATIONS, MIN_SPARSE
from .._custom_types import Args, Manifold, RealScalarLike, Y
from .._fast.jaxprs import carried, closed_jaxpr, jaxprs_inside, num_equations, outputs, walk
from .._large.sparse import pattern_of
from .._manifold import named_entries, noting_call_of
from .._tree import eps_of, ravel, tree_stop_gradient
from .problem import functions_of, linearised
from .rows import AbstractRows, DenseRows
from .sparse_rows import SparseRows

# The primitives of JAX that are sums, and sums of products.
_SUMS = frozenset({"add", "add_any", "sub", "reduce_sum", "cumsum"})
_SUMS_OF_PRODUCTS = frozenset({"dot_general", "conv_general_dilated"})
# The primitives that are functions: they amplify the error of their operand. A primitive with
# others inside, such as a loop, counts as one of them, unless we look into it.
_FUNCTION_NAMES = """acos acosh asin asinh atan atan2 atanh cos cosh erf erf_inv erfc exp exp2 expm1
fft lgamma log log1p logistic lu pow sin sinh tan tanh"""
# The primitives that only move elements. What they take from the state is still exact.
_PART_NAMES = """broadcast_in_dim concatenate gather reshape rev slice split squeeze stack transpose
unstack"""
_FUNCTIONS, _PARTS = frozenset(_FUNCTION_NAMES.split()), frozenset(_PART_NAMES.split())
# How a value depends on the state: not at all, as a part of it, or as computed from it. They are
# ordered such that the result of an operation depends as the maximum of its operands.
_CONSTANT, _STATE, _COMPUTED = range(3)
# A value, a Jacobian, and a roundoff.
_Measured = tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, " m"]]


def cancellation_scale(
    manifold: Manifold, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, " m"], AbstractRows, Float[Array, " m"]]:
    """Values and Jacobian of the functions of a manifold, and the part of their scales that the
    gradients do not show.

    That part is measured once, at the start of a solve, and added to the scale at every state.
    Where the value and the gradient at the start give a larger scale, the part is zero: otherwise
    roundoff that the gradient shows would be counted twice, or at states that do not have it.
    """
    manifold, t, y, args = tree_stop_gradient((manifold, t, y, args))
    vector = ravel(y)
    functions = functions_of(manifold, t, y, args)
    names, programs = [name for name, _ in named_entries(manifold)], []
    for name, fn in zip(names, functions, strict=True):
        with noting_call_of(name, t, y, args):
            programs.append(jax.make_jaxpr(fn)(vector))
    sizes, large = [x.out_avals[0].size for x in programs], [*map(_is_large, programs)]  # pyright: ignore
    pattern = pattern_of(functions, sizes, vector)
    if pattern is None:
        measured = []
        for name, fn, is_large in zip(names, functions, large, strict=True):
            with noting_call_of(name, t, y, args):  # JAX refuses to differentiate some loops
                if is_large:
                    measured.append((*linearised(fn, vector), _sampled(fn, vector)))
                else:
                    measured.append(cancellation_terms(fn, vector))
        value, matrix, cancellation = (jnp.concatenate(x) for x in zip(*measured, strict=True))
        jacobian = DenseRows(matrix)
    else:
        value, jacobian = SparseRows.linearised(pattern, functions, vector)
        measured = [
            _sampled(fn, vector) if is_large else cancellation_terms(fn, vector)[2]
            for fn, is_large in zip(functions, large, strict=True)
        ]
        cancellation = jnp.concatenate(measured)
    gradient_scale = jnp.abs(value) + jacobian.absolute_matvec(jnp.abs(vector))
    return gradient_scale, jacobian, jnp.where(cancellation <= gradient_scale, 0, cancellation)


def _is_large(program: Any) -> bool:
    """Whether a function has many results, each of which would cost a reverse pass, or many
    operations: the reverse pass over two thousand of them, as of the hidden constraints of a
    mechanism in space, was a third of the time to compile a solve."""
    many = program.out_avals[0].size >= MIN_SPARSE
    return many or num_equations(program) > MAX_SCALAR_OPERATIONS // 4


def cancellation_terms(fn: Callable[[Array], Array], y: Float[Array, " n"]) -> _Measured:
    """The value and the Jacobian of `fn` at `y`, and its error there by roundoff, divided by `ε`.

    The function is evaluated with two more arguments, both zero, which change nothing. The rule of
    `_rounded` gives them cotangents: the sum over all rounded values of size times adjoint, and the
    sum of the squares. So one reverse pass finds the gradient and the roundoff together.
    """
    closed = jax.make_jaxpr(fn)(y)

    def evaluate(y: Array, *sums: Array) -> Array:
        return _with_roundoff(closed, [(y, _STATE)], lambda x, size, *_: _rounded(x, size, *sums))[
            0
        ][0]

    value, vjp = jax.vjp(evaluate, y, *jnp.zeros(2, y.dtype))
    one = jnp.eye(value.size, dtype=value.dtype)
    jacobian, total, squares = jax.vmap(vjp)(one)
    unit = jnp.ones_like(total)
    if y.dtype != jnp.float64:
        # In float32 the squares of small numbers, such as of energies in joules of a molecule,
        # underflow. So a second pass is made in a unit in which the sum is one.
        unit = jnp.where(total > 0, total, 1)
        _, _, squares = jax.vmap(vjp)(one / unit[:, None].astype(value.dtype))
    return value, jacobian, unit * jnp.sqrt(squares)


def _sampled(fn: Callable[[Array], Array], y: Float[Array, " n"]) -> Float[Array, " m"]:
    """The error of a large `fn` at `y` by roundoff, divided by `ε`.

    Each rounded value is moved by `√ε` of its size, times a number in general position whose mean
    square is one, and so the results are moved by `√ε` times the root of the sum of the squares. It
    is taken from a few samples, two and two with a phase of 90 degrees (as in the stochastic
    arithmetic of J. Vignes, *Mathematics and Computers in Simulation* 35 (1993), 233-261).
    """
    closed, share = jax.make_jaxpr(fn)(y), eps_of(y) ** 0.5

    def moved(sample: tuple[Array, Array]) -> Float[Array, " m"]:
        (frequency, phase), count = sample, it.count(1)

        def with_error(x: Array, size: Array, step: Array | int = 0) -> Array:
            places = np.arange(1, x.size + 1, dtype=float).reshape(x.shape) ** 2 + next(count) ** 2
            angle = jnp.asarray(np.mod(places, 2 * np.pi), y.dtype)  # float32 would lose the phase
            angle = angle + jnp.asarray(step, y.dtype) ** 2
            weight = 2**0.5 * jnp.sin(frequency * angle + phase)
            unit = share * eps_of(x) / eps_of(y)
            return x + (unit * weight * size).astype(x.dtype)

        return _with_roundoff(closed, [(y, _STATE)], with_error)[0][0]

    frequencies, phases = np.repeat(np.sqrt([1, 2, 3, 5]), 2), np.tile([0, np.pi / 2], 4)
    samples = frequencies.astype(y.dtype), phases.astype(y.dtype)
    changes = jax.lax.map(moved, samples) - fn(y)[None]  # `vmap` compiled three times as long
    # As in `_adjoint`, what is not finite says nothing of roundoff.
    changes = jnp.where(jnp.isfinite(changes), changes / share, 0)
    return jnp.sqrt(jnp.mean(changes**2, axis=0))


@jax.custom_vjp
def _rounded(x: Array, size: Array, total: Array, squares: Array) -> Array:
    """`x`, whose error is one unit of roundoff of `size`. The arguments `total` and `squares` do
    not matter, but their cotangents are what we want: JAX adds up the cotangents of all uses of an
    argument, here the size times the adjoint, and its square."""
    del size, total, squares
    return x


def _adjoint(given: tuple[Array, Array], adjoint: Array) -> tuple[Array, ...]:
    size, total = given
    # A cast to a lower precision has a larger unit of roundoff than the state.
    unit = eps_of(adjoint) / eps_of(total)
    terms = unit * jnp.abs(adjoint * size).astype(total.dtype)
    # A term that is not finite says nothing of roundoff: the value itself is not finite then, or
    # its derivative is infinite.
    terms = jnp.where(terms < jnp.inf, terms, 0)
    return adjoint, jnp.zeros_like(size), jnp.sum(terms), jnp.sum(terms**2)


_rounded.defvjp(lambda x, size, total, squares: (x, (size, total)), _adjoint)


_Pair = tuple[Any, int]  # a value, and how it depends on the state


def _with_roundoff(closed: Any, given: list[_Pair], with_error: Callable[..., Any]) -> list[_Pair]:
    """The values of a jaxpr in which `with_error(x, size)`, in a scan `with_error(x, size, step)`,
    takes the place of each `x` that has an error of its own, of one unit of roundoff of `size`."""
    return walk(closed, given, lambda x: (x, _CONSTANT), ft.partial(_equation, with_error))


def _equation(with_error: Callable[..., Any], eqn: Any, given: list[_Pair]) -> list[_Pair]:
    """The values of one equation of a jaxpr, by the rules at the head of this file."""
    name, params = eqn.primitive.name, eqn.params
    inputs, dependence = [x for x, _ in given], max((each for _, each in given), default=_CONSTANT)
    dependence = _COMPUTED if dependence == _STATE and name not in _PARTS else dependence
    inner = params.get("call_jaxpr")
    # A function with a derivative rule of its own. We look into it, because a rule is about the
    # derivative and not about the errors, unless JAX could not differentiate what is inside.
    if inner is not None and not _is_opaque(inner.jaxpr):
        return _with_roundoff(inner, given, with_error)
    if name in ("checkpoint", "remat2"):
        return _with_roundoff(closed_jaxpr(params["jaxpr"]), given, with_error)
    if name == "cond":
        branches = [ft.partial(_values, with_error, branch) for branch in params["branches"]]
        return [(x, dependence) for x in jax.lax.switch(inputs[0], branches, *inputs[1:])]
    if name == "scan":
        return [(x, dependence) for x in _scanned(with_error, eqn, inputs)]
    products = name in _SUMS_OF_PRODUCTS
    computed = any(each == _COMPUTED for _, each in given)
    if ((products and dependence) or (name in _SUMS and computed)) and _is_inexact(*inputs):
        # In a sum the parts of the state are exact terms, which the gradient shows.
        counted = (x if products or each != _STATE else jnp.zeros_like(x) for x, each in given)
        sizes = [jnp.abs(jax.lax.stop_gradient(x)) for x in counted]
        size = sum(sizes) if name == "sub" else outputs(eqn, *sizes)[0]
        return [(with_error(outputs(eqn, *inputs)[0], size), _COMPUTED)]
    if name == "convert_element_type" and dependence and _is_inexact(*inputs, params["new_dtype"]):
        (x,) = outputs(eqn, *inputs)
        return [(with_error(x, x), _COMPUTED)]
    if name in _FUNCTIONS or jaxprs_inside(eqn):
        inputs = [
            with_error(x, x) if each == _COMPUTED and _is_inexact(x) else x for x, each in given
        ]
    return [(x, dependence) for x in outputs(eqn, *inputs)]


def _is_inexact(*xs: Any) -> bool:
    return all(jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in xs)


def _values(with_error: Callable[..., Any], closed: Any, *inputs: Any) -> list[Any]:
    """As `_with_roundoff`, where all inputs may be computed from the state."""
    return [x for x, _ in _with_roundoff(closed, [(x, _COMPUTED) for x in inputs], with_error)]


def _scanned(with_error: Callable[..., Any], eqn: Any, inputs: list[Any]) -> list[Any]:
    params, inside = eqn.params, eqn.params["jaxpr"]
    first, last = carried(eqn)
    num_carry = last - first

    # Without a checkpoint, reverse mode would keep the values of each step of a long scan.
    @jax.checkpoint
    def body(carry: list[Any], now: Any) -> tuple[list[Any], list[Any]]:
        step, x = now
        in_step = lambda x, size, *_: with_error(x, size, step)  # noqa: E731
        outs = _values(in_step, inside, *inputs[:first], *carry, *x)
        return outs[:num_carry], outs[num_carry:]

    given = inputs[first:last], (np.arange(params["length"]), inputs[last:])
    carry, ys = jax.lax.scan(body, *given, params["length"], params["reverse"])
    return [*carry, *ys]


def _is_opaque(jaxpr: Any) -> bool:
    """Whether a jaxpr contains a loop of unknown length or a callback, which JAX can differentiate
    in reverse mode only by a rule."""
    return any(
        eqn.primitive.name in ("while", "pure_callback", "io_callback")
        or any(_is_opaque(inner.jaxpr) for inner in jaxprs_inside(eqn))
        for eqn in jaxpr.eqns
    )
