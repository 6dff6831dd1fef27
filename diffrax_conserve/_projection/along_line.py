"""Projection along a line, which conserves every linear integral."""

import dataclasses
from typing import Literal, final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._constants import MAX_STEPS
from .._numerics.implicit import MultiplierSystem, implicit_solution
from .._numerics.metric import Diagonal
from .._numerics.problem import Problem
from .._numerics.report import ProjectionInfo
from .._numerics.rows import DenseRows
from .base import AbstractProjection
from .options import check_options, option


@final
class AlongLine(AbstractProjection):
    r"""Projects along a line through the candidate, for one integral.

    For the candidate $\hat y$ and a direction $w$ it solves $g(\hat y + \lambda w) = 0$ by Newton's
    method from $\lambda = 0$, with derivatives along $w$ only. Linear integrals that the wrapped
    solver conserves, as every Runge-Kutta method does, are constant along $w$ and thus conserved
    too, without a metric and without being listed in the manifold. At saved times inside a step and
    in dense output $\hat y$ is the dense output. Derivatives follow from the implicit function
    theorem for $\lambda$.

    **Along the error estimate**, `direction="error"`: $w$ is the error estimate of the step, in a
    Runge-Kutta method the difference from the embedded solution. Where $w$ is nearly tangent to the
    manifold, the correction is long, or does not exist and the projection fails. The order of the
    wrapped solver is kept if the angle between $w$ and the manifold does not vanish with the step
    size. At saved times inside a step $w$ is that of the step.

    **Along the step**, `direction="step"`, known as *relaxation*: $w = \hat y - y_n$, so that
    $y_{n+1} = y_n + \gamma (\hat y - y_n)$ with $\gamma$ near 1. No error estimate is needed. For a
    Runge-Kutta method $y_{n+1}$ approximates the solution at $t_n + \gamma h$, where
    $\gamma = 1 + O(h^{p-1})$ in a method of order $p$. But the steps of diffrax end at
    $t_n + h$, so the order is $p - 1$ (the *incremental direction technique*). For order $p$ let
    the solver carry the time: append a component $\tau$ with $\tau' = 1$ to the state, and write
    the vector field and the integral in terms of $\tau$. It is relaxed like the others, and the
    state belongs to the time $\tau$, not to the time of diffrax.

    Relaxation fails where the integral does not change along the step, as at a candidate on a
    chord of a level set that is straight, and where it finds no solution with $\gamma \ge 1/2$:
    $\gamma = 0$, the start of the step, is always one, and not what is sought. So it fails with
    Euler's method, which moves along a tangent of the level set, and with a quantity that is not
    conserved, in short steps.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        energy = dfc.systems.OuterSolarSystem().manifold["energy"]
        along_error = dfc.AlongLine(direction="error")
        solver = dfc.ManifoldProjection(diffrax.Dopri5(), energy, projection=along_error)
        ```

    ??? cite "Reference"

        Calvo, Hernández-Abreu, Montijano and Rández, "On the preservation of invariants by
        explicit Runge-Kutta methods", *SIAM J. Sci. Comput.* 28 (2006), 868-885, for the error
        estimate. Ketcheson, "Relaxation Runge-Kutta methods: conservation and stability for
        inner-product norms", *SIAM J. Numer. Anal.* 57 (2019), 2850-2870. Ranocha, Sayyari, Dalcin,
        Parsani and Ketcheson, "Relaxation Runge-Kutta methods: fully discrete explicit
        entropy-stable schemes for the compressible Euler and Navier-Stokes equations", *SIAM J.
        Sci. Comput.* 42 (2020), A612-A638, for integrals that are not quadratic.
    """

    direction: Literal["error", "step"] = eqx.field(static=True, kw_only=True)
    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(MAX_STEPS, static=True)
    metric: None = eqx.field(default=None, init=False)

    def __check_init__(self):
        if self.direction not in ("error", "step"):
            raise ValueError(
                f'`direction` is {self.direction!r}. Write `AlongLine(direction="error")`, along '
                'the error estimate of the wrapped solver, or `AlongLine(direction="step")`.'
            )
        check_options(self)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        size = problem.num_residuals
        if size != 1:
            raise ValueError(
                f"`AlongLine` has one unknown, but `manifold` has {size} scalar constraints. Keep "
                "one integral, or pass `projection=SimplifiedNewton()`."
            )
        # The iteration moves along `S Uᵀ λ`, for a factor `S` and a row `U` that are given. With
        # `S = diag(s)`, `s = |w|` and the dimensionless row `w / s` this is `w λ`. Where an element
        # of `w` is zero, its derivative need not be. So `s` is not zero there, but so small that
        # the component counts for nothing.
        line = self._line(problem, candidate)
        least = float(jnp.finfo(line.dtype).tiny) ** 0.5
        s = lax.stop_gradient(jnp.where(line == 0, least, jnp.abs(line)))
        along = dataclasses.replace(problem, factor=Diagonal(s))
        row = DenseRows((line / s)[None])
        y, ok, count, _ = implicit_solution(
            MultiplierSystem(along, candidate, row, max_steps=self.max_steps)
        )
        if self.direction == "step":
            ok = ok & _is_no_return(problem, candidate, y)
        return y, problem.report(candidate, y, count, ok=ok)

    @property
    def needs_signed_error(self) -> bool:
        return self.direction == "error"

    def _line(self, problem: Problem, candidate: Float[Array, " n"]) -> Float[Array, " n"]:
        """The vector `w`."""
        step = problem.step
        if step is None:
            raise ValueError(
                "`AlongLine` moves along a line that the step of a solve gives, but there is no "
                "step outside a solve. Pass `projection=Newton()`."
            )
        if self.direction == "step":
            return candidate - step.y0
        if step.error is None:
            raise ValueError(
                '`AlongLine(direction="error")` moves along the error estimate, but the wrapped '
                "solver has none. Wrap one with an embedded method, such as `diffrax.Tsit5()`, or "
                'pass `projection=AlongLine(direction="step")`.'
            )
        return step.error


AlongLine.__init__.__doc__ = """**Arguments:**

- `direction`: `"error"`, along the error estimate of the wrapped solver, or `"step"`, along the
    step. There is no default: the first needs an estimate, the second loses an order.
- `rtol`, `atol`, `max_steps`: see `SimplifiedNewton`.

**Raises:**

`ValueError` for another direction, with more than one scalar constraint, outside a solve, as in
[`diffrax_conserve.project`][], and for `"error"` without an estimate that has a sign: with a solver
that has none, and with a `diffrax.HalfSolver`.
"""


def _is_no_return(
    problem: Problem, candidate: Float[Array, " n"], y: Float[Array, " n"]
) -> Bool[Array, ""]:
    """Whether a state on the line along a step is not the start of the step, which is on the
    manifold too. It is no solution: time would stand still. So the end of a step must be at least
    as near to the candidate as to the start, which is `γ ≥ 1/2`. All three are on one line, so that
    the ratio of their distances is the same in every norm. A saved time is not tested, because just
    after the start of the step the change of the state may be as small as its error."""
    assert problem.step is not None
    far = lambda x: jnp.max(jnp.abs(y - x), initial=0)  # noqa: E731
    return (far(candidate) <= far(problem.step.y0)) | (problem.t != problem.step.t1)
