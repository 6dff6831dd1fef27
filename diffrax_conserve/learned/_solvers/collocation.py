r"""Collocation on the Chebyshev points of a step: dense output, correction sweeps, errors of paths.

A path $u$ through a step is stored as its states at the fractions $c_i$, one row each. Integrals
are those of the polynomial through the increments $h f$.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Inexact, PyTree
from numpy.polynomial import chebyshev

from ..._custom_types import Args, RealScalarLike, Y
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


# ---- Sweeps ----

Path = Inexact[Array, "nodes n"]
# `(fraction of the step, state as a vector) -> h f`.
Increment = Callable[[Array, Inexact[Array, " n"]], Inexact[Array, " n"]]


def increment(
    terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, like: Y, args: Args
) -> Increment:
    """The vector field of the term times the length of the step."""
    control, length = terms.contr(t0, t1), jnp.asarray(t1 - t0)
    _, unravel = ravel_pytree(like)

    def evaluate(fraction: Array, vector: Array) -> Array:
        t = t0 + fraction.astype(length.dtype) * length
        change, _ = ravel_pytree(terms.vf_prod(t, unravel(vector), args, control))
        return change.astype(vector.dtype)

    return evaluate


def correct(increment: Increment, path: Path, count: int) -> tuple[Path, Inexact[Array, " n"]]:
    r"""The path after `count` Picard sweeps `u ← y0 + h ∫ f(u)`, at all points in parallel, and
    the change by the last of them at the end of the step."""
    previous = path
    for _ in range(count):
        values = jax.vmap(increment)(_fractions(path), path)
        previous, path = path, path[0] + integrals(values)
    return path, path[-1] - previous[-1]


def _fractions(path: Path) -> Array:
    return fractions(path.shape[0], jnp.finfo(path.dtype).dtype)


# Steps of RK4 for `d`. Their truncation error is relative to the estimate: 4 steps give two digits.
_SUBSTEPS = 4


def estimate(increment: Increment, path: Path) -> Inexact[Array, " n"]:
    r"""The exact state minus that of the path, at the end of the step, computed from its defect.

    Let $p$ be the polynomial path, $F$ the polynomial through $f(p)$ at its points, and
    $\rho(c) = y_0 + h \int_0^c F - p(c)$ the integral of its defect. The error of the path is
    $e = \rho + d$ with

    $$d' = h \left(f(p + \rho + d) - F\right), \qquad d(0) = 0,$$

    which is exact. $\rho$ is the change by a sweep; alone it underestimates the error by a large
    factor where $h \|\partial f\|$ is large. Nothing is differentiated, so the roundoff is that of
    the states.
    """
    values = jax.vmap(increment)(_fractions(path), path)
    rho = path[0] + integrals(values) - path
    # The stages of all substeps: at their starts, midpoints and ends.
    places = tuple(i / (2 * _SUBSTEPS) for i in range(2 * _SUBSTEPS + 1))
    states, fields = at(places, path + rho), at(places, values)
    times = jnp.asarray(places, jnp.finfo(path.dtype).dtype)

    def slope(index: Array, d: Array) -> Array:
        return increment(times[index], states[index] + d) - fields[index]

    d, _ = rk4_errors(slope, jnp.zeros_like(path[0]), 1 / _SUBSTEPS, _SUBSTEPS)
    return rho[-1] + d


def rk4_errors(
    slope: Callable[[Array, Array], Array], start: Array, h: RealScalarLike | Array, substeps: int
) -> tuple[Array, Array]:
    """The error at the end, and after each substep, by RK4 steps of length `h` for `d' = slope`.

    The first argument of `slope` counts half substeps.
    """

    def substep(d: Array, i: Array) -> tuple[Array, Array]:
        k1 = slope(i, d)
        k2 = slope(i + 1, d + h / 2 * k1)
        k3 = slope(i + 1, d + h / 2 * k2)
        k4 = slope(i + 2, d + h * k3)
        d = d + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return d, d

    return lax.scan(substep, start, 2 * jnp.arange(substeps))
