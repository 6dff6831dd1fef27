"""Projection along the embedded error estimate, which conserves every linear integral."""

import abc
import dataclasses
from typing import ClassVar, final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._step.constants import MAX_STEPS
from .._step.implicit import Along, solution
from .base import AbstractProjection, Problem, ProjectionInfo
from .options import check_options, option


class AbstractAlongLine(AbstractProjection):
    """A projection with one unknown: `y = ŷ + λ w` for the direction `w` of a line through the
    candidate."""

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(MAX_STEPS, static=True)
    metric: None = eqx.field(default=None, init=False)
    sees_step: ClassVar[bool] = True
    # A verb and its object for the message about too many constraints, such as "has one unknown".
    unknowns: ClassVar[str]

    def __check_init__(self):
        check_options(self)

    @abc.abstractmethod
    def direction(self, problem: Problem, candidate: Float[Array, " n"]) -> Float[Array, " n"]:
        """The vector `w`."""

    def is_wanted(
        self, problem: Problem, candidate: Float[Array, " n"], y: Float[Array, " n"]
    ) -> Bool[Array, ""]:
        """Whether a state of the manifold on this line is the one that is sought. By default every
        one is."""
        del problem, candidate, y
        return jnp.asarray(True)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        size = problem.equations.magnitude.size
        if size != 1:
            raise ValueError(
                f"`{type(self).__name__}` {self.unknowns}, but `manifold` has {size} scalar "
                "constraints. Keep one integral, or pass `projection=SimplifiedNewton()`."
            )
        # The iteration moves along `s Uᵀ λ`, for units `s` and a row `U` that are given. With
        # `s = |w|`, and the signs of `w` as the row, this is `w λ`.
        direction = self.direction(problem, candidate)
        equations = dataclasses.replace(problem.equations, units=jnp.abs(direction))
        signs = lax.stop_gradient(jnp.sign(direction))[None]
        y, ok, count, _ = solution(Along(equations, candidate, signs, max_steps=self.max_steps))
        wanted = self.is_wanted(problem, candidate, y)
        return y, problem.report(candidate, y, count, ok=ok & wanted)


@final
class Directional(AbstractAlongLine):
    r"""Projects along the error estimate of the wrapped solver, for one integral.

    For the candidate $\hat y$ and the error estimate $w$ of the step (in a Runge-Kutta method the
    difference from the embedded solution), it solves $g(\hat y + \lambda w) = 0$ by Newton's method
    from $\lambda = 0$, with derivatives along $w$ only. Linear integrals that the wrapped solver
    conserves, as every Runge-Kutta method does, are constant along $w$ and thus conserved too,
    without a metric and without being listed in the manifold.

    Where $w$ is nearly tangent to the manifold, the correction is long, or does not exist and the
    projection fails. The order of the wrapped solver is kept if the angle between $w$ and the
    manifold does not vanish with the step size. At saved times inside a step and in dense output
    the direction is that of the step.

    Derivatives follow from the implicit function theorem for $\lambda$; they are NaN where the sine
    of that angle is below the cube root of roundoff.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        energy = dfc.systems.OuterSolarSystem().manifold["energy"]
        solver = dfc.ManifoldProjection(diffrax.Dopri5(), energy, projection=dfc.Directional())
        ```

    ??? cite "Reference"

        Calvo, Hernández-Abreu, Montijano and Rández, "On the preservation of invariants by
        explicit Runge-Kutta methods", *SIAM J. Sci. Comput.* 28 (2006), 868-885.
    """

    unknowns: ClassVar[str] = "moves along one direction"

    def direction(self, problem: Problem, candidate: Float[Array, " n"]) -> Float[Array, " n"]:
        del candidate
        error = None if problem.step is None else problem.step.error
        if error is None:
            raise ValueError(
                "`Directional` moves along the error estimate of a step, but there is none. In a "
                "`ManifoldProjection` wrap a solver with an embedded method, such as "
                "`diffrax.Tsit5()`. Elsewhere pass `projection=Newton()`."
            )
        return error


Directional.__init__.__doc__ = """**Arguments:**

- `rtol`, `atol`, `max_steps`: see `SimplifiedNewton`.

**Raises:**

`ValueError` with more than one scalar constraint, and without an error estimate that has a sign: in
[`diffrax_conserve.project`][], with a solver that has none, and with a `diffrax.HalfSolver`.
"""
