"""The compiled part of a training: from the state after some epochs to that after more."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._tree import tree_all_finite
from ._defect import Points, draw, squared_norms
from ._pool import Pool, moved
from ._problem import Carry, Problem
from ._second_order import LeastSquares, SecondOrder


def advance(
    problem: Problem, carry: Carry, start: Int[Array, ""], stop: Int[Array, ""]
) -> tuple[Carry, Float[Array, ""]]:
    """The epochs from `start` up to `stop`, and a comparison with the best model so far.

    Both may be traced, so that all rounds share one compilation.
    """
    carry = lax.fori_loop(start, stop, lambda e, carry: _epoch(problem, carry, e), carry)
    criterion, best = _compared(problem, carry)
    better = criterion < best
    carry = carry._replace(
        best_weights=_where(better, carry.weights, carry.best_weights),
        best_domain=_where(better, carry.domain, carry.best_domain),
        best=jnp.where(better, criterion, best),
        best_epoch=jnp.where(better, stop, carry.best_epoch),
    )
    return carry, criterion


def _compared(problem: Problem, carry: Carry) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The criterion of the model, and that of the best one so far."""
    if not isinstance(problem.sample, Pool):
        return problem.criterion(carry.weights, problem.first_points), carry.best
    # The first states are not those that it goes to. With `refresh=1` neither model has been
    # trained on those of the next epoch.
    best = problem.criterion(carry.best_weights, carry.points)
    best = jnp.where(jnp.isfinite(carry.best), best, jnp.inf).astype(carry.best.dtype)
    return problem.criterion(carry.weights, carry.points), best


def _epoch(problem: Problem, carry: Carry, epoch: Int[Array, ""]) -> Carry:
    """One update, and the points for the next one."""
    p, s = problem.schedule(epoch)
    update = _by_least_squares if isinstance(problem.optimiser, SecondOrder) else _by_gradient
    weights, optimiser_state, loss = update(problem, carry, p, s, epoch)
    finite = jnp.isfinite(loss) & tree_all_finite(weights)
    # A model that is not finite stays so if only this update is left out: every point is used in
    # every epoch. So go back to the best one.
    fresh = problem.optimiser.init(carry.best_weights)
    carry = carry._replace(
        weights=_where(finite, weights, carry.best_weights),
        optimiser_state=_where(finite, optimiser_state, fresh),
        domain=_seen(problem, carry, epoch),
        skipped=carry.skipped + jnp.where(finite, 0, 1),
        losses=carry.losses.at[epoch].set(loss.astype(carry.losses.dtype)),
    )
    return carry._replace(points=_refreshed(problem, carry, epoch + 1))


def _by_gradient(
    problem: Problem, carry: Carry, p: Array, s: Array, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    del epoch
    loss, gradient = eqx.filter_value_and_grad(problem.loss)(carry.weights, carry.points, p, s)
    assert not isinstance(problem.optimiser, SecondOrder)
    updates, state = problem.optimiser.update(gradient, carry.optimiser_state, carry.weights)
    return eqx.apply_updates(carry.weights, updates), state, loss


def _by_least_squares(
    problem: Problem, carry: Carry, p: Array, s: Array, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    """The same by a second-order method, for which the weights are one vector."""
    assert isinstance(problem.optimiser, SecondOrder)
    vector, restore = ravel_pytree(carry.weights)
    points = carry.points

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


def _refreshed(problem: Problem, carry: Carry, epoch: Int[Array, ""]) -> Points:
    """The points for that epoch."""
    if problem.recipe.refresh is None:
        return carry.points
    due = epoch % problem.recipe.refresh == 0
    return lax.cond(due, lambda: _anew(problem, carry, epoch), lambda: carry.points)


def _anew(problem: Problem, carry: Carry, epoch: Int[Array, ""]) -> Points:
    """Other points; the states of a pool go where the network takes them."""
    recipe, sample = problem.recipe, problem.sample
    key = jr.fold_in(problem.key, epoch)
    points = draw(problem.static, recipe.times, sample, recipe.points, key)
    if not isinstance(sample, Pool):
        return points

    def squares(steps: Points) -> Float[Array, " points"]:
        return squared_norms(problem.defects(carry.weights, steps, *problem.complete()))

    model = eqx.combine(carry.weights, problem.static)
    old, new, key = carry.points.y0s, points.y0s, jr.fold_in(key, 0)
    y0s = moved(sample, model, problem.args, squares, problem.typical, old, new, key)
    return points._replace(y0s=y0s)


def _seen(problem: Problem, carry: Carry, epoch: Int[Array, ""]) -> Any:
    """The domain, extended by the states of a pool."""
    if carry.domain is None:
        return None
    # Before that the network may have gone where no solution does.
    late = 2 * epoch >= problem.recipe.epochs
    return _where(late, carry.domain.extended(carry.points.y0s), carry.domain)


def _where(condition: Bool[Array, ""], a: Any, b: Any) -> Any:
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), a, b)
