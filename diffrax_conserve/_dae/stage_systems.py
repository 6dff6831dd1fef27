"""The linear systems of a step of `Radau`: with dense matrices, or with sparse ones by KLU.

Both have the matrices `share ∂F/∂y' + ∂F/∂y`, at the start of the step.
"""

import functools as ft
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._constants import MIN_KLU, WARN_DENSE
from .._large.klu import (
    Factor,
    Places,
    RealFactor,
    SparseJacobian,
    available,
    sparse_jacobian,
    why_not,
)
from .._numerics.linear import computed_after, lu_factors, lu_solution
from .newton import solve_equilibrated

# `F(t, y, y')` of vectors.
Residual = Callable[..., Array]
Solve = Callable[..., Array]
Freed = Callable[..., tuple[Array, ...]]


def _stages_solution(matrix: Float[Array, "N N"], b: Float[Array, " N"]) -> Float[Array, " N"]:
    """The solution of a linear system with the matrix of the three stages.

    The unit of an unknown without slopes, such as a force, may have any ratio to those of the
    others, and must not decide what is lost by rounding. So, as in `Structure.equilibrated_units`,
    each row of an equation with slopes is divided by its largest element of an unknown with slopes,
    the others by their largest, and then each column by its largest element. The blocks off the
    diagonal are `∂F/∂y'` alone, up to a factor.
    """
    n = len(b) // 3
    has_slopes = matrix[:n, n : 2 * n] != 0
    equations, unknowns = (jnp.tile(jnp.any(has_slopes, axis=axis), 3) for axis in (1, 0))
    return solve_equilibrated(matrix, b, equations[:, None] & unknowns)


class DenseSystems(NamedTuple):
    by_y: Float[Array, "n n"]
    by_slope: Float[Array, "n n"]

    # How a linear system with the matrix of the stages is solved, and how the matrix is computed.
    stages_solution = staticmethod(_stages_solution)
    stages_jacobian = staticmethod(jax.jacfwd)

    @classmethod
    def at(cls, residual: Residual, t: Any, y: Array, slope: Array) -> "DenseSystems":
        return cls(*lax.stop_gradient(jax.jacfwd(residual, (1, 2))(t, y, slope)))

    def sizes_of_terms(self, y: Array, slope: Array) -> Float[Array, " n"]:
        return jnp.abs(self.by_y) @ jnp.abs(y) + jnp.abs(self.by_slope) @ jnp.abs(slope)

    def solvers(self, real: Any, pair: Any) -> tuple[Solve, Solve, Freed]:
        """The solutions of linear systems with a real and with a complex share, and a function that
        ends them: it returns its results once the `last` real solution is known.

        A solution of `b` is computed `after` another, on which `b` must depend otherwise."""
        first = lu_factors(real * self.by_slope + self.by_y)
        second = lu_factors(computed_after(pair * self.by_slope + self.by_y, first[0]))

        def solve(factors: tuple[Array, Array], b: Array, after: Array | None = None) -> Array:
            return lu_solution(factors, computed_after(b, after))

        freed = lambda last, *results: computed_after(results, last)  # noqa: E731
        return ft.partial(solve, first), ft.partial(solve, second), freed


class SparseSystems(NamedTuple):
    """The values in the places of both derivatives together."""

    places: "_Together"
    by_y: Float[Array, " k"]
    by_slope: Float[Array, " k"]

    @property
    def stages_solution(self) -> Callable[[Array, Array], Array]:
        return self.places.stages_solution

    @property
    def stages_jacobian(self) -> Callable[[Any], Any]:
        return self.places.stages_jacobian

    def sizes_of_terms(self, y: Array, slope: Array) -> Float[Array, " n"]:
        product = self.places.of_both.matvec
        return product(jnp.abs(self.by_y), jnp.abs(y)) + product(
            jnp.abs(self.by_slope), jnp.abs(slope)
        )

    def solvers(self, real: Any, pair: Any) -> tuple[Solve, Solve, Freed]:
        places = self.places.of_both
        # The factor of the test is that of the real matrix too, whose solution is the real part.
        first = RealFactor(places, real * self.by_slope + self.by_y)
        if places.permutation is None:
            return first.solve, first.solve, first.freed
        # If a matrix is singular for one share, it is for all: no pencil is so for one that a
        # step size happens to have.
        known = jnp.where(first.is_regular, self.by_y, jnp.nan)
        second = Factor(places, pair * self.by_slope + known)

        def freed(last: Array, *results: Array) -> tuple[Array, ...]:
            return first.freed(last, *second.freed(last, *results))

        return first.solve, second.solve, freed


