"""`project`, and the function below it that the solver and the interpolation call."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import ArrayLike, PyTree

from .._custom_types import Args, Manifold, RealScalarLike, State, Values, Y
from .._manifold import (
    Constraint,
    FirstIntegral,
    check_manifold,
    check_outputs,
    check_values,
    conserved_values,
    is_entry,
    named_entries,
)
from .._options import dtype_of
from .._tree import from_view, real_view, tree_mul, tree_sub
from .base import AbstractProjection, Problem, ProjectionInfo, check_like, check_projection
from .certainty import if_certain
from .linearise import linearise
from .newton import Newton
from .residual import residual_of
from .step import Step


def project(
    manifold: Manifold,
    y: State,
    *,
    t: RealScalarLike = 0.0,
    args: Args = None,
    value: Values | None = None,
    projection: AbstractProjection | None = None,
) -> tuple[State, ProjectionInfo]:
    r"""Projects one state to the manifold $\{y : g(t, y, args) = 0\}$.

    Use it to make an initial state consistent, or to change the values of its integrals.

    **Arguments:**

    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `y`: the candidate, any PyTree of floating-point arrays, real or complex.
    - `t`, `args`: passed to the functions of the manifold.
    - `value`: the conserved values: a PyTree like `manifold`, with the conserved value in the place
        of each `FirstIntegral` and `None` in the place of each `Constraint`. Not needed if each
        `FirstIntegral` has its own `value`.
    - `projection`: the method. Default: `Newton()`, the nearest point.

    **Returns:**

    The state on the manifold, shaped like `y`, and a
    [`diffrax_conserve.ProjectionInfo`][]. `info.result` tells whether it succeeded: nothing is
    raised at run time.

    **Raises:**

    `TypeError` or `ValueError` if the manifold, the metric or the conserved values do not fit.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(sphere, jnp.array([1.0, 2.0, 2.0]))  # y = (1/3, 2/3, 2/3)
        ```
    """
    check_manifold(manifold)
    projection = Newton() if projection is None else projection
    check_projection(projection)
    check_state(y, kind=jnp.inexact)
    y = jtu.tree_map(jnp.asarray, y)
    check_metric(projection.metric, y)
    check_outputs(manifold, t, y, args)
    values = given_values(manifold, value, t, y, args)
    projected, info = apply(projection, manifold, values, t, y, args)
    return if_certain(projected, manifold, values, t, projected, args), info


def given_values(
    manifold: Manifold, value: Values | None, t: RealScalarLike, y: Y, args: Args
) -> Values:
    """The conserved values that are given by `value`, or by the entries of the manifold."""
    for name, entry in named_entries(manifold):
        if value is None and isinstance(entry, FirstIntegral) and entry.value is None:
            raise ValueError(
                f"`{name}` has no conserved value, so every state would do. Pass `value=...`, for "
                "example `value=integral.fn(t, y_start, args)`, or write "
                "`FirstIntegral(fn, value=...)`."
            )
    values = conserved_values(manifold, t, y, args)
    if value is not None:
        check_values(manifold, value, t, y, args)

        def choose(entry: FirstIntegral | Constraint, given: Values, own: Values) -> Values:
            return own if isinstance(entry, Constraint) else jtu.tree_map(jnp.asarray, given)

        values = jtu.tree_map(choose, manifold, value, values, is_leaf=is_entry)
    check_values(manifold, values, t, y, args)
    return values


def apply(
    projection: AbstractProjection,
    manifold: Manifold,
    values: Values,
    t: RealScalarLike,
    candidate: Y,
    args: Args,
    anchor: Y | None = None,
    step: Step | None = None,
) -> tuple[Y, ProjectionInfo]:
    """`project` without its checks."""
    residual, magnitude = residual_of(manifold, values, t, candidate, args)
    weights = inverse_metric(projection.metric, real_view(candidate))
    like = jtu.tree_map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), candidate)
    problem = Problem(residual, magnitude, weights, t, args, values, like, real_view(anchor), step)
    y, info = projection.solve(problem, real_view(candidate))
    return from_view(y, candidate), info


def tangential(
    projection: AbstractProjection,
    manifold: Manifold,
    values: Values,
    t: RealScalarLike,
    y: Y,
    args: Args,
    vector: Y,
) -> Y:
    """The part of `vector` that is tangent to the manifold at `y`, `v - M⁻¹Gᵀ(GM⁻¹Gᵀ)⁻¹G v`."""
    residual, _ = residual_of(manifold, values, t, y, args)
    weights = inverse_metric(projection.metric, real_view(y))
    _, jacobian = linearise(residual, real_view(y))
    gram_solver = jacobian.gram_solver(weights)
    normal = jacobian.pullback(gram_solver.solve(jacobian.pushforward(real_view(vector))))
    return tree_sub(vector, from_view(tree_mul(normal, weights), vector))


def check_state(y: Y, user: str = "a projection", kind: Any = jnp.floating) -> None:
    """Raises unless every leaf of the state is a floating-point array, as `user` needs."""
    for leaf in jtu.tree_leaves(y):
        dtype = dtype_of(leaf)
        if not jnp.issubdtype(dtype, kind):
            remedy = (
                "floating-point states, real or complex. Convert it, for example by "
                "`jnp.asarray(..., dtype=float)`."
                if kind is jnp.inexact
                else "real floating-point states. Split a complex leaf into its real and its "
                "imaginary part."
            )
            got = f"a leaf of dtype {dtype}" if eqx.is_array_like(leaf) else f"the leaf {leaf!r}"
            raise TypeError(f"The state has {got}, but {user} needs {remedy}")


def check_metric(metric: PyTree[ArrayLike] | None, y: Y) -> None:
    """Raises unless `metric` is structured like the state."""
    if metric is None:
        return
    remedy = "Give one weight (or an array of weights) for each leaf of the state."
    check_like("metric", metric, y, remedy)


def inverse_metric(metric: PyTree[ArrayLike] | None, y: Y) -> Y:
    """`M⁻¹`, shaped like `y`; an infinite weight freezes its component."""
    if metric is None:
        return jtu.tree_map(jnp.ones_like, y)
    return jtu.tree_map(
        lambda weight, leaf: jnp.broadcast_to(1 / jnp.asarray(weight, leaf.dtype), leaf.shape),
        metric,
        y,
    )
