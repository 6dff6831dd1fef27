"""The structure of large equations, from sparse matrices.

It is found as that of small ones, in `reduction.find_structure`: by elimination of the derivatives
at numbers in general position. `_large.detection` finds their places, `_large.elimination`
eliminates. What this can not do is refused with its reason, before it takes long.
"""

# The types of scipy's sparse arrays are incomplete.
# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# pyright: reportOptionalIterable=false, reportAssignmentType=false

import contextlib
import dataclasses
import functools as ft
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array

from .._fast.run_once import RunOnce
from .._large.detection import NotSparse
from .._large.elimination import TooFull, combinations, exact_sum, extended
from .._large.klu import SparseJacobian
from .elimination import Elimination, NotFound, Round, SparseMatrix, elimination
from .large import Large
from .places import FindPlaces, Numbers
from .reduction import (
    LastConstraints,
    OtherRanks,
    Singular,
    Structure,
    WithNumbers,
    general_states,
    usual,
    with_stages,
)

# The largest index that is looked for. Each differentiation makes the functions larger, and
# mechanisms have three.
MAX_INDEX = 3
_NOT_CONSTANT = "the coefficients of their slopes are coupled, and not constant"


@contextlib.contextmanager
def _refusals() -> Iterator[None]:
    """Gives what an elimination can not do as the reason why nothing was found."""
    try:
        yield
    except TooFull:
        raise NotFound(
            "the matrices of their derivatives fill in too much when they are eliminated"
        ) from None
    except NotSparse:
        raise NotFound(
            "nearly all equations depend on nearly all unknowns, as far as their program tells"
        ) from None


@_refusals()
def find_large_structure(
    equations: WithNumbers,
    numbers: Numbers,
    others: Numbers,
    t: Array,
    y: Array,
    mass: sp.csr_array | None,
    unknown: tuple[int, ...],
    memory: dict[Any, Any],
    known: Structure | None = None,
) -> Structure:
    """As `find_structure`. `unknown` are the numbers that may have any values, also where they are
    indices. `memory` holds what does not depend on the numbers, for the next search."""

    def once(key: Any, find: Callable[[], Any]) -> Any:
        if key not in memory:
            memory[key] = find()
        return memory[key]

    def found() -> Large:
        given = places.of(equations, 2) if mass is None else _jacobian(mass)
        return Large(places.of(equations, 1), given)

    n = y.size
    places = FindPlaces(memory, numbers, unknown, t, y)
    large = once("places", found)
    by_y, by_slope = large.by_y, large.by_slope
    t, y, of_y, values, at_rest, is_linear, absent = _general_position(
        equations, by_y, by_slope, numbers, t, y
    )
    matrix = other = _matrix(by_slope, values)
    if mass is None:
        later, moved = 2 * np.asarray(t) + 1, 2 * np.asarray(y)
        values = _by_slope(equations, by_slope, others, later, moved, y)
        other = _matrix(by_slope, values)
        mass = matrix if (matrix != other).nnz == 0 else None
    none = np.zeros(0, int)
    selected = extended(matrix, extended(_matrix(by_slope, at_rest), (none, none)))
    first = np.setdiff1d(np.arange(n), selected[0])
    is_semi_explicit = not (matrix[first].nnz or other[first].nnz)
    without = np.flatnonzero(_empty(matrix, 0) & _empty(other, 0))
    without_free = np.isin(by_slope.columns, selected[1]).all()
    in_rest = np.isin(first, by_slope.rows).any()
    structure = Structure(
        n,
        (),
        is_linear,
        mass,
        is_semi_explicit,
        always_fits=bool(mass is not None or without_free or not in_rest),
        without_free=bool(without_free),
        without_slopes=_tuple(without),
        large=large,
    )
    needed = none
    in_places = by_slope.rows, by_slope.columns
    gradients = sp.csr_array((0, n))
    while len(selected[0]) < n:
        if known is not None:
            one = known.selected(structure.index, len(selected[0]))
            selected = tuple(np.array(x, int) for x in one)
        if structure.index == MAX_INDEX:
            raise NotFound(f"their index is larger than {MAX_INDEX}")
        one = Round(*map(_tuple, selected))
        kind = (
            structure.is_linear,
            structure.mass is None,
            structure.is_semi_explicit,
            _pattern(matrix),
        )
        further = ft.partial(_with_round, structure, selected, matrix, in_places, needed)
        large, found = once((structure, one, *kind), further)
        structure = dataclasses.replace(
            structure,
            rounds=(*structure.rounds, one),
            eliminations=(*structure.eliminations, found),
            large=large,
        )
        left = np.array(structure.left(structure.index - 1), int)
        if structure.index == 1:  # the derivatives of equations, or of combinations of them
            share = _combined(structure)
            at, of_y = _jacobian(abs(share) @ _ones(by_y)), _matrix(by_y, of_y)
            new = exact_sum(share @ of_y, abs(share) @ abs(of_y))
        else:
            last = LastConstraints(equations, structure)
            at = places.of(last, 1)
            new = _matrix(at, _last_values(last, at, numbers, t, y))
        gradients = sp.csr_array(sp.vstack([gradients, new]))
        independent = extended(gradients, (none, none))[0]
        if len(independent) < gradients.shape[0]:
            start = gradients.shape[0] - len(left)
            blamed = left[~np.isin(start + np.arange(len(left)), independent)]
            raise Singular(_tuple(blamed), absent)
        matrix = _replaced(matrix, left, new)
        kept = ~np.isin(in_places[0], left)
        added = left[at.rows], at.columns
        in_places = tuple(np.append(x[kept], y) for x, y in zip(in_places, added, strict=True))
        selected = extended(matrix, selected)
        needed = np.unique(at.columns[~np.isin(left[at.rows], selected[0])])
    if known is not None and structure.index != known.index:
        raise OtherRanks
    large = once((structure, "slopes"), lambda: _with_slopes(structure, by_y, in_places))
    part = gradients[:, structure.algebraic]
    part = part[~_empty(part, 1)]
    shares_free = len(extended(part, (none, none))[0]) < part.shape[0]
    if structure.index > 1 and shares_free and large.along is None:
        raise NotFound(_NOT_CONSTANT)
    structure = dataclasses.replace(structure, large=large, shares_free=shares_free)
    return with_stages(structure, gradients, lambda part: extended(part, (none, none))[0])


