"""What `fit` is given, checked before compilation, as a network and a problem."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import NamedSharding
from jaxtyping import Array, PRNGKeyArray

from ..._balance import refuse_rates
from ..._custom_types import Args, Manifold, Y
from ..._diagnostics.check_invariance import check_invariance
from ..._manifold import FirstIntegral, check_manifold, check_vector_field, named_entries
from ..._options import one_of
from ..._tree import ravel
from .._networks.deeponet import DeepONet
from .._networks.domain import Box
from .._networks.flat import check_key, check_scalars, stacked_vectors
from .._networks.flow_map import AbstractFlowMap, args_domain_of, as_flow_map
from .._networks.pinn import PINN
from .._networks.taylor import Taylor
from .._networks.trainable import Points, checked_part
from .._networks.wrappers import OfPairs, field_of_pairs, pair
from .._solvers.checks import check_output
from .data import as_data, as_sampler
from .loop import FitState
from .objective import Problem, VectorField
from .recipe import Recipe, second_order

# The derivative of a first integral, relative to its terms, is roundoff. Single precision has much
# of it at rest, where these terms are small.
_CONSERVED = 1e-2


def check_types(key: Any, recipe: Any, state: Any, progress: Any, **limits: Any) -> None:
    """Raises unless these arguments of `fit` are of the right types, and the limits positive."""
    check_key(key)
    checked_part("recipe", recipe, Recipe)
    checked_part("state", state, FitState)
    if not (isinstance(progress, bool) or callable(progress)):
        raise TypeError(f"`progress` is {progress!r}, but it must be a boolean or a function.")
    check_scalars(above=0.0, **limits)


def checked_sharding(sharding: Any, recipe: Recipe) -> NamedSharding | None:
    """`sharding`; raises unless it can share out the points of the recipe evenly."""
    checked_part("sharding", sharding, NamedSharding)
    if sharding is not None:
        try:
            sharding.shard_shape((recipe.points,))
        except ValueError as error:
            raise ValueError(
                f"`sharding` cannot share out the {recipe.points} points of the recipe evenly. "
                "Give one of another number: `dataclasses.replace(recipe, points=...)`."
            ) from error
    return sharding


def checked(
    model: Any,
    vector_field: VectorField | None,
    key: PRNGKeyArray,
    sample: Any,
    data: Any,
    args: Args,
    recipe: Recipe | None,
    manifold: Manifold | None,
) -> tuple[Any, Problem]:
    """The flow map, or the first window of a PINN, and the problem; raises unless they fit."""
    if vector_field is None and data is None:
        raise TypeError("`fit` needs a `vector_field`, or for a flow map `data`.")
    if vector_field is not None:
        check_vector_field(vector_field)
    if manifold is not None:
        check_manifold(manifold)
        refuse_rates(manifold, "a training")
        if not isinstance(model, PINN):
            raise ValueError(
                "`manifold` is for the windows of a `PINN`. Give the network a `layer`, or wrap "
                "its solver in `ManifoldProjection`."
            )
    recipe = second_order(model) if recipe is None else recipe
    if isinstance(model, PINN):
        if sample is not None or data is not None:
            raise ValueError("A `PINN` has one initial state: leave `sample` and `data` out.")
        network, problem = model.window(0), Problem(vector_field, args, None, None, recipe)
    else:
        network, problem = _of_flow_map(model, vector_field, sample, data, args, recipe)
    starts = network.starts(problem.draw(network, jr.split(key)[0]))
    _check_precision(model, starts.y0s)
    if vector_field is not None:
        _check_field(network, problem, starts)
    if network.layer is not None:
        _check_layer(network, problem, starts)
    if vector_field is None:
        return network, problem
    return _with_taylor(network, problem, vector_field), problem


def _of_flow_map(
    model: Any, field: Any, sample: Any, data: Any, args: Args, recipe: Recipe
) -> tuple[AbstractFlowMap, Problem]:
    if sample is not None and field is None:
        raise TypeError("`sample` is only used with a `vector_field`: leave it out.")
    flow_map, domain, sample = as_flow_map(model), args_domain_of(model), as_sampler(sample)
    if not any(map(eqx.is_inexact_array, jtu.tree_leaves(flow_map.weights()))):
        raise ValueError(
            f"`fit` was given a {type(model).__name__}, which has no weights of its own. "
            "Train its inner `flow_map` if it has one, and repeat that."
        )
    if sample is None and data is None:
        if not isinstance(flow_map.domain, Box):
            raise ValueError(
                "This flow map has no `domain` to draw initial states from: pass `sample`, states "
                "or a function from a random key to one."
            )
        sample = flow_map.domain.sample
    if domain is not None:
        if args is not None:
            raise ValueError(
                "Leave `args` out: this flow map takes them as inputs, and a training draws them "
                "from its `args_domain`."
            )
        flow_map = OfPairs(flow_map)
        field = None if field is None else eqx.Partial(field_of_pairs, field)
        sample = None if sample is None else eqx.Partial(pair, sample, domain)
    found = None if data is None else as_data(data, flow_map)
    if found is not None and field is not None:
        sample = sample or found.sample
    return flow_map, Problem(field, args, sample, found, recipe)


def _with_taylor(network: Any, problem: Problem, vector_field: VectorField) -> Any:
    """The network, if it is a DeepONet with the Taylor polynomial of the recipe."""
    inner: Any = network.flow_map if isinstance(network, OfPairs) else network
    order = problem.recipe.taylor
    if not (order and isinstance(inner, DeepONet) and inner.taylor is None):
        return network
    # The polynomial helps only if the field changes by little in a step, at most of the states.
    if not inner.max_step * _rate_of_change(problem) <= 3.0:
        return network
    taylor = Taylor(vector_field, order, args=problem.args)
    inner = eqx.tree_at(lambda m: m.taylor, inner, taylor, is_leaf=lambda x: x is None)
    return OfPairs(inner) if isinstance(network, OfPairs) else inner


@eqx.filter_jit
def _rate_of_change(problem: Problem) -> Array:
    """The median of `|f' f| / |f|`."""
    sample = problem.sample
    assert sample is not None

    def at(key: PRNGKeyArray) -> Array:
        y, rate = sample(key), lambda y: problem.field(0.0, y)
        first, second = jax.jvp(rate, (y,), (rate(y),))
        before, after = (jnp.linalg.norm(ravel(x)) for x in (first, second))
        return after / jnp.maximum(before, 1e-30)

    return jnp.median(jax.vmap(at)(jr.split(jr.key(0), 64)))


def _check_precision(model: Any, y0s: Y) -> None:
    """Raises unless each network has the precision of its states, in which it is trained."""
    is_network = lambda x: isinstance(x, DeepONet)  # noqa: E731
    for network in filter(is_network, jtu.tree_leaves(model, is_leaf=is_network)):
        dtype = jnp.result_type(network.scale, *jtu.tree_leaves(y0s))
        if network.precision != dtype:
            raise TypeError(
                f"The weights of the model are {network.precision}, but its states are {dtype}. "
                f"Give the states in {network.precision}, or make a model from states in {dtype}. "
                "To evaluate one in single precision, convert its `core` after the training."
            )


def _check_field(network: Any, problem: Problem, starts: Points) -> None:
    """Raises unless the field fits the states, is finite, and for a flow map is autonomous."""
    y0 = jtu.tree_map(lambda x: x[0], starts.y0s)
    with one_of(starts.y0s, problem.args):
        if isinstance(network, AbstractFlowMap):
            check_output(network, (y0, starts.ts[0]), y0, "model")
        check_output(lambda y: problem.field(starts.ts[0], y), (y0,), y0, "vector_field")
    now = np.asarray(_vectors(problem.field, starts.ts, starts.y0s))
    _check_finite("`vector_field` is", now, starts.y0s)
    if isinstance(network, AbstractFlowMap):
        size = np.max(np.abs(now))
        # Over hundreds of steps: a dose may be given late.
        for time in network.max_step * 0.618 * 1.618 ** np.arange(16):
            later = np.asarray(_vectors(problem.field, starts.ts + time, starts.y0s))
            change = np.max(np.abs(later - now))
            if not change <= 1e-3 * size:
                raise ValueError(
                    f"`vector_field` depends on time: from t = 0 to {time:.3g} it changes by "
                    f"{change:.3g}, where its largest component is {size:.3g}. A flow map is for "
                    "autonomous equations. Make time a component of the state, of rate one."
                )


def _check_finite(what: str, values: np.ndarray, y0s: Y) -> None:
    wrong = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
    if wrong.size:
        y0 = jtu.tree_map(lambda x: np.asarray(x[wrong[0]]), y0s)
        raise ValueError(
            f"{what} not finite at {wrong.size} of {len(values)} initial states, for example at "
            f"{y0}."
        )


def _check_layer(network: Any, problem: Problem, starts: Points) -> None:
    """Raises unless the conserved values are finite, and warns if the field does not conserve them,
    because then the network cannot become the solution."""
    layer = network.layer
    values = np.asarray(_vectors(layer.values, starts.ts, starts.y0s))
    _check_finite("The conserved values of the `layer` are", values, starts.y0s)
    entries = {name: x for name, x in named_entries(layer.manifold) if isinstance(x, FirstIntegral)}
    if problem.vector_field is None or not entries:
        return
    flow_map = isinstance(network, AbstractFlowMap)
    ts, ys = _shortly_after(problem, starts, network.max_step if flow_map else network.length)
    field = eqx.Partial(_field_of, problem)
    report = check_invariance(field, entries, ys, t=ts, args=layer.args, rtol=_CONSERVED)
    for entry in report.entries:
        if not entry.defect <= _CONSERVED:
            warnings.warn(
                f"`vector_field` does not conserve `{entry.name}` of the `layer`: its derivative "
                f"is {entry.defect:.1g} of the size of its terms. The network cannot become the "
                "solution. Check both, and the `args` of the layer, by `check_invariance`.",
                stacklevel=4,
            )


@eqx.filter_jit
def _shortly_after(problem: Problem, starts: Points, length: Any) -> tuple[Array, Y]:
    """Times and states a little later. At rest itself any function of the velocity is constant."""
    few = jtu.tree_map(lambda x: x[:64], starts)
    h = jnp.sqrt(jnp.finfo(few.ts.dtype).eps) * length
    rates = jax.vmap(problem.field)(few.ts, few.y0s)
    return few.ts + h, jtu.tree_map(lambda y, f: y + (h * f).astype(y.dtype), few.y0s, rates)


def _field_of(problem: Problem, t: Any, y: Y, args: Args) -> Y:
    del args  # those of the layer
    return problem.field(t, y)


@eqx.filter_jit
def _vectors(function: Any, ts: Array, y0s: Y) -> Array:
    return stacked_vectors(jax.vmap(function)(ts, y0s))
