"""`fit`: trains a network from the vector field alone."""

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .._custom_types import Args, Manifold
from .._manifold import check_manifold
from .._network import PINN
from .._tree import tree_all_finite
from ._defect import (
    Points,
    Sampler,
    VectorField,
    defects,
    draw,
    layer_of,
    linear_weights,
    trainable,
    typical_square,
)
from ._recipe import Recipe, second_order
from ._second_order import LeastSquares, SecondOrder
from ._windows import Joint, with_window

_Model = TypeVar("_Model", bound=eqx.Module)
# Called with the epochs that are done, all epochs, the last loss and the best criterion.
Progress = Callable[[int, int, float, float], None]


@final
class FitLog(eqx.Module):
    """How a training went.

    **Attributes:**

    - `losses`: the training loss at each epoch, before its update.
    - `checked`, `criteria`: the epochs at which the model was compared with the best so far, and
        what was compared: the loss on the first collocation points with all iterations of the
        conservative layer, so that epochs with different iterations are comparable.
    - `best_epoch`, `best`: the epoch of the model that was returned, and its criterion.
    - `skipped`: how many updates were not finite. Each of them was replaced by a return to the best
        model so far, with a new state of the optimiser.
    - `seconds`, `compile_seconds`: wall times, of the training and of the one compilation.
    """

    losses: np.ndarray
    checked: np.ndarray
    criteria: np.ndarray
    best_epoch: int
    best: float
    skipped: int
    seconds: float
    compile_seconds: float


class _Carry(NamedTuple):
    weights: Any
    optimiser_state: Any
    points: Points
    best_weights: Any
    best: Float[Array, ""]
    best_epoch: Int[Array, ""]
    skipped: Int[Array, ""]
    losses: Float[Array, " epochs"]


@final
class _Problem(eqx.Module):
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
        return self.recipe.loss(jnp.sum(jnp.square(vectors), axis=1), self.typical)

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


def fit(
    model: _Model,
    vector_field: VectorField,
    *,
    key: PRNGKeyArray,
    sample: Sampler | None = None,
    args: Args = None,
    recipe: Recipe | None = None,
    manifold: Manifold = None,
    progress: bool | Progress = False,
) -> tuple[_Model, FitLog]:
    r"""Trains a network from the vector field alone: no solution is needed.

    Minimises the mean over collocation points of $|u'(t) - f(t, u(t))|^2$, where $u$ is the output
    of the network, the time derivative by forward-mode automatic differentiation. For a network
    with a conservative layer $u$ is the output after as many iterations as the recipe's schedule
    says.

    An update that is not finite is not made. The model that is returned is the best that was seen,
    not the last.

    A `PINN` of several windows is trained window by window; each starts where the one before ended,
    moved onto the manifold if one is given.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], a [`diffrax_conserve.DeepONet`][], or any Module
        `(y0, h) -> y` with an attribute `max_step`, all of whose arrays are then trained.
    - `vector_field`: $f(t, y, args)$. For a flow map it must not depend on time.
    - `key`: a random key. The same key gives the same result.
    - `sample`: for a flow map, a function from a random key to an initial state.
    - `args`: passed to `vector_field`.
    - `recipe`: a [`diffrax_conserve.Recipe`][]. Default:
        [`diffrax_conserve.second_order`][]`(model)`.
    - `manifold`: for a `PINN` of several windows, where the ends of the windows are moved to: the
        values of its integrals are those at the initial state. Default: that of its layer.
    - `progress`: whether to print a line on standard error, or a function that is called now and
        then with the number of epochs done, that of all epochs, the last loss and the best
        criterion.

    **Returns:**

    The trained model and a [`diffrax_conserve.FitLog`][].

    **Raises:**

    `ValueError` or `TypeError` before anything is compiled if the arguments do not fit.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("harmonic-oscillator")
        pinn = dfc.PINN(system.y0, 0.0, 1.0, width=10, depth=2, key=jax.random.key(0))
        recipe = dfc.paper(pinn, epochs=200, points=50)
        pinn, log = dfc.fit(pinn, system.vector_field, key=jax.random.key(1), recipe=recipe)
        print(log.best, log.best_epoch)
        ```

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131, Algorithm 1.
    """
    _check(model, sample, manifold)
    recipe = second_order(model) if recipe is None else recipe
    windows = model.windows if isinstance(model, PINN) else 1
    trainer = _Trainer(vector_field, sample, args, recipe, progress, windows)
    if not isinstance(model, PINN):
        trained, log = trainer.train(model, key)
        return trained, log
    target = Joint.of(model, manifold, args)
    logs = []
    for k in range(windows):
        window, log = trainer.train(model.window(k), key if k == 0 else jr.fold_in(key, k))
        logs.append(log)
        model = with_window(model, k, window, target)
    return model, _joined(logs, recipe.epochs)


