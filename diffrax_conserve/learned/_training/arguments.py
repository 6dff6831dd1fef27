"""The checks of the arguments of `fit`, made before compilation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from ..._balance import refuse_rates
from ..._custom_types import Args, Manifold, Y
from ..._manifold import check_manifold, check_outputs
from ..._options import check_number
from ..._projection.project import check_state
from ..._tree import tree_shapes
from .._networks import (
    PINN,
    AbstractFlowMap,
    AbstractTrainable,
    DeepONet,
    Points,
    as_flow_map,
    has_arrays,
)
from .._networks.flat import stacked_vectors
from .._solvers import check_output
from .defect import VectorField
from .pool import Pool
from .recipe import Recipe
from .state import FitState


def check_types(
    vector_field: Any, key: Any, sample: Any, data: Any, recipe: Any, progress: Any
) -> None:
    """Raises unless the arguments of `fit` besides the model have the right types."""
    if vector_field is None and (data is None or sample is not None):
        raise TypeError(
            "`fit` needs a `vector_field`, or `data` without `sample`, which only a field uses."
        )
    if vector_field is not None and not callable(vector_field):
        raise TypeError(f"`vector_field` is {vector_field!r}, not a function `(t, y, args)`.")
    if not (eqx.is_array(key) and (jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.ndim)):
        raise TypeError(f"`key` is {key!r}, but it must be a random key: `jax.random.key(0)`.")
    if sample is not None and not callable(sample):
        raise TypeError(
            f"`sample` is {sample!r}, but it must be a function from a random key to an initial "
            "state. For given states write `sample=diffrax_conserve.learned.FromStates(states)`."
        )
    if recipe is not None and not isinstance(recipe, Recipe):
        raise TypeError(
            f"`recipe` is {recipe!r}, but it must be a `diffrax_conserve.learned.Recipe`, such as "
            "`diffrax_conserve.learned.Recipe(optimiser=optax.adam(1e-3))`, "
            "`diffrax_conserve.learned.paper(model)` or "
            "`diffrax_conserve.learned.second_order(model)`."
        )
    if not (isinstance(progress, bool) or callable(progress)):
        raise TypeError(
            f"`progress` is {progress!r}, but it must be `True`, `False`, or a function."
        )


def check_arguments(model: Any, sample: Any, data: Any, manifold: Manifold | None) -> None:
    """Raises unless model, sampler, data and manifold are compatible."""
    if manifold is not None:
        check_manifold(manifold)
        refuse_rates(manifold, "a training")
        if not (isinstance(model, PINN) and model.windows > 1):
            raise ValueError(
                "`manifold` is where the ends of the windows of a `PINN` are moved to, but this "
                "network has no windows. To conserve its integrals give the network a `layer`, or "
                "wrap its solver in `ManifoldProjection`."
            )
    if isinstance(model, PINN):
        if sample is not None or data is not None:
            raise ValueError(
                "A `PINN` has one initial state, its own: leave `sample` out, and `data`, from "
                "which only a flow map is trained."
            )
        return
    if not (callable(model) and hasattr(model, "max_step")):
        raise TypeError(
            f"`fit` was given a {type(model).__name__}. It trains a `PINN`, a `DeepONet`, or a "
            "Module `(y0, h) -> y` with an attribute `max_step`, the longest step."
        )
    if not has_arrays(as_flow_map(model).weights()):
        raise ValueError(
            f"`fit` was given a {type(model).__name__}, which has no weights of its own. "
            "Train its inner `flow_map` if it has one, and repeat that."
        )
    _check_precision(model)
    if sample is None and data is None:
        raise ValueError(
            "A flow map is trained on many initial states: pass `sample`, a function from a random "
            "key to one of them, for example `sample=system.sample`."
        )


def _check_precision(model: Any) -> None:
    """Raises for a network that is evaluated in a lower precision than its states have."""
    is_network = lambda x: isinstance(x, DeepONet)  # noqa: E731
    networks = filter(is_network, jtu.tree_leaves(model, is_leaf=is_network))
    if any(network.precision != network.scale.dtype for network in networks):
        raise TypeError(
            "The weights of the model are float32, but its states are float64. Train it in double "
            "precision, and pass the result to `diffrax_conserve.learned.single_precision`."
        )


def check_family(sample: Any, args: Args) -> None:
    """Raises unless states and `args` can be drawn for a flow map that takes `args`."""
    if args is not None:
        raise ValueError(
            "`args` were given, but this flow map takes them as inputs: a training draws them "
            "from its `args_domain`. Leave `args` out."
        )
    if isinstance(sample, Pool):
        raise ValueError(
            "A `Pool` is for a flow map of one vector field, but this one takes `args`. Draw "
            "states along solutions by `diffrax_conserve.learned.reachable_states`, and pass "
            "`sample=diffrax_conserve.learned.FromStates(states)`."
        )


def check_limits(state: Any, target: Any, seconds: Any) -> None:
    """Raises unless the initial state and the limits of a training are valid."""
    if state is not None and not isinstance(state, FitState):
        raise TypeError(f"`state` is {state!r}, but it must be the `state` of a log of `fit`.")
    for name, value in (("target", target), ("seconds", seconds)):
        check_number(name, value, above=0.0)


def check_field(
    model: AbstractTrainable, vector_field: VectorField, args: Args, points: Points
) -> None:
    """Raises unless the vector field fits the states, is finite, and for a flow map is
    autonomous."""
    starts = model.starts(points)
    y0 = jtu.tree_map(lambda x: x[0], starts.y0s)
    rate = eqx.filter_eval_shape(vector_field, starts.ts[0], y0, args)
    if tree_shapes(rate) != tree_shapes(y0):
        raise ValueError(
            f"`vector_field` returns the structure {tree_shapes(rate)}, but the state has "
            f"{tree_shapes(y0)}. Both must be the same."
        )
    now = _rates(vector_field, starts.ts, starts.y0s, args)
    wrong = np.flatnonzero(~np.all(np.isfinite(now), axis=1))
    if wrong.size:
        y0 = jtu.tree_map(lambda x: np.asarray(x[wrong[0]]), starts.y0s)
        raise ValueError(
            f"`vector_field` is not finite at {wrong.size} of {len(now)} initial states, for "
            f"example at {y0}. Draw states at which it is."
        )
    if isinstance(model, AbstractFlowMap):
        later = _rates(vector_field, starts.ts + 0.618 * model.max_step, starts.y0s, args)
        change, size = np.max(np.abs(later - now)), np.max(np.abs(now))
        if not change <= 1e-3 * size:
            raise ValueError(
                f"`vector_field` depends on time: from t = 0 to {0.618 * model.max_step:.3g} it "
                f"changes by {change:.3g}, where its largest component is {size:.3g}. A flow map "
                "is for autonomous equations. Make time a component of the state, of rate one."
            )


def _rates(vector_field: VectorField, ts: Array, y0s: Y, args: Args) -> np.ndarray:
    return np.asarray(_stacked_rates(vector_field, ts, y0s, args))


@eqx.filter_jit
def _stacked_rates(vector_field: VectorField, ts: Array, y0s: Y, args: Args) -> Array:
    return stacked_vectors(jax.vmap(vector_field, in_axes=(0, 0, None))(ts, y0s, args))


def check_pool(pool: Pool, flow_map: AbstractFlowMap, args: Args, recipe: Recipe) -> None:
    """Raises unless a pool can grow and its states fit the model and the manifold."""
    if recipe.refresh is None or recipe.refresh >= recipe.epochs:
        raise ValueError(
            "A `Pool` grows when new points are drawn, but with "
            f"`refresh={recipe.refresh}` in a recipe of {recipe.epochs} epochs that is never. "
            "Write for example `recipe=dataclasses.replace(recipe, refresh=1)`."
        )
    y0 = jtu.tree_map(jnp.asarray, pool.sample(jr.key(0)))
    check_state(y0, "a `Pool`")
    check_output(flow_map, (y0, float(flow_map.max_step)), y0, "model")
    if pool.manifold is not None:
        check_outputs(pool.manifold, 0.0, y0, args)
