"""The places of a Jacobian that can differ from zero, and keys for the functions that have it.

The jaxpr of the function is walked with sets in the place of numbers: for each element of an array
the elements of the argument on which it depends. They are the rows of a sparse matrix of booleans,
so that a primitive is a few products and sums of such matrices. A primitive that moves elements
takes rows of it, one on elements takes the union of the rows of its operands, and a sum that of
those that it adds up. An operation that has no rule here may depend on all elements of its
operands. Numbers are followed too, as far as they are known, because they are indices, or zeros by
which something is multiplied.
"""

import dataclasses
import functools as ft
from collections.abc import Iterable, Iterator
from math import prod
from typing import Any

import jax
import jax.core
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from .._fast.arrays import computed
from .._fast.jaxprs import closed_jaxpr, jaxprs_inside, outputs, walk
from .._fast.scalars import BY_INDICES, ELEMENTWISE, MOVES, TAKES, moved_by

# An array of which so many pairs of elements depend on each other is not sparse.
_MOST_PAIRS = 2 * 10**7
# A loop over more elements than these is taken as one in which all depend on each other.
_MOST_STEPS = 1000
_SCATTERS = dict.fromkeys(["scatter-mul", "scatter-min", "scatter-max", "scatter-sub"], (1, 2))
_BY_INDICES = BY_INDICES | _SCATTERS
_CUMULATED = frozenset(["cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp"])
_REDUCTIONS = frozenset(["reduce_sum", "reduce_prod", "reduce_max", "reduce_min"])
_CALLS = {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}
_CALLS |= dict.fromkeys(["closed_call", "core_call", "checkpoint", "remat2"], "jaxpr")
_ON_ELEMENTS = ELEMENTWISE | {
    "reduce_precision",
    "digamma",
    "polygamma",
    "bessel_i0e",
    "bessel_i1e",
}
# Their derivative is zero, where it exists.
_STEPS = frozenset(["ceil", "floor", "round", "sign", "stop_gradient"])


def constants_of(closed: Any) -> Iterator[Any]:
    """The arrays over which a jaxpr and those inside it close, which their text does not show."""
    yield from closed.consts
    for eqn in closed.jaxpr.eqns:
        yield from (x.val for x in eqn.invars if isinstance(x, jex.Literal) and np.ndim(x.val))
        for inside in jaxprs_inside(eqn):
            yield from constants_of(inside)


def content_key(x: Any) -> Any:
    """A key for a constant of a function. The value of a tracer is not known, only its shape."""
    if isinstance(x, jax.core.Tracer):
        return x.shape, x.dtype
    return np.shape(x), np.asarray(x).tobytes()


def jacobian_places(closed: Any) -> tuple[np.ndarray, np.ndarray]:
    """The rows and columns of the elements of the Jacobian of the first output by the first
    argument that can differ from zero, whatever the other arguments are, and constants that JAX
    traces. Raises `NotSparse` if it is found that nearly all can."""
    like = closed.in_avals
    one = sp.eye_array(prod(like[0].shape), dtype=bool, format="csr")
    given = [_Array(x.shape, x.dtype) for x in like]
    given[0] = dataclasses.replace(given[0], depends=one)
    found = sp.coo_array(_of_jaxpr(closed, given)[0].on(one.shape[1]))
    return found.coords[0].astype(np.int64), found.coords[1].astype(np.int64)


class NotSparse(Exception):
    """Too many elements of an array depend on too many elements of the argument."""


@dataclasses.dataclass
class _Array:
    """What is known of an array: its elements, and for each the elements of the argument on which
    it depends; `None` if nothing, or none."""

    shape: tuple[int, ...]
    dtype: Any
    known: np.ndarray | None = None
    depends: sp.csr_array | None = None

    @property
    def size(self) -> int:
        return prod(self.shape)

    @property
    def places(self) -> np.ndarray:
        return np.arange(self.size).reshape(self.shape)

    def on(self, n: int) -> sp.csr_array:
        if self.depends is None:
            return sp.csr_array((self.size, n), dtype=bool)
        return self.depends

    def rows(self, places: np.ndarray) -> sp.csr_array | None:
        """What elements in these places depend on."""
        return None if self.depends is None else self.depends[places.ravel()]


def _of_jaxpr(closed: Any, given: list[_Array]) -> list[_Array]:
    return walk(closed, given, _constant, _equation)


def _constant(x: Any) -> _Array:
    if isinstance(x, jax.core.Tracer) or jnp.issubdtype(x.dtype, jax.dtypes.extended):
        return _Array(x.shape, x.dtype)
    return _Array(np.shape(x), x.dtype, np.asarray(x))


