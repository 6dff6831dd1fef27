r"""Collocation on the Chebyshev points of a step, by correction sweeps, and the error of a path.

A path $u$ through a step is stored as its states at the fractions $c_i$, one row each. Integrals
are those of the polynomial through the increments $h f$.
"""

from collections.abc import Callable

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Inexact

from ..._custom_types import Args, RealScalarLike, Y
from .chebyshev import at, fractions, integrals

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
