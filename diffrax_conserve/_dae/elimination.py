"""How the slopes are found that constraints need: by constants, in turn, or together.

Of most equations each contains one slope, so that elimination is division. Only slopes on which a
constraint depends are found. With all of them, the constraints of a linkage with 35 unknowns solved
for 27 slopes at once, and each derivative of such a solution costs as much as many of them.
"""

# The types of scipy's sparse arrays are incomplete.
# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false, reportOptionalIterable=false

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
from scipy.sparse.csgraph import maximum_bipartite_matching

from .._numerics.implicit import root
from .newton import algebraic_newton, solve_equilibrated


class Round(NamedTuple):
    """The equations that are solved, and the slopes for which they are solved."""

    equations: tuple[int, ...]
    slopes: tuple[int, ...]


NO_ROUND = Round((), ())


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
    - `levels`: equations that are linear in the slopes, each with one that is not yet known.
    - `coupled`: the equations that are solved together for the others.
    - `as_given`: whether none of them is the derivative of a constraint.
    """

    constant: SparseMatrix | None = None
    levels: tuple[Round, ...] = ()
    coupled: Round = NO_ROUND
    is_linear: bool = True
    as_given: bool = False

    def slopes(
        self, equations: Callable[[Array], Array], like: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The slopes; those that are not needed are zero."""
        slopes = jnp.zeros_like(like)
        if self.constant is not None:
            slopes = self.constant @ equations(slopes)
        for level in self.levels:
            rows, columns = (np.array(x, int) for x in level)
            one = jnp.zeros_like(like).at[columns].set(1)
            left, by_slope = jax.jvp(equations, (slopes,), (one,))
            slopes = slopes.at[columns].set(-left[rows] / by_slope[rows])
        if self.coupled.slopes:
            slopes = self._together(equations, slopes)
        return slopes

    def _together(
        self, equations: Callable[[Array], Array], slopes: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        rows, columns = (np.array(x, int) for x in self.coupled)

        def residual(some: Array) -> Array:
            return equations(slopes.at[columns].set(some))[rows]

        begin = jnp.zeros(columns.size, slopes.dtype)
        if self.is_linear:
            both = jax.jacfwd(lambda some: 2 * (residual(some),), has_aux=True)
            matrix, value = both(begin)
            found = solve_equilibrated(matrix, -value)
        else:
            newton = ft.partial(algebraic_newton, residual)
            found = root(residual, newton, begin, solve_equilibrated).y
        return slopes.at[columns].set(found)


def elimination(
    places: Bool[np.ndarray, "n n"],
    selected: Round,
    needed: Bool[np.ndarray, " n"],
    differentiated: tuple[int, ...],
    *,
    is_linear: bool,
    mass: np.ndarray | None,
) -> Elimination:
    """How the needed ones of the slopes that are selected follow. The matrix `∂F/∂y'` has elements
    in these places, and, where no constraint is differentiated, may be a constant `mass`."""
    rows, columns = _closed(places, selected, needed)
    as_given = not np.isin(rows, differentiated).any()
    kind = Elimination(is_linear=is_linear, as_given=as_given)
    if as_given and is_linear and mass is not None and rows.size:
        inverse = np.zeros(mass.shape)
        inverse[np.ix_(columns, rows)] = -np.linalg.inv(mass[np.ix_(rows, columns)])
        return dataclasses.replace(kind, constant=SparseMatrix(inverse))
    levels, unknown = [], np.isin(np.arange(len(places)), columns)
    while is_linear:
        unsolved = places & unknown
        single = rows[unsolved[rows].sum(1) == 1]
        if not single.size:
            break
        found, first = np.unique(unsolved[single].argmax(1), return_index=True)
        levels.append(_round(single[first], found))
        unknown[found] = False
    solved = np.array([i for one in levels for i in one.equations], int)
    coupled = _round(np.setdiff1d(rows, solved), np.flatnonzero(unknown))
    return dataclasses.replace(kind, levels=tuple(levels), coupled=coupled)


def _round(rows: np.ndarray, columns: np.ndarray) -> Round:
    return Round(tuple(rows.tolist()), tuple(columns.tolist()))


def _closed(
    places: Bool[np.ndarray, "n n"], selected: Round, needed: Bool[np.ndarray, " n"]
) -> tuple[np.ndarray, np.ndarray]:
    """The fewest of the equations that are selected that determine the slopes that are needed, and
    these slopes with those that come with them. Each slope is matched with an equation that
    contains it, which asks for all slopes in it."""
    rows, columns = (np.array(x, int) for x in selected)
    part = places[np.ix_(rows, columns)]
    matched = maximum_bipartite_matching(sp.csr_array(part), perm_type="row")
    asked, before = needed[columns], None
    while not np.array_equal(asked, before):
        before, asked = asked, asked | part[matched[asked]].any(0)
    return rows[matched[asked]], columns[asked]