def _equation(eqn: Any, xs: list[_Array]) -> list[_Array]:
    """What is known of the results of an equation."""
    name, params = eqn.primitive.name, eqn.params
    none = [_Array(var.aval.shape, var.aval.dtype) for var in eqn.outvars]
    if all(x.depends is None for x in xs):
        known = [x.known for x in xs]
        if all(x is not None for x in known):
            for out, number in zip(none, _numbers(eqn, known, none), strict=True):
                out.known = number
        return none
    if name in _STEPS:
        return none
    if name in _CALLS:
        return _of_jaxpr(closed_jaxpr(params[_CALLS[name]]), xs)
    if name == "cond":
        which, *given = xs
        branches = [*map(closed_jaxpr, params["branches"])]
        if which.known is not None:
            branches = [branches[int(np.clip(which.known, 0, len(branches) - 1))]]
        found = [_of_jaxpr(branch, given) for branch in branches]
        return [_either(*outs) for outs in zip(*found, strict=True)]
    if name == "while":
        first = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        body = ft.partial(_of_jaxpr, params["body_jaxpr"])
        return _repeated(lambda carry: body(xs[first[0] : first[1]] + carry), xs[first[1] :])
    if name == "scan":
        return _scanned(params, xs)
    if not any(jnp.issubdtype(x.dtype, jnp.inexact) for x in none):
        return none
    if name in MOVES:
        return _moved(eqn, xs, none)
    if name == "sort":
        for x, out in zip(xs, none, strict=True):
            every = np.ones([x.shape[params["dimension"]]] * 2, bool)
            out.depends = _along(x, params["dimension"], every)
        return none
    if len(none) > 1:
        return _all(xs, none)
    (out,) = none
    if name in _BY_INDICES:
        out.depends = _by_indices(eqn, xs, out)
    elif name in _ON_ELEMENTS:
        out.depends = _union(_relevant(name, xs, out.shape))
    elif name in _REDUCTIONS:
        (x,) = xs
        axes = params["axes"]
        places = np.moveaxis(x.places, axes, range(-len(axes), 0)).reshape(out.size, -1)
        out.depends = _chosen(np.arange(out.size)[:, None], places, out, x)
    elif name in _CUMULATED:
        before = np.tri(xs[0].shape[params["axis"]], dtype=bool)
        out.depends = _along(xs[0], params["axis"], before.T if params["reverse"] else before)
    elif name == "dot_general":
        out.depends = _product(xs, params["dimension_numbers"], out)
    elif name == "conv_general_dilated" and xs[1].depends is None:
        out.depends = _convolved(xs[0], xs[1].shape, params, out)
    else:
        return _all(xs, none)
    return none


def _numbers(eqn: Any, xs: list[Any], none: list[_Array]) -> list[np.ndarray | None]:
    """The results of numbers. Those that are not integers are needed only as far as zeros among
    them are, so not of functions such as the sine."""
    found = computed(eqn, xs)
    if found is None and all(np.dtype(x.dtype).kind in "iub" for x in none):
        found = outputs(eqn, *xs)
    if found is None:
        return [None for _ in none]
    found = found if isinstance(found, list) else [found]
    return [np.asarray(x, out.dtype) for x, out in zip(found, none, strict=True)]


def _sparse(matrix: Any) -> sp.csr_array:
    if matrix.nnz > _MOST_PAIRS:
        raise NotSparse
    return sp.csr_array(matrix)


def _union(parts: list[sp.csr_array | None]) -> sp.csr_array | None:
    found = [x for x in parts if x is not None]
    return _sparse(ft.reduce(lambda a, b: a + b, found)) if found else None


def _either(*xs: _Array) -> _Array:
    return dataclasses.replace(xs[0], known=None, depends=_union([x.depends for x in xs]))


def _all(xs: list[_Array], none: list[_Array]) -> list[_Array]:
    """Each element may depend on all elements of all operands."""
    found = [x.depends.sum(0) > 0 for x in xs if x.depends is not None]
    any_of = np.flatnonzero(np.any(found, axis=0))
    n = next(x.depends.shape[1] for x in xs if x.depends is not None)
    for out in none:
        if out.size * any_of.size > _MOST_PAIRS:
            raise NotSparse
        if jnp.issubdtype(out.dtype, jnp.inexact):
            at = np.arange(out.size).repeat(any_of.size), np.tile(any_of, out.size)
            out.depends = sp.csr_array((np.ones(at[0].size, bool), at), (out.size, n))
    return none


def _chosen(rows: Any, places: np.ndarray, out: _Array, x: _Array) -> sp.csr_array | None:
    """For each row of the result the union of what the elements of `x` in the places depend on."""
    if x.depends is None:
        return None
    if places.size > _MOST_PAIRS:
        raise NotSparse
    rows = np.broadcast_to(rows, places.shape).ravel()
    choice = (np.ones(rows.size, bool), (rows, places.ravel()))
    return _sparse(sp.csr_array(choice, (out.size, x.size)) @ x.depends)


