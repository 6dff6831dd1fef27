"""A training as the compiled part of it sees it: what stays as it is, and what changes."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .._custom_types import Args
from ._defect import (
    Points,
    Sampler,
    VectorField,
    defects,
    draw,
    layer_of,
    linear_weights,
    squared_norms,
    trainable,
    typical_square,
)
from ._pool import Pool, domain_of
from ._recipe import Recipe
from ._second_order import SecondOrder


class Carry(NamedTuple):
    weights: Any
    optimiser_state: Any
    points: Points
    best_weights: Any
    best: Float[Array, ""]
    best_epoch: Int[Array, ""]
    skipped: Int[Array, ""]
    domain: Any  # around what a pool has held, and what that was when the best model was found
    best_domain: Any
    losses: Float[Array, " epochs"]


@final
class Problem(eqx.Module):
    """All that stays as it is during a training."""

    static: Any  # the model without its weights
    vector_field: VectorField
    args: Args
    sample: Sampler | None
    recipe: Recipe
    optimiser: optax.GradientTransformation | SecondOrder
    first_points: Points
    typical: Float[Array, ""]
    linear: Bool[Array, " weights"]  # of all weights in one vector, those of the last layer
    key: PRNGKeyArray

    def defects(self, weights: Any, points: Points, p: Array, s: Array) -> Array:
        model = eqx.combine(weights, self.static)
        return defects(model, self.vector_field, self.args, points, p, s)

    def loss(self, weights: Any, points: Points, p: Array, s: Array) -> Float[Array, ""]:
        vectors = self.defects(weights, points, p, s)
        return self.recipe.loss(squared_norms(vectors), self.typical)

    def criterion(self, weights: Any, points: Points) -> Float[Array, ""]:
        """The loss of what the trained model will compute."""
        loss = self.loss(weights, points, *self.complete())
        return jnp.where(jnp.isfinite(loss), loss, jnp.inf)

    def complete(self) -> tuple[Array, Array]:
        """The schedule by which the conservative layer does all its iterations."""
        return jnp.asarray(self.steps()), jnp.ones(())

    def steps(self) -> int:
        layer = layer_of(self.static)
        return 0 if layer is None else layer.steps

    def schedule(self, epoch: Int[Array, ""]) -> tuple[Array, Array]:
        steps, epochs = self.steps(), self.recipe.epochs
        if steps == 0:
            return jnp.zeros_like(epoch), jnp.ones(())
        return (
            self.recipe.iterations(epoch, epochs, steps),
            jnp.asarray(self.recipe.weight(epoch, epochs, steps), float),
        )


def start(
    model: eqx.Module,
    vector_field: VectorField,
    key: PRNGKeyArray,
    sample: Sampler | None,
    args: Args,
    recipe: Recipe,
) -> tuple[Problem, Carry]:
    points_key, key = jr.split(key)
    trained = trainable(model)
    weights, static = eqx.partition(model, trained)
    points = draw(model, recipe.times, sample, recipe.points, points_key)
    optimiser = recipe.optimiser
    if recipe.max_gradient_norm is not None and not isinstance(optimiser, SecondOrder):
        clip = optax.clip_by_global_norm(recipe.max_gradient_norm)
        optimiser = optax.chain(clip, optimiser)
    typical = typical_square(model, vector_field, args, points)
    last = eqx.filter(linear_weights(model), trained)
    linear, _ = ravel_pytree(jtu.tree_map(lambda w, x: jnp.full(w.shape, x), weights, last))
    problem = Problem(
        static, vector_field, args, sample, recipe, optimiser, points, typical, linear, key
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
    return problem, carry
