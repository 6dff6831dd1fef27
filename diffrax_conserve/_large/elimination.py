"""Gaussian elimination of large sparse matrices of numbers, to find their rank.

How many equations can be solved for how many unknowns must be known exactly. The places of the
elements alone do not tell: the currents into the nodes of a ring of condensers add up to zero. So
the matrix of numbers in general position is eliminated, in an order in which little is filled in.

- A row or a column with a single element is a pivot without arithmetic. Taken again and again, they
  are all of most mass matrices.
- What is left falls into parts that share no row and no column. Small parts are eliminated with the
  largest pivot, all parts of one shape together.
- A large part is factored by SuperLU, with roundoff added so that it is no error if it is singular.
  Its small pivots tell what is left over, which is eliminated in the same way.
"""

# The types of scipy's sparse arrays are incomplete.
# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# pyright: reportOptionalIterable=false, reportAssignmentType=false

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

from .._constants import REGULARISATION_POWER

# The pivots that were found: their rows and their columns.
Pivots = tuple[np.ndarray, np.ndarray]

_EPS = float(np.finfo(float).eps)
# What is smaller, in units in which the largest elements are one, is roundoff.
_LEAST = _EPS**REGULARISATION_POWER
# A pivot of SuperLU that is smaller is not taken at once. Its rows are compared again with what is
# left over.
_SMALL_PIVOT = _EPS**0.25
# Parts with at most this many rows and columns are eliminated as dense matrices.
_DENSE = 256
# Single elements are looked for so often.
_SWEEPS = 20
# A matrix that fills in with more than this many elements is given up, within about a second.
MOST_ELEMENTS = 10**7
MOST_OPERATIONS = 2 * 10**8  # of combinations of rows, which take about 5 s
_COLUMNS = 16  # so many right sides at once, for which SuperLU calls no threads


class TooFull(Exception):
    """The elimination fills in too many elements."""


def equilibrated(matrix: sp.csr_array) -> sp.csr_array:
    """The matrix in units of rows and columns in which the largest elements are one."""
    matrix = sp.coo_array(matrix, dtype=float)
    data = np.abs(matrix.data)
    scale = np.ones(len(data))
    for _ in range(8):
        for at, size in zip(matrix.coords, matrix.shape, strict=True):
            largest = np.zeros(size)
            np.maximum.at(largest, at, data * scale)
            largest = np.sqrt(np.where(largest > 0, largest, 1))
            scale = scale / largest[at]
    return _without_roundoff(sp.csr_array((matrix.data * scale, matrix.coords), matrix.shape))


def _without_roundoff(matrix: sp.csr_array) -> sp.csr_array:
    matrix = sp.csr_array(matrix)
    matrix.data[~(np.abs(matrix.data) > _LEAST)] = 0
    matrix.eliminate_zeros()
    return matrix


def extended(matrix: sp.csr_array, chosen: Pivots) -> Pivots:
    """The pivots that were chosen, with as many more as the rank of the matrix allows."""
    matrix = equilibrated(matrix)
    rows, columns = (np.asarray(x, int) for x in chosen)
    if not rows.size:
        return _pivots(matrix)
    return _with_more(matrix, (rows, columns))


def _with_more(matrix: sp.csr_array, pivots: Pivots) -> Pivots:
    others = _others(matrix.shape, *pivots)
    more = _pivots(_remainder(matrix, pivots, others))
    found = (np.append(a, b[c]) for a, b, c in zip(pivots, others, more, strict=True))
    return tuple(found)  # pyright: ignore


def _others(shape: tuple[int, ...], *used: np.ndarray) -> Pivots:
    return tuple(np.setdiff1d(np.arange(n), x) for n, x in zip(shape, used, strict=True))  # pyright: ignore


def _remainder(matrix: sp.csr_array, pivots: Pivots, others: Pivots) -> sp.csr_array:
    """What is left of the other rows and columns after elimination by these pivots."""
    (rows, columns), (below, beside) = pivots, others
    share = combinations(matrix[below][:, columns], matrix[rows][:, columns])
    given, rest = matrix[below][:, beside], matrix[rows][:, beside]
    return _without_roundoff(exact_sum(given - share @ rest, abs(given) + abs(share) @ abs(rest)))