def _tuple(x: np.ndarray) -> tuple[int, ...]:
    return tuple(x.tolist())


def _empty(matrix: sp.csr_array, axis: int) -> np.ndarray:
    """Which columns, or rows, have no element."""
    return np.bincount(sp.coo_array(matrix).coords[1 - axis], minlength=matrix.shape[1 - axis]) == 0


def _pattern(matrix: sp.csr_array) -> tuple[bytes, bytes]:
    """Where a matrix has elements, as a key."""
    return matrix.indptr.tobytes(), matrix.indices.tobytes()


def _matrix(places: SparseJacobian, values: Any) -> sp.csr_array:
    out = sp.csr_array((np.asarray(values), (places.rows, places.columns)), places.shape)
    out.eliminate_zeros()
    return out


def _jacobian(pattern: sp.csr_array) -> SparseJacobian:
    """The places of the elements of a matrix."""
    rows, columns = sp.coo_array(pattern).coords
    return SparseJacobian(rows, columns, pattern.shape)


def _ones(places: SparseJacobian) -> sp.csr_array:
    return sp.csr_array((np.ones(len(places.rows)), (places.rows, places.columns)), places.shape)


def _combined(structure: Structure) -> sp.csr_array:
    """The combinations of the equations that are left first."""
    large, left = structure.large, np.array(structure.left(0), int)
    assert large is not None
    if large.combinations is not None:
        return large.combinations.matrix
    at = np.arange(len(left)), left
    return sp.csr_array((np.ones(len(left)), at), (len(left), structure.size))


def _replaced(matrix: sp.csr_array, rows: np.ndarray, by: sp.csr_array) -> sp.csr_array:
    kept = np.ones(matrix.shape[0])
    kept[rows] = 0
    by = sp.coo_array(by)
    at = rows[by.coords[0]], by.coords[1]
    out = sp.diags_array(kept) @ matrix + sp.csr_array((by.data, at), matrix.shape)
    out = sp.csr_array(out)
    out.eliminate_zeros()
    return out


# ---- Eliminated slopes ----


def _with_round(
    structure: Structure,
    selected: tuple[np.ndarray, ...],
    matrix: sp.csr_array,
    in_places: tuple[np.ndarray, ...],
    needed: np.ndarray,
) -> tuple[Large, Elimination | None]:
    """What one more round needs. It differentiates some of the constraints before it, and needs the
    slopes of the unknowns in these."""
    rows, columns = selected
    n, large = structure.size, structure.large
    assert large is not None
    differentiated = np.array(structure.left(0), int) if structure.rounds else np.zeros(0, int)
    constant = structure.is_linear and structure.mass is not None
    if not structure.rounds:
        large = dataclasses.replace(large, along=_along(matrix, rows, columns, constant))
        if structure.is_semi_explicit:
            return large, None
        if not constant:
            raise NotFound(
                "equations without slopes are combinations of others, and the coefficients of "
                "their slopes are not constant"
            )
        left = np.setdiff1d(np.arange(n), rows)
        share = combinations(structure.mass[left][:, columns], structure.mass[rows][:, columns])
        whole = _spread(sp.eye_array(len(left), format="csr"), left, n)
        whole = whole - _spread(share, rows, n)
        return dataclasses.replace(large, combinations=SparseMatrix(whole)), None
    if needed.size and not structure.is_linear:
        raise NotFound("they are not linear in slopes that a constraint needs")
    ones = np.ones(len(in_places[0]), bool)
    return large, elimination(
        sp.csr_array((ones, in_places), (n, n)),
        Round(_tuple(rows), _tuple(columns)),
        np.isin(np.arange(n), needed),
        differentiated,
        is_linear=lambda *_: True,
        mass=structure.mass,
        is_large=True,
    )


