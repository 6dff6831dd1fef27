"""The one loop of the projections: Newton's method for the multipliers.

A single trajectory is fastest in arrays. In a batch of small systems the same iteration is written
out in scalars; in every batch, lanes iterate together until none goes on.
"""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, Int8

from .equations import Equations, any_lane, relative, within
from .gram import (
    WRITTEN_OUT_MAX,
    Factors,
    combined,
    factor,
    gram_matrix,
    gram_solve,
    row_sizes,
    solve_factored,
)
from .scalars import components, in_scalars, joined

# An iteration ends at this fraction of the tolerance, or at most two iterations after it.
_SAFELY = 0.25
# The largest state of which a batch is written out in scalars.
_UNKNOWNS_MAX = 8
# The iterations of a batch before the first test: enough for most steps of an integrator.
_UNTESTED = 2

# The directions of the correction, and the factors of the Gram matrix if they are kept.
_Base = tuple[Float[Array, "m n"], Factors | None]
# The state, whether it is on the manifold, and the number of iterations.
Solved = tuple[Float[Array, " n"], Bool[Array, ""], Int[Array, ""]]


def solve(
    equations: Equations,
    candidate: Float[Array, " n"],
    *,
    max_steps: int,
    directions: Float[Array, "m n"] | None = None,
    fresh: bool = False,
) -> Solved:
    """The state `y = ŷ + Dᵀ λ` on the manifold. The directions `D` are by default `G M⁻¹` at the
    candidate; with `fresh` they are that of the last state, and damped."""
    arrays, static = eqx.partition((equations, candidate, directions), eqx.is_array)
    run = ft.partial(_solve, max_steps=max_steps, fresh=fresh)

    @jax.custom_batching.custom_vmap
    def alone(arrays: Any) -> Solved:
        return run(*eqx.combine(arrays, static), small=False)

    @alone.def_vmap
    def batched(size: int, axes: Any, arrays: Any) -> Any:
        del size
        equations, y, _ = eqx.combine(arrays, static)
        small = (
            max(y.shape[-1] / _UNKNOWNS_MAX, equations.magnitude.shape[-1] / WRITTEN_OUT_MAX) <= 1
        )
        lane = lambda x: run(*eqx.combine(x, static), small=small and not fresh)  # noqa: E731
        (axes,) = jtu.tree_map(lambda batched: 0 if batched else None, axes)
        return jax.vmap(lane, (axes,))(arrays), (True, True, True)

    return alone(arrays)


def _solve(
    equations: Equations,
    candidate: Array,
    directions: Array | None,
    *,
    max_steps: int,
    fresh: bool,
    small: bool,
) -> Solved:
    begin = ft.partial(_base, equations, directions, fresh)
    further, test = ft.partial(_further, equations), ft.partial(_test, equations)
    y, left = candidate, jnp.asarray(max_steps + 1, jnp.int8 if max_steps < 127 else jnp.int32)
    if small:
        base = jax.eval_shape(begin, y)
        fns = in_scalars(begin, y), in_scalars(further, base, y), in_scalars(test, base, y, left)
        if small := None not in fns:
            # From here on arrays are tuples of scalars.
            (begin, further, test), y = fns, components(y)
    base, count = begin(y), jnp.asarray(0)
    for _ in range(min(_UNTESTED, max_steps) if small else 0):
        y, left, count = further(base, y), left - 1, count + 1

    def body(carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        y, left = test(base, *carry[:2])
        return y, left, carry[2] + (left > 0)

    y, left, count = lax.while_loop(lambda carry: any_lane(carry[1] > 0), body, (y, left, count))
    return joined(candidate, y), left == 0, count


def _base(
    equations: Equations, directions: Array | None, fresh: bool, y: Float[Array, " n"]
) -> _Base | None:
    if fresh:
        return None
    if directions is not None:
        return directions / row_sizes(directions)[:, None], None
    _, jacobian = equations.linearise(y)
    sizes = row_sizes(jacobian)
    unit = jacobian / sizes[:, None]
    rows = equations.weighted(unit)
    return rows, factor(gram_matrix(unit, rows), sizes) if len(rows) > WRITTEN_OUT_MAX else None


def _test(
    equations: Equations, base: _Base | None, y: Float[Array, " n"], left: Int8[Array, ""]
) -> tuple[Float[Array, " n"], Int8[Array, ""]]:
    """One linearisation: residual, scale and verdict at the state itself, and the next state.
    `left` counts the iterations that are left; 0 is success, -1 failure."""
    g, jacobian = equations.linearise(y)
    scale = equations.scale(jacobian, y)
    tolerance = equations.tolerance(scale)
    ok, safe = within(g, tolerance), within(g, _SAFELY * tolerance)
    less = jnp.where(ok, jnp.minimum(left - 1, 2), left - 1)
    now = jnp.where(safe, 0, jnp.where(left == 1, jnp.where(ok, 0, -1), less))
    left = jnp.where(left > 0, now, left).astype(left.dtype)
    return jnp.where(left > 0, _corrected(equations, base, y, g, jacobian, scale), y), left


def _further(equations: Equations, base: _Base, y: Float[Array, " n"]) -> Float[Array, " n"]:
    return _corrected(equations, base, y, *equations.linearise(y), equations.magnitude)


def _corrected(
    equations: Equations, base: _Base | None, y: Array, g: Array, jacobian: Array, scale: Array
) -> Float[Array, " n"]:
    """`y - Dᵀ (G Dᵀ)⁻¹ g`. A new component of two units of roundoff of the old one is zero:
    otherwise a component whose true value is zero would never be small relative to itself."""
    if base is not None and base[1] is not None:
        rows, factors = base
        multiplier = solve_factored(factors, g)
    else:
        sizes = row_sizes(jacobian)
        unit, g = jacobian / sizes[:, None], g / sizes
        rows = equations.weighted(unit) if base is None else base[0]
        far = 0.0 if base is not None else jnp.sum(relative(g, scale / sizes) ** 2)
        multiplier = gram_solve(gram_matrix(unit, rows), g, jnp.minimum(1e-2, far))
    rest = y - combined(multiplier, rows)
    roundoff = 2 * float(jnp.finfo(y.dtype).eps) * jnp.abs(y)
    return jnp.where(jnp.abs(rest) <= roundoff, 0, rest)
