"""The defect `du/dt - f(t, u)` of a network at a batch of collocation points."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._custom_types import Args, RealScalarLike, Y
from .._network import ConservativeLayer, DeepONet, Window, output_layer
from .._tree import tree_sub
from ._sampling import Times

VectorField = Callable[[RealScalarLike, Any, Args], Any]
Sampler = Callable[[PRNGKeyArray], Any]


class Points(NamedTuple):
    """Collocation points: times, and for a flow map the initial state of each."""

    ts: Float[Array, " points"]
    y0s: Any  # with a leading axis; None for a PINN


def draw(model: Any, times: Times, sample: Sampler | None, count: int, key: PRNGKeyArray) -> Points:
    """`count` random points for `model`."""
    times_key, states_key = jr.split(key)
    if isinstance(model, Window):
        return Points(model.start + times(times_key, count, 0.0, model.length), None)
    assert sample is not None
    y0s = jax.vmap(sample)(jr.split(states_key, count))
    return Points(times(times_key, count, 0.0, float(model.max_step)), y0s)


def layer_of(model: Any) -> ConservativeLayer | None:
    """The conservative layer of the network, if it has one."""
    layer = getattr(model, "layer", None)
    return layer if isinstance(layer, ConservativeLayer) else None


def path(model: Any, points: Points, p: Int[Array, ""], s: Array) -> Callable[[Array], Y]:
    """The states as a function of the times of all points."""
    layer = layer_of(model)
    # A flow map of the user's own has no separate last layer.
    candidate = model if layer is None else model.candidate

    def values(y0: Y, t0: RealScalarLike) -> Any:
        return None if layer is None else layer.values(t0, y0)

    if isinstance(model, Window):
        start = values(model.y0, model.start)
        targets = jtu.tree_map(lambda v: jnp.broadcast_to(v, points.ts.shape + v.shape), start)
    else:
        targets = jax.vmap(values, in_axes=(0, None))(points.y0s, 0.0)

    def states(ts: Array) -> Y:
        if isinstance(model, Window):
            out = jax.vmap(candidate)(ts)
        else:
            out = jax.vmap(candidate)(points.y0s, ts)
        if layer is None:
            return out
        # The schedule is not batched: iterations that it leaves out are not computed.
        conserve = jax.vmap(layer, in_axes=(0, 0, 0, None, None))
        return conserve(out, targets, ts, model.radius(), (p, s))

    return states


def defects(
    model: Any,
    vector_field: VectorField,
    args: Args,
    points: Points,
    p: Int[Array, ""],
    s: Array,
) -> Float[Array, "points n"]:
    """`du/dt - f(t, u)` at every point, as vectors; for a model with frames, in those.

    The time derivative is one forward-mode pass over the whole batch: half the time of a `vmap` of
    forward passes, and a sixth of that of reverse mode.
    """
    states = path(model, points, p, s)
    y, derivative = jax.jvp(states, (points.ts,), (jnp.ones_like(points.ts),))
    defect = tree_sub(derivative, _field(vector_field, args, points.ts, y))
    return _measured(model, points.y0s, defect)


def _measured(model: Any, y0s: Y, rates: Y) -> Float[Array, "points n"]:
    """Rates of change of the states as vectors, in the frames of their initial states if the model
    has frames."""
    leaves = [x.reshape(x.shape[0], -1) for x in jtu.tree_leaves(rates)]
    vectors = leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves, axis=1)
    frame = model.frame if isinstance(model, DeepONet) else None
    if frame is None:
        return vectors
    return jax.vmap(lambda y0, rate: frame(y0).measure(rate))(y0s, vectors)


def typical_square(
    model: Any, vector_field: VectorField, args: Args, points: Points
) -> Float[Array, ""]:
    """The median of `|f|²` over the initial states."""
    if isinstance(model, Window):
        y0s = jtu.tree_map(lambda x: x[None], model.y0)
        return squared_norms(_field(vector_field, args, model.start[None], y0s))[0]
    ts = jnp.zeros_like(points.ts)
    fields = _field(vector_field, args, ts, points.y0s)
    return jnp.median(squared_norms(_measured(model, points.y0s, fields)))


def _field(vector_field: VectorField, args: Args, ts: Array, ys: Y) -> Y:
    return jax.vmap(vector_field, in_axes=(0, 0, None))(ts, ys, args)


def squared_norms(vectors: Y) -> Float[Array, " points"]:
    """Of vectors that are stacked along a leading axis, in each leaf."""
    leaves = [jnp.square(x).reshape(x.shape[0], -1) for x in jtu.tree_leaves(vectors)]
    return sum(jnp.sum(x, axis=1) for x in leaves)  # pyright: ignore


def trainable(model: Any) -> Any:
    """`model` with `True` in the place of every weight and `False` elsewhere.

    Of our own networks only what is called a network is trained: not the initial state, the largest
    step or the scales, which are arrays too.
    """
    nothing = jtu.tree_map(lambda _: False, model)
    everything = jtu.tree_map(eqx.is_inexact_array, model)
    where = _weights(model)
    return everything if where is None else eqx.tree_at(where, nothing, where(everything))


def _weights(model: Any) -> Callable[[Any], Any] | None:
    if isinstance(model, Window):
        return lambda m: m.net
    if isinstance(model, DeepONet):
        return lambda m: m.core
    return None


def linear_weights(model: Any) -> Any:
    """`model` with `True` in the place of every weight that its output is linear in."""

    def last_layer(model: Any) -> Any:
        net = model.net if isinstance(model, Window) else output_layer(model.core)
        return net.weights[-1], net.biases[-1]

    nothing = jtu.tree_map(lambda _: False, model)
    # With a conservative layer after it, the output is not linear in the last layer.
    known = isinstance(model, Window | DeepONet) and model.layer is None
    return eqx.tree_at(last_layer, nothing, (True, True)) if known else nothing
