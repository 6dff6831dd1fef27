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

import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jax.scipy.sparse.linalg import bicgstab
from jaxtyping import Array, Float

from .._constants import (
    DENSE_ROW_RATIO,
    LEAST_SPARSE,
    MAX_BLOCK,
    MAX_DENSE_ROWS,
    MAX_DENSE_SYSTEM,
    REGULARISATION_POWER,
)
from .._numerics.linear import Solve, inverse_factors
from .._numerics.rows import AbstractGram, AbstractRows
from .asdex_import import asdex, reason
from .detection import constants_of, content_key, jacobian_places
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
    - `wide`: whether the Gram matrix is too wide for blocks. Then each row is a block.
    """

    def __init__(self, shape: tuple[int, int], found: list[tuple[int, Any]], dense: np.ndarray):
        (self.size, self.num_columns), self.dense_rows = shape, np.flatnonzero(dense)
        self.colours, of_dense, (rows, columns, colour) = _coloured(shape, found, dense)
        self.sparse_colours, self.dense_colours = (
            np.flatnonzero(~of_dense),
            np.flatnonzero(of_dense),
        )
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
        if block <= MAX_BLOCK:
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
        if widths[best] > MAX_BLOCK:
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
        return _take(x, self.rows), x[self.dense_rows]

    def joined(self, blocks: Array, dense: Array) -> Float[Array, " m"]:
        """The opposite of `taken_apart`."""
        return _take(jnp.concatenate([blocks.reshape(-1), dense]), self.places)


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
        kept = asdex().SparsityPattern.from_coo(rows, columns, (size, shape[1]))
        colour, number = asdex().color_rows(kept)
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
    if m < LEAST_SPARSE:
        return None
    try:
        asdex()
    except Exception as error:  # private names of jax that are gone raise errors of any kind
        warnings.warn(
            f"The manifold has {m} constraints. Their Jacobian is treated as dense, because "
            f"{reason(error)}",
            stacklevel=2,
        )
        return None
    # Equal functions have equal jaxprs and equal constants.
    traced = [jax.make_jaxpr(part)(y) for part in parts]
    keys = tuple((str(x.jaxpr), *map(content_key, constants_of(x))) for x in traced)
    if keys not in _KNOWN:
        with jax.ensure_compile_time_eval():
            try:
                found = [jacobian_places(x, y) for x in traced]
                _KNOWN[keys] = _sparse((m, n), list(zip(sizes, found, strict=True)))
            except NotImplementedError:  # an operation that asdex does not know
                _KNOWN[keys] = None
    pattern = _KNOWN[keys]
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
_KNOWN: dict[Any, Pattern | None] = {}


def _sparse(shape: tuple[int, int], found: list[Any]) -> Pattern | None:
    """The pattern, if few rows are dense and at most a quarter of the elements of the others can
    differ from zero."""
    counts = np.concatenate([np.bincount(r, minlength=size) for size, (r, _) in found])
    dense = counts > DENSE_ROW_RATIO * max(1, np.median(counts))
    if np.sum(dense) > MAX_DENSE_ROWS or not 0 < 4 * np.sum(counts[~dense]) <= np.prod(shape):
        return None
    return Pattern(shape, found, dense)


class SparseRows(AbstractRows):
    """The rows `U` of a Jacobian, or of another matrix with its pattern.

    - `colours`: for each colour the sum of its sparse rows. As these share no component, each
      element of the sum is an element of one row, which `Pattern.owners` tells.
    - `dense`: the rows that are dense.
    """

    colours: Float[Array, "colours active"]
    dense: Float[Array, "dense n"]
    pattern: Pattern = eqx.field(static=True)

    @classmethod
    def linearised(
        cls, pattern: Pattern, parts: Sequence[Callable[[Array], Array]], y: Float[Array, " n"]
    ) -> tuple[Float[Array, " m"], "SparseRows"]:
        """The values of functions, and their Jacobian, by one reverse pass for each colour."""
        values, rows = [], []
        for part, (colour, total) in zip(parts, pattern.colours, strict=True):
            value, vjp = jax.vjp(part, y)
            values.append(value)
            seeds = np.arange(total)[:, None] == colour
            rows.append(jax.vmap(vjp)(seeds.astype(value.dtype))[0])
        rows = jnp.concatenate(rows)
        sparse, dense = rows[pattern.sparse_colours][:, pattern.active], rows[pattern.dense_colours]
        return jnp.concatenate(values), cls(sparse, dense, pattern)

    def __len__(self) -> int:
        return self.pattern.size

    def scale_columns(self, x: Float[Array, " n"]) -> "SparseRows":
        return SparseRows(self.colours * x[self.pattern.active], self.dense * x, self.pattern)

    def largest(self) -> Float[Array, " m"]:
        largest = jnp.max(jnp.abs(_take(self.colours, self.pattern.elements)), axis=2)
        return self.pattern.joined(largest, jnp.max(jnp.abs(self.dense), axis=1))

    def divide_rows(self, sizes: Float[Array, " m"]) -> "SparseRows":
        owned = self.pattern.owners < len(self)
        size = jnp.where(owned, _take(sizes, self.pattern.owners), 1)
        dense = self.dense / sizes[self.pattern.dense_rows, None]
        return SparseRows(self.colours / size, dense, self.pattern)

    def apply(self, linear: Callable[[Array], Array], n: int) -> "SparseRows":
        """The function is taken as diagonal. If it is not, the Gram matrix is only approximate, and
        an iteration with it converges more slowly, to the same result."""
        return self.scale_columns(linear(jnp.ones(n, self.dtype)))

    def matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        products = self.scale_columns(x)
        blocks = jnp.sum(_take(products.colours, self.pattern.elements), axis=2)
        return self.pattern.joined(blocks, jnp.sum(products.dense, axis=1))

    def rmatvec(self, multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
        active = jnp.sum(_take(multiplier, self.pattern.owners) * self.colours, axis=0)
        dense = multiplier[self.pattern.dense_rows, None] * self.dense
        return jnp.sum(dense, axis=0).at[self.pattern.active].add(active)

    def gram(self, others: "SparseRows") -> "BlockGram":
        pattern = self.pattern
        ours, theirs = (_take(x.colours, pattern.elements) for x in (self, others))
        diagonal = jnp.sum(ours[:, :, None] * theirs[:, None], axis=3)
        following = preceding = None
        if pattern.overlap is not None:
            over, width = pattern.overlap[:, None], pattern.overlap.shape[1]

            def coupling(rows: Array, later: Array) -> Array:
                """The products of the rows of each block with those of the next. They are sums over
                the components that both have, so the next rows are taken at the components of the
                first."""
                later = jnp.concatenate([later[1:], jnp.zeros_like(later[:1])])
                later = jnp.take_along_axis(later, np.minimum(over, width - 1), axis=2)
                return jnp.sum(rows[:, :, None] * jnp.where(over < width, later, 0)[:, None], 3)

            following = coupling(ours, theirs)
            preceding = jnp.swapaxes(coupling(theirs, ours), 1, 2)
        columns = jax.vmap(lambda x: self.pattern.taken_apart(self.matvec(x))[0], out_axes=-1)
        rows = jax.vmap(lambda x: self.pattern.taken_apart(others.matvec(x))[0])
        return BlockGram(
            diagonal,
            following,
            preceding,
            columns(others.dense),
            rows(self.dense),
            jnp.sum(self.dense[:, None] * others.dense[None], axis=2),
            (self, others) if pattern.wide else None,
            pattern,
        )


class BlockGram(AbstractGram):
    """The Gram matrix of sparse rows, in blocks.

    - `diagonal`: the blocks on the diagonal.
    - `following`, `preceding`: the blocks that couple each block to the next, in its own rows and
      in those of the next; `None` if blocks are not coupled.
    - `columns`, `rows`, `corner`: the products of sparse rows with dense ones, of dense rows with
      sparse ones, and of dense rows.
    - `factors`: `U` and `V` themselves, if the matrix is too wide for blocks.
    """

    diagonal: Float[Array, "blocks block block"]
    following: Float[Array, "blocks block block"] | None
    preceding: Float[Array, "blocks block block"] | None
    columns: Float[Array, "blocks block dense"]
    rows: Float[Array, "dense blocks block"]
    corner: Float[Array, "dense dense"]
    factors: tuple[SparseRows, SparseRows] | None
    pattern: Pattern = eqx.field(static=True)

    def matvec(self, x: Float[Array, " m"]) -> Float[Array, " m"]:
        if self.factors is not None:
            left, right = self.factors
            return left.matvec(right.rmatvec(x))
        blocks, dense = self.pattern.taken_apart(x)
        products = _times(self.diagonal, blocks) + self.columns @ dense
        if self.following is not None and self.preceding is not None:
            products = products.at[:-1].add(_times(self.following[:-1], blocks[1:]))
            products = products.at[1:].add(_times(self.preceding[:-1], blocks[:-1]))
        below = jnp.einsum("dij,ij->d", self.rows, blocks) + self.corner @ dense
        return self.pattern.joined(products, below)

    def factorise(self, *, least: float | Array | None = None) -> Solve:
        """Dense rows are eliminated last, by their Schur complement
        `corner - rows sparse⁻¹ columns`."""
        del least
        block = self.diagonal.shape[1]
        eye = jnp.eye(block, dtype=bool)
        added = block**0.5 * float(jnp.finfo(self.diagonal.dtype).eps) ** REGULARISATION_POWER
        # A diagonal element is zero for padding, and for a constraint without a gradient. With a
        # one in its place the multiplier of such a row is its right side.
        unit = jnp.where(self.diagonal == 0, 1, (1 + added) * self.diagonal)
        diagonal = jnp.where(eye, unit, self.diagonal)
        if self.factors is None:
            sparse = _reduced(diagonal, self.following, self.preceding)
        elif available(diagonal.dtype):
            sparse = self._by_klu(diagonal)
        else:
            sparse = jtu.Partial(_iterated, self, diagonal)
        if not len(self.corner):
            return BlockFactors(sparse, None, self.pattern)
        eliminated = jax.vmap(sparse, in_axes=-1, out_axes=-1)(self.columns)
        corner = self.corner - jnp.einsum("dij,ije->de", self.rows, eliminated)
        size = jnp.where(jnp.diagonal(self.corner) > 0, jnp.diagonal(self.corner), 1)
        halves = inverse_factors((corner + added * jnp.diag(size))[None])
        return BlockFactors(sparse, (self.rows, eliminated, halves), self.pattern)

    def _by_klu(self, diagonal: Array) -> Solve:
        """The solution for sparse rows by KLU. A matrix that it cannot factor gives NaN."""
        places, first, second, on_diagonal = self.pattern.gram_places
        assert self.factors is not None
        left, right = self.factors
        values = jnp.sum(_take(left.colours, first) * _take(right.colours, second), axis=1)
        values = values.at[on_diagonal].set(diagonal.reshape(-1))
        # With what was added to its diagonal, a symmetric matrix is positive definite, so that no
        # pivot is zero. The test for other matrices takes as long as two solutions.
        if left is not right:
            values = jnp.where(places.is_regular(values), values, jnp.nan)
        return KluFactors(values, places)


class KluFactors(eqx.Module):
    """The elements of a sparse matrix, called with the right side of a system."""

    values: Float[Array, " k"]
    places: Places = eqx.field(static=True)

    def __call__(self, b: Float[Array, "m 1"]) -> Float[Array, "m 1"]:
        return self.places.solve_regular(self.values, b.reshape(-1)).reshape(b.shape)


class BlockFactors(eqx.Module):
    """The factors of a Gram matrix of sparse rows, called with the right side of a system.

    - `sparse`: the solution for the sparse rows alone, as a function of the right side.
    - `last`: for dense rows their products with the sparse ones, these products times the inverse
      of the sparse matrix, and the factors of the Schur complement.
    """

    sparse: Solve
    last: tuple[Array, Array, tuple[Array, Array]] | None
    pattern: Pattern = eqx.field(static=True)

    def __call__(self, b: Float[Array, " m"]) -> Float[Array, " m"]:
        blocks, dense = self.pattern.taken_apart(b)
        blocks = self.sparse(blocks)
        if self.last is None:
            return self.pattern.joined(blocks, dense)
        rows, eliminated, (left, right) = self.last
        dense = dense - jnp.einsum("dij,ij->d", rows, blocks)
        dense = right[0] @ (left[0] @ dense)
        return self.pattern.joined(blocks - eliminated @ dense, dense)


def _iterated(gram: BlockGram, diagonal: Array, b: Array) -> Array:
    """The solution by the stabilised biconjugate gradient method (H. A. van der Vorst, "Bi-CGSTAB",
    *SIAM J. Sci. Stat. Comput.* 13 (1992), 631-644), because the matrix need not be symmetric. The
    preconditioner is the diagonal."""
    pattern, zero = gram.pattern, jnp.zeros(len(gram.corner), diagonal.dtype)

    def solve(product: Callable[[Array], Array], b: Array) -> Array:
        # The iterations of Newton's method correct what an inexact solution leaves, so this is less
        # accurate than could be had.
        tol = float(jnp.finfo(b.dtype).eps) ** (3 / 4)
        return bicgstab(product, b, tol=tol, M=lambda x: x / diagonal[..., 0])[0]

    product = lambda x: pattern.taken_apart(gram.matvec(pattern.joined(x, zero)))[0]  # noqa: E731
    return lax.custom_linear_solve(product, b, solve, solve)


def _take(x: Array, places: np.ndarray) -> Array:
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


def _times(a: Array, b: Array) -> Array:
    """The products of small matrices, or of matrices and vectors, in all blocks."""
    if b.ndim == 2:
        return jnp.sum(a * b[:, None], axis=2)
    return jnp.sum(a[..., None] * b[:, None], axis=2)


def _reduced(diagonal: Array, following: Array | None, preceding: Array | None) -> Solve:
    """The solution of a block tridiagonal system by cyclic reduction (G. H. Golub and C. F. Van
    Loan, *Matrix Computations*, Johns Hopkins 2013, 4.5), as a function of its right side.

    The odd blocks are eliminated, all at once, which leaves a block tridiagonal system of half the
    size for the even blocks, and so on. `following[i]` is the block in block row `i` and block
    column `i + 1`, `preceding[i]` that in row `i + 1` and column `i`; the last of both are zero.
    """
    if following is None or preceding is None or len(diagonal) == 1:
        return jtu.Partial(_in_halves, *inverse_factors(diagonal))
    if diagonal.shape[1] == 1:
        bands = (_before(preceding), diagonal, following)
        return jtu.Partial(lax.linalg.tridiagonal_solve, *(x.reshape(-1) for x in bands))
    # If the number of blocks is odd, an identity block is added, which is coupled to none.
    middle, odd = _even_and_odd(diagonal, jnp.eye(diagonal.shape[1]))
    # The odd block `2 i + 1` is between the even blocks `2 i` and `2 i + 2`.
    to_right, odd_right = _even_and_odd(following)
    # These couple the odd block to the one before, and the next even block to the odd one.
    odd_left, to_left = _even_and_odd(preceding)
    left, right = inverse_factors(odd)
    from_right, from_left = _times(to_right, right), _before(_times(to_left, right))
    odd_left, odd_right = _times(left, odd_left), _times(left, odd_right)
    middle = middle - _times(from_right, odd_left) - _times(from_left, _before(odd_right))
    following = -_times(from_right, odd_right)
    preceding = -_after(_times(from_left, _before(odd_left)))
    coarse = _reduced(middle, following, preceding)
    couplings = from_right, from_left, odd_left, odd_right
    return jtu.Partial(_substituted, coarse, (left, right), couplings)


def _ininverse_factors(left: Array, right: Array, b: Array) -> Array:
    return _times(right, _times(left, b))


def _substituted(
    coarse: Solve,
    halves: tuple[Array, Array],
    couplings: tuple[Array, ...],
    b: Float[Array, "blocks k"],
) -> Float[Array, "blocks k"]:
    """The solution of a level of the reduction, from that of the level of half the size."""
    (left, right), (even, rest) = halves, _even_and_odd(b)
    from_right, from_left, odd_left, odd_right = couplings
    rest = _times(left, rest)
    x = coarse(even - _times(from_right, rest) - _times(from_left, _before(rest)))
    rest = _times(right, rest - _times(odd_left, x) - _times(odd_right, _after(x)))
    return jnp.stack([x, rest], axis=1).reshape(-1, b.shape[1])[: len(b)]


def _before(x: Array) -> Array:
    """For each block the one before it, and zero for the first."""
    return jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])


def _after(x: Array) -> Array:
    return jnp.concatenate([x[1:], jnp.zeros_like(x[:1])])


def _even_and_odd(x: Array, fill: Array | float = 0.0) -> tuple[Array, Array]:
    if len(x) % 2:
        x = jnp.concatenate([x, jnp.broadcast_to(jnp.asarray(fill, x.dtype), x[:1].shape)])
    return x[0::2], x[1::2]
