"""Functions of small states, written out in scalars.

XLA does not fuse across a sum or a stack of components: with a small state nearly every operation
of a projection becomes a separate loop, whose overhead exceeds its arithmetic. In scalars
everything is elementwise arithmetic, which XLA fuses, also in a batch. The functions are the
user's, so their jaxprs are rewritten.
"""

import functools as ft
import itertools as it
from collections.abc import Callable, Iterable
from math import prod
from typing import Any

import jax
import jax.core
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import Y

Scalars = tuple[Array, ...]

# Compile time grows with the number of scalar operations, and gradients multiply that number.
MAX_SCALARS = 32
MAX_OPERATIONS = 512


def written_out(fn: Callable[[Y], PyTree[Array]], y: Y) -> PyTree[Array]:
    """`fn(y)`, computed in scalars where that is possible and `fn` is small. The limit allows for
    XLA's tendency to repeat the whole computation for each element of the result."""
    closed, out = jax.make_jaxpr(fn, return_shape=True)(y)
    leaves, treedef = jtu.tree_flatten(out)
    limit = MAX_OPERATIONS // max(1, sum(x.size for x in leaves))
    try:
        scalars = _WriteOut(closed, y, limit)(*_components(jtu.tree_leaves(y)))
    except _NotWrittenOut:
        return fn(y)
    return jtu.tree_unflatten(treedef, _stacked(scalars, [x.shape for x in leaves]))


def elements_in_scalars(
    fn: Callable[[Y], Array], y: Y
) -> tuple[list[Callable[[Scalars], Array]], Callable[[Y], Scalars], Callable[[Scalars], Y]] | None:
    """Each element of `fn`, whose values have shape `(m,)`, as a function of a tuple of scalars;
    and the maps from states to such tuples and back.

    `None` if the function is too large or uses a primitive that is not supported here.
    """
    leaves, treedef = jtu.tree_flatten(y)
    shapes = [jnp.shape(x) for x in leaves]

    def split(y: Y) -> Scalars:
        return _components(jtu.tree_leaves(y))

    def join(scalars: Scalars) -> Y:
        return jtu.tree_unflatten(treedef, _stacked(scalars, shapes))

    try:
        closed = jax.make_jaxpr(_WriteOut(jax.make_jaxpr(fn)(y), y))(*split(y))
    except _NotWrittenOut:
        return None
    return [_element(closed, i) for i in range(len(closed.out_avals))], split, join


def _element(closed: jex.ClosedJaxpr, i: int) -> Callable[[Scalars], Array]:
    """The `i`-th output as a function, with only the equations that it needs, so that its gradient
    involves no others."""
    output = closed.jaxpr.outvars[i]
    needed, eqns = {output}, []
    for eqn in reversed(closed.jaxpr.eqns):
        if needed.intersection(eqn.outvars):
            needed.update(var for var in eqn.invars if not isinstance(var, jex.Literal))
            eqns.insert(0, eqn)
    jaxpr = closed.jaxpr.replace(eqns=eqns, outvars=[output])
    fn = jex.jaxpr_as_fun(jex.ClosedJaxpr(jaxpr, closed.consts))
    return lambda scalars: fn(*scalars)[0]


def _stacked(scalars: Iterable[Array], shapes: list[tuple[int, ...]]) -> list[Array]:
    rest = iter(scalars)
    return [
        jnp.stack([*it.islice(rest, prod(s))]).reshape(s) if prod(s) else jnp.zeros(s)
        for s in shapes
    ]


def _components(leaves: list[Array]) -> Scalars:
    return tuple(x for leaf in leaves for x in jnp.unstack(jnp.reshape(leaf, -1)))


_Places = np.ndarray  # of integers


def _broadcast(
    places: _Places, shape: tuple[int, ...], broadcast_dimensions: tuple[int, ...]
) -> _Places:
    expanded = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, places.shape, strict=True):
        expanded[axis] = size
    return np.broadcast_to(places.reshape(expanded), shape)


class _NotWrittenOut(Exception):
    """The function has an unsupported primitive or parameter, or too many operations."""


