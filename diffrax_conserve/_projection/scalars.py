"""Functions of small arrays, written out in scalars.

XLA does not fuse across a sum or a stack of components: in a batch of small systems nearly every
operation becomes a loop, whose overhead exceeds its arithmetic. Elementwise arithmetic of scalars
it fuses. The functions call those of the user, so their jaxprs are rewritten.
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

# An array as a tuple of its elements.
Scalars = tuple[Any, ...]

# Compile time grows with the number of scalar operations.
MAX_OPERATIONS = 512


def written_out(fn: Callable[[Any], PyTree[Array]], y: Any) -> PyTree[Array]:
    """`fn(y)`, computed in scalars where that is possible and `fn` is small. The limit allows for
    XLA's tendency to repeat the whole computation for each element of the result."""
    out = jax.eval_shape(fn, y)
    size = max(1, sum(x.size for x in jtu.tree_leaves(out)))
    written = in_scalars(fn, y, limit=MAX_OPERATIONS // size)
    if written is None:
        return fn(y)
    return jtu.tree_map(joined, out, written(jtu.tree_map(components, y)))


def in_scalars(
    fn: Callable[..., Any], *like: Any, limit: int = MAX_OPERATIONS
) -> Callable[..., Any] | None:
    """`fn` with each array that it takes and returns replaced by the tuple of its elements; `None`
    if it is too large or uses a primitive that is not supported here."""
    leaves, treedef = jtu.tree_flatten(like)
    shapes = [jnp.shape(x) for x in leaves]
    if sum(map(prod, shapes)) > limit:
        return None
    closed, out = jax.make_jaxpr(fn, return_shape=True)(*like)
    outs, out_treedef = jtu.tree_flatten(out)

    def write_out(*scalars: Any) -> list[Array]:
        rest = iter(scalars)
        given = [tuple(it.islice(rest, prod(shape))) for shape in shapes]
        return _WriteOut(limit)(closed, shapes, given)

    flat = [jax.ShapeDtypeStruct((), x.dtype) for x in leaves for _ in range(x.size)]
    try:
        evaluate = jex.jaxpr_as_fun(jax.make_jaxpr(write_out)(*flat))
    except _NotWrittenOut:
        return None

    def written(*args: Any) -> Any:
        given = treedef.flatten_up_to(args)
        rest = iter(evaluate(*it.chain(*(x if isinstance(x, tuple) else (x,) for x in given))))
        results = (tuple(it.islice(rest, x.size)) if x.ndim else next(rest) for x in outs)
        return out_treedef.unflatten(results)

    return written


def walk(
    closed: Any,
    inputs: list[Any],
    constant: Callable[[Any], Any],
    equation: Callable[[Any, list[Any]], Iterable[Any]],
) -> list[Any]:
    """The outputs of a jaxpr that is evaluated otherwise: `constant(x)` and `equation(eqn, inputs)`
    take the place of the values of its constants and equations."""
    env = dict(zip(closed.jaxpr.constvars, map(constant, closed.consts), strict=True))
    env.update(zip(closed.jaxpr.invars, inputs, strict=True))

    def read(var: Any) -> Any:
        if isinstance(var, jex.Literal):
            return constant(np.asarray(var.val, var.aval.dtype))  # pyright: ignore
        return env[var]

    for eqn in closed.jaxpr.eqns:
        given = [read(var) for var in eqn.invars]
        if eqn.primitive.name == "jit":
            outs = walk(eqn.params["jaxpr"], given, constant, equation)
        else:
            outs = equation(eqn, given)
        env.update(zip(eqn.outvars, outs, strict=True))
    return [read(var) for var in closed.jaxpr.outvars]


def components(x: Array) -> Any:
    """The elements of an array; a scalar remains what it is."""
    if jnp.ndim(x) == 0:
        return x
    return tuple(jnp.unstack(jnp.reshape(x, -1))) if jnp.size(x) else ()


def joined(like: Any, scalars: Any) -> Array:
    """The array shaped like `like` with these elements."""
    if not isinstance(scalars, tuple):
        return scalars
    return jnp.stack(scalars).reshape(like.shape) if scalars else jnp.zeros(like.shape, like.dtype)


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
abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy
cos cosh div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log
log1p logistic lt max min mul ne neg nextafter not or pow rem round rsqrt select_n sign sin sinh
sqrt square stop_gradient sub tan tanh xor
"""
_ELEMENTWISE = frozenset(_ELEMENTWISE_NAMES.split())
_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
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
# A requested precision may be ignored: sums of products are computed in the type of the state.
_DOT = {"dimension_numbers", "precision", "preferred_element_type"}


def _once(fn: Callable[[Array], Array], x: Array) -> Array:
    """`fn(x)`, which XLA would compute again in each loop that uses it, dozens in a gradient. It
    does not compute quotients again, so this is divided by a 1 that it cannot simplify away."""
    return fn(x) / (lax.stop_gradient(x) * 0 + 1)


_INSTEAD: dict[str, Callable[..., Any]] = {
    "sin": ft.partial(_once, lax.sin),
    "cos": ft.partial(_once, lax.cos),
}


class _WriteOut:
    """Evaluates a jaxpr with each array replaced by an array of places in a list of scalars."""

    def __init__(self, limit: int):
        self.limit = limit
        self.scalars: list[Any] = []
        self.num_operations = 0

    def __call__(
        self, closed: Any, shapes: list[tuple[int, ...]], inputs: Iterable[Scalars]
    ) -> list[Array]:
        places = [self._add(x, shape) for x, shape in zip(inputs, shapes, strict=True)]
        try:
            outputs = walk(closed, places, self._constant, self._equation)
        except (KeyError, TypeError) as error:
            # In another version of jax a parameter may have been renamed or added.
            raise _NotWrittenOut from error
        return [jnp.asarray(self.scalars[i]) for x in outputs for i in x.flat]

    def _equation(self, eqn: Any, inputs: list[_Places]) -> list[_Places]:
        name, params = eqn.primitive.name, eqn.params
        if eqn.effects:
            raise _NotWrittenOut
        # Parameters that are `None` have no effect.
        given = {
            key: value
            for key, value in params.items()
            if value is not None and key not in ("sharding", "out_sharding")
        }
        if name == "unstack" and given.keys() == {"axis"}:
            return [np.asarray(x) for x in np.moveaxis(inputs[0], params["axis"], 0)]
        if name in _STRUCTURAL:
            return [_STRUCTURAL[name](*inputs, **given)]
        if name == "pad" and all(low >= 0 <= high for low, high, _ in given["padding_config"]):
            places, value = inputs
            return [self._pad(places, value, given["padding_config"])]
        if name == "iota":
            indices = np.arange(params["shape"][params["dimension"]], dtype=params["dtype"])
            return [self._constant(_broadcast(indices, params["shape"], (params["dimension"],)))]
        if name in _ELEMENTWISE:
            fn = _INSTEAD.get(name, ft.partial(eqn.primitive.bind, **params))
            return [self._elementwise(fn, inputs)]
        if name in _REDUCTIONS and given.keys() == {"axes"}:
            return [self._reduce(_REDUCTIONS[name], inputs[0], params["axes"])]
        same_type = eqn.invars[0].aval.dtype == eqn.outvars[0].aval.dtype
        if name == "dot_general" and given.keys() <= _DOT and same_type:
            return [self._dot(inputs, params["dimension_numbers"])]
        raise _NotWrittenOut(name)

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
        """Products of the elements, with the axes in the order batch, free, contracted."""
        contracted, batch = dimensions
        order = [
            [*some, *(i for i in range(x.ndim) if i not in (*some, *summed)), *summed]
            for x, some, summed in zip(inputs, batch, contracted, strict=True)
        ]
        a, b = (x.transpose(axes) for x, axes in zip(inputs, order, strict=True))
        first, last = len(batch[0]), len(contracted[0])
        free = a.ndim - first - last, b.ndim - first - last
        middle = first + free[0]
        a = a.reshape(*a.shape[:middle], *[1] * free[1], *a.shape[middle:])
        b = b.reshape(*b.shape[:first], *[1] * free[0], *b.shape[first:])
        product = self._elementwise(lax.mul, [a, b])
        return self._reduce(lax.add, product, tuple(range(product.ndim - last, product.ndim)))

    def _pad(self, places: _Places, value: _Places, config: Any) -> _Places:
        out_shape, inside = [], []
        for n, (low, high, interior) in zip(places.shape, config, strict=True):
            end = low + n + max(n - 1, 0) * interior
            out_shape.append(end + high)
            inside.append(slice(low, end, 1 + interior))
        out = np.full(out_shape, value.item())
        out[tuple(inside)] = places
        return out

    def _constant(self, x: Any) -> _Places:
        self._count(np.size(x))
        if jnp.issubdtype(x.dtype, jax.dtypes.extended):  # a random key
            raise _NotWrittenOut
        if isinstance(x, jax.core.Tracer):
            return self._add(components(jnp.atleast_1d(x)), x.shape)
        return self._add(np.asarray(x).flat, np.shape(x))

    def _add(self, scalars: Iterable[Any], shape: tuple[int, ...]) -> _Places:
        first = len(self.scalars)
        self.scalars.extend(scalars)
        return np.arange(first, len(self.scalars)).reshape(shape)

    def _count(self, operations: int) -> None:
        self.num_operations += operations
        if self.num_operations > self.limit:
            raise _NotWrittenOut