def _moved(eqn: Any, xs: list[_Array], none: list[_Array]) -> list[_Array]:
    given = {k: v for k, v in eqn.params.items() if v is not None and "sharding" not in k}
    starts = np.cumsum([0, *(x.size for x in xs)])
    places = [x.places + start for x, start in zip(xs, starts, strict=False)]
    moved = MOVES[eqn.primitive.name](*places, **given)
    n = next(x.depends.shape[1] for x in xs if x.depends is not None)
    whole = xs[0].on(n) if len(xs) == 1 else sp.csr_array(sp.vstack([x.on(n) for x in xs]))
    for out, those in zip(none, moved if isinstance(moved, list) else [moved], strict=True):
        out.depends = whole[those.ravel()]
    return none


def _relevant(name: str, xs: list[_Array], shape: tuple[int, ...]) -> list[sp.csr_array | None]:
    """What an operation on elements depends on, for each operand. A product with the number zero
    depends on nothing, and a choice that is known on what is chosen."""
    full = [np.broadcast_to(x.places, shape) for x in xs]
    rows = [x.depends if x.shape == shape else x.rows(at) for x, at in zip(xs, full, strict=True)]

    def only(k: int, where: np.ndarray) -> None:
        if rows[k] is not None and not np.all(where):
            where = np.broadcast_to(where, shape).ravel()
            rows[k] = sp.csr_array(sp.diags_array(where, dtype=bool) @ rows[k])

    if name == "mul":
        for k, other in ((0, xs[1]), (1, xs[0])):
            if other.known is not None:
                only(k, other.known != 0)
    if name == "select_n":
        rows[0] = None
        if xs[0].known is not None:
            for k in range(1, len(xs)):
                only(k, xs[0].known == k - 1)
    return rows


def _along(x: _Array, axis: int, on: np.ndarray) -> sp.csr_array | None:
    """Of an operation along an axis, where `on[i, j]` tells whether element `i` of the result
    depends on `j`."""
    lines = np.moveaxis(x.places, axis, -1).reshape(-1, x.shape[axis])
    of, by = np.nonzero(on)
    if len(lines) * of.size > _MOST_PAIRS:
        raise NotSparse
    return _chosen(lines[:, of], lines[:, by], x, x)


def _product(xs: list[_Array], dimensions: Any, out: _Array) -> sp.csr_array | None:
    """Of a product of arrays: the axes of both are brought into the order batch, free, contracted,
    and the free ones are spread out."""
    contracted, batch = dimensions
    sizes, places = [], []
    for x, some, summed in zip(xs, batch, contracted, strict=True):
        free = [i for i in range(len(x.shape)) if i not in (*some, *summed)]
        groups = [prod(x.shape[i] for i in group) for group in (some, free, summed)]
        sizes.append(groups)
        places.append(x.places.transpose([*some, *free, *summed]).reshape(groups))
    if out.size * sizes[0][2] > _MOST_PAIRS:
        raise NotSparse
    shape = sizes[0][0], sizes[0][1], sizes[1][1], sizes[0][2]
    at = [np.broadcast_to(places[0][:, :, None], shape), np.broadcast_to(places[1][:, None], shape)]
    rows = np.broadcast_to(np.arange(out.size).reshape(shape[:3])[..., None], shape)
    found = []
    for k, other in ((0, 1), (1, 0)):
        known = xs[other].known
        some = slice(None) if known is None else known.ravel()[at[other]] != 0
        found.append(_chosen(rows[some], at[k][some], out, xs[k]))
    return _union(found)


def _convolved(x: _Array, kernel: tuple[int, ...], params: Any, out: _Array) -> sp.csr_array | None:
    """For each element of the kernel the pairs of elements that it joins, in the order of axes
    batch, channels, and those of space."""
    numbers = params["dimension_numbers"]
    given, result = x.places.transpose(numbers.lhs_spec), out.places.transpose(numbers.out_spec)
    channels, each, *width = (kernel[i] for i in numbers.rhs_spec)
    group = np.arange(channels) // (channels // params["feature_group_count"])
    channel = group[:, None] * each + np.arange(each)
    if params["batch_group_count"] > 1:
        return _all([x], [out])[0].depends
    rows, places = [], []
    for offset in np.ndindex(*width):
        inside, at = [], []
        for d, k in enumerate(offset):
            position = np.arange(result.shape[2 + d]) * params["window_strides"][d]
            position += k * params["rhs_dilation"][d] - params["padding"][d][0]
            source, rest = np.divmod(position, params["lhs_dilation"][d])
            ok = (rest == 0) & (source >= 0) & (source < given.shape[2 + d])
            inside.append(np.flatnonzero(ok))
            at.append(source[ok])
        number = np.arange(len(given))
        taken = given[np.ix_(number, np.arange(given.shape[1]), *at)][:, channel]
        made = result[np.ix_(number, np.arange(channels), *inside)][:, :, None]
        places.append(taken.ravel())
        rows.append(np.broadcast_to(made, taken.shape).ravel())
    return _chosen(np.concatenate(rows), np.concatenate(places), out, x)


