"""How the slopes are found that constraints need: by constants, or block by block.

The equations that are selected are a square system for the slopes that are selected. Only slopes on
which a constraint depends are found, in the order of its block triangular form (A. Pothen and
C.-J. Fan, *Computing the block triangular form of a sparse matrix*, ACM Trans. Math. Softw. 16,
1990). Most blocks are single equations with one unknown slope. If all slopes were found at once,
the constraints of a linkage with 35 unknowns would contain the solution of a system of 27, and each
derivative of it would cost as much as many of them.
"""

# The types of scipy's sparse arrays are incomplete.
# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# pyright: reportOptionalIterable=false, reportOperatorIssue=false

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    maximum_bipartite_matching,
)

from .._large.elimination import combinations
from .._numerics.implicit import root
from .newton import algebraic_newton, row_and_column_scales, solve_equilibrated

# In a large system at most so many slopes are solved for together.
_MOST_COUPLED = 6
# A matrix of eliminated slopes with more than this many elements for each row is given up: each
# constraint would contain so many unknowns.
_MOST_TERMS = 64
# So many blocks are solved one after the other. In a small system the rest is one block.
_MOST_LEVELS = 8


class NotFound(Exception):
    """Why the structure was not found."""


class Round(NamedTuple):
    """The equations that are solved, and the slopes for which they are solved."""

    equations: tuple[int, ...]
    slopes: tuple[int, ...]


class Blocks(NamedTuple):
    """Square systems of one size that do not depend on each other: a row of equations and of slopes
    for each, in which they may be linear."""

    equations: tuple[tuple[int, ...], ...]
    slopes: tuple[tuple[int, ...], ...]
    is_linear: bool = True


