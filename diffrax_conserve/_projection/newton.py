"""Damped Newton's method for the nearest point of a manifold, for candidates far away.

The nearest point is a stationary point of the distance under the constraints, where the Lagrange
conditions `y - ŷ - M⁻¹ G(y)ᵀ λ = 0` and `g(y) = 0` hold. These are equations for the pair `(y, λ)`.
So they are solved by the same damped iteration as `g(y) = 0` alone, `descent.descend`, and the
derivative follows from the implicit function theorem for them.
"""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .base import Problem, ProjectionInfo
from .descent import descend
from .elimination import combined, gram_matrix, gram_solve, scaled_rows, times
from .equations import Equations, in_units
from .implicit import certain
from .metric import MatrixUnits
from .options import NEWTON_OPTIONS, option
from .within_bounds import AbstractNewton, Box, project_within

# The nearest point is sought for at most this many unknowns and constraints together, because each
# iteration solves a dense system of that size. The docstring of `Newton` gives the number.
_NEAREST_MAX = 512
# A singular value below this many units of roundoff of the largest belongs to constraints that
# depend on each other: the roundoff of a singular value decomposition of a rounded matrix.
_SINGULAR = 64
# A projection from far away makes at most this many iterations in each phase, by default. Nearby it
# needs about five; the rest is for steps that must be shortened.
_MAX_STEPS = 100


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

    max_steps: int = option(_MAX_STEPS, static=True)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        if np.promote_types(candidate.dtype, np.float32) != candidate.dtype:
            # LAPACK has no half precision, in which the derivative would need singular values.
            raise TypeError(
                f"`Newton` cannot solve in the dtype of the state, {candidate.dtype}. Convert the "
                "state to float32, or pass `projection=SimplifiedNewton()`."
            )
        equations = problem.equations
        box = self.box(problem.like)
        unknowns, _, _, count = _nearest(equations, candidate, box, max_steps=self.max_steps)
        y = unknowns[: candidate.size]
        return y, problem.report(candidate, y, count)


Newton.__init__.__doc__ = NEWTON_OPTIONS


class _Optimality(eqx.Module):
    """The Lagrange conditions: `y - clip(ŷ + M⁻¹ G(y)ᵀ λ)` and `g(y)`, as functions of `y` and
    `sizes * λ` in one vector. The `sizes` are those of the gradients, so that all unknowns have
    comparable units. Without bounds `clip` is the identity."""

    equations: Equations
    candidate: Float[Array, " n"]
    box: Box | None
    sizes: Float[Array, " m"]

    def __call__(self, unknowns: Float[Array, " N"]) -> Float[Array, " N"]:
        y, multiplier = jnp.split(unknowns, [self.candidate.size])
        # `G(y)ᵀ λ` by one reverse pass, instead of one for each row of `G`.
        g, vjp = jax.vjp(self.equations.residual, y)
        gradient = self.equations.scaled(vjp(multiplier / self.sizes)[0])
        z = self.candidate + self.equations.moved(gradient)
        return jnp.concatenate([y - (z if self.box is None else self.box.clip(z)), g])


@eqx.filter_custom_jvp
def _nearest(
    equations: Equations, candidate: Float[Array, " n"], box: Box | None, *, max_steps: int
) -> tuple[Float[Array, " N"], Float[Array, " m"], Bool[Array, ""], Int[Array, ""]]:
    """State and scaled multipliers in one vector, the sizes by which the multipliers are scaled,
    whether the state is the nearest point, and the number of iterations."""
    # First phase: some point of the manifold.
    if box is None:
        y, _, count = descend(equations, candidate, max_steps=max_steps)
    else:
        y, _, count = project_within(box, equations, candidate, max_steps=max_steps)
    n, nothing = y.size, jnp.zeros_like(equations.magnitude)
    if n + nothing.size > _NEAREST_MAX:
        return jnp.concatenate([y, nothing]), nothing + 1, jnp.asarray(False), count
    # Second phase: the nearest point. It starts from the multipliers that fit `y - ŷ` best.
    equations = equations.dense()
    sizes, unit, gram, units = _scaled(equations, y)
    along = times(unit, in_units(y - candidate, equations.units))
    start = jnp.concatenate([y, gram_solve(gram, along)])
    # The Lagrange conditions take the place of the constraints. There are as many as unknowns, so
    # the Gauss-Newton steps of `descend` are steps of Newton's method.
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
    """The sizes of the rows of `G diag(s)`, the rows divided by them, their Gram matrix, and units
    for `y` and for the multipliers, with which no condition number depends on the units of the
    user."""
    sizes, unit = scaled_rows(equations.scaled(equations.linearise(y)[1]))
    gram = gram_matrix(unit, unit)
    lengths = jnp.diagonal(gram)
    units = lax.rsqrt(jnp.where(lengths > 0, lengths, 1))
    own = equations.units.sizes if isinstance(equations.units, MatrixUnits) else equations.units
    units = jnp.concatenate([jnp.ones_like(y) if own is None else own, units])
    return sizes, unit, gram, units


@_nearest.def_jvp
def _nearest_jvp(primals: Any, tangents: Any, *, max_steps: int) -> Any:
    """By the implicit function theorem: the Lagrange conditions stay zero. So their tangent at
    constant `y` and `λ`, which is `right`, is cancelled by the tangents of `y` and `λ` times the
    Jacobian, which is `matrix`. Rows and columns are scaled by the units."""
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
    # Only the nearest point has a derivative, so it is NaN where only the first phase succeeded.
    # The result of a failed projection is discarded, and its derivative must stay finite.
    sure = certain(equations, candidate, y, equations.linearise(y)[1])
    doubt = jnp.where(found, sure, jnp.nan)
    doubt = lax.stop_gradient(jnp.where(equations.holds(y), doubt, 1))
    return solved, (doubt * tangent, None, None, None)


def _shortest(matrix: Float[Array, "N N"], b: Float[Array, " N"]) -> Float[Array, " N"]:
    """The solution of least norm, by singular values, because constraints that depend on each other
    make the system singular but consistent. It can be differentiated again, in both modes, as the
    solution of a linear system. An infinite element is replaced by NaN first, because LAPACK does
    not return from a matrix with infinite elements."""
    fixed = lax.stop_gradient(jnp.where(jnp.isfinite(matrix), matrix, jnp.nan))
    u, s, vt = jnp.linalg.svd(fixed)
    inverse = jnp.where(s > _SINGULAR * float(jnp.finfo(b.dtype).eps) * s[0], 1 / s, 0)
    return lax.custom_linear_solve(
        lambda x: combined(x, matrix.T),
        b,
        lambda _, b: combined(inverse * combined(b, u), vt),
        lambda _, b: combined(inverse * combined(b, vt.T), u.T),
    )
