"""Dense output for solvers that can be evaluated anywhere within a step."""

import functools as ft
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree
from numpy.polynomial import chebyshev

from ..._custom_types import RealScalarLike, Y
from ..._time import nonzero_length
from ..._tree import tree_sub


@final
class ChebyshevInterpolation(dfx.AbstractLocalInterpolation):
    """The polynomial through the states at the Chebyshev points of a step, as a Chebyshev series.

    A series is used instead of the barycentric formula because it has no division by zero at the
    points: the root finder of an event needs a time derivative that exists everywhere.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    coefficients: PyTree[Array]  # each leaf with a leading axis

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        x = jnp.asarray(2 * (t0 - self.t0) / nonzero_length(self.t0, self.t1) - 1)
        return jtu.tree_map(lambda c: _clenshaw(c, x.astype(c.dtype)), self.coefficients)


def series(states: Callable[[Array], Y], count: int, dtype: Any) -> PyTree[Array]:
    """The coefficients for `states`, a function of the fraction of the step."""
    return coefficients(jax.vmap(states)(fractions(count, dtype)))


def fractions(count: int, dtype: Any) -> Array:
    """The Chebyshev points of the second kind on [0, 1]."""
    return jnp.asarray(chebyshev_points(count), dtype)


def coefficients(values: PyTree[Array]) -> PyTree[Array]:
    """The coefficients of the series through `values`, which are stacked over the points."""
    return jtu.tree_map(lambda v: multiply(to_coefficients(v.shape[0]), v), values)


def integrals(values: Array) -> Array:
    """The integrals of the polynomial through `values`, from the first point to each point."""
    return multiply(_integration(values.shape[0]), values)


def at(where: tuple[float, ...], values: Array) -> Array:
    """The polynomial through `values` at the fractions `where`."""
    return multiply(_evaluation(values.shape[0], where), values)


def multiply(table: np.ndarray, x: Array) -> Array:
    """`table @ x`, never in the reduced precision of accelerators for single-precision products."""
    weights = jnp.asarray(table, x.dtype)
    return jnp.tensordot(weights, x, axes=1, precision=lax.Precision.HIGHEST)


@ft.cache
def chebyshev_points(count: int) -> np.ndarray:
    n = count - 1
    return np.sin(np.pi * np.arange(count) / (2 * n)) ** 2  # (1 - cos(pi k / n)) / 2


@ft.cache
def to_coefficients(count: int) -> np.ndarray:
    """The matrix from values at the points to the coefficients of the series."""
    return np.linalg.inv(chebyshev.chebvander(2 * chebyshev_points(count) - 1, count - 1))


@ft.cache
def _evaluation(count: int, where: tuple[float, ...]) -> np.ndarray:
    return chebyshev.chebvander(2 * np.asarray(where) - 1, count - 1) @ to_coefficients(count)


@ft.cache
def _integration(count: int) -> np.ndarray:
    """The matrix from values at the points to integrals from the first point to each."""
    # The factor 1/2 is `ds/dx`.
    antiderivative = chebyshev.chebint(np.eye(count), lbnd=-1, axis=0) / 2
    basis = chebyshev.chebvander(2 * chebyshev_points(count) - 1, count)
    matrix = basis @ antiderivative @ to_coefficients(count)
    matrix[0] = 0.0  # exactly
    return matrix


def _clenshaw(coefficients: Array, x: Array) -> Array:
    b1 = b2 = jnp.zeros_like(coefficients[0])
    for c in coefficients[:0:-1]:
        b1, b2 = c + 2 * x * b1 - b2, b1
    return coefficients[0] + x * b1 - b2
