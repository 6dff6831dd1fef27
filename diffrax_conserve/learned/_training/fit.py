"""`fit`: trains a network from the vector field alone, or from data."""

import dataclasses
import math
import os
import time
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PRNGKeyArray

from ..._custom_types import Args, Manifold
from .._networks.flow_map import args_domain_of, as_flow_map, restored
from .._networks.pinn import PINN
from .._networks.trainable import Sampler
from .._networks.wrappers import OfPairs, PairField, PairSampler
from .arguments import (
    check_arguments,
    check_family,
    check_field,
    check_limits,
    check_pool,
    check_types,
)
from .data import as_data
from .defect import VectorField
from .objective import Objective
from .path_error import data_error, step_error
from .pool import Pool, with_domain
from .recipe import Recipe, second_order
from .state import FitLog, FitState, Past, continued, fingerprint, read_checkpoint
from .trainer import Progress, Trainer
from .windows import WindowEnds, solution_error, train_windows, windows_of

_Model = TypeVar("_Model", bound=eqx.Module)


def fit(
    model: _Model,
    vector_field: VectorField | None = None,
    *,
    key: PRNGKeyArray,
    sample: Sampler | None = None,
    data: tuple[Any, Any] | None = None,
    args: Args = None,
    recipe: Recipe | None = None,
    manifold: Manifold | None = None,
    state: FitState | None = None,
    target: float | None = None,
    seconds: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool | Progress = False,
) -> tuple[_Model, FitLog]:
    r"""Trains a network from the vector field alone, or a flow map from data, or from both.

    Minimises the mean over collocation points of $|u'(t) - f(t, u(t))|^2$, where $u$ is the output
    of the network and its time derivative is computed by forward-mode automatic differentiation.
    For a network with a conservative layer, the recipe's schedule determines the number of
    iterations of the layer in $u$.

    From `data` a flow map learns from pairs of states, one step of any length apart, which are
    drawn along the trajectories. The loss is that of the differences, each component relative to
    the root mean square change by a step. With a vector field the squared defect is added, relative
    to the median of $|f|^2$.

    Updates that are not finite are skipped. The best model is returned, not the last. `log.error`
    estimates the error of its solution.

    A `PINN` of several windows is trained window by window; each starts at the end of the previous
    one, projected to the manifold if one is given. Each is judged by its estimated error. A window
    that failed is trained again from other weights, and then in halves, as often as the recipe's
    `retries` allow. Errors add up along the solution and may grow: if it misses the `target`, the
    windows are trained again, to smaller errors. If the solution is still wrong, a warning names
    the window and the error.

    A training that was stopped, also by a keyboard interrupt, can be continued with otherwise the
    same arguments; the result is the same, bit for bit, as without the stop. A finished one can be
    continued with a recipe of more epochs. The result is that of all epochs at once unless the
    optimiser depends on their number, as SPRING does.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], a [`diffrax_conserve.DeepONet`][], any other
        [`diffrax_conserve.learned.AbstractFlowMap`][], or a Module `(y0, h) -> y` with an attribute
        `max_step`, of which all arrays are trained.
    - `vector_field`: $f(t, y, args)$. For a flow map it must not depend on time; with `data` it is
        optional.
    - `key`: a random key. The same key gives the same result.
    - `sample`: for a flow map, a function from a random key to an initial state, or a
        [`diffrax_conserve.learned.Pool`][], which follows the solutions from such states.
    - `data`: for a flow map, trajectories `(ts, ys)`: times of shape `(n, k)`, increasing along
        each trajectory and not necessarily equidistant, and states with leading axes `(n, k)`.
        [`diffrax_conserve.learned.trajectories`][] computes some. With a vector field and without
        `sample`, the collocation points use these states too.
    - `args`: passed to `vector_field`. Omit them for a flow map that takes `args` itself: they are
        drawn from its `args_domain`, and the states of `data` are pairs `(y, args)`.
    - `recipe`: a [`diffrax_conserve.learned.Recipe`][]. Default:
        [`diffrax_conserve.learned.second_order`][]`(model)`.
    - `manifold`: for a `PINN` of several windows, the manifold to which the ends of the windows are
        projected, with the conserved values at the initial state. Default: that of its layer.
    - `state`: the `state` in the log of a training that is to be continued.
    - `target`: for a flow map, the loss at which the training ends. For a `PINN`, the accepted
        estimated error of its solution, relative to its largest component. Default: all epochs are
        run, and a solution with an error above 1e-4 counts as wrong.
    - `seconds`: ends the training after this wall time.
    - `checkpoint`: a file for the state of the training, which is updated regularly; if it exists,
        the training continues from it.
    - `progress`: whether to print a line on standard error, or a function that is called regularly
        with the number of epochs done, the total number, the last loss and the best criterion.

    **Returns:**

    The trained model and a [`diffrax_conserve.learned.FitLog`][].

    **Raises:**

    `ValueError` or `TypeError` before the training if the arguments do not fit, for example if the
    vector field is not finite at an initial state, or for a flow map depends on time;
    `FloatingPointError` if no update was finite.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("harmonic-oscillator")
        pinn = dfc.PINN(system.y0, 0.0, 1.0, width=10, depth=2, key=jax.random.key(0))
        recipe = dfc.learned.paper(pinn, epochs=200, points=50)
        pinn, log = dfc.fit(pinn, system.vector_field, key=jax.random.key(1), recipe=recipe)
        print(f"loss {log.best:.0e} at epoch {log.best_epoch}")
        ```

        ```text
        loss 5e-03 at epoch 200
        ```

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131, Algorithm 1.
    """
    check_types(vector_field, key, sample, data, recipe, progress)
    check_arguments(model, sample, data, manifold)
    check_limits(state, target, seconds)
    recipe = second_order(model) if recipe is None else recipe
    given: Any = model
    flow_map = None if isinstance(model, PINN) else as_flow_map(given)
    if flow_map is not None and (domain := args_domain_of(flow_map)) is not None:
        check_family(sample, args)
        flow_map = OfPairs(flow_map)
        vector_field = None if vector_field is None else PairField(vector_field)
        sample = None if sample is None else PairSampler(sample, domain)
    found = None if data is None or flow_map is None else as_data(data, flow_map)
    if found is not None and vector_field is not None and sample is None:
        sample = found.sample
    trainer = Trainer(
        vector_field,
        sample,
        found,
        args,
        recipe,
        key,
        None if target is None else float(target),
        math.inf if seconds is None else seconds,
        progress,
        None if checkpoint is None else Path(checkpoint),
        fingerprint((model, key, args, vector_field), recipe),
    )
    if isinstance(model, PINN):
        return _fit_windows(trainer, model, manifold, state)
    assert flow_map is not None
    if isinstance(sample, Pool):
        check_pool(sample, flow_map, args, recipe)
    trained, log = _fit_flow_map(trainer, flow_map, state)
    trained = trained.flow_map if isinstance(trained, OfPairs) else trained
    return restored(trained, model), log


