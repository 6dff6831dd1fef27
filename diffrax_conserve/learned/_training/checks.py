"""What `fit` is given, checked before compilation, as a network and a problem."""

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
from ..._manifold import check_manifold, check_vector_field
from ..._options import one_of
from ..._tree import ravel
from .._networks.deeponet import DeepONet
from .._networks.domain import Box
from .._networks.flat import check_key, check_scalars, stacked_vectors
from .._networks.flow_map import AbstractFlowMap, args_domain_of, as_flow_map
from .._networks.pinn import PINN
from .._networks.taylor import Taylor
from .._networks.trainable import checked_part
from .._networks.wrappers import OfPairs, field_of_pairs, pair
from .._solvers.checks import check_output
from .data import as_data, as_sampler
from .objective import Problem, VectorField
from .recipe import Recipe, second_order
from .state import FitState


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
    if vector_field is None:
        return network, problem
    _check_field(network, problem, jr.split(key)[0])
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
    is_network = lambda x: isinstance(x, DeepONet)  # noqa: E731
    networks = filter(is_network, jtu.tree_leaves(model, is_leaf=is_network))
    if any(network.precision != network.scale.dtype for network in networks):
        raise TypeError(
            "The weights of the model are float32, but its states are float64. Train it in double "
            "precision, and convert its `core` afterwards."
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


def _check_field(network: Any, problem: Problem, key: PRNGKeyArray) -> None:
    """Raises unless the field fits the states, is finite, and for a flow map is autonomous."""
    starts = network.starts(problem.draw(network, key))
    y0 = jtu.tree_map(lambda x: x[0], starts.y0s)
    with one_of(starts.y0s):
        check_output(lambda y: problem.field(starts.ts[0], y), (y0,), y0, "vector_field")
    now = np.asarray(_rates(problem, starts.ts, starts.y0s))
    wrong = np.flatnonzero(~np.all(np.isfinite(now), axis=1))
    if wrong.size:
        y0 = jtu.tree_map(lambda x: np.asarray(x[wrong[0]]), starts.y0s)
        raise ValueError(
            f"`vector_field` is not finite at {wrong.size} of {len(now)} initial states, for "
            f"example at {y0}."
        )
    if isinstance(network, AbstractFlowMap):
        size = np.max(np.abs(now))
        # Over hundreds of steps: a dose may be given late.
        for time in network.max_step * 0.618 * 1.618 ** np.arange(16):
            later = np.asarray(_rates(problem, starts.ts + time, starts.y0s))
            change = np.max(np.abs(later - now))
            if not change <= 1e-3 * size:
                raise ValueError(
                    f"`vector_field` depends on time: from t = 0 to {time:.3g} it changes by "
                    f"{change:.3g}, where its largest component is {size:.3g}. A flow map is for "
                    "autonomous equations. Make time a component of the state, of rate one."
                )


@eqx.filter_jit
def _rates(problem: Problem, ts: Array, y0s: Y) -> Array:
    return stacked_vectors(jax.vmap(problem.field)(ts, y0s))