def _with_slopes(
    structure: Structure, by_y: SparseJacobian, in_places: tuple[np.ndarray, np.ndarray]
) -> Large:
    """What the equations need after the last round."""
    n, large = structure.size, structure.large
    large = dataclasses.replace(large, for_slopes=SparseJacobian(*in_places, (n, n)))
    if structure.index != 1:
        return large
    if large.along is None:
        raise NotFound(_NOT_CONSTANT)
    moved = abs(_combined(structure)) @ _ones(by_y) @ abs(large.along.matrix)
    return dataclasses.replace(large, by_free=_jacobian(moved))


def _along(
    matrix: sp.csr_array, rows: np.ndarray, columns: np.ndarray, constant: bool
) -> SparseMatrix | None:
    """A basis of the vectors that rows of a matrix map to zero; `None` if it is not constant."""
    n = matrix.shape[0]
    free = np.setdiff1d(np.arange(n), columns)
    basis = sp.csr_array((np.ones(len(free)), (free, np.arange(len(free)))), (n, len(free)))
    outer = matrix[rows][:, free]
    if outer.nnz:
        if not constant:
            return None
        share = combinations(sp.csr_array(outer.T), sp.csr_array(matrix[rows][:, columns].T))
        basis = basis - _spread(share, columns, n).T
    return SparseMatrix(sp.csr_array(basis))


def _spread(matrix: sp.csr_array, columns: np.ndarray, size: int) -> sp.csr_array:
    """The matrix with its columns in these places of a wider one."""
    at = sp.coo_array(matrix)
    row, column = at.coords
    return sp.csr_array((at.data, (row, columns[column])), (matrix.shape[0], size))


# ---- Numbers ----


@ft.partial(RunOnce, ft.partial(jax.jit, static_argnums=(0, 1)))
def _last_values(
    last: LastConstraints, places: SparseJacobian, numbers: Numbers, t: Array, y: Array
) -> Array:
    return places.values(lambda y: last(numbers, t, y, y), y)


@ft.partial(RunOnce, ft.partial(jax.jit, static_argnums=(0, 1)))
def _by_slope(
    equations: WithNumbers,
    places: SparseJacobian,
    numbers: Numbers,
    t: Array,
    y: Array,
    slopes: Array,
) -> Array:
    return places.values(lambda slopes: equations(numbers, t, y, slopes), slopes)


@ft.partial(RunOnce, ft.partial(jax.jit, static_argnums=(0, 1, 2)))
def _near(
    equations: WithNumbers,
    by_y: SparseJacobian,
    by_slope: SparseJacobian,
    numbers: Numbers,
    t: Array,
    y: Array,
    share: float | Array,
) -> tuple[Array, ...]:
    later, moved, slopes = general_states(t, y, share)
    fn = ft.partial(equations, numbers)
    of_y = by_y.values(lambda y: fn(later, y, slopes[0]), moved)
    given_at = jnp.stack([moved, moved, jnp.zeros_like(y)]), slopes[jnp.array([0, 1, 0])]
    first, second, at_rest = jax.vmap(
        lambda y, slopes: by_slope.values(ft.partial(fn, later, y), slopes)
    )(*given_at)
    total = jnp.sum(fn(later, moved, slopes[0])) + jnp.sum(of_y) + jnp.sum(first + second)
    return later, moved, of_y, first, at_rest, jnp.all(first == second), jnp.isfinite(total)


def _general_position(
    equations: WithNumbers,
    by_y: SparseJacobian,
    by_slope: SparseJacobian,
    numbers: Numbers,
    t: Array,
    y: Array,
) -> tuple[Array, Array, Array, Array, np.ndarray, bool, tuple[int, ...]]:
    for share in (1e-1, 1e-3, 1e-5, 0.0):
        found = _near(equations, by_y, by_slope, numbers, t, y, share)
        later, moved, of_y, values, at_rest, is_linear, finite = found
        if finite:
            absent = _empty(_matrix(by_y, of_y), 0) & _empty(_matrix(by_slope, values), 0)
            absent = _tuple(np.flatnonzero(absent))
            at_rest = usual(np.asarray(at_rest), np.asarray(values))
            return later, moved, of_y, values, at_rest, bool(is_linear), absent
    raise FloatingPointError
