"""What `fit` refuses before anything is compiled."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu

from ..._balance import refuse_rates
from ..._custom_types import Args, Manifold
from ..._manifold import check_manifold, check_outputs
from ..._projection import check_state
from .._networks import PINN, AbstractFlowMap, as_flow_map, has_arrays
from .._solvers import check_output
from .pool import Pool
from .recipe import Recipe


def check_types(vector_field: Any, key: Any, sample: Any, recipe: Any, progress: Any) -> None:
    """Raises unless the arguments of `fit` besides the model have the right types."""
    if not callable(vector_field):
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


def check_arguments(model: Any, sample: Any, manifold: Manifold | None) -> None:
    """Raises unless model, sampler and manifold fit each other."""
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
        if sample is not None:
            raise ValueError("A `PINN` has one initial state, its own: leave `sample` out.")
        return
    if not (callable(model) and hasattr(model, "max_step")):
        raise TypeError(
            f"`fit` was given a {type(model).__name__}. It trains a `PINN`, a `DeepONet`, or a "
            "Module `(y0, h) -> y` with an attribute `max_step`, the longest step."
        )
    if not has_arrays(as_flow_map(model).weights()):
        raise ValueError(
            f"`fit` was given a {type(model).__name__}, which has no weights of its own. If it "
            "repeats another flow map: Train its inner `flow_map`, and repeat that."
        )
    if sample is None:
        raise ValueError(
            "A flow map is trained on many initial states: pass `sample`, a function from a random "
            "key to one of them, for example `sample=system.sample`."
        )


def check_pool(pool: Pool, flow_map: AbstractFlowMap, args: Args, recipe: Recipe) -> None:
    """Raises unless a pool can grow, and its states are those that model and manifold are for."""
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