_ELEMENTWISE_NAMES = """
abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy cos
cosh div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log log1p
logistic lt max min mul ne neg nextafter not or pow rem round rsqrt select_n sign sin sinh sqrt
square stop_gradient sub tan tanh xor
"""
_ELEMENTWISE = frozenset(_ELEMENTWISE_NAMES.split())
_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
}
_STRUCTURAL: dict[str, Callable[..., _Places]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "reshape": lambda x, new_sizes: x.reshape(new_sizes),
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "slice": lambda x, start_indices, limit_indices, strides=None: x[
        tuple(map(slice, start_indices, limit_indices, strides or [1] * x.ndim))
    ],
    "squeeze": lambda x, dimensions: x.squeeze(dimensions),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "transpose": lambda x, permutation: x.transpose(permutation),
}
# A requested precision or type may be ignored: the sum of products is computed in the type of the
# state.
_DOT = {"dimension_numbers", "precision", "preferred_element_type"}
# The operations from which constant matrices are mostly built, in numpy: jax would compile each one
# separately, in 30 ms.
_ON_NUMBERS: dict[str, Callable[..., np.ndarray]] = {
    "add": lambda x, y, **_: x + y,
    "convert_element_type": lambda x, new_dtype, **_: x.astype(new_dtype),
    "eq": lambda x, y, **_: x == y,
    "ge": lambda x, y, **_: x >= y,
    "integer_pow": lambda x, y, **_: x**y,
    "iota": lambda dtype, shape, dimension, **_: _broadcast(
        np.arange(shape[dimension], dtype=dtype), shape, (dimension,)
    ),
    "mul": lambda x, y, **_: x * y,
    "neg": lambda x, **_: -x,
    "sub": lambda x, y, **_: x - y,
}


# XLA recomputes a sine in each loop that uses it, and a gradient has dozens of such loops. It does
# not recompute quotients, so the sine is divided by a 1 that XLA cannot simplify away.
@jax.custom_jvp
def _sin(x: Array) -> Array:
    return lax.sin(x) / _one(x)


@jax.custom_jvp
def _cos(x: Array) -> Array:
    return lax.cos(x) / _one(x)


def _one(x: Array) -> Array:
    return lax.stop_gradient(x) * 0 + 1


_sin.defjvps(lambda t, _, x: t * _cos(x))
_cos.defjvps(lambda t, _, x: -t * _sin(x))
_KEPT = {"sin": _sin, "cos": _cos}


