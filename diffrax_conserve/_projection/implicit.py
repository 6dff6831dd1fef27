"""The derivative of a projection, by the implicit function theorem.

It is exact for the state that was computed, whatever the number of iterations, and nothing is
unrolled. Where it is not determined, because gradients are nearly parallel, it is NaN.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._tree import tree_tangents
from .chord import FROZEN_STEPS, Solved, chord
from .elimination import (
    WRITTEN_OUT_MAX,
    combined,
    eliminated,
    gram_matrix,
    gram_solve,
    scaled_rows,
    times,
)
from .equations import Equations, Jacobian, in_units
from .sparse import SparseRows

# Gradients count as nearly parallel if the sine of their angle is below the cube root of roundoff,
# or if it is below `_SMALL_ANGLE` and the correction, relative to the state and divided by the
# sine, is above `_SHORT_CORRECTION`. Whether they are so everywhere, which does no harm, is tested
# at this distance: there the sine is roundoff, at most `_PARALLEL` units of it.
_SMALL_ANGLE, _SHORT_CORRECTION, _OFFSET, _PARALLEL = 1e-2, 1e-5, 1e-3, 64
# A component that crosses zero counts as this share of the largest one, if its motion is unknown.
_CROSSING = 0.1


@eqx.filter_custom_jvp
def project_along(
    equations: Equations,
    candidate: Float[Array, " n"],
    directions: Jacobian | None,
    *,
    max_steps: int,
    solve: Callable[..., Solved] = chord,
) -> Solved:
    """The state that an iteration finds, by default `chord`, and its derivative."""
    return solve(equations, candidate, directions, max_steps=max_steps)


@project_along.def_jvp
def _project_along_jvp(primals: Any, tangents: Any, **options: Any) -> Any:
    """Let `ẏ` and `ġ` be the tangents of `y = ŷ + s Uᵀ λ` and of its residual at constant `λ`. Then
    `λ̇ = -(G(y) diag(s) Uᵀ)⁻¹ ġ`, and the tangent of the state is `ẏ + s Uᵀ λ̇`. The units depend
    on the solution too, so `ẏ` includes their tangent."""
    equations, candidate, directions = primals
    solved = y, ok, count = project_along(*primals, **options)
    # What failed is not used. Its tangent is that of the candidate, which is finite: reverse mode
    # multiplies it by zero.
    y = jnp.where(ok, y, candidate)
    rows = directions
    if rows is None:
        rows = equations.scaled(equations.linearise(candidate)[1])
    sizes, rows = scaled_rows(rows)
    along = times(rows, in_units(y - candidate, equations.units))
    multiplier = gram_solve(gram_matrix(rows, rows), along) / sizes

    def displaced(equations: Equations, candidate: Array, directions: Any) -> Any:
        if directions is not None:
            moved = combined(multiplier, directions)
        else:  # by one reverse pass, not row by row
            _, vjp = jax.vjp(equations.residual, candidate)
            moved = equations.scaled(vjp(multiplier)[0])
        moved = equations.moved(moved)
        return candidate + moved, equations.residual(candidate + moved)

    tangent = eqx.filter_jvp(displaced, primals, tangents)[1]
    t_y, t_g = tree_tangents((y, multiplier), tangent)
    _, jacobian = equations.linearise(y)
    heights, unit = scaled_rows(equations.scaled(jacobian))
    change = combined(*eliminated(gram_matrix(unit, rows), t_g / heights, rows))
    t_y = t_y - equations.moved(change)
    factor = certain(equations, candidate, y, jacobian, directions)
    if directions is None and 1 < len(rows) <= WRITTEN_OUT_MAX:
        factor = jnp.where(count <= FROZEN_STEPS, factor, jnp.nan)  # not of this form
    factor = jnp.where(ok, factor, 1)
    return solved, Solved(lax.stop_gradient(factor) * t_y, None, None)  # pyright: ignore


def certain(
    equations: Equations,
    candidate: Array,
    y: Array,
    jacobian: Jacobian,
    directions: Jacobian | None = None,
) -> Float[Array, ""]:
    """One if the derivative of the projected state `y` is well determined, otherwise NaN: where
    gradients are nearly parallel, multipliers are large and cancel, so that roundoff dominates
    their derivatives. Constraints with gradients parallel everywhere are redundant: no harm."""
    one, eps = jnp.ones((), y.dtype), float(jnp.finfo(y.dtype).eps)
    if isinstance(jacobian, SparseRows):
        return one
    if len(jacobian) == 1:
        if directions is None:
            return one
        gradient = equations.scaled(jacobian)
        lengths = jnp.linalg.norm(gradient) * jnp.linalg.norm(directions)
        crosses = jnp.abs(jnp.sum(gradient * directions)) > eps ** (1 / 3) * lengths
        return jnp.where(crosses | (lengths == 0), one, jnp.nan)
    sines = _sines(equations, jacobian)
    # The size of each component: where it crosses zero, how far it moves in a step, or, where that
    # is not known, a share of the largest component.
    motion = equations.motion
    sizes = jnp.abs(y) + (_CROSSING * jnp.max(jnp.abs(y), initial=0) if motion is None else motion)
    phases = jnp.sin(jnp.arange(1, y.size + 1, dtype=y.dtype) ** 2)
    beside = y + _OFFSET * sizes * phases
    dependent = _sines(equations, equations.linearise(beside)[1]) <= _PARALLEL * eps
    relative_change = jnp.abs(y - candidate) / jnp.where(sizes > 0, sizes, 1)
    amplified = jnp.max(relative_change, initial=0) > _SHORT_CORRECTION * sines
    doubtful = (sines <= eps ** (1 / 3)) | ((sines <= _SMALL_ANGLE) & amplified)
    return jnp.where(jnp.any(doubtful & ~dependent), jnp.nan, one)


def _sines(equations: Equations, jacobian: Any) -> Float[Array, " m"]:
    """The sine of the angle between each gradient and the span of those before, in the metric."""
    _, unit = scaled_rows(equations.scaled(jacobian))
    columns = unit.astype(jnp.float32 if jnp.finfo(unit.dtype).bits < 32 else unit.dtype).T
    norms = jnp.linalg.norm(columns, axis=0)
    lengths = jnp.abs(jnp.diagonal(jnp.linalg.qr(columns, mode="r")))
    # Of more constraints than unknowns those that are left over depend on the others.
    lengths = jnp.pad(lengths, (0, norms.size - lengths.size))
    return jnp.where(norms > 0, lengths / jnp.where(norms > 0, norms, 1), 1).astype(unit.dtype)
