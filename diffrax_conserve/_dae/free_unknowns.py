"""The nearest state on the constraints, where some unknowns are free.

The equations `F(t, y, y') = 0` do not differentiate the directions `N` with `∂F/∂y' N = 0`, such as
forces and currents. A state moves along them as far as the constraints ask for, and in all other
directions as little as possible. So a change of the state is `δ = S e + N z`, with the units `S` of
the unknowns that are not free, and for a residual `r`

    min |e|²/2  subject to  A e + B z = r,    A = G S,  B = G N,

where `G` is the constraint Jacobian. The result is `e = Âᵀ μ`, with

    [A Âᵀ  B] [μ]   [r]
    [B̂ᵀ    0] [z] = [0],

where `Â` and `B̂` are those at the candidate. Small systems are solved for all `r` at once. The
matrix of large ones is sparse. There an unknown that is in many constraints, whose column would
fill `A Âᵀ`, stays one: with `e` for these alone, `e - Âᵀ μ = 0`.

Elsewhere free unknowns are those with large units. That does not do where they are in more
constraints than they can meet: where cells in parallel have one voltage, the differences of its
constraints are a relation of their charges, and large units would hide it by roundoff.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._large.klu import Places, RealFactor, SparseJacobian, sparse_jacobian
from .._numerics.implicit import AbstractSystem, implicit_solution
from .._numerics.iterate import Solved, iterate, remaining_after_test
from .._numerics.lanes import where_active
from .._numerics.problem import Problem
from .._numerics.rows import DenseRows
from .._tree import eps_of, tree_stop_gradient
from .elimination import SparseMatrix
from .newton import solve_equilibrated


def nearest_with_free(
    problem: Problem,
    candidate: Float[Array, " n"],
    units: Float[Array, " n"],
    along: Float[Array, "n f"] | SparseMatrix,
    free: np.ndarray,
    by_free: Bool[np.ndarray, "m f"] | None,
    fixed: Any = None,
    *,
    max_steps: int,
) -> Solved:
    """The state on the manifold that is nearest to a candidate, by Newton's method.

    The directions of the corrections are those at the candidate, and have no derivative.

    - `units`: of the unknowns that are not free.
    - `along`: the columns of `N`, with the coordinates `free`.
    - `by_free`: which constraints depend on which of them, if that is known.
    - `fixed`: the unknowns that stay as they are; for sparse matrices known while JAX traces.
    """
    fixed = np.zeros(candidate.size, bool) if fixed is None else fixed
    problem_at, at, units = tree_stop_gradient((problem, candidate, units))
    moving = ~fixed & ~np.isin(np.arange(candidate.size), free)
    units = jnp.where(moving, units, 0)
    found = None
    if isinstance(along, SparseMatrix):
        along = SparseMatrix(along.matrix[:, ~(abs(along.matrix.T) @ fixed).astype(bool)])
        found = sparse_jacobian(problem.residual, candidate)
    if isinstance(along, SparseMatrix) and found is not None:
        places = _Places(found, along, moving)
        corrections: Any = _SparseCorrections.at(problem_at, at, units, places)
    else:
        along = along.dense(candidate.dtype) if isinstance(along, SparseMatrix) else along
        moves = ~jnp.any((along != 0) & fixed[:, None], 0)
        moves = moves if by_free is None else moves & by_free
        corrections = _DenseCorrections.at(problem_at, at, units, moving, moves, along)
    return implicit_solution(_Nearest(problem, candidate, corrections, max_steps=max_steps))


def _positive(units: Float[Array, " n"], moving: Any, columns: Float[Array, " n"]) -> Array:
    """The units, where they are zero by a small share of what others stand for in the constraints,
    of which `columns` are the largest elements of the Jacobian, as shares of those in their rows.

    An unknown that has not moved so far has none, such as a virtual ground, whose voltage is zero.
    Its constraint could not be told from that of another unknown if it stayed where it is."""
    return jnp.where((units == 0) & moving, eps_of(units) ** 0.25 / columns, units)


class _Nearest(AbstractSystem):
    """The equations for the distance from the candidate: `g(ŷ + δ) = 0`, where a change of `δ` is
    one of the `corrections`."""

    problem: Problem
    candidate: Float[Array, " n"]
    corrections: Any
    max_steps: int = eqx.field(static=True, kw_only=True)

    def solved(self) -> Solved:
        problem, corrections = self.problem, self.corrections

        def advance(y: Array, tests_left: Array) -> tuple[Array, Array]:
            g, rows = corrections.linearise(problem, y)
            status, to_correct = problem.status(g, problem.scale(rows, y))
            tests_left = remaining_after_test(status, tests_left)
            return where_active(tests_left, y - corrections(rows, to_correct), y), tests_left

        return iterate(advance, self.candidate, max_steps=self.max_steps)

    def linearisation_point(self, solved: Solved) -> Float[Array, " n"]:
        return jnp.where(solved.ok, solved.y - self.candidate, 0)

    def equations(self, unknowns: Float[Array, " n"]) -> tuple[Array, Array]:
        y = self.candidate + unknowns
        return y, self.problem.residual(y)

    def solve_linearised(
        self, solved: Solved, unknowns: Float[Array, " n"], t_equations: tuple[Array, Array]
    ) -> Array:
        t_y, t_g = t_equations
        y = self.candidate + unknowns
        return t_y - self.corrections.linear(self.corrections.linearise(self.problem, y)[1], t_g)


# ---- Small systems ----


class _DenseCorrections(eqx.Module):
    """`directions` are the changes of the state, one for each constraint, that change its residual
    alone, by one."""

    directions: Float[Array, "n m"]

    @classmethod
    def at(
        cls,
        problem: Problem,
        candidate: Array,
        units: Array,
        moving: Any,
        moves: Any,
        along: Array,
    ) -> "_DenseCorrections":
        jacobian = cls.linearise(problem, candidate)[1].matrix
        columns = _largest(jacobian / _largest(jacobian * units, 1), 0)[0]
        units = _positive(units, moving, columns)
        return cls(lax.stop_gradient(_directions(jacobian, units, along, moves)))

    @staticmethod
    def linearise(problem: Problem, y: Array) -> tuple[Array, DenseRows]:
        g, rows = problem.with_dense_jacobian().linearise(y)
        assert isinstance(rows, DenseRows)
        return g, rows

    def __call__(self, rows: DenseRows, residual: Array) -> Array:
        # What no unknown that moves can correct must hold as it is.
        uncorrectable = jnp.diag(jnp.all(self.directions == 0, axis=0).astype(residual.dtype))
        matrix = rows.matrix @ self.directions + uncorrectable
        return self.directions @ solve_equilibrated(matrix, residual)

    linear = __call__


def _directions(
    jacobian: Float[Array, "m n"],
    units: Float[Array, " n"],
    along: Float[Array, "n f"],
    moves: Bool[Array, "*m f"] | bool,
) -> Float[Array, "n m"]:
    """The directions of corrections, from the equations without `e`.

    The linear system is equilibrated: each column of `B` is divided by its largest element, as a
    share of the largest in the row, and then each row of `A` and `B` by its largest element.
    """
    m, f = len(jacobian), along.shape[1]
    scaled, by_free = jacobian * units, jnp.where(moves, jacobian @ along, 0)
    columns = _largest(by_free / _largest(by_free, 1), 0)
    both = jnp.concatenate([scaled, by_free / columns], 1)
    rows = _largest(both, 1)
    scaled, by_free = jnp.split(both / rows, [len(units)], axis=1)
    matrix = jnp.block([[scaled @ scaled.T, by_free], [by_free.T, jnp.zeros((f, f), units.dtype)]])
    # Empty rows, of what cannot be corrected or does not move, have the solution zero.
    matrix = matrix + jnp.diag(jnp.all(matrix == 0, axis=1).astype(units.dtype))
    solution = solve_equilibrated(matrix, jnp.eye(m + f, m, dtype=units.dtype))
    change = units[:, None] * (scaled.T @ solution[:m]) + along @ (solution[m:] / columns.T)
    return change / rows.T


def _largest(matrix: Float[Array, "m n"], axis: int) -> Array:
    """The largest elements of the rows or columns, one where all are zero."""
    largest = jnp.max(jnp.abs(matrix), axis=axis, keepdims=True, initial=0)
    return jnp.where(largest > 0, largest, 1)


# ---- Large systems ----


# A column of `A` with more elements than this would fill `A Âᵀ` with their square.
_WIDE = 16


class _Places:
    """The places of the elements of the matrix of `μ`, `z` and `e`, from those of `G` and `N`.

    - `gram`: for each term of an element of `A Âᵀ` its two elements of `G`.
    - `element`, `factor`, `row`, `column`: for each term of an element of `B` the element of `G`
      and the factor of `N` in it, and its place.
    - `wide`: the elements of `G` in the columns of `e`.
    - `moving`: the unknowns that are neither free nor fixed.
    """

    def __init__(self, found: SparseJacobian, along: SparseMatrix, moving: np.ndarray):
        self.found, self.along, (m, n), f = found, along, found.shape, along.shape[1]
        self.moving = moving
        # The elements of `G` are in the order of the columns.
        counts = np.bincount(found.columns, minlength=n)
        narrow, wide = moving & (counts <= _WIDE), moving & (counts > _WIDE)
        first, place = _expanded(np.where(narrow, counts, 0)[found.columns])
        self.gram = first, (np.cumsum(counts) - counts)[found.columns[first]] + place
        basis = along.matrix
        self.element, place = _expanded(np.diff(basis.indptr)[found.columns])
        at = basis.indptr[found.columns[self.element]] + place
        self.factor, self.column = basis.data[at], basis.indices[at]
        self.row = found.rows[self.element]
        self.wide = np.flatnonzero(wide[found.columns])
        self.wide_columns, e = np.unique(found.columns[self.wide], return_inverse=True)
        size, z, e = m + f + len(self.wide_columns), m + self.column, m + f + e
        both = found.rows[self.gram[0]], found.rows[self.gram[1]]
        by_e = found.rows[self.wide]
        # A zero on the diagonal would be taken for a pivot, so it has no place.
        rows = np.concatenate([both[0], self.row, z, by_e, e])
        columns = np.concatenate([both[1], z, self.row, e, by_e])
        empty = np.setdiff1d(np.arange(m + f), rows)
        self.diagonal = np.concatenate([np.unique(both[0]), empty, np.arange(m + f, size)])
        rows, columns = (np.concatenate([x, self.diagonal]) for x in (rows, columns))
        self.places = Places(rows, columns, size)
        self.index = self.places.index(rows, columns)

    def values(self, parts: list[Array]) -> Float[Array, " k"]:
        """The values of the matrix, from those of its terms."""
        zeros = jnp.zeros(len(self.places.numbers), parts[0].dtype)
        return zeros.at[self.index].add(jnp.concatenate(parts))


def _expanded(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each index as often as is counted, and the numbers of its copies."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)


class _Sparse(NamedTuple):
    """The values of the elements of `G`, and where they are."""

    values: Float[Array, " k"]
    found: SparseJacobian

    def absolute_matvec(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        products = jnp.abs(self.values) * x[self.found.columns]
        return jax.ops.segment_sum(products, self.found.rows, self.found.shape[0])

    def largest(self, axis: int) -> Array:
        """The largest elements of the rows or columns, one where all are zero."""
        zeros = jnp.zeros(self.found.shape[axis], self.values.dtype)
        along = (self.found.rows, self.found.columns)[axis]
        largest = zeros.at[along].max(jnp.abs(self.values))
        return jnp.where(largest > 0, largest, 1)


class _SparseCorrections(eqx.Module):
    """`jacobian` are the values of `G` at the candidate; `row` the units of the constraints;
    `diagonal` is one for `e` and for what cannot be corrected or does not move."""

    jacobian: Float[Array, " k"]
    units: Float[Array, " n"]
    row: Float[Array, " m"]
    diagonal: Float[Array, " d"]
    places: _Places = eqx.field(static=True)

    @classmethod
    def at(
        cls, problem: Problem, candidate: Array, units: Array, places: _Places
    ) -> "_SparseCorrections":
        found, size = places.found, places.places.size
        values = found.values(problem.residual, candidate)
        largest = _Sparse(jnp.abs(values) * units[found.columns], found).largest(0)
        columns = _Sparse(values / largest[found.rows], found).largest(1)
        units = _positive(units, places.moving, columns)
        by_e = jnp.abs(values) * units[found.columns]
        row = jnp.zeros(found.shape[0], values.dtype).at[found.rows].max(by_e)
        row = row.at[places.row].max(jnp.abs(values[places.element] * places.factor))
        empty = jnp.ones(size).at[: row.size].set(row == 0)
        row = jnp.where(row > 0, row, 1)
        return cls(values / row[found.rows], units, row, empty[places.diagonal], places)

    def linearise(self, problem: Problem, y: Array) -> tuple[Array, _Sparse]:
        found = self.places.found
        return problem.residual(y), _Sparse(found.values(problem.residual, y), found)

    def _matrix(self, rows: _Sparse) -> Float[Array, " k"]:
        found, places = self.places.found, self.places
        now, before = rows.values / self.row[found.rows], self.jacobian
        by_e, by_e_before = (x * self.units[found.columns] for x in (now, before))
        (first, second), wide = places.gram, places.wide
        return places.values([
            by_e[first] * by_e_before[second],
            now[places.element] * places.factor,
            before[places.element] * places.factor,
            by_e[wide],
            -by_e_before[wide],
            self.diagonal,
        ])  # fmt: skip

    def _change(self, solution: Array) -> Array:
        found = self.places.found
        multiplier, z = solution[: found.shape[0]], solution[found.shape[0] :]
        terms = self.jacobian * multiplier[found.rows]
        by_e = jax.ops.segment_sum(terms, found.columns, found.shape[1])
        return self.units**2 * by_e + self.places.along @ z[: self.places.along.shape[1]]

    def _right(self, residual: Array) -> Array:
        return jnp.pad(residual / self.row, (0, self.places.places.size - residual.size))

    def __call__(self, rows: _Sparse, residual: Array) -> Array:
        factor = RealFactor(self.places.places, self._matrix(rows))
        solution = factor.solve(self._right(residual))
        return self._change(factor.freed(solution, solution)[0])

    def linear(self, rows: _Sparse, residual: Array) -> Array:
        return self._change(self.places.places.solve(self._matrix(rows), self._right(residual)))
