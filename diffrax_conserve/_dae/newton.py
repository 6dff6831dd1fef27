"""Newton's method for algebraic unknowns, from guesses that may be poor."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._constants import BACKTRACKING_FACTOR, TOLERANCE_IN_EPS
from .._large.klu import Places, RealFactor, SparseJacobian
from .._numerics.iterate import Solved, iterate, remaining_after_step
from .._numerics.lanes import any_lane, where_active
from .._numerics.linear import lu_factors, lu_solution
from .._numerics.roundoff import cancellation_terms
from .._numerics.rows import DenseRows
from .._tree import eps_of

# Newton's method ends after this many attempts at a correction. In a solve it needs a few. From a
# rough guess it may need many: if the voltage at a diode is guessed too large, each correction
# lowers it by one thermal voltage, of 0.025 V, because the current is exponential.
MAX_NEWTON_STEPS = 500
Residual = Callable[[Array], Array]


def solve_equilibrated(
    matrix: Float[Array, "m m"], b: Float[Array, "m *k"], leading: Bool[Array, "m m"] | None = None
) -> Float[Array, "m *k"]:
    """`matrix⁻¹ b`, computed in units in which all elements are about one. The unit of an equation
    is that of its `leading` elements alone, where one of them is not zero; by default of all."""
    if len(b) == 1:
        return b / matrix[0]
    rows, columns = lax.stop_gradient(row_and_column_scales(matrix, leading))
    scaled = matrix / rows[:, None] / columns
    return (jnp.linalg.solve(scaled, (b.T / rows).T).T / columns).T


def row_and_column_scales(
    jacobian: Float[Array, "m m"], leading: Bool[Array, "m m"] | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The units of equations and unknowns, in which no entry is larger than one."""
    sizes = jnp.abs(jacobian)
    rows = jnp.max(sizes, axis=1)
    if leading is not None:
        largest = jnp.max(jnp.where(leading, sizes, 0), axis=1)
        rows = jnp.where(largest > 0, largest, rows)
    return rows, jnp.max(sizes / rows[:, None], axis=0)


def implied_by_others(
    jacobian: Float[Array, "m n"], size: Float[Array, " n"]
) -> Float[Array, " n"]:
    """For each unknown the least change that the largest term of another one stands for, in one of
    the equations of both, if unknowns have these sizes; zero if there is no other."""
    slopes = jnp.abs(jacobian)
    terms = slopes * size
    is_largest = jnp.arange(len(size)) == jnp.argmax(terms, axis=1, keepdims=True)
    largest = jnp.max(terms, axis=1, keepdims=True)
    second = jnp.max(jnp.where(is_largest, 0, terms), axis=1, keepdims=True)
    others = jnp.where(is_largest, second, largest)
    least = _least_changes(slopes, jnp.where(others > 0, others, jnp.inf))
    return jnp.where(least < jnp.inf, least, 0)


def _least_changes(slopes: Float[Array, "m n"], terms: Float[Array, "m #n"]) -> Float[Array, " n"]:
    """For each unknown the least change that a term of one of its equations stands for."""
    changes = jnp.where(slopes > 0, terms / jnp.where(slopes > 0, slopes, 1), jnp.inf)
    return jnp.min(changes, axis=0, initial=jnp.inf)


