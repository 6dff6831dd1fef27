"""Projection along the embedded error estimate, which conserves every linear integral."""

from typing import ClassVar, final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import AbstractProjection, Problem, ProjectionInfo
from .loop import project_along
from .options import check_options, option


@final
class Directional(AbstractProjection):
    r"""Projects along the error estimate of the wrapped solver, for one integral.

    For the candidate $\hat y$ and the error estimate $w$ of the step (in a Runge-Kutta method the
    difference from the embedded solution), it solves the scalar equation

    $$g(\hat y + \lambda w) = 0$$

    by Newton's method, from $\lambda = 0$ and with derivatives along $w$ only. Linear integrals
    that the wrapped solver conserves, as every Runge-Kutta method does, are constant along $w$ and
    thus also conserved after a projection on the energy, without a metric and without being listed
    in the manifold.

    Where $w$ is nearly tangent to the manifold, the correction is long, or does not exist and the
    projection fails. The order of the wrapped solver is kept if the angle between $w$ and the
    manifold does not vanish with the step size. At saved times inside a step and in dense output
    the direction is that of the step.

    Derivatives follow from the implicit function theorem for $\lambda$; they are NaN where the sine
    of the angle between $w$ and the manifold is below the cube root of roundoff.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        planets = dfc.systems.OuterSolarSystem()
        energy = planets.manifold["energy"]
        solver = dfc.ManifoldProjection(diffrax.Dopri5(), energy, projection=dfc.Directional())
        ```

    ??? cite "Reference"

        M. Calvo, D. Hernández-Abreu, J. I. Montijano and L. Rández, "On the preservation of
        invariants by explicit Runge-Kutta methods", *SIAM J. Sci. Comput.* 28 (2006), 868-885.
    """

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(50, static=True)
    metric: None = eqx.field(default=None, init=False)
    sees_step: ClassVar[bool] = True

    def __check_init__(self):
        check_options(self)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        size = problem.equations.magnitude.size
        if size != 1:
            raise ValueError(
                f"`Directional` moves along one direction, but `manifold` has {size} scalar "
                "constraints. Keep one integral, or pass `projection=SimplifiedNewton()`."
            )
        error = None if problem.step is None else problem.step.error
        if error is None:
            raise ValueError(
                "`Directional` moves along the error estimate of a step of the wrapped solver, but "
                "there is none. In a `ManifoldProjection` wrap a solver with an embedded method, "
                "such as `diffrax.Tsit5()`. Elsewhere pass `projection=Newton()`."
            )
        # Normalised: the result does not depend on the length, and products with the gradient do
        # not overflow or underflow.
        length = lax.stop_gradient(jnp.max(jnp.abs(error)))
        direction = error[None] / jnp.where(length > 0, length, 1)
        equations = problem.tolerating(self.rtol, self.atol)
        y, ok, count = project_along(equations, candidate, direction, max_steps=self.max_steps)
        return y, problem.judge(candidate, y, count, rtol=self.rtol, atol=self.atol, ok=ok)


Directional.__init__.__doc__ = """**Arguments:**

- `rtol`, `atol`: the tolerances for residuals; see `SimplifiedNewton`.
- `max_steps`: the largest number of iterations.

**Raises:**

`ValueError`, before compilation: with more than one scalar constraint, with a solver that has no
error estimate, in [`diffrax_conserve.project`][], where there is no step, and with a
`diffrax.HalfSolver`, whose error estimate has no sign.
"""
