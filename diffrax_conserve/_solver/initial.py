"""The check of the initial state: if it fails, the solve ends with its first step."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, FirstIntegral, is_entry
from .._projection.base import AbstractProjection
from .._projection.linearise import linearise
from .._projection.project import apply
from .._projection.residual import largest, relative, residual_of
from .._projection.simplified_newton import SimplifiedNewton
from .._tree import (
    real_view,
    tree_all_finite,
    tree_stop_gradient,
    tree_uniform,
    unflatten,
    working_dtype,
)
from .._with_jacobian import WithJacobian
from .change import change_along

FINE, NOT_FINITE, VIOLATED, UNREACHABLE, WRONG_JACOBIAN, NOT_CONSERVED = range(6)
# A first integral is not conserved if it changes along a short trajectory by more than this,
# relative to the terms that should cancel, and by more than this times the change's error.
_CHANGE, _SURE = 1e-4, 30


class Initial(eqx.Module):
    """The verdict on an initial state: one of the causes above, the position of the responsible
    entry of the manifold, and how far the first projection must move the state to a `value` that
    differs from that of the initial state."""

    cause: Int[Array, ""]
    position: Int[Array, ""]
    offset: Array


def judge(
    projection: AbstractProjection,
    manifold: Manifold,
    values: Values,
    t: RealScalarLike,
    y: Y,
    args: Args,
    vector_field: Callable[[RealScalarLike, Y], Y] | None,
    step: RealScalarLike,
) -> Initial:
    """A `Constraint` is violated if its residual is larger than the square root of roundoff,
    relative to the size of its terms; the first step removes smaller ones. A first integral with
    its own `value` may start at another value if a projection from the initial state succeeds. A
    given `jacobian` must agree with difference quotients. With a `vector_field`, the slope `f(t,
    y)`, first integrals must not change along its trajectory."""
    # The verdict has no derivative, and the derivative of a given Jacobian may not exist.
    manifold, values, t, y, args = tree_stop_gradient((manifold, values, t, y, args))
    dtype = working_dtype(y)
    limit = jnp.finfo(dtype).eps ** 0.5
    entries, treedef = jtu.tree_flatten(manifold, is_leaf=is_entry)
    residual, magnitude = residual_of(manifold, values, t, y, args)
    view = real_view(y)
    g, jacobian = linearise(residual, view)
    # A constraint on a component that is zero up to roundoff has this scale too.
    scale = magnitude + jacobian.scale(tree_uniform(view))
    changed = jnp.zeros_like(g)
    if vector_field is not None and any(isinstance(x, FirstIntegral) for x in entries):
        along = vector_field, manifold, values, t, y, args, step, g
        change, error, moved = change_along(*along)
        terms = magnitude + jacobian.scale(jtu.tree_map(lambda x, d: jnp.abs(x) + d, view, moved))
        least = jnp.maximum(_CHANGE * terms, jnp.maximum(_SURE * error, limit * scale))
        # NaN tells nothing: `fn` need not be defined beside the initial state.
        changed = (jnp.abs(change) > least).astype(g.dtype)
    ratios, scales, changes = (
        treedef.flatten_up_to(unflatten(x, values)) for x in (relative(g, scale), scale, changed)
    )
    given = [isinstance(x, FirstIntegral) and x.value is not None for x in entries]
    cause, position = jnp.asarray(FINE, jnp.int32), jnp.asarray(0, jnp.int32)
    for i, (entry, ratio, scale, change) in reversed(
        [*enumerate(zip(entries, ratios, scales, changes, strict=True))]
    ):
        if isinstance(entry, Constraint):
            wrong = jnp.where(largest(ratio) <= limit, FINE, VIOLATED)
        else:
            wrong = jnp.where(largest(change) > 0, NOT_CONSERVED, FINE)
        if isinstance(entry.fn, WithJacobian):
            wrong = jnp.where(entry.fn.is_wrong(t, y, args), WRONG_JACOBIAN, wrong)
        wrong = jnp.where(tree_all_finite((ratio, scale)), wrong, NOT_FINITE)
        position = jnp.where(wrong != FINE, i, position).astype(jnp.int32)
        cause = jnp.where(wrong != FINE, wrong, cause).astype(jnp.int32)
    offset = jnp.zeros((), dtype)
    if any(given):
        if projection.sees_step:  # there is no step yet
            projection = SimplifiedNewton(metric=projection.metric)
        _, info = apply(projection, manifold, values, t, y, args)
        unreachable = (cause == FINE) & ~info.ok
        cause = jnp.where(unreachable, UNREACHABLE, cause).astype(jnp.int32)
        position = jnp.where(unreachable, given.index(True), position).astype(jnp.int32)
        offset = jnp.where(info.ok, info.correction, 0).astype(dtype)
    return Initial(cause, position, offset)
