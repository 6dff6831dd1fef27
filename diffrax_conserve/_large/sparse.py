"""The Jacobian of many constraints, each of which depends on a few components of the state.

Molecules have thousands of bonds, magnets a spin of fixed length at each site. Which elements of
such a Jacobian can differ from zero follows from the functions alone. This *pattern* is found once,
when a solve is traced, and everything that depends on it is an array of integers known to XLA.

- *Colours.* Rows of the same colour share no component, so that one reverse pass with the sum of
  their seeds computes all of them (Curtis, Powell and Reid, 1974).
- *Blocks.* Constraints are ordered such that the Gram matrix `U Vᵀ` is block diagonal, as that of
  spins and of molecules, or block tridiagonal, as that of a chain. The rows of a block are stored
  as a small dense matrix in the components on which the block depends. The Gram matrix is factored
  by cyclic reduction: each step eliminates every other block, for all of them at once.
- *Dense rows.* An energy or a momentum depends on all components. A few such rows beside the sparse
  ones are eliminated last, by their Schur complement.
- Where the blocks would be too large, as in a membrane, and the system is too large for a dense
  matrix too, it is solved by KLU, or by iteration where that is missing: on a GPU and in float32.
"""

import functools as ft
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._constants import (
    DENSE_ROW_RATIO,
    MAX_BLOCK_WITH_KLU,
    MAX_DENSE_ROWS,
    MAX_DENSE_SYSTEM,
    MAX_ELIMINATION,
    MIN_SPARSE,
)
from .._memory import Memory
from .detection import NotSparse, coloured, constants_of, content_key, jacobian_places
from .klu import Places, available

# A dense Jacobian of this many bytes, 256 MiB, is announced before it is allocated.
_LARGE, _GIB = 2**28, 2**30


