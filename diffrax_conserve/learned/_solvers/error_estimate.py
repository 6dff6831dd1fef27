r"""The error of a path through a step, computed from its defect.

Let $p$ be the polynomial path, $F$ the polynomial through $f(p)$ at its points, and
$\rho(c) = y_0 + h \int_0^c F - p(c)$ the integral of its defect. The error of the path is
$e = \rho + d$ with

$$d' = h \left(f(p + \rho + d) - F\right), \qquad d(0) = 0,$$

which is exact. $\rho$ is the change by a Picard sweep; by itself it underestimates the error by a
large factor where $h \|\partial f\|$ is large. No derivative of $f$ or of the network and no
difference of neighbouring points is needed, so the roundoff is that of the states.

To first order in $e$ that is the linearised defect equation $e' = \partial f\, e + (f(p) - p')$.
"""

from collections.abc import Callable

import jax.lax as lax
import jax.numpy as jnp
from jax import vmap
from jaxtyping import Array, Inexact

from ..._custom_types import RealScalarLike
from .chebyshev import at, fractions, integrals
from .sweeps import Increment, Path

# Steps of RK4 for `d`. Their truncation error is relative to the estimate: 4 steps give two digits.
_SUBSTEPS = 4


def estimate(increment: Increment, path: Path) -> Inexact[Array, " n"]:
    """The exact state minus that of the path, at the end of the step."""
    real = jnp.finfo(path.dtype).dtype
    values = vmap(increment)(fractions(path.shape[0], real), path)
    rho = path[0] + integrals(values) - path
    # The stages of all substeps: at their starts, midpoints and ends.
    places = tuple(i / (2 * _SUBSTEPS) for i in range(2 * _SUBSTEPS + 1))
    states, fields = at(places, path + rho), at(places, values)
    times = jnp.asarray(places, real)

    def slope(index: Array, d: Array) -> Array:
        return increment(times[index], states[index] + d) - fields[index]

    d, _ = rk4_errors(slope, jnp.zeros_like(path[0]), 1 / _SUBSTEPS, _SUBSTEPS)
    return rho[-1] + d


def rk4_errors(
    slope: Callable[[Array, Array], Array], start: Array, h: RealScalarLike | Array, substeps: int
) -> tuple[Array, Array]:
    """The error at the end, and after each substep, by RK4 steps of length `h` for `d' = slope`.

    The first argument of `slope` counts half substeps."""

    def substep(d: Array, i: Array) -> tuple[Array, Array]:
        k1 = slope(i, d)
        k2 = slope(i + 1, d + h / 2 * k1)
        k3 = slope(i + 1, d + h / 2 * k2)
        k4 = slope(i + 2, d + h * k3)
        d = d + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return d, d

    return lax.scan(substep, start, 2 * jnp.arange(substeps))
