"""The defect `du/dt - f(t, u)` of a network at a batch of collocation points."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ..._custom_types import Args, RealScalarLike, Y
from ..._tree import tree_sub
from .._networks.trainable import AbstractTrainable, LayerSchedule, Points

VectorField = Callable[[RealScalarLike, Any, Args], Any]


def defects(
    model: AbstractTrainable,
    vector_field: VectorField,
    args: Args,
    points: Points,
    schedule: LayerSchedule,
) -> Float[Array, "points n"]:
    """`du/dt - f(t, u)` at every point, as vectors in the units of the model.

    The time derivative is one forward-mode pass over the whole batch. A `vmap` of forward passes
    takes twice as long, and reverse mode six times as long.
    """

    def states(ts: Array) -> Y:
        return model.states(points, ts, schedule)

    y, derivative = jax.jvp(states, (points.ts,), (jnp.ones_like(points.ts),))
    defect = tree_sub(derivative, _field(vector_field, args, points.ts, y))
    return model.measured(points, defect)


def typical_square(
    model: AbstractTrainable, vector_field: VectorField, args: Args, points: Points
) -> Float[Array, ""]:
    """The median of `|f|²` over the initial states."""
    starts = model.starts(points)
    fields = _field(vector_field, args, starts.ts, starts.y0s)
    return jnp.median(squared_norms(model.measured(starts, fields)))


def _field(vector_field: VectorField, args: Args, ts: Array, ys: Y) -> Y:
    return jax.vmap(vector_field, in_axes=(0, 0, None))(ts, ys, args)


def squared_norms(vectors: Float[Array, "points n"]) -> Float[Array, " points"]:
    """The squared norms of vectors stacked along a leading axis."""
    return jnp.sum(jnp.square(vectors), axis=1)


def trainable(model: AbstractTrainable) -> Any:
    """`model` with `True` in the place of every weight and `False` elsewhere."""
    return _marked(model, model.weights, jtu.tree_map(eqx.is_inexact_array, model.weights()))


def linear_weights(model: AbstractTrainable) -> Any:
    """`model` with `True` in the place of every weight in which its output is linear, and `False`
    elsewhere."""
    weights = model.linear_weights()
    return _marked(model, model.linear_weights, jtu.tree_map(lambda _: True, weights))


def _marked(model: AbstractTrainable, where: Callable[[], Any], marks: Any) -> Any:
    """`model` with `marks` at the place that the method `where` returns, and `False` elsewhere."""
    nothing = jtu.tree_map(lambda _: False, model)
    if not jtu.tree_leaves(marks):
        return nothing
    return eqx.tree_at(lambda m: getattr(m, where.__name__)(), nothing, marks)