def exact_sum(values: Any, terms: Any) -> sp.csr_array:
    """Sums without those that cancel but for the roundoff of their terms."""
    out = sp.csr_array(values * (abs(values) > _LEAST * terms))
    out.eliminate_zeros()
    return out


def combinations(rows: sp.csr_array, matrix: sp.csr_array) -> sp.csr_array:
    """`rows matrix⁻¹`, the combinations of the rows of a regular matrix that `rows` are."""
    rows, at = sp.csr_array(rows), sp.coo_array(matrix)
    line, column = at.coords
    # An element that is alone in its row and in its column is divided by.
    alone = (np.bincount(line)[line] == 1) & (np.bincount(column)[column] == 1)
    inverse = (1 / at.data[alone], (column[alone], line[alone]))
    found = sp.csr_array(rows @ sp.csr_array(inverse, matrix.shape[::-1]))
    others = _others(matrix.shape, line[alone], column[alone])
    rest = rows[:, others[1]]
    some = np.flatnonzero(np.diff(rest.indptr))
    if some.size * len(others[0]) > MOST_OPERATIONS:
        raise TooFull
    more = [(np.zeros(0), np.zeros(0, int), np.zeros(0, int))]
    factors = spla.splu(sp.csc_array(matrix[others[0]][:, others[1]].T)) if some.size else None
    for start in range(0, some.size, _COLUMNS):
        those = some[start : start + _COLUMNS]
        part = factors.solve(np.ascontiguousarray(rest[those].toarray().T)).T  # pyright: ignore
        i, j = np.nonzero(np.abs(part) > _EPS * np.max(np.abs(part), axis=1, keepdims=True))
        more.append((part[i, j], those[i], others[0][j]))
        if sum(len(x) for x, *_ in more) > MOST_ELEMENTS:
            raise TooFull
    values, i, j = (np.concatenate(x) for x in zip(*more, strict=True))
    return found + sp.csr_array((values, (i, j)), rows.shape)


def _pivots(matrix: sp.csr_array) -> Pivots:
    """As many pivots as the rank is."""
    rows, columns, left = _single(matrix)
    found = [(rows, columns)]
    if left.nnz:
        found += _in_parts(left)
    return tuple(np.concatenate(x).astype(int) for x in zip(*found, strict=True))  # pyright: ignore


def _single(matrix: sp.csr_array) -> tuple[np.ndarray, np.ndarray, sp.csr_array]:
    """The pivots that are alone in their row or column, and the elements that are left, in the
    shape of the matrix."""
    left = sp.coo_array(matrix)
    chosen: list[list[np.ndarray]] = [[], []]
    for _ in range(_SWEEPS):
        number = sum(map(len, chosen[0]))
        for axis in (0, 1):
            lines, across = left.coords[axis], left.coords[1 - axis]
            alone = np.flatnonzero(np.bincount(lines, minlength=left.shape[axis])[lines] == 1)
            # Of those in the same line across only the largest is a pivot.
            order = alone[np.argsort(-np.abs(left.data[alone]), kind="stable")]
            taken = order[np.unique(across[order], return_index=True)[1]]
            for k in (0, 1):
                chosen[k].append(left.coords[k][taken])
            gone = [np.zeros(n, bool) for n in left.shape]
            for k in (0, 1):
                gone[k][left.coords[k][taken]] = True
            kept = ~(gone[0][left.coords[0]] | gone[1][left.coords[1]])
            at = tuple(x[kept] for x in left.coords)
            left = sp.coo_array((left.data[kept], at), left.shape)
        if sum(map(len, chosen[0])) == number or not left.nnz:
            break
    return np.concatenate(chosen[0]), np.concatenate(chosen[1]), sp.csr_array(left)


