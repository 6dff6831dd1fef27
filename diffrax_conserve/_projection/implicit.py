"""The derivative of a projection along given directions, by the implicit function theorem.

The iteration finds multipliers `λ` for which the residual of `y = ŷ + s Uᵀ λ` vanishes. The theorem
gives the derivative of `λ` by everything on which the residual depends: the candidate, the values
that are conserved, parameters of the functions. It holds for the state that was computed, whatever
the number of iterations, and no iteration is unrolled. Where the derivative is not determined in
floating-point arithmetic, because gradients are nearly parallel, it is NaN.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._tree import tree_tangents, without_pattern
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

# Gradients count as nearly parallel if the sine of their angle is below the cube root of roundoff.
# They also do if the sine is below `_SMALL_ANGLE` and the correction, relative to the state and
# divided by the sine, exceeds `_SHORT_CORRECTION`: then the multipliers are large enough for their
# errors to show in a derivative. These are choices, with which the law
# `tests/laws/test_never_silent.py -k parallel` finds no derivative wrong on 400 orbits.
_SMALL_ANGLE, _SHORT_CORRECTION = 1e-2, 1e-5
# Constraints whose gradients are parallel everywhere repeat each other, which does no harm. To tell
# them we look at the sine at another state, at this relative distance, so far that gradients which
# are parallel only here have visibly turned.
_OFFSET = 1e-3
# If the gradients are parallel there too, their sine is roundoff: at most this many units of it,
# for a QR decomposition of gradients that are themselves rounded.
_PARALLEL = 64
# The test above and the size of a correction need a size of each component. If we do not know how
# far a component moves, we count at least this share of the largest one, because its own value may
# just cross zero.
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
    """The state `y = ŷ + s Uᵀ λ` that an iteration finds, by default `chord`. The rows of `U` are
    the `directions`, or the gradients at the candidate. The derivative is that of the rule
    below."""
    return solve(equations, candidate, directions, max_steps=max_steps)


@project_along.def_jvp
def _project_along_jvp(primals: Any, tangents: Any, **options: Any) -> Any:
    """Let `ẏ` and `ġ` be the tangents of `y = ŷ + s Uᵀ λ` and of its residual at constant `λ`. The
    residual stays zero, `ġ + G(y) diag(s) Uᵀ λ̇ = 0`, so `λ̇ = -(G(y) diag(s) Uᵀ)⁻¹ ġ`, and the
    tangent of the state is `ẏ + s Uᵀ λ̇`. The directions depend on the candidate and the units on
    the solution, so `ẏ` includes their tangents."""
    equations, candidate, directions = primals
    solved = y, ok, count = project_along(*primals, **options)
    # The result of a failed projection is discarded. In reverse mode its cotangent is zero, but
    # zero times a tangent that is not finite would be NaN. So we differentiate at the candidate
    # there.
    y = jnp.where(ok, y, candidate)
    rows = directions
    if rows is None:
        rows = equations.scaled(equations.linearise(candidate)[1])
    sizes, rows = scaled_rows(rows)
    # The iteration does not return `λ`. It follows from `U s⁻¹ (y - ŷ) = U Uᵀ λ`.
    along = times(rows, in_units(y - candidate, equations.units))
    multiplier = gram_solve(gram_matrix(rows, rows), along) / sizes

    def displaced(equations: Equations, candidate: Array, directions: Any) -> Any:
        """The state with this `λ`, and its residual."""
        if directions is not None:
            moved = combined(multiplier, directions)
        else:  # `G(ŷ)ᵀ λ` by one reverse pass, instead of one for each row of `G`
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
        # If it took more iterations, `chord` has changed its directions, and the state is not of
        # the form above.
        factor = jnp.where(count <= FROZEN_STEPS, factor, jnp.nan)
    factor = jnp.where(ok, factor, 1)
    return solved, Solved(lax.stop_gradient(factor) * t_y, None, None)  # pyright: ignore


def certain(
    equations: Equations,
    candidate: Array,
    y: Array,
    jacobian: Jacobian,
    directions: Jacobian | None = None,
) -> Float[Array, ""]:
    """One if the derivative of the projected state `y` is well determined, otherwise NaN, as a
    factor of the derivative.

    Where gradients are nearly parallel, multipliers are large and cancel. The state is right
    nevertheless, but its derivative is that of the multipliers, in which roundoff dominates.
    Constraints whose gradients are parallel everywhere are redundant and do no harm.
    """
    one, eps = jnp.ones((), y.dtype), float(jnp.finfo(y.dtype).eps)
    if isinstance(jacobian, SparseRows):  # too many rows to compare each with all others
        return one
    if len(jacobian) == 1:
        if directions is None:
            return one
        # A single constraint along a line: the line must not be tangent to the manifold.
        gradient = equations.scaled(jacobian)
        lengths = jnp.linalg.norm(gradient) * jnp.linalg.norm(directions)
        crosses = jnp.abs(jnp.sum(gradient * directions)) > eps ** (1 / 3) * lengths
        return jnp.where(crosses | (lengths == 0), one, jnp.nan)
    sines = _sines(equations, jacobian)
    # The size of a component is its value plus how far it moves in a step, or, if that is not
    # known, a share of the largest component: the value alone may just cross zero.
    motion = equations.motion
    sizes = jnp.abs(y) + (_CROSSING * jnp.max(jnp.abs(y), initial=0) if motion is None else motion)
    beside = y + _OFFSET * sizes * without_pattern(y.size, y.dtype)
    dependent = _sines(equations, equations.linearise(beside)[1]) <= _PARALLEL * eps
    relative_change = jnp.abs(y - candidate) / jnp.where(sizes > 0, sizes, 1)
    amplified = jnp.max(relative_change, initial=0) > _SHORT_CORRECTION * sines
    doubtful = (sines <= eps ** (1 / 3)) | ((sines <= _SMALL_ANGLE) & amplified)
    return jnp.where(jnp.any(doubtful & ~dependent), jnp.nan, one)


def _sines(equations: Equations, jacobian: Any) -> Float[Array, " m"]:
    """The sine of the angle between each gradient and the span of those before it, in the metric.
    In a QR decomposition it is the diagonal element of `R` divided by the length of the column. A
    gradient that is zero counts as orthogonal to all others."""
    _, unit = scaled_rows(equations.scaled(jacobian))
    columns = unit.astype(np.promote_types(unit.dtype, np.float32)).T  # LAPACK has no float16
    norms = jnp.linalg.norm(columns, axis=0)
    lengths = jnp.abs(jnp.diagonal(jnp.linalg.qr(columns, mode="r")))
    # If there are more constraints than unknowns, those that are left over depend on the others.
    lengths = jnp.pad(lengths, (0, norms.size - lengths.size))
    return jnp.where(norms > 0, lengths / jnp.where(norms > 0, norms, 1), 1).astype(unit.dtype)
