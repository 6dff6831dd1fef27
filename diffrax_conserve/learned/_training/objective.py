"""The constants of the compiled part of a training, and the values that change from epoch to
epoch."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..._custom_types import Args
from .._networks.trainable import AbstractTrainable, LayerSchedule, Points, Sampler
from .data import Data, draw_points, mismatch
from .defect import (
    VectorField,
    defects,
    linear_weights,
    squared_norms,
    trainable,
    typical_square,
)
from .pool import Pool, domain_of
from .recipe import Recipe
from .second_order import SecondOrder


class Carry(NamedTuple):
    weights: Any
    optimiser_state: Any
    points: Points
    best_weights: Any
    best: Float[Array, ""]
    best_epoch: Int[Array, ""]
    skipped: Int[Array, ""]
    domain: Any  # around all states of a pool; `best_domain` belongs to the best model
    best_domain: Any
    losses: Float[Array, " epochs"]


@final
class Objective(eqx.Module):
    """The constants of a training: the loss as a function of the weights, and its minimisation."""

    static: Any  # the model without its weights
    vector_field: VectorField | None
    args: Args
    sample: Sampler | None
    data: Data | None
    recipe: Recipe
    optimiser: optax.GradientTransformation | SecondOrder
    first_points: Points
    typical: Float[Array, ""]
    linear: Bool[Array, " weights"]  # marks those of the last layer
    key: PRNGKeyArray

    def defects(
        self, weights: Any, points: Points, schedule: LayerSchedule
    ) -> Float[Array, "points n"]:
        model = eqx.combine(weights, self.static)
        rows = []
        if self.vector_field is not None:
            rows.append(defects(model, self.vector_field, self.args, points, schedule))
        if self.data is not None:
            # Both are relative, so that neither dominates because of its units.
            rows = [row / jnp.sqrt(self.typical) for row in rows]
            rows.append(mismatch(model, points.pairs, self.data.deviation, schedule))
        return rows[0] if len(rows) == 1 else jnp.concatenate(rows, axis=1)

    def loss(self, weights: Any, points: Points, schedule: LayerSchedule) -> Float[Array, ""]:
        vectors = self.defects(weights, points, schedule)
        return self.recipe.loss(squared_norms(vectors), self.typical)

    def criterion(self, weights: Any, points: Points) -> Float[Array, ""]:
        """The loss with all iterations of the layer, as the trained model is used."""
        loss = self.loss(weights, points, self.complete())
        return jnp.where(jnp.isfinite(loss), loss, jnp.inf)

    def complete(self) -> LayerSchedule:
        """The schedule with all iterations of the conservative layer."""
        return jnp.asarray(self.steps()), jnp.ones(())

    def steps(self) -> int:
        layer = self.static.layer
        return 0 if layer is None else layer.steps

    def schedule(self, epoch: Int[Array, ""]) -> LayerSchedule:
        steps, epochs = self.steps(), self.recipe.epochs
        if steps == 0:
            return jnp.zeros_like(epoch), jnp.ones(())
        return (
            self.recipe.iterations(epoch, epochs, steps),
            jnp.asarray(self.recipe.weight(epoch, epochs, steps), float),
        )


def start(
    model: AbstractTrainable,
    vector_field: VectorField | None,
    key: PRNGKeyArray,
    sample: Sampler | None,
    args: Args,
    recipe: Recipe,
    data: Data | None = None,
) -> tuple[Objective, Carry]:
    points_key, key = jr.split(key)
    trained = trainable(model)
    weights, static = eqx.partition(model, trained)
    points = draw_points(model, recipe.times, sample, data, recipe.points, points_key)
    optimiser = recipe.optimiser
    if recipe.max_gradient_norm is not None and not isinstance(optimiser, SecondOrder):
        clip = optax.clip_by_global_norm(recipe.max_gradient_norm)
        optimiser = optax.chain(clip, optimiser)
    typical = jnp.ones(())
    if vector_field is not None:
        typical = typical_square(model, vector_field, args, points)
    last = eqx.filter(linear_weights(model), trained)
    linear, _ = ravel_pytree(jtu.tree_map(lambda w, x: jnp.full(w.shape, x), weights, last))
    objective = Objective(
        static, vector_field, args, sample, data, recipe, optimiser, points, typical, linear, key
    )
    dtype = jnp.result_type(*jtu.tree_leaves(weights))
    domain = domain_of(model) if isinstance(sample, Pool) else None
    carry = Carry(
        weights=weights,
        optimiser_state=optimiser.init(weights),
        points=points,
        best_weights=weights,
        best=jnp.asarray(jnp.inf, dtype),
        best_epoch=jnp.asarray(0),
        skipped=jnp.asarray(0),
        domain=domain,
        best_domain=domain,
        losses=jnp.full(recipe.epochs, jnp.nan, dtype),
    )
    return objective, carry
