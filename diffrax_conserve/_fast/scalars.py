"""Functions of small arrays, written out in scalars.

XLA does not fuse across a sum or a stack of components. So in a batch of small systems nearly every
operation becomes a loop over the lanes, whose overhead exceeds its arithmetic. It does fuse
elementwise arithmetic, and under `vmap` a scalar is an array over the lanes. So we replace each
array by its elements, each a scalar.

The functions call those of the user, so we cannot write them in scalars ourselves. Instead their
jaxprs are rewritten. All elements are kept in one list, and an array becomes an array of integers,
the *places* of its elements in that list. A primitive that only moves elements moves their places,
which costs nothing at run time. An elementwise primitive, a reduction, or a product of matrices
appends new scalars to the list. Any other primitive stays in arrays in its place: its operands are
stacked, and its results taken apart.

In scalars one sees what an operation on arrays hides. An operation on the same places is the same
number, so it is in the list once. Operations on known numbers, such as indices, are computed at
once, a sum with zero and a product with one are no operations, and what no result needs is left
out. A derivative of a derivative, as JAX makes it, consists mostly of these (A. Griewank and
A. Walther, *Evaluating Derivatives*, SIAM 2008).
"""

import functools as ft
import itertools as it
from collections.abc import Callable, Sequence
from math import prod
from typing import Any, SupportsIndex

import jax
import jax.core
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._constants import MAX_SCALAR_OPERATIONS, MAX_SCALAR_RESULTS, SIMPLIFICATION_FACTOR
from .jaxprs import closed_jaxpr, num_equations, outputs, walk


def scalarised_result(fn: Callable[[Any], PyTree[Array]], y: Any) -> PyTree[Array]:
    """`fn(y)`, computed in scalars if that is possible and `fn` is small.

    XLA tends to repeat the whole computation for each element of the result, so the limit is
    divided by their number.
    """
    limit = lambda size, _: MAX_SCALAR_OPERATIONS // max(1, size)  # noqa: E731
    return (written_out(fn, (y,), limit, differentiated=True) or fn)(y)


def small(fn: Callable[..., PyTree[Array]], *like: Any) -> Callable[..., PyTree[Array]]:
    """`fn`, a function of arrays like these, as a small program, whose derivatives are small too;
    `fn` itself if that is not possible, or has more than twice as many operations as `fn` in
    arrays. A pendulum has 30 where it has 193 in arrays, but with 30 unknowns of a partial
    differential equation it compiled three times as long. Operations in arrays are larger, and
    their derivatives do not become small: two rigid bodies with Euler angles had 171 beside 193,
    and when these stayed in arrays, what was derived from them had ten times as many in the end.

    A product with the number zero is zero here, also where the other factor is infinite, as in all
    derivatives by JAX.
    """
    limit = lambda _, in_arrays: min(MAX_SCALAR_OPERATIONS, 2 * in_arrays)  # noqa: E731
    return written_out(fn, like, limit, differentiated=True, zeros=True) or fn


def scalarised(fn: Callable[..., Any], *like: Any) -> Callable[..., Any] | None:
    """`fn` with each array that it takes and returns replaced by the tuple of its elements.

    It is `None` if `fn` is too large, has many results, has an effect or uses random keys, or is a
    single operation, for which nothing is gained. A function inside that has a derivative rule of
    its own is looked into, and its rule is lost.
    """

    def limit(size: int, in_arrays: int) -> int:
        return MAX_SCALAR_OPERATIONS if size <= MAX_SCALAR_RESULTS and in_arrays > 1 else 0

    return written_out(fn, like, limit, arrays=False)


