"""The compiled part of a training: from the state after some epochs to that after more."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .._custom_types import Args
from .._tree import tree_all_finite
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
from ._recipe import Recipe
from ._second_order import LeastSquares, SecondOrder


class Carry(NamedTuple):
    weights: Any
    optimiser_state: Any
    points: Points
    best_weights: Any
    best: Float[Array, ""]
    best_epoch: Int[Array, ""]
    skipped: Int[Array, ""]
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

    def criterion(self, weights: Any) -> Float[Array, ""]:
        """The loss of what the trained model will compute."""
        steps = self.steps()
        loss = self.loss(weights, self.first_points, jnp.asarray(steps), jnp.ones(()))
        return jnp.where(jnp.isfinite(loss), loss, jnp.inf)

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
    carry = Carry(
        weights=weights,
        optimiser_state=optimiser.init(weights),
        points=points,
        best_weights=weights,
        best=jnp.asarray(jnp.inf, dtype),
        best_epoch=jnp.asarray(0),
        skipped=jnp.asarray(0),
        losses=jnp.full(recipe.epochs, jnp.nan, dtype),
    )
    return problem, carry


def advance(
    problem: Problem, carry: Carry, start: Int[Array, ""], stop: Int[Array, ""]
) -> tuple[Carry, Float[Array, ""]]:
    """The epochs from `start` up to `stop`, and a comparison with the best model so far.

    Both may be traced, so that all rounds share one compilation.
    """
    carry = lax.fori_loop(start, stop, lambda e, carry: _epoch(problem, carry, e), carry)
    criterion = problem.criterion(carry.weights)
    better = criterion < carry.best
    best_weights = _where(better, carry.weights, carry.best_weights)
    carry = carry._replace(
        best_weights=best_weights,
        best=jnp.where(better, criterion, carry.best),
        best_epoch=jnp.where(better, stop, carry.best_epoch),
    )
    return carry, criterion


def _epoch(problem: Problem, carry: Carry, epoch: Int[Array, ""]) -> Carry:
    """One update."""
    points = _refreshed(problem, carry.points, epoch)
    p, s = problem.schedule(epoch)
    update = _by_least_squares if isinstance(problem.optimiser, SecondOrder) else _by_gradient
    weights, optimiser_state, loss = update(problem, carry, points, p, s, epoch)
    finite = jnp.isfinite(loss) & tree_all_finite(weights)
    # A model that is not finite stays so if only this update is left out: every point is used in
    # every epoch. So go back to the best one.
    fresh = problem.optimiser.init(carry.best_weights)
    return carry._replace(
        weights=_where(finite, weights, carry.best_weights),
        optimiser_state=_where(finite, optimiser_state, fresh),
        points=points,
        skipped=carry.skipped + jnp.where(finite, 0, 1),
        losses=carry.losses.at[epoch].set(loss.astype(carry.losses.dtype)),
    )


def _by_gradient(
    problem: Problem, carry: Carry, points: Points, p: Array, s: Array, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    del epoch
    loss, gradient = eqx.filter_value_and_grad(problem.loss)(carry.weights, points, p, s)
    assert not isinstance(problem.optimiser, SecondOrder)
    updates, state = problem.optimiser.update(gradient, carry.optimiser_state, carry.weights)
    return eqx.apply_updates(carry.weights, updates), state, loss


def _by_least_squares(
    problem: Problem, carry: Carry, points: Points, p: Array, s: Array, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    """The same by a second-order method, for which the weights are one vector."""
    assert isinstance(problem.optimiser, SecondOrder)
    vector, restore = ravel_pytree(carry.weights)

    def at_one(vector: Array, point: Points) -> Array:
        single = jtu.tree_map(lambda x: x[None], point)
        return problem.defects(restore(vector), single, p, s)[0]

    least_squares = LeastSquares(
        defects=lambda v: problem.defects(restore(v), points, p, s),
        jacobian=lambda v: jax.vmap(jax.jacrev(at_one), in_axes=(None, 0))(v, points),
        loss=problem.recipe.loss,
        typical=problem.typical,
    )
    fraction = epoch / problem.recipe.epochs
    vector, state, loss = problem.optimiser.update(
        least_squares, vector, carry.optimiser_state, fraction, problem.linear
    )
    return restore(vector), state, loss


def _refreshed(problem: Problem, points: Points, epoch: Int[Array, ""]) -> Points:
    recipe = problem.recipe
    if recipe.refresh is None:
        return points
    due = (epoch % recipe.refresh == 0) & (epoch > 0)
    key = jr.fold_in(problem.key, epoch)

    def anew() -> Points:
        return draw(problem.static, recipe.times, problem.sample, recipe.points, key)

    return lax.cond(due, anew, lambda: points)


def _where(condition: Bool[Array, ""], a: Any, b: Any) -> Any:
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), a, b)
