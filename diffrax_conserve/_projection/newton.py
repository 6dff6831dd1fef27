"""Damped Newton's method for the nearest point, with fresh Jacobians, for candidates far away."""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .base import Problem, ProjectionInfo
from .descent import descend
from .elimination import combined, gram_matrix, gram_solve, scaled_rows, times
from .equations import Equations, in_units
from .implicit import certain
from .metric import MatrixUnits
from .options import NEWTON_OPTIONS, option
from .within_bounds import AbstractNewton, Box, project_within

# The largest number of unknowns and constraints for which the nearest point is sought.
_NEAREST_MAX = 512
# Singular values below this many units of roundoff of the largest belong to dependent constraints.
_SINGULAR = 64


@final
class Newton(AbstractNewton):
    r"""Projects to the nearest point of the manifold, with a fresh Jacobian in each iteration.

    Finds the stationary point of the distance, $(y, \lambda)$ with

    $$y = \hat y + M^{-1} G(y)^\top \lambda, \qquad g(y) = 0,$$

    in two phases. First a damped Gauss-Newton iteration converges to a point of the manifold: a
    step that increases the largest residual, or leaves the domain of a function, is shortened. Then
    Newton's method for both equations moves along the manifold to the nearest point. If that fails,
    or with more than 512 unknowns and constraints, the result is that of the first phase, on the
    manifold but not nearest, and its derivative is NaN. For the close candidates of an integrator
    use [`diffrax_conserve.SimplifiedNewton`][].

    The derivative follows from the implicit function theorem for both equations. It is NaN where
    the gradients of the constraints are nearly parallel at the projected state but not everywhere.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(circle, jnp.array([3.0, 4.0]), projection=dfc.Newton())
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, IV.4, (4.3).
    """

    max_steps: int = option(100, static=True)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        if jnp.finfo(candidate.dtype).bits < 32:
            raise TypeError(
                f"`Newton` cannot solve in the dtype of the state, {candidate.dtype}. Convert the "
                "state to float32, or pass `projection=SimplifiedNewton()`."
            )
        equations = problem.equations
        box = self.box(problem.like)
        unknowns, _, _, count = _nearest(equations, candidate, box, max_steps=self.max_steps)
        y = unknowns[: candidate.size]
        return y, problem.judge(candidate, y, count)


Newton.__init__.__doc__ = NEWTON_OPTIONS


class _Optimality(eqx.Module):
    """`y - clip(ŷ + M⁻¹ G(y)ᵀ λ)` and `g(y)`, as functions of `y` and `sizes * λ` in one vector."""

    equations: Equations
    candidate: Float[Array, " n"]
    box: Box | None
    sizes: Float[Array, " m"]

    def __call__(self, unknowns: Float[Array, " N"]) -> Float[Array, " N"]:
        y, multiplier = jnp.split(unknowns, [self.candidate.size])
        g, vjp = jax.vjp(self.equations.residual, y)  # by one reverse pass, not row by row
        gradient = self.equations.scaled(vjp(multiplier / self.sizes)[0])
        z = self.candidate + self.equations.moved(gradient)
        return jnp.concatenate([y - (z if self.box is None else self.box.clip(z)), g])


@eqx.filter_custom_jvp
def _nearest(
    equations: Equations, candidate: Float[Array, " n"], box: Box | None, *, max_steps: int
) -> tuple[Float[Array, " N"], Float[Array, " m"], Bool[Array, ""], Int[Array, ""]]:
    """State and scaled multipliers, the sizes by which they are scaled, whether they are of the
    nearest point, and a count of iterations."""
    if box is None:
        y, _, count = descend(equations, candidate, max_steps=max_steps)
    else:
        y, _, count = project_within(box, equations, candidate, max_steps=max_steps)
    n, nothing = y.size, jnp.zeros_like(equations.magnitude)
    if n + nothing.size > _NEAREST_MAX:
        return jnp.concatenate([y, nothing]), nothing + 1, jnp.asarray(False), count
    equations = equations.dense()
    sizes, unit, gram, units = _scaled(equations, y)
    along = times(unit, in_units(y - candidate, equations.units))
    start = jnp.concatenate([y, gram_solve(gram, along)])
    optimality = dataclasses.replace(
        equations,
        parts=(_Optimality(equations, candidate, box, sizes),),
        magnitude=jnp.concatenate([jnp.abs(candidate), equations.magnitude]),
        hidden=jnp.concatenate([jnp.zeros_like(y), equations.hidden]),
        units=units,
    )
    end, found, more = descend(optimality, start, max_steps=max_steps, extra=1)
    if box is not None:
        end = jnp.concatenate([box.clip(end[:n]), end[n:]])
        found = found & equations.holds(end[:n])
    return jnp.where(found, end, start), sizes, found, count + more