@final
class _Trainer:
    """Trains one network after the other, all of the same shape, with one compilation."""

    def __init__(
        self,
        vector_field: VectorField,
        sample: Sampler | None,
        args: Args,
        recipe: Recipe,
        progress: bool | Progress,
        count: int,
    ):
        self.vector_field, self.sample, self.args = vector_field, sample, args
        self.recipe, self.progress, self.count = recipe, progress, count
        self.trained, self.compiled = 0, None

    def train(self, model: Any, key: PRNGKeyArray) -> tuple[Any, FitLog]:
        recipe = self.recipe
        problem, carry = _start(model, self.vector_field, key, self.sample, self.args, recipe)
        begun = time.perf_counter()
        if self.compiled is None:
            arguments = (problem, carry, jnp.asarray(0), jnp.asarray(0))
            advance = eqx.filter_jit(_advance)
            lowered = advance.lower(*arguments)  # pyright: ignore[reportFunctionMemberAccess]
            self.compiled = lowered.compile()
        compile_seconds = time.perf_counter() - begun
        checked, criteria, done = [], [], 0
        while True:
            # Without an epoch between them, the first round only judges the model as it came.
            stop = min(done + recipe.check_every, recipe.epochs) if checked else 0
            carry, criterion = self.compiled(problem, carry, jnp.asarray(done), jnp.asarray(stop))
            done = stop
            checked.append(done)
            criteria.append(float(criterion))
            before = self.trained * recipe.epochs
            _report(self.progress, done, before, self.count * recipe.epochs, carry)
            if done == recipe.epochs:
                break
        self.trained += 1
        log = FitLog(
            losses=np.asarray(carry.losses),
            checked=np.array(checked),
            criteria=np.array(criteria),
            best_epoch=int(carry.best_epoch),
            best=float(carry.best),
            skipped=int(carry.skipped),
            seconds=time.perf_counter() - begun - compile_seconds,
            compile_seconds=compile_seconds,
        )
        return eqx.combine(carry.best_weights, problem.static), log


def _joined(logs: list[FitLog], epochs: int) -> FitLog:
    """The log of all windows one after the other; its best is that of the worst window."""
    worst = max(range(len(logs)), key=lambda k: logs[k].best)
    return FitLog(
        losses=np.concatenate([log.losses for log in logs]),
        checked=np.concatenate([k * epochs + log.checked for k, log in enumerate(logs)]),
        criteria=np.concatenate([log.criteria for log in logs]),
        best_epoch=worst * epochs + logs[worst].best_epoch,
        best=logs[worst].best,
        skipped=sum(log.skipped for log in logs),
        seconds=sum(log.seconds for log in logs),
        compile_seconds=sum(log.compile_seconds for log in logs),
    )


def _check(model: eqx.Module, sample: Sampler | None, manifold: Manifold) -> None:
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
    if sample is None:
        raise ValueError(
            "A flow map is trained on many initial states: pass `sample`, a function from a random "
            "key to one of them, for example `sample=system.sample`."
        )


def _start(
    model: eqx.Module,
    vector_field: VectorField,
    key: PRNGKeyArray,
    sample: Sampler | None,
    args: Args,
    recipe: Recipe,
) -> tuple[_Problem, _Carry]:
    points_key, key = jr.split(key)
    weights, static = eqx.partition(model, trainable(model))
    points = draw(model, recipe.times, sample, recipe.points, points_key)
    optimiser = recipe.optimiser
    if recipe.max_gradient_norm is not None and not isinstance(optimiser, SecondOrder):
        clip = optax.clip_by_global_norm(recipe.max_gradient_norm)
        optimiser = optax.chain(clip, optimiser)
    typical = typical_square(model, vector_field, args, points)
    last = eqx.filter(linear_weights(model), trainable(model))
    linear, _ = ravel_pytree(jtu.tree_map(lambda w, x: jnp.full(w.shape, x), weights, last))
    problem = _Problem(
        static, vector_field, args, sample, recipe, optimiser, points, typical, linear, key
    )
    dtype = jnp.result_type(*jtu.tree_leaves(weights))
    carry = _Carry(
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


def _advance(
    problem: _Problem, carry: _Carry, start: Int[Array, ""], stop: Int[Array, ""]
) -> tuple[_Carry, Float[Array, ""]]:
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


def _epoch(problem: _Problem, carry: _Carry, epoch: Int[Array, ""]) -> _Carry:
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
    problem: _Problem, carry: _Carry, points: Points, p: Array, s: Array, epoch: Array
) -> tuple[Any, Any, Float[Array, ""]]:
    del epoch
    loss, gradient = eqx.filter_value_and_grad(problem.loss)(carry.weights, points, p, s)
    assert not isinstance(problem.optimiser, SecondOrder)
    updates, state = problem.optimiser.update(gradient, carry.optimiser_state, carry.weights)
    return eqx.apply_updates(carry.weights, updates), state, loss


def _by_least_squares(
    problem: _Problem, carry: _Carry, points: Points, p: Array, s: Array, epoch: Array
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


def _refreshed(problem: _Problem, points: Points, epoch: Int[Array, ""]) -> Points:
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


def _report(progress: bool | Progress, done: int, before: int, epochs: int, carry: _Carry) -> None:
    if progress is False:
        return
    loss = float(carry.losses[max(done - 1, 0)])
    best = float(carry.best)
    done += before
    if progress is not True:
        progress(done, epochs, loss, best)
        return
    # On a terminal one line that is overwritten, in a file one line for every tenth.
    terminal = sys.stderr.isatty()
    if terminal or done == epochs or done % max(epochs // 10, 1) == 0:
        end = "\r" if terminal and done < epochs else "\n"
        text = f"epoch {done:>{len(str(epochs))}} of {epochs}: loss {loss:.3e}, best {best:.3e}"
        print(text, end=end, file=sys.stderr, flush=True)