def written_out(
    fn: Callable[..., Any],
    like: Any,
    limit: Callable[[int, int], int],
    *,
    arrays: bool = True,
    differentiated: bool = False,
    zeros: bool = False,
) -> Callable[..., Any] | None:
    """`fn` computed in scalars, if it has at most as many operations as `limit` says for the number
    of elements of the result and that of operations in arrays. It takes and returns `arrays`, or
    tuples of their elements."""
    leaves, treedef = jtu.tree_flatten(like)
    shapes = [jnp.shape(x) for x in leaves]
    if sum(map(prod, shapes)) > MAX_SCALAR_OPERATIONS:
        return None
    closed, out = jax.make_jaxpr(fn, return_shape=True)(*like)
    outs, out_treedef = jtu.tree_flatten(out)
    limited = limit(sum(x.size for x in outs), num_equations(closed))
    program = _Program(limited, differentiated, zeros)
    places = [[program.argument() for _ in range(1 if arrays else prod(x))] for x in shapes]
    try:
        inputs = [
            program.elements(i[0], x) if arrays else np.array(i, int).reshape(x)
            for i, x in zip(places, shapes, strict=True)
        ]
        found = [*zip(program.results(closed, inputs), outs, strict=True)]
        rows = [[program.array(i, x.dtype)] if arrays else i.ravel().tolist() for i, x in found]
        evaluate = program.evaluation([i for row in rows for i in row])
    except _NotWrittenOut:
        return None

    def evaluated(*args: Any) -> Any:
        given = treedef.flatten_up_to(args)
        rest = iter(evaluate([*it.chain(*(x if isinstance(x, tuple) else (x,) for x in given))]))
        parts = (
            tuple(jnp.asarray(next(rest), x.dtype) for _ in row)
            for row, x in zip(rows, outs, strict=True)
        )
        return out_treedef.unflatten(
            x if like.ndim and not arrays else x[0] for x, like in zip(parts, outs, strict=True)
        )

    return evaluated


def components(x: Array) -> Any:
    """The elements of an array; a scalar remains what it is."""
    if jnp.ndim(x) == 0:
        return x
    return tuple(jnp.unstack(jnp.reshape(x, -1))) if jnp.size(x) else ()


# An array of integers: where in the list of scalars the elements of an array are.
_Places = np.ndarray


class _NotWrittenOut(Exception):
    """The function has too many operations, an effect, or a random key."""


_ELEMENTWISE_NAMES = """
abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp complex conj
convert_element_type copy cos cosh div eq erf erf_inv erfc exp exp2 expm1 floor ge gt imag
integer_pow is_finite le lgamma log log1p logistic lt max min mul ne neg nextafter not or pow real
rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor
"""
ELEMENTWISE = frozenset(_ELEMENTWISE_NAMES.split())
_REDUCTIONS = {
    "reduce_sum": ("add", lax.add),
    "reduce_prod": ("mul", lax.mul),
    "reduce_max": ("max", lax.max),
    "reduce_min": ("min", lax.min),
    "reduce_and": ("and", lax.bitwise_and),
    "reduce_or": ("or", lax.bitwise_or),
}
# The parameters of a product of matrices that we can treat. A requested precision may be ignored,
# because the sums of products are computed in the type of the state.
_DOT = {"dimension_numbers", "precision", "preferred_element_type"}
# Calls of a function, which we look into. Some functions have a derivative rule of their own, which
# would be lost by that. So these are looked into only if no derivative is taken afterwards.
_CALLS = frozenset({"closed_call", "core_call", "checkpoint", "remat2"})
_CALLS_WITH_A_RULE = frozenset({"custom_jvp_call", "custom_vjp_call"})


def _broadcast(
    x: _Places, shape: Sequence[int], broadcast_dimensions: Sequence[SupportsIndex]
) -> _Places:
    expanded = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, x.shape, strict=True):
        expanded[axis] = size
    return np.broadcast_to(x.reshape(expanded), shape)


def _pad(x: _Places, value: _Places, padding_config: Sequence[Any]) -> _Places:
    out_shape, inside, kept = [], [], []
    for n, (low, high, interior) in zip(x.shape, padding_config, strict=True):
        first, last = max(low, 0), max(low, 0) + n + max(n - 1, 0) * interior
        out_shape.append(last + max(high, 0))
        inside.append(slice(first, last, 1 + interior))
        kept.append(slice(max(-low, 0), last + high if high < 0 else None))
    out = np.full(out_shape, value.item())
    out[tuple(inside)] = x
    return np.asarray(out[tuple(kept)])