def _by_indices(eqn: Any, xs: list[_Array], out: _Array) -> sp.csr_array | None:
    name, (first, last) = eqn.primitive.name, _BY_INDICES[eqn.primitive.name]
    takes, operand = name in TAKES, xs[0]
    indices = [x.known for x in xs[first:last]]
    update = operand if takes else xs[1 if name.startswith("dynamic") else -1]
    if any(x is None for x in indices):
        return _all([operand, update], [out])[0].depends
    at, inside = moved_by(eqn, operand.shape, update.shape, indices)  # pyright: ignore
    at = np.ravel_multi_index(at, operand.shape)
    if takes:
        return _chosen(out.places[inside], at[inside], out, operand)
    new = _chosen(at[inside], update.places[inside], out, update)
    old = operand.depends
    if name in ("scatter", "dynamic_update_slice") and old is not None:
        kept = np.ones(out.size, bool)
        kept[at[inside].ravel()] = False
        old = sp.csr_array(sp.diags_array(kept, dtype=bool) @ old)
    return _union([old, new])


def _repeated(advance: Any, carry: list[_Array]) -> list[_Array]:
    """What is carried by a loop, after any number of steps."""
    while True:
        before = [dataclasses.replace(x, known=None) for x in carry]
        carry = [_either(*pair) for pair in zip(before, advance(before), strict=True)]
        if all(
            (0 if a.depends is None else a.depends.nnz)
            == (0 if b.depends is None else b.depends.nnz)
            for a, b in zip(before, carry, strict=True)
        ):
            return carry


def _scanned(params: Any, xs: list[_Array]) -> list[_Array]:
    first, length = params["num_consts"], params["length"]
    consts, carry = xs[:first], xs[first : first + params["num_carry"]]
    over, body = xs[first + params["num_carry"] :], closed_jaxpr(params["jaxpr"])
    if length > _MOST_STEPS:
        raise NotSparse
    order, found = range(length), []
    for i in reversed(order) if params["reverse"] else order:
        each = [
            _Array(
                x.shape[1:],
                x.dtype,
                None if x.known is None else x.known[i],
                None if x.depends is None else x.rows(x.places[i]),
            )
            for x in over
        ]
        outs = _of_jaxpr(body, [*consts, *carry, *each])
        carry = outs[: len(carry)]
        found.append(outs[len(carry) :])
    if params["reverse"]:
        found.reverse()
    stacked = []
    for parts in zip(*found, strict=True):
        n = next((x.depends.shape[1] for x in parts if x.depends is not None), None)
        depends = None if n is None else sp.csr_array(sp.vstack([x.on(n) for x in parts]))
        stacked.append(_Array((length, *parts[0].shape), parts[0].dtype, None, depends))
    return [*carry, *stacked]


def coloured(lines: np.ndarray, across: np.ndarray, number: int) -> tuple[np.ndarray, int]:
    """A colour for each line of a matrix with elements in these places, such that lines of one
    colour have no element in the same place across, and the number of colours. Each line in turn
    gets the first colour that is free, in the order given or, if that takes too many, those with
    most elements first."""
    order, counts = np.argsort(lines, kind="stable"), np.bincount(lines, minlength=number)
    flat, ends = across[order].tolist(), np.cumsum(counts).tolist()
    each = [flat[start:end] for start, end in zip([0, *ends], ends, strict=False)]
    sizes = np.bincount(across)
    found = _greedy(range(number), each, len(sizes))
    if found[1] > np.max(sizes, initial=0):  # there must be as many as elements in a place across
        others = _greedy(np.argsort(-counts, kind="stable").tolist(), each, len(sizes))
        found = min(found, others, key=lambda found: found[1])
    return found


def _greedy(order: Iterable[int], each: list[list[int]], size: int) -> tuple[np.ndarray, int]:
    colours, taken = [0] * len(each), [0] * size  # the bits of a number are colours
    for line in order:
        used = 0
        for i in each[line]:
            used |= taken[i]
        free = ~used & (used + 1)
        for i in each[line]:
            taken[i] |= free
        colours[line] = free.bit_length() - 1
    return np.array(colours, int), max(colours, default=-1) + 1