def _fit_windows(
    trainer: Trainer, pinn: PINN, manifold: Manifold | None, given: FitState | None
) -> tuple[Any, FitLog]:
    ends = WindowEnds.of(pinn, manifold, trainer.args)
    state = _first(trainer, pinn, given)
    state, found, ended = train_windows(trainer, state, ends)
    trainer.save(state, always=True)
    trained = pinn.cut(found.edges.tolist(), found.nets, found.y0s)
    error = solution_error(trainer, pinn, trained, found)
    if ended == "epochs" and trainer.target is not None and error <= trainer.target:
        ended = "target"
    return trained, _log(trainer, state, ended, error, found.errors)


def _fit_flow_map(trainer: Trainer, flow_map: Any, given: FitState | None) -> tuple[Any, FitLog]:
    state = _first(trainer, flow_map, given)
    objective, _ = trainer.start(state.model, state)

    def close(objective: Objective, state: FitState) -> bool:
        del objective
        return trainer.target is not None and float(state.carry.best) <= trainer.target

    def trained(objective: Objective, state: FitState) -> Any:
        best = eqx.combine(state.carry.best_weights, objective.static)
        return with_domain(best, state.carry.best_domain)

    def error(objective: Objective, state: FitState) -> float:
        network, field = trained(objective, state), trainer.vector_field
        if field is None:
            assert trainer.data is not None
            return data_error(network, trainer.data, trainer.key)
        assert trainer.sample is not None
        return step_error(network, field, trainer.args, trainer.sample, trainer.key)

    ended = "epochs"
    if not state.finished:
        state, ended = trainer.rounds(objective, state, close, error)
        state = dataclasses.replace(state, finished=int(state.done >= trainer.recipe.epochs))
    trainer.save(state, always=True)
    return trained(objective, state), _log(trainer, state, ended, error(objective, state))


def _first(trainer: Trainer, model: Any, given: FitState | None) -> FitState:
    """The first state of the training: the given one, that of a checkpoint, or a new one."""
    network = model.window(0) if isinstance(model, PINN) else model
    recipe, (points_key, _) = trainer.recipe, jr.split(trainer.key)
    if trainer.vector_field is not None:
        points = network.draw(recipe.times, trainer.sample, recipe.points, points_key)
        check_field(network, trainer.vector_field, trainer.args, points)
    _, carry = trainer.start(network, None)
    carry = jtu.tree_map(lambda x: jnp.astype(x, x.dtype), carry)
    windows = windows_of(model) if isinstance(model, PINN) else None
    nothing = np.zeros(0, int), np.zeros(0)
    first = FitState(model, carry, *nothing, Past.empty(), windows=windows)
    if given is not None:
        return continued(given, trainer.recipe.epochs, first)
    if trainer.checkpoint is not None and trainer.checkpoint.exists():
        found = read_checkpoint(trainer.checkpoint, first, trainer.mark)
        return found if found.finished else continued(found, trainer.recipe.epochs, first)
    return first


def _log(trainer: Trainer, state: FitState, ended: str, error: float, errors: Any = ()) -> FitLog:
    past = state.past.and_then(state.carry, state.checked, state.criteria)
    return FitLog(
        **vars(past),
        error=error,
        errors=np.asarray(errors),
        ended=ended,
        seconds=time.perf_counter() - trainer.begun - trainer.compile_seconds,
        compile_seconds=trainer.compile_seconds,
        state=state,
    )
