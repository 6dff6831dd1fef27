"""Derivatives of projections by the implicit function theorem, exact for the returned state."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .equations import Equations
from .gram import combined, gram_matrix, gram_solve, row_sizes
from .loop import Solved, solve

# Gradients count as nearly parallel if the sine of their angle is below the cube root of roundoff,
# or if it is below `_SMALL_ANGLE` and the correction, relative to the state and divided by the
# sine, is above `_SHORT_CORRECTION`. Whether they are so everywhere is tested at this distance.
_SMALL_ANGLE, _SHORT_CORRECTION, _OFFSET = 1e-2, 1e-5, 1e-3


@eqx.filter_custom_jvp
def project_along(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Float[Array, "m n"] | None,
    *,
    max_steps: int,
) -> Solved:
    """`loop.solve` with the directions frozen, and its derivative."""
    return solve(equations, candidate, directions=directions, max_steps=max_steps)


@project_along.def_jvp
def _project_along_jvp(primals: Any, tangents: Any, *, max_steps: int) -> Any:
    """Let `ẏ` and `ġ` be the tangents of `y = ŷ + Dᵀ λ` and of its residual at constant `λ`. Then
    `λ̇ = -(G(y) Dᵀ)⁻¹ ġ`, and the tangent of the state is `ẏ + Dᵀ λ̇`."""
    equations, candidate, directions = primals
    y, ok, count = project_along(*primals, max_steps=max_steps)

    if directions is None:
        _, dual = equations.linearise(candidate)
        rows = equations.weighted(dual)
    else:
        dual = rows = directions
    sizes = row_sizes(dual)
    dual, rows = dual / sizes[:, None], rows / sizes[:, None]
    along = dual @ (y - candidate)
    multiplier = gram_solve(gram_matrix(dual, rows), along) / sizes

    def displaced(equations: Equations, candidate: Array, directions: Array | None) -> Any:
        if directions is not None:
            moved = combined(multiplier, directions)
        else:  # by one reverse pass, not row by row
            _, vjp = jax.vjp(equations.residual, candidate)
            moved = equations.weighted(vjp(multiplier)[0][None])[0]
        return candidate + moved, equations.residual(candidate + moved)

    t_y, t_g = (
        jnp.zeros_like(x) if t is None else t
        for x, t in zip(
            (y, multiplier), eqx.filter_jvp(displaced, primals, tangents)[1], strict=True
        )
    )
    _, jacobian = equations.linearise(y)
    heights = row_sizes(jacobian)
    gram = gram_matrix(jacobian / heights[:, None], rows)
    t_y = t_y - combined(gram_solve(gram, t_g / heights), rows)
    # The derivative of a failed projection is not used: its step is rejected, or ends the solve.
    factor = jnp.where(ok, certain(equations, candidate, y, jacobian, directions), 1)
    return (y, ok, count), (lax.stop_gradient(factor) * t_y, None, None)


def certain(
    equations: Equations,
    candidate: Array,
    y: Array,
    jacobian: Array,
    directions: Array | None = None,
) -> Float[Array, ""]:
    """One if the derivative of the projected state `y` is well determined, otherwise NaN.

    Where gradients are nearly parallel, multipliers are large and cancel, so that roundoff
    dominates their derivatives. Gradients that are parallel everywhere do no harm: such a
    constraint is redundant.
    """
    one, eps = jnp.ones((), y.dtype), float(jnp.finfo(y.dtype).eps)
    if len(jacobian) == 1:
        if directions is None:
            return one
        lengths = jnp.linalg.norm(jacobian) * jnp.linalg.norm(directions)
        crosses = jnp.abs(jnp.sum(jacobian * directions)) > eps ** (1 / 3) * lengths
        return jnp.where(crosses | (lengths == 0), one, jnp.nan)
    sines = _sines(equations, jacobian)
    size = jnp.max(jnp.abs(y), initial=0)
    phases = jnp.sin(jnp.arange(1, y.size + 1, dtype=y.dtype) ** 2)
    beside = y + _OFFSET * (jnp.abs(y) + 0.1 * size) * phases
    dependent = _sines(equations, equations.linearise(beside)[1]) <= 64 * eps
    amplified = jnp.linalg.norm(y - candidate) > _SHORT_CORRECTION * sines * jnp.linalg.norm(y)
    doubtful = (sines <= eps ** (1 / 3)) | ((sines <= _SMALL_ANGLE) & amplified)
    return jnp.where(jnp.any(doubtful & ~dependent), jnp.nan, one)


def _sines(equations: Equations, jacobian: Float[Array, "m n"]) -> Float[Array, " m"]:
    """The sine of the angle between each gradient and the span of those before it, in the norm of
    the metric."""
    unit = jacobian / row_sizes(jacobian)[:, None]
    if equations.weights is not None:
        unit = unit * jnp.sqrt(equations.weights)[None]
    columns = unit.astype(jnp.float32 if jnp.finfo(unit.dtype).bits < 32 else unit.dtype).T
    norms = jnp.linalg.norm(columns, axis=0)
    lengths = jnp.abs(jnp.diagonal(jnp.linalg.qr(columns, mode="r")))
    return jnp.where(norms > 0, lengths / jnp.where(norms > 0, norms, 1), 1).astype(unit.dtype)
