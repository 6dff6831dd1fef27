"""The compiled part of a training: the loss, and the epochs that minimise it.

The defect `du/dt - f(t, u)` is computed at all points by one forward-mode pass. A `vmap` of forward
passes takes twice as long, and reverse mode six times as long.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..._custom_types import Args, RealScalarLike
from ..._tree import tree_all_finite, tree_sub
from .._networks.trainable import AbstractTrainable, LayerSchedule, Points, Sampler
from .data import Data
from .recipe import Recipe
from .second_order import LeastSquares, LevenbergMarquardt, SecondOrder, squared_norms

VectorField = Callable[[RealScalarLike, Any, Args], Any]


@final
class Problem(eqx.Module):
    """What is learned, and how. It does not change during a call of `fit`."""

    vector_field: VectorField | None
    args: Args
    sample: Sampler | None
    data: Data | None
    recipe: Recipe
    sharding: NamedSharding | None = eqx.field(static=True, default=None)  # of the points

    def field(self, t: Any, y: Any) -> Any:
        assert self.vector_field is not None
        return self.vector_field(t, y, self.args)

    def draw(self, model: AbstractTrainable, key: PRNGKeyArray) -> Points:
        """New collocation points, and as many pairs of the data."""
        count, times = self.recipe.points, self.recipe.times
        if self.data is None:
            return model.draw(times, self.sample, count, key)
        pairs = self.data.draw(count, jr.fold_in(key, 1))
        if self.sample is None:
            return Points(pairs.hs, pairs.y0s, pairs)
        return model.draw(times, self.sample, count, key)._replace(pairs=pairs)

    def spread(self, points: Points) -> Points:
        """The points, each device of `sharding` with its share of them."""
        if self.sharding is None:
            return points
        return lax.with_sharding_constraint(points, self.sharding)

    def everywhere(self, carry: "Carry") -> "Carry":
        """The carry, the same on each device of `sharding`."""
        if self.sharding is None:
            return carry
        return lax.with_sharding_constraint(
            carry, NamedSharding(self.sharding.mesh, PartitionSpec())
        )

    def defects(
        self, model: AbstractTrainable, points: Points, schedule: LayerSchedule | None
    ) -> Float[Array, "points n"]:
        """`du/dt - f(t, u)` at every point, as vectors in the units of the model."""
        ts, ones = points.ts, jnp.ones_like(points.ts)
        y, rates = jax.jvp(lambda ts: model.states(points, ts, schedule), (ts,), (ones,))
        return model.measured(points, tree_sub(rates, jax.vmap(self.field)(ts, y)))

    def typical(self, model: AbstractTrainable, points: Points) -> Float[Array, ""]:
        if self.vector_field is None:
            return jnp.ones(())
        starts = model.starts(points)
        rates = jax.vmap(self.field)(starts.ts, starts.y0s)
        return jnp.median(squared_norms(model.measured(starts, rates)))


class Carry(NamedTuple):
    """What changes from epoch to epoch."""

    weights: Any
    optimiser_state: Any
    best_weights: Any
    best: Float[Array, ""]
    skipped: Int[Array, ""]
    losses: Float[Array, " epochs"]
    criteria: Float[Array, " comparisons"]  # at 0 and after each epoch; NaN without a comparison


@final
class Objective(eqx.Module):
    """The constants in the training of one network: the loss as a function of its weights."""

    problem: Problem
    static: Any  # the model without its weights
    first_points: Points
    typical: Float[Array, ""]
    linear: Bool[Array, " weights"]  # marks those of the last layer
    key: PRNGKeyArray
    of_candidate: bool = eqx.field(static=True, default=False)  # leave the layer out of defects

    def defects(
        self, weights: Any, points: Points, schedule: LayerSchedule | None
    ) -> Float[Array, "points n"]:
        model, problem, rows = eqx.combine(weights, self.static), self.problem, []
        if self.of_candidate and model.layer is not None:
            model = eqx.tree_at(lambda model: model.layer, model, None)
        if problem.vector_field is not None:
            rows.append(problem.defects(model, points, schedule))
        if problem.data is not None:
            # Both are relative, so that neither dominates because of its units.
            rows = [row / jnp.sqrt(self.typical) for row in rows]
            rows.append(problem.data.mismatch(model, points.pairs, schedule))
        return rows[0] if len(rows) == 1 else jnp.concatenate(rows, axis=1)

    def loss(
        self, weights: Any, points: Points, schedule: LayerSchedule | None
    ) -> Float[Array, ""]:
        squares = squared_norms(self.defects(weights, points, schedule))
        return self.problem.recipe.loss(squares, self.typical)

    def criterion(self, weights: Any) -> Float[Array, ""]:
        """The loss with all of the layer, as the trained model is used."""
        loss = self.loss(weights, self.first_points, None)
        return jnp.where(jnp.isfinite(loss), loss, jnp.inf)

    def schedule(self, epoch: Int[Array, ""]) -> LayerSchedule | None:
        layer, recipe = self.static.layer, self.problem.recipe
        if layer is None or recipe.schedule is None:
            return None
        p, s = recipe.schedule(epoch, recipe.epochs, layer.steps)
        return p, jnp.asarray(s, float)

    def points(self, epoch: Int[Array, ""]) -> Points:
        refresh = self.problem.recipe.refresh
        if refresh is None:
            return self.first_points
        drawn = epoch - epoch % refresh
        fresh = self.problem.draw(self.static, jr.fold_in(self.key, drawn))
        return self.problem.spread(_where(drawn == 0, self.first_points, fresh))

    def best(self, carry: Carry) -> Any:
        return eqx.combine(carry.best_weights, self.static)


@eqx.filter_jit
def start(problem: Problem, model: AbstractTrainable, key: PRNGKeyArray) -> tuple[Objective, Carry]:
    points_key, key = jr.split(key)
    trained = _marked(model, "weights", eqx.is_inexact_array)
    weights, static = eqx.partition(model, trained)
    points = problem.spread(problem.draw(model, points_key))
    last = eqx.filter(_marked(model, "linear_weights", lambda _: True), trained)
    linear, _ = ravel_pytree(jtu.tree_map(lambda w, x: jnp.full(w.shape, x), weights, last))
    dtype = jnp.result_type(*jtu.tree_leaves(weights))
    carry = Carry(
        weights=weights,
        optimiser_state=problem.recipe.method.init(weights),
        best_weights=weights,
        best=jnp.asarray(jnp.inf, dtype),
        skipped=jnp.asarray(0),
        losses=jnp.full(problem.recipe.epochs, jnp.nan, dtype),
        criteria=jnp.full(problem.recipe.epochs + 1, jnp.nan, dtype),
    )
    # No array is weakly typed, because the compiled epochs return none that is.
    carry = jtu.tree_map(lambda x: jnp.asarray(x).astype(jnp.asarray(x).dtype), carry)
    typical = problem.typical(model, points)
    return Objective(problem, static, points, typical, linear, key), problem.everywhere(carry)


def _marked(model: AbstractTrainable, method: str, mark: Callable[[Any], bool]) -> Any:
    """`model` with marks at the place that the method returns, and `False` elsewhere."""
    nothing = jtu.tree_map(lambda _: False, model)
    marks = jtu.tree_map(mark, getattr(model, method)())
    if not jtu.tree_leaves(marks):
        return nothing
    return eqx.tree_at(lambda m: getattr(m, method)(), nothing, marks)


def advance(
    objective: Objective,
    carry: Carry,
    start: Int[Array, ""],
    stop: Int[Array, ""],
    compare: Bool[Array, ""],
) -> Carry:
    """Runs the epochs from `start` up to `stop`, and may compare the model with the best so far."""
    carry = lax.fori_loop(start, stop, lambda e, carry: _epoch(objective, carry, e), carry)
    criterion = objective.criterion(carry.weights)
    better = compare & (criterion < carry.best)
    found = jnp.where(compare, criterion, carry.criteria[stop]).astype(carry.criteria.dtype)
    carry = carry._replace(
        best_weights=_where(better, carry.weights, carry.best_weights),
        best=jnp.where(better, criterion, carry.best),
        criteria=carry.criteria.at[stop].set(found),
    )
    return objective.problem.everywhere(carry)


def _epoch(objective: Objective, carry: Carry, epoch: Int[Array, ""]) -> Carry:
    """One update."""
    weights, optimiser_state, loss = _updated(objective, carry, epoch)
    finite = jnp.isfinite(loss) & tree_all_finite(weights)
    # If not, continue from the best model: the same weights and points would give the same result.
    fresh = objective.problem.recipe.method.init(carry.best_weights)
    return carry._replace(
        weights=_where(finite, weights, carry.best_weights),
        optimiser_state=_where(finite, optimiser_state, fresh),
        skipped=carry.skipped + jnp.where(finite, 0, 1),
        losses=carry.losses.at[epoch].set(loss.astype(carry.losses.dtype)),
    )


def _updated(objective: Objective, carry: Carry, epoch: Array) -> tuple[Any, Any, Float[Array, ""]]:
    optimiser, schedule = objective.problem.recipe.method, objective.schedule(epoch)
    weights, points, state = carry.weights, objective.points(epoch), carry.optimiser_state
    if not isinstance(optimiser, SecondOrder):
        loss, gradient = eqx.filter_value_and_grad(objective.loss)(weights, points, schedule)
        extra: dict[str, Any] = {}
        if isinstance(optimiser, optax.GradientTransformationExtraArgs):  # such as `optax.lbfgs`
            value_fn = lambda weights: objective.loss(weights, points, schedule)  # noqa: E731
            extra = dict(value=loss, grad=gradient, value_fn=value_fn)
        updates, state = optimiser.update(gradient, state, weights, **extra)
        return eqx.apply_updates(weights, updates), state, loss
    # For a second-order method the weights are one vector.
    vector, restore = ravel_pytree(weights)
    # Levenberg-Marquardt solves for the weights of the last layer, in which the candidate is
    # linear. Through the projection, which forgets a displacement along the gradients, the problem
    # would be singular: with all weights damped alike a pendulum took 1,240 epochs in place of 120,
    # for a hundred times the error. An accurate candidate is near the manifold, and its projection
    # as accurate; the best model is chosen, and measured, with the layer.
    of_candidate = isinstance(optimiser, LevenbergMarquardt)
    objective = dataclasses.replace(objective, of_candidate=of_candidate)

    def at_one(vector: Array, point: Points) -> Array:
        single = jtu.tree_map(lambda x: x[None], point)
        return objective.defects(restore(vector), single, schedule)[0]

    least_squares = LeastSquares(
        defects=lambda v: objective.defects(restore(v), points, schedule),
        jacobian=lambda v: jax.vmap(jax.jacrev(at_one), in_axes=(None, 0))(v, points),
        loss=objective.problem.recipe.loss,
        typical=objective.typical,
        fraction=epoch / objective.problem.recipe.epochs,
        linear=objective.linear,
    )
    vector, state, loss = optimiser.update(least_squares, vector, state)
    return restore(vector), state, loss


def _where(condition: Bool[Array, ""], a: Any, b: Any) -> Any:
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), a, b)
