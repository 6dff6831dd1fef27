"""The iteration of Hairer, Lubich and Wanner, IV.4, for candidates that are as close to the
manifold as the local error of a step. It moves along the gradients at the candidate.
The iterations are in `iterate`, the bounds in `within_bounds`, the derivative in `implicit`."""

from typing import final

from jaxtyping import Array, Float

from .._numerics.problem import Problem
from .._numerics.report import ProjectionInfo
from .options import NEWTON_OPTIONS
from .within_bounds import AbstractNewton, along_gradients


@final
class SimplifiedNewton(AbstractNewton):
    r"""Projects along the gradients at the candidate, which is for candidates near the manifold.

    For the candidate $\hat y$, with $G = \partial g/\partial y\,(\hat y)$ and the metric $M$,
    solves $g(y) = 0$, $y = \hat y + M^{-1} G^\top \lambda$, for the multipliers
    $\lambda \in \mathbb{R}^m$ by

    $$\lambda \leftarrow \lambda - (G(y) M^{-1} G^\top)^{-1} g(y).$$

    Two iterations are enough for nearly every step of an integrator. For up to four constraints the
    matrix is evaluated at each iterate, as it is written here, so this is Newton's method. If they
    are not met after six iterations, the plane of the corrections may miss the manifold, as on a
    circular orbit: from then on the corrections are along the gradients at each iterate. For more
    than four the matrix at the candidate is factored once, as in the simplified Newton iteration,
    and after six iterations that at each iterate, or for more than sixteen at every sixth. So after
    a long step it takes more iterations, and fails sooner. For candidates far away use
    [`diffrax_conserve.Newton`][].

    The derivative, by the implicit function theorem for $\lambda$, is that of a projection along
    the gradients at the candidate. It is exact for the returned state if all corrections were along
    these. A constraint whose gradient has an angle to the span of the others with a sine of at most
    $\varepsilon^{1/4}$, which is 1e-4 in float64, takes no part in the derivative, or little if
    there are more than four: see [Derivatives near a circular
    orbit][derivatives-near-a-circular-orbit].

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        projection = dfc.SimplifiedNewton(max_steps=10)
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), energy, projection=projection)
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, Section IV.4,
        equations (4.4) to (4.6).
    """

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        bounds = self.bounds(problem.like)
        y, ok, count, known = along_gradients(bounds, problem, candidate, max_steps=self.max_steps)
        y = y if bounds is None else bounds.clip(y)
        return y, problem.report(candidate, y, count, ok=ok, linearised=known)


SimplifiedNewton.__init__.__doc__ = NEWTON_OPTIONS