class _WriteOut:
    """Evaluates a jaxpr with each array replaced by an array of places in a list of scalars."""

    def __init__(self, closed: Any, y: Y, limit: int = MAX_OPERATIONS):
        self.limit = limit
        self.closed = closed
        self.shapes = [jnp.shape(x) for x in jtu.tree_leaves(y)]
        if sum(map(prod, self.shapes)) > MAX_SCALARS:
            raise _NotWrittenOut
        self.scalars: list[Any] = []
        self.num_operations = 0

    def __call__(self, *scalars: Array) -> list[Array]:
        """The elements of the outputs, given those of the inputs."""
        rest = iter(scalars)
        inputs = [self._add(it.islice(rest, prod(shape)), shape) for shape in self.shapes]
        try:
            outputs = self._jaxpr(self.closed.jaxpr, self.closed.consts, inputs)
        except (KeyError, TypeError) as error:
            # In another version of jax a parameter may have been renamed or added.
            raise _NotWrittenOut from error
        return [jnp.asarray(self.scalars[i]) for places in outputs for i in places.flat]

    def _jaxpr(self, jaxpr: Any, consts: list[Any], inputs: list[_Places]) -> list[_Places]:
        env: dict[Any, _Places] = {}

        def read(var: Any) -> _Places:
            if isinstance(var, jex.Literal):
                return self._constant(np.asarray(var.val, _dtype(var)))
            return env[var]

        env.update(zip(jaxpr.constvars, map(self._constant, consts), strict=True))
        env.update(zip(jaxpr.invars, inputs, strict=True))
        for eqn in jaxpr.eqns:
            outs = self._equation(eqn, [read(var) for var in eqn.invars])
            env.update(zip(eqn.outvars, outs, strict=True))
        return [read(var) for var in jaxpr.outvars]

    def _equation(self, eqn: Any, inputs: list[_Places]) -> list[_Places]:
        name, params = eqn.primitive.name, eqn.params
        if eqn.effects:
            raise _NotWrittenOut
        if name == "jit":
            return self._jaxpr(params["jaxpr"].jaxpr, params["jaxpr"].consts, inputs)
        # Parameters that are `None` have no effect.
        given = {key: value for key, value in params.items() if value is not None}
        if name == "unstack" and given.keys() == {"axis"}:
            return [np.asarray(x) for x in np.moveaxis(inputs[0], params["axis"], 0)]
        if name in _STRUCTURAL:
            return [_STRUCTURAL[name](*inputs, **given)]
        if all(self._is_known(places) for places in inputs):
            return self._fold(eqn, inputs)
        if name in _ELEMENTWISE:
            fn = _KEPT.get(name, ft.partial(eqn.primitive.bind, **params))
            return [self._elementwise(fn, inputs)]
        if name in _REDUCTIONS and given.keys() == {"axes"}:
            return [self._reduce(_REDUCTIONS[name], inputs[0], params["axes"])]
        same_type = _dtype(eqn.invars[0]) == _dtype(eqn.outvars[0])
        if name == "dot_general" and given.keys() <= _DOT and same_type:
            return [self._dot(inputs, params["dimension_numbers"])]
        raise _NotWrittenOut

    def _is_known(self, places: _Places) -> bool:
        return all(isinstance(self.scalars[i], np.generic) for i in places.flat)

    def _fold(self, eqn: Any, inputs: list[_Places]) -> list[_Places]:
        """Evaluates an equation of constants now, for example where a matrix is built from its
        indices."""
        arrays = [
            np.array([self.scalars[i] for i in places.flat], _dtype(var)).reshape(places.shape)
            for places, var in zip(inputs, eqn.invars, strict=True)
        ]
        if eqn.primitive.name in _ON_NUMBERS:
            with np.errstate(all="ignore"):
                out = _ON_NUMBERS[eqn.primitive.name](*arrays, **eqn.params)
            return [self._constant(np.asarray(out, _dtype(eqn.outvars[0])))]
        with jax.ensure_compile_time_eval():
            out = eqn.primitive.bind(*arrays, **eqn.params)
        return [self._constant(x) for x in (out if eqn.primitive.multiple_results else [out])]

    def _elementwise(self, fn: Callable[..., Array], inputs: list[_Places]) -> _Places:
        inputs = [*np.broadcast_arrays(*inputs)]
        self._count(inputs[0].size)
        rows = zip(*(places.flat for places in inputs), strict=True)
        return self._add((fn(*(self.scalars[i] for i in row)) for row in rows), inputs[0].shape)

    def _reduce(
        self, fn: Callable[[Array, Array], Array], places: _Places, axes: tuple[int, ...]
    ) -> _Places:
        self._count(places.size)
        places = np.moveaxis(places, axes, range(-len(axes), 0))
        shape = places.shape[: places.ndim - len(axes)]
        rows = places.reshape(prod(shape), -1)
        return self._add((ft.reduce(fn, [self.scalars[i] for i in row]) for row in rows), shape)

    def _dot(self, inputs: list[_Places], dimensions: Any) -> _Places:
        contracted, (batch, _) = dimensions
        if batch:
            raise _NotWrittenOut
        a, b = (
            np.moveaxis(x, axes, range(-len(axes), 0))
            for x, axes in zip(inputs, contracted, strict=True)
        )
        rank = len(contracted[0])
        free = a.ndim - rank, b.ndim - rank
        a = a.reshape(*a.shape[: free[0]], *[1] * free[1], *a.shape[free[0] :])
        product = self._elementwise(lax.mul, [a, b])
        return self._reduce(lax.add, product, tuple(range(sum(free), product.ndim)))

    def _constant(self, x: Any) -> _Places:
        self._count(np.size(x))
        if jnp.issubdtype(x.dtype, jax.dtypes.extended):  # a random key
            raise _NotWrittenOut
        if isinstance(x, jax.core.Tracer):
            return self._add(_components([x]), x.shape)
        return self._add(np.asarray(x).flat, np.shape(x))

    def _add(self, scalars: Iterable[Any], shape: tuple[int, ...]) -> _Places:
        first = len(self.scalars)
        self.scalars.extend(scalars)
        return np.arange(first, len(self.scalars)).reshape(shape)

    def _count(self, operations: int) -> None:
        self.num_operations += operations
        if self.num_operations > self.limit:
            raise _NotWrittenOut


def _dtype(var: Any) -> np.dtype:
    return var.aval.dtype
