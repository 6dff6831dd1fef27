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
- Where the blocks would be too large, as in a membrane, the system is solved by iteration.
"""

import functools as ft
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jax.scipy.sparse.linalg import bicgstab
from jaxtyping import Array, Float

# The pattern is sought from this number of constraints on: below it a dense factor is as fast
# (`benchmarks/cost/many_constraints.py`).
LEAST_CONSTRAINTS = 33
# A row with this many times the entries of the median row is dense. Of more dense rows than these
# a Jacobian is not sparse.
_DENSE_ROW, _DENSE_ROWS_MAX = 16, 16
# The work for a block grows with the square of its size, and compile time with the size.
_BLOCK_MAX = 16
# The roundoff that is added to the diagonal of the Gram matrix, as a share of it, so that a factor
# exists where constraints depend on each other.
_ADDED = 16
# A dense Jacobian of so many bytes is announced before it is allocated.
_LARGE = 2**28


class Pattern:
    """The places of a sparse Jacobian. Equal only to itself, because equal functions share one.

    - `colours`: for each entry of the manifold the colour of each row, and their number.
    - `sparse`, `dense`: the colours of sparse rows, and those of dense ones, a row each.
    - `active`: from the first to the last component on which a sparse row depends.
    - `rows`: the row in each place of the blocks. Here and below a number past the end is none.
    - `dense_rows`: the rows that are dense.
    - `places`: the place of each row among those of the blocks and the dense ones.
    - `owners`: for each colour of sparse rows and each active component the row that it belongs to.
    - `elements`: for the rows in the blocks, and the components on which the block depends, the
      place among the colours.
    - `overlap`: the place of each component of a block among those of the next, where blocks are
      coupled.
    - `iterative`: whether the Gram matrix is too wide for blocks.
    """

    def __init__(self, shape: tuple[int, int], found: list[tuple[int, Any]], dense: np.ndarray):
        self.size, self.num_columns = shape
        (m, n), self.colours, kinds = shape, [], []
        colour_of, entries, first, number = np.zeros(m, int), [], 0, 0
        for size, (rows, columns) in found:
            is_dense = dense[first : first + size]
            sparse = ~is_dense[rows]
            kept = _asdex().SparsityPattern.from_coo(rows[sparse], columns[sparse], (size, n))
            colour, total = _asdex().color_rows(kept)
            colour = np.where(is_dense, total + np.cumsum(is_dense) - 1, colour)
            kinds += [False] * total + [True] * int(np.sum(is_dense))
            self.colours.append((colour, total := total + int(np.sum(is_dense))))
            colour_of[first : first + size] = number + colour
            entries.append((first + rows[sparse], columns[sparse]))
            first, number = first + size, number + total
        rows, columns = (np.concatenate(x) for x in zip(*entries, strict=True))
        self.sparse, self.dense = np.flatnonzero(~np.array(kinds)), np.flatnonzero(kinds)
        self.dense_rows = np.flatnonzero(dense)
        self.active = slice(int(columns.min()), width := int(columns.max()) + 1)
        width -= self.active.start
        order, block, coupled = self._ordered(rows, columns)
        self.iterative = block == 0
        block = max(block, 1)
        num_blocks = -(-len(order) // block)
        self.rows = np.full(num_blocks * block, m)
        self.rows[: len(order)] = order
        real = self.rows < m
        self.places = np.zeros(m, int)
        self.places[self.rows[real]] = np.flatnonzero(real)
        self.places[self.dense_rows] = self.rows.size + np.arange(len(self.dense_rows))
        self.rows = self.rows.reshape(num_blocks, block)

        colour = np.searchsorted(self.sparse, colour_of[rows])
        self.owners = np.full((len(self.sparse), width), m)
        self.owners[colour, columns - self.active.start] = rows
        place = self.places[rows]
        held = place // block * n + columns
        pairs = np.unique(held)
        local = np.arange(len(pairs)) - np.searchsorted(pairs, pairs // n * n)
        size = int(local.max()) + 1
        self.elements = np.full((num_blocks, block, size), self.owners.size)
        at = local[np.searchsorted(pairs, held)]
        element = colour * width + columns - self.active.start
        self.elements[place // block, place % block, at] = element
        self.overlap = None
        if coupled:
            after = np.minimum(np.searchsorted(pairs, pairs + n), len(pairs) - 1)
            self.overlap = np.full((num_blocks, size), size)
            shared = np.where(pairs[after] == pairs + n, local[after], size)
            self.overlap[pairs // n, local] = shared

    def _ordered(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, int, bool]:
        """An order of the sparse rows, the size of blocks, zero where that would be too large, and
        whether consecutive blocks are coupled. Padding is a row past the end."""
        sparse = np.setdiff1d(np.arange(self.size), self.dense_rows)
        ones = np.ones(len(rows), np.int8)
        matrix = sp.csr_matrix((ones, (rows, columns)), (self.size, self.num_columns))[sparse]
        graph = (matrix.astype(bool) @ matrix.T.astype(bool)).tocsr()
        _, labels = sp.csgraph.connected_components(graph, directed=False)
        sizes = np.bincount(labels)
        block = int(sizes.max())
        if block <= _BLOCK_MAX:
            by_label = np.argsort(labels, kind="stable")
            starts = np.cumsum(sizes) - sizes
            order = np.full(len(sizes) * block, self.size)
            rank = np.arange(len(sparse)) - starts[labels[by_label]]
            order[labels[by_label] * block + rank] = sparse[by_label]
            return order, block, False
        narrowed = sp.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
        # The order that is given comes first: where it is as good, nothing has to be moved.
        orders = np.arange(len(sparse)), narrowed
        a, b = graph.nonzero()
        widths = [int(np.max(np.abs(np.argsort(x)[a] - np.argsort(x)[b]))) for x in orders]
        best = int(np.argmin(widths))
        if widths[best] > _BLOCK_MAX:
            return sparse, 0, False
        return sparse[orders[best]], widths[best], True

    def taken_apart(self, x: Float[Array, " m"]) -> tuple[Array, Array]:
        """Numbers for the rows of the blocks, and for the dense ones."""
        return _take(x, self.rows), x[self.dense_rows]

    def joined(self, blocks: Array, dense: Array) -> Float[Array, " m"]:
        """The opposite."""
        return _take(jnp.concatenate([blocks.reshape(-1), dense]), self.places)


def pattern_of(
    parts: Sequence[Callable[[Array], Array]], sizes: Sequence[int], y: Any
) -> Pattern | None:
    """The pattern of the Jacobian of these functions, if it is worth while."""
    m, n = sum(sizes), y.size
    if m < LEAST_CONSTRAINTS:
        return None
    if _asdex() is None:
        warnings.warn(
            f"The manifold has {m} constraints. Their Jacobian is treated as dense, because the "
            "package that finds sparse ones is missing: `pip install 'diffrax-conserve[sparse]'`.",
            stacklevel=2,
        )
        return None
    traced = [jax.make_jaxpr(part)(y) for part in parts]
    keys = tuple((str(x.jaxpr), *map(_content, _constants(x))) for x in traced)
    if keys not in _KNOWN:
        with jax.ensure_compile_time_eval():
            try:
                found = [(size, _entries(x, y)) for size, x in zip(sizes, traced, strict=True)]
                _KNOWN[keys] = _sparse((m, n), found)
            except NotImplementedError:  # an operation that asdex does not know
                _KNOWN[keys] = None
    pattern = _KNOWN[keys]
    if pattern is None and m * n * y.dtype.itemsize > _LARGE:
        warnings.warn(
            f"The Jacobian of the {m} constraints is not sparse, or its pattern is not known when "
            f"the solve is traced: it takes {m * n * y.dtype.itemsize / 2**30:.1f} GiB. A function "
            "that selects components by an array of indices must close over it, as a numpy array, "
            "not take it from `args`.",
            stacklevel=2,
        )
    return pattern


# What was found, by the functions.
_KNOWN: dict[Any, Pattern | None] = {}


@ft.cache
def _asdex() -> Any:
    try:
        import asdex
    except ImportError:
        return None
    return asdex


def _constants(closed: Any) -> Iterator[Any]:
    """The arrays over which a jaxpr and those inside it close, which their text does not show."""
    yield from closed.consts
    for eqn in closed.jaxpr.eqns:
        yield from (x.val for x in eqn.invars if isinstance(x, jex.Literal) and np.ndim(x.val))
        is_leaf = lambda x: isinstance(x, jex.ClosedJaxpr | jex.Jaxpr)  # noqa: E731
        for x in filter(is_leaf, jtu.tree_leaves(eqn.params, is_leaf=is_leaf)):
            yield from _constants(x if isinstance(x, jex.ClosedJaxpr) else jex.ClosedJaxpr(x, ()))


def _content(x: Any) -> Any:
    """A key for a constant of a function; the value of a tracer is not known."""
    if isinstance(x, jax.core.Tracer):
        return x.shape, x.dtype
    return np.shape(x), np.asarray(x).tobytes()


def _entries(closed: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    unknown = [i for i, x in enumerate(closed.consts) if isinstance(x, jax.core.Tracer)]

    def fn(y: Array, *others: Array) -> Array:
        consts = list(closed.consts)
        for i, x in zip(unknown, others, strict=True):
            consts[i] = x
        return jex.jaxpr_as_fun(jex.ClosedJaxpr(closed.jaxpr, consts))(y)[0]

    like = [closed.consts[i] for i in unknown]
    others = [np.zeros(x.shape, x.dtype) for x in like]
    found = _asdex().jacobian_sparsity(fn, np.zeros(y.shape, y.dtype), *others)
    return np.asarray(found.rows), np.asarray(found.cols)


def _sparse(shape: tuple[int, int], found: list[Any]) -> Pattern | None:
    counts = np.concatenate([np.bincount(r, minlength=size) for size, (r, _) in found])
    dense = counts > _DENSE_ROW * max(1, np.median(counts))
    if np.sum(dense) > _DENSE_ROWS_MAX or not 0 < 4 * np.sum(counts[~dense]) <= np.prod(shape):
        return None
    return Pattern(shape, found, dense)


class SparseRows(eqx.Module):
    """The rows of a Jacobian, or of another matrix with its pattern.

    - `colours`: the sums of the sparse rows of each colour.
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
        sparse, dense = rows[pattern.sparse][:, pattern.active], rows[pattern.dense]
        return jnp.concatenate(values), cls(sparse, dense, pattern)

    def __len__(self) -> int:
        return self.pattern.size

    def times_columns(self, x: Float[Array, " n"]) -> "SparseRows":
        """`U diag(x)`."""
        return SparseRows(self.colours * x[self.pattern.active], self.dense * x, self.pattern)

    def scaled(self) -> tuple[Float[Array, " m"], "SparseRows"]:
        """The largest element of each row, or one if all are zero, and the rows divided by it."""
        largest = jnp.max(jnp.abs(_take(self.colours, self.pattern.elements)), axis=2)
        sizes = self.pattern.joined(largest, jnp.max(jnp.abs(self.dense), axis=1))
        sizes = jnp.where(sizes > 0, sizes, 1)
        of = jnp.where(self.pattern.owners < len(self), _take(sizes, self.pattern.owners), 1)
        dense = self.dense / sizes[self.pattern.dense_rows, None]
        return sizes, SparseRows(self.colours / of, dense, self.pattern)

    def times(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """`U x`."""
        products = self.times_columns(x)
        blocks = jnp.sum(_take(products.colours, self.pattern.elements), axis=2)
        return self.pattern.joined(blocks, jnp.sum(products.dense, axis=1))

    def combined(self, multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
        """`Uᵀ λ`."""
        active = jnp.sum(_take(multiplier, self.pattern.owners) * self.colours, axis=0)
        dense = multiplier[self.pattern.dense_rows, None] * self.dense
        return jnp.sum(dense, axis=0).at[self.pattern.active].add(active)

    def gram(self, others: "SparseRows") -> "BlockGram":
        """`U Vᵀ`."""
        pattern = self.pattern
        ours, theirs = (_take(x.colours, pattern.elements) for x in (self, others))
        diagonal = jnp.sum(ours[:, :, None] * theirs[:, None], axis=3)
        following = preceding = None
        if pattern.overlap is not None:
            over, width = pattern.overlap[:, None], pattern.overlap.shape[1]

            def coupling(rows: Array, later: Array) -> Array:
                """The products of the rows of each block with those of the next."""
                later = jnp.concatenate([later[1:], jnp.zeros_like(later[:1])])
                later = jnp.take_along_axis(later, np.minimum(over, width - 1), axis=2)
                return jnp.sum(rows[:, :, None] * jnp.where(over < width, later, 0)[:, None], 3)

            following = coupling(ours, theirs)
            preceding = jnp.swapaxes(coupling(theirs, ours), 1, 2)
        columns = jax.vmap(lambda x: self.pattern.taken_apart(self.times(x))[0], out_axes=-1)
        rows = jax.vmap(lambda x: self.pattern.taken_apart(others.times(x))[0])
        return BlockGram(
            diagonal,
            following,
            preceding,
            columns(others.dense),
            rows(self.dense),
            jnp.sum(self.dense[:, None] * others.dense[None], axis=2),
            (self, others) if pattern.iterative else None,
            pattern,
        )


class BlockGram(eqx.Module):
    """A Gram matrix in blocks.

    - `diagonal`, `following`, `preceding`: the blocks on the diagonal, and those that couple each
      block to the next, in its own rows and in those of the next.
    - `columns`, `rows`, `corner`: the products with dense rows, and of dense rows.
    - `factors`: the two matrices of which it is the product, where it is applied as such.
    """

    diagonal: Float[Array, "blocks block block"]
    following: Float[Array, "blocks block block"] | None
    preceding: Float[Array, "blocks block block"] | None
    columns: Float[Array, "blocks block dense"]
    rows: Float[Array, "dense blocks block"]
    corner: Float[Array, "dense dense"]
    factors: tuple[SparseRows, SparseRows] | None
    pattern: Pattern = eqx.field(static=True)

    def __len__(self) -> int:
        return self.pattern.size

    def factored(self) -> Callable[[Float[Array, " m"]], Float[Array, " m"]]:
        """The solution of the system, as a function of its right side."""
        block = self.diagonal.shape[1]
        eye = jnp.eye(block, dtype=bool)
        added = _ADDED * block**0.5 * float(jnp.finfo(self.diagonal.dtype).eps)
        unit = jnp.where(self.diagonal == 0, 1, (1 + added) * self.diagonal)
        diagonal = jnp.where(eye, unit, self.diagonal)
        if self.factors is None:
            sparse = _reduced(diagonal, self.following, self.preceding)
        else:
            sparse = self._iteration(diagonal)
        number = len(self.corner)
        if number == 0:
            return lambda b: self.pattern.joined(sparse(self.pattern.taken_apart(b)[0]), b[:0])
        eliminated = jax.vmap(sparse, in_axes=-1, out_axes=-1)(self.columns)
        corner = self.corner - jnp.einsum("dij,ije->de", self.rows, eliminated)
        least = jnp.where(jnp.diagonal(self.corner) > 0, jnp.diagonal(self.corner), 1)
        inverse = _inverse((corner + added * jnp.diag(least))[None])[0]

        def solve(b: Float[Array, " m"]) -> Float[Array, " m"]:
            blocks, dense = self.pattern.taken_apart(b)
            blocks = sparse(blocks)
            dense = inverse @ (dense - jnp.einsum("dij,ij->d", self.rows, blocks))
            return self.pattern.joined(blocks - eliminated @ dense, dense)

        return solve

    def _iteration(self, diagonal: Array) -> Callable[[Array], Array]:
        """Stabilised conjugate gradients, because the matrix need not be symmetric."""
        factors, zero = self.factors or (), jnp.zeros(len(self.corner), diagonal.dtype)

        def product(left: SparseRows, right: SparseRows, x: Array) -> Array:
            return self.pattern.taken_apart(
                left.times(right.combined(self.pattern.joined(x, zero)))
            )[0]

        def solve(product: Callable[[Array], Array], b: Array) -> Array:
            tol = float(jnp.finfo(b.dtype).eps) ** (3 / 4)
            return bicgstab(product, b, tol=tol, M=lambda x: x / diagonal[..., 0])[0]

        return lambda b: lax.custom_linear_solve(ft.partial(product, *factors), b, solve, solve)


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


def _inverse(matrix: Float[Array, "blocks k k"]) -> Float[Array, "blocks k k"]:
    """The inverses of small matrices, by sweeps, without a search for pivots: Gram matrices do not
    need one."""
    for k in range(matrix.shape[1]):
        pivot = 1 / matrix[:, k, k]
        row, column = matrix[:, k, :] * pivot[:, None], matrix[:, :, k]
        matrix = matrix - column[:, :, None] * row[:, None, :]
        matrix = matrix.at[:, k, :].set(row).at[:, :, k].set(-column * pivot[:, None])
        matrix = matrix.at[:, k, k].set(pivot)
    return matrix


def _reduced(
    diagonal: Array, following: Array | None, preceding: Array | None
) -> Callable[[Float[Array, "blocks k"]], Float[Array, "blocks k"]]:
    """The solution of a block tridiagonal system by cyclic reduction. `following[i]` couples row
    `i` to block `i + 1`, `preceding[i]` row `i + 1` to block `i`; the last of both are zero."""

    def before(x: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])

    def after(x: Array) -> Array:
        return jnp.concatenate([x[1:], jnp.zeros_like(x[:1])])

    if following is None or preceding is None or len(diagonal) == 1:
        inverse = _inverse(diagonal)
        return lambda b: _times(inverse, b)
    if diagonal.shape[1] == 1:
        lower, middle, upper = (
            before(preceding).reshape(-1),
            diagonal.reshape(-1),
            following.reshape(-1),
        )
        return lambda b: lax.linalg.tridiagonal_solve(lower, middle, upper, b)

    def even_and_odd(x: Array, fill: Array | float = 0.0) -> tuple[Array, Array]:
        if len(x) % 2:
            x = jnp.concatenate([x, jnp.broadcast_to(jnp.asarray(fill, x.dtype), x[:1].shape)])
        return x[0::2], x[1::2]

    middle, odd = even_and_odd(diagonal, jnp.eye(diagonal.shape[1]))
    # The odd block `2 i + 1` is between the even blocks `2 i` and `2 i + 2`.
    right, odd_right = even_and_odd(following)
    odd_left, left = even_and_odd(preceding)  # in the rows of the odd block, and of the next even
    inverse = _inverse(odd)
    from_right, from_left = _times(right, inverse), before(_times(left, inverse))
    middle = middle - _times(from_right, odd_left) - _times(from_left, before(odd_right))
    following = -_times(from_right, odd_right)
    preceding = -after(_times(from_left, before(odd_left)))
    coarse = _reduced(middle, following, preceding)

    def solve(b: Array) -> Array:
        even, rest = even_and_odd(b)
        x = coarse(even - _times(from_right, rest) - _times(from_left, before(rest)))
        rest = _times(inverse, rest - _times(odd_left, x) - _times(odd_right, after(x)))
        return jnp.stack([x, rest], axis=1).reshape(-1, b.shape[1])[: len(b)]

    return solve