def _in_parts(matrix: sp.csr_array) -> list[Pivots]:
    """The pivots of the parts that share no row and no column."""
    (m, n), at = matrix.shape, sp.coo_array(matrix)
    graph = sp.coo_array((np.ones(at.nnz), (at.coords[0], at.coords[1] + m)), (m + n, m + n))
    number, labels = connected_components(graph, directed=False)
    ours = [np.argsort(x, kind="stable") for x in (labels[:m], labels[m:])]
    counts = [np.bincount(x, minlength=number) for x in (labels[:m], labels[m:])]
    starts = [np.cumsum(x) - x for x in counts]
    both = (counts[0] > 0) & (counts[1] > 0)
    shapes, found = np.stack(counts, 1), []
    for shape in np.unique(shapes[both], axis=0):
        labels_of = np.flatnonzero(both & (shapes == shape).all(1))
        lines = [
            order[start[labels_of][:, None] + np.arange(size)]
            for order, start, size in zip(ours, starts, shape, strict=True)
        ]
        if max(shape) > _DENSE:
            for rows, columns in zip(*lines, strict=True):
                one, other = _of_large_part(matrix[rows][:, columns])
                found.append((rows[one], columns[other]))
            continue
        at_once = max(1, MOST_ELEMENTS // int(np.prod(shape)) // 8)
        for first in range(0, len(labels_of), at_once):
            rows, columns = (x[first : first + at_once] for x in lines)
            found.append(_of_small_parts(matrix, rows, columns))
    return found


def _of_small_parts(matrix: sp.csr_array, rows: np.ndarray, columns: np.ndarray) -> Pivots:
    """The pivots of many small parts of one shape, by elimination with the largest pivot."""
    number, height, width = len(rows), rows.shape[1], columns.shape[1]
    place = [np.empty(n, int) for n in matrix.shape]
    part = np.full(matrix.shape[0], -1)
    for at, lines in zip(place, (rows, columns), strict=True):
        at[lines] = np.arange(lines.shape[1])
    part[rows] = np.arange(number)[:, None]
    elements = sp.coo_array(matrix[rows.ravel()])
    row, column = rows.ravel()[elements.coords[0]], elements.coords[1]
    dense = np.zeros((number, height, width))
    dense[part[row], place[0][row], place[1][column]] = elements.data
    found: list[Pivots] = []
    each = np.arange(number)
    for _ in range(min(height, width)):
        i, j = np.divmod(np.argmax(np.abs(dense).reshape(number, -1), axis=1), width)
        pivot = dense[each, i, j]
        ok = np.abs(pivot) > _LEAST
        if not ok.any():
            break
        found.append((rows[each, i][ok], columns[each, j][ok]))
        share = dense[each, :, j] / np.where(ok, pivot, 1)[:, None]
        dense = (
            dense - np.where(ok, 1, 0)[:, None, None] * share[:, :, None] * dense[each, i][:, None]
        )
        dense[each, i], dense[each, :, j] = 0, 0
    return tuple(np.concatenate(x) for x in zip(*found, strict=True))  # pyright: ignore


def _of_large_part(matrix: sp.csr_array) -> Pivots:
    """The pivots of a large part by SuperLU, and of what its small pivots leave over."""
    matched = maximum_bipartite_matching(sp.csr_matrix(matrix), perm_type="column")
    rows = np.flatnonzero(matched >= 0)
    columns = matched[rows]
    # What follows a small pivot is eliminated by its row, so the others are factored again alone.
    small = True
    while small and rows.size:
        factors = _factored(matrix[rows][:, columns])
        if factors is None or factors.nnz > MOST_ELEMENTS:
            raise TooFull
        good = np.abs(factors.U.diagonal()) > _SMALL_PIVOT
        rows, columns = (
            x[np.argsort(order)][good]
            for x, order in ((rows, factors.perm_r), (columns, factors.perm_c))
        )
        small = not good.all()
    if not rows.size:
        i = np.argmax(np.abs(matrix.data))
        rows, columns = (x[i : i + 1] for x in sp.coo_array(matrix).coords)
    if rows.size == min(matrix.shape):
        return rows, columns
    return _with_more(matrix, (rows, columns))


def _factored(matrix: sp.csr_array) -> Any:
    """The factors of a matrix, to whose diagonal roundoff in general position is added. The
    roundoff itself may cancel, so it is tried with other sizes; `None` if that does not help."""
    for size in (1 / 16, 1 / 8, 1 / 4):
        general = 1 + np.sin(np.arange(1.0, matrix.shape[0] + 1) ** 2) / 2
        added = sp.diags_array(size * _LEAST * general)
        try:
            return spla.splu(sp.csc_array(matrix + added))
        except RuntimeError:  # exactly singular
            continue
    return None