def moved_elements(
    shape: Sequence[int], indices: np.ndarray, numbers: Any, moved: Sequence[int]
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Which elements of an array of this shape a gather or scatter moves, as indices with the shape
    of what is moved; and whether its slices are inside of the array. If not, they are moved there.

    What is moved has the axes of the indices but the last, and in the places `offsets` those of a
    slice. `starts` are the axes along which the last axis of the indices counts.
    """
    offsets, collapsed, starts, batching, of_indices = numbers
    along = {d: axis for axis, d in zip(of_indices, batching, strict=True)}
    kept = [d for d in range(len(shape)) if d not in (*collapsed, *batching)]
    windows = dict(zip(kept, offsets, strict=True))
    others = [axis for axis in range(len(moved)) if axis not in offsets]
    positions = np.meshgrid(*map(np.arange, moved), indexing="ij", sparse=True)
    at, inside = [], np.ones([1] * len(moved), bool)
    for d, n in enumerate(shape):
        start = np.zeros([1] * len(moved), int)
        if d in starts:
            start = np.expand_dims(indices[..., starts.index(d)].astype(int), offsets)
        elif d in along:
            start = positions[others[along[d]]]
        last = n - (moved[windows[d]] if d in windows else 1)
        inside = inside & (start >= 0) & (start <= last)
        at.append(np.clip(start, 0, last) + (positions[windows[d]] if d in windows else 0))
    return tuple(np.broadcast_to(x, moved) for x in at), np.broadcast_to(inside, moved)


def without_sharding(params: Any) -> dict[str, Any]:
    """The parameters of a primitive that matter here: those that are `None` do not, nor those that
    tell on which device something is."""
    return {k: v for k, v in params.items() if v is not None and "sharding" not in k}


def moved_by(
    eqn: Any, shape: Sequence[int], update_shape: Sequence[int], indices: list[np.ndarray]
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Which elements of an operand of this shape an equation of `BY_INDICES` takes or puts, as
    `moved_elements`, and which of them count."""
    name, params, axes = eqn.primitive.name, eqn.params, tuple(range(len(shape)))
    dynamic, takes = name.startswith("dynamic"), name in TAKES
    numbers = (axes, (), axes, (), ()) if dynamic else params["dimension_numbers"]
    starts = np.stack(indices, -1) if dynamic else indices[0]
    moved = eqn.outvars[0].aval.shape if takes else update_shape
    at, inside = moved_elements(shape, starts, numbers, moved)
    return at, inside | (params.get("mode") != lax.GatherScatterMode.FILL_OR_DROP)


# The primitives that only move elements, as functions that move their places by numpy. JAX itself
# could do that too, but it would compile each of them for each shape, which takes 15 to 50 ms.
MOVES: dict[str, Callable[..., _Places | list[_Places]]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "pad": _pad,
    "reshape": lambda x, new_sizes, dimensions=None: x.transpose(
        range(x.ndim) if dimensions is None else dimensions
    ).reshape(new_sizes),
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "slice": lambda x, start_indices, limit_indices, strides=None: np.asarray(
        x[tuple(map(slice, start_indices, limit_indices, strides or [1] * x.ndim))]
    ),
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, dimensions: x.squeeze(dimensions),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "tile": lambda x, reps: np.tile(x, reps),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "unstack": lambda x, axis: [*map(np.asarray, np.moveaxis(x, axis, 0))],
}
# The primitives that move elements by indices. The operands from the first number to before the
# last are the indices. We can move the places if the indices are known.
BY_INDICES = {
    "dynamic_slice": (1, None),
    "dynamic_update_slice": (2, None),
    "gather": (1, 2),
    "scatter": (1, 2),
    "scatter-add": (1, 2),
}
TAKES = frozenset({"dynamic_slice", "gather"})
# What is computed at once for known numbers. Indices need all of it: JAX replaces -1 by the last
# place before it uses them.
KNOWN: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "add": np.add,
    "and": np.bitwise_and,
    "convert_element_type": lambda x: x,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.bitwise_not,
    "or": np.bitwise_or,
    "select_n": lambda which, *cases: cases[int(which)],
    "sub": np.subtract,
}


def _once(fn: Callable[[Array], Array], x: Array) -> Array:
    """`fn(x)`, computed once.

    XLA considers a sine cheap, and computes it again in each kernel that uses it. In a gradient
    these are dozens. It does not compute quotients again, so we divide by a 1 that it cannot
    simplify away, because `x` might be infinite.
    """
    return fn(x) / (lax.stop_gradient(x) * 0 + 1)


