"""The check of the initial state: if it fails, the solve ends with its first step."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int

from .._balance import rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import AbstractConserved, Constraint, FirstIntegral, is_entry
from .._projection.base import AbstractProjection
from .._projection.linearise import linearise
from .._projection.project import apply
from .._projection.residual import largest, measure, relative, residual_of
from .._projection.simplified_newton import SimplifiedNewton
from .._tree import (
    real_view,
    tree_add,
    tree_all_finite,
    tree_norm,
    tree_scale,
    tree_stop_gradient,
    unflatten,
    working_dtype,
)
from .._with_jacobian import WithJacobian

FINE, NOT_FINITE, VIOLATED, UNREACHABLE, WRONG_JACOBIAN, NOT_CONSERVED = range(6)
# A first integral is not conserved if it changes by more than this along the vector field, relative
# to the terms that should cancel. Integrals that a discretisation nearly conserves are accepted.
_CHANGE = 1e-2
# The change is evaluated one step later, because at a state of rest the terms vanish, but where the
# state has moved by at most this share of its size.
_NEAR = 1e-3


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
    vector_field: Callable[[Y], Y] | None,
    step: RealScalarLike,
) -> Initial:
    """A `Constraint` is violated if its residual is larger than the square root of roundoff,
    relative to the size of its terms; the first step removes smaller ones. A first integral with
    its own `value` may start at another value if a projection from the initial state succeeds. A
    given `jacobian` must agree with difference quotients. With a `vector_field`, `y -> f(t, y,
    args)`, first integrals must not change along it."""
    # The verdict has no derivative, and the derivative of a given Jacobian may not exist.
    manifold, values, t, y, args = tree_stop_gradient((manifold, values, t, y, args))
    dtype = working_dtype(y)
    limit = jnp.finfo(dtype).eps ** 0.5
    entries, treedef = jtu.tree_flatten(manifold, is_leaf=is_entry)
    residuals, scales = measure(manifold, values, t, y, args, uniform=True)
    ratios = treedef.flatten_up_to(relative(residuals, scales))
    given = [isinstance(x, FirstIntegral) and x.value is not None for x in entries]
    changes: dict[int, Values] = {}
    if vector_field is not None:
        seen = {i: x for i, x in enumerate(entries) if _is_seen(x)}
        parts = treedef.flatten_up_to(values)
        kept = [parts[i] for i in seen]
        found = _changes([*seen.values()], kept, t, y, args, vector_field, step)
        changes = dict(zip(seen, found, strict=True))
    cause, position = jnp.asarray(FINE, jnp.int32), jnp.asarray(0, jnp.int32)
    for i, (entry, ratio, scale) in reversed(
        [*enumerate(zip(entries, ratios, treedef.flatten_up_to(scales), strict=True))]
    ):
        violated = isinstance(entry, Constraint) & ~(largest(ratio) <= limit)
        wrong = jnp.where(violated, VIOLATED, FINE)
        if i in changes:
            # NaN tells nothing: `fn` need not be defined beside the initial state.
            wrong = jnp.where(largest(changes[i]) > _CHANGE, NOT_CONSERVED, wrong)
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


def _is_seen(entry: AbstractConserved) -> bool:
    """Whether an entry is a first integral with a derivative by time."""
    return isinstance(entry, FirstIntegral) and not isinstance(entry.fn, WithJacobian)


def _changes(
    manifold: list[AbstractConserved],
    values: list[Values],
    t: RealScalarLike,
    y: Y,
    args: Args,
    vector_field: Callable[[Y], Y],
    step: RealScalarLike,
) -> list[Values]:
    """The derivative of each first integral along the vector field, less its rate, relative to the
    sum of the moduli of its terms."""
    if not manifold:
        return []
    slope = tree_stop_gradient(vector_field(y))
    size, speed = tree_norm(y), tree_norm(slope)
    moves = (size > 0) & (speed > 0)
    time = jnp.where(moves, size / jnp.where(moves, speed, 1), jnp.inf)
    # Nearer than the square root of roundoff, terms that vanished are still lost in it.
    least = jnp.where(moves, jnp.finfo(working_dtype(y)).eps ** 0.5 * time, 0)
    y = tree_add(y, tree_scale(jnp.clip(jnp.abs(step), least, _NEAR * time), slope))
    t = jnp.asarray(t, working_dtype(y))

    def residual(t: Array) -> tuple[Array, Values]:
        fn, _ = residual_of(manifold, values, t, y, args)
        return fn(real_view(y)), rates(manifold, t, y, args)

    fn, _ = residual_of(manifold, values, t, y, args)
    _, jacobian = linearise(fn, real_view(y))
    direction = real_view(tree_stop_gradient(vector_field(y)))
    (_, rate), (in_time, _) = jax.jvp(residual, (t,), (jnp.ones_like(t),))
    rate = jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(rate)])
    change = jacobian.pushforward(direction) + in_time - rate
    terms = jacobian.scale(direction) + jnp.abs(in_time) + jnp.abs(rate)
    return unflatten(relative(change, terms), values)