class _Factored(NamedTuple):
    """The LU decomposition of a Jacobian in the units of its rows and columns. A single number is
    its own: a call of LAPACK would take most of the time of a small solve."""

    lu: tuple[Float[Array, "m m"], Int[Array, " m"]]
    rows: Float[Array, " m"]
    columns: Float[Array, " m"]

    jacobian: Float[Array, "m m"]

    @classmethod
    def at(cls, residual: Residual, z: Float[Array, " m"]) -> "_Factored":
        jacobian = jax.jacfwd(residual)(z)
        rows, columns = row_and_column_scales(jacobian)
        scaled = jacobian / rows[:, None] / columns
        one = scaled, jnp.zeros(1, jnp.int32)
        return cls(one if rows.size == 1 else lu_factors(scaled), rows, columns, jacobian)

    def correction(self, residual: Float[Array, " m"], after: Any = None) -> Float[Array, " m"]:
        del after
        right = residual / self.rows
        one = right.size == 1
        return -(right / self.lu[0][0] if one else lu_solution(self.lu, right)) / self.columns

    def freed(self, last: Float[Array, " m"]) -> Float[Array, " m"]:
        return last

    def regular(self) -> Bool[Array, ""]:
        pivots = jnp.abs(jnp.diagonal(self.lu[0]))  # of columns whose largest entry was one
        return jnp.all(pivots > TOLERANCE_IN_EPS * eps_of(pivots))

    def implied_sizes(self, size: Float[Array, " m"]) -> Float[Array, " m"]:
        """For each unknown the least change that the largest term of one of its equations stands
        for, if unknowns have these sizes."""
        slopes = jnp.abs(self.jacobian)
        return _least_changes(slopes, jnp.max(slopes * size, axis=1, keepdims=True, initial=0))


class _SparseFactored(NamedTuple):
    """As `_Factored`, for many unknowns. A correction is computed `after` another, and the factor
    is freed with the last."""

    places: Places
    values: Float[Array, " k"]
    factor: RealFactor

    def correction(self, residual: Float[Array, " m"], after: Any = None) -> Float[Array, " m"]:
        return -self.factor.solve(residual, after)

    def freed(self, last: Float[Array, " m"]) -> Float[Array, " m"]:
        return self.factor.freed(last, last)[0]

    def regular(self) -> Bool[Array, ""]:
        return self.factor.is_regular

    def implied_sizes(self, size: Float[Array, " m"]) -> Float[Array, " m"]:
        rows, columns, slopes = self.places.rows, self.places.columns, jnp.abs(self.values)
        terms = jax.ops.segment_max(slopes * size[columns], rows, self.places.size)
        least = jnp.where(slopes > 0, terms[rows] / jnp.where(slopes > 0, slopes, 1), jnp.inf)
        return jax.ops.segment_min(least, columns, self.places.size)


class SparseNewton:
    """Newton's method with a sparse Jacobian, and the linear systems of the derivative. `sizes` are
    those of the terms of the residual."""

    def __init__(self, found: SparseJacobian):
        self.found, self.places = found, Places(found.rows, found.columns, found.shape[0])

    def at(self, residual: Residual, z: Float[Array, " m"]) -> _SparseFactored:
        values = self.found.values(residual, z)
        return _SparseFactored(self.places, values, RealFactor(self.places, values))

    def at_roundoff(self, residual: Residual, z: Float[Array, " m"]) -> Bool[Array, ""]:
        sizes = self.places.matvec(jnp.abs(self.found.values(residual, z)), jnp.abs(z))
        return jnp.all(jnp.abs(residual(z)) <= TOLERANCE_IN_EPS * eps_of(z) * sizes)

    def jacobian(self, residual: Residual) -> Residual:
        return lambda z: self.found.values(residual, z)

    def solve(self, values: Float[Array, " k"], b: Float[Array, " m"]) -> Float[Array, " m"]:
        return self.places.solve(values, b)


def least_exact(dtype: Any) -> float:
    """The least number of which a change by roundoff does not underflow."""
    info = jnp.finfo(dtype)
    return float(info.tiny) / float(info.eps)


def algebraic_newton(
    residual: Residual, z: Float[Array, " m"], sparse: SparseNewton | None = None
) -> Solved:
    """A root of the residual near `z`, as exact as rounding lets us see; NaN if none is found."""
    z, at_rest, num_iterations, is_root = error_oriented_newton(residual, z, sparse)
    found = at_rest & is_root
    return Solved(jnp.where(found, z, jnp.nan), found, num_iterations)


def _at_roundoff(
    residual: Residual, z: Float[Array, " m"], sparse: SparseNewton | None
) -> Bool[Array, ""]:
    """Whether a residual is one by roundoff of its terms."""
    if sparse is not None:
        return sparse.at_roundoff(residual, z)
    g, jacobian, cancellation = cancellation_terms(residual, z)
    limit = TOLERANCE_IN_EPS * eps_of(z)
    scale = DenseRows(jacobian).absolute_matvec(jnp.abs(z)) + cancellation
    # The square of a term may be infinite, and then so is the scale.
    return jnp.all((jnp.abs(g) <= limit * scale) & (scale < jnp.inf))


