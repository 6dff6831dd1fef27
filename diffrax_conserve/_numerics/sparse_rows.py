"""The rows of the Jacobian of many constraints, of which each contains a few components of the
state, and their Gram matrix. The places of the elements are in `_large.sparse`."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.scipy.sparse.linalg import bicgstab
from jaxtyping import Array, Float

from .._large.klu import Places, available
from .._large.sparse import Pattern, take
from .._tree import eps_of
from .linear import Solve, diagonal_shift, inverse_factors
from .rows import AbstractGram, AbstractRows


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

    @property
    def is_large(self) -> bool:
        return self.pattern.wide

    def scale_columns(self, x: Float[Array, " n"]) -> "SparseRows":
        return SparseRows(self.colours * x[self.pattern.active], self.dense * x, self.pattern)

    def largest_in_rows(self) -> Float[Array, " m"]:
        largest = jnp.max(jnp.abs(take(self.colours, self.pattern.elements)), axis=2)
        return self.pattern.joined(largest, jnp.max(jnp.abs(self.dense), axis=1))

    def largest_in_columns(self) -> Float[Array, " n"]:
        dense = jnp.max(jnp.abs(self.dense), axis=0, initial=0)
        return dense.at[self.pattern.active].max(jnp.max(jnp.abs(self.colours), axis=0))

    def divide_rows(self, row_scales: Float[Array, " m"]) -> "SparseRows":
        owned = self.pattern.owners < len(self)
        size = jnp.where(owned, take(row_scales, self.pattern.owners), 1)
        dense = self.dense / row_scales[self.pattern.dense_rows, None]
        return SparseRows(self.colours / size, dense, self.pattern)

    def map_rows(self, linear: Callable[[Array], Array], n: int) -> "SparseRows":
        """The function is taken as diagonal. If it is not, the Gram matrix is only approximate, and
        an iteration with it converges more slowly, to the same result."""
        return self.scale_columns(linear(jnp.ones(n, self.dtype)))

    def matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        products = self.scale_columns(x)
        blocks = jnp.sum(take(products.colours, self.pattern.elements), axis=2)
        return self.pattern.joined(blocks, jnp.sum(products.dense, axis=1))

    def rmatvec(self, multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
        # A reduction over the axis of the colours would take ten times as long on a CPU.
        by_colour = zip(self.pattern.owners, self.colours, strict=True)
        active = sum(take(multiplier, owners) * colour for owners, colour in by_colour)
        dense = multiplier[self.pattern.dense_rows, None] * self.dense
        return jnp.sum(dense, axis=0).at[self.pattern.active].add(active)

    def gram(self, others: "SparseRows") -> "BlockGram":
        pattern = self.pattern
        ours, theirs = (take(x.colours, pattern.elements) for x in (self, others))
        diagonal = jnp.sum(ours[:, :, None] * theirs[:, None], axis=3)
        following = preceding = None
        if pattern.overlap is not None:
            over, width = pattern.overlap[:, None], pattern.overlap.shape[1]

            def coupling(rows: Array, later: Array) -> Array:
                """The products of the rows of each block with those of the next. They are sums over
                the components that both have, so the next rows are taken at the components of the
                first."""
                later = jnp.take_along_axis(_after(later), np.minimum(over, width - 1), axis=2)
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

    def factorise(self, *, pivot_tolerance: float | Array | None = None) -> Solve:
        """Dense rows are eliminated last, by their Schur complement
        `corner - rows sparse⁻¹ columns`."""
        del pivot_tolerance
        block = self.diagonal.shape[1]
        eye = jnp.eye(block, dtype=bool)
        shift = diagonal_shift(block, self.diagonal.dtype)
        # A diagonal element is zero for padding, and for a constraint without a gradient. With a
        # one in its place the multiplier of such a row is its right side.
        unit = jnp.where(self.diagonal == 0, 1, (1 + shift) * self.diagonal)
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
        halves = inverse_factors((corner + shift * jnp.diag(size))[None])
        return BlockFactors(sparse, (self.rows, eliminated, halves), self.pattern)

    def _by_klu(self, diagonal: Array) -> Solve:
        """The solution for sparse rows by KLU. A matrix that it cannot factor gives NaN."""
        places, first, second, on_diagonal = self.pattern.gram_places
        assert self.factors is not None
        left, right = self.factors
        values = jnp.sum(take(left.colours, first) * take(right.colours, second), axis=1)
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
        tol = eps_of(b) ** (3 / 4)
        return bicgstab(product, b, tol=tol, M=lambda x: x / diagonal[..., 0])[0]

    product = lambda x: pattern.taken_apart(gram.matvec(pattern.joined(x, zero)))[0]  # noqa: E731
    return lax.custom_linear_solve(product, b, solve, solve)


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
        return jtu.Partial(_in_factors, *inverse_factors(diagonal))
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


def _in_factors(left: Array, right: Array, b: Array) -> Array:
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
