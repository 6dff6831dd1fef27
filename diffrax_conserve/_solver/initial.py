"""The check of the initial state: if it fails, the solve ends with its first step."""

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, FirstIntegral, is_entry
from .._projection.base import AbstractProjection
from .._projection.project import apply
from .._projection.residual import largest, measure, relative
from .._projection.simplified_newton import SimplifiedNewton
from .._tree import tree_all_finite, tree_stop_gradient, working_dtype
from .._with_jacobian import WithJacobian

FINE, NOT_FINITE, VIOLATED, UNREACHABLE, WRONG_JACOBIAN = range(5)


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
) -> Initial:
    """A `Constraint` is violated if its residual is larger than the square root of roundoff,
    relative to the size of its terms; the first step removes smaller ones. A first integral with
    its own `value` may start at another value if a projection from the initial state succeeds. A
    given `jacobian` must agree with difference quotients."""
    # The verdict has no derivative, and the derivative of a given Jacobian may not exist.
    manifold, values, t, y, args = tree_stop_gradient((manifold, values, t, y, args))
    dtype = working_dtype(y)
    limit = jnp.finfo(dtype).eps ** 0.5
    entries, treedef = jtu.tree_flatten(manifold, is_leaf=is_entry)
    residuals, scales = measure(manifold, values, t, y, args, uniform=True)
    ratios = treedef.flatten_up_to(relative(residuals, scales))
    given = [isinstance(x, FirstIntegral) and x.value is not None for x in entries]
    cause, position = jnp.asarray(FINE, jnp.int32), jnp.asarray(0, jnp.int32)
    for i, (entry, ratio, scale) in reversed(
        [*enumerate(zip(entries, ratios, treedef.flatten_up_to(scales), strict=True))]
    ):
        violated = isinstance(entry, Constraint) & ~(largest(ratio) <= limit)
        wrong = jnp.where(violated, VIOLATED, FINE)
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
