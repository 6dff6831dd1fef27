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

import jax.lax as lax
import jax.numpy as jnp
from jax import vmap
from jaxtyping import Array, Inexact

from .chebyshev import at, fractions, integrals
from .sweeps import Increment, Path

# Steps of RK4 for `d`. Their truncation error is relative to the estimate: 4 steps give two digits.
_SUBSTEPS = 4


def estimate(increment: Increment, path: Path) -> Inexact[Array, " n"]:
    """The exact state minus the path's, at the end of the step."""
    real = jnp.finfo(path.dtype).dtype
    values = vmap(increment)(fractions(path.shape[0], real), path)
    rho = path[0] + integrals(values) - path
    # The stages of all substeps: at their starts, midpoints and ends.
    places = tuple(i / (2 * _SUBSTEPS) for i in range(2 * _SUBSTEPS + 1))
    states, fields = at(places, path + rho), at(places, values)
    times = jnp.asarray(places, real)

    def slope(index: Array | int, d: Array) -> Array:
        return increment(times[index], states[index] + d) - fields[index]

    def substep(d: Array, start: Array) -> tuple[Array, None]:
        h = 1 / _SUBSTEPS
        k1 = slope(start, d)
        k2 = slope(start + 1, d + h / 2 * k1)
        k3 = slope(start + 1, d + h / 2 * k2)
        k4 = slope(start + 2, d + h * k3)
        return d + h / 6 * (k1 + 2 * (k2 + k3) + k4), None

    d, _ = lax.scan(substep, jnp.zeros_like(path[0]), 2 * jnp.arange(_SUBSTEPS))
    return rho[-1] + d
