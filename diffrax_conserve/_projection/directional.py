"""Projection along the embedded error estimate, which conserves every linear integral."""

from typing import ClassVar, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Int, Real

from .._custom_types import Y
from .._tree import tree_add, tree_dot, tree_max, tree_norm, tree_scale, tree_tangents
from .base import AbstractProjection, Problem, ProjectionInfo, check_options, option
from .equations import SAFELY
from .linearise import Joined, linearise
from .residual import Tolerance, within


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
    projection fails: an adaptive solve then takes a smaller step, a solve with fixed steps ends.
    The order of the wrapped solver is kept if the angle between $w$ and the manifold does not
    vanish with the step size; with a `max_correction` of the `ManifoldProjection`, long corrections
    are failures. At saved times inside a step and in dense output the direction is that of the
    step; where the projection fails there, [`diffrax_conserve.SimplifiedNewton`][] is used instead,
    which does not conserve linear integrals.

    Success is judged as in every projection. Derivatives follow from the implicit function theorem
    for $\lambda$; they are NaN where the sine of the angle between $w$ and the manifold is below
    the cube root of roundoff.

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
    max_steps: int = option(20, static=True)
    metric: None = eqx.field(default=None, init=False)
    sees_step: ClassVar[bool] = True

    def __check_init__(self):
        check_options(self)

    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        direction = _direction(problem)
        limit = Tolerance(self.rtol, self.atol)
        length, count = _length(
            problem.residual,
            candidate,
            direction,
            (limit, problem.magnitude),
            max_steps=self.max_steps,
        )
        y = tree_add(candidate, tree_scale(length, direction))
        return y, problem.judge(candidate, y, count, rtol=self.rtol, atol=self.atol)


Directional.__init__.__doc__ = """**Arguments:**

- `rtol`, `atol`: the tolerances for residuals; see `SimplifiedNewton`.
- `max_steps`: the largest number of iterations.

**Raises:**

`ValueError`, when it is used and before compilation: with more than one scalar constraint, with a
solver that has no error estimate, or in [`diffrax_conserve.project`][], where there is no step.
`ValueError` from `ManifoldProjection` for a `diffrax.HalfSolver`, whose error estimate has no sign.
"""


def _direction(problem: Problem) -> Y:
    if problem.magnitude.size != 1:
        raise ValueError(
            f"`Directional` moves along one direction, but `manifold` has {problem.magnitude.size} "
            "scalar constraints. Keep one integral, or pass `projection=SimplifiedNewton()`."
        )
    if problem.step is None:
        raise ValueError(
            "`Directional` moves along the error estimate of a step, but there is no step here. "
            "Use it in a `ManifoldProjection`. Elsewhere pass `projection=Newton()`."
        )
    if problem.step.error is None:
        raise ValueError(
            "`Directional` moves along the error estimate of the wrapped solver, but this has "
            "none. Wrap a solver with an embedded method, such as `diffrax.Tsit5()`, or pass "
            "`projection=SimplifiedNewton()`."
        )
    # Normalised: the result does not depend on the length, and products with the gradient do not
    # overflow or underflow.
    size = lax.stop_gradient(tree_max(problem.step.error))
    return tree_scale(1 / jnp.where(size > 0, size, 1), problem.step.error)


@eqx.filter_custom_jvp
def _length(
    residual: Joined,
    candidate: Y,
    direction: Y,
    accuracy: tuple[Tolerance, Real[Array, " 1"]],
    *,
    max_steps: int,
) -> tuple[Real[Array, ""], Int[Array, ""]]:
    """The last iterate of `λ`, converged or not, and the number of iterations."""
    limit, magnitude = accuracy
    _, jacobian = linearise(residual, candidate)
    enough = SAFELY * limit(magnitude + jacobian.scale(candidate))[0]

    def along(length: Array) -> Array:
        return residual(tree_add(candidate, tree_scale(length, direction)))[0]

    def body(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        _, last, length, num_steps = carry
        g, slope = jax.jvp(along, (length,), (jnp.ones_like(length),))
        size = jnp.abs(g)
        # Ends when the residual stops decreasing; `Problem.judge` decides on success.
        unfinished = (size > enough) & (size < 0.9 * last) & (num_steps < max_steps) & (slope != 0)
        step = jnp.where(unfinished, g / jnp.where(slope == 0, 1, slope), 0)
        return unfinished, size, length - step, num_steps + unfinished.astype(int)

    zero = jnp.zeros((), magnitude.dtype)
    start = jnp.asarray(True), jnp.full_like(zero, jnp.inf), zero, jnp.asarray(0)
    _, _, length, count = lax.while_loop(lambda carry: carry[0], body, start)
    return length, count


@_length.def_jvp
def _length_jvp(primals, tangents, *, max_steps):
    """From `g(ŷ + λ w) = 0`: with `ġ` at a fixed `λ`, `λ̇ = -ġ / (∂g/∂y · w)`."""
    residual, candidate, direction, (limit, magnitude) = primals
    length, count = _length(*primals, max_steps=max_steps)

    def displaced(residual: Joined, candidate: Y, direction: Y) -> Array:
        return residual(tree_add(candidate, tree_scale(length, direction)))[0]

    g, t_g = eqx.filter_jvp(displaced, tuple(primals[:3]), tuple(tangents[:3]))
    t_g = tree_tangents(g, t_g)
    y = tree_add(candidate, tree_scale(length, direction))
    _, jacobian = linearise(residual, y)
    gradient = jacobian.pullback(jnp.ones_like(magnitude))
    slope = tree_dot(gradient, direction, g.dtype)
    sine = jnp.abs(slope) / (tree_norm(gradient) * tree_norm(direction))
    certain = (sine > float(jnp.finfo(g.dtype).eps) ** (1 / 3)) | (tree_max(direction) == 0)
    # The derivative of a failed projection is not used: its step is rejected, or ends the solve.
    failed = ~within(g, limit(magnitude + jacobian.scale(y))[0])
    t_length = -t_g / jnp.where(slope == 0, 1, slope)
    factor = lax.stop_gradient(jnp.where(certain | failed, 1.0, jnp.nan).astype(g.dtype))
    return (length, count), (factor * t_length, None)