# Primitives that are computed otherwise.
_INSTEAD: dict[str, Callable[..., Any]] = {
    "sin": ft.partial(_once, lax.sin),
    "cos": ft.partial(_once, lax.cos),
}


class _Program:
    """A list of operations, each on results of earlier ones, in which none stands twice."""

    def __init__(self, limit: int, differentiated: bool, zeros: bool):
        self.limit, self.differentiated, self.zeros = limit, differentiated, zeros
        self.num_operations = 0
        # At each place: a number, an operation with the places of its operands, or `None` for an
        # argument.
        self.entries: list[Any] = []
        self.places: dict[Any, int] = {}  # of operations and numbers
        self.negated: dict[int, int] = {}  # the place of `x` by that of `-x`
        # The arrays that were taken apart, by the place of their first element. If one is needed as
        # a whole again, it need not be stacked.
        self.wholes: dict[int, tuple[int, _Places]] = {}

    def argument(self) -> int:
        self.entries.append(None)
        return len(self.entries) - 1

    def results(self, closed: Any, inputs: list[_Places]) -> list[_Places]:
        return walk(closed, inputs, self._constant, self._equation)

    def evaluation(self, results: list[int]) -> Callable[[list[Any]], list[Any]]:
        """The results as a function of the arguments."""
        needed, rest = set(), [*results]
        while rest:
            i = rest.pop()
            if i not in needed and isinstance(self.entries[i], tuple):
                needed.add(i)
                rest += self.entries[i][1]
        if len(needed) > self.limit:
            raise _NotWrittenOut
        entries, order = self.entries, sorted(needed)

        def evaluate(arguments: list[Any]) -> list[Any]:
            values = arguments + entries[len(arguments) :]
            for i in order:
                fn, row = entries[i]
                values[i] = fn(*(values[j] for j in row))
            return [values[i] for i in results]

        return evaluate

    # ---- Equations ----

    def _equation(self, eqn: Any, inputs: list[_Places]) -> list[_Places]:
        """The places of the results of an equation, by the rule for its kind of primitive."""
        name, params = eqn.primitive.name, eqn.params
        if eqn.effects or any(_is_key(var.aval) for var in eqn.outvars):
            raise _NotWrittenOut
        given = without_sharding(params)
        dtype = eqn.outvars[0].aval.dtype if eqn.outvars else None
        if name in MOVES:
            moved = MOVES[name](*inputs, **given)
            return moved if isinstance(moved, list) else [moved]
        if name in BY_INDICES:
            return self._by_indices(eqn, inputs)
        if name == "iota":
            indices = np.arange(params["shape"][params["dimension"]], dtype=params["dtype"])
            return [self._constant(_broadcast(indices, params["shape"], (params["dimension"],)))]
        if name in ELEMENTWISE:
            if name == "copy" or (
                name == "convert_element_type" and dtype == eqn.invars[0].aval.dtype
            ):
                return inputs
            fn = ft.partial(eqn.primitive.bind, **params)
            fn = fn if self.zeros else _INSTEAD.get(name, fn)
            return [self._elementwise(name, fn, inputs, dtype, tuple(sorted(given.items())))]
        if name in _REDUCTIONS and given.keys() == {"axes"} and inputs[0].size:
            both, fn = _REDUCTIONS[name]
            return [self._reduce(both, fn, inputs[0], params["axes"], dtype)]
        types = {var.aval.dtype for var in (*eqn.invars, *eqn.outvars)}
        if name == "dot_general" and given.keys() <= _DOT and len(types) == 1:
            return [self._dot(inputs, params["dimension_numbers"], dtype)]
        if name in _CALLS or (name in _CALLS_WITH_A_RULE and not self.differentiated):
            return self.results(closed_jaxpr(params.get("call_jaxpr", params.get("jaxpr"))), inputs)
        return self._as_it_is(eqn, inputs)

    def _elementwise(
        self, name: str, fn: Any, inputs: list[_Places], dtype: Any, params: Any = ()
    ) -> _Places:
        inputs = [*np.broadcast_arrays(*inputs)]
        self._count(inputs[0].size)
        rows = zip(*(places.ravel().tolist() for places in inputs), strict=True)
        out = [self._scalar(name, fn, row, dtype, params) for row in rows]
        return np.array(out, int).reshape(inputs[0].shape)

    def _reduce(
        self, name: str, fn: Any, places: _Places, axes: Sequence[SupportsIndex], dtype: Any
    ) -> _Places:
        self._count(places.size)
        places = np.moveaxis(places, axes, range(-len(axes), 0))
        shape = places.shape[: places.ndim - len(axes)]
        rows = places.reshape(prod(shape), -1).tolist()
        both = lambda a, b: self._scalar(name, fn, (a, b), dtype)  # noqa: E731
        return np.array([ft.reduce(both, row) for row in rows], int).reshape(shape)

    def _dot(self, inputs: list[_Places], dimensions: Any, dtype: Any) -> _Places:
        """A product of arrays, as products of their elements that are summed. The axes of both are
        brought into the order batch, free, contracted, and the free ones are spread out."""
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
        product = self._elementwise("mul", lax.mul, [a, b], dtype)
        axes = tuple(range(product.ndim - last, product.ndim))
        return self._reduce("add", lax.add, product, axes, dtype)

    def _by_indices(self, eqn: Any, inputs: list[_Places]) -> list[_Places]:
        name, params, operand = eqn.primitive.name, eqn.params, inputs[0]
        first, last = BY_INDICES[name]
        found, dtype = [self._integers(x) for x in inputs[first:last]], eqn.outvars[0].aval.dtype
        indices = [x for x in found if x is not None]
        if len(indices) < len(found):
            return self._as_it_is(eqn, inputs)
        takes, updates = name in TAKES, inputs[1 if name.startswith("dynamic") else -1]
        at, counted = moved_by(eqn, operand.shape, updates.shape, indices)
        if takes and np.all(counted):
            return [np.asarray(operand[at])]
        if takes:
            filling = params["fill_value"]
            if filling is None and not jnp.issubdtype(dtype, jnp.inexact):
                return self._as_it_is(eqn, inputs)
            filling = np.asarray(np.nan if filling is None else filling, dtype)
            return [np.where(counted, operand[at], self._constant(filling))]
        out = operand.copy()
        at, updates = tuple(x[counted] for x in at), updates[counted]
        if name != "scatter-add":
            out[at] = updates
            return [out]
        self._count(updates.size)
        for *one, place in zip(*at, updates.tolist(), strict=True):
            both = int(out[tuple(one)]), place
            out[tuple(one)] = self._scalar("add", lax.add, both, dtype)
        return [out]

    def _as_it_is(self, eqn: Any, inputs: list[_Places]) -> list[_Places]:
        """A primitive for which there is no rule here: its inputs are stacked to arrays, and its
        outputs are taken apart."""
        self._count(sum(prod(var.aval.shape) for var in (*eqn.invars, *eqn.outvars)))
        row = tuple(self.array(x, v.aval.dtype) for x, v in zip(inputs, eqn.invars, strict=True))
        called = self._operation(id(eqn), lambda *xs: outputs(eqn, *xs), row)
        out = []
        for k, var in enumerate(eqn.outvars):
            one = self._operation("output", lambda xs, k=k: xs[k], (called,), k)
            out.append(self.elements(one, var.aval.shape))
        return out

    # ---- Arrays and their elements ----

    def elements(self, whole: int, shape: tuple[int, ...]) -> _Places:
        """The places of the elements of an array whose own place is given."""
        if not shape:
            return np.array(whole)
        flat = self._operation("elements", components, (whole,))
        each = [
            self._operation("element", lambda x, k=k: x[k], (flat,), k) for k in range(prod(shape))
        ]
        places = np.array(each, int).reshape(shape)
        if each:
            self.wholes[each[0]] = whole, places
        return places

    def array(self, places: _Places, dtype: Any) -> int:
        """The place of the array of these elements. If they are those of an array that was taken
        apart, in the same order, it is that array."""
        shape = places.shape
        if not shape:
            return int(places)
        row = tuple(places.ravel().tolist())
        whole, those = self.wholes.get(row[0], (0, None)) if row else (0, None)
        if those is not None and row == tuple(those.ravel().tolist()):
            if shape == those.shape:
                return whole
            return self._operation("reshape", lambda x: x.reshape(shape), (whole,), shape)

        def stacked(*scalars: Any) -> Any:
            if any(isinstance(x, jax.core.Tracer) for x in scalars):
                return jnp.stack(scalars).reshape(shape)
            return np.array(scalars, dtype).reshape(shape)

        return self._operation("array", stacked, row, (shape, dtype))

    def _constant(self, x: Any) -> _Places:
        self._count(np.size(x))
        if _is_key(x):
            raise _NotWrittenOut
        if isinstance(x, jax.core.Tracer):
            return self.elements(self._operation(id(x), lambda: x, ()), x.shape)
        x = np.asarray(x)
        numbers = [*map(self._number, x.flat)]
        return np.array(numbers, int).reshape(x.shape)

    def _integers(self, places: _Places) -> np.ndarray | None:
        """The values of an array of integers or booleans, as indices are; `None` if they are not
        known."""
        numbers = [self.entries[i] for i in places.flat]
        known = all(isinstance(x, np.generic) and x.dtype.kind in "iub" for x in numbers)
        return np.array(numbers).reshape(places.shape) if known else None

    # ---- Scalars ----

    def _number(self, x: Any) -> int:
        key = x.dtype, x.tobytes()
        if key not in self.places:
            self.places[key] = len(self.entries)
            self.entries.append(x)
        return self.places[key]

    def _operation(self, name: Any, fn: Any, row: tuple[int, ...], params: Any = ()) -> int:
        key = name, params, row
        if key not in self.places:
            self.places[key] = len(self.entries)
            self.entries.append((fn, row))
        return self.places[key]

    def _scalar(
        self, name: str, fn: Any, row: tuple[int, ...], dtype: Any, params: Any = ()
    ) -> int:
        """The place of the result of an operation on scalars."""
        name = "add" if name == "add_any" else name
        known = [x if isinstance(x := self.entries[i], np.generic) else None for i in row]
        if name in KNOWN and all(x is not None for x in known):
            with np.errstate(all="ignore"):
                return self._number(np.asarray(KNOWN[name](*known)).astype(dtype)[()])
        simpler = self._simpler(name, row, known, dtype)
        if simpler is not None:
            return simpler
        if name in ("add", "mul"):
            row = tuple(sorted(row))
        place = self._operation(name, fn, row, params)
        if name == "neg":
            self.negated[place] = row[0]
        return place

    def _simpler(self, name: str, row: Any, known: list[Any], dtype: Any) -> int | None:
        """The place of a result that needs no operation, or a simpler one."""
        zero, one, minus = ([x is not None and x == v for x in known] for v in (0, 1, -1))
        apply = lambda name, *row: self._scalar(name, getattr(lax, name), row, dtype)  # noqa: E731
        opposite = [self.negated.get(i) for i in row]
        match name:
            case "neg":
                return opposite[0]
            case "select_n" if known[0] is not None or len(set(row[1:])) == 1:
                return row[1 + int(known[0] or 0)]
            case "div" if one[1] or (zero[0] and self.zeros):
                return row[0]
            case "sub" if zero[1]:
                return row[0]
            case "sub" if zero[0]:
                return apply("neg", row[1])
            case "sub" if opposite[1] is not None:
                return apply("add", row[0], opposite[1])
            case "add":
                for i, j in ((0, 1), (1, 0)):
                    if zero[i]:
                        return row[j]
                    if opposite[i] is not None:
                        return apply("sub", row[j], opposite[i])
            case "mul":
                for i, j in ((0, 1), (1, 0)):
                    if one[i] or (zero[i] and self.zeros):
                        return row[j if one[i] else i]
                    if minus[i] and dtype.kind in "fc":
                        return apply("neg", row[j])
                    if opposite[i] is not None:
                        return apply("neg", apply("mul", opposite[i], row[j]))
        return None

    def _count(self, operations: int) -> None:
        self.num_operations += operations
        if self.num_operations > (
            SIMPLIFICATION_FACTOR * MAX_SCALAR_OPERATIONS if self.zeros else self.limit
        ):
            raise _NotWrittenOut


def _is_key(x: Any) -> bool:
    """Whether an array holds random keys, which have no arithmetic."""
    return jnp.issubdtype(x.dtype, jax.dtypes.extended)
