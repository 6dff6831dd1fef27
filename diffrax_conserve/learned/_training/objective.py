"""The compiled part of a training: its constants, the values that change from epoch to epoch, and
the epochs."""

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

from ..._custom_types import Args
from ..._tree import tree_all_finite
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
from .pool import Pool, domain_of, moved
from .recipe import Recipe
from .second_order import LeastSquares, SecondOrder


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


def advance(
    objective: Objective, carry: Carry, start: Int[Array, ""], stop: Int[Array, ""]
) -> tuple[Carry, Float[Array, ""]]:
    """Runs the epochs from `start` up to `stop`, and compares the model with the best one so far.

    `start` and `stop` may be traced, so that all rounds share one compilation.
    """
    carry = lax.fori_loop(start, stop, lambda e, carry: _epoch(objective, carry, e), carry)
    criterion, best = _compared(objective, carry)
    better = criterion < best
    carry = carry._replace(
        best_weights=_where(better, carry.weights, carry.best_weights),
        best_domain=_where(better, carry.domain, carry.best_domain),
        best=jnp.where(better, criterion, best),
        best_epoch=jnp.where(better, stop, carry.best_epoch),
    )
    return carry, criterion


def _compared(objective: Objective, carry: Carry) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The criterion of the model, and that of the best one so far."""
    if not isinstance(objective.sample, Pool):
        return objective.criterion(carry.weights, objective.first_points), carry.best
    # The states of a pool move, so both models are compared on the points of the next epoch, on
    # which with `refresh=1` neither has been trained.
    best = objective.criterion(carry.best_weights, carry.points)
    best = jnp.where(jnp.isfinite(carry.best), best, jnp.inf).astype(carry.best.dtype)
    return objective.criterion(carry.weights, carry.points), best


def _epoch(objective: Objective, carry: Carry, epoch: Int[Array, ""]) -> Carry:
    """One update, and the points for the next one."""
    schedule = objective.schedule(epoch)
    update = _by_least_squares if isinstance(objective.optimiser, SecondOrder) else _by_gradient
    weights, optimiser_state, loss = update(objective, carry, schedule, epoch)
    finite = jnp.isfinite(loss) & tree_all_finite(weights)
    # If the update is not finite, continue from the best model: skipping the update is not enough,
    # because the same points would give the same result in the next epoch.
    fresh = objective.optimiser.init(carry.best_weights)
    carry = carry._replace(
        weights=_where(finite, weights, carry.best_weights),
        optimiser_state=_where(finite, optimiser_state, fresh),
        domain=_seen(objective, carry, epoch),
        skipped=carry.skipped + jnp.where(finite, 0, 1),
        losses=carry.losses.at[epoch].set(loss.astype(carry.losses.dtype)),
    )
    return carry._replace(points=_refreshed(objective, carry, epoch + 1))


def _by_gradient(
    objective: Objective, carry: Carry, schedule: LayerSchedule, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    del epoch
    loss, gradient = eqx.filter_value_and_grad(objective.loss)(
        carry.weights, carry.points, schedule
    )
    assert not isinstance(objective.optimiser, SecondOrder)
    updates, state = objective.optimiser.update(gradient, carry.optimiser_state, carry.weights)
    return eqx.apply_updates(carry.weights, updates), state, loss


def _by_least_squares(
    objective: Objective, carry: Carry, schedule: LayerSchedule, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    """The update by a second-order method, for which the weights are one vector."""
    assert isinstance(objective.optimiser, SecondOrder)
    vector, restore = ravel_pytree(carry.weights)
    points = carry.points

    def at_one(vector: Array, point: Points) -> Array:
        single = jtu.tree_map(lambda x: x[None], point)
        return objective.defects(restore(vector), single, schedule)[0]

    least_squares = LeastSquares(
        defects=lambda v: objective.defects(restore(v), points, schedule),
        jacobian=lambda v: jax.vmap(jax.jacrev(at_one), in_axes=(None, 0))(v, points),
        loss=objective.recipe.loss,
        typical=objective.typical,
    )
    fraction = epoch / objective.recipe.epochs
    vector, state, loss = objective.optimiser.update(
        least_squares, vector, carry.optimiser_state, fraction, objective.linear
    )
    return restore(vector), state, loss


def _refreshed(objective: Objective, carry: Carry, epoch: Int[Array, ""]) -> Points:
    """The points for `epoch`."""
    if objective.recipe.refresh is None:
        return carry.points
    due = epoch % objective.recipe.refresh == 0
    return lax.cond(due, lambda: _anew(objective, carry, epoch), lambda: carry.points)


def _anew(objective: Objective, carry: Carry, epoch: Int[Array, ""]) -> Points:
    """New points; the states of a pool are moved by the network."""
    recipe, sample = objective.recipe, objective.sample
    key = jr.fold_in(objective.key, epoch)
    static, data = objective.static, objective.data
    points = draw_points(static, recipe.times, sample, data, recipe.points, key)
    if not isinstance(sample, Pool):
        return points

    def squares(steps: Points) -> Float[Array, " points"]:
        return squared_norms(objective.defects(carry.weights, steps, objective.complete()))

    model = eqx.combine(carry.weights, objective.static)
    old, new, key = carry.points.y0s, points.y0s, jr.fold_in(key, 0)
    y0s = moved(sample, model, objective.args, squares, objective.typical, old, new, key)
    return points._replace(y0s=y0s)


def _seen(objective: Objective, carry: Carry, epoch: Int[Array, ""]) -> Any:
    """The domain, extended by the states of a pool."""
    if carry.domain is None:
        return None
    # Earlier, the network may have moved states where no solution goes.
    late = 2 * epoch >= objective.recipe.epochs
    return _where(late, carry.domain.extended(carry.points.y0s), carry.domain)


def _where(condition: Bool[Array, ""], a: Any, b: Any) -> Any:
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), a, b)