def _scaled(equations: Equations, y: Float[Array, " n"]) -> tuple[Array, Array, Array, Array]:
    """The sizes of the rows of `G diag(s)`, the rows divided by them, their Gram matrix, and the
    units of `y` and the multipliers in which no condition number depends on the user's."""
    sizes, unit = scaled_rows(equations.scaled(equations.linearise(y)[1]))
    gram = gram_matrix(unit, unit)
    lengths = jnp.diagonal(gram)
    units = lax.rsqrt(jnp.where(lengths > 0, lengths, 1))
    own = equations.units.sizes if isinstance(equations.units, MatrixUnits) else equations.units
    units = jnp.concatenate([jnp.ones_like(y) if own is None else own, units])
    return sizes, unit, gram, units


@_nearest.def_jvp
def _nearest_jvp(primals: Any, tangents: Any, *, max_steps: int) -> Any:
    """The tangent of the optimality system at constant `y` and `λ` is cancelled by theirs."""
    equations, candidate, _ = primals
    solved = _nearest(*primals, max_steps=max_steps)
    unknowns, sizes, found, _ = solved
    if unknowns.size > _NEAREST_MAX:
        return solved, (jnp.full_like(unknowns, jnp.nan), None, None, None)
    y = unknowns[: candidate.size]
    equations = equations.dense()
    _, _, _, units = _scaled(equations, y)
    _, right = eqx.filter_jvp(lambda *p: _Optimality(*p, sizes=sizes)(unknowns), primals, tangents)
    right = jnp.zeros_like(unknowns) if right is None else right
    matrix = jax.jacfwd(_Optimality(*primals, sizes=sizes))(unknowns)
    # A component that is never moved has no unit, but its tangent is known: that of the candidate.
    known = jnp.where(units == 0, right, 0)
    right = right - combined(known, matrix.T)
    rows = jnp.concatenate([jnp.where(units == 0, 1, units)[: y.size], sizes / units[y.size :]])
    tangent = -known - units * _shortest(matrix / rows[:, None] * units, right / rows)
    # Only the nearest point has a derivative; that of a failed projection is not used.
    sure = certain(equations, candidate, y, equations.linearise(y)[1])
    doubt = jnp.where(found, sure, jnp.nan)
    doubt = lax.stop_gradient(jnp.where(equations.holds(y), doubt, 1))
    return solved, (doubt * tangent, None, None, None)


def _shortest(matrix: Float[Array, "N N"], b: Float[Array, " N"]) -> Float[Array, " N"]:
    """The minimum-norm solution by singular values, because dependent constraints make the system
    singular but consistent. NaN if `matrix` is not finite: LAPACK never returns from infinity."""
    fixed = lax.stop_gradient(jnp.where(jnp.isfinite(matrix), matrix, jnp.nan))
    u, s, vt = jnp.linalg.svd(fixed)
    inverse = jnp.where(s > _SINGULAR * float(jnp.finfo(b.dtype).eps) * s[0], 1 / s, 0)
    return lax.custom_linear_solve(
        lambda x: combined(x, matrix.T),
        b,
        lambda _, b: combined(inverse * combined(b, u), vt),
        lambda _, b: combined(inverse * combined(b, vt.T), u.T),
    )