def error_oriented_newton(
    residual: Residual, z: Float[Array, " m"], sparse: SparseNewton | None = None
) -> Solved:
    """Damped Newton's method with the natural monotonicity test (P. Deuflhard, *Newton Methods for
    Nonlinear Problems*, Springer 2004, 3.3).

    A correction times the damping factor `λ` is accepted if the simplified correction after it,
    computed with the same Jacobian, is at most `1 - λ/2` times as long. So the test compares
    changes of `z`, and does not depend on the units of the equations. A correction that is NaN is
    not accepted.

    The iteration comes to rest where corrections have converged, or where none helps, perhaps
    because of roundoff: whether that is a root, which `aux` tells, the residual decides. The result
    is NaN if corrections become infinite, or the Jacobian is singular.
    """
    eps = eps_of(z)
    linearised = _Factored.at if sparse is None else sparse.at

    def advance(now: Any, tests_left: Array) -> tuple[Any, Array]:
        # The unknowns, the damping factor to try next, whether all larger ones have been tried at
        # these unknowns, and whether they have converged.
        z, damping, larger_tried, _ = now
        factored = linearised(residual, z)
        correction = factored.correction(residual(z))
        trial = z + damping * correction
        simplified = factored.freed(factored.correction(residual(trial), correction))
        size = jnp.maximum(jnp.abs(z), jnp.abs(trial))
        # An unknown near zero is compared with the change that the largest term of one of its
        # equations stands for, whatever the units of the others are.
        size = size + eps**0.5 * factored.implied_sizes(size)
        size = jnp.where(size > 0, jnp.maximum(size, least_exact(z.dtype)), 1)
        norm = lambda x: jnp.max(jnp.abs(x) / size, initial=0)  # noqa: E731
        length, simplified_length = norm(correction), norm(simplified)
        # Where the linear model is exact, the simplified correction is `1 - damping` times as long.
        # We ask for half of that gain.
        better = simplified_length <= (1 - damping / 2) * length
        # The later corrections shrink at least by the same ratio. So the one that would follow both
        # is at most `simplified_length² / length`, which is roundoff here.
        converged = better & (damping == 1) & (simplified_length**2 <= eps * length)
        # If a change of at most `√ε` does not help, it is probably roundoff that keeps it from
        # helping. From a poor guess the damping factor may be tiny, because for a diode at rest the
        # correction is longer than the voltage by the ratio of the currents; and it may be too
        # small for the next correction.
        too_short = damping * BACKTRACKING_FACTOR * length <= eps**0.5
        going = (length < jnp.inf) & (better | ~too_short | ~larger_tried)
        # Where no damping helps, roundoff of one unknown may hide that another still gains by the
        # whole correction.
        z = jnp.where(better, trial, jnp.where(going, z, z + correction))
        z = z + jnp.where(converged, simplified, 0)
        less, more = jnp.minimum(damping / BACKTRACKING_FACTOR, 1), damping * BACKTRACKING_FACTOR
        damping = jnp.where(better, less, jnp.where(too_short, 1, more))
        larger_tried = (damping == 1) | (larger_tried & ~better)
        at_rest = (converged | (~going & (length < jnp.inf))) & factored.regular()
        moved = where_active(tests_left, (z, damping, larger_tried, converged), now)
        return moved, remaining_after_step(at_rest, going, tests_left)

    start = z, jnp.ones((), z.dtype), jnp.asarray(True), jnp.asarray(False)
    (z, *_, converged), at_rest, count, _ = iterate(advance, start, max_steps=MAX_NEWTON_STEPS)
    unsure = at_rest & ~converged
    at_roundoff = ft.partial(_at_roundoff, residual, z, sparse)
    is_root = converged | lax.cond(any_lane(unsure), at_roundoff, lambda: jnp.asarray(False))
    return Solved(jnp.where(at_rest, z, jnp.nan), at_rest, count, is_root)