class _Together:
    """The places of the elements of both derivatives. It is equal only to itself, as those are."""

    def __init__(self, by_y: SparseJacobian, by_slope: SparseJacobian, size: int):
        self.by_y, self.by_slope = by_y, by_slope
        rows = np.concatenate([by_y.rows, by_slope.rows])
        self.of_both = Places(rows, np.concatenate([by_y.columns, by_slope.columns]), size)

    def at(self, residual: Residual, t: Any, y: Array, slope: Array) -> SparseSystems:
        t, y, slope = lax.stop_gradient((t, y, slope))
        by_y = self.by_y.values(lambda y: residual(t, y, slope), y)
        by_slope = self.by_slope.values(lambda slope: residual(t, y, slope), slope)
        return SparseSystems(
            self, self._placed(self.by_y, by_y), self._placed(self.by_slope, by_slope)
        )

    def _placed(self, found: SparseJacobian, values: Array) -> Float[Array, " k"]:
        index = self.of_both.index(found.rows, found.columns)
        return jnp.zeros(len(self.of_both.numbers), values.dtype).at[index].set(values)

    @ft.cached_property
    def _stages(self) -> tuple[SparseJacobian, Places]:
        """The Jacobian of the stages: with `∂F/∂y'` between any two of them, and `∂F/∂y` in each.
        A derivative of a step alone needs it."""
        n, stages = self.of_both.size, range(3)
        parts = [
            (x.rows + i * n, x.columns + j * n)
            for i in stages
            for j in stages
            for x in (self.by_y, self.by_slope)
            if i == j or x is self.by_slope
        ]
        rows, columns = (np.concatenate(x) for x in zip(*parts, strict=True))
        places = Places(rows, columns, 3 * n)
        return SparseJacobian(places.rows, places.columns, (3 * n, 3 * n)), places

    def stages_solution(self, values: Array, b: Array) -> Array:
        return self._stages[1].solve(values, b)

    def stages_jacobian(self, residual: Callable[[Array], Array]) -> Callable[[Array], Array]:
        return lambda x: self._stages[0].values(residual, x)


@ft.lru_cache(256)
def _together(by_y: SparseJacobian, by_slope: SparseJacobian, size: int) -> _Together:
    return _Together(by_y, by_slope, size)


def systems_at(residual: Residual, t: Any, y: Array, slope: Array) -> DenseSystems | SparseSystems:
    """The linear systems with the derivatives at a time, a state and slopes: sparse ones where that
    is faster."""
    n, dense = y.size, ft.partial(DenseSystems.at, residual, t, y, slope)
    if n < MIN_KLU:
        return dense()
    if not available(y.dtype):
        if n >= WARN_DENSE and y.dtype == jnp.float64 and why_not():
            warnings.warn(
                f"`Radau` solves dense linear systems with {n} unknowns, because {why_not()}",
                stacklevel=2,
            )
        return dense()
    t, y, slope = lax.stop_gradient((t, y, slope))
    by_y = sparse_jacobian(lambda y: residual(t, y, slope), y)
    by_slope = sparse_jacobian(lambda slope: residual(t, y, slope), slope)
    if by_y is None or by_slope is None:
        return dense()
    both = _together(by_y, by_slope, n)
    if 4 * len(both.of_both.numbers) > n * n:
        return dense()
    return both.at(residual, t, y, slope)
