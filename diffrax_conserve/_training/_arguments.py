"""What `fit` refuses before anything is compiled."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu

from .._custom_types import Args, Manifold
from .._manifold import check_manifold, check_outputs
from .._network import PINN, Repeated
from .._projection import check_state
from .._solver._learned import check_output
from ._defect import Sampler
from ._pool import Pool
from ._recipe import Recipe


def check_arguments(model: eqx.Module, sample: Sampler | None, manifold: Manifold) -> None:
    """Raises unless model, sampler and manifold fit each other."""
    if manifold is not None:
        check_manifold(manifold)
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
    if isinstance(model, Repeated):
        raise ValueError(
            "`fit` was given a `Repeated`, which has no weights of its own. Train its inner "
            "`flow_map`, and repeat that."
        )
    if sample is None:
        raise ValueError(
            "A flow map is trained on many initial states: pass `sample`, a function from a random "
            "key to one of them, for example `sample=system.sample`."
        )


def check_pool(pool: Pool, model: Any, args: Args, recipe: Recipe) -> None:
    """Raises unless a pool can grow, and its states are what model and manifold are for."""
    if recipe.refresh is None or recipe.refresh >= recipe.epochs:
        raise ValueError(
            "A `Pool` grows when points are drawn anew, but with "
            f"`refresh={recipe.refresh}` in a recipe of {recipe.epochs} epochs that is never. "
            "Write for example `recipe=dataclasses.replace(recipe, refresh=1)`."
        )
    y0 = jtu.tree_map(jnp.asarray, pool.sample(jr.key(0)))
    check_state(y0, "a `Pool`")
    check_output(model, (y0, float(model.max_step)), y0, "model")
    if pool.manifold is not None:
        check_outputs(pool.manifold, 0.0, y0, args)