class SparseMatrix:
    """A constant sparse matrix that is known while JAX traces, with its product."""

    def __init__(self, matrix: sp.csr_array):
        self.matrix = sp.csr_array(matrix)
        self.matrix.sum_duplicates()
        self.matrix.eliminate_zeros()
        at = sp.coo_array(self.matrix)
        self.values, (self.rows, self.columns) = (
            at.data,
            (np.asarray(x, np.int32) for x in at.coords),
        )
        self._key = at.shape, *(x.tobytes() for x in (self.rows, self.columns, self.values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SparseMatrix) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape

    def dense(self, dtype: Any) -> Array:
        # With the barrier XLA does not keep all zeros as a constant.
        zeros = lax.optimization_barrier(jnp.zeros(self.shape, dtype))
        return zeros.at[self.rows, self.columns].set(jnp.asarray(self.values, dtype))

    def __matmul__(self, x: Array) -> Array:
        """By gather and scatter, of which the cost is that of the elements."""
        products = jnp.asarray(self.values, x.dtype) * x[self.columns]
        return jnp.zeros(self.shape[0], x.dtype).at[self.rows].add(products)


@dataclasses.dataclass(frozen=True)
class Elimination:
    """How equations are solved for the slopes that are needed.

    - `constant`: where `∂F/∂y'` is constant, slopes are this matrix times the equations at no
      slopes; `None` if there are none of these.
    - `blocks`: the blocks that give the others, in their order.
    - `as_given`: whether no equation in them is the derivative of a constraint.
    """

    constant: SparseMatrix | None = None
    blocks: tuple[Blocks, ...] = ()
    as_given: bool = False

    def slopes(
        self, equations: Callable[[Array], Array], like: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The slopes; those that are not needed are zero."""
        slopes = jnp.zeros_like(like)
        if self.constant is not None:
            slopes = self.constant @ equations(slopes)
        for one in self.blocks:
            rows, columns = np.array(one.equations, int), np.array(one.slopes, int)
            solve = _linear_blocks if one.is_linear else _nonlinear_blocks
            slopes = slopes.at[columns].set(solve(equations, slopes, rows, columns))
        return slopes


def _linear_blocks(
    equations: Callable[[Array], Array], slopes: Float[Array, " n"], rows: Any, columns: Any
) -> Float[Array, "b k"]:
    size = columns.shape[1]
    directions = jnp.zeros((size, slopes.size), slopes.dtype).at[np.arange(size), columns].set(1)
    # `jax.linearize` would trace thousands of scalar operations ten times as long.
    along = jax.vmap(lambda v: jax.jvp(equations, (slopes,), (v,)), out_axes=(None, -1))
    value, rates = along(directions)
    matrix = rates[rows]
    return _solved(matrix, -value[rows])


def _solved(matrix: Float[Array, "b k k"], b: Float[Array, "b k"]) -> Float[Array, "b k"]:
    """`matrix⁻¹ b`, for several blocks by elimination that is written out: XLA spreads the calls of
    LAPACK for a batch over its threads, where on two cores some waited for each other for ever."""
    if len(b) == 1:
        return solve_equilibrated(matrix[0], b[0])[None]
    size = b.shape[1]
    if size == 1:
        return b / matrix[:, 0]
    scales = jax.vmap(row_and_column_scales)(matrix)
    rows, columns = lax.stop_gradient(scales)
    scaled = jnp.concatenate([matrix / columns[:, None], b[..., None]], 2) / rows[..., None]
    lines = [*jnp.unstack(scaled, axis=1)]
    for k in range(size):
        for i in range(k + 1, size):
            exchanged = (jnp.abs(lines[i]) > jnp.abs(lines[k]))[:, k, None]
            pair = lines[k], lines[i]
            lines[k], lines[i] = (jnp.where(exchanged, *x) for x in (pair[::-1], pair))
        for i in range(size):
            if i != k:
                lines[i] = lines[i] - (lines[i][:, k] / lines[k][:, k])[:, None] * lines[k]
    return jnp.stack([x[:, -1] / x[:, k] for k, x in enumerate(lines)], axis=1) / columns


def _nonlinear_blocks(
    equations: Callable[[Array], Array], slopes: Float[Array, " n"], rows: Any, columns: Any
) -> Float[Array, "b k"]:
    residual = lambda x: equations(slopes.at[columns.ravel()].set(x))[rows.ravel()]  # noqa: E731
    begin = jnp.zeros(columns.size, slopes.dtype)
    found = root(residual, ft.partial(algebraic_newton, residual), begin, solve_equilibrated)
    return found.y.reshape(columns.shape)


def elimination(
    places: sp.csr_array,
    selected: Round,
    needed: Bool[np.ndarray, " n"],
    differentiated: Any,
    *,
    is_linear: Callable[[np.ndarray, np.ndarray], bool],
    mass: sp.csr_array | None,
    is_large: bool = False,
) -> Elimination:
    """How the needed ones of the slopes that are selected follow from equations that depend on the
    slopes in these `places`. Those that are not `differentiated` may have a constant `mass`;
    `is_linear` tells of some of the equations and slopes whether they are. What would cost too much
    in a large system raises `NotFound`."""
    rows, columns = (np.array(x, int) for x in selected)
    closed = np.zeros(0, int), np.zeros(0, int)
    if mass is not None:
        closed = _closed(mass, np.setdiff1d(rows, differentiated), columns)
    at = np.isin(rows, closed[0]), np.isin(columns, closed[1])
    rows, columns = rows[~at[0]], columns[~at[1]]
    rows = rows[maximum_bipartite_matching(places[rows][:, columns], perm_type="row")]
    depends = places[rows][:, columns]  # each slope on others, by its own equation
    wanted = _reachable(depends, needed[columns])
    rows, columns, depends = rows[wanted], columns[wanted], depends[wanted][:, wanted]
    blocks = tuple(
        one._replace(is_linear=is_linear(*(np.unique(x) for x in one[:2])))
        for one in _blocks(rows, columns, depends, is_large)
    )
    used = places[rows]
    needed = needed | (np.bincount(used.indices, minlength=needed.size) > 0)
    constant = None
    if mass is not None and (those := np.intersect1d(closed[1], np.flatnonzero(needed))).size:
        constant = _inverse(mass, closed, those, is_large)
    return Elimination(constant, blocks, not np.isin(rows, differentiated).any())


def _reachable(depends: sp.csr_array, start: Bool[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """What the start depends on, with the start."""
    if not (size := start.size):
        return start
    first = sp.csr_array(start[None].astype(float))
    graph = sp.block_array([[None, first], [sp.csr_array((size, 1)), depends]], format="csr")
    found = breadth_first_order(graph, 0, return_predecessors=False)
    return np.isin(np.arange(1, size + 1), found)


def _blocks(
    rows: np.ndarray, columns: np.ndarray, depends: sp.csr_array, is_large: bool
) -> tuple[Blocks, ...]:
    """The blocks in their order: slopes that depend on each other are in one."""
    if not columns.size:
        return ()
    count, block = connected_components(depends, connection="strong")
    on, after = block[sp.coo_array(depends).coords[1]], block[sp.coo_array(depends).coords[0]]
    inside = on == after
    level, settled = np.zeros(count, int), False
    for _ in range(_MOST_LEVELS):
        before = level.copy()
        np.maximum.at(level, after[~inside], before[on[~inside]] + 1)
        settled = np.array_equal(level, before)
        if settled:
            break
    sizes = np.bincount(block, minlength=count)
    if is_large and (not settled or sizes.max() > _MOST_COUPLED):
        raise NotFound("slopes that a constraint needs are coupled, and not by constants")
    if not settled:
        return (Blocks((tuple(rows.tolist()),), (tuple(columns.tolist()),)),)
    order, found = np.argsort(block, kind="stable"), []
    starts = np.cumsum(sizes) - sizes
    for one, size in np.unique(np.stack([level, sizes], 1), axis=0):
        those = np.flatnonzero((level == one) & (sizes == size))
        at = order[starts[those][:, None] + np.arange(size)]
        for part in [at] if size <= _MOST_COUPLED else at[:, None]:
            found.append(Blocks(*(tuple(map(tuple, x[part].tolist())) for x in (rows, columns))))
    return tuple(found)


def _closed(
    mass: sp.csr_array, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Those rows and columns of independent rows that are as many in their connected component, so
    that these slopes are determined by these equations alone."""
    part = mass[rows][:, columns]
    both = sp.block_array([[None, part], [part.T, None]], format="csr")
    count, component = connected_components(both, directed=False)
    of_rows, of_columns = np.split(component, [rows.size])
    sizes = (np.bincount(x, minlength=count) for x in (of_rows, of_columns))
    is_square = np.equal(*sizes)
    return rows[is_square[of_rows]], columns[is_square[of_columns]]


def _inverse(
    mass: sp.csr_array, closed: tuple[np.ndarray, np.ndarray], needed: np.ndarray, is_large: bool
) -> SparseMatrix:
    """The matrix that gives the slopes that are needed from the equations without slopes."""
    rows, columns = closed
    at = np.argsort(columns)[np.searchsorted(np.sort(columns), needed)]
    one = sp.csr_array((np.ones(len(at)), (np.arange(len(at)), at)), (len(at), len(columns)))
    inverse = sp.coo_array(combinations(one, mass[rows][:, columns]))
    if is_large and inverse.nnz > _MOST_TERMS * len(at):
        raise NotFound(
            "the slopes of too many unknowns are coupled, as those of finite elements with a "
            "consistent mass matrix: use a diagonal one"
        )
    (i, j), values = inverse.coords, np.asarray(inverse.data)
    return SparseMatrix(sp.csr_array((-values, (needed[i], rows[j])), mass.shape))
