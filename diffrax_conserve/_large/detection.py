"""The places of a Jacobian that can differ from zero, and keys for the functions that have it.

The jaxpr of the derivative along a tangent is walked with sets in the place of numbers: for each
element of an array the elements of the tangent on which it depends. They are the rows of a sparse
matrix of booleans, so that a primitive is a few products and sums of such matrices. A primitive
that moves elements takes rows of it, one on elements takes the union of the rows of its operands,
and a sum that of those that it adds up. The derivative is linear in the tangent, so that no other
primitives need a rule. An operation that has no rule here may depend on all
elements of its operands. Numbers are followed too, as far as they are known, because they are
indices, or zeros by which something is multiplied.
"""

import functools as ft
from collections.abc import Iterable, Iterator
from math import prod
from typing import Any, NamedTuple

import jax
import jax.core
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array

from .._fast.arrays import computed, is_whole
from .._fast.jaxprs import carried, closed_jaxpr, jaxprs_inside, outputs, walk
from .._fast.scalars import BY_INDICES, ELEMENTWISE, MOVES, TAKES, moved_by, without_sharding

# A matrix or an array of more elements than these is not followed, and no loop of more steps.
_MOST_ELEMENTS, _MOST_STEPS = 2 * 10**7, 1000
# The search ends after this many elements, about ten seconds, plus so many for each unknown. An
# equation of the jaxpr takes as long as a number of elements.
_MOST_WORK, _WORK_PER_UNKNOWN, _WORK_PER_EQUATION = 10**8, 1000, 5000
_CALLS = frozenset(["closed_call", "core_call", "checkpoint", "remat2"])
_BY_INDICES = BY_INDICES | dict.fromkeys(["scatter-sub", "scatter-mul"], (1, 2))


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
    traces. Raises `NotSparse` if too many can."""
    fn, given = jex.jaxpr_as_fun(closed), closed.in_avals

    def along(tangent: Array, x: Array, *rest: Array) -> Array:
        return jax.jvp(lambda x: fn(x, *rest)[0], (x,), (tangent,))[1]

    walker = _Walker(n := prod(given[0].shape))
    tangent, *others = map(walker.unknown, (given[0], *given))
    tangent = tangent._replace(on=sp.eye_array(n, dtype=bool, format="csr"))
    linear = jax.make_jaxpr(along)(given[0], *given)
    found = sp.coo_array(walker.of_jaxpr(linear, [tangent, *others])[0].on)
    return found.coords[0].astype(np.int64), found.coords[1].astype(np.int64)


class NotSparse(Exception):
    """Too many elements of an array depend on too many elements of the argument."""


class _Array(NamedTuple):
    """What is known of an array: for each element, a row of `on`, on which elements of the argument
    it depends; and the elements themselves, or `None`."""

    shape: tuple[int, ...]
    dtype: Any
    on: sp.csr_array
    known: np.ndarray | None = None

    @property
    def size(self) -> int:
        return prod(self.shape)

    @property
    def places(self) -> np.ndarray:
        return np.arange(self.size).reshape(self.shape)


class _Walker:
    """The rules for the primitives, with an argument of `n` elements."""

    def __init__(self, n: int):
        self.n, self.left = n, _MOST_WORK + _WORK_PER_UNKNOWN * n

    def unknown(self, like: Any, known: np.ndarray | None = None) -> _Array:
        on = sp.csr_array((prod(like.shape), self.n), dtype=bool)
        return _Array(tuple(like.shape), like.dtype, on, known)

    def constant(self, x: Any) -> _Array:
        hidden = isinstance(x, jax.core.Tracer) or jnp.issubdtype(x.dtype, jax.dtypes.extended)
        return self.unknown(x, None if hidden else np.asarray(x))

    def of_jaxpr(self, closed: Any, given: list[_Array]) -> list[_Array]:
        return walk(closed_jaxpr(closed), given, self.constant, self.counted)

    def counted(self, eqn: Any, xs: list[_Array]) -> list[_Array]:
        if max((prod(var.aval.shape) for var in eqn.outvars), default=0) > _MOST_ELEMENTS:
            raise NotSparse
        found = self.equation(eqn, xs)
        self.left -= _WORK_PER_EQUATION + sum(x.on.nnz for x in found)
        if self.left < 0:
            raise NotSparse
        return found

    def equation(self, eqn: Any, xs: list[_Array]) -> list[_Array]:
        """What is known of the results of an equation."""
        name, params = eqn.primitive.name, eqn.params
        out = [self.unknown(var.aval) for var in eqn.outvars]
        if not any(x.on.nnz for x in xs):
            return _numbers(eqn, xs, out)
        if name in _CALLS:
            return self.of_jaxpr(params["jaxpr"], xs)
        if name == "cond":
            which, *given = xs
            ends = [self.of_jaxpr(branch, given) for branch in params["branches"]]
            ends = ends if which.known is None else [ends[int(which.known)]]
            return [*map(_either, *ends)] if len(ends) > 1 else ends[0]
        if name == "while":
            first, count = params["cond_nconsts"], params["body_nconsts"]
            consts, carry = xs[first : first + count], xs[first + count :]
            return self._repeated(params["body_jaxpr"], consts, carry)
        if name == "scan":
            return self._scanned(eqn, xs)
        if not any(jnp.issubdtype(x.dtype, jnp.inexact) for x in out):
            return out
        found = _dependence(eqn, xs, out)
        if found is None:  # there is no rule: on all elements of all operands
            some = np.flatnonzero(sum(x.on.sum(0) for x in xs))
            found = [_pairs(x, np.arange(x.size)[:, None], some, self.n) for x in out]
        return [x._replace(on=on) for x, on in zip(out, found, strict=True)]

    def _repeated(self, body: Any, consts: list[_Array], carry: list[_Array]) -> list[_Array]:
        """What a loop carries, after any number of steps."""
        before = -1
        while before < (before := sum(x.on.nnz for x in carry)):
            carry = [x._replace(known=None) for x in carry]
            carry = [*map(_either, carry, self.of_jaxpr(body, [*consts, *carry]))]
        return carry

    def _scanned(self, eqn: Any, xs: list[_Array]) -> list[_Array]:
        params, found, (first, last) = eqn.params, [], carried(eqn)
        length = params["length"]
        if not 0 < length <= _MOST_STEPS:
            raise NotSparse
        consts, carry, order = xs[:first], xs[first:last], range(length)
        for i in reversed(order) if params["reverse"] else order:
            each = [
                _Array(x.shape[1:], x.dtype, x.on[x.places[i].ravel()], _at(x.known, i))
                for x in xs[last:]
            ]
            ends = self.of_jaxpr(params["jaxpr"], [*consts, *carry, *each])
            carry = ends[: len(carry)]
            found.append(ends[len(carry) :])
        parts = [*zip(*(reversed(found) if params["reverse"] else found), strict=True)]
        wholes = (sp.csr_array(sp.vstack([x.on for x in row])) for row in parts)
        ends = [
            _Array((length, *row[0].shape), row[0].dtype, on)
            for row, on in zip(parts, wholes, strict=True)
        ]
        return [*carry, *ends]


def _at(known: np.ndarray | None, i: int) -> np.ndarray | None:
    return None if known is None else known[i]


def _numbers(eqn: Any, xs: list[_Array], out: list[_Array]) -> list[_Array]:
    """The results of numbers. Those that are not integers are needed only as far as zeros among
    them are, so not of functions such as the sine."""
    known = [x.known for x in xs]
    if any(x is None for x in known):
        return out
    found = computed(eqn, known)  # pyright: ignore
    if found is None and all(is_whole(x.dtype) for x in out):
        found = outputs(eqn, *known)
    if found is None:
        return out
    found = found if isinstance(found, list) else [found]
    return [x._replace(known=np.asarray(y, x.dtype)) for x, y in zip(out, found, strict=True)]


def _either(*xs: _Array) -> _Array:
    return xs[0]._replace(known=None, on=_union(x.on for x in xs))


def _union(parts: Iterable[sp.csr_array]) -> sp.csr_array:
    return ft.reduce(lambda a, b: a + b, parts)


def _pairs(out: _Array, rows: Any, columns: Any, width: int) -> sp.csr_array:
    """A matrix with elements in these places, whose rows are those of the result."""
    rows, columns = np.broadcast_arrays(rows, columns)
    if rows.size > _MOST_ELEMENTS:
        raise NotSparse
    at = rows.ravel(), columns.ravel()
    return sp.csr_array((np.ones(rows.size, bool), at), (out.size, width))


def _chosen(out: _Array, rows: Any, places: Any, x: _Array) -> sp.csr_array:
    """What the result depends on, if its elements in `rows` depend on those of `x` in `places`."""
    pairs = _pairs(out, rows, places, x.size)
    if np.sum(np.diff(x.on.indptr)[pairs.indices]) > _MOST_ELEMENTS:
        raise NotSparse
    return sp.csr_array(pairs @ x.on)


def _taken(on: sp.csr_array, rows: np.ndarray) -> sp.csr_array:
    """These rows, some of them repeatedly."""
    if np.sum(np.diff(on.indptr)[rows]) > _MOST_ELEMENTS:
        raise NotSparse
    return on[rows]


def _dependence(eqn: Any, xs: list[_Array], out: list[_Array]) -> list[sp.csr_array] | None:
    """On what the results of an equation depend; `None` if there is no rule for its primitive."""
    name, params, x, one = eqn.primitive.name, eqn.params, xs[0], out[0]
    if name in MOVES:
        starts = np.cumsum([0, *(x.size for x in xs)])
        places = [np.asarray(x.places + start) for x, start in zip(xs, starts, strict=False)]
        moved = MOVES[name](*places, **without_sharding(params))
        whole = sp.csr_array(sp.vstack([x.on for x in xs]))
        return [_taken(whole, at.ravel()) for at in (moved if isinstance(moved, list) else [moved])]
    if name == "cumsum":
        return [_cumulated(x, params["axis"], params["reverse"])]
    if name in ELEMENTWISE:
        return [_union(_relevant(name, xs, one.shape))]
    if name == "reduce_sum":
        axes = params["axes"]
        places = np.moveaxis(x.places, axes, range(-len(axes), 0)).reshape(one.size, -1)
        return [_chosen(one, np.arange(one.size)[:, None], places, x)]
    if name == "dot_general":
        return [_product(xs, params["dimension_numbers"], one)]
    if name == "conv_general_dilated" and not xs[1].on.nnz and params["batch_group_count"] == 1:
        return [_convolved(x, xs[1].shape, params, one)]
    if name in _BY_INDICES and all(i.known is not None for i in xs[slice(*_BY_INDICES[name])]):
        return [_by_indices(eqn, xs, one)]
    return None


def _relevant(name: str, xs: list[_Array], shape: tuple[int, ...]) -> list[sp.csr_array]:
    """What an operation on elements depends on, for each operand. A product with the number zero
    depends on nothing, and a choice that is known on what is chosen."""
    rows = [
        x.on if x.shape == shape else _taken(x.on, np.broadcast_to(x.places, shape).ravel())
        for x in xs
    ]

    def only(k: int, where: np.ndarray) -> None:
        where = np.broadcast_to(where, shape).ravel()
        rows[k] = sp.csr_array(sp.diags_array(where, dtype=bool) @ rows[k])

    if name == "mul":
        for k, other in ((0, xs[1].known), (1, xs[0].known)):
            if other is not None and not np.all(other):
                only(k, other != 0)
    if name == "select_n":
        which = xs[0].known
        for k in range(1, len(xs)) if which is not None else ():
            only(k, which == k - 1)
        return rows[1:]
    return rows


def _cumulated(x: _Array, axis: int, reverse: bool) -> sp.csr_array:
    """Of sums along an axis, each with all elements before it or, in reverse, after it."""
    lines = np.moveaxis(x.places, axis, -1).reshape(-1, x.shape[axis])
    before = np.tri(x.shape[axis], dtype=bool)
    of, by = np.nonzero(before.T if reverse else before)
    if len(lines) * of.size > _MOST_ELEMENTS:
        raise NotSparse
    return _chosen(x, lines[:, of], lines[:, by], x)


def _product(xs: list[_Array], dimensions: Any, out: _Array) -> sp.csr_array:
    """Of a product of arrays: the axes of both are brought into the order batch, free, contracted,
    and the free ones are spread out. A product with the number zero depends on nothing."""
    contracted, batch = dimensions
    sizes, places = [], []
    for x, some, summed in zip(xs, batch, contracted, strict=True):
        free = [i for i in range(len(x.shape)) if i not in (*some, *summed)]
        sizes.append([prod(x.shape[i] for i in group) for group in (some, free, summed)])
        places.append(x.places.transpose([*some, *free, *summed]).reshape(sizes[-1]))
    shape = sizes[0][0], sizes[0][1], sizes[1][1], sizes[0][2]
    if prod(shape) > _MOST_ELEMENTS:
        raise NotSparse
    at = [np.broadcast_to(places[0][:, :, None], shape), np.broadcast_to(places[1][:, None], shape)]
    rows, found = np.broadcast_to(out.places.reshape(*shape[:3], 1), shape), []
    for k, other in ((0, 1), (1, 0)):
        known = xs[other].known
        some = ... if known is None else known.ravel()[at[other]] != 0
        found.append(_chosen(out, rows[some], at[k][some], xs[k]))
    return _union(found)


def _convolved(x: _Array, kernel: tuple[int, ...], params: Any, out: _Array) -> sp.csr_array:
    """For each element of the kernel the pairs of elements that it joins. The axes are in the order
    batch, channels, and those of space."""
    numbers = params["dimension_numbers"]
    given, result = x.places.transpose(numbers.lhs_spec), out.places.transpose(numbers.out_spec)
    channels, each, *width = (kernel[i] for i in numbers.rhs_spec)
    group = np.arange(channels) // (channels // params["feature_group_count"])
    channel, rows, places = group[:, None] * each + np.arange(each), [], []
    for offset in np.ndindex(*width):
        inside, at = [], []
        for d, k in enumerate(offset):
            position = np.arange(result.shape[2 + d]) * params["window_strides"][d]
            position += k * params["rhs_dilation"][d] - params["padding"][d][0]
            source, rest = np.divmod(position, params["lhs_dilation"][d])
            ok = (rest == 0) & (source >= 0) & (source < given.shape[2 + d])
            inside.append(np.flatnonzero(ok))
            at.append(source[ok])
        taken = given[np.ix_(*map(np.arange, given.shape[:2]), *at)][:, channel]
        made = result[np.ix_(*map(np.arange, result.shape[:2]), *inside)][:, :, None]
        places.append(taken.ravel())
        rows.append(np.broadcast_to(made, taken.shape).ravel())
    return _chosen(out, np.concatenate(rows), np.concatenate(places), x)


def _by_indices(eqn: Any, xs: list[_Array], out: _Array) -> sp.csr_array:
    """Elements that are taken, or put, by known indices."""
    name, operand = eqn.primitive.name, xs[0]
    indices: Any = [x.known for x in xs[slice(*_BY_INDICES[name])]]
    update = xs[1 if name.startswith("dynamic") else -1]
    at, counted = moved_by(eqn, operand.shape, update.shape, indices)
    at = np.ravel_multi_index(at, operand.shape)[counted]
    if name in TAKES:
        return _chosen(out, out.places[counted], at, operand)
    kept = np.ones(out.size, bool)
    if name in ("scatter", "dynamic_update_slice"):
        kept[at] = False
    old = sp.csr_array(sp.diags_array(kept, dtype=bool) @ operand.on)
    return old + _chosen(out, at, update.places[counted], update)


# ---- Colours ----


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
    return np.array(colours, int), max(taken, default=0).bit_length()