class Pattern:
    """The places of the elements of a sparse Jacobian. It is equal only to itself, because equal
    functions share one.

    A place is an index. In an array of places an index past the end marks an empty place.

    - `size`, `num_columns`: the numbers of rows and of columns.
    - `colours`: for each entry of the manifold the colour of each row, and their number.
    - `sparse_colours`, `dense_colours`: which colours, counted over all entries, belong to sparse
      rows, and which to dense ones. Each dense row has a colour of its own.
    - `dense_rows`: the rows that are dense.
    - `active`: from the first to the last component on which a sparse row depends.
    - `owners`: for each colour of sparse rows and each active component the row to which the
      element belongs.
    - `rows`: the row in each place of the blocks.
    - `places`: the place of each row among those of the blocks, followed by the dense rows.
    - `elements`: for each row in the blocks, and each component on which its block depends, the
      place of the element in an array shaped like `owners`.
    - `overlap`: the number of each component of a block among those of the next block; `None` if
      blocks are not coupled.
    - `klu`: whether KLU can be had for these numbers.
    - `wide`: whether the Gram matrix is too wide for blocks. Then each row is a block.
    """

    def __init__(
        self, shape: tuple[int, int], found: list[tuple[int, Any]], dense: np.ndarray, klu: bool
    ):
        (self.size, self.num_columns), self.dense_rows = shape, np.flatnonzero(dense)
        self.klu = klu
        self.colours, of_dense, (rows, columns, colour) = _coloured(shape, found, dense)
        self.sparse_colours, self.dense_colours = map(np.flatnonzero, (~of_dense, of_dense))
        colour = np.searchsorted(self.sparse_colours, colour)
        self.active = slice(int(columns.min()), int(columns.max()) + 1)
        width = self.active.stop - self.active.start
        self.owners = np.full((len(self.sparse_colours), width), self.size)
        self.owners[colour, columns - self.active.start] = rows
        order, block, coupled = self._ordered(rows, columns)
        self.wide = block == 0
        self.rows, self.places = self._placed(order, max(block, 1))
        stored = colour * width + columns - self.active.start
        self.elements, self.overlap = self._in_blocks(rows, columns, stored, coupled)

    def _ordered(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, int, bool]:
        """An order of the sparse rows, in which a row past the end is padding; the size of the
        blocks, zero if they would be too large; and whether consecutive blocks are coupled.

        Two rows are neighbours if they share a component, because then their product in the Gram
        matrix is not zero. If neighbours form small groups, as the bonds of molecules do, each
        group is a block, and blocks are not coupled. Otherwise we look for an order in which
        neighbours are near each other. With blocks as long as the largest distance, each block is
        coupled to the next one only.
        """
        sparse = np.setdiff1d(np.arange(self.size), self.dense_rows)
        ones = np.ones(len(rows), np.int8)
        matrix = sp.csr_matrix((ones, (rows, columns)), (self.size, self.num_columns))[sparse]
        graph = (matrix.astype(bool) @ matrix.T.astype(bool)).tocsr()
        _, labels = sp.csgraph.connected_components(graph, directed=False)
        sizes = np.bincount(labels)
        block = int(sizes.max())
        if block <= MAX_ELIMINATION:
            by_label = np.argsort(labels, kind="stable")
            starts = np.cumsum(sizes) - sizes
            order = np.full(len(sizes) * block, self.size)
            rank = np.arange(len(sparse)) - starts[labels[by_label]]
            order[labels[by_label] * block + rank] = sparse[by_label]
            return order, block, False
        # The algorithm of Cuthill and McKee makes the band of a symmetric matrix narrow.
        narrowed = sp.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
        # The given order comes first. If it is as good, it is kept, and nothing has to be moved.
        orders = np.arange(len(sparse)), narrowed
        a, b = graph.nonzero()
        widths = [int(np.max(np.abs(np.argsort(x)[a] - np.argsort(x)[b]))) for x in orders]
        best = int(np.argmin(widths))
        # Wider blocks, written out, compile for long, and KLU is faster with them.
        by_klu = self.size + self.num_columns > MAX_DENSE_SYSTEM and self.klu
        if widths[best] > (MAX_BLOCK_WITH_KLU if by_klu else MAX_ELIMINATION):
            return sparse, 0, False
        return sparse[orders[best]], widths[best], True

    def _placed(self, order: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
        """`rows` and `places`, for the rows in this order and blocks of this size."""
        rows = np.full(-(-len(order) // block) * block, self.size)
        rows[: len(order)] = order
        real = rows < self.size
        places = np.zeros(self.size, int)
        places[rows[real]] = np.flatnonzero(real)
        places[self.dense_rows] = rows.size + np.arange(len(self.dense_rows))
        return rows.reshape(-1, block), places

    def _in_blocks(
        self, rows: np.ndarray, columns: np.ndarray, stored: np.ndarray, coupled: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """`elements` and `overlap`, for the elements of sparse rows and where each is stored."""
        (num_blocks, block), n = self.rows.shape, self.num_columns
        # A block and a component on which it depends are one number. Within a block we count the
        # components in ascending order.
        place = self.places[rows]
        pair = place // block * n + columns
        pairs = np.unique(pair)
        number = np.arange(len(pairs)) - np.searchsorted(pairs, pairs // n * n)
        size = int(number.max()) + 1
        elements = np.full((num_blocks, block, size), self.owners.size)
        elements[place // block, place % block, number[np.searchsorted(pairs, pair)]] = stored
        if not coupled:
            return elements, None
        after = np.minimum(np.searchsorted(pairs, pairs + n), len(pairs) - 1)
        overlap = np.full((num_blocks, size), size)
        overlap[pairs // n, number] = np.where(pairs[after] == pairs + n, number[after], size)
        return elements, overlap

    @ft.cached_property
    def gram_places(self) -> tuple[Places, np.ndarray, np.ndarray, np.ndarray]:
        """The places of the Gram matrix of the sparse rows; for each place the elements of both
        rows in the components that they share, as places in an array shaped like `owners`; and the
        places on the diagonal."""
        colour, columns = np.nonzero(self.owners < self.size)
        rows = self.places[self.owners[colour, columns]]
        stored = colour * self.owners.shape[1] + columns
        order = np.argsort(columns, kind="stable")
        rows, columns, stored = rows[order], columns[order], stored[order]
        # Each element is paired with all elements of its column.
        counts = np.bincount(columns)
        starts, number = (np.cumsum(counts) - counts)[columns], counts[columns]
        first = np.repeat(np.arange(len(rows)), number)
        rank = np.arange(len(first)) - np.repeat(np.cumsum(number) - number, number)
        second = np.repeat(starts, number) + rank
        places = Places(rows[first], rows[second], self.rows.size)
        place = places.index(rows[first], rows[second])
        order = np.argsort(place, kind="stable")
        place, first, second = place[order], first[order], second[order]
        shared = np.bincount(place)
        rank = np.arange(len(place)) - (np.cumsum(shared) - shared)[place]
        elements = np.full((2, len(shared), shared.max()), self.owners.size)
        elements[:, place, rank] = stored[first], stored[second]
        on_diagonal = places.index(*2 * [np.arange(self.rows.size)])
        return places, elements[0], elements[1], on_diagonal

    def taken_apart(self, x: Float[Array, " m"]) -> tuple[Array, Array]:
        """The elements of a vector for the rows in the blocks, and those for the dense rows."""
        return take(x, self.rows), x[self.dense_rows]

    def joined(self, blocks: Array, dense: Array) -> Float[Array, " m"]:
        """The opposite of `taken_apart`."""
        return take(jnp.concatenate([blocks.reshape(-1), dense]), self.places)


def _coloured(
    shape: tuple[int, int], found: list[tuple[int, Any]], dense: np.ndarray
) -> tuple[list[tuple[np.ndarray, int]], np.ndarray, tuple[np.ndarray, ...]]:
    """The colours of each entry of the manifold; whether a colour is that of a dense row; and the
    rows, columns and colours of the elements of sparse rows, counted over all entries.

    Each entry is differentiated by itself, so it has its own colours: first those of its sparse
    rows, then one for each dense row.
    """
    colours, of_dense, elements, first = [], [], [], 0
    for size, (rows, columns) in found:
        is_dense = dense[first : first + size]
        rows, columns = rows[~is_dense[rows]], columns[~is_dense[rows]]
        colour, number = coloured(rows, columns, size)
        colour = np.where(is_dense, number + np.cumsum(is_dense) - 1, colour)
        elements.append((first + rows, columns, len(of_dense) + colour[rows]))
        of_dense += [False] * number + [True] * int(np.sum(is_dense))
        colours.append((colour, number + int(np.sum(is_dense))))
        first += size
    rows, columns, colour = (np.concatenate(x) for x in zip(*elements, strict=True))
    return colours, np.array(of_dense, bool), (rows, columns, colour)


def pattern_of(
    parts: Sequence[Callable[[Array], Array]], sizes: Sequence[int], y: Any
) -> Pattern | None:
    """The pattern of the Jacobian of these functions; `None` if they are few, or if it is not
    sparse or cannot be found."""
    m, n = sum(sizes), y.size
    if m < MIN_SPARSE:
        return None
    # Equal functions have equal jaxprs and equal constants.
    traced = [jax.make_jaxpr(part)(y) for part in parts]
    keys = tuple((str(x.jaxpr), *map(content_key, constants_of(x))) for x in traced)

    def found() -> Pattern | None:
        with jax.ensure_compile_time_eval():
            try:
                places = map(jacobian_places, traced)
                return _sparse((m, n), list(zip(sizes, places, strict=True)), y.dtype)
            except NotSparse:
                return None

    pattern = _KNOWN(keys, found)
    if pattern is None and m * n * y.dtype.itemsize > _LARGE:
        warnings.warn(
            f"The Jacobian of the {m} constraints is not sparse, or its pattern is not known when "
            f"the solve is traced: it takes {m * n * y.dtype.itemsize / _GIB:.1f} GiB. A function "
            "that selects components by an array of indices must close over it, as a numpy array, "
            "not take it from `args`.",
            stacklevel=2,
        )
    # For constraints that depend on each other, as in an over-constrained mechanism, the factors of
    # a dense matrix are more robust than sparse ones and than an iteration.
    if pattern is not None and pattern.wide and m + n <= MAX_DENSE_SYSTEM:
        return None
    return pattern


# The patterns that were found, by their functions. Detection takes seconds for large systems.
_KNOWN = Memory()


def _sparse(shape: tuple[int, int], found: list[Any], dtype: Any) -> Pattern | None:
    """The pattern, if few rows are dense and at most a quarter of the elements of the others can
    differ from zero."""
    counts = np.concatenate([np.bincount(r, minlength=size) for size, (r, _) in found])
    dense = counts > DENSE_ROW_RATIO * max(1, np.median(counts))
    if np.sum(dense) > MAX_DENSE_ROWS or not 0 < 4 * np.sum(counts[~dense]) <= np.prod(shape):
        return None
    return Pattern(shape, found, dense, available(dtype))


def take(x: Array, places: np.ndarray) -> Array:
    """The elements of `x` in these places, and zero where a place is past the end. Consecutive
    places are a slice, which costs nothing."""
    first, number = (int(places.flat[0]) if places.size else 0), places.size
    if np.array_equal(places.reshape(-1), np.arange(first, first + number)):
        return x.reshape(-1)[first : first + number].reshape(places.shape)
    inside = places < x.size
    if inside.all():
        return x.reshape(-1)[places.astype(np.int32)]
    taken = x.reshape(-1)[np.where(inside, places, 0).astype(np.int32)]
    return jnp.where(inside, taken, 0)
