"""A manifold at one time, as equations `g(y) = 0` for a state in one real vector.

For a first integral `g = I(t, y, args) - I₀`, for a constraint `g` itself. The *scale* of a
residual at `y`, to which roundoff is proportional, is the size of the terms that cancel in it:
`|I₀| + Σ_k |y_k ∂g/∂y_k|`, and what `roundoff` finds inside `fn` but not in its gradient.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.custom_batching
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, evaluate, is_entry, named_entries
from .._tree import ravel, unflatten, unravel
from .metric import MatrixUnits, Units
from .sparse import Pattern, SparseRows, pattern_of

# The accepted residual in units of roundoff of the scale. Rounding the state and evaluating the
# residual contribute about one unit each.
ROUNDOFF_MULTIPLE = 16
# What a state is, in this order, so that a minimum over the residuals tells it.
NOT_FINITE, OFF, ON, SETTLED = -1, 0, 1, 2
# The noise of a residual as a share of its tolerance, and the tolerance as a share of what the
# gradient shows from which a state counts as near rest.
_NOISE, _NEAR_REST = 1 / 8, 64
Part = Callable[[Float[Array, " n"]], Float[Array, " k"]]
Jacobian = Float[Array, "m n"] | SparseRows


class Equations(eqx.Module):
    """The residuals of a manifold, in the order in which it is flattened.

    - `parts`: the residual of each entry.
    - `magnitude`: the part of the scale that does not depend on the state: `|I₀| + hidden`.
    - `hidden`: the part of it that the gradients do not show.
    - `units`: the unit `s` of each component in which a correction is measured, `M⁻¹ = diag(s²)`,
      or a factor `S` of `M⁻¹ = S Sᵀ`; `None` if all are one. A component whose unit is zero is
      never moved. All linear algebra works with `G S`, whose columns no longer know the units of
      the user: so nothing is squared before it is scaled, and a change of units by powers of two
      changes no bit of the result.
    - `motion`: how far each component moves in a step, where that is known; see `Target`.
    - `rtol`, `atol`: a residual within `rtol * scale + atol` counts as zero.
    - `may_vanish`: whether all terms of a residual may be zero, as those of a `Constraint`.
    - `clip`: within bounds the map to the state from a vector without bounds, then the argument of
      all methods. The residual is the gradient of a convex function of the multipliers with kinks:
      an iteration looks for the minimum along its step.
    - `pattern`: that of a sparse Jacobian.
    """

    parts: tuple[Part, ...]
    magnitude: Float[Array, " m"]
    hidden: Float[Array, " m"]
    units: Units = None
    motion: Float[Array, " n"] | None = None
    rtol: float | Array | None = None
    atol: float | Array | None = None
    may_vanish: bool = eqx.field(default=False, static=True)
    clip: Callable[[Float[Array, " n"]], Float[Array, " n"]] | None = None
    pattern: Pattern | None = eqx.field(default=None, static=True)

    def residual(self, y: Float[Array, " n"]) -> Float[Array, " m"]:
        return jnp.concatenate([part(y) for part in self.parts])

    @eqx.filter_jit  # traced once for all uses
    def linearise(self, y: Float[Array, " n"]) -> tuple[Float[Array, " m"], Jacobian]:
        """`g(y)` and the constraint Jacobian `G(y)`. Entry by entry, so that the rows of one do not
        contain the gradients of the others."""
        if self.pattern is not None:
            return SparseRows.linearised(self.pattern, self.parts, y)
        values, rows = [], []
        for part in self.parts:
            value, vjp = jax.vjp(part, y)
            values.append(value)
            if value.size == 1:
                rows.append(vjp(jnp.ones_like(value))[0][None])
            else:
                rows.append(jax.vmap(vjp)(np.eye(value.size, dtype=value.dtype))[0])
        return jnp.concatenate(values), jnp.concatenate(rows)

    def dense(self) -> "Equations":
        """The same, with a dense Jacobian."""
        return dataclasses.replace(self, pattern=None)

    def scale(self, jacobian: Jacobian, y: Float[Array, " n"]) -> Float[Array, " m"]:
        y = y if self.clip is None else self.clip(y)
        return self.magnitude + shown_terms(jacobian, y)

    def tolerance(self, scale: Float[Array, " m"]) -> Float[Array, " m"]:
        eps = float(jnp.finfo(scale.dtype).eps)
        rtol = ROUNDOFF_MULTIPLE * eps if self.rtol is None else self.rtol
        limit = jnp.asarray(rtol, scale.dtype) * scale
        return limit if self.atol is None else limit + jnp.asarray(self.atol, scale.dtype)

    def level(
        self, g: Float[Array, " m"], scale: Float[Array, " m"]
    ) -> tuple[Int[Array, ""], Float[Array, " m"]]:
        """What a state is, `NOT_FINITE`, `OFF`, `ON` or `SETTLED`, and the noise of the residuals,
        given these and their scales.

        The noise is what only chance could reduce: an eighth of the tolerance, or half of it where
        the tolerance is a large part of what the gradient shows, as near rest, where a correction
        within it would move the state by much. A state is settled if each residual is within twice
        the noise. A residual within a tolerance that underflows says nothing.
        """
        limit = self.tolerance(scale)
        valid = (limit >= float(jnp.finfo(scale.dtype).tiny)) | (scale == 0)
        valid = valid & (limit < jnp.inf)
        near_rest = _NEAR_REST * limit >= scale - self.magnitude
        noise = jnp.where(near_rest, 1 / 2, _NOISE) * limit
        on = jnp.where(jnp.abs(g) <= 2 * noise, jnp.int8(SETTLED), jnp.int8(ON))
        off = jnp.where(jnp.abs(g) < jnp.inf, jnp.int8(OFF), jnp.int8(NOT_FINITE))
        # Not by a maximum of residuals, which can lose NaN on a CPU.
        return jnp.min(jnp.where(valid & (jnp.abs(g) <= limit), on, off)), noise

    def holds(self, y: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether `y` is on the manifold."""
        g, jacobian = self.linearise(y)
        return self.level(g, self.scale(jacobian, y))[0] >= ON

    def scaled(self, rows: Any) -> Any:
        """`G S` for the rows of a Jacobian, or for one gradient."""
        if self.units is None:
            return rows
        if isinstance(self.units, MatrixUnits):
            return self.units.scaled(rows)
        if isinstance(rows, SparseRows):
            return rows.times_columns(self.units)
        return rows * jnp.broadcast_to(self.units, rows.shape)

    def moved(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        """`S u`, the change of the state that is `u` in the units."""
        if isinstance(self.units, MatrixUnits):
            return self.units.moved(change)
        return change if self.units is None else change * self.units


def in_units(change: Float[Array, " n"], units: Units) -> Float[Array, " n"]:
    """A change of the state, each component in its unit; zero where the unit is zero, because such
    a component is never moved."""
    if units is None:
        return change
    if isinstance(units, MatrixUnits):
        return units.measured(in_units(change, units.diagonal))
    moves = units != 0
    return jnp.where(moves, change / jnp.where(moves, units, 1), 0)


def length(change: Float[Array, " n"], units: Units) -> Float[Array, ""]:
    """The length of a change of the state in the metric."""
    return jnp.linalg.norm(in_units(change, units))


def reach(start: Float[Array, " n"], end: Float[Array, " n"], units: Units) -> Float[Array, ""]:
    """The length of a step in the metric, the yardstick of corrections. Each component counts at
    least by the root of roundoff of itself, by which roundoff alone moves a state where gradients
    are nearly parallel: otherwise no correction would be short in a step at rest."""
    least = float(jnp.finfo(end.dtype).eps) ** 0.5 * jnp.abs(end)
    return length(jnp.maximum(jnp.abs(end - start), least), units)


def shown_terms(jacobian: Jacobian, y: Float[Array, " n"]) -> Float[Array, " m"]:
    """`Σ_k |y_k ∂g/∂y_k|`, the part of a scale that the gradient shows."""
    if isinstance(jacobian, SparseRows):
        return jtu.tree_map(jnp.abs, jacobian).times(jnp.abs(y))
    return jnp.sum(jnp.abs(jacobian * y[None]), axis=1)


def relative(residual: Any, scale: Any) -> Any:
    """Residuals relative to their scales; a scale of zero counts as one."""
    return jtu.tree_map(lambda g, s: g / jnp.where(s > 0, s, jnp.ones_like(s)), residual, scale)


def measure(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> tuple[Values, Values]:
    """The residuals at `y` and their scales there, both shaped like the values of the manifold."""
    vector = ravel(y)
    equations = equations_of(manifold, ravel(values).astype(vector.dtype), t, y, args)
    g, jacobian = equations.linearise(vector)
    like = jax.eval_shape(lambda: evaluate(manifold, t, y, args))
    return unflatten(g, like), unflatten(equations.scale(jacobian, vector), like)


def functions_of(manifold: Manifold, t: RealScalarLike, like: Any, args: Args) -> list[Part]:
    """The function of each entry, from the numbers of a state to a vector."""

    def flat(entry: Any) -> Part:
        return lambda y: ravel(evaluate(entry, t, unravel(y, like), args)).astype(y.dtype)

    return [flat(entry) for entry in jtu.tree_leaves(manifold, is_leaf=is_entry)]


def equations_of(
    manifold: Manifold,
    values: Float[Array, " m"],
    t: RealScalarLike,
    like: Any,
    args: Args,
    hidden: Float[Array, " m"] | None = None,
) -> Equations:
    """The equations of a manifold with the conserved `values`, for states like `like`."""
    hidden = jnp.zeros_like(values) if hidden is None else hidden
    like = jax.eval_shape(lambda: like)
    vector, parts, start = jax.eval_shape(ravel, like), [], 0
    functions = functions_of(manifold, t, like, args)
    sizes = [jax.eval_shape(fn, vector).size for fn in functions]
    for fn, size in zip(functions, sizes, strict=True):

        def part(y: Array, fn=fn, start=start, end=start + size) -> Array:
            return fn(y) - values[start:end]

        # Arrays over which `fn` closes become leaves, and can be differentiated.
        parts.append(_Converted(eqx.filter_closure_convert(part, vector)))
        start += size
    magnitude = lax.stop_gradient(jnp.abs(values) + hidden)
    may_vanish = any(isinstance(x, Constraint) for _, x in named_entries(manifold))
    pattern = pattern_of(functions, sizes, vector)
    return Equations(tuple(parts), magnitude, hidden, may_vanish=may_vanish, pattern=pattern)


class _Known:
    """An array that is not a leaf of arrays, so that no transformation makes it a tracer."""

    def __init__(self, value: Any):
        self.value = value


class _Converted(eqx.Module):
    """A converted function that still knows the integers over which it closes: `scalars` moves
    elements only by indices that are known."""

    fn: Any

    def __init__(self, fn: Any):
        def known(x: Any) -> Any:
            constant = hasattr(x, "dtype") and not isinstance(x, jax.core.Tracer)
            return _Known(x) if constant and not jnp.issubdtype(x.dtype, jnp.inexact) else x

        self.fn = jtu.tree_map(known, fn)

    def __call__(self, y: Array) -> Array:
        return jtu.tree_map(lambda x: x.value if isinstance(x, _Known) else x, self.fn)(y)


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether the flag of any lane of a batch is set: a loop with this condition has no selects."""
    return flag


@any_lane.def_vmap
def _any_lane(size: int, axes: Any, flags: Bool[Array, " lanes"]) -> tuple[Array, bool]:
    del size, axes
    return any_lane(jnp.any(flags)), False
